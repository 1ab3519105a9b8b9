"""A cyclist who sends VAMs, and a car that keeps behind him by them: docs/how-to/standard-messages.md.

Options: `cyclist`, the node that is one; `listens`, whether cars heed VAMs; `asn1`, ETSI's own schema.
"""

from __future__ import annotations

import math

import numpy as np

from docs.examples.its2.standard_messages import PROFILE, Message, decode_vam, encode_vam, schema, station_of
from vnet import Fix, Node

POSITION_M, SPEED_M_S, HEADING_RAD, LONGEST_S = 4.0, 0.5, math.radians(4), 5.0
"""Changes since the last VAM that call for another, and the longest interval (TS 103 300-3, clause 6.4.1)."""
BEHIND_M, BRAKING_M_S2 = 10.0, 4.0
"""Distance that a car keeps, and its deceleration."""


def is_due(fix: Fix, last: Fix | None) -> bool:
    """Tell whether a VAM is sent at this fix, given that of the last one."""
    if last is None or fix.time_ns - last.time_ns >= LONGEST_S * 1e9:
        return True
    turned_rad = 0.0
    if fix.heading_rad is not None and last.heading_rad is not None:
        turned_rad = math.remainder(fix.heading_rad - last.heading_rad, math.tau)
    return (
        float(np.hypot(*(fix.position_m - last.position_m))) > POSITION_M
        or abs((fix.speed_m_s or 0.0) - (last.speed_m_s or 0.0)) > SPEED_M_S
        or abs(turned_rad) > HEADING_RAD
    )


def braking_m_s2(fix: Fix, cyclist: Message) -> float:
    """Return the acceleration that takes a car to the cyclist's speed `BEHIND_M` behind him; 0 if far away.

    A cyclist whose speed is not known counts as standing.
    """
    passed_s, speed_m_s = (fix.time_ns - cyclist.time_ns) / 1e9, cyclist.speed_m_s or 0.0
    gap_m = cyclist.position_m[0] + passed_s * speed_m_s - float(fix.position_m[0]) - BEHIND_M
    closing_m_s = (fix.speed_m_s or 0.0) - speed_m_s
    needed_m_s2 = closing_m_s**2 / (2 * max(gap_m, 0.1))
    return -needed_m_s2 if closing_m_s > 0 and needed_m_s2 > BRAKING_M_S2 / 2 else 0.0


async def main(node: Node) -> None:
    """Send VAMs if one is the cyclist; else heed them."""
    types = schema(node.options.get("asn1", PROFILE), "VAM")
    sent: Fix | None = None
    cyclist: Message | None = None
    vams = 0
    async for fix in node.gnss:
        for packet in node.radio.drain():
            cyclist = decode_vam(packet.payload, types, fix.time_ns) or cyclist
        if node.id == node.options.get("cyclist") and is_due(fix, sent):
            here_m = float(fix.position_m[0]), float(fix.position_m[1])
            told = Message(station_of(node.id), fix.time_ns, here_m, fix.heading_rad, fix.speed_m_s)
            await node.radio.broadcast(encode_vam(told, types))
            sent, vams = fix, vams + 1
        if cyclist is not None and node.options.get("listens", True):
            node.drive(acceleration_m_s2=braking_m_s2(fix, cyclist))
        node.report(fix.position_m, fix.covariance_m2, vams=vams)
