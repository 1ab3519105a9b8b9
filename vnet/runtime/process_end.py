"""Ends of a process that its programs ask for: `os._exit` and `os.exec*` are the death of a vehicle.

Where programs share a process with the emulator (`caught`), the vehicle alone has died, and the program goes no
further. In a process of their own (`count_as_death`) it ends, with a status other than 0: 0 is that of a run's end.
"""

from __future__ import annotations

import atexit
import faulthandler
import os
import posix
import sys
import threading
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from functools import wraps
from typing import Any, NoReturn

from vnet.node import Node
from vnet.runtime.outside_loop import present_node

exit_now = os._exit
"""End this process at once: `os._exit` as it is."""
DEATH_STATUS = 71
"""Exit status of a process whose program has ended it with status 0, or has put another program in its place."""
JOBS = "vnet"
"""Prefix of the names of threads of the default executor, whose jobs are nobody's."""

_takers: list[Callable[[Node | None, str], None]] = []
_process = os.getpid()
_is_programs_own = False
_status_late = 0


class ProcessEndedError(BaseException):
    """A program has ended its process: its vehicle has died, which has been told."""


@contextmanager
def caught(taker: Callable[[Node | None, str], None]) -> Iterator[None]:
    """Call `taker` within the block with each node that ends this process, and with the call that does."""
    global _process
    _replace()
    _process = os.getpid()
    _takers.append(taker)
    try:
        yield
    finally:
        _takers.remove(taker)


def count_as_death() -> None:
    """Have this process, which is that of its programs, end with a status other than 0 if one of them ends it."""
    global _process, _is_programs_own
    _replace()
    _process, _is_programs_own = os.getpid(), True


def refuse_success() -> None:
    """Have `os._exit` and `exec*` end this process with a status other than 0 from now on, whoever calls them.

    A test's process that a thread, a finalizer or an `atexit` function of a program ends has not passed.
    """
    global _process, _status_late
    _replace()
    _process, _status_late = os.getpid(), DEATH_STATUS


def _replace() -> None:
    for name in ("_exit", "execv", "execve"):
        original = getattr(os, name)
        if not hasattr(original, "__wrapped__"):
            replacement = _replacement(name, original)  # one, so that it can be pickled by its name
            for module in (os, posix):
                setattr(module, name, replacement)


def _replacement(name: str, original: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(original)
    def end(*args: Any, **options: Any) -> Any:
        if os.getpid() != _process:  # a process that a program has forked
            return original(*args, **options)
        call = f"os.{name}({', '.join([*map(repr, args[:1]), *(f'{key}={options[key]!r}' for key in options)])})"
        node = present_node()
        if _is_programs_own:
            status = args[0] if name == "_exit" and args and isinstance(args[0], int) else 0
            _end_as_death(node, call, status)
        if not _takers or (node is None and not threading.current_thread().name.startswith(f"{JOBS}_")):
            if _status_late and (name != "_exit" or not args or args[0] == 0):
                sys.stderr.write(f"vnet: {call} ended the process of the tests\n")
                exit_now(_status_late)
            return original(*args, **options)
        for taker in tuple(_takers):
            taker(node, call)
        raise ProcessEndedError(call)

    return end


def _end_as_death(node: Node | None, call: str, status: int) -> NoReturn:
    sys.stderr.write(f"vnet-agent: the program of {'a vehicle' if node is None else node.id} called {call}\n")
    sys.stderr.flush()
    exit_now(status or DEATH_STATUS)


ENDING_S = 60.0
"""Seconds for an agent, or a separate router, to end: Zenoh gives a connection up after ten."""


def end_within(seconds: float = ENDING_S) -> None:
    """Have this process end after so many seconds at the latest, with status 1 and its stacks on standard error."""
    if sys.__stderr__ is not None:
        faulthandler.dump_traceback_later(seconds, exit=True, file=sys.__stderr__)


# The end of a process that was forked from a zygote.
#
# An interpreter that ends takes all of its objects apart, and so writes to memory that it has shared with the
# zygote so far: at the end of a run all agents at once would need several times the memory that they ran in.


def end_forked(status: int, shared: Collection[str]) -> NoReturn:
    """End this process with `status`, and leave the objects of the modules named in `shared` as they are.

    As when an interpreter ends, threads are awaited and functions of `atexit` called, and what the other modules
    hold is discarded, so that files which they have left open are written.
    """
    threading._shutdown()  # type: ignore[attr-defined]  # as multiprocessing does, and `_exit` below
    atexit._run_exitfuncs()
    for name in [name for name in reversed(sys.modules) if name not in shared]:
        module = sys.modules.pop(name)
        with suppress(AttributeError, TypeError):  # what a program has put in a module's place
            vars(module).clear()
    for stream in (sys.stdout, sys.stderr):
        with suppress(AttributeError, OSError, ValueError):  # closed, none, or without a reader
            stream.flush()
    exit_now(status)
