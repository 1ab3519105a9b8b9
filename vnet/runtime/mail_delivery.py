"""Putting what arrives at the nodes of one process into their mailboxes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from vnet.node import Mailbox, Node, Packet
from vnet.runtime.node_clocks import NodeClocks
from vnet.runtime.ready_queue import OrderedQueue
from vnet.transport import wire


class MailDelivery:
    """Mailboxes of `nodes`; `clocks` give the times that packets show.

    With an `ordered` queue what arrives at the present instant is an event there, and not in the mailbox at once.
    """

    def __init__(self, nodes: Mapping[str, Node], clocks: NodeClocks) -> None:
        self._nodes = nodes
        self._clocks = clocks
        self.ordered: OrderedQueue | None = None

    def deliver(
        self, packets: Iterable[wire.WirePacket], fixes: Sequence[wire.WireFix], time_ns: int | None = None
    ) -> None:
        """Deliver packets, then fixes; `time_ns` is the instant, where there is one."""
        if self.ordered is not None and time_ns is not None:
            self._add_events(self.ordered, packets, fixes, time_ns)
            return
        arrived: dict[str, list[Packet]] = {}
        for packet in packets:
            arrived.setdefault(packet.node, []).append(self._shown(packet))
        for node, some in arrived.items():
            self._nodes[node].radio.inbox.deliver(some)
        for fix in fixes:
            self._nodes[fix.node].gnss.inbox.deliver((fix.fix(),))

    def _shown(self, packet: wire.WirePacket) -> Packet:
        """Return a packet with the time of its arrival as its receiver's clock showed it."""
        received = packet.packet()
        if self._clocks.has_been_wrong(packet.node):
            return replace(received, received_ns=self._clocks.shown_ns(packet.node, received.received_ns))
        return received

    def _add_events(
        self,
        ordered: OrderedQueue,
        packets: Iterable[wire.WirePacket],
        fixes: Sequence[wire.WireFix],
        time_ns: int,
    ) -> None:
        """Deliver what has come before `time_ns`, and let the rest come in the order that is tried."""
        for packet in packets:
            node = self._nodes[packet.node]
            show = partial(node.radio.inbox.deliver, (self._shown(packet),))
            if packet.received_ns < time_ns:
                show()
            else:
                ordered.add_event(
                    node, f"packet from {packet.sender}", "radio", show, partial(_is_awaited, node.radio.inbox)
                )
        latest = {fix.node: fix for fix in fixes}
        for fix in fixes:
            node = self._nodes[fix.node]
            show_fix = partial(node.gnss.inbox.deliver, (fix.fix(),))
            if fix is latest[fix.node] and time_ns % node.period_ns == 0:
                ordered.add_event(node, "fix", "gnss", show_fix, partial(_is_awaited, node.gnss.inbox))
            else:
                show_fix()


def _is_awaited(inbox: Mailbox[Any]) -> bool:
    return inbox.waiting
