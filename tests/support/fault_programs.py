"""Vehicle programs for the tests of faults: they report a digest of all that happened to them, and when."""

import asyncio
import zlib

from vnet import Node


class Diary:
    """Digest of what a program saw, in order, as one number."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self.digest = 0

    def note(self, *what: object) -> None:
        clock = asyncio.get_running_loop().time()
        self.digest = zlib.crc32(repr((self._node.now_ns, clock, *what)).encode(), self.digest)


async def minds_the_order(node: Node) -> None:
    """Several tasks at once: what comes in another order, or at another time, changes what is said and reported.

    One node in three never waits on its radio, and one waits with a timeout only.
    """
    with (node.folder / "incarnations").open("a") as file:
        file.write(f"{node.incarnation}\n")
    diary = Diary(node)
    manner = int(node.id[1:]) % 3

    async def hear() -> None:
        while True:
            if manner == 0:
                packets = [await node.radio.receive()]
            elif manner == 1:
                await asyncio.sleep(0.13)
                packets = node.radio.drain()
            else:
                try:
                    packets = [await asyncio.wait_for(node.radio.receive(), float(node.rng.uniform(0.01, 0.1)))]
                except TimeoutError:
                    diary.note("nothing")
                    continue
            for packet in packets:
                diary.note("packet", packet.sender, packet.sent_ns, packet.received_ns, packet.payload)

    async def locate() -> None:
        async for fix in node.gnss:
            diary.note("fix", fix.time_ns, fix.position_m.tolist())
            await node.radio.broadcast(diary.digest.to_bytes(4, "big") + bytes([node.incarnation]))
            node.report(fix.position_m, digest=diary.digest)

    async def tick(name: str, period_s: float) -> None:
        while True:
            await asyncio.sleep(period_s)
            diary.note(name, float(node.rng.random()))

    async def tock() -> None:
        while True:
            try:
                async with asyncio.timeout(0.17):
                    await asyncio.Event().wait()
            except TimeoutError:
                diary.note("tock")
            await node.radio.broadcast(b"tock" + diary.digest.to_bytes(4, "big"))

    def strike(number: int) -> None:
        """A timer of the loop's, without a task."""
        diary.note("strike", number)
        loop.call_at(loop.time() + 0.1, strike, number + 1)

    loop = asyncio.get_running_loop()
    loop.call_later(0.05, strike, 0)
    await asyncio.gather(hear(), locate(), tick("a", 0.1), tick("b", 0.1), tick("c", 0.05), tock())


async def does_not_give_up(node: Node) -> None:
    """Goes on after it was cancelled, and says so to all; its final messages are many."""

    async def stubborn() -> None:
        waiter = asyncio.get_running_loop().create_future()
        while True:
            try:
                await (asyncio.sleep(0.05) if waiter.done() else asyncio.wait_for(waiter, 0.05))
            except (asyncio.CancelledError, TimeoutError):
                waiter = asyncio.get_running_loop().create_future()
            finally:
                node.report(incarnation=node.incarnation)
                await node.radio.broadcast(b"still here" + bytes([node.incarnation]))

    await asyncio.gather(stubborn(), minds_the_order(node))
