"""`logs/NODE.log` of simulated nodes: what a process of its own would have written there, bounded in size."""

from __future__ import annotations

import threading
from collections import Counter
from pathlib import Path

from emulator.records.atomic import disk_errors

LARGEST_LOG_BYTES = 10_000_000
"""Bytes that are kept of a node's log, so that a flood fills no disk."""

LONGEST_HELD = 10_000
"""Characters that are held back of a line that has no end."""


class NodeLogs:
    """The logs of nodes in the folder `logs`. Raises VnetError where the disk refuses."""

    def __init__(self, logs: Path) -> None:
        self._logs = logs
        self._bytes: Counter[str] = Counter()
        self._begun: dict[str, str] = {}
        self._lock = threading.RLock()  # threads of programs print

    def write(self, node: str, text: str) -> None:
        """Append a line, or say once that the log is full."""
        self.add(node, f"{text}\n")

    def add(self, node: str, text: str) -> None:
        """Append a text as it is; the beginning of a line is held back until there is more of it."""
        with self._lock:
            text = self._begun.pop(node, "") + text
            if len(text) < LONGEST_HELD:
                whole, newline, begun = text.rpartition("\n")
                text = whole + newline
                if begun:
                    self._begun[node] = begun
            if text:
                self._append(node, text)

    def end_lines(self) -> None:
        """Write what is held back."""
        for node in list(self._begun):
            self.add(node, "\n")

    def _append(self, node: str, text: str) -> None:
        before = self._bytes[node]
        self._bytes[node] += len(text.encode(errors="replace"))
        if before > LARGEST_LOG_BYTES:
            return
        if self._bytes[node] > LARGEST_LOG_BYTES:
            text = f"(the log is full: further lines are left out after {LARGEST_LOG_BYTES:,} bytes)\n"
        with (
            disk_errors(self._logs),
            (self._logs / f"{node}.log").open("a", encoding="utf-8", errors="replace") as file,
        ):
            file.write(text)
