"""Rules of both pacings for the messages of a process, and the encoding of packets."""

from __future__ import annotations

from collections.abc import Sequence

from vnet.errors import VnetError
from vnet.radio import Packet
from vnet.transport import wire


class ProtocolError(VnetError):
    """A message that does not fit what its process was told, or speaks for others."""


def check_ownership(nodes: Sequence[str], traffic: wire.Traffic, waiting: Sequence[str] = ()) -> None:
    """Raise ProtocolError if the traffic of the process of `nodes`, or its `waiting` nodes, are not its own."""
    sent = traffic.frames, traffic.messages, traffic.actions
    told = *sent, traffic.reports, traffic.endings, traffic.unhandled, traffic.notes, traffic.deviations
    own = frozenset(nodes)  # of a simulation a thousand, each of which is looked for several times
    for node in [part.node for parts in told for part in parts] + [*waiting]:
        if node not in own:
            raise ProtocolError(f"the process of {nodes[0]} speaks for {node}, which is not its own")
    for action in traffic.actions:
        if not action.is_sound:
            raise ProtocolError(f"{action.node} asks for an acceleration that is no number")


def check_yield(nodes: Sequence[str], message: wire.Yield, granted_ns: int, end_ns: int) -> None:
    """Raise ProtocolError if a yield of these nodes' process breaks its window, `granted_ns` to `end_ns`."""
    if message.next_timer_ns is not None and message.next_timer_ns < end_ns:
        raise ProtocolError(
            f"yield {message.seq} of {nodes[0]}: its next timer, {message.next_timer_ns}, lies before the end "
            f"of its window, {end_ns}"
        )
    check_ownership(nodes, wire.Traffic(), [*message.waiting_radio, *message.waiting_gnss])
    earliest_ns = granted_ns
    for step in message.steps:
        if not earliest_ns <= step.time_ns < end_ns:
            raise ProtocolError(
                f"yield {message.seq} of {nodes[0]}: a step at {step.time_ns}, where {earliest_ns} to "
                f"{end_ns - 1} are allowed"
            )
        earliest_ns = step.time_ns + 1
        check_ownership(nodes, step.traffic)


def wire_packet(node: str, packet: Packet) -> wire.WirePacket:
    """Encode a packet for its receiver `node`."""
    sender, sent_ns, received_ns, payload = packet.sender, packet.sent_ns, packet.received_ns, packet.payload
    return wire.WirePacket(node, sender, sent_ns, received_ns, payload, packet.rssi_dbm, packet.snr_db)
