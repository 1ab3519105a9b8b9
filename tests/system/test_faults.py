"""Faults in whole runs: the same trace live and simulated, and nothing left standing, whatever ends the run."""

import json
import os
import signal
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import tomli_w

from tests.support.forked_commands import VNET, Command
from tests.support.paths import ROOT
from tests.support.processes import has_ended, wait_until
from tests.system.conftest import TIMEOUT_S, Vnet, heard_by, run_until, zygote_of

PROGRAM = "tests.support.fault_programs:minds_the_order"

EVERY_SORT = [
    {"kind": "kill", "at_s": 0.53, "duration_s": 0.6, "nodes": {"ids": ["v01"]}},
    {"kind": "restart", "at_s": 0.8, "duration_s": 0.4, "nodes": {"ids": ["v02", "v03"]}},
    {"kind": "pause", "at_s": 0.9, "duration_s": 0.77, "nodes": {"ids": ["v03", "v04"]}},
    {"kind": "skew", "at_s": 0.7, "duration_s": 1.1, "offset_ms": -130, "nodes": {"ids": ["v02", "v04"]}},
    {"kind": "drift", "at_s": 1.0, "duration_s": 0.9, "rate_ppm": 200_000, "nodes": {"ids": ["v01"]}},
    {"kind": "partition", "at_s": 1.2, "duration_s": 0.5},
    {"kind": "corrupt", "at_s": 0.4, "duration_s": 1.5, "probability": 0.5},
    {"kind": "kill", "at_s": 1.5, "duration_s": 0.2},
]

IN_PAIRS = [
    {"kind": "kill", "at_s": 0.53, "duration_s": 0.4, "nodes": {"ids": ["v01", "v02"]}},
    {"kind": "pause", "at_s": 0.8, "duration_s": 0.37, "nodes": {"ids": ["v04", "v03"]}},
    {"kind": "partition", "at_s": 1.2, "duration_s": 0.5},
    {"kind": "restart", "at_s": 1.4, "duration_s": 0.4, "nodes": {"ids": ["v03", "v04"]}},
    {"kind": "skew", "at_s": 0.7, "duration_s": 1.1, "offset_ms": -130, "nodes": {"ids": ["v02", "v04"]}},
]
"""Check that nodes that share a process end together."""


def write(folder: Path, faults: Sequence[dict[str, Any]], **sections: dict[str, Any]) -> str:
    """A small scenario with these faults; returns its path."""
    data: dict[str, Any] = {
        "run": {"name": "faulty", "duration_s": 2.5, "settle_s": 0.5, "orphan_timeout_s": 0.5},
        "network": {"vehicles": 4},
        "radio": {"loss": 0.1, "range_m": 1e6},
        "program": {"entry": PROGRAM},
        "fault": list(faults),
    }
    for name, section in sections.items():
        data[name] = {**data[name], **section}
    path = folder / "faulty.toml"
    path.write_text(tomli_w.dumps(data))
    return str(path)


def processes_of(folder: Path) -> dict[int, str]:
    """The processes, by pid, whose log lies in a run's folder, with their state as /proc says it."""
    found = {}
    for process in Path("/proc").glob("[0-9]*"):
        try:
            log = log_of(int(process.name))
            state = (process / "stat").read_text().rpartition(")")[2].split()[0]
        except OSError:
            continue
        if log.startswith(str(folder)) and state != "Z":
            found[int(process.name)] = state
    return found


def log_of(pid: int) -> str:
    """The file to which a process writes."""
    return str(Path(f"/proc/{pid}/fd/1").readlink())


def wait_until_all_are_gone(folder: Path) -> None:
    """Wait until the processes of a run, which are not our children, have ended."""
    for pid in processes_of(folder):
        if not has_ended(pid, 120):  # a recorder draws what still waits
            os.kill(pid, signal.SIGKILL)
            pytest.fail(f"process {pid} is left behind")
    assert processes_of(folder) == {}


def events_of(folder: Path, kind: str) -> list[dict[str, Any]]:
    try:
        lines = (folder / "events.jsonl").read_text().splitlines()
    except FileNotFoundError:
        return []
    return [event for line in lines if (event := json.loads(line))["kind"] == kind]


@contextmanager
def started(scenario: str, folder: Path, *options: str, after: str) -> Iterator[subprocess.Popen[str]]:
    """`vnet run`, once the event `after` has happened."""
    command = [*VNET, "run", scenario, "--out", str(folder), *options]
    with Command(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            wait_until(lambda: bool(events_of(folder, after)), process)
            yield process
        finally:
            process.kill()


@pytest.mark.parametrize(
    ("together", "router", "start", "faults"),
    [
        (1, "embedded", "fork", [*EVERY_SORT, {"kind": "emulator_restart", "at_s": 1.1, "down_s": 0.3}]),
        (1, "separate", "spawn", [*EVERY_SORT, {"kind": "router_restart", "at_s": 1.1, "down_s": 0.3}]),
        (2, "embedded", "fork", IN_PAIRS),
    ],
)
def test_a_run_with_faults_of_every_sort_replays_live_and_simulated(
    vnet: Vnet, tmp_path: Path, together: int, router: str, start: str, faults: list[dict[str, Any]]
) -> None:
    scenario = write(tmp_path, faults, run={"nodes_per_process": together, "start": start})
    live = vnet("run", scenario, "--router", router)
    simulated = vnet("simulate", scenario)
    assert live.check("progress")["verdict"] == "valid", live.stdout + live.stderr
    assert live.fingerprint == simulated.fingerprint
    assert [e for e in live.events if e["kind"].startswith(("fault_", "restarted"))] == [
        e for e in simulated.events if e["kind"].startswith(("fault_", "restarted"))
    ]
    assert len(live.events_of("fault_ended")) == len(faults)
    assert live.verdict["verdict"] == simulated.verdict["verdict"] == "valid", live.stdout
    assert live.outcomes["fault"] > 0
    assert live.outcomes["receiver_down"] > 0
    for node in ("v01", "v02", "v03", "v04"):
        place = Path("files") / node / "incarnations"
        entries = (live.folder / place).read_text()
        assert len(entries.split()) > 1 and entries == (simulated.folder / place).read_text()
    assert processes_of(live.folder) == {}


def kill_zygote(emulator: subprocess.Popen[str]) -> int:
    """Kill the process from which a run's agents are forked; returns the one that takes its place."""
    former = zygote_of(emulator.pid)
    os.kill(former, signal.SIGKILL)
    wait_until(lambda: zygote_of(emulator.pid) not in (0, former), emulator)
    return zygote_of(emulator.pid)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_vehicles_that_stand_still_do_not_outlive_the_run(tmp_path: Path, number: signal.Signals) -> None:
    pause = {"kind": "pause", "at_s": 0.3, "duration_s": 3600, "nodes": {"ids": ["v01", "v03"]}}
    scenario = write(tmp_path, [pause], run={"pacing": "realtime", "duration_s": 7200})
    folder = tmp_path / "run"
    with started(scenario, folder, after="fault_started") as process:
        wait_until(lambda: [*processes_of(folder).values()].count("T") == 2, process)
        assert len(processes_of(folder)) == 4
        zygote = kill_zygote(process)
        assert sorted(processes_of(folder).values()).count("T") == 2, "they are paused without their zygote, too"
        process.send_signal(number)
        process.communicate(timeout=TIMEOUT_S)
        assert has_ended(zygote, TIMEOUT_S)
        assert number == signal.SIGKILL or processes_of(folder) == {}
        wait_until_all_are_gone(folder)


def test_a_killed_lockstep_run_leaves_no_process_and_no_router(tmp_path: Path) -> None:
    faults = [
        {"kind": "emulator_restart", "at_s": 0.1, "down_s": 0.1},
        {"kind": "kill", "at_s": 0.3, "duration_s": 3000, "nodes": {"ids": ["v01"]}},
        {"kind": "pause", "at_s": 0.2, "duration_s": 3000, "nodes": {"ids": ["v02"]}},
    ]
    scenario = write(tmp_path, faults, run={"duration_s": 7200})
    folder = tmp_path / "run"
    with started(scenario, folder, "--router", "separate", after="fault_ended") as process:
        wait_until(lambda: len(processes_of(folder)) == 4, process)  # three agents and the router
        (router,) = [pid for pid in processes_of(folder) if log_of(pid).endswith("/router.log")]
        config = Path(Path(f"/proc/{router}/cmdline").read_text().split("\0")[-2])
        assert config.exists()
        process.kill()
        wait_until_all_are_gone(folder)
    assert not config.parent.exists(), "nor the run's passwords"


@pytest.mark.parametrize("pacing", ["lockstep", "realtime"])
def test_a_router_that_somebody_kills_ends_the_run_as_unknown(tmp_path: Path, pacing: str) -> None:
    """The machine's fault, not that of the vehicles, which were told as dead."""
    scenario = write(tmp_path, [], run={"duration_s": 7200, "pacing": pacing})
    folder = tmp_path / "run"
    with started(scenario, folder, "--router", "separate", "--no-report", after="started") as process:
        (router,) = [pid for pid in processes_of(folder) if log_of(pid).endswith("/router.log")]
        os.kill(router, signal.SIGKILL)
        process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 3
    assert processes_of(folder) == {}
    verdict = json.loads((folder / "verdict.json").read_text())
    assert verdict["verdict"] == "unknown"
    assert "router" in next(check["text"] for check in verdict["checks"] if check["name"] == "progress")
    assert events_of(folder, "died") == []


@pytest.mark.slow
def test_in_real_time_who_is_paused_in_a_restart_of_the_emulator_loses_nothing_to_the_machine(
    vnet: Vnet, tmp_path: Path
) -> None:
    faults = [
        {"kind": "pause", "at_s": 0.4, "duration_s": 0.8, "nodes": {"ids": ["v02"]}},
        {"kind": "emulator_restart", "at_s": 0.6, "down_s": 0.1},
    ]
    done = vnet("run", write(tmp_path, faults, run={"pacing": "realtime", "duration_s": 4.0}))
    assert done.verdict["verdict"] != "invalid", done.stdout
    assert done.check("transport")["verdict"] == "valid"
    assert max(row["sent_ns"] for row in done.trace() if row["sender"] == "v02") > 1.2e9


def test_in_real_time_processes_are_killed_restarted_and_paused_and_none_is_left(tmp_path: Path) -> None:
    faults = [
        {"kind": "kill", "at_s": 0.5, "duration_s": 0.5, "nodes": {"ids": ["v01"]}},
        {"kind": "restart", "at_s": 0.7, "duration_s": 0.5, "nodes": {"ids": ["v02"]}},
        {"kind": "pause", "at_s": 0.6, "duration_s": 0.7, "nodes": {"ids": ["v03", "v02"]}},
    ]
    run = {"pacing": "realtime", "duration_s": 3600.0}
    scenario = write(tmp_path, faults, run=run, program={"entry": "tests.system.programs:names_neighbours"})
    folder = tmp_path / "run"

    def all_are_there_again() -> bool:
        late = {name for name, second in heard_by(folder, "v04") if second >= 2}
        return late >= {"v01.1", "v02.1", "v03.0"}

    done = run_until(all_are_there_again, folder, scenario)
    assert done.verdict["verdict"] != "invalid", done.stdout
    assert sorted(event["node"] for event in done.events_of("restarted")) == ["v01", "v02"]
    assert len(done.events_of("fault_ended")) == 3
    assert done.events_of("died") == done.events_of("crashed") == []
    assert processes_of(done.folder) == {}
