"""Vehicles upload pictures, and 20 ms later logs, in one session with the server v01; a session ends by itself.

The bug: the logs look whether there is a session, and open one if not. If the answer to the pictures' request
arrives at that very instant, or late, there are two.
"""

from __future__ import annotations

import asyncio
from itertools import count

from tests.hunt.programs.messages import PERIOD_S, parse, send
from vnet import Node

SERVER = "v01"
UPLOADS_EVERY = 5
"""Periods between two uploads."""
STAGGER_S = 0.02
"""Delay of the logs behind the pictures."""
LIFETIME_S = 0.3
"""Time after which a session ends."""


async def serve(node: Node) -> None:
    """Open a session for whoever asks; answer again who repeats."""
    async for packet in node.radio:
        kind, fields = parse(packet.payload)
        if kind == "open":
            await send(node, "opened", packet.sender, fields[0])


class Uploader:
    """A vehicle with two kinds of data to upload."""

    def __init__(self, node: Node, group: asyncio.TaskGroup) -> None:
        self._node = node
        self._group = group
        self._numbers = count(node.incarnation * 1000)
        self._pending: dict[int, asyncio.Future[int]] = {}
        self._session: int | None = None

    async def run(self) -> None:
        """Upload until the run ends."""
        self._group.create_task(self._receive())
        async for fix in self._node.gnss:
            if fix.time_ns // self._node.period_ns % UPLOADS_EVERY == 0:
                self._group.create_task(self._upload("pictures", 0.0))
                self._group.create_task(self._upload("logs", STAGGER_S))

    async def _upload(self, data: str, delay_s: float) -> None:
        if delay_s:
            await asyncio.sleep(delay_s)
        session = await self._ensure_session()
        await send(self._node, "upload", session, data)

    async def _ensure_session(self) -> int:
        if self._session is None:
            self._session = await self._open()
            self._node.event("opened", session=self._session)
            asyncio.get_running_loop().call_later(LIFETIME_S, self._end, self._session)
        return self._session

    def _end(self, session: int) -> None:
        self._node.event("ended", session=session)
        self._session = None

    async def _open(self) -> int:
        number = next(self._numbers)
        answer = self._pending[number] = asyncio.get_running_loop().create_future()
        asking = self._group.create_task(self._keep_asking(number))
        try:
            return await answer
        finally:
            asking.cancel()
            del self._pending[number]

    async def _keep_asking(self, number: int) -> None:
        while True:
            await send(self._node, "open", number)
            await asyncio.sleep(PERIOD_S)

    async def _receive(self) -> None:
        async for packet in self._node.radio:
            kind, fields = parse(packet.payload)
            if kind == "opened" and fields[0] == self._node.id:
                answer = self._pending.get(fields[1])
                if answer is not None and not answer.done():
                    answer.set_result(fields[1])


class RepairedUploader(Uploader):
    """A vehicle that opens one session at a time."""

    def __init__(self, node: Node, group: asyncio.TaskGroup) -> None:
        super().__init__(node, group)
        self._opening = asyncio.Lock()

    async def _ensure_session(self) -> int:
        async with self._opening:
            return await super()._ensure_session()


async def main(node: Node) -> None:
    """Serve or upload, with the bug."""
    if node.id == SERVER:
        await serve(node)
    async with asyncio.TaskGroup() as group:
        await Uploader(node, group).run()


async def repaired(node: Node) -> None:
    """Serve or upload."""
    if node.id == SERVER:
        await serve(node)
    async with asyncio.TaskGroup() as group:
        await RepairedUploader(node, group).run()
