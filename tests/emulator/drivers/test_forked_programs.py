"""Simulations in several processes: how they end, and what their programs need not know.

Other tests of this folder compare their traces, events and metrics with those of one process (`run_forked`).
"""

import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from emulator.drivers.conclude import conclude
from emulator.drivers.process_count import process_count, split_evenly
from emulator.drivers.simulate import simulate
from emulator.radio.outcomes import Outcome
from emulator.records.costs import read_cost
from tests.emulator.drivers.test_status import emulate
from tests.support.multi_loop_driver import emulation_of, scenario_of
from vnet.errors import VnetError
from vnet.node import Node
from vnet.runtime.programs import given_programs

pytestmark = pytest.mark.usefixtures("default_signals")

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
    assert [(event.kind, event.time_ns) for event in emulation.folder.events] == [
        ("started", 0),
        ("interrupted", AT_NS),
    ]
    judgement, _ = conclude(emulation, wall_s, "simulate")
    assert judgement.exit_status == 3
    assert children() == before


def test_a_process_that_ends_ends_the_run_in_one_line(tmp_path: Path) -> None:
    before = children()
    with pytest.raises(VnetError, match="the process of v04 to v06 ended with SIGKILL in the middle of the run"):
        simulate(emulate(tmp_path / "run", program=entry(ends_its_process)), processes=2)
    assert children() == before


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
    for wrong in ("many", "0", -1, "1.5"):
        with pytest.raises(VnetError, match=f"processes = .*{wrong}.*: a whole number from 1, or auto, is"):
            process_count(wrong, 12)
