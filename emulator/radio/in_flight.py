"""Receptions in flight, and the packets that have arrived.

All receptions in flight are in one table, whatever their receivers, so that no work is done per reception until a
program takes a packet.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import overload

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from emulator.radio.frames import Transmission
from emulator.radio.trace import Trace
from vnet.radio import Packet
from vnet.types import IntArray

NO_ARRIVAL_NS = np.iinfo(np.int64).max
"""Time of the next arrival where none is in flight."""
INITIAL_CAPACITY = 1 << 12
"""Receptions for which the table has room at first."""
_ARRIVAL, _RECEIVER, _ROW, _FRAME = range(4)


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
        if self._built is None:
            table = self._table[:, self._order()]
            receivers, rows = table[_RECEIVER].tolist(), table[_ROW].tolist()
            self._built = [*map(Delivery, receivers, self._packets(table), rows)]
        return self._built

    def by_receiver(self) -> Iterator[tuple[int, list[Packet]]]:
        """Yield each receiver's number and its packets, as they stand: by receiver, and in their order for each.

        Nothing is kept of them, which is what takes time where there are many.
        """
        table = self._table[:, self._order()]
        table = table[:, np.argsort(table[_RECEIVER], kind="stable")]
        packets = self._packets(table)
        first = 0
        for receiver, count in Counter(table[_RECEIVER].tolist()).items():
            yield receiver, packets[first : first + count]
            first += count

    def _packets(self, table: IntArray) -> list[Packet]:
        """Return the packets of these columns (4, n) of the table, as they stand."""
        arrivals_ns, receivers, _, numbers = table.tolist()
        transmissions = [self._frames[number] for number in numbers]
        packets = [
            Packet(sent.frame.name, sent.frame.sent_ns, arrival_ns, sent.altered.get(receiver, sent.frame.payload))
            if sent.altered
            else Packet((frame := sent.frame).name, frame.sent_ns, arrival_ns, frame.payload)
            for sent, arrival_ns, receiver in zip(transmissions, arrivals_ns, receivers, strict=True)
        ]
        if not self._trace.knows_power:
            return packets
        powers = zip(packets, *self._trace.powers(table[_ROW]), strict=True)
        return [replace(packet, rssi_dbm=rssi_dbm, snr_db=snr_db) for packet, rssi_dbm, snr_db in powers]

    def _order(self) -> NDArray[np.intp]:
        order: NDArray[np.intp] = self._table[_ARRIVAL].argsort(kind="stable")
        arrival_ns = self._table[_ARRIVAL, order]
        is_same = arrival_ns[1:] == arrival_ns[:-1]
        if is_same.any():
            tied = np.append(is_same, False) | np.append(False, is_same)
            some = order[tied]
            arrival, receiver, row, _ = self._table[:, some]
            rows = self._trace.rows(row)
            order[tied] = some[np.lexsort((row, rows["copy"], receiver, rows["seq"], rows["sender"], arrival))]
        return order


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

    def next_ns(self, receiver: int) -> int | None:
        """Return the time of the next arrival at `receiver`, or None."""
        next_ns = int(self.by_receiver()[receiver])
        return None if next_ns == NO_ARRIVAL_NS else next_ns

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
            needed = np.unique(self._table[_FRAME, : self._length]).tolist()
            self._frames = {number: self._frames[number] for number in needed}
            self._frames_kept = 2 * len(needed) + 64
