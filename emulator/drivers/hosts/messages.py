"""The messages between the emulator and a host, on the keys `host/NAME/rx` and `host/NAME/tx`.

What the emulator and an agent say to each other passes as bytes that a host does not decode. Both ends are vnet's
own, of one version: the hello names its digest. Decoding checks types; a violation is a `WireError`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, TypeVar

import msgspec

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


# Orders of the emulator.


class ToNode(Message, frozen=True):
    """A message on the `rx` of a node; `awaited` if its process owes a yield for it."""

    node: str
    payload: bytes
    awaited: bool


class ToUnit(Message, frozen=True):
    """A message on the `rx` of the backbone of a unit."""

    node: str
    payload: bytes


class Start(Message, frozen=True):
    """Start these processes, whose ids and serial numbers these are, at a niceness."""

    process_ids: Sequence[str]
    serials: Sequence[int]
    nice: int


class Kill(Message, frozen=True):
    """End a process at once."""

    process_id: str


class Detach(Message, frozen=True):
    """A process has been told to go: kill it if it has not gone after so many seconds."""

    process_id: str
    patience_s: float


class Signal(Message, frozen=True):
    """Send a signal to a process."""

    process_id: str
    number: int


class Look(Message, frozen=True):
    """Measure CPU time and memory of the processes at this emulated time, and tell if one exceeds the limit."""

    time_ns: int
    memory_limit_mb: float | None = None


class Patience(Message, frozen=True):
    """The emulator, or its router, will be absent, for at most `within_s` seconds."""

    within_s: float


class HandIn(Message, frozen=True):
    """The run is over: wait so many seconds for the processes, end them, and hand in what they leave."""

    patience_s: float


class Leave(Message, frozen=True):
    """The run is over, and all has been handed in."""


Order = ToNode | ToUnit | Start | Kill | Detach | Signal | Look | Patience | HandIn | Leave


class Orders(Message, frozen=True):
    """Orders to a host, in the order in which they are to be carried out."""

    nonce: bytes
    orders: Sequence[Order]


# News of a host.


class FromNode(Message, frozen=True):
    """A message that came on the `tx` of a node."""

    node: str
    payload: bytes


class FromUnit(Message, frozen=True):
    """A message that came on the `tx` of the backbone of a unit."""

    node: str
    payload: bytes


class Token(Message, frozen=True):
    """The liveliness token of a node has appeared, or is gone."""

    node: str
    alive: bool


class Ended(Message, frozen=True):
    """A process has ended without an order, or could not be started: serial number, status and end of its log.

    `overdue_s` is for how many seconds it was waited for, if it was killed because it did not end.
    """

    process_id: str
    serial: int
    status: int
    log_tail: str
    overdue_s: float | None = None


class LogTail(Message, frozen=True):
    """The end of the log of a process that was asked for its stacks."""

    process_id: str
    text: str


class Part(Message, frozen=True):
    """The next bytes of a process's log, or of a file on a node's disk: `path` is relative to the node's folder."""

    kind: Literal["log", "file"]
    owner: str
    path: str
    data: bytes


class LeftOut(Message, frozen=True):
    """Bytes of a log, or files of a disk, that were not handed in; the first files are named with their reasons."""

    kind: Literal["log", "file"]
    owner: str
    count: int
    which: Sequence[str] = ()


class Figures(Message, frozen=True):
    """CPU time of each process in ns, and private memory: process id, times in s and KiB of each series."""

    cpu_ns: dict[str, int]
    memory: Sequence[tuple[str, Sequence[float], Sequence[int]]]


class MemoryExceeded(Message, frozen=True):
    """A process holds more private memory than the limit."""

    process_id: str
    memory_mb: float


class HandingIn(Message, frozen=True):
    """The order to hand in has come: what follows may take its time."""


class HandedIn(Message, frozen=True):
    """All has been handed in."""


Item = (
    FromNode | FromUnit | Token | Ended | LogTail | Part | LeftOut | Figures | MemoryExceeded | HandingIn | HandedIn
)


class News(Message, frozen=True):
    """News of a host's agents, in the order in which it came."""

    nonce: bytes
    items: Sequence[Item]


ToHost = HostWelcome | HostRefusal | Orders
FromHost = HostHello | News

_encoder = msgspec.msgpack.Encoder()
_to_host: msgspec.msgpack.Decoder[ToHost] = msgspec.msgpack.Decoder(ToHost)
_from_host: msgspec.msgpack.Decoder[FromHost] = msgspec.msgpack.Decoder(FromHost)
_M = TypeVar("_M")


def encode(message: ToHost | FromHost) -> bytes:
    """Encode a message."""
    return _encoder.encode(message)


def decode_to_host(data: bytes) -> ToHost:
    """Decode a message of the emulator. Raise WireError for a bad one."""
    return _decode(_to_host, data)


def decode_from_host(data: bytes) -> FromHost:
    """Decode a message of a host. Raise WireError for a bad one, or one above `LARGEST_BUNDLE_BYTES`."""
    if len(data) > LARGEST_BUNDLE_BYTES:
        raise WireError(f"message of {len(data)} bytes: at most {LARGEST_BUNDLE_BYTES} allowed")
    return _decode(_from_host, data)


def _decode(decoder: msgspec.msgpack.Decoder[_M], data: bytes) -> _M:
    try:
        return decoder.decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise WireError(f"{len(data)} bytes are not a message: {printable(str(error), 200)}") from None
