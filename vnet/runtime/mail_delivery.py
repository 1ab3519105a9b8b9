"""Putting what arrives at the nodes of one process into their mailboxes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Any

from msgspec.structs import replace

from vnet.mailbox import Mailbox
from vnet.node import Node
from vnet.radio import Packet
from vnet.runtime.mail import Mail
from vnet.runtime.news import NewsItem
from vnet.runtime.node_clocks import NodeClocks
from vnet.runtime.ready_queue import OrderedQueue
from vnet.transport.backbone import WireMessage


class MailDelivery:
    """Mailboxes of `nodes`; `clocks` give the times that packets show.

    With an `ordered` queue what arrives at the present instant is an event there, and not in the mailbox at once.
    """

    def __init__(self, nodes: Mapping[str, Node], clocks: NodeClocks) -> None:
        self._nodes = nodes
        self._clocks = clocks
        self.ordered: OrderedQueue | None = None

    def deliver(self, mail: Mail, time_ns: int | None = None) -> None:
        """Deliver packets, then fixes; `time_ns` is the instant, where there is one."""
        if self.ordered is not None and time_ns is not None:
            self._add_events(self.ordered, mail, time_ns)
            return
        for node, packets in mail.packets.items():
            self._nodes[node].radio.inbox.deliver(self._shown(node, packets))
        for node, fix in mail.fixes:
            self._nodes[node].gnss.inbox.deliver((fix,))

    def deliver_news(self, arrivals: Iterable[NewsItem], time_ns: int | None = None) -> None:
        """Deliver results of frames to single nodes, and messages of the backbone."""
        for arrival in arrivals:
            node = self._nodes[arrival.node]
            if isinstance(arrival, WireMessage):
                self._deliver_message(node, arrival, time_ns)
                continue
            show = partial(node.radio.settle, arrival.number, arrival.result())
            if self.ordered is None or time_ns is None or arrival.time_ns < time_ns:
                show()
            else:
                self.ordered.add_event(node, f"result of send {arrival.number}", "send", show, lambda: True)

    def _deliver_message(self, node: Node, arrival: WireMessage, time_ns: int | None) -> None:
        if node.backbone is None:
            return
        message, inbox = arrival.message(), node.backbone.inbox
        if self._clocks.has_been_wrong(node.id):
            message = message._replace(received_ns=self._clocks.shown_ns(node.id, message.received_ns))
        show = partial(inbox.deliver, (message,))
        if self.ordered is None or time_ns is None or arrival.time_ns < time_ns:
            show()
        else:
            label = f"message from {message.sender}"
            self.ordered.add_event(node, label, "backbone", show, partial(_is_awaited, inbox))

    def _shown(self, node: str, packets: Sequence[Packet]) -> Sequence[Packet]:
        """Return the packets of a node with the times of their arrivals as its clock showed them."""
        if not self._clocks.has_been_wrong(node):
            return packets
        return [replace(each, received_ns=self._clocks.shown_ns(node, each.received_ns)) for each in packets]

    def _add_events(self, ordered: OrderedQueue, mail: Mail, time_ns: int) -> None:
        """Deliver what has come before `time_ns`, and let the rest come in the order that is tried."""
        for name, packets in mail.packets.items():
            node = self._nodes[name]
            for packet, shown in zip(packets, self._shown(name, packets), strict=True):
                show = partial(node.radio.inbox.deliver, (shown,))
                if packet.received_ns < time_ns:
                    show()
                else:
                    awaited = partial(_is_awaited, node.radio.inbox)
                    ordered.add_event(node, f"packet from {packet.sender}", "radio", show, awaited)
        latest = dict(mail.fixes)
        for name, fix in mail.fixes:
            node = self._nodes[name]
            show_fix = partial(node.gnss.inbox.deliver, (fix,))
            if fix is latest[name] and time_ns % node.period_ns == 0:
                ordered.add_event(node, "fix", "gnss", show_fix, partial(_is_awaited, node.gnss.inbox))
            else:
                show_fix()


def _is_awaited(inbox: Mailbox[Any]) -> bool:
    return inbox.waiting
