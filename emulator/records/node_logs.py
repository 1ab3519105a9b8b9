"""Logs of nodes: what programs print, up to a bound, whether the run writes it or their processes do."""

from __future__ import annotations

import threading
from collections import Counter
from contextlib import suppress
from pathlib import Path

from emulator.records.atomic import disk_errors

LARGEST_LOG_BYTES = 10_000_000
"""Bytes that are kept of a node's log, so that a flood fills no disk."""

LONGEST_HELD = 10_000
"""Characters that are held back of a line that has no end."""


def log_is_full() -> str:
    """Return the last line of a log that is full."""
    return f"(the log is full: further lines are left out after {LARGEST_LOG_BYTES:,} bytes)\n"


def cut_log(path: Path) -> None:
    """Cut a log that a process writes by itself, which must have it open for appending, if it is full."""
    with suppress(OSError):  # a full disk, or a log that is gone
        if path.stat().st_size <= LARGEST_LOG_BYTES:
            return
        with path.open("r+b") as file:
            file.seek(LARGEST_LOG_BYTES - 1)
            end = file.read(1)
            file.seek(LARGEST_LOG_BYTES)
            file.write(b"\n" * (end != b"\n") + log_is_full().encode())
            file.truncate()  # last: what the process writes meanwhile goes, too


class NodeLogs:
    """The logs of nodes in the folder `logs`. Raises VnetError where the disk refuses."""

    def __init__(self, logs: Path) -> None:
        self._logs = logs.absolute()
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
            text = log_is_full()
        with (
            disk_errors(self._logs),
            (self._logs / f"{node}.log").open("a", encoding="utf-8", errors="replace") as file,
        ):
            file.write(text)
