"""Vehicles ask the signal of a crossing for its phase; v01 is the signal, and answers with its next beacon.

The bug: a query that expires marks its future at once, but leaves the table only when the asking task runs again.
An answer that arrives in between resolves the future a second time: InvalidStateError.
"""

from __future__ import annotations

import asyncio
from itertools import count

from tests.hunt.programs.messages import PERIOD_S, parse, send
from vnet import Node

SIGNAL = "v01"
TIMEOUT_S = PERIOD_S
ASKS_EVERY = 5
"""Beacons between two queries of a vehicle."""
PHASES = ("red", "green", "amber")


class Signal:
    """The signal: collects queries, and answers them all with its beacon."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._queries: list[tuple[str, int]] = []

    async def run(self) -> None:
        """Take queries and answer them until the run ends."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._receive())
            group.create_task(self._answer())

    async def _receive(self) -> None:
        async for packet in self._node.radio:
            kind, fields = parse(packet.payload)
            if kind == "query":
                self._queries.append((packet.sender, fields[0]))

    async def _answer(self) -> None:
        async for fix in self._node.gnss:
            await send(self._node, "beacon")
            queries, self._queries = self._queries, []
            phase = PHASES[fix.time_ns // 10**9 % len(PHASES)]
            for vehicle, number in queries:
                await send(self._node, "phase", vehicle, number, phase)
            self._node.report(fix.position_m, phase=phase)


class Vehicle:
    """A vehicle that asks now and then when it receives a beacon."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._numbers = count(node.incarnation * 1000)
        self._pending: dict[int, asyncio.Future[str]] = {}
        self._phase = "unknown"

    async def run(self) -> None:
        """Ask until the run ends."""
        async with asyncio.TaskGroup() as group:
            beacons = count()
            async for packet in self._node.radio:
                kind, fields = parse(packet.payload)
                if kind == "beacon" and next(beacons) % ASKS_EVERY == 0:
                    group.create_task(self._ask())
                elif kind == "phase" and fields[0] == self._node.id:
                    self._answered(*fields[1:])

    async def _ask(self) -> None:
        number = next(self._numbers)
        loop = asyncio.get_running_loop()
        answer = self._pending[number] = loop.create_future()
        timer = loop.call_later(TIMEOUT_S, self._expire, answer)
        try:
            await send(self._node, "query", number)
            self._phase = await answer
        except TimeoutError:
            self._phase = "unknown"
        finally:
            timer.cancel()
            self._pending.pop(number, None)
        self._node.report(phase=self._phase)

    def _expire(self, answer: asyncio.Future[str]) -> None:
        if not answer.done():
            answer.set_exception(TimeoutError("the signal has not answered"))

    def _answered(self, number: int, phase: str) -> None:
        answer = self._pending.pop(number, None)
        if answer is not None:
            answer.set_result(phase)


class RepairedVehicle(Vehicle):
    """An answer counts only while its query waits."""

    def _answered(self, number: int, phase: str) -> None:
        answer = self._pending.pop(number, None)
        if answer is not None and not answer.done():
            answer.set_result(phase)


async def main(node: Node) -> None:
    """Answer or ask, with the bug."""
    await (Signal(node) if node.id == SIGNAL else Vehicle(node)).run()


async def repaired(node: Node) -> None:
    """Answer or ask."""
    await (Signal(node) if node.id == SIGNAL else RepairedVehicle(node)).run()
