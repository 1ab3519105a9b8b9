"""A program that does at random what asyncio offers, and tells by frames and reports in which order all came.

Each vehicle draws its own steps from the seed, its name and its incarnation. A frame's length and a report's digest
depend on everything that the vehicle has said before, so that two orders give two traces.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from contextvars import Context, copy_context
from functools import partial
from random import Random
from typing import Any
from weakref import WeakKeyDictionary, WeakSet
from zlib import crc32

from vnet import Node

DELAYS_S = (0.0, 0.01, 0.02, 0.1)
"""Few, so that much happens at one instant."""
LONGEST_PAYLOAD = 200
FRAME_OF = 3
"""Things said for a frame: the others only change the next one."""
SHORTEST_STEP_S = 0.002
"""A pause behind each step: no vehicle does everything at one instant."""


class Vehicle:
    """A vehicle and what it has said."""

    def __init__(self, node: Node) -> None:
        self.node = node
        self.random = Random(f"{node.options['seed']} {node.id} {node.incarnation}")
        self.digest = 0
        self.kept: list[Any] = []

    def say(self, text: str) -> None:
        """Tell something, now and then by a frame, also where nothing can be awaited."""
        self.digest = crc32(text.encode(), self.digest)
        if self.digest % FRAME_OF == 0:
            with suppress(StopIteration):
                self.node.radio.broadcast(bytes(1 + self.digest % LONGEST_PAYLOAD)).send(None)

    def delay_s(self) -> float:
        """Draw a delay."""
        return self.random.choice(DELAYS_S)

    def names(self) -> list[str]:
        """Draw the names of some things."""
        return [f"{self.random.randrange(1000)}" for _ in range(self.random.randint(2, 6))]

    async def speak(self, name: str, delay_s: float) -> str:
        """Wait, and say whether it was cancelled."""
        try:
            await asyncio.sleep(delay_s)
        except asyncio.CancelledError:
            self.say(f"{name} cancelled")
            raise
        self.say(name)
        return name

    def tasks(self, **options: Any) -> list[asyncio.Task[str]]:
        """Start some tasks that speak."""
        return [asyncio.create_task(self.speak(one, self.delay_s()), name=one, **options) for one in self.names()]


class Discarded:
    """Part of a cycle, which speaks when the collector finds it."""

    def __init__(self, vehicle: Vehicle, name: str) -> None:
        self.itself, self.vehicle, self.name = self, vehicle, name

    def __del__(self) -> None:
        self.vehicle.say(f"discarded {self.name}")


async def waits_for_some(v: Vehicle) -> None:
    """Look at the sets that `asyncio.wait` returns."""
    pending = {*v.tasks()}
    while pending:
        done, pending = await asyncio.wait(
            pending,
            return_when=v.random.choice([asyncio.FIRST_COMPLETED, asyncio.ALL_COMPLETED]),
            timeout=v.delay_s(),
        )
        for task in done:
            v.say(f"done {task.get_name()}")
        if v.random.random() < 0.3:
            for task in pending:
                task.cancel()


async def takes_as_completed(v: Vehicle) -> None:
    """Take results of coroutines or tasks as they come."""
    awaitables: list[Any] = [v.speak(each, v.delay_s()) for each in v.names()]
    if v.random.random() < 0.5:
        awaitables = [asyncio.ensure_future(each) for each in awaitables]
    with suppress(TimeoutError):
        for each in asyncio.as_completed(awaitables, timeout=v.random.choice([None, 0.05])):
            v.say(f"came {await each}")


async def aborts_a_group(v: Vehicle) -> None:
    """Have one child of a group fail."""

    async def fails(after_s: float) -> None:
        await asyncio.sleep(after_s)
        raise ValueError("of a child")

    try:
        async with asyncio.TaskGroup() as group:
            for each in v.names():
                group.create_task(v.speak(each, v.delay_s()))
            group.create_task(fails(v.delay_s()))
    except* ValueError:
        v.say("aborted")


async def asks_for_all_tasks(v: Vehicle) -> None:
    """Look at all tasks, and cancel some of them."""
    own = WeakSet(v.tasks())
    await asyncio.sleep(v.delay_s())
    for task in asyncio.all_tasks():
        v.say(f"{task in own}")
    for task in asyncio.all_tasks():
        if task in own and v.random.random() < 0.5:
            task.cancel()
    await asyncio.gather(*own, return_exceptions=True)


async def keeps_sets(v: Vehicle) -> None:
    """Look at sets and keys of tasks and futures, of all ways to make them."""
    loop = asyncio.get_running_loop()
    tasks = v.tasks()
    futures: list[Any] = [*tasks, asyncio.gather(*tasks), asyncio.shield(tasks[0])]
    futures += [
        loop.create_future(),
        asyncio.Future(),
        asyncio.Task(v.speak("direct", 0.0)),
        asyncio.Future(loop=loop),
    ]
    names = {each: f"{number}" for number, each in enumerate(futures)}
    v.random.shuffle(futures)
    for kept in (set(futures), WeakSet(futures), WeakKeyDictionary(dict.fromkeys(futures))):
        v.say(" ".join(names[each] for each in kept))
    await asyncio.gather(*tasks)


async def runs_in_empty_contexts(v: Vehicle) -> None:
    """Start tasks, callbacks and timers in contexts that have nothing in them, or another's copy."""
    loop = asyncio.get_running_loop()
    context = v.random.choice([Context(), copy_context()])
    tasks = v.tasks(context=context)
    loop.call_soon(v.say, "soon", context=Context())
    loop.call_later(v.delay_s(), v.say, "later", context=context)
    tasks.append(Context().run(asyncio.create_task, v.speak("within", v.delay_s())))
    Context().run(loop.call_later, v.delay_s(), v.say, "later within")
    tasks[0].add_done_callback(lambda task: v.say("callback"), context=Context())
    Context().run(lambda: v.say(f"{asyncio.get_running_loop().time():.6f}"))
    await asyncio.wait(tasks)


async def goes_on_for_ever(v: Vehicle) -> None:
    """Leave a task in an empty context that no one ends."""

    async def ticks() -> None:
        while True:
            await asyncio.sleep(0.3)
            v.say("tick")

    asyncio.create_task(ticks(), context=Context())  # noqa: RUF006


async def shares(v: Vehicle) -> None:
    """Share a lock, a semaphore, a condition and a barrier."""
    lock, semaphore, condition = asyncio.Lock(), asyncio.Semaphore(2), asyncio.Condition()
    barrier = asyncio.Barrier(3)

    async def one(name: str) -> None:
        async with semaphore, lock:
            await v.speak(name, v.delay_s())
        async with condition:
            condition.notify_all()
        await barrier.wait()
        v.say(f"past {name}")

    async def waits() -> None:
        async with condition:
            await condition.wait()
        v.say("notified")

    await asyncio.gather(waits(), *(one(f"{number}") for number in range(3)))


async def passes_through_queues(v: Vehicle) -> None:
    """Put into a bounded queue from several tasks, and take from it in several."""
    queue: asyncio.Queue[str] = v.random.choice([asyncio.Queue(2), asyncio.LifoQueue(2), asyncio.PriorityQueue(2)])

    async def takes() -> None:
        while True:
            v.say(f"took {await queue.get()}")
            queue.task_done()
            await asyncio.sleep(v.delay_s())

    takings = [asyncio.create_task(takes()) for _ in range(2)]
    await asyncio.gather(*(queue.put(each) for each in v.names()))
    await queue.join()
    for taking in {*takings}:
        taking.cancel()


async def times_out(v: Vehicle) -> None:
    """Let timeouts and cancellations meet."""
    with suppress(TimeoutError):
        await asyncio.wait_for(v.speak("slow", v.delay_s()), 0.01)
    with suppress(TimeoutError):
        async with asyncio.timeout(0.015):
            await asyncio.shield(v.speak("shielded", v.delay_s()))
    first, second = v.tasks()[:2]
    asyncio.get_running_loop().call_later(0.01, first.cancel)
    for task in {first, second}:
        with suppress(asyncio.CancelledError):
            await task


async def works_in_threads(v: Vehicle) -> None:
    """Give jobs to threads, some of which call what only the loop's may."""
    loop = asyncio.get_running_loop()
    refused: list[Callable[[], object]] = [
        lambda: v.node.radio.broadcast(b"from a thread").send(None),
        lambda: v.node.now_ns,
        v.node.radio.drain,
        partial(loop.call_soon_threadsafe, v.say, "soon"),
        lambda: asyncio.run_coroutine_threadsafe(asyncio.sleep(0), loop).result(9),
    ]
    with ThreadPoolExecutor(2) as pool:
        jobs: list[Awaitable[object]] = [loop.run_in_executor(pool, abs, -number) for number in range(3)]
        jobs += [asyncio.to_thread(v.random.choice(refused)), asyncio.to_thread(sum, range(1000))]
        for result in await asyncio.gather(*jobs, return_exceptions=True):
            v.say(f"{result}" if isinstance(result, int) else type(result).__name__)
        try:
            await asyncio.wrap_future(pool.submit(abs, -1))
        except RuntimeError as error:
            v.say(type(error).__name__)


async def leaves_garbage(v: Vehicle) -> None:
    """Leave to the collector what speaks when it is discarded: objects in cycles and async generators."""
    for each in v.names():
        Discarded(v, each)
    v.kept.append(Discarded(v, "kept"))
    if len(v.kept) > 3:
        del v.kept[:]

    async def numbers() -> AsyncIterator[int]:
        try:
            for number in range(9):
                yield number
        finally:
            await asyncio.sleep(v.delay_s())
            v.say("generator closed")

    kept: list[Any] = [numbers()]
    async for number in kept[0]:
        if number == 2:
            break
    if v.random.random() < 0.5:
        kept.append(kept)
    await asyncio.sleep(v.delay_s())


async def has_a_task_factory(v: Vehicle) -> None:
    """Have tasks made by a factory of its own for a while."""
    loop = asyncio.get_running_loop()
    made: list[str] = []

    def factory(loop: asyncio.AbstractEventLoop, coroutine: Any, **options: Any) -> Any:
        made.append("made")
        return asyncio.Task(coroutine, loop=loop, **options)

    eager = getattr(asyncio, "eager_task_factory", factory)
    loop.set_task_factory(v.random.choice([factory, eager]))
    tasks = v.tasks()
    loop.set_task_factory(None)
    await asyncio.wait(tasks)
    v.say(f"{len(made)} {loop.get_task_factory()}")


async def asks_for_what_is_not_its_own(v: Vehicle) -> None:
    """Try to shut down what belongs to the loop."""
    loop = asyncio.get_running_loop()
    for call in (loop.shutdown_default_executor, loop.shutdown_asyncgens, loop.stop):
        try:
            ended = call()
            if ended is not None:
                await ended
        except RuntimeError as error:
            v.say(f"{error}")


async def hears(v: Vehicle) -> None:
    """Look for packets, at once or for a while."""
    for packet in v.node.radio.drain():
        v.say(f"{packet.sender} {len(packet.payload)}")
    with suppress(TimeoutError):
        packet = await asyncio.wait_for(v.node.radio.receive(), 0.02)
        v.say(f"{packet.sender} {packet.received_ns}")


STEPS = [
    waits_for_some, takes_as_completed, aborts_a_group, asks_for_all_tasks, keeps_sets, runs_in_empty_contexts,
    goes_on_for_ever, shares, passes_through_queues, times_out, works_in_threads, leaves_garbage,
    has_a_task_factory, asks_for_what_is_not_its_own, hears,
]  # fmt: skip


async def main(node: Node) -> None:
    """Do steps at random in several tasks, and report a digest of all with each fix."""
    vehicle = Vehicle(node)

    async def does_steps() -> None:
        while True:
            await vehicle.random.choice(STEPS)(vehicle)
            await asyncio.sleep(SHORTEST_STEP_S + vehicle.delay_s())

    running = {asyncio.create_task(does_steps()) for _ in range(vehicle.random.randint(1, 3))}
    async for fix in node.gnss:
        node.report(fix.position_m, fix.covariance_m2, digest=vehicle.digest)
        for task in running:
            if task.done():
                task.result()
