"""Emergency brake warning in a column of human drivers: docs/how-to/brake-warning.md.

A driver keeps a distance by the intelligent driver model (Treiber, Hennecke and Helbing 2000), on what was there
`reaction_s` ago. A share `equipped` of the vehicles has a radio: whoever brakes hard warns, and a vehicle that is
warned by one ahead brakes at once.
"""

from __future__ import annotations

import math
import struct
from collections import deque
from dataclasses import dataclass

from vnet import Node
from vnet.node import Fix
from vnet.units import NS_PER_S

HARD_M_S2 = -4.0
"""Braking from which on a vehicle warns."""
WARNING = struct.Struct("d")
"""Position of the sender along the road in m."""


@dataclass(frozen=True)
class Options:
    """Options of the program: share of vehicles with a radio, reaction, warned braking, and the drivers' model."""

    equipped: float = 0.5
    reaction_s: float = 1.2
    warned_m_s2: float = -5.0
    heed_m: float = 250.0
    heed_s: float = 2.0
    brakes_at_s: float = 10.0
    cruise_m_s: float = 30.0
    headway_s: float = 1.0
    standstill_m: float = 2.0
    acceleration_m_s2: float = 1.5
    comfortable_m_s2: float = 2.0


def wished(options: Options, fix: Fix) -> float:
    """Return the acceleration of the intelligent driver model in m/s²."""
    speed_m_s = fix.speed_m_s or 0.0
    free = 1 - (speed_m_s / options.cruise_m_s) ** 4
    if fix.gap_m is None or fix.gap_rate_m_s is None:
        return options.acceleration_m_s2 * free
    scale = 2 * math.sqrt(options.acceleration_m_s2 * options.comfortable_m_s2)
    closing = speed_m_s * -fix.gap_rate_m_s / scale
    gap_m = options.standstill_m + max(0.0, options.headway_s * speed_m_s + closing)
    return max(-8.0, options.acceleration_m_s2 * (free - (gap_m / max(fix.gap_m, 0.1)) ** 2))


async def main(node: Node) -> None:
    """Drive as people do, and brake when warned; the first vehicle makes an emergency stop."""
    options = Options(**node.options)
    has_radio, is_first = node.rng.random() < options.equipped, int(node.id[1:]) == 1
    seen: deque[Fix] = deque(maxlen=1 + round(options.reaction_s * NS_PER_S / node.period_ns))
    heeds_until_ns = 0
    async for fix in node.gnss:
        seen.append(fix)
        asked = wished(options, seen[0])
        if is_first and fix.time_ns >= options.brakes_at_s * NS_PER_S:
            asked = -8.0
        for packet in node.radio.drain():
            (ahead_m,) = WARNING.unpack(packet.payload)
            if has_radio and 0 < ahead_m - fix.position_m[0] < options.heed_m:
                heeds_until_ns = packet.sent_ns + round(options.heed_s * NS_PER_S)
        if node.now_ns < heeds_until_ns:
            asked = min(asked, options.warned_m_s2)
        node.drive(asked)
        if has_radio and asked < HARD_M_S2:
            await node.radio.broadcast(WARNING.pack(fix.position_m[0]))
