"""The engine: frames in, deliveries out, in virtual time.

It knows no Zenoh, no asyncio and no wall clock. Drivers `transmit` what nodes send, ask when something arrives
next, and `advance` to an instant. Every (frame, receiver) pair gets exactly one outcome, final at the instant of
its arrival; pairs in range are rows of the trace, pairs out of range are counted.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from heapq import heappop, heappush

import numpy as np
from numpy.typing import NDArray

from emulator.channel.outcomes import Outcome
from emulator.channel.stages import (
    NO_CAUSE,
    Frame,
    InRange,
    Latency,
    Loss,
    Pairs,
    PayloadLimit,
    PeerCap,
    Stage,
    Topology,
    TransmitQueue,
)
from emulator.faults.links import LinkFaults
from emulator.faults.plan import PlannedFault
from emulator.faults.senders import Outgoing, SenderFaults
from emulator.observe.trace import Trace
from vnet.link.node import Packet
from vnet.scenario import Radio

_Pending = tuple[int, int, int, int, int, int, Packet]
"""A pair that is on its way: arrival, sender, seq, receiver, copy, row of the trace, packet."""


@dataclass(frozen=True, slots=True)
class Delivery:
    """A packet that has reached `receiver` (a number); `row` is its row of the trace."""

    receiver: int
    packet: Packet
    row: int


class Engine:
    """The state of the emulated radio. Nodes are known by their numbers, 0 … N-1, in the order of `node_ids`.

    `position_m` (N, 2); `links` (N, N) is `radio.links` as loaded, whether i (row) hears j (column), or None where
    `radio.range_m` decides.
    """

    def __init__(
        self,
        node_ids: Sequence[str],
        radio: Radio,
        seed: int,
        position_m: NDArray[np.float64],
        links: NDArray[np.bool_] | None,
    ) -> None:
        self._node_ids = tuple(node_ids)
        self._topology = Topology(position_m, radio.range_m, radio.max_peers, links)
        queue = TransmitQueue(seed, radio)
        self._links = LinkFaults(seed, self._topology, queue, len(node_ids))
        self._senders = SenderFaults(self._node_ids, self._next_copy)
        self.chain: list[Stage] = [
            InRange(self._topology),
            PayloadLimit(radio.max_payload_bytes),
            queue,
            PeerCap(self._topology),
            self._links.lose,
            Loss(seed, radio.loss),
            Latency(seed, radio),
            self._links.change,
        ]
        self.trace = Trace(node_ids)
        self.counts = dict.fromkeys(Outcome, 0)
        self._next_seq = [0] * len(node_ids)
        self._copies: Counter[tuple[int, int]] = Counter()
        # One heap a receiver: nothing is shared between receivers.
        self._pending: list[list[_Pending]] = [[] for _ in node_ids]

    def set_positions(self, position_m: NDArray[np.float64]) -> None:
        """Move the vehicles: (N, 2) in metres. Frames in flight keep what was decided when they were sent."""
        self._topology.move(position_m)

    def set_up(self, node: int, up: bool) -> None:
        """A node that is down sends nothing, and what arrives at it is `receiver_down`."""
        self._topology.set_up(node, up)

    def set_faults(self, active: Sequence[PlannedFault], time_ns: int) -> None:
        """From now on, at `time_ns`, these faults act on frames and no others. What is in flight stays decided."""
        for planned in active:
            self.trace.name_cause(planned.number, planned.label)
        self._links.update(active, time_ns)
        self._senders.update(active)

    def _next_copy(self, sender: int, seq: int) -> int:
        self._copies[sender, seq] += 1
        return self._copies[sender, seq]

    def transmit(self, time_ns: int, node: int, payloads: Sequence[bytes]) -> None:
        """Frames that `node` broadcasts at `time_ns`, in order. Those of a node that is down are discarded."""
        if not self._topology.is_up(node):
            return
        for payload in payloads:
            seq = self._next_seq[node]
            self._next_seq[node] = seq + 1
            for outgoing in self._senders.frames(time_ns, node, seq, payload):
                frame = Frame(node, outgoing.seq, time_ns, len(outgoing.payload), outgoing.copy, outgoing.draw)
                self._transmit(frame, outgoing)

    def _transmit(self, frame: Frame, outgoing: Outgoing) -> None:
        count = len(self._node_ids)
        pairs = Pairs.of(frame, count)
        if outgoing.cause != NO_CAUSE:
            pairs.cause[:] = outgoing.cause
        for stage in self.chain:
            stage(frame, pairs)
        receivers = np.flatnonzero(pairs.outcome != Outcome.out_of_range)
        self.counts[Outcome.out_of_range] += count - 1 - len(receivers)
        self._book(frame, outgoing, pairs, receivers)
        arriving = pairs.outcome == Outcome.pending
        for which, later_ns, cause in pairs.copies:
            again = np.flatnonzero(which & arriving)
            if len(again):
                copy = self._next_copy(frame.sender, frame.seq)
                copied = replace(
                    pairs, arrival_ns=pairs.arrival_ns + later_ns, cause=np.full(count, cause, np.int16)
                )
                self._book(replace(frame, copy=copy), outgoing, copied, again)

    def _book(self, frame: Frame, outgoing: Outgoing, pairs: Pairs, receivers: NDArray[np.intp]) -> None:
        """Write the rows of a frame's pairs with `receivers`, and put those that arrive where they are awaited."""
        outcome = pairs.outcome[receivers]
        arrival_ns = pairs.arrival_ns[receivers]
        payloads = {receiver: _flipped(outgoing.payload, flips) for receiver, flips in pairs.flips.items()}
        digest: int | NDArray[np.uint64] = _digest(outgoing.payload)
        if payloads:
            digest = np.full(len(receivers), digest, np.uint64)
            for receiver, payload in payloads.items():
                digest[receivers == receiver] = _digest(payload)
        first_row = self.trace.append(frame, receivers, digest, outcome, arrival_ns, pairs.cause[receivers])
        for kind, number in enumerate(np.bincount(outcome).tolist()):
            self.counts[Outcome(kind)] += number
        pending = outcome == Outcome.pending
        rows = first_row + np.flatnonzero(pending)
        name = outgoing.alias or self._node_ids[frame.sender]
        for receiver, arrival, row in zip(
            receivers[pending].tolist(), arrival_ns[pending].tolist(), rows.tolist(), strict=True
        ):
            packet = Packet(name, frame.sent_ns, arrival, payloads.get(receiver, outgoing.payload))
            heappush(self._pending[receiver], (arrival, frame.sender, frame.seq, receiver, frame.copy, row, packet))

    def next_arrival_ns(self, node: int) -> int | None:
        """When the next pending frame arrives at `node`."""
        pending = self._pending[node]
        return pending[0][0] if pending else None

    def next_time(self) -> int | None:
        """When the next pending frame arrives anywhere."""
        return min((pending[0][0] for pending in self._pending if pending), default=None)

    def pending_rows(self) -> list[int]:
        """The rows of the trace whose frames are on their way."""
        return [row for pending in self._pending for *_, row, _ in pending]

    def advance(self, time_ns: int) -> list[Delivery]:
        """All that arrives up to `time_ns`, ordered by (arrival, sender, seq, receiver)."""
        arrived = list(self._arrivals(time_ns))
        arrived.sort(key=lambda item: item[:5])
        return self._decide(arrived)

    def _arrivals(self, time_ns: int) -> Iterator[_Pending]:
        for pending in self._pending:
            while pending and pending[0][0] <= time_ns:
                yield heappop(pending)

    def _decide(self, arrived: Sequence[_Pending]) -> list[Delivery]:
        deliveries = []
        down_rows = []
        for *_, receiver, _, row, packet in arrived:
            if self._topology.is_up(receiver):
                deliveries.append(Delivery(receiver, packet, row))
            else:
                down_rows.append(row)
        self.trace.decide([delivery.row for delivery in deliveries], Outcome.delivered)
        self.trace.decide(down_rows, Outcome.receiver_down)
        self.counts[Outcome.delivered] += len(deliveries)
        self.counts[Outcome.receiver_down] += len(down_rows)
        self.counts[Outcome.pending] -= len(arrived)
        return deliveries

    def lose(self, delivery: Delivery) -> None:
        """A delivery that never reached its process (real time only); once for each."""
        self.trace.decide([delivery.row], Outcome.transport)
        self.counts[Outcome.delivered] -= 1
        self.counts[Outcome.transport] += 1

    def drain(self) -> None:
        """End of the run: everything in flight arrives, and nobody is woken for it."""
        if (last := max((max(p)[0] for p in self._pending if p), default=None)) is not None:
            self.advance(last)


def _digest(payload: bytes) -> int:
    return int.from_bytes(hashlib.blake2b(payload, digest_size=8).digest(), "little")


def _flipped(payload: bytes, flips: Sequence[tuple[int, int]]) -> bytes:
    changed = bytearray(payload)
    for place, change in flips:
        changed[place] ^= change
    return bytes(changed)
