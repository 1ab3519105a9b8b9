"""A program that tells what the sensors of its vehicle read."""

from vnet import Node


async def tells(node: Node) -> None:
    """Write down what the sensors read with each fix."""
    async for fix in node.gnss:
        for name, value in fix.sensors.items():
            several = value if isinstance(value, tuple) else (value,)
            node.event("read", sensor=name, value=" ".join(map(repr, several)))
        await node.radio.broadcast(b"here")
