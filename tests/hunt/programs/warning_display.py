"""v01 warns of hazards now and then; the others show each warning, and "clear" after a quiet period.

The bug: the inbox puts a warning into the future of the waiting task. If the task is cancelled by its timeout
before it runs again, the warning is lost with the future.
"""

from __future__ import annotations

import asyncio
from collections import deque
from itertools import count

from tests.hunt.programs.messages import PERIOD_S, parse, send
from vnet import Node

SOURCE = "v01"
TICK_S = 0.01
GAPS = (20, 60)
"""Least and greatest time between two warnings, in ticks."""
QUIET_S = PERIOD_S


class Inbox:
    """A queue of warnings for one reader."""

    def __init__(self) -> None:
        self._items: deque[int] = deque()
        self._reader: asyncio.Future[int] | None = None

    def put(self, item: int) -> None:
        """Give an item to the reader that waits, or keep it."""
        if self._reader is not None and not self._reader.done():
            self._reader.set_result(item)
        else:
            self._items.append(item)

    async def get(self) -> int:
        """Remove and return the oldest item; wait for one if there is none."""
        if self._items:
            return self._items.popleft()
        self._reader = asyncio.get_running_loop().create_future()
        return await self._reader


class RepairedInbox(Inbox):
    """A reader that is cancelled puts back what it was given."""

    async def get(self) -> int:
        try:
            return await super().get()
        except asyncio.CancelledError:
            if self._reader is not None and self._reader.done() and not self._reader.cancelled():
                self._items.appendleft(self._reader.result())
            raise


async def warn(node: Node) -> None:
    """Send warnings, at times that are drawn."""
    for number in count(1):
        await asyncio.sleep(TICK_S * int(node.rng.integers(*GAPS)))
        await send(node, "warning", number)
        node.report(warnings=number)


async def show(node: Node, inbox: Inbox) -> None:
    """Receive and show warnings until the run ends."""

    async def receive() -> None:
        async for packet in node.radio:
            number = parse(packet.payload)[1][0]
            node.event("received", number=number)
            inbox.put(number)

    async def display() -> None:
        while True:
            try:
                async with asyncio.timeout(QUIET_S):
                    number = await inbox.get()
            except TimeoutError:
                node.report(display="clear")
            else:
                node.event("shown", number=number)
                node.report(display="hazard")

    await asyncio.gather(receive(), display())


async def main(node: Node) -> None:
    """Warn or show, with the bug."""
    await (warn(node) if node.id == SOURCE else show(node, Inbox()))


async def repaired(node: Node) -> None:
    """Warn or show."""
    await (warn(node) if node.id == SOURCE else show(node, RepairedInbox()))
