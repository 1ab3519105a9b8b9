"""v01 is a crossing without lights that lets one vehicle in at a time, for one period; the others ask to enter.

The bug: a permit that is returned goes to the first task that waits. If the task is cancelled by its timeout before
it runs again, the permit is lost, and nobody enters any more.
"""

from __future__ import annotations

import asyncio
from collections import deque

from tests.hunt.programs.messages import PERIOD_S, parse, send
from vnet import Node

CROSSING = "v01"
STAY_S = PERIOD_S
"""Time for which a vehicle is on the crossing."""
PATIENCE_S = 2 * PERIOD_S
"""Time after which a vehicle that waits is refused: it stops and asks again."""
ASKS_EVERY = 5
"""Periods between two requests of a vehicle."""


class Permits:
    """Permits to enter, `free` at first; whoever waits gets them in the order of asking."""

    def __init__(self, free: int) -> None:
        self.free = free
        self._waiting: deque[asyncio.Future[None]] = deque()

    async def acquire(self) -> None:
        """Take a permit; wait for one if none is free."""
        if self.free:
            self.free -= 1
            return
        waiter: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting.append(waiter)
        await self._wait(waiter)

    async def _wait(self, waiter: asyncio.Future[None]) -> None:
        await waiter

    def release(self) -> None:
        """Return a permit: to the first that waits, if any does."""
        while self._waiting:
            waiter = self._waiting.popleft()
            if not waiter.done():
                waiter.set_result(None)
                return
        self.free += 1


class RepairedPermits(Permits):
    """A task that is cancelled with a permit returns it."""

    async def _wait(self, waiter: asyncio.Future[None]) -> None:
        try:
            await waiter
        except asyncio.CancelledError:
            if not waiter.cancelled():
                self.release()
            raise


class Crossing:
    """The crossing: answers each request with "enter" or "refused"."""

    def __init__(self, node: Node, permits: Permits) -> None:
        self._node = node
        self._permits = permits
        self._inside = 0

    async def run(self) -> None:
        """Serve vehicles until the run ends."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._report())
            async for packet in self._node.radio:
                if parse(packet.payload)[0] == "request":
                    group.create_task(self._serve(packet.sender))

    async def _report(self) -> None:
        async for fix in self._node.gnss:
            self._node.report(fix.position_m, free=self._permits.free, inside=self._inside)

    async def _serve(self, vehicle: str) -> None:
        try:
            async with asyncio.timeout(PATIENCE_S):
                await self._permits.acquire()
        except TimeoutError:
            await send(self._node, "refused", vehicle)
            return
        self._inside += 1
        asyncio.get_running_loop().call_later(STAY_S, self._left)
        await send(self._node, "enter", vehicle)

    def _left(self) -> None:
        self._inside -= 1
        self._permits.release()


async def approach(node: Node) -> None:
    """Ask to enter, again and again."""
    async for fix in node.gnss:
        if fix.time_ns // node.period_ns % ASKS_EVERY == 0:
            await send(node, "request")
        node.report(fix.position_m)


async def main(node: Node) -> None:
    """Serve or ask, with the bug."""
    await (Crossing(node, Permits(1)).run() if node.id == CROSSING else approach(node))


async def repaired(node: Node) -> None:
    """Serve or ask."""
    await (Crossing(node, RepairedPermits(1)).run() if node.id == CROSSING else approach(node))
