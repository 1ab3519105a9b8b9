"""Backbone: the wired network among roadside units, as their programs see it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

from vnet.arguments import checked_payload
from vnet.errors import PayloadTooLargeError, shown
from vnet.mailbox import Mailbox


class BackboneMessage(NamedTuple):
    """A message of another roadside unit. Times are emulated nanoseconds from the start of the run."""

    sender: str
    sent_ns: int
    received_ns: int
    payload: bytes


class UnitAbilities(NamedTuple):
    """Position of a roadside unit in m, names of the other units, and largest message in bytes."""

    position_m: tuple[float, float]
    peers: Sequence[str] = ()
    max_message_bytes: int = 0


class BackboneTransport(Protocol):
    """Interface of a backbone to the process that hosts its node."""

    def send_message(self, node: str, to: str | None, payload: bytes) -> None:
        """Enqueue a message of `node` to one unit, or to all others, at the present time."""
        ...


class Backbone:
    """The roadside unit's end of the backbone: sends to other units, and receives their messages.

    Attributes:
        peers: names of the other units.
        max_message: largest payload of a message in bytes.
    """

    def __init__(self, node_id: str, transport: BackboneTransport, peers: Sequence[str], max_message: int) -> None:
        self.peers = tuple(peers)
        self.max_message = max_message
        self.inbox: Mailbox[BackboneMessage] = Mailbox()
        self._node_id = node_id
        self._transport = transport

    async def send(self, to: str, payload: bytes) -> None:
        """Send a message to the unit `to`. Messages between two units arrive in the order in which they were sent.

        Raise `PayloadTooLargeError` above `max_message` bytes, TypeError for what is not bytes, and ValueError for
        a `to` that is none of the `peers`.
        """
        if to not in self.peers:
            allowed = f"one of {', '.join(self.peers)} is expected" if self.peers else "there is no other unit"
            raise ValueError(f"backbone.send({shown(to)}, …): {allowed}")
        self._transport.send_message(self._node_id, to, self._checked("send", payload))

    async def broadcast(self, payload: bytes) -> None:
        """Send a message to all other units. The exceptions are those of `send`."""
        self._transport.send_message(self._node_id, None, self._checked("broadcast", payload))

    def _checked(self, call: str, payload: bytes) -> bytes:
        content = checked_payload(f"backbone.{call}", payload)
        if len(content) > self.max_message:
            raise PayloadTooLargeError(len(content), self.max_message, "backbone.max_message_bytes")
        return content

    def drain(self) -> list[BackboneMessage]:
        """Return all messages received since the last call, oldest first, without waiting."""
        return self.inbox.drain()

    async def receive(self) -> BackboneMessage:
        """Return the next message; wait for one if there is none."""
        return await self.inbox.get()

    def __aiter__(self) -> Backbone:
        return self

    async def __anext__(self) -> BackboneMessage:
        return await self.inbox.get()
