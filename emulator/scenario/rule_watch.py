"""Bounds on a call into code of the user's own: a rule that loops, or waits, forever is stopped.

A call is looked at now and then: how much processor time its thread has had, and at how many looks it had next to
none. So a slow machine, or one that is stopped, stops nothing.

In the main thread, to which Python gives signals, a timer's signal interrupts the call, and its handler looks. From
any other thread the function is called on a thread of its own, which is left behind. In a single long call into a
library nothing is interrupted before it returns.
"""

from __future__ import annotations

import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from contextvars import copy_context
from dataclasses import dataclass, field
from functools import partial
from queue import Empty, SimpleQueue
from types import FrameType, TracebackType
from typing import NoReturn, TypeVar

from emulator.scenario.own_functions import NonsenseError, in_words, line_of, outside

LIMIT_S = 10.0
"""Processor time of one call: a thousand times what a rule for hundreds of receivers takes."""
WAIT_LIMIT_S = 30.0
"""Time that one call may wait: three times what it may compute."""
BUSY_SHARE = 0.01
"""Share of processor time above which a call computes, and does not wait."""
WAKE_UP = signal.SIGALRM
LOOK_EVERY_S = 0.1
T = TypeVar("T")


class NoAnswerError(BaseException):
    """A call has had its time. No Exception, so that the function does not catch it by accident."""

    def __str__(self) -> str:
        return f"{LIMIT_S:g} s of processor time"


class WaitedError(NoAnswerError):
    """A call has waited for too long."""

    def __str__(self) -> str:
        return f"{WAIT_LIMIT_S:g} s of waiting"


@dataclass
class _Call:
    """A call that the current thread begins: the thread, its clock, its time then and at the last look, in ns.

    `waited_s` is how long it was seen to wait.
    """

    thread: int = field(default_factory=threading.get_ident)
    clock: int = field(
        default_factory=lambda: (
            time.pthread_getcpuclockid(threading.get_ident())
            if sys.platform == "linux"
            else time.CLOCK_PROCESS_CPUTIME_ID
        )
    )
    start_ns: int = 0
    looked_ns: int = 0
    waited_s: float = 0.0

    def __post_init__(self) -> None:
        self.start_ns = self.looked_ns = time.clock_gettime_ns(self.clock)

    def look(self, frame: FrameType | None) -> None:
        """Raise NoAnswerError if the call has had its time: again and again, if it goes on. `frame` is its own."""
        cpu_ns = time.clock_gettime_ns(self.clock)
        self.waited_s += LOOK_EVERY_S if cpu_ns - self.looked_ns < BUSY_SHARE * LOOK_EVERY_S * 1e9 else 0.0
        self.looked_ns = cpu_ns
        if cpu_ns - self.start_ns > LIMIT_S * 1e9:
            self.start_ns = cpu_ns
            error = NoAnswerError()
        elif self.waited_s > WAIT_LIMIT_S:
            self.waited_s = 0.0
            error = WaitedError()
        else:
            return
        if not _in_debugger(frame):
            raise error


def _in_debugger(frame: FrameType | None) -> bool:
    """Return whether pdb waits for its user."""
    while frame is not None:
        if frame.f_globals.get("__name__") == "bdb":
            return True
        frame = frame.f_back
    return False


def call_bounded(function: Callable[..., T], *arguments: object) -> T:
    """Return what a function returns. Raises what it raises, or NoAnswerError after its time.

    It may compute for `LIMIT_S`, and wait for `WAIT_LIMIT_S`.
    """
    # None: a handler that Python has not set, and cannot set again.
    if threading.current_thread() is threading.main_thread() and signal.getsignal(WAKE_UP) is not None:
        return _call_here(function, *arguments)
    return _call_aside(function, *arguments)


def _call_here(function: Callable[..., T], *arguments: object) -> T:
    call, began_s = _Call(), time.monotonic()
    handler = signal.signal(WAKE_UP, lambda number, frame: call.look(frame))
    left_s, every_s = signal.setitimer(signal.ITIMER_REAL, LOOK_EVERY_S, LOOK_EVERY_S)

    def end() -> None:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(WAKE_UP, handler)
        if left_s:  # the timer of somebody else, which goes on
            signal.setitimer(signal.ITIMER_REAL, max(left_s - time.monotonic() + began_s, 1e-6), every_s)

    try:
        try:
            return function(*arguments)
        finally:
            end()
    except NoAnswerError:
        end()  # it may have been raised while the call ended
        raise


def _call_aside(function: Callable[..., T], *arguments: object) -> T:
    """Call on a thread of its own, which goes on by itself once it has had its time: nobody takes its answer."""
    calls: SimpleQueue[_Call] = SimpleQueue()
    answers: SimpleQueue[Callable[[], T]] = SimpleQueue()

    def run() -> None:
        calls.put(_Call())
        try:
            answer = function(*arguments)
        except BaseException as error:
            answers.put(partial(_raise, error))
        else:
            answers.put(lambda: answer)

    threading.Thread(target=copy_context().run, args=(run,), name="rule", daemon=True).start()
    call = calls.get()
    while True:
        with suppress(Empty):
            answer = answers.get(timeout=LOOK_EVERY_S)
            break
        frame = sys._current_frames().get(call.thread)
        try:
            call.look(frame)
        except OSError:  # its thread has just ended
            continue
        except NoAnswerError as error:
            raise error.with_traceback(_stack(frame)) from None
    return answer()


def _raise(error: BaseException) -> NoReturn:
    raise error


def _stack(frame: FrameType | None) -> TracebackType | None:
    """Return the traceback from this file to where a thread stands, as if it had raised there."""
    traced: TracebackType | None = None
    while frame is not None and frame.f_code.co_filename != __file__:
        traced = TracebackType(traced, frame, frame.f_lasti, frame.f_lineno or frame.f_code.co_firstlineno)
        frame = frame.f_back
    return traced


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
