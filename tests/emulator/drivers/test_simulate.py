"""A simulation that ends before its time leaves nothing half done, and nothing to complain of."""

import asyncio
import gc
import signal
from collections import Counter
from pathlib import Path

import pytest

from emulator.cells.cells import judged_figures
from emulator.drivers.conclude import conclude
from emulator.drivers.simulate import simulate
from emulator.records.costs import read_cost
from tests.emulator.drivers.test_status import emulate
from vnet.errors import ProgramError
from vnet.node import Node

pytestmark = pytest.mark.usefixtures("default_signals")

AT_NS = 500_000_000


async def is_interrupted(node: Node) -> None:
    """Ctrl-C comes while a program computes."""
    async for fix in node.gnss:
        if node.id == "v02" and fix.time_ns == AT_NS:
            signal.raise_signal(signal.SIGINT)
        await node.radio.broadcast(b"x")


async def computes_for_ever(node: Node) -> None:
    """Ctrl-C comes, and the program does not yield; then it comes again."""
    async for fix in node.gnss:
        while node.id == "v02" and fix.time_ns == AT_NS:
            signal.raise_signal(signal.SIGINT)


@pytest.mark.parametrize("program", ["is_interrupted", "computes_for_ever"])
def test_an_interruption_is_recorded_and_the_run_judged(
    tmp_path: Path, program: str, caplog: pytest.LogCaptureFixture
) -> None:
    before = signal.getsignal(signal.SIGINT)
    emulation = emulate(tmp_path / "run", program={"entry": f"tests.emulator.drivers.test_simulate:{program}"})
    wall_s, interrupted = simulate(emulation)
    assert interrupted
    assert signal.getsignal(signal.SIGINT) is before
    assert [(e.kind, e.time_ns) for e in emulation.folder.events] == [("started", 0), ("interrupted", AT_NS)]
    judgement, _ = conclude(emulation, wall_s, "simulate")
    assert judgement.exit_status == 3
    gc.collect()
    if program == "is_interrupted":
        sent = emulation.engine.trace.to_table()["sent_ns"].to_pylist()
        assert Counter(sent) == {n * 100_000_000: 6 * 5 for n in range(5)}, "of no instant there is but a part"
        assert caplog.text == "", "asyncio has nothing to complain of"


def test_whoever_sees_to_interruptions_goes_on_doing_so(tmp_path: Path) -> None:
    seen: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: seen.append(number))
    try:
        program = {"entry": "tests.emulator.drivers.test_simulate:is_interrupted"}
        _, interrupted = simulate(emulate(tmp_path / "run", program=program))
    finally:
        signal.signal(signal.SIGINT, before)
    assert (seen, interrupted) == ([signal.SIGINT], False)


@pytest.mark.filterwarnings("error")
def test_a_program_that_is_not_there_is_all_that_is_said(tmp_path: Path) -> None:
    with pytest.raises(ProgramError, match="cannot import"):
        simulate(emulate(tmp_path / "run", program={"entry": "nowhere:main"}))
    gc.collect()


async def two_wake_ups_a_second(node: Node) -> None:
    """Sleeps and sends 7 bytes, v02 40; everybody twice, and v03 ends after the first time."""
    for _ in range(1 if node.id == "v03" else 2):
        await asyncio.sleep(0.25)
        await node.radio.broadcast(b"x" * (40 if node.id == "v02" else 7))


def test_costs_are_those_of_each_vehicles_program(tmp_path: Path) -> None:
    program = {"entry": "tests.emulator.drivers.test_simulate:two_wake_ups_a_second"}
    emulation = emulate(tmp_path / "run", program=program)
    _, verdict = conclude(emulation, simulate(emulation)[0], "simulate")
    cost = read_cost(verdict["cost"])
    costs = {vehicle.node: vehicle for vehicle in cost.vehicles}
    assert cost.measured == "program"
    total_s = sum(vehicle.cpu_s or 0 for vehicle in cost.vehicles)
    assert cost.cpu_s == pytest.approx(total_s, abs=1e-5), "but for rounding"
    assert {node: of.wake_ups for node, of in costs.items()} == {
        node: 2 if node == "v03" else 3 for node in emulation.world.node_ids
    }, "at time 0, and after each sleep"
    assert (costs["v01"].payload.frames, costs["v03"].payload.frames) == (2, 1)
    assert (costs["v02"].payload.mean_bytes, costs["v01"].payload.max_bytes) == (40.0, 7)
    assert "cpu_s" not in judged_figures(verdict), "a study's table is the same on every machine"
