"""A child process for a simulation's programs: what ends it, such as a fatal signal, does not end the command."""

from __future__ import annotations

import mmap
import os
import shutil
import signal
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import NoReturn

from vnet.runtime import interrupts, running_node
from vnet.runtime.die_with_parent import adoption, end_left, signal_at_parent_death, started_processes
from vnet.runtime.running_node import LOOK_S, Patience

LONGEST_PATH = 4096
"""Bytes of the path of a run's folder."""
FORWARDED = (signal.SIGINT, signal.SIGTERM)
AGAIN_S = 1.0
"""Least time after which a second SIGTERM is a new one: `timeout` sends it to the command, and to its group."""
FROM_TERMINAL = 0x80
"""`si_code` of a signal that the kernel sends, as Ctrl-C does to all of the terminal's foreground (SI_KERNEL)."""


class OwnChild:
    """A child of this process that goes on in its place, until a vehicle ends it."""

    def __init__(self) -> None:
        self._folder = mmap.mmap(-1, LONGEST_PATH)
        self.ending = "ended"
        """Word for its end: by a vehicle "ended" or "stalled", by a second SIGTERM "terminated"."""

    def told(self, folder: Path) -> None:
        """Take note of the folder that the run has made; of none, that all is done."""
        self._folder[:] = os.fsencode(folder.absolute() if folder.name else "").ljust(LONGEST_PATH, b"\0")

    def fork(self, stall_limit_s: float) -> str | None:
        """Return None in the child, and in the parent the vehicle that has ended it, "" if unknown.

        The folder of its run is then removed. Where no vehicle has, the parent ends as the child did. A vehicle
        whose code runs for `stall_limit_s` without a pause ends it, too: after Ctrl-C as a second one would.
        """
        from emulator.records.run_folder import MANIFEST_FILE  # slow to import, and --help does without

        sys.stdout.flush()
        sys.stderr.flush()
        in_foreground = interrupts.is_in_foreground()
        heeded = [each for each in FORWARDED if signal.getsignal(each) is not signal.SIG_IGN]
        handled = (*heeded, signal.SIGCHLD)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)  # whoever started this may ignore it
        before = signal.pthread_sigmask(signal.SIG_BLOCK, handled)
        adopts = adoption.begin()
        others = {*started_processes(os.getpid())}  # of whoever has become this command, as a shell by exec
        child = os.fork()
        if child == 0:
            if not in_foreground:  # what is sent to the parent's group would reach it twice
                os.setpgid(0, 0)
                signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in the background of a shell
            signal.signal(signal.SIGHUP, signal.SIG_IGN)  # the parent interrupts it
            signal_at_parent_death(signal.SIGKILL)
            _leaving.append(self)
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            return None
        forwarded: set[int] = set()
        insists, terminated_s = False, 0.0
        patience, look_s = Patience(running_node.running, stall_limit_s), time.monotonic() + LOOK_S
        while (status := _ended(child)) is None:
            told = signal.sigtimedwait(handled, max(0.0, look_s - time.monotonic()))
            if told is None:
                look_s = time.monotonic() + LOOK_S
                if not patience.is_over(child):
                    continue
                if forwarded and not insists:
                    insists, patience = True, Patience(running_node.running, stall_limit_s)
                    os.kill(child, signal.SIGINT)  # the second one ends it at once
                else:
                    self.ending = "stalled"
                    os.kill(child, signal.SIGKILL)
            elif told.si_signo in FORWARDED:
                if told.si_signo == signal.SIGTERM and signal.SIGTERM in forwarded:
                    if time.monotonic() < terminated_s + AGAIN_S:
                        continue
                    self.ending = "terminated"
                    os.kill(child, signal.SIGKILL)  # it does not end, as where its main thread has
                if told.si_signo == signal.SIGTERM:
                    terminated_s = time.monotonic()
                forwarded.add(told.si_signo)
                if not in_foreground or told.si_code != FROM_TERMINAL:
                    os.kill(child, signal.SIGINT)  # SIGTERM in it is one that a program sends itself
        forwarded |= signal.sigpending() & set(heeded)
        end_left(started_processes(os.getpid(), others))
        if adopts:
            adoption.end()
        vehicle, folder = running_node.running.read(), os.fsdecode(self._folder[:].rstrip(b"\0"))
        ended = os.waitstatus_to_exitcode(status)
        # With its folder still noted, it has not left by `leave`. SIGKILL is the system's if memory is short. Once
        # all files are written, a fatal signal while no vehicle's code runs takes nothing from the run.
        is_over = not vehicle and ended < 0 and (Path(folder) / MANIFEST_FILE).exists()
        by_vehicle = self.ending == "stalled" or (ended != -signal.SIGKILL and not is_over)
        if (vehicle or folder) and by_vehicle and not forwarded:
            running_node.running.show("")
            shutil.rmtree(folder, ignore_errors=True)
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            return vehicle
        if self.ending == "stalled":
            sys.stderr.write(f"vnet: {vehicle} does not end, and is killed: the run has no verdict\n")
            sys.stderr.flush()
            return interrupts.exit_now(interrupts.INTERRUPTED)
        if self.ending == "terminated":
            ended = -signal.SIGTERM
        if ended < 0:
            if -ended != signal.SIGKILL:
                signal.signal(-ended, signal.SIG_DFL)
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {-ended})
            os.kill(os.getpid(), -ended)
        return interrupts.exit_now(ended)


def _ended(child: int) -> int | None:
    """Forget children that have ended, orphans of programs among them; return the status of `child` if it has."""
    while (ended := os.waitpid(-1, os.WNOHANG))[0]:
        if ended[0] == child:
            return ended[1]
    return None


_leaving: list[OwnChild] = []
"""The child that this process is, if it is one."""


def leave(status: int) -> NoReturn:
    """End this process. A child of a command ends at once: `atexit` and threads of programs are not waited for."""
    if not _leaving:
        sys.exit(status)
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()
    _leaving[0].told(Path())
    interrupts.exit_now(status)


def may_fork() -> bool:
    """Return whether this process is a command's own, with nothing in it that a child would disturb."""
    tools = getattr(sys, "monitoring", None)  # of Python 3.12
    watched = sys.gettrace() or sys.getprofile() or (tools and any(map(tools.get_tool, range(6))))
    return sys.platform == "linux" and _is_commands_own and not watched and threading.active_count() == 1


_is_commands_own = False


def this_process_is_a_command() -> None:
    """Take note that this process runs one command, and ends; when its terminal is closed as by SIGTERM."""
    global _is_commands_own
    _is_commands_own = True
    if signal.getsignal(signal.SIGHUP) is signal.SIG_DFL:  # not with `nohup`
        signal.signal(signal.SIGHUP, lambda number, frame: os.kill(os.getpid(), signal.SIGTERM))
