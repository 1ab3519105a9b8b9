"""Ending a process together with its process group: what a program has forked ends with its vehicle.

A group is killed between the end of its first process and the call that forgets it: until then no other process can
get its id. A descendant that has left the group, as a session of its own does, is not reached.
"""

from __future__ import annotations

import os
import select
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress


def has_ended(pid: int) -> bool:
    """Return whether a child of this process has ended, or is none (any more); does not forget it."""
    try:
        return os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None
    except ChildProcessError:
        return True


def wait_until_ended(pid: int, timeout_s: float | None) -> None:
    """Wait for the end of a child of this process that nobody has waited for yet, at most so many seconds."""
    descriptor = os.pidfd_open(pid)
    try:
        poll = select.poll()
        poll.register(descriptor, select.POLLIN)
        poll.poll(None if timeout_s is None else timeout_s * 1000)
    finally:
        os.close(descriptor)


@contextmanager
def rest_of_group_ended(pid: int) -> Iterator[None]:
    """Kill the group of a process that has ended; the block waits for the process itself.

    Those of the group that this process has adopted are waited for.
    """
    with suppress(ProcessLookupError, PermissionError):  # it has ended before it had a group
        os.killpg(pid, signal.SIGKILL)
    yield
    with suppress(ChildProcessError):
        while True:
            os.waitpid(-pid, 0)


class GroupProcess(subprocess.Popen[bytes]):
    """A process started in a group of its own, which ends with it."""

    def poll(self) -> int | None:
        """Return the exit status (minus the signal's number), or None while it runs."""
        if self.returncode is None and has_ended(self.pid):
            with rest_of_group_ended(self.pid):
                super().poll()
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end, at most so many seconds. Raises subprocess.TimeoutExpired."""
        if self.poll() is None:
            wait_until_ended(self.pid, timeout)
        status = self.poll()
        if status is None:
            raise subprocess.TimeoutExpired(self.args, timeout or 0.0)
        return status
