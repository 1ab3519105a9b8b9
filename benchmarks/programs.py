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


async def brakes_now_and_then(node: Node) -> None:
    """A beacon at each fix, whose vehicle brakes for one second in ten."""
    phase_s = float(node.rng.uniform(0.0, 10.0))
    async for fix in node.gnss:
        await node.radio.broadcast(bytes(SIZE_BYTES))
        node.radio.drain()
        if (fix.time_ns / 1e9 + phase_s) % 10.0 < 1.0:
            node.drive(-2.0)
        else:
            node.drive(release=True)
