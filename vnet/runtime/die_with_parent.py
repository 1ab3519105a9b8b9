"""A signal for a process when the one that started it ends: a parent that is killed leaves nothing behind.

Before a command, as `TIED` stands there, it becomes that command, and ends when its parent does (on Linux;
elsewhere the command just runs).
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Set
from io import FileIO

PR_SET_PDEATHSIG = 1
PR_SET_CHILD_SUBREAPER = 36
PR_GET_CHILD_SUBREAPER = 37
STARTED_BY_VNET = "VNET_ENDS_WITH_PARENT"
"""Variable in the environment of agents, and of hosts, that an emulator or a host has started."""
TIED = (sys.executable, "-I", "-S", __file__)
"""Words before a command that is to end when this process does. The environment is for the command alone."""
POLL_S = 0.5
"""Seconds between two looks for the parent, on systems that do not tell."""


def signal_at_parent_death(number: signal.Signals) -> None:
    """Have this process sent a signal when the one that started it ends.

    On Linux the kernel sends it, to a stopped process too; elsewhere a thread of this process does.
    """
    parent = os.getppid()
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):  # a C library without prctl
            ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, number)
            if os.getppid() != parent:  # it has ended meanwhile
                os.kill(os.getpid(), number)
            return
    threading.Thread(target=_watch, args=(parent, number), daemon=True).start()


class Adoption:
    """Adoption of orphaned descendants by this process (on Linux), as long as somebody has asked for it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._asked = 0
        self._before = 0

    def begin(self) -> bool:
        """Adopt orphans from now on; returns whether the system can."""
        with self._lock, contextlib.suppress(OSError, AttributeError):
            before = ctypes.c_int()
            if ctypes.CDLL(None).prctl(PR_GET_CHILD_SUBREAPER, ctypes.byref(before), 0, 0, 0):
                return False
            if self._asked == 0:
                self._before = before.value
            if not before.value:  # a child that was forked within does not inherit it
                ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
            self._asked += 1
            return True
        return False

    def end(self) -> None:
        """Do as before the first `begin`, once every one of them that could has had its `end`."""
        with self._lock:
            self._asked -= 1
            if self._asked == 0:
                ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, self._before, 0, 0, 0)


adoption = Adoption()
"""That of this process."""


def started_processes(by: int, others: Set[int] = frozenset()) -> Iterator[int]:
    """Yield the processes of this session that one has started, and that these have, but for `others` and theirs.

    Nothing if no file tells.
    """
    for process in _children(by) - others:
        with contextlib.suppress(ProcessLookupError):
            if os.getsid(process) == os.getsid(0):
                yield from (process, *started_processes(process, others))


def _children(of: int) -> set[int]:
    found: set[int] = set()
    with contextlib.suppress(OSError):  # it has ended meanwhile
        for task in os.scandir(f"/proc/{of}/task"):
            with contextlib.suppress(OSError):  # or this thread of it
                found.update(map(int, _read(f"{task.path}/children").split()))
    return found


def rest_of_groups(groups: Set[int]) -> Iterator[int]:
    """Yield the processes that are left of groups whose first processes have ended."""
    for pid in {int(entry.name) for entry in os.scandir("/proc") if entry.name.isdigit()} - groups:
        with contextlib.suppress(OSError):  # it has ended meanwhile
            if os.getpgid(pid) in groups:
                yield pid


def end_left(processes: Iterable[int]) -> None:
    """Kill what programs have left, but for Python's tracker, which ends once it has removed what others left."""
    for process in list(processes):
        with contextlib.suppress(OSError):  # it has ended meanwhile
            if b"resource_tracker" not in _read(f"/proc/{process}/cmdline"):
                os.kill(process, signal.SIGKILL)


def _read(file: str) -> bytes:
    with FileIO(file) as content:  # `pathlib` would be a third of the time that `TIED` takes
        return content.read()


def _watch(parent: int, number: signal.Signals) -> None:
    while os.getppid() == parent:
        time.sleep(POLL_S)
    os.kill(os.getpid(), number)


def main(command: list[str]) -> None:
    """Become `command`."""
    for number in (signal.SIGTERM, signal.SIGINT):  # whatever it was that started this may ignore them
        signal.signal(number, signal.SIG_DFL)
    if sys.platform == "linux":  # elsewhere the thread would not survive
        signal_at_parent_death(signal.SIGKILL)  # nobody is left who could insist
    os.execv(command[0], command)


if __name__ == "__main__":
    main(sys.argv[1:])
