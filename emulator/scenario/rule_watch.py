"""Bounds on a call into code of the user's own: a rule that loops, or waits, forever is interrupted.

A thread looks at the processor time of the calling thread now and then, and raises an exception in it once the
call has had its time. So a slow machine, or one that is stopped, interrupts nothing.

A call that waits (sleeps, reads from a socket, acquires a lock) sees no such exception. In the main thread, to
which Python gives signals, it is interrupted by a signal whose handler raises; the handler is set for the call
alone. From any other thread the function is called on a thread of its own, which is left behind if it waits for too
long. In a single long call into a library nothing is interrupted before it returns.
"""

from __future__ import annotations

import ctypes
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable
from contextvars import copy_context
from dataclasses import dataclass, field
from functools import partial
from queue import SimpleQueue
from types import FrameType, TracebackType
from typing import Any, NoReturn, TypeVar

from emulator.scenario.own_functions import NonsenseError, in_words, line_of, outside

LIMIT_S = 10.0
"""Processor time of one call: a thousand times what a rule for hundreds of receivers takes."""
WAIT_LIMIT_S = 30.0
"""Time that one call may wait: three times what it may compute."""
BUSY_SHARE = 0.01
"""Share of processor time above which a call computes, and does not wait."""
WAKE_UP = signal.SIGALRM
LOOK_EVERY_S = 0.1
IDLE_S = 5.0
"""Time without a call after which the thread ends."""
T = TypeVar("T")


class NoAnswerError(BaseException):
    """A call has had its time. No Exception, so that the function does not catch it by accident."""

    def __str__(self) -> str:
        return f"{LIMIT_S:g} s of processor time"


class WaitedError(NoAnswerError):
    """A call has waited for too long."""

    def __str__(self) -> str:
        return f"{WAIT_LIMIT_S:g} s of waiting"


@dataclass(eq=False)
class _Call:
    """A call that is on: its thread, the clock of that thread, and its time by that clock at the start, in ns.

    `looked_ns` is that time when the watch last looked, and `waited_s` how long it has seen the call wait.
    `takes_signals` says that the handler of `WAKE_UP` is that of this call, in place of `handler_before`.
    `leave`, if given, is called in place of a signal once the call has waited for too long.
    """

    leave: Callable[[_Call], None] | None = None

    thread: int = field(default_factory=threading.get_ident)
    clock: int | None = field(default_factory=lambda: _own_clock())
    start_ns: int = 0
    looked_ns: int = 0
    waited_s: float = 0.0
    is_interrupted: bool = False
    is_on: bool = True
    takes_signals: bool = False
    is_awaited: bool = False
    is_signalled: bool = False
    handler_before: Any = None

    def __post_init__(self) -> None:
        self.start_ns = self.looked_ns = self.cpu_ns()

    def take_signals(self) -> None:
        """Set the handler of `WAKE_UP` to that of this call, where Python allows it."""
        self.handler_before = signal.getsignal(WAKE_UP)
        # None: a handler that Python has not set, and cannot set again.
        if threading.current_thread() is threading.main_thread() and self.handler_before is not None:
            self.takes_signals = True
            signal.signal(WAKE_UP, self._wake_up)

    def cpu_ns(self) -> int:
        """Return the time of the clock; of the whole process where threads have no clocks."""
        return time.process_time_ns() if self.clock is None else time.clock_gettime_ns(self.clock)

    def interrupt(self) -> None:
        """Raise NoAnswerError in the thread at its next step."""
        ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(self.thread), ctypes.py_object(NoAnswerError))

    def take_back(self) -> None:
        """Catch an exception that has perhaps not been raised yet; in the thread itself.

        It is raised here. If it were withdrawn, Python 3.11 would look for it for ever, and hang as soon as a
        debugger traces a coroutine.
        """
        try:
            self.interrupt()
            while True:
                pass
        except NoAnswerError:
            pass

    def look(self) -> None:
        """Interrupt the call if it has had its time: again and again, if it goes on."""
        cpu_ns = self.cpu_ns()
        self.waited_s += LOOK_EVERY_S if cpu_ns - self.looked_ns < BUSY_SHARE * LOOK_EVERY_S * 1e9 else 0.0
        self.looked_ns = cpu_ns
        if cpu_ns - self.start_ns > LIMIT_S * 1e9:
            self.is_interrupted, self.start_ns = True, cpu_ns
            self.interrupt()
        if self.leave is not None and self.waited_s > WAIT_LIMIT_S:
            leave, self.leave = self.leave, None
            leave(self)
        elif self.takes_signals and self.waited_s > WAIT_LIMIT_S:
            self.waited_s, self.is_awaited, self.is_signalled = 0.0, True, True
            signal.pthread_kill(self.thread, WAKE_UP)

    def release_signals(self) -> None:
        """Set the handler of before; the watch does not look at the call any more."""
        if self.takes_signals:
            if self.is_signalled:
                time.sleep(0)  # a signal that has been sent is taken before a system call returns
            self.takes_signals = False
            signal.signal(WAKE_UP, self.handler_before)

    def _wake_up(self, number: int, frame: FrameType | None) -> None:
        """Raise in a call that has waited too long; give every other such signal to the handler of before."""
        is_own, self.is_awaited = self.is_awaited, False
        if not is_own:
            if callable(self.handler_before):
                self.handler_before(number, frame)
        elif self.is_on and not _in_debugger(frame):
            raise WaitedError


def _in_debugger(frame: FrameType | None) -> bool:
    """Return whether pdb waits for its user."""
    while frame is not None:
        if frame.f_globals.get("__name__") == "bdb":
            return True
        frame = frame.f_back
    return False


def _own_clock() -> int | None:
    return time.pthread_getcpuclockid(threading.get_ident()) if sys.platform == "linux" else None


class _Watch:
    """The calls that are on in this process, and the thread that looks at them."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._calls: set[_Call] = set()
        self._thread: threading.Thread | None = None
        self._last_s = 0.0

    def begin(self, call: _Call) -> None:
        if call.leave is None:
            call.take_signals()
        with self._lock:
            self._calls.add(call)
            self._last_s = time.monotonic()
            if self._thread is None or not self._thread.is_alive():  # a fork has no threads but its own
                self._thread = threading.Thread(target=self._look, name="rule watch", daemon=True)
                self._thread.start()

    def end(self, call: _Call) -> None:
        call.is_on = False
        with self._lock:
            self._calls.discard(call)
        if call.is_interrupted:
            call.take_back()
        call.release_signals()

    def _look(self) -> None:
        while True:
            time.sleep(LOOK_EVERY_S)
            with self._lock:
                for call in self._calls:
                    call.look()
                if not self._calls and time.monotonic() - self._last_s > IDLE_S:
                    self._thread = None
                    return


_WATCH = _Watch()


def call_bounded(function: Callable[..., T], *arguments: object) -> T:
    """Return what a function returns. Raises what it raises, or NoAnswerError after its time.

    It may compute for `LIMIT_S`, and wait for `WAIT_LIMIT_S`.
    """
    if threading.current_thread() is threading.main_thread():
        return _call_here(_Call(), function, *arguments)
    return _call_aside(function, *arguments)


def _call_aside(function: Callable[..., T], *arguments: object) -> T:
    """Call on a thread of its own, which goes on by itself if it waits for too long: nobody takes its answer."""
    answers: SimpleQueue[Callable[[], T]] = SimpleQueue()

    def leave(call: _Call) -> None:
        waits = WaitedError().with_traceback(_stack(sys._current_frames().get(call.thread)))
        answers.put(partial(_raise, waits))

    def run() -> None:
        try:
            answer = _call_here(_Call(leave), function, *arguments)
        except BaseException as error:
            answers.put(partial(_raise, error))
        else:
            answers.put(lambda: answer)

    threading.Thread(target=copy_context().run, args=(run,), name="rule", daemon=True).start()
    return answers.get()()


def _raise(error: BaseException) -> NoReturn:
    raise error


def _stack(frame: FrameType | None) -> TracebackType | None:
    """Return the traceback from this file to where a thread stands, as if it had raised there."""
    traced: TracebackType | None = None
    while frame is not None and frame.f_code.co_filename != __file__:
        traced = TracebackType(traced, frame, frame.f_lasti, frame.f_lineno)
        frame = frame.f_back
    return traced


def _call_here(call: _Call, function: Callable[..., T], *arguments: object) -> T:
    try:
        try:
            _WATCH.begin(call)
            return function(*arguments)
        finally:
            _WATCH.end(call)
    except NoAnswerError:
        _WATCH.end(call)  # it may have been raised while the call ended
        raise


def told(error: BaseException, *files: str) -> tuple[str, str]:
    """Return in one line how a function of the user's own failed, with its line, and the traceback from there on.

    `files` are those of vnet in the traceback, besides this one.
    """
    if isinstance(error, NonsenseError):
        return f"answers {error}", ""
    frames = outside(error, __file__, *files)
    said = f"does not answer within {error}" if isinstance(error, NoAnswerError) else f"raises {in_words(error)}"
    if frames is None:
        return said, ""
    return f"{said} ({line_of(frames)})", "".join(traceback.format_exception(error.with_traceback(frames)))
