"""Programs of roadside units, for tests."""

import asyncio

from vnet import Node


async def counts(node: Node) -> None:
    """Send numbers to all units and one more to the last of them, and record whatever comes, every 70 ms."""
    assert node.backbone is not None
    number = 0
    while True:
        await asyncio.sleep(0.07)
        for message in node.backbone.drain():
            node.event("got", sender=message.sender, number=int(message.payload), received_ns=message.received_ns)
        await node.backbone.broadcast(b"%d" % number)
        if node.backbone.peers:
            await node.backbone.send(node.backbone.peers[-1], b"%d" % (number + 1))
        await node.radio.broadcast(b"here")
        number += 2
