"""A child process for a simulation's programs: what ends it, such as a fatal signal, does not end the command."""

from __future__ import annotations

import mmap
import os
import shutil
import signal
import sys
import threading
from pathlib import Path
from types import FrameType

from vnet.runtime import interrupts, running_node
from vnet.runtime.die_with_parent import signal_at_parent_death

LONGEST_PATH = 4096
"""Bytes of the path of a run's folder."""
FORWARDED = (signal.SIGINT, signal.SIGTERM)
FROM_TERMINAL = 0x80
"""`si_code` of a signal that the kernel sends, as Ctrl-C does to the child, too (SI_KERNEL)."""


class OwnChild:
    """A child of this process that goes on in its place, until a vehicle ends it."""

    def __init__(self) -> None:
        self._folder = mmap.mmap(-1, LONGEST_PATH)

    def told(self, folder: Path) -> None:
        """Take note of the folder that the run has made."""
        self._folder[:] = os.fsencode(folder.absolute()).ljust(LONGEST_PATH, b"\0")

    def fork(self) -> str | None:
        """Return None in the child, and in the parent the vehicle that has ended it; its folder is removed.

        Where no vehicle has, the parent ends as the child did.
        """
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        handled = (*FORWARDED, signal.SIGCHLD)
        handler = signal.signal(signal.SIGCHLD, _ignore)  # one that is ignored would not be told
        before = signal.pthread_sigmask(signal.SIG_BLOCK, handled)
        child = os.fork()
        if child == 0:
            signal_at_parent_death(signal.SIGKILL)
            signal.signal(signal.SIGCHLD, handler)
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            return None
        forwarded: set[int] = set()
        while True:
            waited, status = os.waitpid(child, os.WNOHANG)
            if waited:
                break
            told = signal.sigwaitinfo(handled)
            if told.si_signo != signal.SIGCHLD:
                forwarded.add(told.si_signo)
                if told.si_code != FROM_TERMINAL:
                    os.kill(child, told.si_signo)
        forwarded |= signal.sigpending() & set(FORWARDED)
        signal.signal(signal.SIGCHLD, handler)
        vehicle, ended = running_node.running.read(), os.waitstatus_to_exitcode(status)
        if vehicle and not forwarded and ended != -signal.SIGKILL:  # which the system sends if memory is short
            running_node.running.show("")
            if folder := self._folder[:].rstrip(b"\0"):
                shutil.rmtree(os.fsdecode(folder), ignore_errors=True)
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            return vehicle
        if ended < 0:
            if -ended != signal.SIGKILL:
                signal.signal(-ended, signal.SIG_DFL)
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {-ended})
            os.kill(os.getpid(), -ended)
        return interrupts.exit_now(ended)


def _ignore(number: int, frame: FrameType | None) -> None:
    pass


def may_fork() -> bool:
    """Return whether this process is a command's own, with nothing in it that a child would disturb."""
    tools = getattr(sys, "monitoring", None)  # of Python 3.12
    watched = sys.gettrace() or sys.getprofile() or (tools and any(map(tools.get_tool, range(6))))
    return sys.platform == "linux" and _is_commands_own and not watched and threading.active_count() == 1


_is_commands_own = False


def this_process_is_a_command() -> None:
    """Take note that this process runs one command, and ends."""
    global _is_commands_own
    _is_commands_own = True
