"""The window of a process in lockstep: its packets, each with its arrival, and the steps that were made in it.

The emulator grants a process a window of time, in which it passes from instant to instant by itself
(docs/virtual-time.md). Pure: it knows no nodes and no loop.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection
from operator import attrgetter

from vnet.transport import wire


class Window:
    """See the module's text. Packets that no instant has come to stay for the next window."""

    def __init__(self) -> None:
        self.end_ns = 0
        """The end of the window, which is not in it."""
        self._packets: deque[wire.WirePacket] = deque()
        self._steps: list[wire.Step] = []
        self._instants = 0

    def open(self, grant: wire.Grant) -> None:
        """Begin the next window; the steps of the last one have been taken."""
        self.end_ns = grant.end_ns
        self._packets.extend(sorted(grant.packets, key=attrgetter("received_ns")))

    def drop(self, node: str) -> None:
        """Drop the packets of a node whose process is gone."""
        self._packets = deque(packet for packet in self._packets if packet.node != node)

    def end_instant(self, time_ns: int, traffic: wire.Traffic) -> None:
        """Note that the process has nothing left to do at an instant, and what was enqueued at it."""
        self._instants += 1
        if traffic:
            self._steps.append(wire.Step(time_ns, traffic))

    @property
    def has_packets(self) -> bool:
        """True if packets are yet to be taken."""
        return bool(self._packets)

    def first_packet_ns(self, nodes: Collection[str]) -> int:
        """Return the arrival of the first packet at one of these nodes, or the window's end."""
        return next((packet.received_ns for packet in self._packets if packet.node in nodes), self.end_ns)

    def take_packets(self, time_ns: int, paused: Collection[str]) -> list[wire.WirePacket]:
        """Remove and return the packets that have arrived by then, oldest first; those of paused nodes wait."""
        if self._packets and self._packets[-1].received_ns <= time_ns and not paused:
            due = list(self._packets)
            self._packets.clear()
            return due
        due = []
        waiting: list[wire.WirePacket] = []
        while self._packets and self._packets[0].received_ns <= time_ns:
            packet = self._packets.popleft()
            (waiting if packet.node in paused else due).append(packet)
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
