"""Bounds on a call into code of the user's own: a rule that loops, or waits, forever is stopped.

A thread looks at the processor time of the calling thread now and then. So a slow machine, or one that is stopped,
stops nothing.

In the main thread, to which Python gives signals, a call that has had its time is interrupted by a signal whose
handler raises; the handler is set for the call alone. From any other thread the function is called on a thread of
its own, which is left behind. In a single long call into a library nothing is interrupted before it returns.
"""

from __future__ import annotations

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
    `due` is the exception that the handler of `WAKE_UP` is to raise. `leave`, if given, is called with it instead.
    """

    leave: Callable[[_Call, NoAnswerError], None] | None = None

    thread: int = field(default_factory=threading.get_ident)
    clock: int | None = field(default_factory=lambda: _own_clock())
    start_ns: int = 0
    looked_ns: int = 0
    waited_s: float = 0.0
    is_on: bool = True
    is_signalled: bool = False
    due: NoAnswerError | None = None
    handler_before: Any = None

    def __post_init__(self) -> None:
        self.start_ns = self.looked_ns = self.cpu_ns()

    def take_signals(self) -> None:
        """Set the handler of `WAKE_UP` to that of this call."""
        self.handler_before = signal.signal(WAKE_UP, self._wake_up)

    def cpu_ns(self) -> int:
        """Return the time of the clock; of the whole process where threads have no clocks."""
        return time.process_time_ns() if self.clock is None else time.clock_gettime_ns(self.clock)

    def look(self) -> None:
        """Stop the call if it has had its time: again and again, if it goes on."""
        cpu_ns = self.cpu_ns()
        self.waited_s += LOOK_EVERY_S if cpu_ns - self.looked_ns < BUSY_SHARE * LOOK_EVERY_S * 1e9 else 0.0
        self.looked_ns = cpu_ns
        if cpu_ns - self.start_ns > LIMIT_S * 1e9:
            self.start_ns = cpu_ns
            self._stop(NoAnswerError())
        elif self.waited_s > WAIT_LIMIT_S:
            self.waited_s = 0.0
            self._stop(WaitedError())

    def _stop(self, error: NoAnswerError) -> None:
        if self.handler_before is not None:
            self.due, self.is_signalled = error, True
            signal.pthread_kill(self.thread, WAKE_UP)
        elif self.leave is not None:
            leave, self.leave = self.leave, None
            leave(self, error)

    def release_signals(self) -> None:
        """Set the handler of before; the watch does not look at the call any more."""
        if self.handler_before is not None:
            if self.is_signalled:
                time.sleep(0)  # a signal that has been sent is taken before a system call returns
            signal.signal(WAKE_UP, self.handler_before)
            self.handler_before = None

    def _wake_up(self, number: int, frame: FrameType | None) -> None:
        """Raise in a call that has had its time; give every other such signal to the handler of before."""
        due, self.due = self.due, None
        if due is None:
            if callable(self.handler_before):
                self.handler_before(number, frame)
        elif self.is_on and not _in_debugger(frame):
            raise due


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
    # None: a handler that Python has not set, and cannot set again.
    if threading.current_thread() is threading.main_thread() and signal.getsignal(WAKE_UP) is not None:
        return _call_here(_Call(), function, *arguments)
    return _call_aside(function, *arguments)


def _call_aside(function: Callable[..., T], *arguments: object) -> T:
    """Call on a thread of its own, which goes on by itself once it has had its time: nobody takes its answer."""
    answers: SimpleQueue[Callable[[], T]] = SimpleQueue()

    def leave(call: _Call, error: NoAnswerError) -> None:
        stack = _stack(sys._current_frames().get(call.thread))
        answers.put(partial(_raise, error.with_traceback(stack)))

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
        traced = TracebackType(traced, frame, frame.f_lasti, frame.f_lineno or frame.f_code.co_firstlineno)
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
