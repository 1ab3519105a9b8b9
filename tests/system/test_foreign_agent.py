"""Whole runs in which an agent that imports no vnet takes part, beside those of vnet, in both pacings."""

import ast
import shlex
import signal
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any

import pytest

from tests.support.forked_commands import AGENT, Command
from tests.support.paths import ROOT
from tests.support.processes import wait_until
from tests.system.by_hand import NODES, finish, start_emulator
from tests.system.conftest import TIMEOUT_S, Finished, Vnet, heard_by, run_until

FOREIGN = [sys.executable, "-P", "docs/examples/foreign_agent.py"]
WRONG = [sys.executable, "-P", "-m", "tests.system.wrong_agent"]
LISTEN = ("--listen", "tcp/127.0.0.1:0")


@pytest.fixture(autouse=True)
def tests_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the processes of the agents with a mistake import this package."""
    monkeypatch.setenv("PYTHONPATH", str(ROOT))


def start(
    stack: ExitStack, command: list[str], node: str, endpoint: str, folder: Path, log: IO[str] | None = None
) -> subprocess.Popen[Any]:
    credentials = str(folder / "access" / "credentials" / f"{node}.json")
    words = [*command, "--connect", endpoint, "--run", "beacon", "--node", node, "--credentials", credentials]
    agent = (Command if command == AGENT else subprocess.Popen)(words, cwd=ROOT, stdout=log)
    stack.callback(agent.wait)
    stack.callback(agent.kill)
    return agent


def test_the_foreign_agent_is_short_and_imports_no_vnet() -> None:
    text = (ROOT / "docs" / "examples" / "foreign_agent.py").read_text()
    imports = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Import | ast.ImportFrom)]
    names = {alias.name for node in imports if isinstance(node, ast.Import) for alias in node.names}
    names |= {str(node.module) for node in imports if isinstance(node, ast.ImportFrom)}
    assert {name.split(".")[0] for name in names} - sys.stdlib_module_names == {"msgpack", "zenoh"}
    assert len(text.splitlines()) < 200


def test_foreign_agents_and_those_of_vnet_take_part_in_one_run(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with ExitStack() as stack:
        emulator, endpoint = start_emulator(stack, folder, *LISTEN)
        for node in NODES[:2]:
            start(stack, AGENT, node, endpoint, folder)
        foreign = [start(stack, FOREIGN, node, endpoint, folder) for node in NODES[2:]]
        done = finish(emulator, folder)
        assert [agent.wait(TIMEOUT_S) for agent in foreign] == [0, 0]
    assert done.verdict["verdict"] == "valid", done.stdout
    sent = {node: len({row["seq"] for row in done.trace() if row["sender"] == node}) for node in NODES}
    assert set(sent.values()) == {20}
    assert receivers_of(done, "v03") == {"v01", "v02", "v04"}


def test_in_real_time_they_take_part_as_well(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    options = ("--pacing", "realtime", "--duration", "3600", "--program", "tests.system.programs:names_neighbours")
    with ExitStack() as stack:
        emulator, endpoint = start_emulator(stack, folder, *LISTEN, *options)
        for node in NODES[:2]:
            log = stack.enter_context((folder / "logs" / f"{node}.log").open("w"))
            start(stack, AGENT, node, endpoint, folder, log)
        foreign = [start(stack, FOREIGN, node, endpoint, folder) for node in NODES[2:]]
        pairs = [("v01", "v02"), ("v01", "v03"), ("v02", "v01"), ("v02", "v04")]
        wait_until(lambda: all(len(seconds_heard(folder, *pair)) >= 2 for pair in pairs), emulator)
        emulator.send_signal(signal.SIGINT)
        done = finish(emulator, folder)
        assert [agent.wait(TIMEOUT_S) for agent in foreign] == [0, 0]
    assert done.verdict["verdict"] == "unknown", "it was interrupted, and everything else is as it should be"
    assert done.events_of("died") == done.events_of("refused") == []
    assert {"v01", "v02", "v04"} >= receivers_of(done, "v03") >= {"v01"}


UNSHARE = ["unshare", "--time", "--kill-child", "--monotonic"]


def test_in_real_time_agents_in_another_time_namespace_begin_with_the_run(tmp_path: Path) -> None:
    """Their monotonic clocks are behind or ahead of the emulator's, and the boot id is the same."""
    if subprocess.run([*UNSHARE, "1", "true"], capture_output=True, check=False).returncode != 0:
        pytest.skip("time namespaces are not permitted here")
    folder = tmp_path / "run"
    agents = [AGENT, [*UNSHARE, "-500", *AGENT], [*UNSHARE, "5", *AGENT], [*UNSHARE, "5", *FOREIGN]]
    with ExitStack() as stack:
        emulator, endpoint = start_emulator(stack, folder, *LISTEN, "--pacing", "realtime")
        for node, agent in zip(NODES, agents, strict=True):
            start(stack, agent, node, endpoint, folder)
        done = finish(emulator, folder)
    assert {row["sender"] for row in done.trace()} == set(NODES)
    (late,) = done.events_of("late_deliveries")
    assert late["max_ms"] < 4000


def receivers_of(done: Finished, sender: str) -> set[str]:
    return {row["receiver"] for row in done.trace() if row["sender"] == sender and row["outcome"] == "delivered"}


def seconds_heard(folder: Path, node: str, sender: str) -> set[int]:
    """The seconds in which a vehicle of vnet's own has heard another."""
    return {second for name, second in heard_by(folder, node) if name.startswith(sender)}


def test_a_run_of_foreign_agents_replays_over_tls_too(tmp_path: Path) -> None:
    fingerprints = []
    for listen in ("tcp/127.0.0.1:0", "tls/127.0.0.1:0"):
        folder = tmp_path / listen[:3]
        with ExitStack() as stack:
            emulator, endpoint = start_emulator(stack, folder, "--listen", listen)
            for node in NODES:
                start(stack, FOREIGN, node, endpoint, folder)
            fingerprints.append(finish(emulator, folder).fingerprint)
    assert fingerprints[0] == fingerprints[1]


def test_a_killed_foreign_agent_is_named_and_the_others_go_on(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with ExitStack() as stack:
        emulator, endpoint = start_emulator(stack, folder, *LISTEN, "--duration", "20")
        agents = {node: start(stack, FOREIGN, node, endpoint, folder) for node in NODES}
        wait_until(lambda: '"started"' in (folder / "events.jsonl").read_text(), emulator)
        agents["v04"].send_signal(signal.SIGKILL)
        done = finish(emulator, folder)
    assert done.verdict["verdict"] == "invalid"
    (died,) = done.events_of("died")
    assert died["node"] == "v04"
    assert done.check("agents_alive")["verdict"] == "invalid"
    assert done.check("progress")["verdict"] == "valid"


GIVEN = ["--connect", "{endpoint}", "--run", "{run}", "--node", "{node}", "--credentials", "{credentials}"]
EACH_FOREIGN = ("--agent", shlex.join([*FOREIGN, *GIVEN]))


def each_wrong(mistake: str) -> tuple[str, str]:
    return "--agent", shlex.join([*WRONG, mistake, *GIVEN])


MISTAKES = {
    "SaysTextForInteger": "Expected `int`, got `str`",
    "ForgetsItsNonce": "without the nonce of its process",
    "CountsByItself": "yield 1 of v03: expected 0",
    "SpeaksForOthers": "speaks for v02, which is not its own",
    "TimerInThePast": "its next timer, 0, lies before the end of its window",
    "StepsAfterItsWindow": "a step at 2000000, where 0 to 1999999 are allowed",
    "ClaimsAFault": "tells an event fault_started, which is a name of vnet's own",
}


def test_misbehaving_agents_are_refused_with_the_reason_and_the_run_is_unknown(tmp_path: Path) -> None:
    mistakes = {f"v{number:02}": mistake for number, mistake in enumerate(MISTAKES, 1)}
    agents = each_wrong(",".join(f"{node}={mistake}" for node, mistake in mistakes.items()))
    folder = tmp_path / "run"

    def are_refused() -> bool:
        events = folder / "events.jsonl"
        return events.exists() and events.read_text().count('"refused"') >= len(mistakes)

    vehicles = ("--set", f"network.vehicles={len(mistakes)}", "--set", "run.stall_timeout_s=3600")
    done = run_until(are_refused, folder, "scenarios/beacon.toml", *vehicles, *agents)
    assert done.verdict["verdict"] == "unknown", done.stdout
    refused = {event["node"]: event["reason"] for event in done.events_of("refused")}
    assert refused.keys() == mistakes.keys()
    for node, mistake in mistakes.items():
        assert MISTAKES[mistake] in refused[node]


FAULTS = """
[run]
name = "faults"
duration_s = 3.0
settle_s = 0.5

[network]
vehicles = 3

[program]
entry = "agents.beacon:main"

[[fault]]
kind = "restart"
nodes = ["v01"]
at_s = 0.3
duration_s = 0.5

[[fault]]
kind = "pause"
nodes = ["v02"]
at_s = 0.5
duration_s = 0.6

[[fault]]
kind = "skew"
nodes = ["v03"]
at_s = 0.5
duration_s = 0.5
offset_ms = 5.0
"""


def test_a_run_starts_foreign_agents_and_does_to_them_what_faults_do(vnet: Vnet, tmp_path: Path) -> None:
    (tmp_path / "faults.toml").write_text(FAULTS)
    done = vnet("run", str(tmp_path / "faults.toml"), *EACH_FOREIGN)
    assert done.verdict["verdict"] == "valid", done.stdout
    assert "foreign_agent.py" in shlex.split(done.verdict["reproduce"])[3]  # after vnet run --agent
    assert [event["node"] for event in done.events_of("restarted")] == ["v01"]
    assert done.events_of("refused") == done.events_of("died") == []
    assert {row["sender"] for row in done.trace()} == {"v01", "v02", "v03"}


@pytest.mark.parametrize(
    ("mistake", "pacing", "check", "verdict"),
    [
        ("EndsWithAnError", "lockstep", "agents_alive", "invalid"),
        ("NeverAcknowledges", "realtime", "transport", "unknown"),
    ],
)
def test_what_is_no_message_is_judged(vnet: Vnet, mistake: str, pacing: str, check: str, verdict: str) -> None:
    few = ("--duration", "1.5", "--set", "network.vehicles=2", "--pacing", pacing)
    assert vnet("run", "scenarios/beacon.toml", *each_wrong(mistake), *few).check(check)["verdict"] == verdict


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (each_wrong("KnowsNoWindows"), "speaks version 1 of the messages"),
        (("--agent", f"{sys.executable} -c 'print(1); exit(4)' {' '.join(GIVEN)}"), "(exit status 4): 1"),
    ],
)
def test_an_agent_that_cannot_be_started_is_told_in_one_line(
    vnet: Vnet, options: tuple[str, ...], told: str
) -> None:
    done = vnet("run", "scenarios/beacon.toml", "--set", "network.vehicles=2", *options)
    assert done.status == 2 and told in done.stderr.splitlines()[-1]


def test_a_message_of_a_hundred_megabytes_is_refused_by_name(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with ExitStack() as stack:
        emulator, endpoint = start_emulator(stack, folder, *LISTEN, "--set", "run.stall_timeout_s=3600")
        start(stack, [*WRONG, "SendsHundredMegabytes"], "v01", endpoint, folder)
        for node in NODES[1:]:
            start(stack, FOREIGN, node, endpoint, folder)
        wait_until(lambda: '"refused"' in (folder / "events.jsonl").read_text(), emulator)
        emulator.send_signal(signal.SIGINT)
        done = finish(emulator, folder)
    (refused,) = done.events_of("refused")
    assert refused["node"] == "v01" and "message of 10000" in refused["reason"]


def test_reports_that_no_program_could_make_are_seen(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with ExitStack() as stack:
        emulator, endpoint = start_emulator(stack, folder, *LISTEN)
        start(stack, [*WRONG, "ReportsNoCovariance"], "v01", endpoint, folder)
        for node in NODES[1:]:
            start(stack, FOREIGN, node, endpoint, folder)
        done = finish(emulator, folder)
    check = done.check("reports")
    assert check["verdict"] == done.verdict["verdict"] == "invalid"
    told = [row["what"] for row in check["figures"]["rows"]]
    assert "../../x: not a name of a value" in told and "covariance_m2: no covariance matrix" in told


def test_a_foreign_agent_that_is_refused_ends_with_one_line(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with ExitStack() as stack:
        _, endpoint = start_emulator(stack, folder, *LISTEN)
        credentials = str(folder / "access" / "credentials" / "v01.json")
        values = ["--connect", endpoint, "--run", "beacon", "--node", "v01", "--credentials", credentials]
        words = [*WRONG, "OfNoNode", *values]
        done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert done.stderr == "v01: refused: a hello on the key of v01 names 'v99'\n"
