"""Several hosts: the same run as on one, and what becomes of it when a host goes.

Where root may make them, hosts are network namespaces, which share nothing but a bridge.
"""

import os
import subprocess
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import tomli_w
import zenoh

from emulator.drivers.hosts import host as host_side
from emulator.drivers.hosts import messages
from tests.support.forked_commands import VNET, Command, run
from tests.support.namespaces import NetworkHost, network, why_impossible
from tests.support.paths import ROOT
from tests.system.by_hand import line_of
from tests.system.conftest import PATIENT, TIMEOUT_S, Finished, Vnet
from vnet.transport import keys
from vnet.transport.access import Access, host_user
from vnet.transport.session import open_client, open_router, router_endpoint

SCENARIO: dict[str, Any] = {
    "run": {"name": "hosts", "duration_s": 4.0, "settle_s": 0.5},
    "network": {"vehicles": 5},
    "radio": {"loss": 0.1},
    "program": {"entry": "tests.system.programs:counts_its_starts"},
    "fault": [
        {"kind": "kill", "at_s": 0.5, "duration_s": 1.0, "nodes": ["v02"]},
        {"kind": "pause", "at_s": 1.0, "duration_s": 0.5, "nodes": ["v05"]},
        {"kind": "emulator_restart", "at_s": 2.0, "down_s": 0.2},
    ],
}


def write(path: Path, **changes: Any) -> str:
    path.write_text(tomli_w.dumps({**SCENARIO, **changes}))
    return str(path)


def test_on_two_hosts_the_run_is_that_of_one_process(vnet: Vnet, tmp_path: Path) -> None:
    """With a restart on one of them, a pause and roadside units on the other, and a restart of the router."""
    units = [{"position_m": [0.0, 0.0], "entry": "tests.support.roadside_programs:counts"}] * 2
    scenario = write(tmp_path / "hosts.toml", roadside=units)
    there, here = vnet("run", scenario, "--hosts", "2"), vnet("simulate", scenario)
    assert there.status == here.status == 0, there.stdout + there.stderr
    assert there.fingerprint == here.fingerprint
    kinds = ("log", "event", "restarted")
    assert [event for event in there.events if event["kind"] in kinds] == [
        event for event in here.events if event["kind"] in kinds
    ]
    assert (there.folder / "backbone.parquet").read_bytes() == (here.folder / "backbone.parquet").read_bytes()
    for file in ("logs/v02.log", "files/v02/starts.txt", "files/v05/starts.txt"):
        assert (there.folder / file).read_text() == (here.folder / file).read_text(), file
    assert (there.folder / "files/v02/starts.txt").read_text() == "2"
    measured = {event["node"] for event in there.events_of("memory")}
    assert measured >= {"v01", "v02", "v03", "v04", "v05"}
    assert all(each["cpu_s"] > 0 for each in there.verdict["cost"]["vehicles"])


NAMES = ["a", "b", "c"]
LOST = {"run": {"name": "lost", "duration_s": 2.0, "stall_timeout_s": 2.0}, "network": {"vehicles": 6}, "fault": []}
"""A run of three hosts with two vehicles each."""
ASKED_NS = 900_000_000
"""Last request of programs that speak in each period and are gone at one second."""


@pytest.fixture
def three_hosts() -> Iterator[list[NetworkHost]]:
    if why := why_impossible():
        pytest.skip(why)
    with network(3) as hosts:
        yield hosts


def run_on(hosts: list[NetworkHost], scenario: str, tmp_path: Path, scheme: str, *options: str) -> Finished:
    """Run a scenario with the emulator on the first of these hosts, and a host of the run on each."""
    access, folder = tmp_path / "access", tmp_path / "run"
    endpoint = f"{scheme}/{hosts[0].address}:7447"
    command = [*VNET, "access", scenario, "--hosts", ",".join(NAMES), "--listen", endpoint, "--out", str(access)]
    assert run(command, cwd=ROOT, capture_output=True, timeout=TIMEOUT_S).returncode == 0
    with ExitStack() as stack:
        words = [*VNET, "emulator", scenario, "--access", str(access), "--listen", endpoint, "--out", str(folder)]
        pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        emulator = Command(hosts[0].command(*words, *options), cwd=ROOT, **pipes)
        stack.enter_context(emulator)
        stack.callback(emulator.kill)
        line_of(emulator, "waiting for 3 hosts")
        for name, host in zip(NAMES, hosts, strict=True):
            words = [*VNET, "host", "--connect", endpoint, "--run", Path(scenario).stem]
            words += ["--credentials", str(access / "credentials" / f"host-{name}.json")]
            here = {**os.environ, "TMPDIR": str(tmp_path)}  # a host that is killed leaves its logs behind
            process = stack.enter_context(Command(host.command(*words), cwd=ROOT, env=here))
            stack.callback(process.kill)
        stdout, stderr = emulator.communicate(timeout=TIMEOUT_S)
    return Finished(emulator.returncode, stdout, stderr, folder)


def lose_the_third(hosts: list[NetworkHost], tmp_path: Path, how: str) -> Finished:
    program = {"entry": "tests.system.programs:ends_its_host", "options": {"vehicle": "v06", "how": how}}
    return run_on(hosts, write(tmp_path / "lost.toml", program=program, **LOST), tmp_path, "tcp")


def test_on_three_hosts_over_tls_the_run_is_that_of_one_process(
    vnet: Vnet, three_hosts: list[NetworkHost], tmp_path: Path
) -> None:
    scenario = write(tmp_path / "hosts.toml")
    there, here = run_on(three_hosts, scenario, tmp_path, "tls", *PATIENT), vnet("simulate", scenario)
    assert there.status == here.status == 0, there.stdout + there.stderr
    assert there.fingerprint == here.fingerprint


def test_a_host_that_is_killed_is_missed_at_that_barrier(three_hosts: list[NetworkHost], tmp_path: Path) -> None:
    done = lose_the_third(three_hosts, tmp_path, "kills")
    assert done.status == 1 and done.check("agents_alive")["verdict"] == "invalid", done.stdout + done.stderr
    assert done.check("progress")["verdict"] == "valid"
    assert [(event["host"], event["time_ns"]) for event in done.events_of("host_gone")] == [("c", ASKED_NS)]
    died = {event["node"]: (event["time_ns"], event["how"]) for event in done.events_of("died")}
    assert died == dict.fromkeys(["v05", "v06"], (ASKED_NS, "the connection of host c closed"))
    spoke = {node: {row["sent_ns"] for row in done.trace() if row["sender"] == node} for node in ("v01", "v05")}
    assert max(spoke["v05"]) < ASKED_NS < max(spoke["v01"])


def test_a_host_that_is_cut_off_ends_the_run_as_unknown(three_hosts: list[NetworkHost], tmp_path: Path) -> None:
    done = lose_the_third(three_hosts, tmp_path, "cuts")
    assert done.status == 3, done.stdout + done.stderr
    stalled = {event["node"]: event["time_ns"] for event in done.events_of("stalled")}
    assert stalled == {"v05": ASKED_NS, "v06": ASKED_NS}
    assert [event["host"] for event in done.events_of("host_silent")] == ["c"]
    assert (done.folder / "logs" / "v01.log").exists(), "the other hosts have handed in what they have"


def test_a_host_without_a_place_for_its_files_tells_the_emulator(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[messages.HostHello] = []
    welcome = messages.HostWelcome(b"", [["v01"]], "spawn", [], False, 1.0, 1, 1.0)
    monkeypatch.setattr(host_side, "Up", lambda *given: SimpleNamespace(nonce=b"", say_hello=said.append))
    monkeypatch.setattr(host_side._Join, "until_welcome", lambda join: welcome)
    monkeypatch.setattr(host_side, "set_time_slice", lambda *given: None)
    monkeypatch.setattr("tempfile.tempdir", "/dev/null")
    with pytest.raises(NotADirectoryError):
        host_side.run_host("tcp/127.0.0.1:1", "r", "a", None, [], 1.0, lambda line: None)
    (hello,) = said
    assert (hello.failure or "").startswith("/dev/null/vnet-host-")
    assert (hello.failure or "").endswith(": Not a directory")


def test_a_host_gets_and_says_nothing_but_its_own() -> None:
    access = Access.create("r", [["v01"], ["v02"]], hosts=["a", "b"])
    heard: list[str] = []
    stolen: list[str] = []
    over = threading.Event()

    def hear(sample: zenoh.Sample) -> None:
        heard.append(str(sample.key_expr))
        if sample.payload.to_bytes() == b"last":
            over.set()

    with open_router("tcp/127.0.0.1:0", access) as router, ExitStack() as stack:
        stack.enter_context(router.declare_subscriber("vnet/r/**", hear))
        stack.enter_context(router.liveliness().declare_subscriber("vnet/r/**", hear))
        thief, client = (
            stack.enter_context(open_client(router_endpoint(router), access.credentials(host_user("a")), 10_000))
            for _ in range(2)
        )
        for wanted in ("vnet/r/**", keys.host_rx("r", "b"), keys.host_tx("r", "b"), keys.node_rx("r", "v01")):
            stack.enter_context(
                thief.declare_subscriber(wanted, lambda sample: stolen.append(str(sample.key_expr)))
            )
        for key in (keys.host_rx("r", "b"), keys.node_rx("r", "v01"), keys.observe("r", "period")):
            router.put(key, b"secret")
        for key in (keys.host_tx("r", "b"), keys.node_tx("r", "v01"), keys.host_rx("r", "b"), "vnet/r/control/x"):
            client.put(key, b"false")
        client.liveliness().declare_token(keys.host_alive("r", "b"))
        client.put(keys.host_tx("r", "a"), b"last")
        assert over.wait(TIMEOUT_S)
    secrets = [keys.host_rx("r", "b"), keys.node_rx("r", "v01"), keys.observe("r", "period")]
    assert [key for key in heard if key not in secrets] == [keys.host_tx("r", "a")]
    assert stolen == []
