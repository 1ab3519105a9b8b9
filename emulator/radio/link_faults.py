"""What the acting faults do to the channel: which pairs they lose, and what else they change on the way.

`LinkFaults.update` is told which faults act and makes of them the `effects` of that time, which every frame keeps
that is handed over while they last.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from emulator.faults.plan import PlannedFault, swizzle_times_ns
from emulator.radio.frames import Copied, Frame, Receptions
from emulator.radio.mac import Mac
from emulator.radio.outcomes import PENDING
from emulator.scenario.fault_families import DelayFault, LossFault
from emulator.scenario.faults import Corrupt, Duplicate, Range, Swizzle, Throttle
from emulator.scenario.random_streams import Draws
from vnet.types import Array, Mask
from vnet.units import NS_PER_MS


@dataclass
class _Random:
    """A fault that draws for each reception. `bad` (N, N) is the memory of a loss, by sender and receiver."""

    planned: PlannedFault
    draws: Draws
    bad: Mask = field(default_factory=lambda: np.zeros((0, 0), dtype=bool))


@dataclass(frozen=True)
class ActiveLinkFaults:
    """What the faults of one time do to the frames that are handed over in it.

    `cut` are links (N, N) that a fault cuts altogether, `short` nodes and the range that a fault leaves them.
    """

    cut: Sequence[tuple[int, Mask]] = ()
    short: Sequence[tuple[int, Mask, float]] = ()
    losing: Sequence[_Random] = ()
    delaying: Sequence[_Random] = ()
    copying: Sequence[_Random] = ()
    corrupting: Sequence[_Random] = ()

    @property
    def lose(self) -> bool:
        """Whether any pair may be lost."""
        return bool(self.cut or self.short or self.losing)

    @property
    def change(self) -> bool:
        """Whether anything else may happen on the way."""
        return bool(self.delaying or self.copying or self.corrupting)

    @property
    def copy(self) -> bool:
        """Whether a reception may arrive more than once."""
        return bool(self.copying)

    def losses(self, frame: Frame) -> Iterator[tuple[int, Mask]]:
        """By which fault the frame is lost at which receivers (N,), in the order in which they act."""
        for number, cut in self.cut:
            yield number, cut[frame.sender]
        for number, nodes, range_m in self.short:
            beyond = frame.topology.distance_m[frame.sender] > range_m
            yield number, beyond & (nodes | nodes[frame.sender])
        for one in self.losing:
            yield one.planned.number, _lost(one, frame) & _links(one)[frame.sender]

    def changes(self, frame: Frame, place: int, receptions: Receptions) -> None:
        """Let what is left of frame number `place` arrive later, once more, or with other bytes."""
        pending = receptions.outcome[place] == PENDING
        count = len(pending)
        for one in self.delaying:
            draws = one.draws.uniform(frame.sender, frame.seq, count, frame.draw)
            later = _links(one)[frame.sender] & pending
            receptions.arrival_ns[place] += np.where(later, _later_ns(one.planned, draws), 0)
        for one in self.copying:
            fault = one.planned.fault
            assert isinstance(fault, Duplicate)
            draws = one.draws.uniform(frame.sender, frame.seq, count, frame.draw)
            again = _links(one)[frame.sender] & (draws < fault.probability)
            receptions.copies += [
                Copied(place, again, round((number + 1) * fault.delay_ms * NS_PER_MS), one.planned.number)
                for number in range(fault.copies)
            ]
        for one in self.corrupting:
            _corrupt(one, frame, place, receptions, pending)


class LinkFaults:
    """The faults of the channel, and their `effects` now. `access` is told whom they throttle."""

    def __init__(self, seed: int, access: Mac, count: int) -> None:
        self._seed = seed
        self._access = access
        self._count = count
        self._random: dict[int, _Random] = {}
        self.effects = ActiveLinkFaults()

    def update(self, active: Sequence[PlannedFault], time_ns: int) -> None:
        """From now on, at `time_ns`, these act and no others."""
        random = {p.number: self._go_on(p) for p in active if p.links is not None}
        self._random = random
        self.effects = ActiveLinkFaults(
            cut=[(p.number, cut) for p in active if (cut := self._cut_by(p, time_ns)) is not None],
            short=[(p.number, p.nodes, p.fault.range_m) for p in active if isinstance(p.fault, Range)],
            losing=_of(random, LossFault),
            delaying=_of(random, DelayFault),
            copying=_of(random, Duplicate),
            corrupting=_of(random, Corrupt),
        )
        self._access.throttle(self._throttled(active))

    def _go_on(self, planned: PlannedFault) -> _Random:
        """What has been drawn for a fault so far, acting from now on where it says."""
        one = self._random.get(planned.number)
        return self._begin(planned) if one is None else replace(one, planned=planned)

    def _begin(self, planned: PlannedFault) -> _Random:
        bad = np.zeros((self._count, self._count) if isinstance(planned.fault, LossFault) else (0, 0), dtype=bool)
        return _Random(planned, Draws(self._seed, f"fault {planned.number}"), bad)

    def _cut_by(self, planned: PlannedFault, time_ns: int) -> Mask | None:
        """Links (N, N) that a fault cuts altogether."""
        if isinstance(planned.fault, Swizzle):
            off = np.zeros(self._count, dtype=bool)
            for node, off_ns, back_ns in swizzle_times_ns(planned, self._seed):
                off[node] = off_ns <= time_ns < back_ns
            return np.asarray(off[:, None] | off[None, :])
        return planned.links if planned.fault.cuts else None

    def _throttled(self, active: Sequence[PlannedFault]) -> dict[int, float]:
        """The bitrate of each sender that is throttled: the least of those that apply."""
        slowest: dict[int, float] = {}
        for planned in active:
            if isinstance(planned.fault, Throttle):
                for node in np.flatnonzero(planned.nodes).tolist():
                    rate_mbps = planned.fault.bitrate_mbps
                    slowest[node] = min(rate_mbps, slowest.get(node, rate_mbps))
        return slowest


def _lost(one: _Random, frame: Frame) -> Mask:
    fault, count = one.planned.fault, len(_links(one))
    draws = one.draws.uniform(frame.sender, frame.seq, 2 * count, frame.draw).reshape(-1, 2).T
    assert isinstance(fault, LossFault), fault
    return fault.lost(draws, one.bad[frame.sender])


def _corrupt(one: _Random, frame: Frame, place: int, receptions: Receptions, pending: Mask) -> None:
    fault = one.planned.fault
    assert isinstance(fault, Corrupt)
    draws = one.draws.uniform(frame.sender, frame.seq, len(pending), frame.draw)
    hit = _links(one)[frame.sender] & pending & (draws < fault.probability)
    for receiver in np.flatnonzero(hit).tolist() if frame.size_bytes else ():
        # What is left of the draw beneath the probability says which bytes: each receiver gets its own.
        rng = np.random.default_rng(int(draws[receiver] * 2**53))
        places = rng.choice(frame.size_bytes, size=min(fault.flips, frame.size_bytes), replace=False)
        change = rng.integers(1, 256, size=len(places))
        flips = zip(places.tolist(), change.tolist(), strict=True)
        receptions.flips.setdefault((place, receiver), []).extend(flips)
        receptions.cause[place, receiver] = one.planned.number


def _links(one: _Random) -> Mask:
    assert one.planned.links is not None
    return one.planned.links


def _of(random: Mapping[int, _Random], *kinds: type) -> list[_Random]:
    return [one for one in random.values() if isinstance(one.planned.fault, kinds)]


def _later_ns(planned: PlannedFault, draws: Array) -> NDArray[np.int64]:
    assert isinstance(planned.fault, DelayFault), planned.fault
    return np.asarray(np.round(planned.fault.added_ms(draws) * NS_PER_MS), dtype=np.int64)
