"""The messages of Zenoh programs on the radio, and the frames that carry them.

A sample, a query, a reply or a liveliness token is encoded with msgpack and cut into as many frames as the radio's
payload asks for. Both sides of the wall read them: gateways and emulated sessions, and the emulator's records.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache
from itertools import count
from typing import Annotated, Any, Literal
from zlib import crc32

import msgspec
import zenoh

from vnet.units import NS_PER_S

FRAGMENT_BYTES = 24
"""Most bytes of a frame around its part of a message."""
CHECKSUM_BYTES = 4
"""Bytes at the end of a message in parts: one of other bytes would often be a message as well."""
MOST_UNFINISHED = 64
"""Messages in parts that are kept of each sender until the rest has come; the oldest go first."""
MOST_WHOLE = 1024
"""Messages of one frame that are kept decoded, for all who receive it."""
MOST_FRAGMENTS = 65_535
ZID_BYTES, EID_BYTES = 16, 4
"""Bytes of the ids of a session and of its entity."""
MOST_MESSAGES = 2**32
"""Messages that an incarnation of a sender has numbers for."""

Priority = Literal[
    "REAL_TIME", "INTERACTIVE_HIGH", "INTERACTIVE_LOW", "DATA_HIGH", "DATA", "DATA_LOW", "BACKGROUND"
]
# Zenoh panics on a timestamp beyond these.
Seconds = Annotated[int, msgspec.Meta(ge=0, lt=2**32)]
Nanoseconds = Annotated[int, msgspec.Meta(ge=0, lt=NS_PER_S)]
TimestampId = Annotated[bytes, msgspec.Meta(min_length=1, max_length=16)]


class CrossingSample(msgspec.Struct, array_like=True, frozen=True, tag="sample"):
    """A sample on its way over the radio.

    `time` is seconds, nanoseconds and id of its timestamp, `source` the publisher and its number for the sample.
    """

    key: str
    payload: bytes
    encoding: str
    is_delete: bool
    attachment: bytes | None
    priority: Priority
    congestion: Literal["DROP", "BLOCK", "BLOCK_FIRST"]
    express: bool
    time: tuple[Seconds, Nanoseconds, TimestampId] | None
    source: tuple[bytes, int] | None


class CrossingQuery(msgspec.Struct, array_like=True, frozen=True, tag="query"):
    """A query on its way over the radio, with its number among those of the asking vehicle."""

    number: int
    selector: str
    payload: bytes | None
    encoding: str | None
    attachment: bytes | None


class CrossingReply(msgspec.Struct, array_like=True, frozen=True, tag="reply"):
    """A reply to query `number` of vehicle `to`: a sample, or payload and encoding of an error."""

    to: str
    number: int
    sample: CrossingSample | None
    error: tuple[bytes, str] | None = None


class CrossingTokens(msgspec.Struct, array_like=True, frozen=True, tag="tokens"):
    """All liveliness tokens of the sender's programs: told when they change, and again while there are any.

    So neither a lost frame nor a vehicle that comes into range later is left with another picture for long.
    """

    keys: tuple[str, ...]


Message = CrossingSample | CrossingQuery | CrossingReply | CrossingTokens


class Fragment(msgspec.Struct, array_like=True, frozen=True):
    """Contents of a frame: part `index` of `parts` of the sender's message `number`."""

    number: int
    index: int
    parts: int
    content: bytes


def entity_bytes(entity: Any) -> bytes:
    """Return the id of an entity: that of its session, and its number there."""
    eid: int = entity.eid
    return bytes(entity.zid).ljust(ZID_BYTES, b"\0") + eid.to_bytes(EID_BYTES, "little")


def crossing_sample(sample: Any, stamp: zenoh.Timestamp | None) -> CrossingSample:
    """Return what of a sample crosses the radio, with a timestamp that it need not have had itself."""
    time, source = None, sample.source_info
    if stamp is not None:
        ntp = stamp.get_time_as_ntp64()
        time = ntp.as_secs(), ntp.subsec_nanos(), bytes(stamp.get_id())
    return CrossingSample(
        str(sample.key_expr),
        sample.payload.to_bytes(),
        str(sample.encoding),
        sample.kind == zenoh.SampleKind.DELETE,
        _bytes(sample.attachment),
        _name_of(sample.priority),
        _name_of(sample.congestion_control),
        sample.express,
        time,
        None if source is None else (entity_bytes(source.source_id), source.source_sn),
    )


def crossing_query(number: int, query: Any) -> CrossingQuery:
    """Return what of a query crosses the radio."""
    encoding = None if query.encoding is None else str(query.encoding)
    return CrossingQuery(number, str(query.selector), _bytes(query.payload), encoding, _bytes(query.attachment))


def crossing_reply(asker: str, query: CrossingQuery, reply: Any) -> CrossingReply:
    """Return what of a reply to another vehicle's query crosses the radio."""
    if reply.ok is not None:
        return CrossingReply(asker, query.number, crossing_sample(reply.ok, reply.ok.timestamp))
    return CrossingReply(asker, query.number, None, (reply.err.payload.to_bytes(), str(reply.err.encoding)))


@lru_cache(maxsize=MOST_WHOLE)
def sample_options(sample: CrossingSample) -> Mapping[str, Any]:
    """Return what a sample has beside key, payload, kind, encoding and source, the same at all receivers."""
    time = sample.time
    return {
        "attachment": None if sample.attachment is None else zenoh.ZBytes(sample.attachment),
        "priority": getattr(zenoh.Priority, sample.priority),
        "congestion_control": getattr(zenoh.CongestionControl, sample.congestion),
        "express": sample.express,
        "timestamp": None if time is None else zenoh.Timestamp(zenoh.NTP64(*time[:2]), time[2]),
    }


def _checksum(content: bytes) -> bytes:
    return crc32(content).to_bytes(CHECKSUM_BYTES)


def _bytes(content: zenoh.ZBytes | None) -> bytes | None:
    return None if content is None else content.to_bytes()


def _name_of(member: object) -> Any:
    """Return the name of a member of one of Zenoh's enumerations."""
    return str(member).rpartition(".")[2]


_encode = msgspec.msgpack.Encoder().encode
_decode_message = msgspec.msgpack.Decoder(Message).decode
decode_fragment = msgspec.msgpack.Decoder(Fragment).decode
"""Decode a frame's payload. Raises msgspec.MsgspecError for what is none."""


def decode_message(content: bytes) -> Message:
    """Decode a whole message. Raises msgspec.MsgspecError for what is none."""
    message: Message = _decode_message(content)
    return message


@lru_cache(maxsize=MOST_WHOLE)
def whole_message(payload: bytes) -> Message | None:
    """Return the message of a frame that has all of it, the same at all receivers; None for a part.

    Raises msgspec.MsgspecError for what is none.
    """
    fragment = decode_fragment(payload)
    return decode_message(fragment.content) if fragment.parts == 1 else None


class TooLargeError(Exception):
    """A message needs more than `MOST_FRAGMENTS` frames."""


class Fragments:
    """Cuts the messages of one incarnation of a sender into payloads of at most `max_payload` bytes.

    `warn` is told once that a message has more frames than the radio's queue, `queue_frames`, takes.
    """

    def __init__(
        self,
        max_payload: int,
        incarnation: int = 0,
        queue_frames: float = math.inf,
        warn: Callable[[str], object] = lambda text: None,
    ) -> None:
        self._max_payload, self._queue_frames = max_payload, queue_frames
        self._warn: Callable[[str], object] | None = warn
        # Receivers may still have parts of the last incarnation, which must complete no message of this one.
        self._numbers = count(incarnation * MOST_MESSAGES)

    def of(self, message: Message) -> Iterator[bytes]:
        """Return the payloads of a message's frames. Raises TooLargeError."""
        content, number = _encode(message), next(self._numbers)
        size = self._max_payload - FRAGMENT_BYTES
        if len(content) > size:
            content += _checksum(content)
        parts = -(-len(content) // max(size, 1))
        if size < 1 or parts > MOST_FRAGMENTS:
            raise TooLargeError(
                f"a message of {len(content)} bytes needs more than {MOST_FRAGMENTS} frames of "
                f"radio.max_payload_bytes = {self._max_payload}"
            )
        if parts > self._queue_frames and self._warn is not None:
            self._warn(
                f"a message of {parts} frames, which cannot arrive: radio.queue_frames = {self._queue_frames}"
            )
            self._warn = None
        pieces = (content[start : start + size] for start in range(0, len(content), size))
        return (_encode(Fragment(number, index, parts, piece)) for index, piece in enumerate(pieces))


class Reassembly:
    """Puts messages together from the frames of all senders that one vehicle hears."""

    def __init__(self) -> None:
        self._parts: dict[str, OrderedDict[int, dict[int, bytes]]] = {}

    def take(self, sender: str, payload: bytes) -> Message | None:
        """Return the message that a frame completes, if it does.

        Raises msgspec.MsgspecError or LookupError for bytes that no sender has sent, as a fault makes them.
        """
        if (message := whole_message(payload)) is not None:
            return message
        fragment = decode_fragment(payload)
        unfinished = self._parts.setdefault(sender, OrderedDict())
        parts = unfinished.setdefault(fragment.number, {})
        parts[fragment.index] = fragment.content
        if len(parts) == fragment.parts:
            del unfinished[fragment.number]
            whole = b"".join(parts[index] for index in range(fragment.parts))
            content, checksum = whole[:-CHECKSUM_BYTES], whole[-CHECKSUM_BYTES:]
            if checksum != _checksum(content):
                raise LookupError(f"a part of message {fragment.number} has been changed")
            return decode_message(content)
        if len(unfinished) > MOST_UNFINISHED:
            unfinished.popitem(last=False)
        return None


def describe(payload: bytes) -> str:
    """Return in words what a frame carries: `vnet trace RUN --decode vnet.gateway.frames:describe`.

    Raises msgspec.MsgspecError for what is no frame of a Zenoh program.
    """
    fragment = decode_fragment(payload)
    if fragment.parts > 1:
        return f"part {fragment.index + 1} of {fragment.parts} of message {fragment.number}"
    return str(decode_message(fragment.content))
