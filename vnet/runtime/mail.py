"""Packets and fixes that a grant brings to the nodes of a process."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from vnet.node import Fix
from vnet.radio import Packet
from vnet.transport import wire


class Mail(NamedTuple):
    """Packets of each node, oldest first, and fixes with their nodes."""

    packets: dict[str, list[Packet]]
    fixes: Sequence[tuple[str, Fix]]

    @classmethod
    def of(cls, packets: Iterable[wire.WirePacket], fixes: Iterable[wire.WireFix]) -> Mail:
        """Return mail from its form on the wire."""
        by_node: dict[str, list[Packet]] = {}
        for packet in packets:
            by_node.setdefault(packet.node, []).append(packet.packet())
        return cls(by_node, [(fix.node, fix.fix()) for fix in fixes])
