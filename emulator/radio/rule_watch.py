"""A bound on the processor time of a call into code of the user's own: a rule that loops forever is interrupted.

A thread looks at the processor time of the calling thread now and then, and raises an exception in it once the
call has had its time. So a slow machine, or one that is stopped, interrupts nothing. What waits without computing,
and a single long call into a library, are not interrupted before they return.
"""

from __future__ import annotations

import ctypes
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

LIMIT_S = 10.0
"""Processor time of one call: a thousand times what a rule for hundreds of receivers takes."""
LOOK_EVERY_S = 0.1
IDLE_S = 5.0
"""Time without a call after which the thread ends."""
T = TypeVar("T")


class NoAnswerError(BaseException):
    """A call has had its processor time. No Exception, so that the function does not catch it by accident."""


@dataclass(eq=False)
class _Call:
    """A call that is on: its thread, the clock of that thread, and its time by that clock at the start, in ns."""

    thread: int = field(default_factory=threading.get_ident)
    clock: int | None = field(default_factory=lambda: _own_clock())
    start_ns: int = 0
    is_interrupted: bool = False

    def __post_init__(self) -> None:
        self.start_ns = self.cpu_ns()

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


def _own_clock() -> int | None:
    return time.pthread_getcpuclockid(threading.get_ident()) if sys.platform == "linux" else None


class _Watch:
    """The calls that are on in this process, and the thread that looks at them."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._calls: set[_Call] = set()
        self._thread: threading.Thread | None = None
        self._last_s = 0.0

    def begin(self) -> _Call:
        call = _Call()
        with self._lock:
            self._calls.add(call)
            self._last_s = time.monotonic()
            if self._thread is None or not self._thread.is_alive():  # a fork has no threads but its own
                self._thread = threading.Thread(target=self._look, name="rule watch", daemon=True)
                self._thread.start()
        return call

    def end(self, call: _Call) -> None:
        with self._lock:
            self._calls.discard(call)
        if call.is_interrupted:
            call.take_back()

    def _look(self) -> None:
        while True:
            time.sleep(LOOK_EVERY_S)
            with self._lock:
                for call in self._calls:
                    if call.cpu_ns() - call.start_ns > LIMIT_S * 1e9:
                        call.is_interrupted, call.start_ns = True, call.cpu_ns()  # again, if it goes on
                        call.interrupt()
                if not self._calls and time.monotonic() - self._last_s > IDLE_S:
                    self._thread = None
                    return


_WATCH = _Watch()


def call_bounded(function: Callable[..., T], *arguments: object) -> T:
    """Return what a function returns. Raises what it raises, or NoAnswerError after `LIMIT_S` of processor time."""
    call = _WATCH.begin()
    try:
        try:
            return function(*arguments)
        finally:
            _WATCH.end(call)
    except NoAnswerError:
        _WATCH.end(call)  # it may have been raised while the call ended
        raise
