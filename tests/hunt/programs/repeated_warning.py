"""v01 sends each warning three times, 200 ms apart; the others warn their drivers once.

The bug: the number of a warning is remembered until the next repetition is due, and not longer. A repetition that
arrives after the timer, at the same instant or late, is taken for a new warning.
"""

from __future__ import annotations

import asyncio
from itertools import count

from tests.hunt.programs.messages import parse, send
from vnet import Node

SOURCE = "v01"
REPETITIONS = 3
INTERVAL_S = 0.2
PAUSE_S = 0.4
"""Time between the last repetition of a warning and the next warning."""


async def warn(node: Node) -> None:
    """Send warnings, each of them several times."""
    for number in count(node.incarnation * 1000):
        for _ in range(REPETITIONS):
            await send(node, "warning", number)
            await asyncio.sleep(INTERVAL_S)
        await asyncio.sleep(PAUSE_S)


class Receiver:
    """A vehicle that remembers the warnings that it has shown."""

    memory_s = INTERVAL_S

    def __init__(self, node: Node) -> None:
        self._node = node
        self._seen: dict[int, asyncio.TimerHandle] = {}

    async def run(self) -> None:
        """Warn the driver until the run ends."""
        loop = asyncio.get_running_loop()
        async for packet in self._node.radio:
            number = parse(packet.payload)[1][0]
            if number in self._seen:
                self._seen[number].cancel()
            else:
                self._node.event("warned", number=number)
            self._seen[number] = loop.call_later(self.memory_s, self._forget, number)

    def _forget(self, number: int) -> None:
        del self._seen[number]


class RepairedReceiver(Receiver):
    """It remembers a warning far longer than it is repeated."""

    memory_s = 60.0


async def main(node: Node) -> None:
    """Warn or receive, with the bug."""
    await (warn(node) if node.id == SOURCE else Receiver(node).run())


async def repaired(node: Node) -> None:
    """Warn or receive."""
    await (warn(node) if node.id == SOURCE else RepairedReceiver(node).run())
