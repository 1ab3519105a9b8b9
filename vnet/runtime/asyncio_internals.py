"""The parts of asyncio outside its documented interface on which virtual time depends, each behind one function.

No other module of vnet touches them. `tests/vnet/runtime/test_asyncio_internals.py` has a test for each, which
names what is missing or different when a new version of Python changes it. What is assumed:

- The loop keeps callbacks that are ready in the queue `_ready`: it puts them in with `append` alone, and takes
  them out with `popleft`, in rounds. The queue may be exchanged between two rounds.
- The loop keeps timers in the heap `_scheduled`, ordered by `TimerHandle.__lt__`; the flag `_scheduled` of a timer
  says that it is there. Cancelled timers have left the head of the heap before the loop waits.
- A round waits in `select(timeout)` of the selector given to the loop: `timeout` is 0 or less if a callback is
  ready or a timer is due, and None if there is no timer.
- Timers that are earlier than `time()` plus `_clock_resolution` are due; `call_later` sets its timer by `call_at`.
- A future whose exception nobody has retrieved has `_log_traceback` set, which may be cleared; discarded with it,
  it calls the exception handler. Reading `_exception` does not clear it. What `gather` returns knows its
  `_children`.
- Callbacks run in `Handle._run`, a function in Python, which lets SystemExit and KeyboardInterrupt through.
- `gather` makes an `asyncio.tasks._GatheringFuture`, and lets it fail with `set_exception`.
- `call_soon`, `call_soon_threadsafe` and tasks make their handles in `_call_soon`. What writes to the self-pipe
  wakes the selector. An async generator is told of to `_asyncgen_firstiter_hook` when it begins, and to
  `_asyncgen_finalizer_hook` when it is discarded before its end, which calls `call_soon_threadsafe`.
- `_check_closed`, `Handle._context` (public since Python 3.12), `Task._log_destroy_pending`, `_enter_task` and
  `_leave_task` of `tasks`, `_get_running_loop` and `_set_running_loop` of `events`.
"""

from __future__ import annotations

import asyncio
import heapq
import inspect
import traceback
from collections import deque
from collections.abc import Callable, Coroutine, Iterator, Sequence
from contextvars import Context
from types import FrameType
from typing import Any, cast
from weakref import WeakKeyDictionary

MOST_CLOSINGS = 10
"""Times that a coroutine is told to close that awaits something in answer."""


def ready_queue(loop: asyncio.AbstractEventLoop) -> deque[asyncio.Handle]:
    """Return the loop's own queue of callbacks that are ready to run."""
    return cast("deque[asyncio.Handle]", _private(loop)._ready)


def replace_ready_queue(loop: asyncio.AbstractEventLoop, queue: deque[asyncio.Handle]) -> None:
    """Let the loop use `queue`, which holds what was ready, from its next round on."""
    _private(loop)._ready = queue


def push_timer(loop: asyncio.AbstractEventLoop, timer: asyncio.TimerHandle) -> None:
    """Add a timer to the loop's heap."""
    heapq.heappush(_private(loop)._scheduled, timer)
    _private(timer)._scheduled = True


def timers(loop: asyncio.AbstractEventLoop) -> list[asyncio.TimerHandle]:
    """Return the loop's heap of timers, cancelled ones among them."""
    return cast("list[asyncio.TimerHandle]", _private(loop)._scheduled)


def next_timer(loop: asyncio.AbstractEventLoop) -> asyncio.TimerHandle | None:
    """Return the head of the loop's heap of timers; while the loop waits, this timer is not cancelled."""
    heap = timers(loop)
    return heap[0] if heap else None


def set_clock_resolution(loop: asyncio.AbstractEventLoop, seconds: float) -> None:
    """Set by how much a timer may fire before its time."""
    _private(loop)._clock_resolution = seconds


def check_not_closed(loop: asyncio.AbstractEventLoop) -> None:
    """Raise RuntimeError if the loop is closed, as its own methods do."""
    _private(loop)._check_closed()


def push_ready(loop: asyncio.AbstractEventLoop, handle: asyncio.Handle) -> None:
    """Add a callback to the queue of those that are ready, as `_call_soon` does."""
    if _private(handle)._source_traceback:
        del _private(handle)._source_traceback[-1]
    _private(loop)._ready.append(handle)


def wake(loop: asyncio.AbstractEventLoop) -> None:
    """Have the loop look for what is there, from any thread."""
    _private(loop)._write_to_self()


def generators(loop: asyncio.AbstractEventLoop) -> list[Any]:
    """Return the async generators that have begun and are there yet."""
    return list(_private(loop)._asyncgens)


def context_of(handle: asyncio.Handle) -> Context:
    """Return the context in which a callback will run."""
    return cast("Context", _private(handle)._context)


def handle_that_raised(error: BaseException) -> asyncio.Handle | None:
    """Return the callback out of which an exception has left the loop, if it was one."""
    for frame, _ in traceback.walk_tb(error.__traceback__):
        if frame.f_code is asyncio.Handle._run.__code__:
            return cast("asyncio.Handle", frame.f_locals["self"])
    return None


def abandon(task: asyncio.Task[Any]) -> None:
    """Let a pending task, which goes no further, be destroyed without a message in the log."""
    _private(task)._log_destroy_pending = False
    coroutine = task.get_coro()
    if inspect.iscoroutine(coroutine) and inspect.getcoroutinestate(coroutine) == inspect.CORO_CREATED:
        coroutine.close()


def abandon_pending(tasks: Sequence[asyncio.Task[Any]]) -> list[asyncio.Task[Any]]:
    """Abandon those of the tasks that are pending, and return them."""
    pending = [task for task in tasks if not task.done()]
    for task in pending:
        abandon(task)
    return pending


def close_abandoned(task: asyncio.Task[Any], module: Any = asyncio) -> None:
    """Close an abandoned task's coroutine, or what else it awaits as one, whatever it does in answer.

    Python would do so when it discards the coroutine, at any time, and print what it raises: a task group
    cannot cancel its tasks any more. What it asks of its loop never comes; were it refused, one that catches all
    exceptions in a loop of its own would go on for ever. `module` is the asyncio to which the task belongs.
    """
    loop, coroutine = task.get_loop(), cast("Coroutine[Any, Any, Any]", task.get_coro())
    if loop.is_closed():
        _grant_nothing(loop, module.events)
    before = module.events._get_running_loop()
    module.events._set_running_loop(loop)
    is_idle = module.tasks.current_task(loop) is None
    if is_idle:
        module.tasks._enter_task(loop, task)
    try:
        for _ in range(MOST_CLOSINGS):
            try:
                coroutine.close()
                return
            except KeyboardInterrupt:
                raise
            except BaseException:  # a task group raises a group of GeneratorExit
                pass
        import ctypes  # seldom needed

        ctypes.pythonapi.Py_IncRef(ctypes.py_object(coroutine))  # for ever: to discard it is to close it again
    finally:
        if is_idle:
            module.tasks._leave_task(loop, task)
        module.events._set_running_loop(before)


def _grant_nothing(loop: Any, events: Any) -> None:
    """Have a closed loop take callbacks, timers, tasks and jobs, of which none will run."""

    def soon(callback: Any, *args: Any, context: Any = None) -> Any:
        return events.Handle(callback, args, loop, context)

    def later(when: float, callback: Any, *args: Any, context: Any = None) -> Any:
        return events.TimerHandle(when, callback, args, loop, context)

    def task(coroutine: Any, **options: Any) -> Any:
        coroutine.close()
        return loop.create_future()

    loop.call_soon, loop.call_later, loop.call_at, loop.create_task = soon, later, later, task
    loop.call_soon_threadsafe, loop.run_in_executor = soon, lambda *job: loop.create_future()


def is_unretrieved(future: asyncio.Future[Any]) -> bool:
    """Return whether a future or task has failed and nobody has retrieved its exception; asking does not."""
    return bool(_private(future)._log_traceback)


def error_of(future: asyncio.Future[Any]) -> BaseException | None:
    """Return the exception of a future or task without retrieving it."""
    return cast("BaseException | None", _private(future)._exception)


def disclaim(future: asyncio.Future[Any]) -> BaseException:
    """Return the exception that nobody has retrieved; asyncio does not complain of it any more."""
    error = error_of(future)
    assert error is not None
    _private(future)._log_traceback = False
    return error


def gathered(future: asyncio.Future[Any]) -> Sequence[asyncio.Future[Any]]:
    """Return the futures that `asyncio.gather` has joined in this one; none if it is another kind of future."""
    return cast("Sequence[asyncio.Future[Any]]", getattr(future, "_children", ()))


_set_exception = asyncio.Future.set_exception  # asyncio's own; while programs run, the name is another's


def tell_of_failed_gatherings() -> None:
    """Have what `asyncio.gather` returns call `on_failed` of its loop, if it has one, when it fails."""

    def set_exception(future: asyncio.Future[Any], exception: type | BaseException) -> None:
        _set_exception(future, exception)
        on_failed = getattr(future.get_loop(), "on_failed", None)
        if on_failed is not None:
            on_failed(future)

    _private(asyncio.tasks)._GatheringFuture.set_exception = set_exception


def hash_gatherings_by(hash_of: Callable[[asyncio.Future[Any]], int]) -> None:
    """Have what `asyncio.gather` returns hash by `hash_of`."""
    _private(asyncio.tasks)._GatheringFuture.__hash__ = hash_of


class NodeHandle(asyncio.Handle):
    """A callback that is ready, with its node."""

    __slots__ = ("node",)
    node: object


class NumberedTimer(asyncio.TimerHandle):
    """A timer with a place among those of one instant: they fire in that order.

    asyncio leaves that order to the shape of its heap, and so to how many other nodes share the loop. Where other
    orders are tried, `setter` has the name of what has set the timer, and its callback. `node` is whose it is.
    """

    __slots__ = ("_due", "node", "setter")
    node: object
    setter: tuple[str, object]

    def __init__(self, place: Any, *rest: Any) -> None:
        super().__init__(*rest)
        self._due = self.when(), place

    def __lt__(self, other: asyncio.TimerHandle) -> bool:
        return self._due < other._due  # type: ignore[attr-defined,no-any-return]  # all of a loop's are numbered


def _private(owner: object) -> Any:
    """The same object without its published type, which lacks the attributes of this module."""
    return owner


_greenlets: WeakKeyDictionary[asyncio.Task[Any], Any] = WeakKeyDictionary()
"""The greenlet that a task drives, of tasks that are threads of a program."""


def note_greenlet(greenlet: object) -> None:
    """Note that the present task drives `greenlet`: where the greenlet is suspended, the task is."""
    if (task := asyncio.current_task()) is not None:
        _greenlets[task] = greenlet


def suspended_in(task: asyncio.Task[Any]) -> Iterator[FrameType]:
    """Yield the frames in which a suspended task waits, from its outermost coroutine inwards."""
    coroutine: Any = task.get_coro()
    while (frame := getattr(coroutine, "cr_frame", None)) is not None:
        yield frame
        coroutine = coroutine.cr_await
    frame = getattr(_greenlets.get(task), "gr_frame", None)
    yield from reversed([each for each, _ in traceback.walk_stack(frame)] if frame else [])


def stacks_of(tasks: Sequence[asyncio.Task[Any]]) -> str:
    """Return the stacks of suspended tasks, as text."""
    lines = []
    for task in tasks:
        lines.append(f"task {task.get_name()}:")
        for frame in suspended_in(task):
            lines.append(f"  {frame.f_code.co_filename}:{frame.f_lineno} in {frame.f_code.co_qualname}")
    return "\n".join(lines)


async def all_done(tasks: Sequence[asyncio.Task[Any]]) -> None:
    """Wait until tasks are done, and retrieve no exception: whether a program does is what matters."""
    if tasks:
        await asyncio.wait(tasks)
