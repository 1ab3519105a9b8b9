"""The engine: frames in, deliveries out, in virtual time.

It knows no Zenoh, no asyncio and no wall clock. Drivers `transmit` the nodes' frames, ask for the time of the next
arrival, and `advance` to a time. Every reception (a frame at a receiver) gets exactly one outcome, which is final
at the time of its arrival. Receptions in range are rows of the trace; those out of range are only counted.

A frame passes three steps: it is enqueued, it waits for the medium and is on air, and it has been sent. The state
of the network (positions, nodes that are up, faults) is kept with the frame when it is enqueued. The stages run
after it has been sent, over all frames at once that have been sent since the last query.

All receptions in flight are in one table, whatever their receivers, so that no work is done per reception until a
program takes a packet.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from operator import attrgetter
from typing import Required, TypedDict, overload

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from emulator.fault_plan import PlannedFault
from emulator.radio.csma import Csma
from emulator.radio.faults import LinkFaults, SenderFaults
from emulator.radio.frames import (
    BROADCAST,
    CopyNumbers,
    Frame,
    Receptions,
    Stage,
    Transmission,
    UnicastResult,
    allowed_choices,
    flipped,
)
from emulator.radio.mac import Mac, TransmitQueue
from emulator.radio.outcomes import OUT_OF_RANGE, PENDING, Outcome
from emulator.radio.own_rules import OwnRules
from emulator.radio.propagation import transmit_powers_dbm
from emulator.radio.reception import (
    LatencyStage,
    LossStage,
    Reception,
    RoundedUp,
    Signals,
    change_by_faults,
    in_range,
    lose_by_faults,
    peer_cap,
    sender_side,
)
from emulator.radio.sidelink import Sidelink, SidelinkReception
from emulator.radio.topology import Topology, connectivity_of
from emulator.radio.trace import CHOSEN, PERIOD, Trace, payload_digest
from emulator.radio.unicast import Unicasts
from emulator.scenario.scenario import Radio, least_latency_ns
from emulator.world.neighbours import Links
from emulator.world.radio_inputs import RadioInputs
from vnet.radio import Packet, SentFrame
from vnet.types import IntArray
from vnet.units import ANY_TIME, Grid

NO_ARRIVAL_NS = np.iinfo(np.int64).max
"""Time of the next arrival where none is in flight."""
INITIAL_CAPACITY = 1 << 12
"""Receptions for which the table has room at first."""
_ARRIVAL, _RECEIVER, _ROW, _FRAME = range(4)
_OF_PACKET = attrgetter("frame.name", "frame.sent_ns", "frame.payload")
"""Returns what all packets of a transmission share."""


@dataclass(frozen=True, slots=True)
class Delivery:
    """A packet that has reached the node number `receiver`; `row` is the number of its row of the trace."""

    receiver: int
    packet: Packet
    row: int


@dataclass(slots=True)
class Deliveries(Sequence[Delivery]):
    """Packets that have reached their receivers, in the order (arrival, sender, seq, receiver, copy).

    The objects are built at the first access to one of them.
    """

    _table: IntArray
    _frames: dict[int, Transmission]
    _trace: Trace
    _built: list[Delivery] | None = field(default=None, init=False)

    def __len__(self) -> int:
        return int(self._table.shape[1])

    @overload
    def __getitem__(self, index: int) -> Delivery: ...

    @overload
    def __getitem__(self, index: slice) -> list[Delivery]: ...

    def __getitem__(self, index: int | slice) -> Delivery | list[Delivery]:
        return self._all()[index]

    def __iter__(self) -> Iterator[Delivery]:
        return iter(self._all())

    def _all(self) -> list[Delivery]:
        if self._built is None and not len(self):
            self._built = []
        elif self._built is None:
            table = self._table[:, self._order()]
            receivers, rows = table[_RECEIVER].tolist(), table[_ROW].tolist()
            self._built = [*map(Delivery, receivers, self._packets(table), rows)]
        return self._built

    def by_receiver(self) -> Iterator[tuple[int, list[Packet]]]:
        """Yield each receiver's number and its packets, as they stand: by receiver, and in their order for each.

        Nothing is kept of them, which is what takes time where there are many.
        """
        if not len(self):
            return
        order = self._order()
        receivers = self._table[_RECEIVER].take(order)
        small = receivers.astype(np.uint16) if receivers.max() < 1 << 16 else receivers  # sorted by radix
        order = order.take(small.argsort(kind="stable"))
        packets = self._packets(self._table.take(order, axis=1))
        receivers = self._table[_RECEIVER].take(order)
        starts = [0, *(np.flatnonzero(receivers[1:] != receivers[:-1]) + 1).tolist()]
        ends = [*starts[1:], len(packets)]
        for receiver, start, end in zip(receivers.take(starts).tolist(), starts, ends, strict=True):
            yield receiver, packets[start:end]

    def _packets(self, table: IntArray) -> list[Packet]:
        """Return the packets of these columns (4, n) of the table, as they stand."""
        if not table.shape[1]:
            return []
        numbers = table[_FRAME].tolist()
        frames = {number: self._frames[number] for number in set(numbers)}
        of_frames = {number: _OF_PACKET(sent) for number, sent in frames.items()}
        names, sent_ns, payloads = zip(*map(of_frames.__getitem__, numbers), strict=True)
        if any(sent.altered for sent in frames.values()):
            receptions = zip(numbers, table[_RECEIVER].tolist(), payloads, strict=True)
            payloads = tuple(frames[number].altered.get(node, payload) for number, node, payload in receptions)
        powers = self._trace.powers(table[_ROW]) if self._trace.knows_power else ()
        return [*map(Packet, names, sent_ns, table[_ARRIVAL].tolist(), payloads, *powers)]

    def _order(self) -> NDArray[np.intp]:
        order: NDArray[np.intp] = self._table[_ARRIVAL].argsort(kind="stable")
        arrival_ns = self._table[_ARRIVAL, order]
        is_same = arrival_ns[1:] == arrival_ns[:-1]
        if is_same.any() and self._are_mixed(order, is_same):
            tied = np.zeros(len(order), np.bool_)
            tied[1:] = is_same
            tied[:-1] |= is_same
            some = order[tied]
            arrival, receiver, row, _ = self._table[:, some]
            sender, seq, copy = self._trace.frames_of(row)
            order[tied] = some[np.lexsort((row, copy, receiver, seq, sender, arrival))]
        return order

    def _are_mixed(self, order: NDArray[np.intp], is_same: NDArray[np.bool_]) -> bool:
        """Return whether packets that arrive together are of several frames, or not ordered by receiver."""
        receiver, frame = self._table[_RECEIVER, order], self._table[_FRAME, order]
        return bool((is_same & ((frame[1:] != frame[:-1]) | (receiver[1:] < receiver[:-1]))).any())


class InFlight:
    """The receptions in flight to `count` nodes.

    Rows of the table are arrival time, receiver, row of the trace, and frame; columns are receptions. The first
    `_compared` of them are in `_by_receiver`: many drivers never ask for it.
    """

    def __init__(self, count: int) -> None:
        self._table: IntArray = np.zeros((4, INITIAL_CAPACITY), np.int64)
        self._length = 0
        self._frames: dict[int, Transmission] = {}
        self._frames_kept = 64
        self._next_frame = 0
        self._by_receiver: IntArray = np.full(count, NO_ARRIVAL_NS)
        self._compared = 0
        self._soonest_ns = NO_ARRIVAL_NS
        self._foreseen_ns = -1

    def add(
        self,
        transmissions: Sequence[Transmission],
        frame_index: NDArray[np.intp],
        receiver: IntArray,
        row: IntArray,
        arrival_ns: IntArray,
    ) -> None:
        """Add receptions, arrays (n,) each: `frame_index` are indices into `transmissions`, `row` is in the trace.

        None of them arrives by a time up to which arrivals have been foreseen.
        """
        if not len(row):
            return
        soonest_ns = int(arrival_ns.min())
        assert soonest_ns > self._foreseen_ns, f"arrival at {soonest_ns} ns: foreseen up to {self._foreseen_ns} ns"
        self._make_room(len(row))
        new = self._table[:, self._length : self._length + len(row)]
        new[_ARRIVAL], new[_RECEIVER], new[_ROW] = arrival_ns, receiver, row
        new[_FRAME] = frame_index + self._next_frame
        self._frames.update(enumerate(transmissions, self._next_frame))
        self._next_frame += len(transmissions)
        self._length += len(row)
        self._soonest_ns = min(self._soonest_ns, soonest_ns)

    def _make_room(self, more: int) -> None:
        if self._length + more > self._table.shape[1]:
            grown = np.zeros((4, 2 * (self._length + more)), np.int64)
            grown[:, : self._length] = self._table[:, : self._length]
            self._table = grown

    def soonest_ns(self) -> int | None:
        """Return the time of the next arrival at any node, or None."""
        return self._soonest_ns if self._length else None

    def by_receiver(self) -> IntArray:
        """Return the time of the next arrival at each receiver (N,), or `NO_ARRIVAL_NS`; not to be changed."""
        if self._compared < self._length:
            new = self._table[:, self._compared : self._length]
            np.minimum.at(self._by_receiver, new[_RECEIVER], new[_ARRIVAL])
            self._compared = self._length
        return self._by_receiver

    def foresee(self, time_ns: int, up: NDArray[np.bool_], trace: Trace) -> Deliveries:
        """Return what arrives up to `time_ns` at receivers that are `up` (N,); it stays in flight.

        None that is added later may arrive by then.
        """
        self._foreseen_ns = max(self._foreseen_ns, time_ns)
        flying = self._table[:, : self._length]
        due = flying[_ARRIVAL] <= time_ns
        due[due] = up[flying[_RECEIVER, due]]
        return Deliveries(flying[:, due], self._frames, trace)

    def rows(self) -> list[int]:
        """Return the row numbers of the trace of all receptions in flight."""
        return [int(row) for row in self._table[_ROW, : self._length]]

    def take(self, time_ns: int) -> IntArray:
        """Remove and return the columns (4, n) of the receptions that arrive up to `time_ns`."""
        if self._soonest_ns > time_ns:
            return self._table[:, :0]
        flying = self._table[:, : self._length]
        due = flying[_ARRIVAL] <= time_ns
        taken, left = flying[:, due], flying[:, ~due]
        self._length = left.shape[1]
        self._table[:, : self._length] = left
        self._soonest_ns = int(left[_ARRIVAL].min(initial=NO_ARRIVAL_NS))
        self._by_receiver[:], self._compared = NO_ARRIVAL_NS, 0
        return taken

    def miss(self, table: IntArray) -> None:
        """Note in transmissions to single vehicles that these receptions, which `take` returned, found nobody."""
        for number in table[_FRAME].tolist():
            self._frames[number].is_missed = True

    def deliveries(self, table: IntArray, trace: Trace) -> Deliveries:
        """Return the receptions that `take` returned as packets."""
        deliveries = Deliveries(table, self._frames, trace)
        self._forget()
        return deliveries

    def _forget(self) -> None:
        """Forget the frames that no reception in flight needs; earlier `Deliveries` keep the old dictionary."""
        if len(self._frames) > self._frames_kept:
            needed = set(self._table[_FRAME, : self._length].tolist())
            self._frames = {number: self._frames[number] for number in needed}
            self._frames_kept = 2 * len(needed) + 64


NO_CHOICES = None, None, None, None
"""Power, bit rate, addressee and period of a frame without any of its own."""

_choices = attrgetter("power_dbm", "rate_mbps", "to", "period_ms")


class _Chosen(TypedDict, total=False):
    """The fields of a frame that a program may choose."""

    bitrate_mbps: Required[float]
    gain_db: float
    to: int
    ticket: int
    period_ms: int


_COLUMNS = ("sent_ns", "sender", "seq", "size_bytes", "copy", "on_air_ns", "left_ns")
_CHOICES = attrgetter(*(f"frame.{name}" for name in CHOSEN))
_OF_FRAME = ("frame.sent_ns", "frame.sender", "frame.seq", "frame.size_bytes", "frame.copy")
_VALUES = attrgetter(*_OF_FRAME, "on_air_ns", "end_ns")
"""Returns a transmission's values of `_COLUMNS` of the trace."""


class Engine:
    """The state of the emulated radio. Nodes have the numbers 0 … N-1 in the order of `node_ids`.

    `position_m` (N, 2) are positions in metres. `inputs` are those that a scenario reads from files; `rules` are
    those of the user's own. `arrivals` are rounded up to instants of a grid.
    """

    def __init__(
        self,
        node_ids: Sequence[str],
        radio: Radio,
        seed: int,
        position_m: NDArray[np.float64],
        inputs: RadioInputs | None = None,
        rules: OwnRules | None = None,
        arrivals: Grid = ANY_TIME,
    ) -> None:
        self._node_ids = tuple(node_ids)
        self._radio = radio
        self._max_payload_bytes = radio.max_payload_bytes
        self._periods_ms = () if radio.sidelink is None else radio.sidelink.periods_ms
        count = len(node_ids)
        signals = Signals(seed, radio.fading, count) if radio.is_physical else None
        nakagami = signals.nakagami if signals is not None else None
        self._topology = Topology(position_m, connectivity_of(radio, seed, inputs), radio.max_peers, nakagami)
        self._trace = Trace(node_ids, radio.mac is not None, knows_power=radio.path_loss is not None)
        self._copies = CopyNumbers()
        self._least_latency_ns = least_latency_ns(radio)
        self._unicasts = Unicasts(self._least_latency_ns, self._trace)
        self._mac: Mac
        if radio.sidelink is not None and signals is not None:
            self._mac = Sidelink(radio, signals, seed)
        elif radio.mac is not None and signals is not None:
            self._mac = Csma(radio, signals, self._topology, self._trace, self._copies, self._unicasts, seed)
        else:
            self._mac = TransmitQueue(seed, radio)
        self._rules = rules or OwnRules(seed, node_ids)
        self._rules.tx_power_dbm = transmit_powers_dbm(radio.path_loss, count, inputs.units if inputs else ())
        self._links = LinkFaults(seed, self._mac, count, self._rules)
        ask = partial(self._rules.ask_sender, max_bytes=radio.max_payload_bytes)
        self._senders = SenderFaults(self._node_ids, self._copies, ask)
        self._reception: Reception | SidelinkReception | None = None
        if signals is not None:
            stage = SidelinkReception if radio.sidelink is not None else Reception
            self._reception = stage(radio, signals)
        self.deciding: list[Stage] = [
            in_range,
            sender_side,
            peer_cap,
            lose_by_faults,
            *([self._reception] if self._reception is not None else []),
            LossStage(seed, radio.loss),
        ]
        """Stages that decide which receptions succeed."""
        self.timing: list[Stage] = [LatencyStage(seed, radio), change_by_faults]
        """Stages after them, which say when and how often those arrive, and with which bytes."""
        if arrivals.step_ns:
            self.timing.append(RoundedUp(arrivals))
        self._counts = dict.fromkeys(Outcome, 0)
        self._next_seq = [0] * len(node_ids)
        self._number = {node: number for number, node in enumerate(node_ids)}
        self._in_flight = InFlight(len(node_ids))
        self.on_payload: Sequence[Callable[[int, int, int, bytes], None]] = ()
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
        if not up:
            self._unicasts.forget(node)

    def set_faults(self, active: Sequence[PlannedFault], time_ns: int) -> None:
        """Let exactly these faults act from `time_ns` on. Receptions in flight are not affected."""
        for planned in active:
            self._trace.name_cause(planned.number, planned.label)
        self._links.update(active, time_ns)
        self._senders.update(active)

    # Enqueueing.

    def number_next(self, node: int, seq: int) -> None:
        """Give the next frame of a node this number: a trace lacks the frames that nobody was in range of."""
        self._next_seq[node] = seq

    def transmit(self, time_ns: int, node: int, frames: Sequence[SentFrame | bytes]) -> None:
        """Enqueue frames that `node` sends at `time_ns`, in order. A node that is down sends nothing.

        A payload alone is broadcast with the scenario's power and bit rate.
        """
        self.transmit_all(time_ns, [(node, frames)])

    def transmit_all(self, time_ns: int, by_sender: Iterable[tuple[int, Sequence[SentFrame | bytes]]]) -> None:
        """Enqueue the frames of several nodes, each as `transmit` does: what they need is drawn at once."""
        self._run(time_ns)
        self._topology.advance(time_ns)
        sent = [
            frame
            for node, frames in by_sender
            if self._topology.is_up(node)
            for asked in frames
            if (frame := self._numbered(time_ns, node, asked)) is not None
        ]
        if not self._senders.misbehave:
            self._enqueue(sent)
            return
        for frame in sent:
            self._settle()  # duplicates of frames sent before are numbered before the copies sent now
            for each in self._senders.frames(frame):
                self._enqueue([each])

    def _numbered(self, time_ns: int, node: int, asked: SentFrame | bytes) -> Frame | None:
        """Return the next frame of a node; None for one to nobody, which is not sent."""
        payload = asked if isinstance(asked, bytes) else asked.payload
        chosen: _Chosen | None = {"bitrate_mbps": self._radio.bitrate_mbps}
        if isinstance(asked, SentFrame) and _choices(asked) != NO_CHOICES:
            chosen = self._chosen(time_ns, node, asked)
        if chosen is None:
            return None
        frame = Frame(
            sender=node,
            seq=self._next_seq[node],
            sent_ns=time_ns,
            payload=payload,
            topology=self._topology.now,
            effects=self._links.effects,
            name=self._node_ids[node],
            **chosen,
        )
        self._next_seq[node] += 1
        for take in self.on_payload:
            take(time_ns, node, frame.seq, payload)
        return frame

    def _chosen(self, time_ns: int, node: int, asked: SentFrame) -> _Chosen | None:
        """Return what a program has chosen for a frame; None for one to nobody, which is not sent."""
        gain_db, bitrate_mbps = allowed_choices(self._radio, asked, self._rules.largest_dbm(node))
        to, ticket = BROADCAST, 0
        if asked.to is not None:
            to = self._number.get(asked.to, BROADCAST)
            if not self._mac.acknowledges:
                return None
            if to in (node, BROADCAST):
                self._unicasts.refuse(node, asked.number, time_ns)
                return None
            ticket, self._trace.acknowledges = self._unicasts.register(node, asked.number), True
        if (gain_db, bitrate_mbps) != (0.0, self._radio.bitrate_mbps):
            self._trace.begin_choices(self._radio.bitrate_mbps)
        period_ms = int(asked.period_ms) if asked.period_ms in self._periods_ms else 0
        self._trace.tells_periods |= period_ms > 0
        return {
            "gain_db": gain_db,
            "bitrate_mbps": bitrate_mbps,
            "to": to,
            "ticket": ticket,
            "period_ms": period_ms,
        }

    def _enqueue(self, frames: Sequence[Frame]) -> None:
        """Give frames to the MAC; it never sees those that are dropped, or too large."""
        offered: list[Transmission] = []
        for frame in frames:
            sent = Transmission(frame, attempt=int(frame.to != BROADCAST))
            if frame.dropped or len(frame.payload) > self._max_payload_bytes:
                sent.sender_outcome = Outcome.fault if frame.dropped else Outcome.oversize
                sent.end_ns = frame.sent_ns
                self._mac.sent.append(sent)
            else:
                offered.append(sent)
        self._mac.enqueue(offered)
        if frames and frames[0].effects.copy:  # their duplicates are numbered before copies sent after them
            self._settle()

    # Frames that have been sent.

    def _run(self, time_ns: int | None) -> None:
        """Have the MAC process its events before `time_ns`, or all of them."""
        while (ended := self._mac.run(time_ns)) is not None:
            self._judge(ended)

    def _judge(self, ended: Transmission) -> None:
        """Tell the MAC who could read a transmission that ends now; an acknowledgement has no rows."""
        self._settle()
        if ended.decoded is None:
            self._mac.judge([ended], self._decided([ended]))

    def _decided(self, transmissions: Sequence[Transmission]) -> Receptions:
        receptions = Receptions.of(transmissions, len(self._node_ids))
        for stage in self.deciding:
            stage(transmissions, receptions)
        return receptions

    def _settle(self) -> None:
        """Run the stages over the frames that have been sent."""
        if transmissions := self._mac.take_sent():
            receptions = self._decided(transmissions)
            for stage in self.timing:
                stage(transmissions, receptions)
            self._mac.judge(transmissions, receptions)
            self._book(transmissions, receptions)

    def _book(self, transmissions: Sequence[Transmission], receptions: Receptions) -> None:
        """Append the receptions in range to the trace, and put the pending ones in flight."""
        for (number, column), flips in receptions.flips.items():
            sent, receiver_number = transmissions[number], int(receptions.receivers()[number, column])
            sent.altered[receiver_number] = flipped(sent.frame.payload, flips)
        near = receptions.outcome != OUT_OF_RANGE
        addressed = [number for number, sent in enumerate(transmissions) if sent.attempt]
        for number in addressed:  # its row stands also if nobody could receive it
            near[number, transmissions[number].frame.to] = True
        each = np.count_nonzero(near, axis=1)
        place = np.flatnonzero(near)  # look-ups with one index are much faster than with a mask of two dimensions
        column = place - np.repeat(np.arange(len(each)) * near.shape[1], each)
        receiver = column if receptions.receiver is None else receptions.receiver.ravel().take(place)
        near_ones = len(receiver) - (int(each[addressed].sum()) if addressed else 0)
        broadcasts = len(transmissions) - len(addressed)
        self._counts[Outcome.out_of_range] += broadcasts * (len(self._node_ids) - 1) - near_ones
        outcome, cause = receptions.outcome.ravel().take(place), receptions.cause.ravel().take(place)
        arrival_ns = receptions.arrival_ns.ravel().take(place)
        self._enter(transmissions, each, receiver, outcome, arrival_ns, cause)
        for number, copied, later_ns, planned in receptions.copies:
            again = np.flatnonzero(copied & (receptions.outcome[number] == PENDING))
            if len(again):
                frame = transmissions[number].frame
                frame = replace(frame, copy=self._copies.next(frame.sender, frame.seq), cause=planned)
                each, pending = np.array([len(again)]), np.full(len(again), PENDING, np.uint8)
                arrival_ns = receptions.arrival_ns[number, again] + later_ns
                receiver = receptions.receivers()[number, again]
                self._enter(
                    [replace(transmissions[number], frame=frame)],
                    each,
                    receiver,
                    pending,
                    arrival_ns,
                    np.int16(planned),
                )

    def _enter(
        self,
        transmissions: Sequence[Transmission],
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
        columns = dict(zip(_COLUMNS, np.array([_VALUES(sent) for sent in transmissions], np.int64).T, strict=True))
        if self._trace.chooses:
            columns.update(zip(CHOSEN, np.array([_CHOICES(sent) for sent in transmissions]).T, strict=True))
        if self._trace.tells_periods:
            columns[PERIOD] = np.array([sent.frame.period_ms for sent in transmissions])
        if self._trace.acknowledges:
            columns["attempt"] = np.array([sent.attempt for sent in transmissions])
        columns["payload_digest"] = np.array(
            [payload_digest(sent.frame.payload) for sent in transmissions], np.uint64
        )
        frame_index = np.repeat(np.arange(len(transmissions)), each)
        powers_db = None
        if self._reception is not None and self._trace.knows_power:
            powers_db = self._reception.powers_db(transmissions, frame_index, receiver)
        first = self._trace.append(columns, each, receiver, outcome, cause, arrival_ns, powers_db)
        for number, sent in enumerate(transmissions):
            sent.row = first + int(each[: number + 1].sum()) - 1 if sent.attempt else -1
            for node, payload in sent.altered.items():
                for row in np.flatnonzero((frame_index == number) & (receiver == node)).tolist():
                    self._trace.alter(first + row, payload_digest(payload))
        for kind, number in enumerate(np.bincount(outcome).tolist()):
            if number:
                self._counts[Outcome(kind)] += number
        if self._trace.acknowledges:
            self._unicasts.note_duplicates(transmissions, first, outcome, arrival_ns)
        flying = np.flatnonzero(outcome == PENDING)
        self._in_flight.add(
            transmissions, frame_index[flying], receiver[flying], first + flying, arrival_ns[flying]
        )

    # Arrivals.

    def next_arrivals_ns(self) -> IntArray:
        """Return the time of the next arrival of a sent frame at each node (N,), or `NO_ARRIVAL_NS`."""
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
        if self._mac.next_ns() is None:
            return
        until_ns = self._first_ns(time_ns, nodes)
        while (next_ns := self._mac.next_ns()) is not None and next_ns < until_ns:
            if (ended := self._mac.step()) is not None:
                self._judge(ended)
            if ended is not None or self._mac.sent or self._unicasts.are_open:
                until_ns = self._first_ns(time_ns, nodes)

    def _first_ns(self, time_ns: int, nodes: Sequence[int] | IntArray) -> int:
        """Return `time_ns`, or the first arrival at one of these nodes or the first result if that is earlier."""
        first_ns = min(time_ns, int(self.next_arrivals_ns()[nodes].min())) if len(nodes) else time_ns
        result_ns = self.next_result_ns()
        return first_ns if result_ns is None else min(first_ns, result_ns)

    def next_result_ns(self) -> int | None:
        """Return the time of the next result of a frame to a single vehicle, as far as it is known, or None."""
        if not self._unicasts.are_open:
            return None
        self._settle()
        return self._unicasts.next_ns()

    def take_results(self, time_ns: int) -> list[UnicastResult]:
        """Remove and return the results up to `time_ns` of frames to single vehicles, in order."""
        return [] if self.next_result_ns() is None else self._unicasts.take(time_ns)

    def pending_rows(self) -> list[int]:
        """Return the row numbers of the trace whose receptions are in flight."""
        self._settle()
        return self._in_flight.rows()

    def advance(self, time_ns: int) -> Deliveries:
        """Return all packets that arrive up to `time_ns`, ordered by (arrival, sender, seq, receiver)."""
        self._run(time_ns)
        if any(sent.end_ns + self._least_latency_ns <= time_ns for sent in self._mac.sent):
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
        self._unicasts.miss_duplicates(time_ns, self._topology.up, self._counts)
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
        self._run(time_ns)
        return self._mac.busy_ratios(time_ns)

    @property
    def shares_medium(self) -> bool:
        """True if the vehicles share a medium, which they sense."""
        return self._mac.shares_medium

    def busy_ratios_at(self, time_ns: int) -> NDArray[np.float64]:
        """Return the channel busy ratios (N,) of the 100 ms before `time_ns`, a multiple of `SLICE_NS`.

        All events before it have been processed, and it lies no more than a lookahead and a window back.
        """
        busy_ratios = self._mac.busy_ratios_at(time_ns)
        assert busy_ratios is not None
        return busy_ratios

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
        self._run(None)
        self._settle()
        self._arrive(NO_ARRIVAL_NS - 1)
