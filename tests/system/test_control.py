"""Operators at a running emulator: faults injected live act, heal, and replay from what the run wrote down."""

import json
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from emulator.drivers.control import CONTROL_FILE, OPERATOR_FILE, ask
from tests.support.processes import wait_until
from tests.system.conftest import TIMEOUT_S, Finished, Vnet, in_this_process
from tests.system.test_failures import long_run
from vnet.errors import VnetError
from vnet.transport import keys
from vnet.transport.credentials import Credentials
from vnet.transport.session import open_client

LOSS = {"kind": "loss", "duration_s": 3000.0, "probability": 1.0}


def ask_until(folder: Path, wanted: Callable[[dict[str, Any]], bool]) -> None:
    """Ask for the status until it is as wanted: emulated time passes meanwhile, at whatever pace."""
    wait_until(lambda: wanted(ask(folder, "status")))


def test_faults_are_injected_listed_and_healed_while_the_run_is_on(tmp_path: Path, vnet: Vnet) -> None:
    folder = tmp_path / "run"
    with long_run(folder) as process:
        assert [(folder / name).stat().st_mode & 0o077 for name in (CONTROL_FILE, OPERATOR_FILE)] == [0, 0]
        kill = ["kill", "--for", "2", "--set", "nodes.count=1"]
        status, told, error = in_this_process(["fault", "inject", *kill, "--run", str(folder)])
        assert status == 0, error
        assert "kill-0" in told
        assert ask(folder, "inject", LOSS)["fault"] == "loss-1"
        ask_until(folder, lambda status: [f["state"] for f in status["faults"]] == ["ended", "acting"])
        assert ask(folder, "heal", "loss-1") == {"healed": ["loss-1"]}
        ask_until(folder, lambda status: status["faults"][1]["state"] == "ended")
        assert ask(folder, "heal", "loss-1") == {"healed": ["loss-1"]}, "healing twice is harmless"
        _, listed, _ = in_this_process(["fault", "list", "--run", str(folder)])
        assert [name in listed for name in ("kill-0", "loss-1")] == [True, True]
        assert " 3 up\n" in in_this_process(["status", "--run", str(folder)])[1]
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=TIMEOUT_S)
    assert not (folder / CONTROL_FILE).exists()
    assert not (folder / OPERATOR_FILE).exists()
    done = Finished(process.returncode, "", "", folder)
    ends = {event["fault"]: event["time_ns"] / 1e9 for event in done.events_of("fault_ended")}
    # The whole schedule is in the run's scenario: up to the last end, simulating it gives the same trace.
    until_s = str(max(ends.values()) + 0.05)
    again = vnet("simulate", str(folder / "scenario.toml"), "--duration", until_s, "--set", "run.settle_s=0")
    limit_ns = float(until_s) * 1e9
    kept = [row for row in done.trace() if row["sent_ns"] < limit_ns - 2e7]
    assert kept == [row for row in again.trace() if row["sent_ns"] < limit_ns - 2e7]
    assert {row["cause"] for row in kept} == {"", "loss-1"}


@pytest.mark.parametrize(
    ("verb", "payload", "said"),
    [
        ("inject", b"{", "not valid JSON"),
        ("inject", b"[" * 100_000, "not valid JSON"),
        ("inject", b"\xff", "not valid JSON"),
        ("inject", b" " * 2_000_000, "at most 1048576 are taken"),
        ("inject", b"{}", "a kind is needed"),
        ("inject", b'{"kind": "kill", "duration_s": -1}', "kill.duration_s = -1"),
        ("inject", b'{"kind": "kill", "duration_s": 1, "nodes": {"ids": ["x"]}}', "'x' is no vehicle"),
        ("inject", b'{"kind": "router_restart"}', "needs a router of its own"),
        ("heal", b'"nothing"', "no fault 'nothing'"),
        ("heal", b"7", "7 is no name of a fault"),
        ("explode", b"", "control/explode: unknown; there are status, inject, heal"),
    ],
)
def test_a_bad_query_gets_one_line_of_error_and_changes_nothing(
    running: tuple[Path, dict[str, str]], verb: str, payload: bytes, said: str
) -> None:
    folder, control_endpoint = running
    login = Credentials.load(folder / OPERATOR_FILE)
    with open_client(control_endpoint["endpoint"], login, 10_000) as session:
        replies = list(session.get(keys.control(control_endpoint["run"], verb), payload=payload, timeout=TIMEOUT_S))
    assert len(replies) == 1
    assert replies[0].err is not None
    text = replies[0].err.payload.to_string()
    assert said in text
    assert "\n" not in text
    assert ask(folder, "status")["faults"] == []


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder = tmp_path_factory.mktemp("control") / "run"
    with long_run(folder, "--pacing", "realtime") as process:  # in lockstep it would fill the memory meanwhile
        yield folder, json.loads((folder / CONTROL_FILE).read_text())
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=TIMEOUT_S)


def test_where_no_run_is_going_on_a_command_says_so(tmp_path: Path) -> None:
    with pytest.raises(VnetError, match="no run is going on there"):
        ask(tmp_path, "status")
    told = in_this_process(["fault", "list", "--run", str(tmp_path)])
    assert told == (2, "", f"vnet: {tmp_path}: no run is going on there ({CONTROL_FILE} is missing)\n")
