"""A convoy is led by the vehicle with the lowest id that is heard: it answers the others' reports with orders.

v01 joins late and takes the lead from v02. The bug: the function that waits for a report with a time limit returns
the report although the task has been cancelled, if both happen at one instant. So v02 goes on giving orders, beside
v01.
"""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import Any

from tests.hunt.programs.messages import PERIOD_S, parse, send
from vnet import Fix, Node

LATE = "v01"
JOINS_S = 0.5
SILENCE_NS = 300_000_000
"""Time without a leader after which a vehicle leads."""


async def within(awaited: Coroutine[Any, Any, str], limit_s: float) -> str | None:
    """Return the result if there is one within the limit, else None."""
    inner = asyncio.ensure_future(awaited)
    try:
        await asyncio.wait({inner}, timeout=limit_s)
    except asyncio.CancelledError:
        if inner.done():
            return inner.result()
        inner.cancel()
        raise
    if inner.done():
        return inner.result()
    inner.cancel()
    return None


async def repaired_within(awaited: Coroutine[Any, Any, str], limit_s: float) -> str | None:
    """Return the result if there is one within the limit, else None. A cancellation is always passed on."""
    try:
        async with asyncio.timeout(limit_s):
            return await awaited
    except TimeoutError:
        return None


class Member:
    """A vehicle of the convoy."""

    within = staticmethod(within)

    def __init__(self, node: Node) -> None:
        self._node = node
        self._reports: asyncio.Queue[str] = asyncio.Queue()
        self._leading: asyncio.Task[None] | None = None
        self._led_ns = node.now_ns
        self._orders = 0

    async def run(self) -> None:
        """Lead or follow until the run ends."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._receive())
            async for fix in self._node.gnss:
                await self._at_fix(group, fix)

    async def _at_fix(self, group: asyncio.TaskGroup, fix: Fix) -> None:
        if self._leading is None and self._node.now_ns - self._led_ns >= SILENCE_NS:
            self._leading = group.create_task(self._lead())
        if self._leading is not None:
            await send(self._node, "lead")
        else:
            await send(self._node, "report", *fix.position_m.tolist())
        self._node.report(fix.position_m, leads=self._leading is not None, orders=self._orders)

    async def _receive(self) -> None:
        async for packet in self._node.radio:
            kind, _ = parse(packet.payload)
            if kind == "report":
                self._reports.put_nowait(packet.sender)
            elif kind == "lead" and packet.sender < self._node.id:
                self._follow()

    def _follow(self) -> None:
        self._led_ns = self._node.now_ns
        if self._leading is not None:
            self._leading.cancel()
            self._leading = None

    async def _lead(self) -> None:
        """Order one vehicle to adjust its gap, or all to keep it, in each period."""
        while True:
            reporter = await self.within(self._reports.get(), PERIOD_S)
            await send(self._node, "order", reporter)
            self._orders += 1


class RepairedMember(Member):
    """A vehicle that can be stopped leading at any time."""

    within = staticmethod(repaired_within)


async def join(member: Member, node: Node) -> None:
    """Join, late if need be."""
    if node.id == LATE and not node.incarnation:
        await asyncio.sleep(JOINS_S)
        node.gnss.drain()
        node.radio.drain()
    await member.run()


async def main(node: Node) -> None:
    """Lead or follow, with the bug."""
    await join(Member(node), node)


async def repaired(node: Node) -> None:
    """Lead or follow."""
    await join(RepairedMember(node), node)
