"""The cooperative program with its loop changed in two ways, each of which plants a bug.

`by_the_clock` begins its periods by the clock, with the newest fix that a task of its own has received: the fix of
that very instant, if it is there already; else it sends the one before again. `every_fix` works through all fixes
that have come during a pause, and sends a burst of frames.
"""

from __future__ import annotations

import asyncio

from agents.cooperative.estimator import Estimator
from agents.cooperative.options import Options
from agents.cooperative.program import SENDING_SHARE, GnssClock, _broadcast, _report, listening_share
from agents.cooperative.program import main as repaired
from vnet import Fix, Node

__all__ = ["by_the_clock", "every_fix", "repaired"]


class Vehicle:
    """A cooperative vehicle, and what it does in a period."""

    def __init__(self, node: Node) -> None:
        options = Options.parse(node.options)
        self.node = node
        self.estimator = Estimator(node.id, options, node.map, node.rng, node.period_ns)
        self.clock = GnssClock(node)
        slot = int(node.rng.integers(options.slots))
        self._slot_ns = slot * round(SENDING_SHARE * node.period_ns) // options.slots
        self._listening_ns = round(listening_share(self.estimator.name, options) * node.period_ns)

    async def cooperate(self, fix: Fix) -> None:
        """Do what is to be done in the period of a fix."""
        node, clock, estimator = self.node, self.clock, self.estimator
        await clock.sleep_until(fix.time_ns + self._slot_ns)
        estimator.read(node.radio.drain(), clock.now_ns)
        payload_bytes = await _broadcast(node, estimator, fix)

        await clock.sleep_until(fix.time_ns + self._listening_ns)
        packets = node.radio.drain()
        estimator.read(packets, clock.now_ns)
        estimator.filter(fix)
        estimator.agree()
        _report(node, estimator, fix, {"heard": len(packets), "bytes": payload_bytes})


async def by_the_clock(node: Node) -> None:
    """Cooperate with a task that receives fixes, and one that begins a period when the clock says so."""
    vehicle = Vehicle(node)
    newest = await node.gnss.receive()
    vehicle.clock.set_by(newest)

    async def locate() -> None:
        nonlocal newest
        async for newest in node.gnss:
            vehicle.clock.set_by(newest)

    async def work() -> None:
        while True:
            await vehicle.cooperate(newest)
            periods = vehicle.clock.now_ns // node.period_ns
            await vehicle.clock.sleep_until((periods + 1) * node.period_ns)

    await asyncio.gather(locate(), work())


async def every_fix(node: Node) -> None:
    """Cooperate with each fix in turn, however old it is."""
    vehicle = Vehicle(node)
    async for fix in node.gnss:
        vehicle.clock.set_by(fix)
        await vehicle.cooperate(fix)
