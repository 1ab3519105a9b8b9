"""The engine: frames in, deliveries out, in virtual time.

It knows no Zenoh, no asyncio and no wall clock. Drivers `transmit` what nodes send, ask when something arrives
next, and `advance` to an instant. Every (frame, receiver) pair gets exactly one outcome, final at the instant of
its arrival; pairs in range are rows of the trace, pairs out of range are counted.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from heapq import heappop, heappush

import numpy as np
from numpy.typing import NDArray

from emulator.channel.outcomes import Outcome
from emulator.channel.stages import Frame, Pairs, Topology, default_chain
from emulator.observe.trace import Trace
from vnet.link.node import Packet
from vnet.scenario import Radio


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
        self.chain = default_chain(radio, seed, self._topology)
        self.trace = Trace(node_ids)
        self.counts = dict.fromkeys(Outcome, 0)
        self._next_seq = [0] * len(node_ids)
        # One heap a receiver, of (arrival, sender, seq, row, sent, payload): nothing is shared between receivers.
        self._pending: list[list[tuple[int, int, int, int, int, bytes]]] = [[] for _ in node_ids]

    def set_positions(self, position_m: NDArray[np.float64]) -> None:
        """Move the vehicles: (N, 2) in metres. Frames in flight keep what was decided when they were sent."""
        self._topology.move(position_m)

    def set_up(self, node: int, up: bool) -> None:
        """A node that is down sends nothing, and what arrives at it is `receiver_down`."""
        self._topology.set_up(node, up)

    def transmit(self, time_ns: int, node: int, payloads: Sequence[bytes]) -> None:
        """Frames that `node` broadcasts at `time_ns`, in order. Those of a node that is down are discarded."""
        if not self._topology.is_up(node):
            return
        for payload in payloads:
            seq = self._next_seq[node]
            self._next_seq[node] = seq + 1
            self._transmit(Frame(node, seq, time_ns, len(payload)), payload)

    def _transmit(self, frame: Frame, payload: bytes) -> None:
        count = len(self._node_ids)
        pairs = Pairs(np.zeros(count, np.uint8), np.full(count, frame.sent_ns, np.int64))
        for stage in self.chain:
            stage.apply(frame, pairs)
        receivers = np.flatnonzero(pairs.outcome != Outcome.out_of_range)
        self.counts[Outcome.out_of_range] += count - 1 - len(receivers)
        outcome = pairs.outcome[receivers]
        arrival_ns = pairs.arrival_ns[receivers]
        digest = int.from_bytes(hashlib.blake2b(payload, digest_size=8).digest(), "little")
        first_row = self.trace.append(
            frame.sent_ns,
            frame.sender,
            frame.seq,
            receivers,
            frame.size_bytes,
            digest,
            outcome,
            arrival_ns,
            pairs.cause,
        )
        pending = outcome == Outcome.pending
        for kind, number in enumerate(np.bincount(outcome).tolist()):
            self.counts[Outcome(kind)] += number
        rows = first_row + np.flatnonzero(pending)
        for receiver, arrival, row in zip(
            receivers[pending].tolist(), arrival_ns[pending].tolist(), rows.tolist(), strict=True
        ):
            heappush(self._pending[receiver], (arrival, frame.sender, frame.seq, row, frame.sent_ns, payload))

    def next_arrival_ns(self, node: int) -> int | None:
        """When the next pending frame arrives at `node`."""
        pending = self._pending[node]
        return pending[0][0] if pending else None

    def next_time(self) -> int | None:
        """When the next pending frame arrives anywhere."""
        return min((pending[0][0] for pending in self._pending if pending), default=None)

    def advance(self, time_ns: int) -> list[Delivery]:
        """All that arrives up to `time_ns`, ordered by (arrival, sender, seq, receiver)."""
        arrived: list[tuple[int, int, int, int, int, int, bytes]] = []
        for receiver, pending in enumerate(self._pending):
            while pending and pending[0][0] <= time_ns:
                arrival, sender, seq, row, sent_ns, payload = heappop(pending)
                arrived.append((arrival, sender, seq, receiver, row, sent_ns, payload))
        arrived.sort(key=lambda item: item[:4])
        return self._decide(arrived)

    def _decide(self, arrived: list[tuple[int, int, int, int, int, int, bytes]]) -> list[Delivery]:
        deliveries = []
        down_rows = []
        for arrival, sender, _, receiver, row, sent_ns, payload in arrived:
            if self._topology.is_up(receiver):
                packet = Packet(self._node_ids[sender], sent_ns, arrival, payload)
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
        """A delivery that never reached its process (real time only)."""
        self.trace.decide([delivery.row], Outcome.transport)
        self.counts[Outcome.delivered] -= 1
        self.counts[Outcome.transport] += 1

    def drain(self) -> None:
        """End of the run: everything in flight arrives, and nobody is woken for it."""
        if (last := max((max(p)[0] for p in self._pending if p), default=None)) is not None:
            self.advance(last)
