"""Failures of programs by their kind: one line a kind, however many vehicles it befell."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from emulator.records.events import GROUPED, Event, EventKind

_FRAME = re.compile(r'^ *File "(.*)", line (\d+)', re.MULTILINE)


@dataclass(frozen=True)
class Kind:
    """Failures of one kind: events in the order of their instants."""

    events: tuple[Event, ...]

    @property
    def first(self) -> Event:
        """The first of them."""
        return self.events[0]

    @property
    def nodes(self) -> list[str]:
        """Ids of the vehicles that it befell, each once."""
        return list(dict.fromkeys(str(event.node) for event in self.events))

    @property
    def who(self) -> str:
        """The vehicle, or how many there are."""
        return self.nodes[0] if len(self.nodes) == 1 else f"{len(self.nodes)} vehicles"

    @property
    def when(self) -> str:
        """The instant, or that of the first one."""
        instant = f"at {shown_s(self.first.time_ns)}"
        if self.first.kind == EventKind.exception:
            return instant if len(self.events) == 1 else f"first {instant}"
        return instant if len({event.time_ns for event in self.events}) == 1 else f"first {instant}"

    @property
    def untimed(self) -> str:
        """The kind in one line without its instant."""
        ended = "" if self.first.kind == EventKind.exception else f" {self.first.kind}"
        return f"{self.who}{ended}: {self.first.why}"

    def __str__(self) -> str:
        if self.first.kind == EventKind.exception:
            return f"{self.untimed}, {self.when}"
        comma = "," if self.when.startswith("first") else ""
        return f"{self.who} {self.first.kind}{comma} {self.when}: {self.first.why}"


def shown_s(time_ns: int) -> str:
    """Return an instant in seconds, to the millisecond, without zeros that say nothing."""
    return f"{round(time_ns / 1e9, 3)} s"


def in_words(kinds: Sequence[Kind], most: int = 5) -> str:
    """Return the first kinds in one line."""
    return "; ".join([*map(str, kinds[:most]), *(["…"] if len(kinds) > most else [])])


def merged(events: Iterable[Event]) -> list[Event]:
    """Return the events with one for each kind of failure, which names how many vehicles it befell."""
    by_kind: dict[tuple[str, ...] | int, list[Event]] = {}
    for number, event in enumerate(events):
        by_kind.setdefault(key_of(event) if event.has(GROUPED) else number, []).append(event)
    return [replace(each[0], node=Kind(tuple(each)).who) if len(each) > 1 else each[0] for each in by_kind.values()]


def kinds_of(events: Iterable[Event]) -> list[Kind]:
    """Sort failures into their kinds: the same type of error, raised in the same line."""
    kinds: dict[tuple[str, ...], list[Event]] = {}
    for event in sorted(events, key=lambda event: event.time_ns):
        kinds.setdefault(key_of(event), []).append(event)
    return [Kind(tuple(events)) for events in kinds.values()]


def key_of(event: Event) -> tuple[str, ...]:
    """Return what failures of one kind have in common."""
    error = str(event.details.get("error") or event.details.get("how", ""))
    place = str(event.details.get("place") or _last_line(str(event.details.get("where", ""))))
    return event.kind, error.partition(":")[0], place


def _last_line(trace: str) -> str:
    """File and line of the innermost frame of a traceback."""
    frames = _FRAME.findall(trace)
    return f"{Path(frames[-1][0]).name}:{frames[-1][1]}" if frames else ""
