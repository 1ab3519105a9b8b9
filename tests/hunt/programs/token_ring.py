"""Four vehicles take turns with a token; each keeps it until its next fix. v01 replaces a token that has been lost.

The bug: a token is accepted whatever its number is. If v01's watchdog expires as the token arrives, or the token is
late, there are two from then on.
"""

from __future__ import annotations

import asyncio

from tests.hunt.programs.messages import PERIOD_S, parse, send
from vnet import Node

RING = ("v01", "v02", "v03", "v04")
MONITOR = "v01"
ROTATION_S = len(RING) * PERIOD_S
"""Time that a token takes to go round."""


class Station:
    """A vehicle of the ring. A token's number is the time at which it was made."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._next = RING[(RING.index(node.id) + 1) % len(RING)]
        self._holds = node.id == MONITOR and not node.incarnation
        self._number = node.now_ns
        self._watchdog: asyncio.TimerHandle | None = None
        self._replacing: asyncio.Task[None] | None = None

    async def run(self) -> None:
        """Take turns until the run ends."""
        self._watch()
        await asyncio.gather(self._receive(), self._take_turns())

    async def _take_turns(self) -> None:
        async for fix in self._node.gnss:
            self._node.report(fix.position_m, holds=self._holds)
            if self._holds:
                self._holds = False
                await send(self._node, "token", self._next, self._number)

    def _watch(self) -> None:
        if self._watchdog is not None:
            self._watchdog.cancel()
        if self._node.id == MONITOR:
            self._watchdog = asyncio.get_running_loop().call_later(ROTATION_S, self._lost)

    def _lost(self) -> None:
        self._number = self._node.now_ns
        self._watch()
        self._replacing = asyncio.create_task(send(self._node, "token", self._next, self._number))

    async def _receive(self) -> None:
        async for packet in self._node.radio:
            _, (addressee, number) = parse(packet.payload)
            if addressee == self._node.id and self._accepts(number):
                self._holds, self._number = True, number
                self._watch()

    def _accepts(self, number: int) -> bool:
        return True


class RepairedStation(Station):
    """A station that drops a token older than the newest it has seen."""

    def _accepts(self, number: int) -> bool:
        return number >= self._number


async def main(node: Node) -> None:
    """Take turns, with the bug."""
    await Station(node).run()


async def repaired(node: Node) -> None:
    """Take turns."""
    await RepairedStation(node).run()
