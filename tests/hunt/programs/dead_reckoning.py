"""Vehicles send their positions. Once a second they check that the next fix comes; if not, they reckon on without.

The bug: the watchdog says that the vehicle reckons, and the task that reckons takes that back as it ends. If the
fix comes between the watchdog and the task, the task is cancelled before it begins, and the vehicle reckons for
good.
"""

from __future__ import annotations

import asyncio

from tests.hunt.programs.messages import PERIOD_S, send
from vnet import Fix, Node
from vnet.types import Array
from vnet.units import NS_PER_S

STEP_S = 0.05
"""Time between two reckoned positions."""


class Vehicle:
    """A vehicle that knows whether it reckons."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._reckons = False
        self._reckoning: asyncio.Task[None] | None = None
        self._watchdog: asyncio.TimerHandle | None = None
        self._fixes: list[Fix] = []

    async def run(self) -> None:
        """Send positions until the run ends."""
        async for fix in self._node.gnss:
            await self._stop_reckoning()
            self._fixes = [*self._fixes[-1:], fix]
            if fix.time_ns % NS_PER_S == 0:
                self._watchdog = asyncio.get_running_loop().call_later(PERIOD_S, self._silent)
            await self._send(fix.position_m)
            self._node.report(fix.position_m, reckons=self._reckons)

    async def _send(self, position_m: Array) -> None:
        await send(self._node, "position", *position_m.tolist(), self._reckons)

    async def _stop_reckoning(self) -> None:
        if self._watchdog is not None:
            self._watchdog.cancel()
        if self._reckoning is not None:
            self._reckoning.cancel()
            await asyncio.wait({self._reckoning})
            self._reckoning = None

    def _silent(self) -> None:
        self._reckons = True
        self._reckoning = asyncio.create_task(self._reckon())

    async def _reckon(self) -> None:
        first, last = self._fixes[0], self._fixes[-1]
        step_m = (last.position_m - first.position_m) * (STEP_S / PERIOD_S)
        position_m = last.position_m
        try:
            while True:
                position_m = position_m + step_m
                await self._send(position_m)
                await asyncio.sleep(STEP_S)
        finally:
            self._reckons = False


class RepairedVehicle(Vehicle):
    """A vehicle that switches reckoning off where it ends it."""

    async def _stop_reckoning(self) -> None:
        await super()._stop_reckoning()
        self._reckons = False


async def main(node: Node) -> None:
    """Send positions, with the bug."""
    await Vehicle(node).run()


async def repaired(node: Node) -> None:
    """Send positions."""
    await RepairedVehicle(node).run()
