"""Beacons of a size and a rate: docs/how-to/three-radios.md."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass

from vnet import Node


@dataclass(frozen=True)
class Options:
    """Options of the program: beacons a second, and their size."""

    rate_hz: float = 10.0
    size_bytes: int = 190


async def main(node: Node) -> None:
    """Broadcast a beacon each 1 / `rate_hz` seconds, from a random time on."""
    options = Options(**node.options)
    period_s = 1 / options.rate_hz
    told_ms = 1000 * period_s if 1000 * period_s in node.radio.periods_ms else None  # else a radio learns it
    await asyncio.sleep(node.rng.uniform(0, period_s))
    while True:
        await node.radio.broadcast(bytes(options.size_bytes), period_ms=told_ms)
        node.radio.drain()
        await asyncio.sleep(period_s)
