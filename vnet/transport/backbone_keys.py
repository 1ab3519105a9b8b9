"""Messages of the backbone on the keys of the roadside units, to which yields, grants, frames and batches refer.

Whoever says something to the other end puts the messages of units on their keys first, and references to them in
what it says. The other end resolves the references, whatever comes first: nothing depends on an order between keys.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Generic, TypeVar

import msgspec
from msgspec.structs import replace

from vnet.transport import wire
from vnet.transport.wire import Count, MessageRef, SentMessage, TimeNs, WireMessage, arrived_in_full, sent_in_full


class Sent(wire.Message, frozen=True):
    """A message that a unit sends, on its `tx`; `nonce` is that of its process."""

    nonce: bytes
    number: Count
    to: str | None
    payload: bytes

    def message(self, unit: str) -> SentMessage:
        """Return the message, as what `unit` has put."""
        return SentMessage(unit, self.number, self.to, self.payload)


class Arrived(wire.Message, frozen=True):
    """A message for a unit, on its `rx`."""

    number: Count
    sender: str
    sent_ns: TimeNs
    time_ns: TimeNs
    payload: bytes

    def message(self, unit: str) -> WireMessage:
        """Return the message, as what came for `unit`."""
        return WireMessage(unit, self.number, self.sender, self.sent_ns, self.time_ns, self.payload)


_encoder = msgspec.msgpack.Encoder()
_sent_decoder: msgspec.msgpack.Decoder[Sent] = msgspec.msgpack.Decoder(Sent)
_arrived_decoder: msgspec.msgpack.Decoder[Arrived] = msgspec.msgpack.Decoder(Arrived)


def encode(content: Sent | Arrived) -> bytes:
    """Encode what is put on a unit's key."""
    return _encoder.encode(content)


def decode_sent(data: bytes) -> Sent:
    """Decode what is on a unit's `tx`. Raise WireError for a bad one, or one above `LARGEST_MESSAGE_BYTES`."""
    wire.check_size(data)
    return wire.decode(_sent_decoder, data)


def decode_arrived(data: bytes) -> Arrived:
    """Decode what is on a unit's `rx`. Raise WireError for a bad one."""
    return wire.decode(_arrived_decoder, data)


# Splitting, before a message is put.


def _split(traffic: wire.Traffic, nonce: bytes) -> tuple[wire.Traffic, list[tuple[str, Sent]]]:
    """Return traffic with references in the place of its messages, and these."""
    contents = [
        (each.node, Sent(nonce, each.number, each.to, each.payload)) for each in sent_in_full(traffic.messages)
    ]
    return replace(traffic, messages=_refs(traffic.messages)), contents


def split_yield(message: wire.Yield) -> tuple[wire.Yield, list[tuple[str, Sent]]]:
    """Return a yield with references in the place of its messages, and what its units are to put on their `tx`."""
    parts = [_split(step.traffic, message.nonce) for step in message.steps]
    steps = [replace(step, traffic=part) for step, (part, _) in zip(message.steps, parts, strict=True)]
    return replace(message, steps=steps), [content for _, contents in parts for content in contents]


def split_frames(message: wire.Frames) -> tuple[wire.Frames, list[tuple[str, Sent]]]:
    """Return frames with references in the place of their messages, as `split_yield` does."""
    traffic, contents = _split(message.traffic, message.nonce)
    return replace(message, traffic=traffic), contents


def split_grant(message: wire.Grant | wire.Batch) -> tuple[wire.Grant | wire.Batch, list[tuple[str, Arrived]]]:
    """Return a grant or a batch with references to its messages, and what is to be put on its units' `rx`."""
    contents = [
        (each.node, Arrived(each.number, each.sender, each.sent_ns, each.time_ns, each.payload))
        for each in arrived_in_full(message.messages)
    ]
    return replace(message, messages=_refs(message.messages)), contents


def _refs(messages: Sequence[MessageRef]) -> list[MessageRef]:
    return [MessageRef(each.node, each.number) for each in messages]


# Joining, at the other end.

_M = TypeVar("_M", bound=MessageRef)


class Contents(Generic[_M]):
    """Messages that have come on units' keys and to which nothing has referred yet."""

    def __init__(self) -> None:
        self._messages: dict[tuple[str, int], _M] = {}

    def add(self, message: _M) -> None:
        """Add a message."""
        self._messages[message.node, message.number] = message

    def split(self, refs: Sequence[MessageRef]) -> tuple[list[_M], list[MessageRef]]:
        """Remove and return the messages that have come of these; second, the references to those that have not."""
        found, missing = [], []
        for ref in refs:
            message = self._messages.pop((ref.node, ref.number), None)
            if message is None:
                missing.append(ref)
            else:
                found.append(message)
        return found, missing

    def missing(self, refs: Sequence[MessageRef]) -> list[MessageRef]:
        """Return the references to messages that have not come."""
        return [ref for ref in refs if (ref.node, ref.number) not in self._messages]

    def drop(self, units: Collection[str]) -> None:
        """Forget the messages of these units."""
        self._messages = {key: each for key, each in self._messages.items() if key[0] not in units}


def refs_of(message: wire.Yield) -> list[MessageRef]:
    """Return all references of a yield, in order."""
    return [ref for step in message.steps for ref in step.traffic.messages]


def join_yield(message: wire.Yield, sent: Contents[SentMessage]) -> wire.Yield:
    """Return a yield with messages that have come in the place of its references: the reverse of `split_yield`."""
    messages = [sent.split(step.traffic.messages)[0] for step in message.steps]
    steps = [
        replace(step, traffic=replace(step.traffic, messages=own))
        for step, own in zip(message.steps, messages, strict=True)
    ]
    return replace(message, steps=steps)
