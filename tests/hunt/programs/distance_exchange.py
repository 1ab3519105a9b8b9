"""Each vehicle tells each of its neighbours their distance, one after the other, 10 ms apart.

The bug: it iterates over its table of neighbours, and waits in between. A neighbour that is forgotten meanwhile, or
that appears, changes the table: RuntimeError.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterable

import numpy as np

from tests.hunt.programs.messages import parse, send
from vnet import Node

SPACING_S = 0.01
LIFETIME_S = 0.3
"""Time after which a silent neighbour is forgotten."""


class Vehicle:
    """A vehicle and its table of neighbours."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._neighbours: dict[str, list[float]] = {}
        self._expiry: dict[str, asyncio.TimerHandle] = {}

    async def run(self) -> None:
        """Exchange distances until the run ends."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._receive())
            async for fix in self._node.gnss:
                await send(self._node, "here", *fix.position_m.tolist())
                for name, position_m in self._all():
                    await asyncio.sleep(SPACING_S)
                    distance_m = float(np.hypot(*(fix.position_m - position_m)))
                    await send(self._node, "distance", name, distance_m)

    def _all(self) -> Iterable[tuple[str, list[float]]]:
        return self._neighbours.items()

    async def _receive(self) -> None:
        loop = asyncio.get_running_loop()
        async for packet in self._node.radio:
            kind, fields = parse(packet.payload)
            if kind == "here":
                if packet.sender in self._expiry:
                    self._expiry[packet.sender].cancel()
                self._neighbours[packet.sender] = fields
                self._expiry[packet.sender] = loop.call_later(LIFETIME_S, self._forget, packet.sender)

    def _forget(self, name: str) -> None:
        del self._neighbours[name], self._expiry[name]


class RepairedVehicle(Vehicle):
    """It walks through a copy of its table."""

    def _all(self) -> Iterable[tuple[str, list[float]]]:
        return list(self._neighbours.items())


async def main(node: Node) -> None:
    """Exchange distances, with the bug."""
    await Vehicle(node).run()


async def repaired(node: Node) -> None:
    """Exchange distances."""
    await RepairedVehicle(node).run()
