"""The stages of the channel: small objects with one method over all receivers of a frame.

Stages run in the order of the chain; each looks only at the pairs that are still pending, and the first that
decides a pair has decided it. Whatever is random comes from `Draws`, indexed by receiver number. No stage needs
state of two receivers, so that the engine can be split by receiver; the transmit queue has state of one sender.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from emulator.channel.draws import Draws
from emulator.channel.outcomes import Outcome
from vnet.scenario import Radio

NS_PER_MS = 1_000_000
NO_CAUSE = -1
MIN_LATENCY_NS = 1_000
"""No exchange without time passing: every pair's latency is at least a microsecond."""


@dataclass(frozen=True, slots=True)
class Frame:
    """One broadcast as the channel sees it; `sender` is a receiver number, `seq` counts the sender's frames.

    `copy` counts the times that a frame is sent again (by a fault); such a copy has a row, and luck, of its own:
    `draw` tells its draws from the original's, and depends only on the fault and on what it sends again.
    """

    sender: int
    seq: int
    sent_ns: int
    size_bytes: int
    copy: int = 0
    draw: int = 0


@dataclass(slots=True)
class Pairs:
    """The pairs of one frame with every receiver: arrays indexed by receiver number.

    `outcome` (N,) of `Outcome`; `arrival_ns` (N,) is when the frame arrives where it does; `cause` (N,) is the
    number of the fault behind an outcome `fault`, or behind changed bytes, else NO_CAUSE. `copies` are pairs that
    arrive once more: which (N,), how much later in ns, and by which fault. `flips` are bytes that change on the
    way, by receiver: places, and what they are xored with.
    """

    outcome: NDArray[np.uint8]
    arrival_ns: NDArray[np.int64]
    cause: NDArray[np.int16]
    copies: list[tuple[NDArray[np.bool_], int, int]] = field(default_factory=list)
    flips: dict[int, list[tuple[int, int]]] = field(default_factory=dict)

    @classmethod
    def of(cls, frame: Frame, count: int) -> Pairs:
        """The pairs of a frame with `count` nodes, nothing decided."""
        sent_ns = np.full(count, frame.sent_ns, np.int64)
        return cls(np.zeros(count, np.uint8), sent_ns, np.full(count, NO_CAUSE, np.int16))

    def decide(self, which: NDArray[np.bool_] | bool, outcome: Outcome, cause: int = NO_CAUSE) -> None:
        """Give `outcome`, by fault number `cause`, to those of `which` that are still pending."""
        decided = (self.outcome == Outcome.pending) & which
        self.outcome[decided] = outcome
        if cause != NO_CAUSE:
            self.cause[decided] = cause


Stage = Callable[[Frame, Pairs], None]
"""One step of the channel: decides pairs, or changes when they arrive."""


class Topology:
    """Who is in range of whom, and whom each receiver's peer cap admits; rows are senders.

    Recomputed only when vehicles move or go up or down. Positions are (N, 2) in metres; NaN where a vehicle is not
    there. `links` (N, N), whose rows are receivers, says who is in range of whom in place of `range_m`; distances
    then only rank the peers.
    """

    def __init__(
        self,
        position_m: NDArray[np.float64],
        range_m: float,
        max_peers: int,
        links: NDArray[np.bool_] | None = None,
    ) -> None:
        self._range_m = range_m
        self._links = links
        self._max_peers = max_peers
        self._up = np.ones(len(position_m), dtype=bool)
        self.move(position_m)

    def move(self, position_m: NDArray[np.float64]) -> None:
        """Take new positions."""
        offset_m = position_m[:, None, :] - position_m[None, :, :]
        self.distance_m = np.hypot(offset_m[..., 0], offset_m[..., 1])
        if self._links is None:
            self.in_range = self.distance_m <= self._range_m
        else:
            self.in_range = self._links.T & np.isfinite(self.distance_m)
        np.fill_diagonal(self.in_range, False)
        self._rank()

    def set_up(self, node: int, up: bool) -> None:
        """A node that is down is nobody's peer."""
        self._up[node] = up
        self._rank()

    def is_up(self, node: int) -> bool:
        """Whether a node is up."""
        return bool(self._up[node])

    def _rank(self) -> None:
        """`admitted[s, r]`: sender s is among the `max_peers` nearest live senders in range of receiver r."""
        candidate = self.in_range & self._up[:, None]
        distance_m = np.where(candidate, self.distance_m, np.inf)
        order = np.argsort(distance_m, axis=0, kind="stable")  # ties go to the lower number
        rank = np.empty_like(order)
        np.put_along_axis(rank, order, np.arange(len(order))[:, None], axis=0)
        self.admitted = candidate & (rank < self._max_peers)


class InRange:
    """Everybody within `radio.range_m` hears, or whom `radio.links` lets hear; nobody else."""

    def __init__(self, topology: Topology) -> None:
        self._topology = topology

    def __call__(self, frame: Frame, pairs: Pairs) -> None:
        """Decide `out_of_range`."""
        pairs.decide(~self._topology.in_range[frame.sender], Outcome.out_of_range)


class PayloadLimit:
    """A frame above `radio.max_payload_bytes` reaches nobody."""

    def __init__(self, max_payload_bytes: int) -> None:
        self._max_payload_bytes = max_payload_bytes

    def __call__(self, frame: Frame, pairs: Pairs) -> None:
        """Decide `oversize`."""
        if frame.size_bytes > self._max_payload_bytes:
            pairs.decide(True, Outcome.oversize)


@dataclass
class _Backlog:
    """What a sender has still to send: when each waiting frame starts, and when the last one ends."""

    starts_ns: deque[int] = field(default_factory=deque)
    busy_until_ns: int = 0

    def room(self, time_ns: int, limit: int) -> bool:
        """Whether another frame finds a place at `time_ns`."""
        while self.starts_ns and self.starts_ns[0] <= time_ns:
            self.starts_ns.popleft()
        return len(self.starts_ns) < limit

    def take(self, ready_ns: int, airtime_ns: int) -> int:
        """Put one more frame at the end; returns when it will have been sent."""
        start_ns = max(ready_ns, self.busy_until_ns)
        self.starts_ns.append(start_ns)
        self.busy_until_ns = start_ns + airtime_ns
        return self.busy_until_ns


class TransmitQueue:
    """The sender's own queue: random access delay, airtime at `radio.bitrate_mbps`, at most `queue_frames` waiting.

    Sets the arrival to the end of the transmission. Faults `throttle` some senders.
    """

    def __init__(self, seed: int, radio: Radio) -> None:
        self._draws = Draws(seed, "access")
        self._access_jitter_ns = radio.access_jitter_ms * NS_PER_MS
        self._bitrate_mbps = radio.bitrate_mbps
        self._max_payload_bytes = radio.max_payload_bytes
        self._limit = radio.queue_frames
        self._backlogs: dict[int, _Backlog] = {}
        self._throttled_mbps: dict[int, float] = {}
        self._unthrottled: dict[int, _Backlog] = {}

    def throttle(self, bitrate_mbps: Mapping[int, float]) -> None:
        """From now on these senders send at these bitrates, and no others are slowed.

        Who no longer is goes on as if it had never been: what waits is sent as it was decided, but nothing new
        waits behind it, so that the fault ends with its end however slow it was.
        """
        for sender in self._throttled_mbps.keys() - bitrate_mbps.keys():
            self._backlogs[sender] = self._unthrottled.pop(sender)
        for sender in bitrate_mbps.keys() - self._throttled_mbps.keys():
            backlog = self._backlogs.get(sender, _Backlog())
            self._unthrottled[sender] = _Backlog(backlog.starts_ns.copy(), backlog.busy_until_ns)
        self._throttled_mbps = dict(bitrate_mbps)

    def __call__(self, frame: Frame, pairs: Pairs) -> None:
        """Decide `queue_full`, or when the frame has left the sender."""
        if frame.size_bytes > self._max_payload_bytes:  # never got as far as the queue
            return
        jitter_ns = int(self._access_jitter_ns * self._draws.uniform(frame.sender, frame.seq, 1, frame.draw)[0])
        bitrate_mbps = self._bitrate_mbps
        if (unthrottled := self._unthrottled.get(frame.sender)) is not None:
            self._put(frame, unthrottled, jitter_ns, bitrate_mbps)
            bitrate_mbps = min(bitrate_mbps, self._throttled_mbps[frame.sender])
        backlog = self._backlogs.setdefault(frame.sender, _Backlog())
        end_ns = self._put(frame, backlog, jitter_ns, bitrate_mbps)
        if end_ns is None:
            pairs.decide(True, Outcome.queue_full)
        else:
            pairs.arrival_ns[:] = end_ns

    def _put(self, frame: Frame, backlog: _Backlog, jitter_ns: int, bitrate_mbps: float) -> int | None:
        if not backlog.room(frame.sent_ns, self._limit):
            return None
        return backlog.take(frame.sent_ns + jitter_ns, round(frame.size_bytes * 8_000 / bitrate_mbps))


class PeerCap:
    """Each receiver hears its nearest `radio.max_peers` live senders in range, ties by number."""

    def __init__(self, topology: Topology) -> None:
        self._topology = topology

    def __call__(self, frame: Frame, pairs: Pairs) -> None:
        """Decide `peer_cap`."""
        pairs.decide(~self._topology.admitted[frame.sender], Outcome.peer_cap)


class Loss:
    """Every pair is lost independently with probability `radio.loss`."""

    def __init__(self, seed: int, loss: float) -> None:
        self._draws = Draws(seed, "loss")
        self._loss = loss

    def __call__(self, frame: Frame, pairs: Pairs) -> None:
        """Decide `lost`."""
        if self._loss > 0:
            draws = self._draws.uniform(frame.sender, frame.seq, len(pairs.outcome), frame.draw)
            pairs.decide(draws < self._loss, Outcome.lost)


class Latency:
    """Propagation and processing: `latency_ms` plus uniform `jitter_ms`, rounded up to the delivery tick."""

    def __init__(self, seed: int, radio: Radio) -> None:
        self._draws = Draws(seed, "latency")
        self._latency_ns = radio.latency_ms * NS_PER_MS
        self._jitter_ns = radio.jitter_ms * NS_PER_MS
        self._tick_ns = radio.delivery_tick_us * 1_000

    def __call__(self, frame: Frame, pairs: Pairs) -> None:
        """Set when each pair arrives."""
        draws = self._draws.uniform(frame.sender, frame.seq, len(pairs.outcome), frame.draw)
        latency_ns = (self._latency_ns + self._jitter_ns * draws).astype(np.int64)
        arrival_ns = pairs.arrival_ns + np.maximum(latency_ns, MIN_LATENCY_NS)
        if self._tick_ns:
            arrival_ns = -(-arrival_ns // self._tick_ns) * self._tick_ns
        pairs.arrival_ns = arrival_ns
