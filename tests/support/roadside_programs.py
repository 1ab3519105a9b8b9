"""Programs of roadside units, for tests."""

import asyncio

from vnet import Node


async def relay(node: Node) -> None:
    """Pass on what vehicles say to the other units, and broadcast what these pass on."""
    assert node.backbone is not None and node.surveyed_position_m is not None
    await asyncio.gather(_pass_on(node), _repeat(node))


async def _pass_on(node: Node) -> None:
    assert node.backbone is not None
    async for packet in node.radio:
        if packet.sender.startswith("v"):
            await node.backbone.broadcast(packet.payload)


async def _repeat(node: Node) -> None:
    assert node.backbone is not None
    async for message in node.backbone:
        node.report(delay_ms=(message.received_ns - message.sent_ns) / 1e6)
        node.event("relayed", sender=message.sender, sent_ns=message.sent_ns, received_ns=message.received_ns)
        await node.radio.broadcast(message.payload)


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
