"""The end of a command's main thread by an exception, or by a status other than 0: it ends the program at once.

Python would wait for other threads, and Zenoh has one for each callback: the program would stay, and nobody would
see that it has failed. vnet reads the report once the process has ended.

Imports no module whose name a program might have.
"""

from __future__ import annotations

import gc
import os
import sys
from contextlib import suppress
from functools import lru_cache
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from typing import Any, NoReturn

INTERRUPTED = 130
"""Status of a program that an interrupt has ended."""
_code: Any = vars(SystemExit)["code"]
_left: list[SystemExit] = []
"""The exception by which the main thread has left, once it has."""


class _Code:
    """`SystemExit.code`: Python asks for it outside of any function when the main thread has left by it."""

    def __get__(self, error: SystemExit | None, kind: type) -> Any:
        if error is None:
            return self
        try:
            sys._getframe(1)
        except ValueError:
            _left.append(error)
        return _code.__get__(error)

    def __set__(self, error: SystemExit, code: object) -> None:
        _code.__set__(error, code)


def _exit(status: Any = None, /) -> NoReturn:
    """Do as `sys.exit`; the exception keeps its place, which before Python 3.12 the end does not show."""
    error: Any = SystemExit(status)
    error._place = _error_text().line_of_caller()
    raise error


@lru_cache
def _error_text() -> Any:
    """Return vnet's module of this name, also where vnet is not installed."""
    path = f"{__file__.rpartition('/gateway/')[0]}/runtime/error_text.py"
    spec: Any = spec_from_file_location("_vnet_error_text", path)
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _failure() -> BaseException | None:
    """Return the exception that has ended the main thread, if it has failed."""
    if _left:
        return _left[0] if _left[0].code not in (None, 0) else None
    error: Any = getattr(sys, "last_exc", None) or getattr(sys, "last_value", None)
    trace = getattr(error, "__traceback__", None)
    ends_main = trace is not None and trace.tb_frame.f_code.co_name in ("<module>", "_run_module_as_main")
    return error if ends_main else None


def _leave(status: Any) -> None:
    for stream in (sys.stdout, sys.stderr):
        with suppress(AttributeError, OSError, ValueError):
            stream.flush()
    os._exit(status & 0xFF if isinstance(status, int) else 1)


def note_exits() -> None:
    """Take note of the exception by which the main thread leaves. Before any program has looked at such a one."""
    gc.get_referents(vars(SystemExit))[0]["code"] = _Code()
    sys.exit = _exit


def watch(path: str) -> None:
    """Have a failure of this process's main thread written to a file, and end the process."""
    process, threading = os.getpid(), import_module("threading")
    wait_for_threads = threading._shutdown

    def end() -> None:
        error = _failure() if os.getpid() == process else None
        if error is not None:
            status: Any = INTERRUPTED if isinstance(error, KeyboardInterrupt) else None
            status = error.code if isinstance(error, SystemExit) else status
            _error_text().write_report(path, error, status, getattr(error, "_place", ""))
            if any(not each.daemon for each in threading.enumerate() if each is not threading.main_thread()):
                _leave(status)
        wait_for_threads()

    vars(threading)["_shutdown"] = end
