"""Messages of the programs: a kind and its fields, as msgpack."""

from __future__ import annotations

from typing import Any

import msgpack

from vnet import Node

PERIOD_S = 0.1
"""Time between two fixes in s."""


async def send(node: Node, kind: str, *fields: Any) -> None:
    """Broadcast a message."""
    await node.radio.broadcast(msgpack.packb((kind, *fields)))


def parse(payload: bytes) -> tuple[str, list[Any]]:
    """Return the kind and the fields of a message."""
    kind, *fields = msgpack.unpackb(payload)
    return kind, fields
