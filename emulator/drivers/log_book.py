"""Exceptions, events and log lines of programs, written to `events.jsonl` in an order that no driver changes."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping

from emulator.records.events import EventKind
from emulator.records.run_folder import RunFolder
from vnet.transport import wire

MOST_EXCEPTIONS = 20
"""Unhandled exceptions of a node that are written down, with their tracebacks; further ones are counted."""
MOST_NOTES = 1000
"""Log lines of a node that are written down, and as many of its events; further ones are counted."""
MOST = {"exception": MOST_EXCEPTIONS, "log": MOST_NOTES, "event": MOST_NOTES}
LONGEST_TEXT = 4000
"""Characters of a text that are written down."""
MOST_DETAILS = 50
"""Details of an event that are written down."""


class LogBook:
    """Writes what programs tell into the run's folder. `number` has the nodes in their order."""

    def __init__(self, folder: RunFolder, number: Mapping[str, int]) -> None:
        self._folder = folder
        self._number = number
        self._counts: Counter[tuple[str, str]] = Counter()

    def tell(self, time_ns: int, notes: Iterable[wire.Note], unhandled: Iterable[wire.Unhandled]) -> None:
        """Write down what came at `time_ns`, each at its own instant."""
        for note in sorted(notes, key=lambda note: (note.time_ns, self._number[note.node])):
            if self._fits(note.node, note.kind):
                self._write(min(time_ns, note.time_ns), note)
        raised = [(time_ns if each.time_ns is None else min(time_ns, each.time_ns), each) for each in unhandled]
        for raised_ns, each in sorted(raised, key=lambda pair: (pair[0], self._number[pair[1].node])):
            if self._fits(each.node, EventKind.exception):
                details = {"error": each.error[:LONGEST_TEXT], "place": each.place, "where": each.details}
                self._folder.event(raised_ns, EventKind.exception, each.node, **details)

    def _fits(self, node: str, kind: str) -> bool:
        self._counts[node, kind] += 1
        return self._counts[node, kind] <= MOST[kind]

    def _write(self, time_ns: int, note: wire.Note) -> None:
        text = note.text[:LONGEST_TEXT]
        if note.kind == "log":
            self._folder.event(time_ns, EventKind.log, note.node, level=note.level, text=text)
            return
        details = {key: _plain(value) for key, value in list(note.details.items())[:MOST_DETAILS]}
        self._folder.event(time_ns, EventKind.event, note.node, name=text, details=details)

    def tell_left_out(self, time_ns: int) -> None:
        """Write down how much of each kind is missing of each node, because there was too much."""
        for (node, kind), count in sorted(self._counts.items(), key=lambda item: self._number[item[0][0]]):
            if count > MOST[kind]:
                self._folder.event(time_ns, EventKind.left_out, node, what=kind, count=count - MOST[kind])


def _plain(value: bool | int | float | str) -> bool | int | float | str:
    """A value that JSON has: bounded texts, finite numbers."""
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value[:LONGEST_TEXT] if isinstance(value, str) else value
