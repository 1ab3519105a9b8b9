"""The order of events that a node sees: asyncio's own primitives hold in all, and its promises are kept."""

import asyncio
import os
from collections.abc import Awaitable, Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import cast

import pytest

from tests.vnet.runtime.test_host import LANES
from vnet import Node
from vnet.runtime.host import Host
from vnet.runtime.ready_queue import Option, OrderedQueue, Pct, Shuffle, Taped
from vnet.runtime.virtual_time import VirtualTimeLoop
from vnet.transport import wire
from vnet.transport.wire import Deviation, Order

END_NS = 10_000_000_000


class Over(Exception):
    """The end of the run."""


def run(program: Callable[[Node], Awaitable[None]], order: Order) -> list[Deviation]:
    """Run a program on one node whose mail is a packet from each of two others, and a fix, each 0.1 s."""
    step_ns = 100_000_000
    deviations: list[Deviation] = []

    def exchange(next_timer_ns: int | None) -> int:
        window_end_ns = (loop.now_ns // step_ns + 1) * step_ns
        if (next_ns := host.next_instant(next_timer_ns)) is not None:
            return next_ns
        for step in host.make_yield(b"n", 0, next_timer_ns).steps:
            deviations.extend(step.traffic.deviations)
            for ending in step.traffic.endings:
                assert ending.kind == "finished", ending
            assert not step.traffic.unhandled, step.traffic.unhandled
        return grant(window_end_ns)

    def grant(time_ns: int) -> int:
        if time_ns >= END_NS or not any(host._active.values()):
            raise Over
        packets = [wire.WirePacket("v01", sender, 0, time_ns, b"") for sender in ("v02", "v03")]
        fix = wire.WireFix("v01", time_ns, (0.0, 0.0), (1.0, 0.0, 0.0, 1.0), None)
        return host.open_window(wire.Grant(0, time_ns, time_ns + step_ns, packets, [fix]))

    loop = VirtualTimeLoop(exchange, 10_000)
    lanes = LANES.to_wire()
    welcome = wire.Welcome(
        "v01", b"n", 0, "lockstep", "x:y", {}, lanes, 1, step_ns, 1400, 5.0, 1000, "", order=order
    )
    host = Host([welcome], lambda: loop.now_ns)
    try:
        host.order_events(loop)
        loop.start_at(grant(0))
        host.start(loop, {"v01": program})
        loop.run_forever()
    except Over:
        host.close(loop)
        assert not host.take_final().unhandled
    finally:
        loop.close()
    return deviations


# asyncio's promises.


async def queue_keeps_its_order(node: Node) -> None:
    """Two put, two get, all at the same instants: nothing is lost, and the items of each come in order."""
    queue: asyncio.Queue[tuple[str, int]] = asyncio.Queue(maxsize=2)
    got: list[tuple[str, int]] = []

    async def put(name: str) -> None:
        for number in range(6):
            await asyncio.sleep(0.1)
            await queue.put((name, number))

    async def get() -> None:
        while len(got) < 12:
            try:
                async with asyncio.timeout(0.1):
                    got.append(await queue.get())
            except TimeoutError:
                continue

    async with asyncio.TaskGroup() as group:
        for name in "ab":
            group.create_task(put(name))
        getters = [group.create_task(get()) for _ in range(2)]
        await asyncio.wait(getters, return_when=asyncio.FIRST_COMPLETED)
        for getter in getters:
            getter.cancel()
    assert sorted(got) == [(name, number) for name in "ab" for number in range(6)]


async def lock_is_held_by_one(node: Node) -> None:
    lock, held, turns = asyncio.Lock(), 0, 0

    async def work() -> None:
        nonlocal held, turns
        for _ in range(3):
            await asyncio.sleep(0.1)
            try:
                async with asyncio.timeout(0.3), lock:
                    held += 1
                    assert held == 1
                    try:
                        await asyncio.sleep(0.1)
                    finally:
                        held -= 1
                    turns += 1
            except TimeoutError:
                pass

    await asyncio.gather(*(work() for _ in range(4)))
    assert not lock.locked() and turns > 0


async def condition_wakes_who_waits(node: Node) -> None:
    condition, stock, taken = asyncio.Condition(), 0, 0

    def in_stock() -> bool:
        return stock > 0

    async def consume() -> None:
        nonlocal stock, taken
        for _ in range(3):
            async with condition:
                await condition.wait_for(in_stock)
                stock -= 1
                taken += 1
            await asyncio.sleep(0.1)

    async def produce() -> None:
        nonlocal stock
        for _ in range(6):
            await asyncio.sleep(0.1)
            async with condition:
                stock += 1
                condition.notify()

    await asyncio.wait_for(asyncio.gather(consume(), consume(), produce()), 5.0)
    assert (stock, taken) == (0, 6)


async def semaphore_counts(node: Node) -> None:
    semaphore, inside = asyncio.BoundedSemaphore(2), 0

    async def work(seconds: float) -> None:
        nonlocal inside
        for _ in range(3):
            async with semaphore:
                inside += 1
                assert inside <= 2
                await asyncio.sleep(seconds)
                inside -= 1

    await asyncio.gather(*(work(seconds) for seconds in (0.1, 0.1, 0.2, 0.2)))
    assert not semaphore.locked()


async def task_group_ends_all(node: Node) -> None:
    ended = []

    async def sleep(name: str, seconds: float) -> None:
        try:
            await asyncio.sleep(seconds)
        finally:
            ended.append(name)

    async def fail() -> None:
        await asyncio.sleep(0.2)
        raise ValueError("on purpose")

    try:
        async with asyncio.TaskGroup() as group:
            for name in "abc":
                group.create_task(sleep(name, 0.1))
            group.create_task(sleep("d", 0.2))
            group.create_task(sleep("e", 0.5))
            group.create_task(fail())
    except* ValueError:
        pass
    assert sorted(ended) == list("abcde")


async def timeout_is_either(node: Node) -> None:
    """A result and its timeout at the same instant: one or the other, and a cancelled task has ended."""
    for _ in range(5):
        task = asyncio.create_task(asyncio.sleep(0.1, "done"))
        try:
            assert await asyncio.wait_for(task, 0.1) == "done"
        except TimeoutError:
            assert task.done()
        try:
            async with asyncio.timeout(0.1):
                packet = await node.radio.receive()
                assert packet.received_ns <= node.now_ns
        except TimeoutError:
            pass


async def deadline_comes_before_what_is_set_after_it(node: Node) -> None:
    """A task that sets a deadline, and then sleeps for as long, never sleeps to the end."""
    woken = []

    async def sleeps_too_long() -> None:
        for _ in range(5):
            try:
                async with asyncio.timeout(0.1):
                    await asyncio.sleep(0)
                    await asyncio.sleep(0.1)
            except TimeoutError:
                woken.append(node.now_ns)
            else:
                raise AssertionError("slept longer than the deadline")

    async with asyncio.TaskGroup() as tasks:
        tasks.create_task(sleeps_too_long())
        for _ in range(5):
            await asyncio.sleep(0.1)
    assert len(woken) == 5


async def mail_comes_once_and_in_order(node: Node) -> None:
    """However fixes, packets, timers and jobs are ordered, each comes once, and none before its time."""
    loop, seen = asyncio.get_running_loop(), []
    with ThreadPoolExecutor(1) as threads:
        for number in range(8):
            if number % 3 == 0:
                assert await loop.run_in_executor(threads, abs, -number) == number
            packet = await node.radio.receive()
            assert packet.received_ns <= node.now_ns
            seen.append((packet.sender, packet.received_ns))
            seen += [(each.sender, each.received_ns) for each in node.radio.drain()]
            await asyncio.sleep(0.1)
    for sender in ("v02", "v03"):
        times = [time_ns for name, time_ns in seen if name == sender]
        assert times == sorted(set(times))


PRIMITIVES = [
    queue_keeps_its_order,
    lock_is_held_by_one,
    condition_wakes_who_waits,
    semaphore_counts,
    task_group_ends_all,
    timeout_is_either,
    deadline_comes_before_what_is_set_after_it,
    mail_comes_once_and_in_order,
]


@pytest.mark.slow
@pytest.mark.parametrize("program", PRIMITIVES)
def test_asyncio_s_primitives_hold_in_every_order(program: Callable[[Node], Awaitable[None]]) -> None:
    """Without an alarm. In CI there are 626 shuffles and 626 times PCT of each of eight programs: 10 016 orders."""
    different = set()
    for seed in range(626 if os.environ.get("CI") else 25):
        for order in (Order("shuffle", seed), Order("pct", seed, 1 + seed % 5, 50)):
            different.add(tuple((each.time_ns, each.decision, each.label) for each in run(program, order)))
    assert len(different) > 40, "orders were explored"


@pytest.mark.slow
def test_what_one_callback_registers_keeps_its_order() -> None:
    """Also if it is due at a later instant, and whatever else is due then."""

    async def program(node: Node) -> None:
        loop = asyncio.get_running_loop()
        called: list[int] = []
        for number in range(4):
            loop.call_soon(called.append, number)
            loop.call_later(0.1, called.append, 10 + number)
            loop.call_at(loop.time() + 0.1, called.append, 20 + number)
        await asyncio.sleep(0.2)
        registered = [number for step in range(4) for number in (10 + step, 20 + step)]
        assert called == [0, 1, 2, 3, *registered]

    for seed in range(50):
        run(program, Order("shuffle", seed))


@pytest.mark.slow
def test_timers_of_different_callbacks_and_mail_come_in_any_order() -> None:
    seen = set()

    async def program(node: Node) -> None:
        order: list[str] = []

        async def wait(name: str) -> None:
            await asyncio.sleep(0.1)
            order.append(name)

        async def listen() -> None:
            async for fix in node.gnss:
                if fix.time_ns > 0:
                    order.append("fix")
                    return

        await asyncio.gather(wait("a"), wait("b"), listen())
        seen.add("".join(name[0] for name in order))

    for seed in range(60):
        run(program, Order("shuffle", seed))
    assert seen == {"abf", "afb", "baf", "bfa", "fab", "fba"}


# What makes decisions.

OPTIONS = [Option("fix", "gnss"), Option("timer of a", "a"), Option("go on", "radio")]


class OwnedHandle(asyncio.Handle):
    """The handle of a callback of a node."""

    node: Node


class AnyNode:
    """Stands for a node."""

    id = "v01"


def test_what_arrives_while_nobody_runs_is_registered_by_nobody_whoever_ran_last() -> None:
    """In a process of several vehicles another one ran last."""
    loop, node, seen = asyncio.new_event_loop(), cast(Node, AnyNode()), list[Option]()

    class Fifo:
        def choose(self, time_ns: int, decision: int, options: Sequence[Option]) -> int:
            seen.extend(options)
            return 0

    def handle() -> OwnedHandle:
        made = OwnedHandle(print, (), loop)
        made.node = node
        return made

    queue = OrderedQueue([], lambda node: Fifo(), lambda: 0, lambda node, deviation: None)
    queue.add_event(node, "timer of beat", "beat", lambda: queue.append(handle()), lambda: True)
    while queue.compose():
        queue.popleft()
    seen.clear()
    queue.append(handle())
    queue.add_event(node, "packet", "radio", lambda: None, lambda: True)
    queue.compose()
    assert [option.source for option in seen] == ["radio", "start"]
    loop.close()


def test_pct_follows_priorities_until_one_falls() -> None:
    """Without a change of priority always the same source; with some, at most so many others."""
    assert len({Pct(5, 1, 100).choose(0, 0, OPTIONS) for _ in range(10)}) == 1
    steady = Pct(5, 1, 100)
    assert len({steady.choose(0, number, OPTIONS) for number in range(100)}) == 1
    changing = Pct(5, 3, 100)
    chosen = [changing.choose(0, number, OPTIONS) for number in range(100)]
    changes = sum(1 for one, other in pairwise(chosen) if one != other)
    assert changes == 2
    assert {Pct(seed, 1, 1).choose(0, 0, OPTIONS) for seed in range(30)} == {0, 1, 2}


def test_shuffle_takes_all_options_about_as_often() -> None:
    shuffle = Shuffle(1)
    counts = [0, 0, 0]
    for number in range(3000):
        counts[shuffle.choose(0, number, OPTIONS)] += 1
    assert min(counts) > 900


def test_a_tape_is_followed_where_it_fits() -> None:
    tape = Taped([Deviation("v01", 0, 5, 1, "timer of a", "fix"), Deviation("v01", 0, 6, 0, "timer of z", "fix")])
    assert tape.choose(5, 0, OPTIONS) == 0
    assert tape.choose(5, 1, OPTIONS) == 1
    assert tape.choose(6, 0, OPTIONS) == 0, "there is no such timer"
