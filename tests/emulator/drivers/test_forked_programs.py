"""Simulations in several processes: how they end, and what their programs need not know.

Other tests of this folder compare their traces, events and metrics with those of one process (`run_forked`).
"""

import io
import math
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from multiprocessing import Pipe
from pathlib import Path
from typing import Any, NoReturn

import pytest

from emulator.drivers import local
from emulator.drivers.conclude import conclude
from emulator.drivers.local import ForkedPrograms
from emulator.drivers.simulate import process_count, simulate, split_evenly
from emulator.radio.outcomes import Outcome
from emulator.records.costs import read_cost
from tests.emulator.drivers.test_status import emulate
from tests.support.multi_loop_driver import emulation_of, scenario_of
from vnet.errors import VnetError
from vnet.node import Node
from vnet.runtime.programs import given_programs

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("default_signals")]

AT_NS = 500_000_000


def children() -> set[str]:
    """Return the processes that this one has started."""
    here = Path("/proc/self/task")
    return {pid for task in here.iterdir() for pid in (task / "children").read_text().split()}


def entry(program: Callable[..., object]) -> dict[str, str]:
    return {"entry": f"{__name__}:{program.__name__}"}


async def is_interrupted(node: Node) -> None:
    """Ctrl-C comes while a program computes."""
    async for fix in node.gnss:
        if node.id == "v02" and fix.time_ns == AT_NS:
            os.kill(os.getppid(), signal.SIGINT)
        await node.radio.broadcast(b"x")


async def computes_for_ever(node: Node) -> None:
    """Ctrl-C comes, and the program does not yield."""
    async for fix in node.gnss:
        if node.id == "v02" and fix.time_ns == AT_NS:
            os.kill(os.getppid(), signal.SIGINT)
            while True:
                pass


async def ends_its_process(node: Node) -> None:
    async for fix in node.gnss:
        if node.id == "v05" and fix.time_ns == AT_NS:
            os.kill(os.getpid(), signal.SIGKILL)


async def two_end_their_process(node: Node) -> None:
    async for fix in node.gnss:
        if node.id in ("v03", "v05") and fix.time_ns == AT_NS:
            print("the reason")
            os.kill(os.getpid(), signal.SIGKILL)


kept_open: list[Any] = []


async def writes_a_file(node: Node) -> None:
    file = Path(f"{node.id}.txt").open("w")  # noqa: SIM115 (the process ends before it is closed)
    kept_open.append(file)
    async for fix in node.gnss:
        file.write(f"{fix.time_ns} ")
        if node.id == "v02" and fix.time_ns == AT_NS:
            file.close()
            return


async def gives_its_output_away(node: Node) -> None:
    subprocess.run([sys.executable, "-c", "print('of another process')"], stdout=sys.stdout, check=True)


async def prints_letters(node: Node) -> None:
    if node.id == "v01":
        sys.stdout.buffer.write(b"\xff\n")
    print("\N{GREEK SMALL LETTER TAU}")


async def raises_on_its_way_out(node: Node) -> None:
    try:
        async for _ in node.gnss:
            await node.radio.broadcast(b"x")
    finally:
        if node.id == "v01":
            raise RuntimeError("on the way out")


@pytest.mark.parametrize("program", [is_interrupted, computes_for_ever])
def test_an_interruption_is_recorded_and_leaves_no_process(tmp_path: Path, program: Callable[..., object]) -> None:
    """The second Ctrl-C ends programs that do not yield."""
    before = children()
    emulation = emulate(tmp_path / "run", program=entry(program))
    asked = []

    def on_interrupt() -> None:
        asked.append(1)
        if program is computes_for_ever:
            os.kill(os.getpid(), signal.SIGINT)

    wall_s, interrupted = simulate(emulation, on_interrupt=on_interrupt, processes=3)
    assert (interrupted, asked) == (True, [1])
    assert [(e.kind, e.time_ns) for e in emulation.folder.events] == [("started", 0), ("interrupted", AT_NS)]
    judgement, _ = conclude(emulation, wall_s, "simulate")
    assert judgement.exit_status == 3
    assert children() == before


def test_vehicles_of_a_process_that_ends_have_died_and_the_others_go_on(tmp_path: Path) -> None:
    before = children()
    emulation = emulate(tmp_path / "run", program=entry(ends_its_process))
    wall_s, _ = simulate(emulation, processes=2)
    judgement, verdict = conclude(emulation, wall_s, "simulate")
    assert judgement.exit_status == 1
    died = [event for event in emulation.folder.events if event.kind == "died"]
    assert [event.node for event in died] == ["v04", "v05", "v06"]
    assert {event.details["how"] for event in died} == {"SIGKILL, while v05 ran"}
    assert verdict["emulated_s"] == emulation.duration_ns / 1e9
    assert children() == before


def test_vehicles_that_end_their_processes_die_alone(tmp_path: Path) -> None:
    emulation = emulate(tmp_path / "run", program=entry(two_end_their_process))
    simulate(emulation, apart="v05")
    died = {event.node: event.details["how"] for event in emulation.folder.events if event.kind == "died"}
    assert died.keys() == {"v03", "v05"} and died["v05"] == "SIGKILL"
    assert "the reason\n" in (tmp_path / "run" / "logs" / "v05.log").read_text()


def test_a_vehicle_that_ended_the_process_of_all_has_died_though_it_ends_not_its_own(tmp_path: Path) -> None:
    emulation = emulate(tmp_path / "run")
    simulate(emulation, apart="v05")
    judgement, _ = conclude(emulation, 1.0, "simulate")
    assert judgement.exit_status == 1
    assert [event.node for event in emulation.folder.events if event.kind == "died"] == ["v05"]
    with pytest.raises(VnetError, match="none did"):
        simulate(emulate(tmp_path / "unknown"), apart="")


def test_an_error_before_the_first_turn_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its process has ended when it is given the turn."""

    def has_no_room(*_: object) -> NoReturn:
        raise VnetError("no room for programs")

    monkeypatch.setattr(local, "HostedPrograms", has_no_room)
    emulation = emulate(tmp_path / "run")
    welcomes = [emulation.welcome("v01", b"")]
    process = ForkedPrograms(welcomes, {}, emulation.folder, [], lambda: None, 30.0)
    os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
    try:
        process.end(None)
        with pytest.raises(VnetError, match="no room for programs"):
            process.take()
    finally:
        process.close()


@pytest.mark.parametrize("name", ["os.fork", "emulator.drivers.local.Pipe"])
def test_a_process_that_cannot_be_started_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    calls, before = [], children()
    real = os.fork if name == "os.fork" else Pipe

    def fails_later() -> Any:
        calls.append(1)
        if len(calls) == 2:
            raise BlockingIOError(11, "Resource temporarily unavailable")
        return real()

    emulation = emulate(tmp_path / "run")
    with monkeypatch.context() as patch, pytest.raises(VnetError, match=r"^process 2 for programs: Resource temp"):
        patch.setattr(name, fails_later)
        simulate(emulation, processes=3)
    assert children() == before


def test_what_programs_have_written_to_files_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    simulate(emulate(tmp_path / "run", program=entry(writes_a_file)), processes=3)
    written = [(tmp_path / f"v{number:02}.txt").read_text() for number in (1, 2, 3, 4, 5, 6)]
    assert [str(AT_NS) in each for each in written] == [True] * 6


def test_other_processes_may_write_where_programs_print(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with capfd.disabled(), (tmp_path / "output").open("w+") as output:
        stream, sys.stdout = sys.stdout, output
        try:
            emulation = emulate(tmp_path / "run", program=entry(gives_its_output_away))
            simulate(emulation, processes=2)
        finally:
            sys.stdout = stream
        output.seek(0)
        assert output.read().count("of another process") == 6


def test_letters_that_the_terminal_has_not_end_no_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The program that prints them sees the error that it sees in one process; bytes are replaced."""
    failed = []
    for processes in (1, 2):
        kept = io.BytesIO()
        monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(kept, encoding="ascii", write_through=True))
        emulation = emulate(tmp_path / str(processes), program=entry(prints_letters))
        simulate(emulation, processes=processes)
        failed.append([(event.node, event.details) for event in emulation.folder.events if event.kind == "crashed"])
        assert kept.getvalue() == (b"?\n" if processes == 2 else b"\xff\n")
    assert failed[0] == failed[1] and len(failed[0]) == 6


@pytest.mark.parametrize("at_s", [0.0, 0.5])
def test_a_program_that_ends_while_its_vehicle_is_paused_ends_then(at_s: float) -> None:
    """All vehicles of its process are paused; in one process others run."""
    faults = [
        {"kind": "pause", "at_s": at_s, "duration_s": 1.5, "nodes": {"ids": ["v01"]}},
        {"kind": "restart", "at_s": 2 * at_s, "duration_s": 0.5, "nodes": {"ids": ["v01"]}},
    ]
    seen = []
    for processes in (1, 2, 4):
        emulation = emulation_of(scenario_of(faults, f"{__name__}:raises_on_its_way_out"))
        simulate(emulation, processes=processes)
        events = [(event.time_ns, event.kind, event.node) for event in emulation.folder.events]
        assert [time_ns for time_ns, *_ in events] == sorted(time_ns for time_ns, *_ in events)
        seen.append((events, emulation.engine.trace.sha256()))
    assert seen[0] == seen[1] == seen[2]


def test_costs_are_those_of_each_program_and_name_the_processes(tmp_path: Path) -> None:
    figures = []
    for processes in (1, 4):
        emulation = emulate(tmp_path / str(processes))
        _, verdict = conclude(emulation, simulate(emulation, processes=processes)[0], "simulate")
        cost = read_cost(verdict["cost"])
        assert cost.processes == processes
        assert (" in 4 processes " in cost.line()) == (processes == 4)
        figures.append({each.node: (each.wake_ups, each.payload) for each in cost.vehicles})
    assert figures[0] == figures[1]


def test_a_program_that_nobody_can_import_runs_in_several_processes() -> None:
    said = b"from a closure"

    async def main(node: Node) -> None:
        async for _ in node.gnss:
            await node.radio.broadcast(said)

    scenario = scenario_of([], "nowhere:main")
    with given_programs({"nowhere:main": main}):
        emulation = emulation_of(scenario)
        simulate(emulation, processes=2)
    assert emulation.engine.counts[Outcome.delivered] > 0


def test_vehicles_are_split_evenly() -> None:
    assert split_evenly(["a", "b", "c", "d", "e"], 2) == [["a", "b"], ["c", "d", "e"]]
    assert split_evenly(["a", "b"], 2) == [["a"], ["b"]]


def test_as_many_processes_as_cores_and_vehicles_allow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(8)), raising=False)
    assert [process_count("auto", vehicles) for vehicles in (1, 12, 50, 1000)] == [1, 1, 5, 8]
    assert [process_count(asked, 12) for asked in (1, "3", 40)] == [1, 3, 12]
    for wrong in ("many", "0", -1, "1.5", 2.7, True, None, math.inf):
        with pytest.raises(VnetError, match=f"processes = .*{wrong}.*: a whole number from 1, or auto, is"):
            process_count(wrong, 12)  # type: ignore[arg-type]
