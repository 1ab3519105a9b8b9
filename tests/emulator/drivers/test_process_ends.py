"""A program that ends its process is its vehicle's death, also where the process is the emulator's own."""

import asyncio
import os
import posix
import threading
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

from emulator.checks.run import check_agents_alive, check_no_exceptions
from emulator.drivers.conclude import gather
from emulator.drivers.emulation import Emulation
from emulator.records.events import EventKind
from emulator.records.verdicts import Verdict
from tests.support.multi_loop_driver import run_forked, run_together, scenario_of
from vnet.node import Node

pytestmark = pytest.mark.slow

Run = Callable[[Any], Emulation]
Program = Callable[[Node], Awaitable[None]]


async def sends(node: Node) -> None:
    async for _ in node.gnss:
        await node.radio.broadcast(b"x")


def exits_in_a_thread() -> None:
    thread = threading.Thread(target=os._exit, args=[0])
    thread.start()
    thread.join()


WAYS: dict[str, Callable[[], object]] = {
    "os": lambda: os._exit(0),
    "the module below": lambda: posix._exit(0),
    "another program": lambda: os.execlp("true", "true"),
    "a callback": lambda: asyncio.get_running_loop().call_soon(os._exit, 0),
    "a thread": exits_in_a_thread,
    "a job": lambda: asyncio.to_thread(os._exit, 0),
}


async def exits(node: Node) -> None:
    await asyncio.sleep(0.5)
    if node.id == "v02":
        done = WAYS[node.options.get("way", "os")]()
        if asyncio.iscoroutine(done):
            await done
    await sends(node)


async def exits_and_catches_everything(node: Node) -> None:
    await asyncio.sleep(0.5)
    try:
        if node.id == "v02":
            os._exit(0)
    except BaseException:
        await asyncio.sleep(0)
        node.report(survived=1)
    await sends(node)


async def exits_in_a_finally(node: Node) -> None:
    try:
        await sends(node)
    finally:
        if node.id == "v02":
            os._exit(0)


async def forks(node: Node) -> None:
    await asyncio.sleep(0.5)
    pid = os.fork()
    if pid == 0:
        os._exit(7)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 7
    await sends(node)


def run_of(program: Program, run: Run, **options: str) -> Emulation:
    return run(scenario_of([], f"{__name__}:{program.__name__}", vehicles=3, program={"options": options}))


@pytest.mark.parametrize("run", [run_together, run_forked])
@pytest.mark.parametrize("way", [*WAYS, "caught"])
def test_a_vehicle_that_ends_its_process_has_died_alone(way: str, run: Run) -> None:
    emulation = run_of(exits_and_catches_everything, run) if way == "caught" else run_of(exits, run, way=way)
    (died,) = [event for event in emulation.folder.events if event.kind == "died"]
    assert (died.node, died.time_ns) == ("v02", 500_000_000)
    assert died.details["how"].startswith("os.")
    recorded = gather(emulation, 1.0)
    assert recorded.trace.num_rows > 0
    assert not [event for event in emulation.folder.events if event.kind in ("crashed", "exception")]
    emulation.folder.event(0, EventKind.started, start_up_s=0.0)
    assert check_agents_alive(recorded).verdict is Verdict.INVALID  # type: ignore[union-attr]


def test_the_line_of_the_program_that_ended_its_process_is_named() -> None:
    (died,) = [event for event in run_of(exits, run_together).folder.events if event.kind == "died"]
    line = WAYS["os"].__code__.co_firstlineno
    assert died.details["place"] == f"{Path(__file__).name}:{line}"


@pytest.mark.parametrize("run", [run_together, run_forked])
def test_a_process_that_ends_in_a_finally_at_the_end_makes_the_run_invalid(run: Run) -> None:
    emulation = run_of(exits_in_a_finally, run)
    found = check_no_exceptions(gather(emulation, 1.0))
    assert found.verdict is Verdict.INVALID  # type: ignore[union-attr]
    assert "v02" in found.text  # type: ignore[union-attr]


def test_a_process_that_a_program_has_forked_ends_as_it_likes() -> None:
    events = run_of(forks, run_together).folder.events
    assert not [event for event in events if event.kind in ("died", "crashed", "exception")]


def test_outside_of_programs_nothing_is_caught() -> None:
    run_of(exits, run_together)
    pid = os.fork()
    if pid == 0:
        os._exit(5)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 5
