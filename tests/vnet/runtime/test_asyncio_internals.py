"""asyncio behaves as `vnet.runtime.asyncio_internals` assumes: where a test fails, a new Python has changed it."""

import asyncio
import contextvars
import gc
import heapq
import inspect
import re
import selectors
import sys
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator
from types import ModuleType
from typing import Any, ClassVar

import pytest

from agents import host as agent_host
from vnet.runtime import asyncio_internals, host, virtual_time
from vnet.runtime.asyncio_internals import NumberedTimer

CHANGED = f"Python {sys.version.split()[0]} has changed asyncio: "


class RecordingSelector(selectors.DefaultSelector):
    """The real selector, which never waits and records for how long it was asked to."""

    def __init__(self) -> None:
        super().__init__()
        self.timeouts: list[float | None] = []
        self.before: Callable[[], None] = lambda: None

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        self.timeouts.append(timeout)
        self.before()
        return super().select(0)


class StandingLoop(asyncio.SelectorEventLoop):
    """A loop whose clock stands at `now_s`."""

    def __init__(self) -> None:
        self.selector = RecordingSelector()
        self.now_s = 100.0
        super().__init__(self.selector)

    def time(self) -> float:
        return self.now_s

    def round(self) -> None:
        """Run one round of the loop: what `stop` leaves of `run_forever`."""
        self.stop()
        self.run_forever()


@pytest.fixture
def loop() -> Iterator[StandingLoop]:
    loop = StandingLoop()
    yield loop
    loop.close()


def nothing() -> None:
    """A callback."""


def has(owner: object, *names: str) -> None:
    for name in names:
        assert hasattr(owner, name), f"{CHANGED}{type(owner).__name__}.{name} is gone"


def test_what_is_ready_stands_in_a_deque(loop: StandingLoop) -> None:
    has(loop, "_ready")
    handle = loop.call_soon(nothing)
    queue = asyncio_internals.ready_queue(loop)
    assert isinstance(queue, deque) and list(queue) == [handle], f"{CHANGED}_ready does not hold what is ready"


class Appended(deque[asyncio.Handle]):
    """A queue that knows what was put in with `append`, and refuses every other method."""

    def __init__(self) -> None:
        super().__init__()
        self.appended: list[asyncio.Handle] = []

    def append(self, handle: asyncio.Handle) -> None:
        self.appended.append(handle)
        super().append(handle)

    def _refuse(self, *arguments: Any) -> Any:
        raise AssertionError(f"{CHANGED}_ready is filled with something else than append")

    appendleft = extend = extendleft = insert = __iadd__ = _refuse


def test_the_queue_can_be_exchanged_and_is_filled_by_append_alone(loop: StandingLoop) -> None:
    has(loop, "_ready")
    queue, seen = Appended(), []
    asyncio_internals.replace_ready_queue(loop, queue)

    async def step() -> None:
        await asyncio.sleep(0)
        seen.append("task")

    task = loop.create_task(step())
    loop.call_soon(seen.append, "soon")
    loop.call_soon_threadsafe(seen.append, "from a thread")
    timer = loop.call_at(loop.now_s, seen.append, "timer")
    for _ in range(3):
        loop.round()
    assert task.done()
    assert set(seen) == {"task", "soon", "from a thread", "timer"}, f"{CHANGED}a callback took another way"
    assert timer in queue.appended, f"{CHANGED}a timer that is due does not go through _ready.append"


def test_timers_stand_in_a_heap_and_know_it(loop: StandingLoop) -> None:
    has(loop, "_scheduled")
    late, early = loop.call_at(102.0, nothing), loop.call_at(101.0, nothing)
    assert asyncio_internals.next_timer(loop) is early, f"{CHANGED}the head of _scheduled is not the next timer"
    scheduled: list[asyncio.TimerHandle] = vars(loop)["_scheduled"]
    assert heapq.heappop(scheduled) is early and heapq.heappop(scheduled) is late, f"{CHANGED}it is no heap"
    for timer in (late, early):
        has(timer, "_scheduled")
    assert asyncio_internals.next_timer(loop) is None


def test_a_timer_that_is_pushed_fires_and_can_be_cancelled(loop: StandingLoop) -> None:
    fired: list[str] = []
    timers = [NumberedTimer(n, 100.0, fired.append, (f"{n}",), loop, None) for n in (1, 0, 2)]
    for timer in timers:
        asyncio_internals.push_timer(loop, timer)
    has(loop, "_timer_cancelled_count")
    timers[2].cancel()
    assert vars(loop)["_timer_cancelled_count"] == 1, f"{CHANGED}it counts cancelled timers by another mark"
    loop.round()
    assert fired == ["0", "1"], f"{CHANGED}timers of one instant are not ordered by __lt__ alone"


def test_cancelled_timers_have_left_the_head_of_the_heap_before_the_loop_waits(loop: StandingLoop) -> None:
    heads: list[asyncio.TimerHandle | None] = []
    loop.selector.before = lambda: heads.append(asyncio_internals.next_timer(loop))
    cancelled, kept = loop.call_at(101.0, nothing), loop.call_at(102.0, nothing)
    cancelled.cancel()
    loop.round()
    assert heads == [kept], f"{CHANGED}a cancelled timer is at the head of _scheduled while the loop waits"


def test_how_long_the_selector_is_asked_to_wait(loop: StandingLoop) -> None:
    """`stop` alone makes a timeout of 0; so each case lets the selector stop the loop."""
    loop.selector.before = loop.stop

    def asked() -> float | None:
        loop.selector.timeouts.clear()
        loop.run_forever()
        return loop.selector.timeouts[0]

    assert asked() is None, f"{CHANGED}a loop with nothing to do does not wait for ever"
    timer = loop.call_at(101.5, nothing)
    assert asked() == pytest.approx(1.5), f"{CHANGED}a loop does not wait for its next timer"
    timer.cancel()
    loop.call_soon(nothing)
    assert asked() == 0, f"{CHANGED}a loop waits although a callback is ready"
    loop.call_at(99.0, nothing)
    waited_s = asked()
    assert waited_s is not None and waited_s <= 0, f"{CHANGED}a loop waits although a timer is due"


def test_timers_within_the_resolution_of_the_clock_are_due(loop: StandingLoop) -> None:
    has(loop, "_clock_resolution")
    asyncio_internals.set_clock_resolution(loop, 0.25)
    fired: list[str] = []
    loop.call_at(100.125, fired.append, "within")
    loop.call_at(100.5, fired.append, "later")
    loop.round()
    assert fired == ["within"], f"{CHANGED}_clock_resolution does not decide which timers are due"


def test_call_later_sleep_and_timeouts_set_their_timers_by_call_at(
    loop: StandingLoop, monkeypatch: pytest.MonkeyPatch
) -> None:
    set_at: list[float] = []
    call_at = loop.call_at

    def recorded(when: float, *rest: Any, **options: Any) -> asyncio.TimerHandle:
        set_at.append(when)
        return call_at(when, *rest, **options)

    async def times_out() -> None:
        async with asyncio.timeout(3.0):
            await asyncio.sleep(2.0)

    monkeypatch.setattr(loop, "call_at", recorded)
    loop.call_later(1.0, nothing)
    task = loop.create_task(times_out())
    loop.round()
    assert sorted(set_at) == [101.0, 102.0, 103.0], f"{CHANGED}not all timers are set by call_at and time()"
    task.cancel()
    loop.round()
    loop.round()


def test_a_closed_loop_says_so(loop: StandingLoop) -> None:
    has(loop, "_check_closed")
    asyncio_internals.check_not_closed(loop)
    loop.close()
    with pytest.raises(RuntimeError, match="closed"):
        asyncio_internals.check_not_closed(loop)


def test_a_callback_has_the_context_in_which_it_was_set(loop: StandingLoop) -> None:
    variable = contextvars.ContextVar("variable", default="outside")
    context = contextvars.copy_context()
    context.run(variable.set, "inside")

    async def program() -> None:
        await asyncio.sleep(0)

    handles = [loop.call_soon(nothing, context=context), loop.call_at(101.0, nothing, context=context)]
    task = loop.create_task(program(), context=context)
    handles.append(asyncio_internals.ready_queue(loop)[-1])
    for handle in handles:
        has(handle, "_context")
        assert asyncio_internals.context_of(handle)[variable] == "inside", f"{CHANGED}a handle has another context"
    loop.run_until_complete(task)


@pytest.mark.slow
def test_an_abandoned_task_is_destroyed_in_silence(loop: StandingLoop) -> None:
    complaints: list[str] = []
    loop.set_exception_handler(lambda _, about: complaints.append(about["message"]))

    async def waits() -> None:
        await loop.create_future()

    def destroy(abandoned: bool) -> None:
        task = loop.create_task(waits())
        has(task, "_log_destroy_pending")
        loop.round()
        if abandoned:
            asyncio_internals.abandon(task)
        del task
        gc.collect()

    destroy(abandoned=False)
    assert complaints == ["Task was destroyed but it is pending!"]
    destroy(abandoned=True)
    assert len(complaints) == 1, f"{CHANGED}_log_destroy_pending does not silence a task"


def test_an_abandoned_task_is_closed_although_it_awaits_something_in_answer(loop: StandingLoop) -> None:
    ended: list[str] = []

    async def holds_on() -> None:
        try:
            await loop.create_future()
        finally:
            try:
                await loop.create_future()
            finally:
                ended.append("ended")

    task = loop.create_task(holds_on())
    loop.round()
    asyncio_internals.abandon(task)
    asyncio_internals.close_abandoned(task)
    assert ended == ["ended"]


def test_an_abandoned_task_that_catches_all_in_a_loop_is_closed(loop: StandingLoop) -> None:
    caught: list[str] = []

    async def swallows() -> None:
        while True:
            try:
                loop.call_soon_threadsafe(len, "")
                async with asyncio.timeout(9), asyncio.TaskGroup() as group:
                    group.create_task(asyncio.sleep(9))
                    await asyncio.sleep(9)
            except BaseException as error:
                caught.append(type(error).__name__)
                assert len(caught) < 100

    loop.create_task(swallows())
    loop.round()
    tasks = asyncio_internals.abandon_pending([*asyncio.all_tasks(loop)])
    loop.close()
    for task in tasks:
        asyncio_internals.close_abandoned(task)
    assert 0 < len(caught) < 100


@pytest.mark.parametrize("begins", [False, True])
def test_a_task_that_awaits_the_next_of_an_iterator_is_abandoned_as_others(
    loop: StandingLoop, begins: bool
) -> None:
    async def ticks() -> AsyncIterator[int]:
        await loop.create_future()
        yield 1

    following = anext(ticks())
    task = asyncio.ensure_future(following, loop=loop)
    if begins:
        loop.round()
    asyncio_internals.abandon(task)
    asyncio_internals.close_abandoned(task)
    with pytest.raises(RuntimeError, match="cannot reuse"):
        following.__await__().send(None)


def test_a_task_group_that_is_discarded_raises_nothing(loop: StandingLoop) -> None:
    """Its body is ended by GeneratorExit, which it puts into a group of its own."""

    async def waits_in_a_group() -> None:
        async with asyncio.TaskGroup():
            await loop.create_future()

    task = loop.create_task(waits_in_a_group())
    loop.round()
    asyncio_internals.abandon(task)
    asyncio_internals.close_abandoned(task)


def test_a_task_factory_may_take_whatever_a_task_does(loop: StandingLoop) -> None:
    """From 3.13.3 on `create_task` hands the task's name to the factory, too."""
    taken: list[dict[str, Any]] = []

    def factory(
        loop: asyncio.AbstractEventLoop, coroutine: Any, context: contextvars.Context | None = None, **options: Any
    ) -> asyncio.Task[Any]:
        taken.append(options)
        return asyncio.Task(coroutine, loop=loop, context=context, **options)

    async def program() -> None:
        await asyncio.sleep(0)

    loop.set_task_factory(factory)
    context = contextvars.copy_context()
    task = loop.create_task(program(), name="v01 main", context=context)
    loop.run_until_complete(task)
    assert task.get_name() == "v01 main"
    assert len(taken) == 1 and set(taken[0]) <= {"name", "eager_start"}, f"{CHANGED}its factories get {taken}"


@pytest.mark.parametrize("module", [host, virtual_time, agent_host], ids=lambda module: module.__name__)
def test_no_other_module_names_what_is_private(module: ModuleType) -> None:
    named = set(re.findall(r"\._[a-z]\w+", inspect.getsource(asyncio_internals))) - {"._number"}
    assert {"._ready", "._scheduled", "._log_destroy_pending"} <= named
    assert named & set(re.findall(r"\._[a-z]\w+", inspect.getsource(module))) == set()


def test_the_callback_that_raised_is_found() -> None:
    loop = asyncio.new_event_loop()
    handle = loop.call_soon(sys.exit, 3)
    with pytest.raises(SystemExit) as raised:
        loop.run_forever()
    loop.close()
    assert asyncio_internals.handle_that_raised(raised.value) is handle
    assert asyncio_internals.handle_that_raised(SystemExit(3)) is None


def test_what_is_gathered_tells_its_loop_when_it_fails() -> None:
    class Loop(asyncio.SelectorEventLoop):
        told: ClassVar[list[object]] = []
        on_failed = told.append

    asyncio_internals.tell_of_failed_gatherings()
    loop = Loop()
    inner = loop.create_future()
    outer = asyncio.gather(inner)
    loop.call_soon(inner.set_exception, ValueError("boom"))
    with pytest.raises(ValueError, match="boom"):
        loop.run_until_complete(outer)
    loop.close()
    assert Loop.told == [outer]
