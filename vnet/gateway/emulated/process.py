"""The process of a program on virtual time, as it takes itself for one: its signals and its end.

Python's own functions act on the whole process, which has the emulator and all its vehicles.
"""

from __future__ import annotations

import _multiprocessing  # type: ignore[import-not-found]
import asyncio
import errno
import multiprocessing
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from math import ceil, inf
from multiprocessing.synchronize import RECURSIVE_MUTEX  # type: ignore[attr-defined]
from operator import index
from types import FrameType, ModuleType, TracebackType
from typing import Any, NoReturn
from zlib import crc32

from vnet.gateway import STARTUP
from vnet.gateway.emulated.strands import (
    BUSY_WAIT_S,
    HardExit,
    Strand,
    Threads,
    Waiting,
    current_strand,
    is_child,
    leave_hard,
    look,
    sleep,
)

OUTSIDE = "VNET_OUTSIDE"
"""Variable by which a child process knows that it has no radio, as its Zenoh would reach the machine's network."""
FIRST_PID = 1 << 22
"""Least number of a program's process: above all of Linux, so that no process of the machine has it."""
PIDS = 1 << 30
"""Numbers of processes from there on."""
INTERRUPTED = 130
"""Status of a program that an interrupt has ended."""
_OF_PROCESSES = "getsid", "pidfd_open", "sched_getaffinity", "sched_getscheduler", "sched_setaffinity"
"""Functions of `os` that ask the machine about a process by its number."""
_IGNORED = (signal.SIGCHLD, signal.SIGCONT, signal.SIGURG, signal.SIGWINCH)
"""Signals that do nothing to a program without a handler."""
_TIMERS = (signal.ITIMER_REAL, signal.ITIMER_VIRTUAL, signal.ITIMER_PROF)


class OwnProcess:
    """Signals that a program sends to itself, and ends without a farewell. No signal comes from elsewhere."""

    def __init__(self, threads: Threads, name: str) -> None:
        """The process that has a `name` in the run, from which its number is derived."""
        self._threads = threads
        self._pid = FIRST_PID + crc32(name.encode()) % PIDS
        self._handlers: dict[int, Any] = {signal.SIGINT: signal.default_int_handler}
        self._timer: asyncio.TimerHandle | None = None
        self._interval_s = 0.0
        self._blocked: set[int] = set()
        self._awaited: list[set[int]] = []
        self._pending: set[int] = set()
        self._arrivals, self._handled = Waiting(), Waiting()
        self.interrupt: BaseException | None = None
        """The last interrupt that was the program's own."""

    def os_functions(self) -> dict[str, Any]:
        """Return what stands for functions of `os`."""
        return {
            "chdir": self._threads.folder.change,
            **dict.fromkeys(["getpid", "getpgid", "getpgrp"], lambda *pid: self._pid),
            "getppid": lambda: 0,
            **dict.fromkeys(["kill", "killpg"], self._kill),
            "_exit": self._exit,
            "abort": lambda: self._exit(-signal.SIGABRT),
            **{name: _refuse for name in vars(os) if name.startswith(("exec", "fork", "closerange"))},
            **{name: self._of_the_machine(vars(os)[name]) for name in _OF_PROCESSES},
            "close": _close,
            "dup2": _dup2,
        }

    def _of_the_machine(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function of the number of a process that takes the program's for the machine's."""
        return lambda pid, *args: function(os.getpid() if pid == self._pid else pid, *args)

    def signal_functions(self) -> dict[str, Any]:
        """Return what stands for functions of `signal`."""
        return {
            "signal": self.set_handler,
            "getsignal": lambda number: self._handlers.get(number, signal.SIG_DFL),
            "raise_signal": self.send,
            "pthread_kill": lambda thread, number: self.send(number),
            "pause": self._pause,
            "sigwait": lambda signals: _named(self._await(signals)),
            "sigwaitinfo": lambda signals: self._siginfo(self._await(signals)),
            "sigtimedwait": self._await_for,
            "sigpending": lambda: set(map(_named, self._pending)),
            "pthread_sigmask": self._set_mask,
            "alarm": lambda seconds: ceil(self._set_timer(signal.ITIMER_REAL, index(seconds))[0]),
            "setitimer": self._set_timer,
            "getitimer": self._timer_left,
            "set_wakeup_fd": lambda *args, **kwargs: -1,
            "siginterrupt": lambda *args: None,
        }

    def set_handler(self, number: int, handler: Any) -> Any:
        """Have a signal handled so; return what it was handled by before. Raises as `signal.signal`."""
        if not callable(handler) and handler not in (signal.SIG_DFL, signal.SIG_IGN):
            raise TypeError("signal handler must be signal.SIG_IGN, signal.SIG_DFL, or a callable object")
        if self._is_in_thread():
            raise ValueError("signal only works in main thread of the main interpreter")
        if not 0 < number < signal.NSIG:
            raise ValueError("signal number out of range")
        if number in (signal.SIGKILL, signal.SIGSTOP):
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        before = self._handlers.get(number, signal.SIG_DFL)
        self._handlers[number] = handler
        return before

    def _is_in_thread(self) -> bool:
        """Return whether another than the main thread runs."""
        strand, main = current_strand(), self._threads.main
        return strand is not None and main is not None and strand.number != main.number

    def _timer_left(self, which: int) -> tuple[float, float]:
        if self._timer is None or which != signal.ITIMER_REAL:
            return 0.0, 0.0
        return self._timer.when() - asyncio.get_running_loop().time(), self._interval_s

    def _set_timer(self, which: int, seconds: float, interval: float = 0.0) -> tuple[float, float]:
        """Do as `signal.setitimer`; timers of the processor's time, of which computing takes none, never ring."""
        if which not in _TIMERS or seconds < 0 or interval < 0:
            raise signal.ItimerError(errno.EINVAL, os.strerror(errno.EINVAL))
        before = self._timer_left(which)
        if which == signal.ITIMER_REAL:
            if self._timer is not None:
                self._timer.cancel()
            self._interval_s = interval
            self._timer = asyncio.get_running_loop().call_later(seconds, self._ring) if seconds else None
        return before

    def _ring(self) -> None:
        self._timer = None
        if not self._threads.are_over:
            self._set_timer(signal.ITIMER_REAL, self._interval_s, self._interval_s)
            self._threads.start_as_main(lambda: self.send(signal.SIGALRM))

    def _set_mask(self, how: int, mask: Iterable[int]) -> set[int]:
        """Do as `signal.pthread_sigmask`; all threads have one mask."""
        before, given = self._blocked, set(mask) - {signal.SIGKILL, signal.SIGSTOP}
        masks = {
            signal.SIG_BLOCK: before | given,
            signal.SIG_UNBLOCK: before - given,
            signal.SIG_SETMASK: given,
        }
        if how not in masks:
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        self._blocked = masks[signal.Sigmasks(how)]
        for number in sorted(self._pending - self._blocked):
            self._pending.discard(number)
            self.send(number)
        return set(map(_named, before))

    def _pause(self) -> None:
        self._handled.wait()

    def _await_for(self, signals: Iterable[int], timeout: float) -> signal.struct_siginfo | None:
        if timeout < 0:
            raise ValueError("timeout must be non-negative")
        number = self._await(signals, timeout)
        return self._siginfo(number) if number else None

    def _siginfo(self, number: int) -> signal.struct_siginfo:
        return signal.struct_siginfo((number, 0, 0, self._pid, 0, 0, 0))

    def _await(self, signals: Iterable[int], timeout: float = -1) -> int:
        """Block until one of these signals comes, which is then not handled; return 0 after `timeout` seconds."""
        awaited, end_s = set(signals), asyncio.get_running_loop().time() + timeout
        self._awaited.append(awaited)
        try:
            while not (came := self._pending & awaited):
                left_s = -1 if timeout == -1 else max(0.0, end_s - asyncio.get_running_loop().time())
                if not self._arrivals.wait(left_s):
                    return 0
        finally:
            self._awaited.remove(awaited)
        self._pending.discard(min(came))
        return min(came)

    def _kill(self, pid: int, number: int) -> None:
        if pid in (self._pid, -self._pid, 0, -1):
            self.send(number)
        else:  # a child
            os.kill(pid, number)

    def send(self, number: int) -> None:
        """Do what a signal to the program does. What a handler raises, its main thread gets."""
        if number in self._blocked.union(*self._awaited):
            self._pending.add(int(number))
            self._arrivals.wake_all()
            return
        handler = self._handlers.get(number, signal.SIG_DFL)
        if number in (signal.SIGKILL, signal.SIGSTOP) or (
            handler == signal.SIG_DFL and number not in (0, *_IGNORED)
        ):
            self._exit(-number)
        if not callable(handler):
            return
        if self._is_in_thread():
            self._threads.start_as_main(lambda: self.send(number))
            return
        try:
            handler(int(number), self._frame())
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt):
                self.interrupt = error
            if current_strand() is self._threads.main:
                raise
            self._threads.interrupt(error)
        else:
            self._handled.wake_all()

    def _frame(self) -> FrameType:
        """Return where the program is: where it runs, or else where its main thread waits."""
        here = sys._getframe()
        main = None if self._threads.main is None else self._threads.main.gr_frame
        return _program_frame(here) or (main and _program_frame(main)) or here

    def _exit(self, status: int) -> None:
        """End the program at once: nothing of it runs any more."""
        frame, strand = self._frame(), current_strand()
        leave = HardExit(status).with_traceback(TracebackType(None, frame, frame.f_lasti, frame.f_lineno))
        if strand is self._threads.main:
            leave_hard(leave)
        self._threads.interrupt(leave)
        if strand is not None:
            leave_hard(None)


class Semaphore(_multiprocessing.SemLock):  # type: ignore[misc]
    """A lock or semaphore of `multiprocessing`, for which a program waits on emulated time.

    Where no thread holds it, and there are child processes, it waits in the machine's time, as for these.
    """

    _holder: Strand | None = None

    def acquire(self, block: bool = True, timeout: float | None = None) -> bool:
        strand = current_strand()
        if strand is None or is_child():
            return bool(super().acquire(block, timeout))
        look()
        loop = asyncio.get_running_loop()
        end_s = loop.time() + (inf if timeout is None else timeout)
        while not self._is_taken(strand):
            if not block or loop.time() >= end_s:
                return False
            if self._holder is None and multiprocessing.active_children():
                return self._is_noted(strand, super().acquire(True, timeout))
            sleep(BUSY_WAIT_S)
        return True

    def _is_taken(self, strand: Strand) -> bool:
        """Take it, if it is free; to Python all strands are the one that holds it."""
        is_others = self.kind == RECURSIVE_MUTEX and self._is_mine() and self._holder is not strand
        return not is_others and self._is_noted(strand, super().acquire(False))

    def _is_noted(self, strand: Strand, is_taken: bool) -> bool:
        if is_taken:
            self._holder = strand
        return is_taken

    def release(self) -> None:
        if self.kind == RECURSIVE_MUTEX and self._holder not in (None, current_strand()):
            raise AssertionError("attempt to release recursive lock not owned by thread")
        super().release()
        if self.kind != RECURSIVE_MUTEX or not self._count():
            self._holder = None

    __enter__ = acquire

    def __exit__(self, *args: object) -> None:
        self.release()


def _program_frame(frame: FrameType) -> FrameType | None:
    """Return the innermost frame of the program among those that lead to `frame`, None without any."""
    inner: FrameType | None = frame
    while inner is not None and inner.f_globals.get("__name__", "").startswith("vnet."):
        inner = inner.f_back
    return inner


def _named(number: int) -> int:
    return signal.Signals(number) if number in set(signal.Signals) else number


def _refuse(*args: object, **options: object) -> NoReturn:
    raise OSError(errno.ENOSYS, "not available on virtual time: the process has other vehicles, too")


def _close(fd: int) -> None:
    _refuse_to_end(fd)
    os.close(fd)


def _dup2(fd: int, fd2: int, inheritable: bool = True) -> int:
    _refuse_to_end(fd2)
    return os.dup2(fd, fd2, inheritable)


def _refuse_to_end(fd: int) -> None:
    """Raise OSError for input and output, which all vehicles have."""
    if fd in range(3):
        _refuse()


_programs, _path_before = 0, ""


@contextmanager
def children_outside() -> Iterator[None]:
    """Have Zenoh in Python's child processes, however they are started, open no session meanwhile."""
    global _programs, _path_before
    if _programs == 0:
        _path_before = os.environ.get("PYTHONPATH", "")
        os.environ |= _outside(os.environ)
    _programs += 1
    try:
        yield
    finally:
        _programs -= 1
        if _programs == 0:
            os.environ["PYTHONPATH"] = _path_before  # empty means none
            os.environ.pop(OUTSIDE, None)


def _outside(environ: Mapping[str, str]) -> dict[str, str]:
    """Return the variables by which Zenoh in a child process with this environment opens no session."""
    path = [each for each in environ.get("PYTHONPATH", "").split(os.pathsep) if each not in ("", str(STARTUP))]
    return {"PYTHONPATH": os.pathsep.join([str(STARTUP), *path]), OUTSIDE: "1"}


def subprocess_functions(environ: Mapping[str, str], tell: Callable[[], object]) -> dict[str, Any]:
    """Return what stands for functions of `subprocess`.

    Child processes get the program's environment, and in any have what `children_outside` sets.
    """

    def environment(given: Any) -> Any:
        tell()
        chosen = environ if given is None else given
        return {**chosen, **_outside(chosen)}

    class Popen(subprocess.Popen[Any]):
        def __init__(self, *args: Any, **options: Any) -> None:
            super().__init__(*args, **options | {"env": environment(options.get("env"))})

    def inheriting(function: Callable[..., Any]) -> Callable[..., Any]:
        return lambda *args, env=None, **options: function(*args, env=environment(env), **options)

    names = ("call", "check_call", "check_output", "run")
    return {"Popen": Popen, **{name: inheriting(getattr(subprocess, name)) for name in names}}


def take_output(builtins: dict[str, Any], own_sys: ModuleType) -> None:
    """Have `print` write where the program's own `sys.stdout` is."""

    def own_print(*values: object, file: Any = None, **options: Any) -> None:
        print(*values, file=vars(own_sys)["stdout"] if file is None else file, **options)

    builtins["print"] = own_print
