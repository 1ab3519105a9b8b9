"""A process at quiet instants: when it asks the emulator, and what it knows by then."""

import asyncio
import os
import threading
from collections.abc import Callable, Iterator
from types import SimpleNamespace

import pytest

from agents.host import RunAhead, Swap
from tests.support.multi_loop_driver import emulation_of, scenario_of
from vnet import Node
from vnet.runtime.host import Host
from vnet.runtime.programs import Program
from vnet.runtime.virtual_time import VirtualTimeLoop
from vnet.transport import wire

MS = 1_000_000
Run = Callable[[Program, Swap], wire.Traffic]


class Over(Exception):
    """The run is over."""


@pytest.fixture
def run() -> Iterator[Run]:
    """Run a program from a window that ends at 2 ms, with quiet instants up to 100 ms; returns its last traffic."""
    loop = VirtualTimeLoop(lambda timer_ns: parts.ahead.exchange(timer_ns))
    parts = SimpleNamespace()

    def run(program: Program, swap: Swap) -> wire.Traffic:
        emulation = emulation_of(scenario_of([], "agents.beacon:main", vehicles=1))
        welcome = emulation.welcome(emulation.world.node_ids[0], b"n")
        parts.host = Host([welcome], lambda: loop.now_ns, lambda: parts.ahead.tell())
        parts.ahead = RunAhead(parts.host, lambda: loop.now_ns, lambda timer_ns: parts.swap(timer_ns))
        parts.swap = lambda timer_ns: parts.ahead.open_window(granted(swap(timer_ns)))
        loop.before_job = parts.ahead.catch_up
        loop.start_at(parts.ahead.open_window(granted(0)))
        parts.host.start(loop, {welcome.node: program})
        with pytest.raises(Over):
            loop.run_forever()
        parts.ahead.close()
        parts.host.close(loop)
        last: wire.Traffic = parts.host.take_final()
        return last

    yield run
    loop.close()


def granted(time_ns: int) -> wire.Grant:
    return wire.Grant(0, time_ns, time_ns + 2 * MS, quiet_ns=100 * MS)


def test_the_end_of_the_run_does_not_pass_through_the_program(run: Run) -> None:
    asked: list[int | None] = []
    seen: list[str] = []

    async def program(node: Node) -> None:
        await asyncio.sleep(0.01)
        try:
            seen.append(f"{len(node.radio.drain())} packets at {node.now_ns}")
        except Exception as error:
            seen.append(repr(error))
        node.log("told at an instant that was never granted")
        await asyncio.sleep(1)

    def swap(next_timer_ns: int | None) -> int:
        asked.append(next_timer_ns)
        raise Over

    assert not run(program, swap)
    assert (asked, seen) == ([10 * MS], [f"0 packets at {10 * MS}"])


async def works(node: Node) -> None:
    await asyncio.to_thread(int)


async def sends(node: Node) -> None:
    await node.radio.broadcast(b"x")


async def reports(node: Node) -> None:
    node.report((0, 0))


async def logs(node: Node) -> None:
    node.log("here")


async def notes(node: Node) -> None:
    node.event("here")


async def listens(node: Node) -> None:
    node.radio.drain()


async def forks(node: Node) -> None:
    """The child tells something, and would ask."""
    child = os.fork()
    if not child:
        node.log("from a process that has no emulator")
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0


async def starts_a_thread(node: Node) -> None:
    thread = threading.Thread(target=node.radio.drain)
    thread.start()
    thread.join()


async def computes(node: Node) -> None:
    await asyncio.sleep(0)


@pytest.mark.slow
@pytest.mark.parametrize("does", [listens, works, reports, logs, notes])
def test_what_the_emulator_must_know_first_is_asked_for_at_once(run: Run, does: Program) -> None:
    assert asked_by(run, does) == [20 * MS]


@pytest.mark.slow
@pytest.mark.parametrize("does", [computes, forks, starts_a_thread, sends])
def test_what_needs_no_answer_is_not_asked_for(run: Run, does: Program) -> None:
    assert asked_by(run, does) == []


def asked_by(run: Run, does: Program) -> list[int | None]:
    """Return the instants for which a program has asked by the time that it has done this, at 20 ms."""
    asked: list[int | None] = []
    by_then: list[int | None] = []

    async def program(node: Node) -> None:
        await asyncio.sleep(0.01)
        await asyncio.sleep(0.01)
        await does(node)
        by_then.extend(asked)
        await asyncio.sleep(1)

    def swap(next_timer_ns: int | None) -> int:
        asked.append(next_timer_ns)
        if next_timer_ns is None or next_timer_ns > 20 * MS:
            raise Over
        return next_timer_ns

    run(program, swap)
    return by_then
