"""`logs/NODE.log` of simulated nodes: what a process of its own would have written there, bounded in size."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from emulator.records.atomic import disk_errors

LARGEST_LOG_BYTES = 10_000_000
"""Bytes that are kept of a node's log, so that a flood fills no disk."""


class NodeLogs:
    """The logs of nodes in the folder `logs`. Raises VnetError where the disk refuses."""

    def __init__(self, logs: Path) -> None:
        self._logs = logs
        self._bytes: Counter[str] = Counter()

    def write(self, node: str, text: str) -> None:
        """Append a line, or say once that the log is full."""
        before = self._bytes[node]
        self._bytes[node] += len(text.encode(errors="replace")) + 1
        if before > LARGEST_LOG_BYTES:
            return
        if self._bytes[node] > LARGEST_LOG_BYTES:
            text = f"(the log is full: further lines are left out after {LARGEST_LOG_BYTES:,} bytes)"
        with (
            disk_errors(self._logs),
            (self._logs / f"{node}.log").open("a", encoding="utf-8", errors="replace") as file,
        ):
            file.write(f"{text}\n")
