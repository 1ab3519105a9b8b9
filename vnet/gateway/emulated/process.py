"""The process of a program on virtual time, as it takes itself for one: its signals and its end.

Python's own functions act on the whole process, which has the emulator and all its vehicles.
"""

from __future__ import annotations

import asyncio
import errno
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from math import ceil
from types import ModuleType, TracebackType
from typing import Any, NoReturn

from vnet.gateway import STARTUP
from vnet.gateway.emulated.strands import HardExit, Threads, block_on, current_strand, leave_hard, sleep

OUTSIDE = "VNET_OUTSIDE"
"""Variable by which a child process knows that it has no radio, as its Zenoh would reach the machine's network."""
PID = 1
"""Number of the program's process."""
INTERRUPTED = 130
"""Status of a program that an interrupt has ended."""
_IGNORED = (signal.SIGCHLD, signal.SIGCONT, signal.SIGURG, signal.SIGWINCH)
"""Signals that do nothing to a program without a handler."""


class OwnProcess:
    """Signals that a program sends to itself, and ends without a farewell. No signal comes from elsewhere."""

    def __init__(self, threads: Threads) -> None:
        self._threads = threads
        self._handlers: dict[int, Any] = {signal.SIGINT: signal.default_int_handler}
        self._timer: asyncio.TimerHandle | None = None
        self._interval_s = 0.0
        self.interrupt: BaseException | None = None
        """The last interrupt that was the program's own."""

    def os_functions(self) -> dict[str, Any]:
        """Return what stands for functions of `os`."""
        return {
            "chdir": self._threads.folder.change,
            **dict.fromkeys(["getpid", "getpgid", "getpgrp"], lambda *pid: PID),
            "getppid": lambda: 0,
            **dict.fromkeys(["kill", "killpg"], self._kill),
            "_exit": self._exit,
            "abort": lambda: self._exit(-signal.SIGABRT),
            **{name: _refuse for name in vars(os) if name.startswith(("exec", "fork"))},
        }

    def signal_functions(self) -> dict[str, Any]:
        """Return what stands for functions of `signal`."""
        return {
            "signal": self.set_handler,
            "getsignal": lambda number: self._handlers.get(number, signal.SIG_DFL),
            "raise_signal": self.send,
            "pthread_kill": lambda thread, number: self.send(number),
            **dict.fromkeys(["pause", "sigwait", "sigwaitinfo"], _wait_for_ever),
            "sigtimedwait": lambda signals, timeout: sleep(timeout),
            "pthread_sigmask": lambda how, mask: set(),
            "alarm": lambda seconds: ceil(self._set_timer(signal.ITIMER_REAL, seconds)[0]),
            "setitimer": self._set_timer,
            "getitimer": self._timer_left,
            "set_wakeup_fd": lambda *args, **kwargs: -1,
            "siginterrupt": lambda *args: None,
        }

    def set_handler(self, number: int, handler: Any) -> Any:
        """Have a signal handled so; return what it was handled by before."""
        before = self._handlers.get(number, signal.SIG_DFL)
        self._handlers[number] = handler
        return before

    def _timer_left(self, which: int) -> tuple[float, float]:
        if self._timer is None or which != signal.ITIMER_REAL:
            return 0.0, 0.0
        return self._timer.when() - asyncio.get_running_loop().time(), self._interval_s

    def _set_timer(self, which: int, seconds: float, interval: float = 0.0) -> tuple[float, float]:
        """Do as `signal.setitimer`; timers of the processor's time, of which computing takes none, never ring."""
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
            self._threads.start(self.send, (signal.SIGALRM,))

    def _kill(self, pid: int, number: int) -> None:
        if pid in (PID, -PID, 0, -1):
            self.send(number)
        else:  # a child
            os.kill(pid, number)

    def send(self, number: int) -> None:
        """Do what a signal to the program does. What a handler raises, its main thread gets."""
        handler = self._handlers.get(number, signal.SIG_DFL)
        if number in (signal.SIGKILL, signal.SIGSTOP) or (
            handler == signal.SIG_DFL and number not in (0, *_IGNORED)
        ):
            self._exit(-number)
        if not callable(handler):
            return
        try:
            handler(int(number), None)
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt):
                self.interrupt = error
            if current_strand() is self._threads.main:
                raise
            self._threads.interrupt(error)

    def _exit(self, status: int) -> None:
        """End the program at once: nothing of it runs any more."""
        leave, strand = HardExit(status).with_traceback(_place()), current_strand()
        if strand is self._threads.main:
            leave_hard(leave)
        self._threads.interrupt(leave)
        if strand is not None:
            leave_hard(None)


def _place() -> TracebackType:
    """Return where the program is that runs."""
    frame = sys._getframe()
    while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith("vnet."):
        frame = frame.f_back
    return TracebackType(None, frame, frame.f_lasti, frame.f_lineno)


def _wait_for_ever(*_: object) -> None:
    block_on(asyncio.get_running_loop().create_future())


def _refuse(*args: object, **options: object) -> NoReturn:
    raise OSError(errno.ENOSYS, "not available on virtual time: the process has other vehicles, too")


_programs, _path_before = 0, ""


@contextmanager
def children_outside() -> Iterator[None]:
    """Have Zenoh in Python's child processes, however they are started, open no session meanwhile."""
    global _programs, _path_before
    if _programs == 0:
        _path_before = os.environ.get("PYTHONPATH", "")
        os.environ |= {"PYTHONPATH": os.pathsep.join(filter(None, [str(STARTUP), _path_before])), OUTSIDE: "1"}
    _programs += 1
    try:
        yield
    finally:
        _programs -= 1
        if _programs == 0:
            os.environ["PYTHONPATH"] = _path_before  # empty means none
            del os.environ[OUTSIDE]


def subprocess_functions(environ: Mapping[str, str], tell: Callable[[], object]) -> dict[str, Any]:
    """Return what stands for functions of `subprocess`: child processes get the program's environment."""

    def environment(given: Any) -> Any:
        tell()
        return environ if given is None else given

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
