"""Vehicle programs for the benchmarks."""

import asyncio

from vnet import Node

SIZE_BYTES = 300


async def steady_beacon(node: Node) -> None:
    """300 bytes ten times a second, at a phase of its own, so that the load is even."""
    payload = bytes(SIZE_BYTES)
    loop = asyncio.get_running_loop()
    due_s = loop.time() + float(node.rng.uniform(0.0, 0.1))
    while True:
        await asyncio.sleep(max(0.0, due_s - loop.time()))
        await node.radio.broadcast(payload)
        node.radio.drain()
        due_s += 0.1


async def always_awaits(node: Node) -> None:
    """A beacon, and a task that is woken for each packet."""
    listening = asyncio.create_task(_listen(node))
    async for _ in node.gnss:
        await node.radio.broadcast(bytes(SIZE_BYTES))
    await listening


async def _listen(node: Node) -> None:
    async for _ in node.radio:
        pass
