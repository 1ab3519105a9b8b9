"""Messages of the backbone among roadside units, in their form on the wire."""

from __future__ import annotations

import msgspec

from vnet.backbone import BackboneMessage
from vnet.transport.orders import TimeNs


class SentMessage(msgspec.Struct, frozen=True, array_like=True):
    """A message that `node` sends `to` one unit, or to all others."""

    node: str
    to: str | None
    payload: bytes


class WireMessage(msgspec.Struct, frozen=True, array_like=True):
    """A message of `sender` that reaches `node` at `time_ns`."""

    node: str
    sender: str
    sent_ns: TimeNs
    time_ns: TimeNs
    payload: bytes

    def message(self) -> BackboneMessage:
        """Return the message as the program sees it."""
        return BackboneMessage(self.sender, self.sent_ns, self.time_ns, self.payload)
