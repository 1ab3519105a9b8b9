"""Threads of a blocking program as tasks of its node: a call that blocks becomes an await on the node's loop.

Each thread is a *strand*, a greenlet that a task drives. Where the thread blocks, its greenlet switches to the task
with what it waits for; the task yields that to the event loop, as any coroutine does, and switches back with the
result. One strand runs at a time, until it blocks.
"""

from __future__ import annotations

import _thread
import asyncio
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Awaitable, Callable, Generator
from contextvars import Context, copy_context
from dataclasses import dataclass
from functools import partial
from itertools import count
from pathlib import Path
from types import ModuleType, coroutine
from typing import Any, TypeVar

from greenlet import GreenletExit, getcurrent, greenlet

from vnet.gateway.emulated.shown import facade
from vnet.runtime.asyncio_internals import note_greenlet
from vnet.runtime.outside_loop import collector, taken
from vnet.runtime.own_asyncio import Task, present_node

T = TypeVar("T")

MOST_EXITS = 10
"""Times that a strand is told to end which blocks in answer, or goes on."""
MOST_LOOKS, BUSY_WAIT_S = 1000, 0.001
"""Looks of a thread, at one instant, at what only time or others change, and how long it is let wait then. What it
puts and asks counts like them."""
LOOKS_A_TURN = 10
"""Looks for which a sleep of nothing counts, which takes longer."""
LONGEST_WAIT_S = 1e9
"""Largest timeout of a lock in seconds, as `threading.TIMEOUT_MAX`."""

for _variable in ("RUST_BACKTRACE", "RUST_LIB_BACKTRACE"):
    # An error of Zenoh's would walk the stack, of which greenlets have moved a part, and crash the process.
    os.environ[_variable] = "0"

_unending: list[greenlet] = []
"""Strands that did not end when they were told to: held, as to discard one is to tell it again."""
_is_child = False
"""True in a process that a program has forked, where time is real."""


def _note_child() -> None:
    global _is_child
    _is_child = current_strand() is not None


os.register_at_fork(after_in_child=_note_child)


class HardExit(SystemExit):
    """The end of a program of which nothing runs any more, its `finally` blocks neither."""


@dataclass
class Folder:
    """The working directory of a program, which is that of the process while its code runs."""

    home: Path
    """That of the process."""
    path: Path | None = None
    """That of the program, None if it is the same."""

    def change(self, path: Any) -> None:
        """Do as `os.chdir`."""
        os.chdir(path)
        self.path = Path.cwd()


def context_of_thread() -> Context:
    """Return the context in which Python starts a thread: an empty one, but for vnet's own variables."""
    started = Context()
    for variable, value in copy_context().items():
        if variable.name.startswith("vnet_"):
            started.run(variable.set, value)
    return started


class Strand(greenlet):
    """A thread."""

    def __init__(self, run: Callable[[], Any], number: int, folder: Folder, context: Context | None = None) -> None:
        super().__init__(run)
        self.number = number
        self.folder = folder
        self.at_end: list[Callable[[], object]] = []
        self.interrupt: BaseException | None = None
        """Exception that it is to raise where it waits."""
        self.is_ended = False
        """True once its coroutine is closed: what it waits for does not come."""
        self.is_gone = False
        """True once it shall not run any more."""
        self.looked_s, self.looks = -1.0, 0
        self.generator_hooks: tuple[Any, ...] | None = None
        """The hooks of `sys.set_asyncgen_hooks` that an event loop has set which it runs."""
        self.collects = False
        """True while it waits within a collection of garbage that it has called for: others do not collect."""
        self.gr_context = copy_context() if context is None else context

    def begin(self) -> Any:
        """Run until the strand blocks, and return what it waits for; or to its end, and return its result."""
        self.parent = getcurrent()
        return self.go(self.switch)

    def go(self, step: Callable[..., Any], *values: Any) -> Any:
        """Go on by `switch` or `throw`, in the folder of the program, and with its hooks."""
        folder, before = self.folder, sys.get_asyncgen_hooks()
        is_collecting, collector.runs = collector.runs, self.collects
        if folder.path is not None:
            os.chdir(folder.path)
        if self.generator_hooks is not None:
            sys.set_asyncgen_hooks(*self.generator_hooks)
        try:
            return step(*values)
        finally:
            if folder.path is not None:
                os.chdir(folder.home)
            if self.generator_hooks is not None:
                sys.set_asyncgen_hooks(*before)
            self.collects, collector.runs = collector.runs, is_collecting


async def go_on(strand: Strand, item: Any) -> Any:
    """Run a strand that waits for `item` to its end, and return its result."""
    return await _steps(strand, item)


@coroutine
def _steps(strand: Strand, item: Any) -> Generator[Any, Any, Any]:
    note_greenlet(strand)
    while not strand.dead and item is not IDLE:
        if isinstance(item, HardExit):
            _unending.append(strand)
            raise item
        try:
            value = yield item
        except GeneratorExit:
            _end(strand)
            raise
        except BaseException as error:
            item = _thrown(strand, error)
        else:
            item = strand.go(strand.switch, value)
    if isinstance(item, GreenletExit):
        raise asyncio.CancelledError
    return item


def _thrown(strand: Strand, error: BaseException) -> Any:
    """Have a strand raise what its task was ended with, or what it is interrupted by; returns what it waits for."""
    if strand.is_gone:
        _unending.append(strand)
        raise error
    if strand.interrupt is not None:
        error, strand.interrupt = strand.interrupt, None
        task = asyncio.current_task()
        assert task is not None
        task.uncancel()
        if isinstance(error, HardExit):
            return error
    return strand.go(strand.throw, error)


IDLE = object()
"""Stands for what a strand waits for that has nothing to do until `begin` is called again."""


def idle() -> None:
    """Have the present strand do nothing until `begin` is called again."""
    parent = getcurrent().parent
    assert parent is not None
    parent.switch(IDLE)


async def run_strand(strand: Strand) -> Any:
    """Run a strand from its beginning, and return its result."""
    return await go_on(strand, strand.begin())


def _end(strand: Strand) -> None:
    """End a strand whose task is closed, whatever it does in answer."""
    if strand.is_gone:
        _unending.append(strand)
        return
    strand.is_ended = True
    for _ in range(MOST_EXITS):
        if strand.dead:
            return
        try:
            strand.go(strand.throw, GreenletExit())
        except KeyboardInterrupt:
            raise
        except BaseException:  # of what the program does in answer, which nobody hears any more
            pass
    _unending.append(strand)


def current_strand() -> Strand | None:
    """Return the strand that runs, None outside of all."""
    strand = getcurrent()
    return strand if isinstance(strand, Strand) else None


def set_generator_hooks(*hooks: Any, **named: Any) -> None:
    """Do as `sys.set_asyncgen_hooks` for the present strand."""
    sys.set_asyncgen_hooks(*hooks, **named)
    if (strand := current_strand()) is not None:
        strand.generator_hooks = sys.get_asyncgen_hooks()


def is_child() -> bool:
    """Return whether this is a process that a program has forked."""
    return _is_child


def go_no_further_if_ended() -> None:
    """Raise GreenletExit whenever the present strand goes on, if it is ended, so that no loop of it is endless.

    Raises RuntimeError in a process that a program has forked.
    """
    if _is_child:
        raise RuntimeError("a forked process is outside of the emulation: no session, no channel and no lock there")
    strand = current_strand()
    while strand is not None and strand.is_ended:
        assert strand.parent is not None
        strand.parent.switch(None)


def leave_hard(leave: HardExit | None) -> None:
    """Have the present strand run no more; `leave` ends its task, too."""
    strand = current_strand()
    assert strand is not None and strand.parent is not None
    strand.is_gone = True
    while True:
        strand.parent.switch(leave or next(asyncio.get_running_loop().create_future().__await__()))


def look(looks: int = 1) -> None:
    """Take note that the present strand looks at what others change; one that does nothing else is let wait."""
    strand = current_strand()
    if strand is None or _is_child:
        return
    now_s = asyncio.get_running_loop().time()
    strand.looks = strand.looks + looks if now_s == strand.looked_s else looks
    strand.looked_s = now_s
    if strand.looks > MOST_LOOKS:
        sleep(BUSY_WAIT_S)


def block_on(awaitable: Awaitable[T]) -> T:
    """Block the present strand until `awaitable` is done. Raises RuntimeError outside of strands."""
    strand = getcurrent()
    if not isinstance(strand, Strand):
        raise RuntimeError(
            "a call that blocks, in a callback of the event loop or in a finalizer: on virtual time it can wait in "
            "a thread or in a coroutine alone"
        )
    go_no_further_if_ended()
    assert strand.parent is not None
    switch, steps = strand.parent.switch, awaitable.__await__()
    try:
        item = next(steps)
        while True:
            try:
                value = switch(item)
            except BaseException as error:
                item = steps.throw(error)
            else:
                item = steps.send(value)
    except StopIteration as stop:
        return stop.value  # type: ignore[no-any-return]
    except asyncio.CancelledError:
        raise GreenletExit from None  # the vehicle's program is ended: `finally` and `with` run, `except` does not


def sleep(seconds: float) -> None:
    """Block the present strand for so long."""
    if seconds != seconds:
        raise ValueError("Invalid value NaN (not a number)")
    if seconds < 0:
        raise ValueError("sleep length must be non-negative")
    if _is_child:
        time.sleep(seconds)
        return
    if seconds == 0:
        look(LOOKS_A_TURN)
    block_on(asyncio.sleep(seconds))


def give_way() -> None:
    """Let what is due run before the present strand goes on, unless it is ended."""
    strand = current_strand()
    if strand is not None and not strand.is_ended:
        block_on(asyncio.sleep(0))


class Waiting:
    """Strands that wait for others, in the order in which they came."""

    def __init__(self) -> None:
        self._waiters: deque[asyncio.Future[bool]] = deque()

    def wait(self, timeout: float = -1) -> bool:
        """Block the present strand until it is woken, or for `timeout` seconds; return whether it was woken."""
        go_no_further_if_ended()
        loop = asyncio.get_running_loop()
        waiter: asyncio.Future[bool] = loop.create_future()
        self._waiters.append(waiter)
        timer = None if timeout == -1 else loop.call_later(timeout, _settle, waiter, False)
        try:
            return block_on(waiter)
        except BaseException:
            if waiter.done() and not waiter.cancelled() and waiter.result():
                self.give_back()
            raise
        finally:
            if timer is not None:
                timer.cancel()
            if waiter in self._waiters:
                self._waiters.remove(waiter)

    def wake(self) -> bool:
        """Wake who has waited longest; return whether anybody waits."""
        while self._waiters:
            waiter = self._waiters.popleft()
            if not waiter.done():
                waiter.set_result(True)
                return True
        return False

    def wake_all(self) -> None:
        """Wake all."""
        while self.wake():
            pass

    def give_back(self) -> None:
        """Wake another in the place of a strand that was woken and is ended before it goes on."""
        self.wake()


class Lock(Waiting):
    """`threading.Lock`; who has waited longest gets it."""

    def __init__(self) -> None:
        super().__init__()
        self._locked = False

    def acquire(self, blocking: bool = True, timeout: float = -1) -> bool:
        """Take the lock; block until it is there, or for `timeout` seconds. Return whether it was taken."""
        if timeout != -1 and (not blocking or timeout < 0):
            text = "timeout value must be a non-negative number"
            raise ValueError(text if blocking else "can't specify a timeout for a non-blocking call")
        if not self._locked:
            self._locked = True
            return True
        if blocking and timeout != 0:
            return self.wait(timeout)
        look()
        return False

    def release(self) -> None:
        """Give the lock to who waits for it, if anybody does. Raises RuntimeError unless it is taken."""
        if not self._locked:
            raise RuntimeError("release unlocked lock")
        self._locked = self.wake()

    give_back = release

    def release_if_locked(self) -> None:
        """Release it unless it is not taken."""
        if self._locked:
            self.release()

    def locked(self) -> bool:
        """Return whether it is taken."""
        if self._locked:
            look()
        return self._locked

    def _is_owned(self) -> bool:  # which conditions ask, and no look
        return self._locked

    def __enter__(self) -> bool:
        return self.acquire()

    def __exit__(self, *_: object) -> None:
        self.release()

    def _at_fork_reinit(self) -> None:
        self.__init__()  # type: ignore[misc]


def _settle(waiter: asyncio.Future[bool], result: bool) -> None:
    if not waiter.done():
        waiter.set_result(result)


class ThreadHandle:
    """`_thread._ThreadHandle` of Python 3.13 and later."""

    def __init__(self, ident: int | None = None) -> None:
        self.ident = ident
        self._done = Lock()
        self._done.acquire()

    def is_done(self) -> bool:
        """Return whether the thread has ended."""
        return not self._done.locked()

    def join(self, timeout: float | None = None) -> None:
        """Block until the thread has ended."""
        if self._done.acquire(timeout=-1 if timeout is None or timeout < 0 else timeout):
            self._done.release()

    def _set_done(self) -> None:
        self._done.release_if_locked()


class Threads:
    """The threads of one program, and the module `_thread` on which the standard library's `threading` stands."""

    def __init__(self) -> None:
        self._numbers = count(1)
        self._alive = 0
        self.folder = Folder(Path.cwd())
        self._handles: list[ThreadHandle] = []
        self._running: dict[asyncio.Task[Any], Strand] = {}
        self.have_stopped = False
        self.callbacks: set[object] = set()
        """Callbacks of Zenoh that may be called again, each in a thread that is no daemon."""
        self.callbacks_end = Waiting()
        self.main: Strand | None = None
        """The strand of the main thread."""
        self._main_task: asyncio.Task[Any] | None = None
        self.on_interrupt: Callable[[], object] = lambda: None
        """Does what `_thread.interrupt_main` does."""
        self.tell_failed: Callable[[], object] = lambda: None
        """Tells what has failed in asyncio, that the program holds and has not asked for."""
        self.close_tasks: Callable[[], object] = lambda: None
        """Closes what the program's loops of asyncio have left; Python would run its `finally` at any time."""

    async def run_main(self, run: Callable[[], Any]) -> None:
        """Run the main thread."""
        self.main, self._main_task = Strand(run, self.new_number(), self.folder), asyncio.current_task()
        await run_strand(self.main)

    def interrupt(self, error: BaseException) -> None:
        """Have the main thread raise an exception where it waits."""
        if self.main is not None and not self.main.dead and self._main_task is not None:
            self.main.interrupt = error
            self._main_task.cancel()

    @property
    def are_over(self) -> bool:
        """True once the main thread has ended, or is told to."""
        return self.main is None or self.main.dead or self.main.is_ended or self.main.is_gone

    def new_number(self) -> int:
        """Return the number of a further thread."""
        return next(self._numbers)

    def start(self, function: Callable[..., Any], args: Any = (), kwargs: Any = None) -> int:
        """Start a thread, and return its number."""
        return self._begin(partial(function, *args, **(kwargs or {}))).number

    def start_as_main(self, function: Callable[[], Any]) -> None:
        """Start a strand that is the main thread to who asks: its number, its context. The main strand waits."""
        assert self.main is not None
        self._begin(function, self.main)

    def _begin(self, function: Callable[[], Any], like: Strand | None = None) -> Strand:
        context = context_of_thread() if like is None else like.gr_context
        number = self.new_number() if like is None else like.number
        strand = Strand(partial(self._run, function), number, self.folder, context)
        self._alive += 1
        running: Any = run_strand(strand)
        inner = getattr(function, "func", function)
        named = getattr(getattr(inner, "__self__", None), "name", None)
        running.__qualname__ = str(named or getattr(inner, "__qualname__", "a thread"))  # as orders name its timers
        task = Task(running, loop=asyncio.get_running_loop(), name=f"thread {strand.number}")
        self._running[task] = strand
        task.add_done_callback(self._running.pop)
        return strand

    def stop_where_they_are(self) -> None:
        """Have no thread run any more, its `finally` blocks neither, as daemons at the end of a process."""
        self.have_stopped = True
        for task, strand in self._running.items():
            strand.is_gone = True
            task.cancel()

    def _run(self, function: Callable[[], Any]) -> None:
        strand = current_strand()
        assert strand is not None
        try:
            function()
        except (SystemExit, GreenletExit):
            pass
        except BaseException as error:
            fail(error)
        finally:
            self._alive -= 1
            for end in strand.at_end:
                end()

    def _set_sentinel(self) -> Lock:
        lock, strand = Lock(), current_strand()
        if strand is not None:
            strand.at_end.append(lock.release_if_locked)
        return lock

    def _start_joinable(
        self, function: Callable[[], Any], handle: ThreadHandle | None = None, daemon: bool = True
    ) -> ThreadHandle:
        handle, strand = handle or ThreadHandle(), self._begin(function)
        strand.at_end.append(handle._set_done)
        handle.ident = strand.number
        if not daemon:
            self._handles.append(handle)
        return handle

    def await_callbacks(self) -> None:
        """Block until there is no callback of Zenoh any more, as the end of a program of Python's does."""
        while self.callbacks:
            self.callbacks_end.wait(LONGEST_WAIT_S)  # a timer: who only waits to be called is in no deadlock

    def _shutdown(self) -> None:
        while self._handles:
            self._handles.pop().join()

    def module(self) -> ModuleType:
        """Return the module `_thread`, with what `threading` needs of it in Python 3.11 to 3.13."""
        return facade(
            _thread,
            RLock=None,  # `threading` has one in Python
            **dict.fromkeys(["allocate_lock", "allocate", "lock", "LockType"], Lock),
            TIMEOUT_MAX=LONGEST_WAIT_S,
            **dict.fromkeys(["start_new_thread", "start_new"], self.start),
            **dict.fromkeys(["get_ident", "get_native_id"], number_of_thread),
            stack_size=lambda size=0: 0,
            _excepthook=_thread_failed,
            interrupt_main=lambda signum=2: self.on_interrupt(),
            _count=lambda: self._alive,
            _set_sentinel=self._set_sentinel,
            _get_main_thread_ident=lambda: 1,
            **dict.fromkeys(["_ThreadHandle", "_make_thread_handle"], ThreadHandle),
            start_joinable_thread=self._start_joinable,
            _shutdown=self._shutdown,
        )


def number_of_thread() -> int:
    """Return the number of the present strand, 0 in a callback of the event loop."""
    strand = current_strand()
    return 0 if strand is None else strand.number


def _thread_failed(failed: threading.ExceptHookArgs) -> None:
    """Stand for `threading.excepthook`; a strand that is ended leaves no message."""
    if failed.exc_value is not None and not isinstance(failed.exc_value, GreenletExit):
        fail(failed.exc_value)


def fail(error: BaseException, place: str = "in a thread") -> None:
    """Have the run tell of an exception that has ended a thread or a callback; the vehicle's log has its lines."""
    taken(present_node(), error, place)
