"""Sender faults: senders that repeat their own frames, whose payloads the emulator does not read, or send what a
rule of the user's own says."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from emulator.faults.plan import PlannedFault
from emulator.radio.choices import Choices
from emulator.radio.frames import NO_CAUSE
from emulator.scenario.faults import CustomSender, DataReplay, DoS, SenderFault, StaleMessages, Sybil
from vnet.units import NS_PER_S

REMEMBERED_FRAMES = 4096
"""Frames kept of each affected sender, to be sent again."""


class _Sent(NamedTuple):
    """A frame that an affected sender has sent."""

    time_ns: int
    seq: int
    payload: bytes
    choices: Choices


@dataclass(frozen=True, slots=True)
class Outgoing:
    """A frame before it is enqueued: copy number `copy` of frame `seq`, sent under the name `alias` if it is set.

    `choices` are power, bit rate and addressee, those of the frame that is sent again if it is an older one. `draw`
    distinguishes its random draws from those of the other copies. The frame is recorded, but never sent, if the
    fault `cause` has `dropped` it.
    """

    payload: bytes
    seq: int
    choices: Choices
    copy: int = 0
    draw: int = 0
    cause: int = NO_CAUSE
    alias: str | None = None
    dropped: bool = False


class SenderFaults:
    """The acting sender faults, and the frames that affected senders have sent.

    `next_copy` numbers the copies of (sender, seq). `ask` returns the payloads that a rule of the user's own sends
    in place of a frame, none if it drops it: of a fault, at a time in ns, by a sender.
    """

    def __init__(
        self,
        node_ids: Sequence[str],
        next_copy: Callable[[int, int], int],
        ask: Callable[[PlannedFault, int, int, Outgoing], list[bytes]],
    ) -> None:
        self._ask = ask
        self._node_ids = node_ids
        self._next_copy = next_copy
        self._acting: dict[int, list[PlannedFault]] = {}
        self._sent: dict[int, deque[_Sent]] = {}

    @property
    def misbehave(self) -> bool:
        """True if any sender fault acts."""
        return bool(self._acting)

    def update(self, active: Sequence[PlannedFault]) -> None:
        """Let exactly these faults act from now on."""
        self._acting = {}
        for planned in active:
            if isinstance(planned.fault, SenderFault):
                for node in np.flatnonzero(planned.nodes).tolist():
                    self._acting.setdefault(node, []).append(planned)
        self._sent = {node: self._sent.get(node, deque(maxlen=REMEMBERED_FRAMES)) for node in self._acting}

    def frames(self, time_ns: int, node: int, original: Outgoing) -> Iterator[Outgoing]:
        """Yield all frames that are sent when `node` enqueues one."""
        acting = self._acting.get(node)
        if not acting:
            yield original
            return
        seq, choices = original.seq, original.choices
        self._sent[node].append(_Sent(time_ns, seq, original.payload, choices))
        for planned in acting:
            if isinstance(planned.fault, StaleMessages) and (old := self._from(node, time_ns, planned.fault.age_s)):
                again = old.choices._replace(ticket=choices.ticket)
                original = Outgoing(old.payload, seq, again, cause=planned.number)
        further: dict[int, list[bytes]] = {}
        for planned in acting:
            if isinstance(planned.fault, CustomSender) and not original.dropped:
                sent = self._ask(planned, time_ns, node, Outgoing(original.payload, seq, original.choices))
                further[planned.number] = sent[1:]
                if not sent:
                    original = replace(original, cause=planned.number, dropped=True)
                elif sent[0] != original.payload:
                    original = replace(original, payload=sent[0], cause=planned.number)
        yield original
        for planned in acting:
            for index, more in enumerate(further.get(planned.number, ()), start=1):
                yield self._copy(planned, node, replace(original, payload=more), index)
            yield from self._again(planned, time_ns, node, original)

    def _again(self, planned: PlannedFault, time_ns: int, node: int, original: Outgoing) -> Iterator[Outgoing]:
        match planned.fault:
            case DoS(factor=factor):
                for index in range(1, factor):
                    yield self._copy(planned, node, original, index)
            case Sybil(ghosts=ghosts):
                for ghost in range(1, ghosts + 1):
                    yield self._copy(planned, node, original, ghost, f"{self._node_ids[node]}~{ghost}")
            case DataReplay(age_s=age_s):
                if old := self._from(node, time_ns, age_s):
                    again = Outgoing(old.payload, old.seq, old.choices)
                    yield self._copy(planned, node, again, original.seq - old.seq)

    def _copy(
        self, planned: PlannedFault, node: int, frame: Outgoing, index: int, alias: str | None = None
    ) -> Outgoing:
        """Return another copy of a frame; `index` distinguishes the copies that one fault makes of it."""
        draw = (planned.number + 1 << 32) + index
        copy = self._next_copy(node, frame.seq)
        return Outgoing(frame.payload, frame.seq, frame.choices, copy, draw, planned.number, alias)

    def _from(self, node: int, time_ns: int, age_s: float) -> _Sent | None:
        """Return the latest frame of `node` that is at least `age_s` old, or None."""
        before_ns = time_ns - round(age_s * NS_PER_S)
        return next((sent for sent in reversed(self._sent[node]) if sent.time_ns <= before_ns), None)
