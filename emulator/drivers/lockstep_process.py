"""The state of one process at the barrier of a run: what it is granted, waits for, and has done."""

from __future__ import annotations

from collections.abc import Sequence

from vnet.radio import Packet
from vnet.transport import wire


class LockstepProcess:
    """One event loop: its nodes, what they last said, and what waits for its next wake-up.

    `order` is its place among all processes. `plan` numbers its planned wake-up: earlier ones are void.
    """

    def __init__(self, nodes: Sequence[str], order: int) -> None:
        self.id = nodes[0]
        self.nodes = tuple(nodes)
        self.order = order
        self.plan = -1
        self.seq = 0
        self.granted_ns = 0
        self.next_timer_ns: int | None = None
        self.waiting_radio: Sequence[str] = ()
        self.waiting_gnss: Sequence[str] = ()
        self.steps: Sequence[wire.Step] = ()
        self.packets: dict[str, list[Packet]] = {node: [] for node in self.nodes}
        self.next_fix = dict.fromkeys(self.nodes, 0)
        self.paused: set[str] = set()
        self.affected: set[str] = set()
        self.clocks: list[wire.ClockError] = []

    @property
    def running(self) -> list[str]:
        """Nodes that are not paused."""
        return [node for node in self.nodes if node not in self.paused]

    def take_packets(self) -> dict[str, list[Packet]]:
        """Return the packets of nodes that run, and have any."""
        due = {node: self.packets[node] for node in self.running if self.packets[node]}
        self.packets.update({node: [] for node in due})
        return due

    def take_clocks(self) -> list[wire.ClockError]:
        changed, self.clocks = self.clocks, []
        return changed
