"""What the acting faults do to the channel: stages of their own, and what they change in the radio's.

`LinkFaults.update` is told which faults act; the stages then look only at what it has made of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from emulator.channel.draws import Draws
from emulator.channel.outcomes import Outcome
from emulator.channel.stages import NS_PER_MS, Frame, Pairs, Topology, TransmitQueue
from emulator.faults.plan import PlannedFault, swizzle_times_ns
from emulator.faults.selectors import Mask
from vnet.faults import BurstLoss, Corrupt, Delay, Duplicate, Jitter, Loss, Range, Reorder, Throttle
from vnet.roads.lanes import Array


@dataclass
class _Random:
    """A fault that draws for each pair. `bad` (N, N) is the state of a burst loss."""

    planned: PlannedFault
    draws: Draws
    bad: Mask = field(default_factory=lambda: np.zeros((0, 0), dtype=bool))


class LinkFaults:
    """The faults of the channel that act now, and the stages they act through."""

    def __init__(self, seed: int, topology: Topology, queue: TransmitQueue, count: int) -> None:
        self._seed = seed
        self._topology = topology
        self._queue = queue
        self._count = count
        self._random: dict[int, _Random] = {}
        self._cut: Sequence[tuple[int, Mask]] = ()
        self._short: Sequence[tuple[int, Mask, float]] = ()
        self._losing: Sequence[_Random] = ()
        self._delaying: Sequence[_Random] = ()
        self._copying: Sequence[_Random] = ()
        self._corrupting: Sequence[_Random] = ()

    def update(self, active: Sequence[PlannedFault], time_ns: int) -> None:
        """From now on, at `time_ns`, these act and no others."""
        self._cut = [(p.number, cut) for p in active if (cut := self._cut_by(p, time_ns)) is not None]
        self._short = [(p.number, p.nodes, p.fault.range_m) for p in active if isinstance(p.fault, Range)]
        random = {p.number: self._go_on(p) for p in active if p.links is not None}
        self._random = random
        self._losing = _of(random, Loss, BurstLoss)
        self._delaying = _of(random, Delay, Jitter, Reorder)
        self._copying = _of(random, Duplicate)
        self._corrupting = _of(random, Corrupt)
        self._queue.throttle(self._throttled(active))

    def _go_on(self, planned: PlannedFault) -> _Random:
        """What has been drawn for a fault so far, acting from now on where it says."""
        one = self._random.get(planned.number) or self._begin(planned)
        one.planned = planned
        return one

    def _begin(self, planned: PlannedFault) -> _Random:
        bad = np.zeros((self._count, self._count) if isinstance(planned.fault, BurstLoss) else (0, 0), dtype=bool)
        return _Random(planned, Draws(self._seed, f"fault {planned.number}"), bad)

    def _cut_by(self, planned: PlannedFault, time_ns: int) -> Mask | None:
        """Links (N, N) that a fault cuts altogether."""
        match planned.fault.kind:
            case "partition" | "block":
                return planned.links
            case "swizzle":
                off = np.zeros(self._count, dtype=bool)
                for node, off_ns, back_ns in swizzle_times_ns(planned, self._seed):
                    off[node] = off_ns <= time_ns < back_ns
                return np.asarray(off[:, None] | off[None, :])
            case _:
                return None

    def _throttled(self, active: Sequence[PlannedFault]) -> dict[int, float]:
        """The bitrate of each sender that is throttled: the least of those that apply."""
        slowest: dict[int, float] = {}
        for planned in active:
            if isinstance(planned.fault, Throttle):
                for node in np.flatnonzero(planned.nodes).tolist():
                    rate_mbps = planned.fault.bitrate_mbps
                    slowest[node] = min(rate_mbps, slowest.get(node, rate_mbps))
        return slowest

    def lose(self, frame: Frame, pairs: Pairs) -> None:
        """A stage: decide `fault` where a link is cut, or loses this frame."""
        for number, cut in self._cut:
            pairs.decide(cut[frame.sender], Outcome.fault, cause=number)
        for number, nodes, range_m in self._short:
            beyond = self._topology.distance_m[frame.sender] > range_m
            pairs.decide(beyond & (nodes | nodes[frame.sender]), Outcome.fault, cause=number)
        for one in self._losing:
            number, lost = one.planned.number, self._lost(one, frame)
            pairs.decide(lost & _links(one)[frame.sender], Outcome.fault, cause=number)

    def _lost(self, one: _Random, frame: Frame) -> Mask:
        fault = one.planned.fault
        draws = one.draws.uniform(frame.sender, frame.seq, 2 * self._count, frame.draw).reshape(-1, 2).T
        if isinstance(fault, Loss):
            return np.asarray(draws[0] < fault.probability)
        assert isinstance(fault, BurstLoss), fault
        bad = one.bad[frame.sender]
        bad[:] = np.where(bad, draws[0] >= fault.leave, draws[0] < fault.enter)
        return np.asarray(draws[1] < np.where(bad, fault.loss_bad, fault.loss_good))

    def change(self, frame: Frame, pairs: Pairs) -> None:
        """A stage, after the latency: what does not lose a pair; later arrivals, copies, other bytes."""
        for one in self._delaying:
            draws = one.draws.uniform(frame.sender, frame.seq, self._count, frame.draw)
            later = _links(one)[frame.sender] & (pairs.outcome == Outcome.pending)
            pairs.arrival_ns = pairs.arrival_ns + np.where(later, _later_ns(one.planned, draws), 0)
        for one in self._copying:
            fault = one.planned.fault
            assert isinstance(fault, Duplicate)
            draws = one.draws.uniform(frame.sender, frame.seq, self._count, frame.draw)
            again = _links(one)[frame.sender] & (draws < fault.probability)
            pairs.copies += [
                (again, round((number + 1) * fault.delay_ms * NS_PER_MS), one.planned.number)
                for number in range(fault.copies)
            ]
        for one in self._corrupting:
            self._corrupt(one, frame, pairs)

    def _corrupt(self, one: _Random, frame: Frame, pairs: Pairs) -> None:
        fault = one.planned.fault
        assert isinstance(fault, Corrupt)
        draws = one.draws.uniform(frame.sender, frame.seq, self._count, frame.draw)
        hit = _links(one)[frame.sender] & (pairs.outcome == Outcome.pending) & (draws < fault.probability)
        for receiver in np.flatnonzero(hit).tolist() if frame.size_bytes else ():
            # What is left of the draw beneath the probability says which bytes: each receiver gets its own.
            rng = np.random.default_rng(int(draws[receiver] * 2**53))
            place = rng.choice(frame.size_bytes, size=min(fault.flips, frame.size_bytes), replace=False)
            change = rng.integers(1, 256, size=len(place))
            pairs.flips.setdefault(receiver, []).extend(zip(place.tolist(), change.tolist(), strict=True))
            pairs.cause[receiver] = one.planned.number


def _links(one: _Random) -> Mask:
    assert one.planned.links is not None
    return one.planned.links


def _of(random: Mapping[int, _Random], *kinds: type) -> list[_Random]:
    return [one for one in random.values() if isinstance(one.planned.fault, kinds)]


def _later_ns(planned: PlannedFault, draws: Array) -> NDArray[np.int64]:
    match planned.fault:
        case Delay(delay_ms=delay_ms):
            later_ms = np.full(len(draws), delay_ms)
        case Jitter(jitter_ms=jitter_ms):
            later_ms = jitter_ms * draws
        case Reorder(probability=probability, delay_ms=delay_ms):
            later_ms = np.where(draws < probability, delay_ms, 0.0)
        case other:
            raise AssertionError(other)
    return np.asarray(np.round(later_ms * NS_PER_MS), dtype=np.int64)
