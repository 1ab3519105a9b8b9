"""Logs of nodes. A record of the standard `logging` becomes a line of the node on whose behalf it is made."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

from vnet.node import Node
from vnet.runtime.current_node import present_node
from vnet.units import NS_PER_S

LONGEST_NOTE = 4000
"""Characters of a line that are told to the emulator."""
MOST_LINES = 100_000
"""Lines of a node's log that are written by one process, so that a flood fills no disk."""


class NodeLogHandler(logging.Handler):
    """Hands records to `write`, with the node on whose behalf they are made and their level.

    Records on nobody's behalf, and asyncio's own, go the way of `logging.lastResort`, as without this handler.
    """

    def __init__(self, write: Callable[[Node, str, str], None]) -> None:
        super().__init__()
        self._write = write

    def createLock(self) -> None:
        """Make no lock: `write` needs none, and may wait for the emulator while others log."""
        self.lock = None

    def handle(self, record: logging.LogRecord) -> Any:
        """Take a record unless a filter refuses it; from Python 3.13 on logging's own method needs a lock."""
        kept = self.filter(record)
        if kept:
            self.emit(kept if isinstance(kept, logging.LogRecord) else record)
        return kept

    def emit(self, record: logging.LogRecord) -> None:
        """Take a record."""
        node = present_node()
        if node is None or record.name == "asyncio":
            last = logging.lastResort
            alone = logging.getLogger().handlers == [self]
            if alone and last is not None and record.levelno >= last.level:
                last.handle(record)
        else:
            try:
                self._write(node, level_name(record.levelno), f"{record.name}: {self.format(record)}")
            except Exception:
                self.handleError(record)


class NodeLines:
    """Lines of nodes' logs, with their emulated time, up to `MOST_LINES` of each node."""

    def __init__(self, write: Callable[[str, str], None]) -> None:
        self._write = write
        self._count: Counter[str] = Counter()

    def add(self, node: str, time_ns: int, kind: str, level: str, text: str, details: Mapping[str, object]) -> None:
        """Write a line of a program, or an event with its details, to a node's log, unless there were too many."""
        said = ", ".join(f"{key}={value}" for key, value in details.items()).replace("\n", "\\n")
        line = f"{'' if kind == 'log' else 'event '}{text} {said}".rstrip().replace("\n", "\n    ")
        self._count[node] += 1
        if self._count[node] <= MOST_LINES:
            self._write(node, f"{time_ns / NS_PER_S:.6f} {node} {level}: {line}")
        elif self._count[node] == MOST_LINES + 1:
            self._write(node, f"(further lines of {node} are left out after {MOST_LINES:,})")


_NAMES = (
    (logging.CRITICAL, "critical"),
    (logging.ERROR, "error"),
    (logging.WARNING, "warning"),
    (logging.INFO, "info"),
)


def level_name(number: int) -> str:
    """Return the level that `Node.log` has for one of `logging`."""
    return next((name for least, name in _NAMES if number >= least), "debug")
