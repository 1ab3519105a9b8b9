"""The engine: frames in, deliveries out, in virtual time.

It knows no Zenoh, no asyncio and no wall clock. Drivers `transmit` the nodes' frames, ask for the time of the next
arrival, and `advance` to a time. Every reception (a frame at a receiver) gets exactly one outcome, which is final
at the time of its arrival. Receptions in range are rows of the trace; those out of range are only counted.

A frame passes three steps: it is enqueued, it waits for the medium and is on air, and it has been sent. The state
of the network (positions, nodes that are up, faults) is kept with the frame when it is enqueued. The stages run
after it has been sent, over all frames at once that have been sent since the last query.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from emulator.faults.plan import PlannedFault
from emulator.radio.csma import Csma
from emulator.radio.faults import LinkFaults, Outgoing, SenderFaults
from emulator.radio.frames import BROADCAST, Choices, Frame, Receptions, Stage, allowed_choices, flipped
from emulator.radio.in_flight import NO_ARRIVAL_NS, Deliveries, Delivery, InFlight
from emulator.radio.mac import Mac, TransmitQueue
from emulator.radio.medium import WINDOW_NS
from emulator.radio.outcomes import OUT_OF_RANGE, PENDING, Outcome
from emulator.radio.own_rules import OwnRules
from emulator.radio.propagation import transmit_powers_dbm
from emulator.radio.reception import Reception, Signals
from emulator.radio.stages import Latency, Loss, change_by_faults, in_range, lose_by_faults, peer_cap, sender_side
from emulator.radio.topology import Topology, connectivity_of
from emulator.radio.trace import CHOSEN, Trace, payload_digest
from emulator.radio.unicast import Result, address, address_all
from emulator.scenario.scenario import MIN_LATENCY_NS, Radio
from emulator.world.neighbours import Links
from emulator.world.radio_inputs import RadioInputs
from vnet.radio import SendOptions
from vnet.types import IntArray

NO_OPTIONS: Mapping[int, SendOptions] = {}

__all__ = ["Deliveries", "Delivery", "Engine"]

_COLUMNS = ("sent_ns", "sender", "seq", "size_bytes", "copy", "on_air_ns", "left_ns")
_CHOICES = attrgetter(*CHOSEN)
_OF_FRAME = attrgetter("sent_ns", "sender", "seq", "size_bytes", "copy", "on_air_ns", "end_ns")
"""Returns a frame's values of `_COLUMNS` of the trace."""


class Engine:
    """The state of the emulated radio. Nodes have the numbers 0 … N-1 in the order of `node_ids`.

    `position_m` (N, 2) are positions in metres. `inputs` are those that a scenario reads from files; `rules` are
    those of the user's own.
    """

    def __init__(
        self,
        node_ids: Sequence[str],
        radio: Radio,
        seed: int,
        position_m: NDArray[np.float64],
        inputs: RadioInputs | None = None,
        rules: OwnRules | None = None,
    ) -> None:
        self._node_ids = tuple(node_ids)
        self._radio = radio
        self._max_payload_bytes = radio.max_payload_bytes
        count = len(node_ids)
        signals = Signals(seed, radio.fading, count) if radio.is_physical else None
        nakagami = signals.nakagami if signals is not None else None
        self._topology = Topology(position_m, connectivity_of(radio, seed, inputs), radio.max_peers, nakagami)
        self._csma = (
            Csma(radio.mac, radio, signals, count, seed) if radio.mac is not None and signals is not None else None
        )
        self._mac: Mac = self._csma or TransmitQueue(seed, radio)
        if self._csma is not None:
            self._csma.judge, self._csma.next_copy = self._judge, self._next_copy
            self._csma.is_up, self._csma.acknowledged = self._topology.is_up, self._acknowledged
        self._rules = rules or OwnRules(seed, node_ids)
        self._rules.tx_power_dbm = transmit_powers_dbm(radio.path_loss, count, inputs.units if inputs else ())
        self._links = LinkFaults(seed, self._mac, count, self._rules)
        self._senders = SenderFaults(self._node_ids, self._next_copy, self._ask_sender)
        self._reception = Reception(radio, signals) if signals is not None else None
        self.chain: list[Stage] = [
            in_range,
            sender_side,
            peer_cap,
            lose_by_faults,
            *([self._reception] if self._reception is not None else []),
            Loss(seed, radio.loss),
            Latency(seed, radio),
            change_by_faults,
        ]
        self._trace = Trace(node_ids, self._csma is not None, knows_power=radio.path_loss is not None)
        self._counts = dict.fromkeys(Outcome, 0)
        self._next_seq = [0] * len(node_ids)
        self._default_choices = Choices(0.0, radio.bitrate_mbps)
        self._number = {node: number for number, node in enumerate(node_ids)}
        self._copies: Counter[tuple[int, int]] = Counter()
        self._in_flight = InFlight(len(node_ids))
        self.on_payload: Callable[[int, int, int, bytes], None] | None = None
        """Called with time in ns, node, number and payload of each frame that a program sends."""

    @property
    def trace(self) -> Trace:
        """The trace: one row for each reception in range of the frames that have been sent."""
        self._settle()
        return self._trace

    @property
    def counts(self) -> dict[Outcome, int]:
        """Number of receptions by outcome so far."""
        self._settle()
        return self._counts

    def set_positions(self, position_m: NDArray[np.float64]) -> None:
        """Move the vehicles to (N, 2) in metres. Frames that were enqueued before are not affected."""
        self._topology.move(position_m)

    @property
    def links(self) -> Links:
        """Links of a sender and a receiver in its range at the present positions."""
        return self._topology.links

    def set_up(self, node: int, up: bool) -> None:
        """Set a node up or down. A node that is down sends nothing; what arrives there is `receiver_down`."""
        self._topology.set_up(node, up)
        if not up and self._csma is not None:
            self._csma.unicasts.forget(node)

    def set_faults(self, active: Sequence[PlannedFault], time_ns: int) -> None:
        """Let exactly these faults act from `time_ns` on. Receptions in flight are not affected."""
        for planned in active:
            self._trace.name_cause(planned.number, planned.label)
        self._links.update(active, time_ns)
        self._senders.update(active)

    def _next_copy(self, sender: int, seq: int) -> int:
        self._copies[sender, seq] += 1
        return self._copies[sender, seq]

    def _ask_sender(self, planned: PlannedFault, time_ns: int, node: int, outgoing: Outgoing) -> list[bytes]:
        return self._rules.ask_sender(planned, self._frame(time_ns, node, outgoing), self._max_payload_bytes)

    # Enqueueing.

    def number_next(self, node: int, seq: int) -> None:
        """Give the next frame of a node this number: a trace lacks the frames that nobody was in range of."""
        self._next_seq[node] = seq

    def transmit(
        self, time_ns: int, node: int, payloads: Sequence[bytes], options: Mapping[int, SendOptions] = NO_OPTIONS
    ) -> None:
        """Enqueue frames that `node` broadcasts at `time_ns`, in order. A node that is down sends nothing.

        `options` are those of frames, by their index, that have another power or bit rate than the scenario's.
        """
        if not self._topology.is_up(node):
            return
        self._mac.run(time_ns)
        self._topology.advance(time_ns)
        for index, payload in enumerate(payloads):
            choices = self._chosen(time_ns, node, options[index]) if index in options else self._default_choices
            if choices is None:
                continue
            seq, self._next_seq[node] = self._next_seq[node], self._next_seq[node] + 1
            if self.on_payload is not None:
                self.on_payload(time_ns, node, seq, payload)
            original = Outgoing(payload, seq, choices)
            if not self._senders.misbehave:
                self._enqueue(time_ns, node, original)
                continue
            self._settle()  # duplicates of frames sent before are numbered before the copies sent now
            for outgoing in self._senders.frames(time_ns, node, original):
                self._enqueue(time_ns, node, outgoing)

    def _chosen(self, time_ns: int, node: int, options: SendOptions) -> Choices | None:
        """Return the choices for the next frame; None for one to nobody, which is not sent."""
        choices = allowed_choices(self._radio, options, self._rules.largest_dbm(node))
        is_chosen = choices != self._default_choices
        if options.to is not None:
            to = self._number.get(options.to, BROADCAST)
            if self._csma is None:
                return None
            if to in (node, BROADCAST):
                self._csma.unicasts.refuse(node, options.number, time_ns)
                return None
            self._trace.acknowledges = True
            choices = choices._replace(to=to, ticket=self._csma.unicasts.register(node, options.number))
        if is_chosen:
            self._trace.begin_choices(self._radio.bitrate_mbps)
        return choices

    def _frame(self, time_ns: int, node: int, outgoing: Outgoing) -> Frame:
        return Frame(
            sender=node,
            bitrate_mbps=(choices := outgoing.choices).bitrate_mbps,
            gain_db=choices.gain_db,
            seq=outgoing.seq,
            sent_ns=time_ns,
            size_bytes=len(outgoing.payload),
            topology=self._topology.now,
            effects=self._links.effects,
            copy=outgoing.copy,
            draw=outgoing.draw,
            payload=outgoing.payload,
            name=outgoing.alias or self._node_ids[node],
            cause=outgoing.cause,
            to=choices.to,
            attempt=int(choices.to != BROADCAST),
            ticket=0 if outgoing.copy else choices.ticket,
        )

    def _enqueue(self, time_ns: int, node: int, outgoing: Outgoing) -> None:
        frame = self._frame(time_ns, node, outgoing)
        if outgoing.dropped or frame.size_bytes > self._max_payload_bytes:  # the MAC never sees it
            frame.sender_outcome = Outcome.fault if outgoing.dropped else Outcome.oversize
            frame.end_ns = time_ns
            self._mac.sent.append(frame)
        else:
            self._mac.enqueue(frame)
        if frame.effects.copy:  # its duplicates are numbered before those of the next frame
            self._settle()

    # Frames that have been sent.

    def _settle(self) -> None:
        """Run the stages over the frames that have been sent."""
        if frames := self._mac.sent:
            self._mac.sent = []
            receptions = Receptions.of(frames, len(self._node_ids))
            for stage in self.chain:
                stage(frames, receptions)
            if self._csma is not None:
                address_all(frames, receptions, self._csma)
            self._book(frames, receptions)

    def _judge(self, frame: Frame) -> None:
        """Decide the receptions of a frame that ends now, or of an acknowledgement, which has no rows."""
        if self._mac.sent:
            self._settle()
        if frame.decoded is None:
            receptions = Receptions.of([frame], len(self._node_ids))
            for stage in self.chain[:-2]:  # without latency
                stage([frame], receptions)
            if self._csma is not None:
                address(frame, receptions.outcome[0], self._csma.medium.locked(frame), receptions.cause[0])

    def _acknowledged(self, frame: Frame) -> None:
        assert frame.ack is not None
        self._trace.acknowledge(frame.row, frame.ack.on_air_ns, frame.acked)

    def _book(self, frames: Sequence[Frame], receptions: Receptions) -> None:
        """Append the receptions in range to the trace, and put the pending ones in flight."""
        for (number, column), flips in receptions.flips.items():
            receiver_number = int(receptions.receivers()[number, column])
            frames[number].altered[receiver_number] = flipped(frames[number].payload, flips)
        near = receptions.outcome != OUT_OF_RANGE
        addressed = [number for number, frame in enumerate(frames) if frame.attempt]
        for number in addressed:  # its row stands also if nobody could receive it
            near[number, frames[number].to] = True
        each = near.sum(axis=1)
        column = near.nonzero()[1]
        receiver = column if receptions.receiver is None else receptions.receiver[near]
        near_ones = len(receiver) - int(each[addressed].sum())
        broadcasts = len(frames) - len(addressed)
        self._counts[Outcome.out_of_range] += broadcasts * (len(self._node_ids) - 1) - near_ones
        self._enter(
            frames, each, receiver, receptions.outcome[near], receptions.arrival_ns[near], receptions.cause[near]
        )
        for number, copied, later_ns, cause in receptions.copies:
            again = np.flatnonzero(copied & (receptions.outcome[number] == PENDING))
            if len(again):
                frame = frames[number]
                frame = replace(frame, copy=self._next_copy(frame.sender, frame.seq), cause=cause)
                each, pending = np.array([len(again)]), np.full(len(again), PENDING, np.uint8)
                arrival_ns = receptions.arrival_ns[number, again] + later_ns
                receiver = receptions.receivers()[number, again]
                self._enter([frame], each, receiver, pending, arrival_ns, np.int16(cause))

    def _enter(
        self,
        frames: Sequence[Frame],
        each: NDArray[np.intp],
        receiver: NDArray[np.intp],
        outcome: NDArray[np.uint8],
        arrival_ns: NDArray[np.int64],
        cause: NDArray[np.int16] | np.int16,
    ) -> None:
        """Append receptions to the trace, and put the pending ones in flight.

        `each` (K,) is the number of receptions of each frame; the other arrays (n,) hold those of the first frame,
        then those of the second, and so on.
        """
        columns = dict(zip(_COLUMNS, np.array([_OF_FRAME(frame) for frame in frames], np.int64).T, strict=True))
        if self._trace.chooses:
            columns.update(zip(CHOSEN, np.array([_CHOICES(frame) for frame in frames]).T, strict=True))
        if self._trace.acknowledges:
            columns["attempt"] = np.array([frame.attempt for frame in frames])
        columns["payload_digest"] = np.array([payload_digest(frame.payload) for frame in frames], np.uint64)
        frame_index = np.repeat(np.arange(len(frames)), each)
        powers_db = None
        if self._reception is not None and self._trace.knows_power:
            powers_db = self._reception.powers_db(frames, frame_index, receiver)
        first = self._trace.append(columns, each, receiver, outcome, cause, arrival_ns, powers_db)
        for number, frame in enumerate(frames):
            frame.row = first + int(each[: number + 1].sum()) - 1 if frame.attempt else -1
            for node, payload in frame.altered.items():
                for row in np.flatnonzero((frame_index == number) & (receiver == node)).tolist():
                    self._trace.alter(first + row, payload_digest(payload))
        for kind, number in enumerate(np.bincount(outcome).tolist()):
            if number:
                self._counts[Outcome(kind)] += number
        if self._csma is not None and self._trace.acknowledges:
            self._csma.unicasts.note_duplicates(frames, first, outcome, arrival_ns, self._trace)
        flying = np.flatnonzero(outcome == PENDING)
        self._in_flight.add(frames, frame_index[flying], receiver[flying], first + flying, arrival_ns[flying])

    # Arrivals.

    def next_arrival_ns(self, node: int) -> int | None:
        """Return the time of the next arrival at `node` among the frames that have been sent, or None."""
        self._settle()
        return self._in_flight.next_ns(node)

    def next_arrivals_ns(self) -> IntArray:
        """Return the time of the next arrival at each node (N,), as `next_arrival_ns`, or `NO_ARRIVAL_NS`."""
        self._settle()
        return self._in_flight.by_receiver()

    def next_time(self) -> int | None:
        """Return the time of the next arrival or MAC event, at which `advance` must be called, or None."""
        self._settle()
        # The events of the MAC at a time are processed when time has passed beyond it.
        air_ns = self._mac.next_ns()
        times_ns = (self._in_flight.soonest_ns(), None if air_ns is None else air_ns + 1)
        return min((time_ns for time_ns in times_ns if time_ns is not None), default=None)

    def look_ahead(self, time_ns: int, nodes: Sequence[int] | IntArray) -> None:
        """Process the events of the MAC up to `time_ns`, the first arrival at one of these nodes, or a result.

        The caller guarantees that no frame is enqueued before that.
        """
        if self._csma is None:
            return
        until_ns = self._first_ns(time_ns, nodes)
        while (next_ns := self._csma.next_ns()) is not None and next_ns < until_ns:
            self._csma.step()
            if self._csma.sent or self._csma.unicasts.are_open:
                until_ns = self._first_ns(time_ns, nodes)

    def _first_ns(self, time_ns: int, nodes: Sequence[int] | IntArray) -> int:
        """Return `time_ns`, or the first arrival at one of these nodes or the first result if that is earlier."""
        first_ns = min(time_ns, int(self.next_arrivals_ns()[nodes].min())) if len(nodes) else time_ns
        result_ns = self.next_result_ns()
        return first_ns if result_ns is None else min(first_ns, result_ns)

    def next_result_ns(self) -> int | None:
        """Return the time of the next result of a frame to a single vehicle, as far as it is known, or None."""
        if self._csma is None or not self._csma.unicasts.are_open:
            return None
        self._settle()
        return self._csma.unicasts.next_ns()

    def take_results(self, time_ns: int) -> list[Result]:
        """Remove and return the results up to `time_ns` of frames to single vehicles, in order."""
        return [] if self.next_result_ns() is None or self._csma is None else self._csma.unicasts.take(time_ns)

    def pending_rows(self) -> list[int]:
        """Return the row numbers of the trace whose receptions are in flight."""
        self._settle()
        return self._in_flight.rows()

    def advance(self, time_ns: int) -> Deliveries:
        """Return all packets that arrive up to `time_ns`, ordered by (arrival, sender, seq, receiver)."""
        self._mac.run(time_ns)
        if any(frame.end_ns + MIN_LATENCY_NS <= time_ns for frame in self._mac.sent):
            self._settle()
        return self._arrive(time_ns)

    def foresee(self, time_ns: int) -> Deliveries:
        """Return all packets that will arrive up to `time_ns` at nodes that are up now, in the order of `advance`.

        They stay in flight: `advance` decides them, by the nodes that are up then. The caller guarantees that no
        frame that is enqueued, or goes on air, later arrives by `time_ns`.
        """
        self._settle()
        return self._in_flight.foresee(time_ns, self._topology.up, self._trace)

    def _arrive(self, time_ns: int) -> Deliveries:
        arrived = self._take_arrivals(time_ns)
        if self._csma is not None:
            self._csma.unicasts.miss_duplicates(time_ns, self._topology.up, self._trace, self._counts)
        return arrived

    def _take_arrivals(self, time_ns: int) -> Deliveries:
        table = self._in_flight.take(time_ns)
        if not table.shape[1]:
            return self._in_flight.deliveries(table, self._trace)
        row, up = table[2], self._topology.up[table[1]]
        self._trace.decide(row[up], Outcome.delivered)
        if missed := len(row) - int(up.sum()):
            self._trace.decide(row[~up], Outcome.receiver_down)
            self._counts[Outcome.receiver_down] += missed
            self._in_flight.miss(table[:, ~up])
        self._counts[Outcome.delivered] += len(row) - missed
        self._counts[Outcome.pending] -= len(row)
        return self._in_flight.deliveries(table[:, up], self._trace)

    def busy_ratios(self, time_ns: int) -> list[NDArray[np.float64]]:
        """Return the channel busy ratios (N,) of every window that ends by `time_ns`; none without `[radio.mac]`.

        No frame may be enqueued before `time_ns` after this call.
        """
        if self._csma is None:
            return []
        self._csma.run(time_ns)
        self._csma.medium.count(time_ns)
        return self._csma.medium.windows[: time_ns // WINDOW_NS]

    @property
    def shares_medium(self) -> bool:
        """True if the vehicles share a medium, which they sense."""
        return self._csma is not None

    def busy_ratios_at(self, time_ns: int) -> NDArray[np.float64]:
        """Return the channel busy ratios (N,) of the 100 ms before `time_ns`, a multiple of `SLICE_NS`.

        All events before it have been processed, and it lies no more than a lookahead and a window back.
        """
        assert self._csma is not None
        return self._csma.medium.busy_ratios_at(time_ns)

    def lose(self, delivery: Delivery) -> None:
        """Change a delivery that never reached its process (real time only) to `transport`; call once for each."""
        self._trace.decide([delivery.row], Outcome.transport)
        self._counts[Outcome.delivered] -= 1
        self._counts[Outcome.transport] += 1

    def delay(self, delivery: Delivery, arrival_ns: int) -> None:
        """Correct the arrival of a delivery that the machine brought late (real time only); call once for each."""
        self._trace.delay(delivery.row, arrival_ns)

    def drain(self) -> None:
        """End the run: complete every transmission and reception, without waking a program."""
        self._mac.run(None)
        self._settle()
        self._arrive(NO_ARRIVAL_NS - 1)
