"""The messages between the emulator and a host, on the keys `host/NAME/rx` and `host/NAME/tx`.

After the welcome each side calls methods of the other, many in one message. What the emulator and an agent say to
each other passes as bytes that a host does not decode. Both ends are vnet's
own, of one version: the hello names its digest. Decoding checks types; a violation is a `WireError`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypeVar

import msgspec
from msgspec.structs import replace

from vnet.errors import WireError, printable
from vnet.transport.wire import LARGEST_BUNDLE_BYTES, Message

PART_BYTES = 2**20
"""Bytes of a file in one message."""


class HostHello(Message, frozen=True):
    """A host's request to speak for its processes; said again with `ready` once agents can be started.

    `nonce` is a secret of the host's process: later messages contain it. `digest` is that of its vnet. `failure`
    says why it cannot start agents.
    """

    host: str
    nonce: bytes
    pid: int
    machine: str
    digest: str
    ready: bool = False
    failure: str | None = None


class HostWelcome(Message, frozen=True):
    """Admission of a host, with what it needs to start its agents: the node ids of each process, first.

    `units` are those of its nodes that are roadside units.
    """

    nonce: bytes
    processes: Sequence[Sequence[str]]
    start: Literal["fork", "spawn"]
    modules: Sequence[str]
    realtime: bool
    orphan_timeout_s: float
    duration_ns: int
    files_max_mb: float
    units: Sequence[str] = ()


class HostRefusal(Message, frozen=True):
    """Refusal of a host, and why."""

    nonce: bytes
    reason: str


Call = tuple[Any, ...]
"""A method of the other side, and its arguments."""

Owned = Literal["log", "file"]
"""Kind of what is left behind: a log of a process, or a file on a node's disk."""
TO_HOST: dict[str, Any] = {
    "to_node": tuple[str, str, bytes, bool],  # a message for a node; True if its process owes a yield for it
    "to_unit": tuple[str, str, bytes],  # a message for a roadside unit, on its key of the backbone
    "start": tuple[str, list[str], list[int], int],  # ids of processes, their serial numbers, their niceness
    "kill": tuple[str, str],
    "detach": tuple[str, str, float],  # a process has been told to go: the seconds after which it is killed
    "signal": tuple[str, str, int],
    "look": tuple[str, int, float | None],  # measure the processes at this emulated time; their limit in megabytes
    "be_patient": tuple[str, float],  # the emulator, or its router, will be absent for at most so many seconds
    "hand_in": tuple[str, float],  # wait so many seconds for the processes, end them, hand in what they leave
    "leave": tuple[str],  # the run is over, and all has been handed in
}
"""Calls of the emulator at a host, with the types of the name and the arguments."""
FROM_HOST: dict[str, Any] = {
    "message": tuple[str, str, bytes],  # a message on the `tx` of a node
    "backbone": tuple[str, str, bytes],  # a message on the `tx` of the backbone of a unit
    "token": tuple[str, str, bool],  # the liveliness token of a node has appeared, or is gone
    # A process has ended without an order, or could not be started: its id, serial number, status, end of its log,
    # and for how many seconds it was waited for, if it was killed because it did not end.
    "ended": tuple[str, str, int, int, str, float | None],
    "log_tail": tuple[str, str, str],  # the end of the log of a process that was asked for its stacks
    "part": tuple[str, Owned, str, str, bytes],  # whose, its path in the node's folder, its next bytes
    "left_out": tuple[str, Owned, str, int, list[str]],  # whose, bytes of a log or files, the first with reasons
    # CPU time of each process in ns; process, times in s and KiB of private memory of each series.
    "figures": tuple[str, dict[str, int], list[tuple[str, list[float], list[int]]]],
    "memory": tuple[str, str, float],  # a process holds more than the limit: its megabytes
    "handing_in": tuple[str],  # the order to hand in has come: what follows may take its time
    "handed_in": tuple[str],
}
"""Calls of a host at the emulator, with the types of the name and the arguments."""


class Calls(Message, frozen=True):
    """Calls of the other side's methods, in the order in which they are to be carried out."""

    nonce: bytes
    calls: Sequence[Call]


ToHost = HostWelcome | HostRefusal | Calls
FromHost = HostHello | Calls

_encoder = msgspec.msgpack.Encoder()
_to_host: msgspec.msgpack.Decoder[ToHost] = msgspec.msgpack.Decoder(ToHost)
_from_host: msgspec.msgpack.Decoder[FromHost] = msgspec.msgpack.Decoder(FromHost)
_M = TypeVar("_M")


def encode(message: ToHost | FromHost) -> bytes:
    """Encode a message."""
    return _encoder.encode(message)


def decode_to_host(data: bytes) -> ToHost:
    """Decode a message of the emulator. Raise WireError for a bad one."""
    return _decode(_to_host, data, TO_HOST)


def decode_from_host(data: bytes) -> FromHost:
    """Decode a message of a host. Raise WireError for a bad one, or one above `LARGEST_BUNDLE_BYTES`."""
    if len(data) > LARGEST_BUNDLE_BYTES:
        raise WireError(f"message of {len(data)} bytes: at most {LARGEST_BUNDLE_BYTES} allowed")
    return _decode(_from_host, data, FROM_HOST)


def _decode(decoder: msgspec.msgpack.Decoder[_M], data: bytes, allowed: Mapping[str, Any]) -> _M:
    try:
        message = decoder.decode(data)
        if isinstance(message, Calls):
            message = replace(message, calls=[_checked(call, allowed) for call in message.calls])
        return message
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise WireError(f"{len(data)} bytes are not a message: {printable(str(error), 200)}") from None


def _checked(call: Call, allowed: Mapping[str, Any]) -> Call:
    """Return a call whose name and types of arguments are allowed. Raise msgspec.ValidationError for another."""
    name = call[0] if call else None
    if not isinstance(name, str) or name not in allowed:
        raise msgspec.ValidationError(f"there is no call {name!r}")
    checked: Call = msgspec.convert(call, allowed[name])
    return checked
