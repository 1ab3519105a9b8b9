"""Effects of the acting faults of links and senders on frames and receptions.

`LinkFaults.update` takes the faults that act from now on and derives their `effects`, which are kept with every
frame that is enqueued while they act. Senders repeat their own frames, whose payloads the emulator does not read,
or send what a rule of the user's own says.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from emulator.fault_plan import PlannedFault, swizzle_times_ns
from emulator.radio.frames import Copied, CopyNumbers, Frame, Receptions, Transmission, random_flips
from emulator.radio.mac import Mac
from emulator.radio.outcomes import PENDING
from emulator.radio.own_rules import OwnRules, RuledLinks
from emulator.scenario.faults import (
    Corrupt,
    Custom,
    CustomSender,
    DataReplay,
    DelayFault,
    DoS,
    Duplicate,
    LossFault,
    Range,
    SenderFault,
    StaleMessages,
    Swizzle,
    Sybil,
    Throttle,
)
from emulator.scenario.random_streams import Draws
from vnet.types import Array, Mask
from vnet.units import NS_PER_MS, NS_PER_S

_Columns = slice | NDArray[np.intp]
"""Index that takes the columns of a frame's receptions from an array over all nodes (N,)."""
REMEMBERED_FRAMES = 4096
"""Frames kept of each affected sender, to be sent again."""


@dataclass
class _RandomFault:
    """A fault that draws for each reception. `bad` (N, N) is the state of a loss, by sender and receiver."""

    planned: PlannedFault
    draws: Draws
    bad: Mask = field(default_factory=lambda: np.zeros((0, 0), dtype=bool))


@dataclass(frozen=True)
class ActiveLinkFaults:
    """Effects of a set of acting faults on the frames that are enqueued meanwhile; implements `LinkEffects`.

    `cut` are a fault's number and the links (N, N) that it cuts; `shortened` are a fault's number, the affected
    nodes (N,) and their range in metres.
    """

    cut: Sequence[tuple[int, Mask]] = ()
    shortened: Sequence[tuple[int, Mask, float]] = ()
    losing: Sequence[_RandomFault] = ()
    delaying: Sequence[_RandomFault] = ()
    copying: Sequence[_RandomFault] = ()
    corrupting: Sequence[_RandomFault] = ()
    ruled: Sequence[RuledLinks] = ()

    @property
    def lose(self) -> bool:
        """True if any reception may be lost."""
        return bool(self.cut or self.shortened or self.losing or self.ruled)

    @property
    def change(self) -> bool:
        """True if a reception may arrive later, more than once, or with other bytes."""
        return bool(self.delaying or self.copying or self.corrupting or self.ruled)

    @property
    def copy(self) -> bool:
        """True if a reception may arrive more than once."""
        return bool(self.copying or self.ruled)

    def losses(self, sent: Transmission) -> Iterator[tuple[int, Mask]]:
        """Yield, in the order in which faults act, a fault's number and the columns (M,) that lose the frame."""
        frame = sent.frame
        at = frame.topology.receivers(frame.sender)
        for number, cut in self.cut:
            yield number, cut[frame.sender][at]
        for number, nodes, range_m in self.shortened:
            beyond = frame.topology.distance_m[frame.sender] > range_m
            yield number, beyond & (nodes[at] | nodes[frame.sender])
        for one in self.losing:
            yield one.planned.number, (_lost(one, frame) & _links(one)[frame.sender])[at]
        for ruled in self.ruled:
            yield ruled.planned.number, ruled.lost(sent)

    def changes(self, sent: Transmission, index: int, receptions: Receptions) -> None:
        """Delay, duplicate or alter the pending receptions of transmission number `index`."""
        frame = sent.frame
        pending = receptions.outcome[index] == PENDING
        at: _Columns = slice(None) if receptions.receiver is None else receptions.receiver[index]
        for one in self.delaying:
            draws, links = _drawn(one, frame, at)
            later = links & pending
            receptions.arrival_ns[index] += np.where(later, _extra_delay_ns(one.planned, draws), 0)
        for one in self.copying:
            fault = one.planned.fault
            assert isinstance(fault, Duplicate)
            draws, links = _drawn(one, frame, at)
            again = links & (draws < fault.probability)
            receptions.copies += [
                Copied(index, again, round((number + 1) * fault.delay_ms * NS_PER_MS), one.planned.number)
                for number in range(fault.copies)
            ]
        for one in self.corrupting:
            draws, links = _drawn(one, frame, at)
            _corrupt(one, frame, index, receptions, draws, pending & links)
        for ruled in self.ruled:
            ruled.change(sent, index, receptions)


class LinkFaults:
    """The acting link faults, and their present `effects`. It sets the throttled senders' bitrates in `mac`.

    `rules` are those of the user's own.
    """

    def __init__(self, seed: int, mac: Mac, count: int, rules: OwnRules) -> None:
        self._rules = rules
        self._seed = seed
        self._mac = mac
        self._count = count
        self._random: dict[int, _RandomFault] = {}
        self.effects = ActiveLinkFaults()

    def update(self, active: Sequence[PlannedFault], time_ns: int) -> None:
        """Let exactly these faults act from `time_ns` on."""
        random = {p.number: self._continued(p) for p in active if p.links is not None}
        self._random = random
        self.effects = ActiveLinkFaults(
            cut=[(p.number, cut) for p in active if (cut := self._cut_by(p, time_ns)) is not None],
            shortened=[(p.number, p.nodes, p.fault.range_m) for p in active if isinstance(p.fault, Range)],
            losing=_of_kind(random, LossFault),
            delaying=_of_kind(random, DelayFault),
            copying=_of_kind(random, Duplicate),
            corrupting=_of_kind(random, Corrupt),
            ruled=[self._ruled(p) for p in active if isinstance(p.fault, Custom)],
        )
        self._mac.throttle(self._throttled(active))

    def _continued(self, planned: PlannedFault) -> _RandomFault:
        """Return a fault with its state so far and its present links, or a new one."""
        one = self._random.get(planned.number)
        return self._started(planned) if one is None else dataclasses.replace(one, planned=planned)

    def _started(self, planned: PlannedFault) -> _RandomFault:
        bad = np.zeros((self._count, self._count) if isinstance(planned.fault, LossFault) else (0, 0), dtype=bool)
        return _RandomFault(planned, Draws(self._seed, f"fault {planned.draws_of}"), bad)

    def _ruled(self, planned: PlannedFault) -> RuledLinks:
        return RuledLinks(planned, Draws(self._seed, f"fault {planned.draws_of} bytes"), self._rules)

    def _cut_by(self, planned: PlannedFault, time_ns: int) -> Mask | None:
        """Return the mask (N, N) of the links that a fault cuts at `time_ns`; None if it cuts none."""
        if isinstance(planned.fault, Swizzle):
            off = np.zeros(self._count, dtype=bool)
            for node, off_ns, back_ns in swizzle_times_ns(planned, self._seed):
                off[node] = off_ns <= time_ns < back_ns
            return np.asarray(off[:, None] | off[None, :])
        return planned.links if planned.fault.cuts else None

    def _throttled(self, active: Sequence[PlannedFault]) -> dict[int, float]:
        """Return the bitrate in Mbit/s of each throttled sender: the lowest of those that apply."""
        slowest: dict[int, float] = {}
        for planned in active:
            if isinstance(planned.fault, Throttle):
                for node in np.flatnonzero(planned.nodes).tolist():
                    rate_mbps = planned.fault.bitrate_mbps
                    slowest[node] = min(rate_mbps, slowest.get(node, rate_mbps))
        return slowest


def _lost(one: _RandomFault, frame: Frame) -> Mask:
    fault, count = one.planned.fault, len(_links(one))
    draws = one.draws.uniform(frame.sender, frame.seq, 2 * count, frame.draw).reshape(-1, 2).T
    assert isinstance(fault, LossFault), fault
    return fault.lost(draws, one.bad[frame.sender])


def _drawn(one: _RandomFault, frame: Frame, at: _Columns) -> tuple[Array, Mask]:
    """Return a fault's draws (M,) for a frame and the mask (M,) of its links, at the columns that `at` takes."""
    links = _links(one)
    return one.draws.uniform(frame.sender, frame.seq, len(links), frame.draw)[at], links[frame.sender][at]


def _corrupt(
    one: _RandomFault, frame: Frame, index: int, receptions: Receptions, draws: Array, pending: Mask
) -> None:
    fault = one.planned.fault
    assert isinstance(fault, Corrupt)
    hit = pending & (draws < fault.probability)
    for column in np.flatnonzero(hit).tolist() if frame.size_bytes else ():
        # The draw, conditioned on being below the probability, seeds the altered bytes of each receiver.
        flips = random_flips(draws[column], frame.size_bytes, fault.flips)
        receptions.flips.setdefault((index, column), []).extend(flips)
        receptions.cause[index, column] = one.planned.number


def _links(one: _RandomFault) -> Mask:
    assert one.planned.links is not None
    return one.planned.links


def _of_kind(random: Mapping[int, _RandomFault], *kinds: type) -> list[_RandomFault]:
    return [one for one in random.values() if isinstance(one.planned.fault, kinds)]


def _extra_delay_ns(planned: PlannedFault, draws: Array) -> NDArray[np.int64]:
    assert isinstance(planned.fault, DelayFault), planned.fault
    return np.asarray(np.round(planned.fault.added_ms(draws) * NS_PER_MS), dtype=np.int64)


class SenderFaults:
    """The acting sender faults, and the frames that affected senders have sent.

    They number copies of frames among `copies`. `ask` returns the payloads that a rule of the user's own sends in
    place of a frame, none if it drops it.
    """

    def __init__(
        self, node_ids: Sequence[str], copies: CopyNumbers, ask: Callable[[PlannedFault, Frame], list[bytes]]
    ) -> None:
        self._ask = ask
        self._node_ids = node_ids
        self._copies = copies
        self._acting: dict[int, list[PlannedFault]] = {}
        self._sent: dict[int, deque[Frame]] = {}

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

    def frames(self, frame: Frame) -> Iterator[Frame]:
        """Yield all frames that are sent when a node enqueues one."""
        acting = self._acting.get(frame.sender, ())
        if acting:
            self._sent[frame.sender].append(frame)
        original = frame
        for planned in acting:
            if isinstance(planned.fault, StaleMessages) and (
                old := self._older(original, planned, planned.fault.age_s)
            ):
                frame = replace(_again(original, old), cause=planned.number)
        further: dict[int, list[bytes]] = {}
        for planned in acting:
            if isinstance(planned.fault, CustomSender) and not frame.dropped:
                sent = self._ask(planned, frame)
                further[planned.number] = sent[1:]
                if not sent:
                    frame = replace(frame, cause=planned.number, dropped=True)
                elif sent[0] != frame.payload:
                    frame = replace(frame, payload=sent[0], cause=planned.number)
        yield frame
        for planned in acting:
            for index, more in enumerate(further.get(planned.number, ()), start=1):
                yield self._copy(planned, replace(frame, payload=more), index)
            yield from self._repeated(planned, frame)

    def _repeated(self, planned: PlannedFault, frame: Frame) -> Iterator[Frame]:
        match planned.fault:
            case DoS(factor=factor):
                for index in range(1, factor):
                    yield self._copy(planned, frame, index)
            case Sybil(ghosts=ghosts):
                for ghost in range(1, ghosts + 1):
                    yield self._copy(planned, frame, ghost, f"~{ghost}")
            case DataReplay(age_s=age_s):
                if old := self._older(frame, planned, age_s):
                    yield self._copy(planned, replace(_again(frame, old), seq=old.seq), frame.seq - old.seq)

    def _copy(self, planned: PlannedFault, frame: Frame, index: int, suffix: str = "") -> Frame:
        """Return another copy of a frame; `index` distinguishes the copies that one fault makes of it."""
        return replace(
            frame,
            copy=self._copies.next(frame.sender, frame.seq),
            draw=(planned.draws_of + 1 << 32) + index,
            cause=planned.number,
            name=self._node_ids[frame.sender] + suffix,
            dropped=False,
            ticket=0,
        )

    def _older(self, frame: Frame, planned: PlannedFault, age_s: float) -> Frame | None:
        """Return the latest frame of a frame's sender, since a fault began, that is `age_s` older, or None."""
        before_ns = frame.sent_ns - round(age_s * NS_PER_S)
        old = next((sent for sent in reversed(self._sent[frame.sender]) if sent.sent_ns <= before_ns), None)
        return old if old is not None and old.sent_ns >= planned.start_ns else None


def _again(frame: Frame, old: Frame) -> Frame:
    """Return a frame that is an older one, sent again now: its payload, power, bit rate and addressee."""
    return replace(frame, payload=old.payload, gain_db=old.gain_db, bitrate_mbps=old.bitrate_mbps, to=old.to)
