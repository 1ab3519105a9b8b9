"""Outbox: what the nodes of a process have enqueued for the emulator and the transport has not taken yet."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import count

from vnet.driving import Action
from vnet.reports import Report
from vnet.transport import wire
from vnet.transport.backbone import SentMessage
from vnet.transport.orders import Deviation


@dataclass
class Outbox:
    """Traffic in the order in which it was made, by kind."""

    frames: list[wire.Frame] = field(default_factory=list)
    reports: list[Report] = field(default_factory=list)
    endings: list[wire.Ending] = field(default_factory=list)
    notes: list[wire.Note] = field(default_factory=list)
    deviations: list[Deviation] = field(default_factory=list)
    actions: list[Action] = field(default_factory=list)
    messages: list[SentMessage] = field(default_factory=list)
    numbers: Iterator[int] = field(default_factory=count)
    """Numbers of messages of the backbone, of which no two are equal."""

    @property
    def has_any(self) -> bool:
        """True if there is anything that the emulator must be told at this instant."""
        return bool(self.frames or self.reports or self.endings or self.notes or self.actions or self.messages)

    def take(self, unhandled: Sequence[wire.Unhandled]) -> wire.Traffic:
        """Remove and return all of it, with exceptions that nobody handled."""
        frames, reports, endings, notes = self.frames, self.reports, self.endings, self.notes
        deviations, actions, messages = self.deviations, self.actions, self.messages
        self.frames, self.reports, self.endings, self.notes = [], [], [], []
        self.deviations, self.actions, self.messages = [], [], []
        return wire.Traffic(frames, reports, endings, unhandled, notes, deviations, actions, messages)
