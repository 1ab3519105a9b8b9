"""The window of a process in lockstep: its packets, each with its arrival, and the steps that were made in it.

The emulator grants a process a window of time, in which it passes from instant to instant by itself
(docs/virtual-time.md). Pure: it knows no nodes and no loop.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection
from operator import itemgetter

from vnet.radio import Packet
from vnet.transport import wire


class Window:
    """See the module's text. Packets that no instant has come to stay for the next window."""

    def __init__(self) -> None:
        self.end_ns = 0
        """The end of the window, which is not in it."""
        self._new: dict[str, list[Packet]] = {}
        self._packets: deque[tuple[int, str, Packet]] = deque()
        self._steps: list[wire.Step] = []
        self._instants = 0

    def open(self, end_ns: int, packets: dict[str, list[Packet]]) -> None:
        """Begin the next window; the steps of the last one have been taken."""
        if self._new:
            self._queue_new()
        self.end_ns = end_ns
        self._new = packets

    def _queue_new(self) -> None:
        """Put packets in the order of their arrivals: only when needed, because most are due at once."""
        new = [(packet.received_ns, node, packet) for node, some in self._new.items() for packet in some]
        self._packets.extend(sorted(new, key=itemgetter(0)))
        self._new = {}

    def drop(self, node: str) -> None:
        """Drop the packets of a node whose process is gone."""
        self._new.pop(node, None)
        self._packets = deque(entry for entry in self._packets if entry[1] != node)

    def end_instant(self, time_ns: int, traffic: wire.Traffic) -> None:
        """Note that the process has nothing left to do at an instant, and what was enqueued at it."""
        self._instants += 1
        if traffic:
            self._steps.append(wire.Step(time_ns, traffic))

    @property
    def has_packets(self) -> bool:
        """True if packets are yet to be taken."""
        return bool(self._new or self._packets)

    def first_packet_ns(self, nodes: Collection[str]) -> int:
        """Return the arrival of the first packet at one of these nodes, or the window's end."""
        self._queue_new()
        return next((received_ns for received_ns, node, _ in self._packets if node in nodes), self.end_ns)

    def take_packets(self, time_ns: int, paused: Collection[str]) -> dict[str, list[Packet]]:
        """Remove and return the packets that have arrived by then, oldest first; those of paused nodes wait."""
        due = self._new
        if not (self._packets or paused) and all(some[-1].received_ns <= time_ns for some in due.values()):
            self._new = {}
            return due
        self._queue_new()
        due = {}
        waiting: list[tuple[int, str, Packet]] = []
        while self._packets and self._packets[0][0] <= time_ns:
            _, node, packet = entry = self._packets.popleft()
            if node in paused:
                waiting.append(entry)
            else:
                due.setdefault(node, []).append(packet)
        self._packets.extendleft(reversed(waiting))
        return due

    def take_final(self, last: wire.Traffic) -> wire.Traffic:
        """Return the exceptions and notes that have not been taken, and those of the `last` traffic."""
        steps, _ = self.take_steps()
        parts = [*(step.traffic for step in steps), last]
        unhandled = [each for part in parts for each in part.unhandled]
        return wire.Traffic(unhandled=unhandled, notes=[note for part in parts for note in part.notes])

    def take_steps(self) -> tuple[list[wire.Step], int]:
        """Return the steps since the last call, and the number of instants at which the process ran."""
        taken = self._steps, self._instants
        self._steps, self._instants = [], 0
        return taken
