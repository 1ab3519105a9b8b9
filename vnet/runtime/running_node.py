"""Name of the node whose code runs, in memory shared with the parent process: it outlives a process that dies."""

from __future__ import annotations

import mmap

LONGEST_ID = 64
"""Characters of a node's id."""


class RunningNode:
    """The node whose code runs in this process; processes that are forked from it later write to the same place.

    `file` is the descriptor of that place, of `LONGEST_ID` bytes, where a process that is not forked reads it.
    """

    def __init__(self, file: int = -1) -> None:
        self._memory = mmap.mmap(file, LONGEST_ID)
        self._shown = ""
        self._written: dict[str, bytes] = {}
        """The bytes that stand for each node."""

    def show(self, node: str) -> None:
        """Write down that this node's code runs; "" is nobody's."""
        if node != self._shown:
            self._shown = node
            if (written := self._written.get(node)) is None:
                written = self._written[node] = node.encode().ljust(LONGEST_ID, b"\0")[:LONGEST_ID]
            self._memory[:] = written

    def read(self) -> str:
        """Return what was written down last, by any process."""
        return self._memory[:].rstrip(b"\0").decode(errors="replace")


running = RunningNode()
"""The node whose code runs on this process's loops."""
