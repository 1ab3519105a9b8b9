"""Vehicle programs that drive, for tests and benchmarks."""

import asyncio
import struct

from vnet import Node
from vnet.node import Fix
from vnet.units import NS_PER_S

DESIRED_S = 0.8
STANDSTILL_M = 5.0


def follow(fix: Fix, ahead_m_s2: float = 0.0) -> float:
    """Return the acceleration of a vehicle that keeps its distance to the one ahead."""
    if fix.gap_m is None or fix.gap_rate_m_s is None or fix.speed_m_s is None:
        return 0.0
    return 0.4 * (fix.gap_m - STANDSTILL_M - DESIRED_S * fix.speed_m_s) + 0.9 * fix.gap_rate_m_s + 0.5 * ahead_m_s2


async def platoon(node: Node) -> None:
    """The first keeps 20 m/s and brakes for a while; others follow by radar, and by what the one ahead says."""
    heard: dict[str, float] = {}
    ahead = f"v{int(node.id[1:]) - 1:02d}"
    async for fix in node.gnss:
        heard |= {packet.sender: struct.unpack("d", packet.payload)[0] for packet in node.radio.drain()}
        asked = follow(fix, heard.get(ahead, 0.0))
        if node.id == "v01":
            asked = -3.0 if 1 < fix.time_ns / NS_PER_S < 2 else 0.5 * (20.0 - (fix.speed_m_s or 0.0))
        node.drive(asked)
        await node.radio.broadcast(struct.pack("d", asked))
        node.report(speed_m_s=fix.speed_m_s or 0.0)


async def restless(node: Node) -> None:
    """Ask for anything at any time: between control instants, several times at one, lanes that are not there."""
    while True:
        await asyncio.sleep(float(node.rng.uniform(0, 0.15)))
        for _ in range(int(node.rng.integers(1, 3))):
            node.drive(float(node.rng.uniform(-6, 5)), int(node.rng.integers(-1, 2)))
        await node.radio.broadcast(b"here")
        seen = [fix.gap_m or 0.0 for fix in node.gnss.drain()]
        node.report(gap_m=sum(seen), heard_so_far=len(node.radio.drain()))


async def brakes_not(node: Node) -> None:
    """Drive on, whatever is ahead."""
    node.drive(0.5)
    await asyncio.sleep(3600)


async def brakes_and_releases(node: Node) -> None:
    """In SUMO: brake in the second second, then leave it to SUMO; say where one is."""
    async for fix in node.gnss:
        time_s = fix.time_ns / NS_PER_S
        if 1.0 <= time_s < 2.0:
            node.drive(-2.0, lane=int(time_s == 1.5))
        else:
            node.drive(release=True)
        await node.radio.broadcast(struct.pack("2d", *fix.position_m))
        node.report(fix.position_m, speed_m_s=fix.speed_m_s or 0.0)
