"""Messages of the backbone among roadside units, and references to them.

Within a process a yield or a grant holds its messages themselves. On Zenoh it holds references, and the messages
are on keys of the units' own (`vnet/transport/backbone_keys.py`).
"""

from __future__ import annotations

from collections.abc import Iterable

import msgspec

from vnet.backbone import BackboneMessage
from vnet.transport.orders import Count, TimeNs


class MessageRef(msgspec.Struct, frozen=True, array_like=True):
    """Reference to a message on one of the keys of the unit `node`: no two there have the same `number`."""

    node: str
    number: Count


class SentMessage(MessageRef, frozen=True, array_like=True):
    """A message that `node` sends `to` one unit, or to all others."""

    to: str | None
    payload: bytes


class WireMessage(MessageRef, frozen=True, array_like=True):
    """A message of `sender` that reaches `node` at `time_ns`."""

    sender: str
    sent_ns: TimeNs
    time_ns: TimeNs
    payload: bytes

    def message(self) -> BackboneMessage:
        """Return the message as the program sees it."""
        return BackboneMessage(self.sender, self.sent_ns, self.time_ns, self.payload)


def sent_in_full(messages: Iterable[MessageRef]) -> list[SentMessage]:
    """Return the messages of a yield whose references have been resolved."""
    return [message for message in messages if isinstance(message, SentMessage)]


def arrived_in_full(messages: Iterable[MessageRef]) -> list[WireMessage]:
    """Return the messages of a grant whose references have been resolved."""
    return [message for message in messages if isinstance(message, WireMessage)]
