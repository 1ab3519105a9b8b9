"""A simulation that ends before its time leaves nothing half done, and nothing to complain of."""

import gc
import signal
from collections import Counter
from pathlib import Path

import pytest

from emulator.drivers.conclude import conclude
from emulator.drivers.simulate import simulate
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
    assert [(event.kind, event.time_ns) for event in emulation.folder.events] == [
        ("started", 0),
        ("interrupted", AT_NS),
    ]
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
