"""The messages on the keys of a node: typed records <-> msgpack, without any I/O.

`tx` carries what an agent says (`Hello`, `Yield`, `Frames`, `StackDump`), `rx` what the emulator says
(`Welcome`, `Grant`, `Batch`, `StackRequest`, `End`). Decoding checks every type and bound; what does not fit is a
`WireError`. All times are integer nanoseconds from the start of the run.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
import numpy as np

from vnet.errors import WireError, printable
from vnet.node import Fix, Packet, Report

TimeNs = Annotated[int, msgspec.Meta(ge=0, le=2**62)]
Count = Annotated[int, msgspec.Meta(ge=0, le=2**62)]

HEAD_START_NS = 200_000_000
"""Real time: time 0 is this much later than the message that announces it, so that all hear of it in time."""
LATENESS_LIMIT_NS = 20_000_000
"""Deliveries later than this count against a real-time run."""
LATENESS_BINS = 80
"""Four for each factor of two, from 10 µs to 10 s around the limit."""
LARGEST_SAID_BYTES = 64 * 2**20
"""What an agent may say at once: a frame of the largest payload from each of a thousand nodes still fits."""


class Message(msgspec.Struct, frozen=True, array_like=True, tag=True):
    """Common form: an array whose first element names the kind of message."""


class WirePacket(msgspec.Struct, frozen=True, array_like=True):
    """A `Packet` for `node`."""

    node: str
    sender: str
    sent_ns: TimeNs
    received_ns: TimeNs
    payload: bytes

    def packet(self) -> Packet:
        """The packet as the program sees it."""
        return Packet(self.sender, self.sent_ns, self.received_ns, self.payload)


class WireFix(msgspec.Struct, frozen=True, array_like=True):
    """A `Fix` for `node`; the covariance is row by row."""

    node: str
    time_ns: TimeNs
    position_m: tuple[float, float]
    covariance_m2: tuple[float, float, float, float]
    heading_rad: float | None

    @classmethod
    def of(cls, node: str, fix: Fix) -> WireFix:
        """The fix in its form on the wire."""
        x, y = fix.position_m.tolist()
        a, b, c, d = fix.covariance_m2.ravel().tolist()
        return cls(node, fix.time_ns, (x, y), (a, b, c, d), fix.heading_rad)

    def fix(self) -> Fix:
        """The fix as the program sees it."""
        covariance = np.array(self.covariance_m2).reshape(2, 2)
        return Fix(self.time_ns, np.array(self.position_m), covariance, self.heading_rad)


class Frame(msgspec.Struct, frozen=True, array_like=True):
    """One broadcast that `node` hands to the radio."""

    node: str
    payload: bytes


class Ending(msgspec.Struct, frozen=True, array_like=True):
    """A node's program is over: it returned, raised, or span at one instant (`details` says where)."""

    node: str
    kind: Literal["finished", "crashed", "spun"]
    error: str = ""
    details: str = ""


class Traffic(msgspec.Struct, frozen=True, array_like=True):
    """What the nodes of one process hand over at once: frames and reports in the order they were made."""

    frames: Sequence[Frame] = ()
    reports: Sequence[Report] = ()
    endings: Sequence[Ending] = ()


class Hello(Message, frozen=True):
    """A node asks to join. `process_id` is the first node of its process, whose keys carry the process's traffic.

    `nonce` is a secret of the process: later messages bear it, so that nobody else can speak for the node.
    Said again with `ready` once the welcome has come and the program is loaded, or with the `failure` to.
    """

    node: str
    process_id: str
    nonce: bytes
    pid: int
    host: str
    ready: bool = False
    failure: str | None = None


class Yield(Message, frozen=True):
    """Lockstep: the process has nothing left to do at the instant of grant `seq`."""

    nonce: bytes
    seq: Count
    next_timer_ns: TimeNs | None
    waiting_radio: Sequence[str]
    waiting_gnss: Sequence[str]
    traffic: Traffic


class Lateness(msgspec.Struct, frozen=True, array_like=True):
    """Real time: how late packets reached their process, as counts in the bins of `lateness_bin`."""

    counts: Annotated[Sequence[Count], msgspec.Meta(min_length=LATENESS_BINS, max_length=LATENESS_BINS)]


class Frames(Message, frozen=True):
    """Real time: traffic since the last message; acknowledges batches up to `received_seq`, less the gaps."""

    nonce: bytes
    seq: Count
    received_seq: Count
    missed: Sequence[tuple[Count, Count]]
    traffic: Traffic
    lateness: Lateness | None = None
    final: bool = False


class StackDump(Message, frozen=True):
    """The answer to `StackRequest`: the stacks of the process's program threads."""

    nonce: bytes
    text: str


class Welcome(Message, frozen=True):
    """A node is taken in: all it needs to run its program. The scenario itself never travels.

    Without `runs` the program has ended before its process was started anew, and stays so.
    """

    node: str
    nonce: bytes
    incarnation: Count
    pacing: Literal["lockstep", "realtime"]
    entry: str
    options: dict[str, Any]
    lane_map: list[Any] | dict[str, Any]
    seed: int
    period_ns: Annotated[int, msgspec.Meta(gt=0)]
    max_payload: Annotated[int, msgspec.Meta(gt=0)]
    orphan_timeout_s: float
    spin_limit: Count
    boot_id: str
    runs: bool = True


class ClockError(msgspec.Struct, frozen=True, array_like=True):
    """How the clock of `node` goes wrong: at time t it shows t + offset_ns + rate · (t − since_ns)."""

    node: str
    since_ns: TimeNs
    offset_ns: Annotated[int, msgspec.Meta(ge=-(2**53), le=2**53)] = 0
    rate: Annotated[float, msgspec.Meta(gt=-1, lt=2**20)] = 0.0

    @property
    def is_wrong(self) -> bool:
        """Whether the clock is wrong at all."""
        return bool(self.offset_ns or self.rate)

    def shown_ns(self, time_ns: int) -> int:
        """What the clock shows at `time_ns`."""
        return time_ns + self.offset_ns + round(self.rate * (time_ns - self.since_ns))

    def time_ns(self, shown_ns: int) -> int:
        """When the clock shows this."""
        return self.since_ns + round((shown_ns - self.since_ns - self.offset_ns) / (1 + self.rate))


class Grant(Message, frozen=True):
    """Lockstep: it is now `time_ns`; here is what is due. Grant 0 starts a process. `clocks` that have changed."""

    seq: Count
    time_ns: TimeNs
    packets: Sequence[WirePacket] = ()
    fixes: Sequence[WireFix] = ()
    clocks: Sequence[ClockError] = ()


class Batch(Message, frozen=True):
    """Real time: what is due by now. Batch 0 starts the process: it is `start_ns` at `origin_ns` + `start_ns` on
    the monotonic clock of the machine whose boot the welcome names; on other machines, when it arrives.

    `held`: packets waited for a process that stood still, so that nobody is to blame that they are late.
    """

    fixes: Sequence[WireFix]
    seq: Count
    packets: Sequence[WirePacket] = ()
    origin_ns: int | None = None
    start_ns: TimeNs = 0
    held: bool = False
    clocks: Sequence[ClockError] = ()


class StackRequest(Message, frozen=True):
    """The emulator waits too long for this process: where does it stand?"""


class Await(Message, frozen=True):
    """The emulator, or its router, is about to go away, and expects to be back within `within_s`."""

    within_s: float


class End(Message, frozen=True):
    """The run is over, or this node is refused."""

    nonce: bytes | None
    reason: str
    refused: bool = False


AgentMessage = Hello | Yield | Frames | StackDump
EmulatorMessage = Welcome | Grant | Batch | StackRequest | Await | End

_M = TypeVar("_M")
_encoder = msgspec.msgpack.Encoder()
_agent_decoder: msgspec.msgpack.Decoder[AgentMessage] = msgspec.msgpack.Decoder(AgentMessage)
_emulator_decoder: msgspec.msgpack.Decoder[EmulatorMessage] = msgspec.msgpack.Decoder(EmulatorMessage)
_report_decoder: msgspec.msgpack.Decoder[Report] = msgspec.msgpack.Decoder(Report)


def encode(message: AgentMessage | EmulatorMessage | Report) -> bytes:
    """Any message as bytes."""
    return _encoder.encode(message)


def decode_tx(data: bytes) -> AgentMessage:
    """What an agent said. Raises WireError, also where it is larger than `LARGEST_SAID_BYTES`."""
    _check_size(data)
    return _decode(_agent_decoder, data)


def decode_rx(data: bytes) -> EmulatorMessage:
    """What the emulator said. Raises WireError."""
    return _decode(_emulator_decoder, data)


def decode_report(data: bytes) -> Report:
    """A copy of a report. Raises WireError, also where it is larger than `LARGEST_SAID_BYTES`."""
    _check_size(data)
    return _decode(_report_decoder, data)


def encode_observation(message: dict[str, Any]) -> bytes:
    """A message for observers: numbers, text, bytes, lists and tables of these."""
    return _encoder.encode(message)


def decode_observation(data: bytes) -> dict[str, Any]:
    """Restore `encode_observation`. Raises WireError."""
    return _decode(msgspec.msgpack.Decoder(dict[str, Any]), data)


def is_batch(data: bytes) -> bool:
    """Whether an encoded message is a batch: told from its first bytes, without decoding it."""
    return data[1:7] == b"\xa5Batch"


def is_packets_only(data: bytes) -> bool:
    """Whether an encoded message is a batch without fixes."""
    return is_batch(data) and data[7:8] == b"\x90"


def _decode(decoder: msgspec.msgpack.Decoder[_M], data: bytes) -> _M:
    try:
        return decoder.decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise WireError(f"{len(data)} bytes that are no message: {printable(str(error), 200)}") from None


def _check_size(data: bytes) -> None:
    # Decoded, a byte can become 30: what a stranger may have the emulator allocate is bounded here.
    if len(data) > LARGEST_SAID_BYTES:
        raise WireError(f"{len(data)} bytes at once: at most {LARGEST_SAID_BYTES} are read")


_LATENESS_LIMIT_BIN = 44


def lateness_bin(late_ns: int) -> int:
    """The bin of a delay: four a factor of two, so that bin 44 starts just at the limit of 20 ms."""
    if late_ns <= 0:
        return 0
    position = _LATENESS_LIMIT_BIN + math.floor(4 * math.log2(late_ns / LATENESS_LIMIT_NS))
    return min(max(position, 0), LATENESS_BINS - 1)


def lateness_edge_ms(index: int) -> float:
    """The upper edge of a lateness bin in milliseconds."""
    return LATENESS_LIMIT_NS / 1e6 * float(2 ** ((index + 1 - _LATENESS_LIMIT_BIN) / 4))


def boot_id() -> str:
    """Names this boot of this machine: processes with the same one share a monotonic clock."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return ""
