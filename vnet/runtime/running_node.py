"""Name of the node whose code runs, in memory shared with the parent process: it outlives a process that dies."""

from __future__ import annotations

import math
import mmap
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

LONGEST_ID = 64
"""Characters of a node's id."""
LOOK_S = 0.5
"""Time between two looks at what runs in another process, in s of wall clock."""


class RunningNode:
    """The node whose code runs in this process; processes that are forked from it later write to the same place.

    `file` is the descriptor of that place, of `LONGEST_ID` + 1 bytes, where a process that is not forked reads it:
    the last one counts what is written, so that a node that runs on can be told from one that runs again.
    """

    def __init__(self, file: int = -1) -> None:
        self._memory = mmap.mmap(file, LONGEST_ID + 1)
        self._count = 0
        self._shown = ""
        self._written: dict[str, bytes] = {}
        """The bytes that stand for each node."""

    def show(self, node: str) -> None:
        """Write down that this node's code runs; "" is nobody's."""
        if node != self._shown:
            self._shown = node
            if (written := self._written.get(node)) is None:
                written = self._written[node] = node.encode().ljust(LONGEST_ID, b"\0")[:LONGEST_ID]
            self._memory[:LONGEST_ID] = written
            self._memory[LONGEST_ID] = self._count = (self._count + 1) & 255

    @contextmanager
    def pause(self) -> Iterator[None]:
        """Have nobody's code run within the block, which may wait for who reads the output."""
        node = self._shown
        self.show("")
        try:
            yield
        finally:
            if not self._shown:  # else the program's threads go on beside its loop
                self.show(node)

    def read(self) -> str:
        """Return what was written down last, by any process."""
        return self._memory[:LONGEST_ID].rstrip(b"\0").decode(errors="replace")

    def seen(self) -> bytes:
        """Return what is different once another node's code has run, or the same node's again."""
        return self._memory[:]


class Patience:
    """Patience with a node whose code runs on and on: looks each `LOOK_S` until nothing is different for `limit_s`.

    Looks are counted, and not the time between them: a process that was stopped (Ctrl-Z) has not stalled. At a
    terminal a process that waits may wait for its user, as in `breakpoint()`.
    """

    def __init__(self, running: RunningNode, limit_s: float, has_user: bool | None = None) -> None:
        self._running = running
        self._most = math.ceil(limit_s / LOOK_S)
        self._has_user = sys.stdin is not None and sys.stdin.isatty() if has_user is None else has_user
        self._seen, self._looks = b"", 0

    def is_over(self, pid: int) -> bool:
        """Look at the process; return whether a node's code has run for `limit_s`."""
        seen = self._running.seen()
        runs_on = seen == self._seen and self._running.read() and not (self._has_user and _waits(pid))
        self._looks, self._seen = (self._looks + 1 if runs_on else 0), seen
        return self._looks >= self._most


def _waits(pid: int) -> bool:
    """Return whether the main thread of a process neither computes nor has ended."""
    with suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] in "SD"
    return False


running = RunningNode()
"""The node whose code runs on this process's loops."""
