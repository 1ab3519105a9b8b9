"""The smallest useful program: broadcast the own position, count the neighbours.

Each vehicle broadcasts its raw GNSS fix ten times a second and remembers the vehicles that it receives.
Its report is its own fix, and the number of neighbours received in the last second. `docs/tutorial.md` builds
this file from nothing.
"""

from __future__ import annotations

import struct

from vnet import Fix, Node

FRAME = struct.Struct("<dd")  # east and north in metres
FRESH_NS = 1_000_000_000  # a neighbour was received within this time


def encode(fix: Fix) -> bytes:
    """Encode a fix as the 16 bytes of a frame."""
    return FRAME.pack(*fix.position_m)


def decode(payload: bytes) -> tuple[float, float] | None:
    """Decode the position in a frame; None for other bytes, which the radio may well deliver."""
    return FRAME.unpack(payload) if len(payload) == FRAME.size else None


async def main(node: Node) -> None:
    """Broadcast every fix, remember the neighbours, report."""
    last_heard_ns: dict[str, int] = {}
    async for fix in node.gnss:
        await node.radio.broadcast(encode(fix))
        for packet in node.radio.drain():
            if decode(packet.payload) is not None:
                last_heard_ns[packet.sender] = packet.received_ns
        now_ns = node.now_ns
        fresh = [t for t in last_heard_ns.values() if now_ns - t <= FRESH_NS]
        node.report(fix.position_m, fix.covariance_m2, neighbours=len(fresh))
