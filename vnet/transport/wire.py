"""The messages on the keys of a node: typed records and their msgpack encoding, without I/O.

`tx` carries an agent's messages (`Hello`, `Yield`, `Frames`, `Final`, `StackDump`), `rx` the emulator's (`Welcome`,
`Grant`, `Batch`, `StackRequest`, `Await`, `End`). Decoding checks every type and bound; a violation is a
`WireError`. All times are integer nanoseconds from the start of the run.

Within a process a yield or a grant holds the messages of the backbone themselves. On Zenoh it holds references, and
the messages are on keys of the units' own (`Sent`, `Arrived`). Whoever says something to the other end puts the
messages of units on their keys first, and references to them in what it says. The other end resolves the
references, whatever comes first: nothing depends on an order between keys.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Collection, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Generic, Literal, TypeVar

import msgspec
import numpy as np
from msgspec.structs import replace

from vnet.errors import WireError, printable
from vnet.node import NOTHING_SENSED, Action, Fix, Reading
from vnet.radio import BackboneMessage, Packet, SendResult, SentFrame, UnitAbilities
from vnet.reports import Report

TimeNs = Annotated[int, msgspec.Meta(ge=0, le=2**62)]
Count = Annotated[int, msgspec.Meta(ge=0, le=2**62)]
PacketCount = Annotated[int, msgspec.Meta(ge=0, le=2**40)]
"""Number of packets: more than any run has, and few enough that the sum over all processes can be written."""


class Deviation(msgspec.Struct, frozen=True, array_like=True):
    """A decision of `node` that is not FIFO's: at `time_ns`, of what happened, `label` came before `first`.

    `decision` counts the decisions of the instant from 0.
    """

    node: str
    incarnation: Count
    time_ns: TimeNs
    decision: Count
    label: Annotated[str, msgspec.Meta(max_length=256)]
    first: Annotated[str, msgspec.Meta(max_length=256)]


class Order(msgspec.Struct, frozen=True, array_like=True):
    """In which order a node is shown what happens at one instant (lockstep), if not FIFO.

    `depth` and `steps` are those of `pct`; `tape` has the deviations from FIFO of a `tape`. Timers are due at
    multiples of `slack_ns`, if it is not 0, plus `phase_ns`.
    """

    kind: Literal["shuffle", "pct", "tape"]
    seed: int = 0
    depth: Count = 1
    steps: Count = 0
    tape: Sequence[Deviation] = ()
    slack_ns: Count = 0
    phase_ns: Count = 0


class WireSendResult(msgspec.Struct, frozen=True, array_like=True):
    """The result of frame `number` that `node` has sent to another one, which it learns at `time_ns`."""

    node: str
    number: Count
    time_ns: TimeNs
    delivered: bool
    attempts: Count

    def result(self) -> SendResult:
        """Return the result as the program sees it."""
        return SendResult(self.delivered, self.attempts)


LATENESS_LIMIT_NS = 20_000_000
"""Deliveries later than this count against a real-time run."""
LATENESS_BINS = 80
"""Number of bins."""
_LATENESS_LIMIT_BIN = 44
"""Bin whose lower edge is `LATENESS_LIMIT_NS`."""


def lateness_bin(late_ns: int) -> int:
    """Return the bin of a delay: four bins for each factor of two; bin 44 begins at the bound of 20 ms."""
    if late_ns <= 0:
        return 0
    position = _LATENESS_LIMIT_BIN + math.floor(4 * math.log2(late_ns / LATENESS_LIMIT_NS))
    return min(max(position, 0), LATENESS_BINS - 1)


def lateness_edge_ms(index: int) -> float:
    """Return the upper edge of a lateness bin in milliseconds."""
    return LATENESS_LIMIT_NS / 1e6 * float(2 ** ((index + 1 - _LATENESS_LIMIT_BIN) / 4))


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


VERSION = 2
"""Version of the messages. 2: a grant is for a window, and a yield has steps."""
HEAD_START_NS = 200_000_000
"""Real time: time from the announcement of time 0 to time 0, so that all processes receive it before."""
LARGEST_MESSAGE_BYTES = 64 * 2**20
"""Largest message of an agent: it holds a frame of the largest payload from each of a thousand nodes."""

LARGEST_BUNDLE_BYTES = 2 * LARGEST_MESSAGE_BYTES
"""Largest message of a host, which bundles those of its agents."""


class Message(msgspec.Struct, frozen=True, array_like=True, tag=True):
    """Base of all messages: an array whose first element names the kind of message."""


class WirePacket(msgspec.Struct, frozen=True, array_like=True):
    """A `Packet` for `node`."""

    node: str
    sender: str
    sent_ns: TimeNs
    received_ns: TimeNs
    payload: bytes
    rssi_dbm: float | None = None
    snr_db: float | None = None

    @classmethod
    def of(cls, node: str, packet: Packet) -> WirePacket:
        """Return the packet in its form on the wire, for its receiver `node`."""
        sender, sent_ns, received_ns, payload = packet.sender, packet.sent_ns, packet.received_ns, packet.payload
        return cls(node, sender, sent_ns, received_ns, payload, packet.rssi_dbm, packet.snr_db)

    def packet(self) -> Packet:
        """Return the packet as the program sees it: a sender is one object, which `pickle` tells apart."""
        sender = sys.intern(self.sender)
        return Packet(sender, self.sent_ns, self.received_ns, self.payload, self.rssi_dbm, self.snr_db)


class WireFix(msgspec.Struct, frozen=True, array_like=True):
    """A `Fix` for `node`; the covariance is in row-major order, `multipath` has its deviation and time."""

    node: str
    time_ns: TimeNs
    position_m: tuple[float, float]
    covariance_m2: tuple[float, float, float, float]
    heading_rad: float | None
    speed_m_s: float | None = None
    gap_m: float | None = None
    gap_rate_m_s: float | None = None
    sensors: dict[str, Reading] | None = None
    multipath: tuple[float, float] | None = None

    @classmethod
    def of(cls, node: str, fix: Fix) -> WireFix:
        """Return the fix in its form on the wire."""
        x, y = fix.position_m.tolist()
        a, b, c, d = fix.covariance_m2.ravel().tolist()
        seen = fix.heading_rad, fix.speed_m_s, fix.gap_m, fix.gap_rate_m_s, dict(fix.sensors) or None
        multipath = (fix.multipath_sigma_m, fix.multipath_tau_s) if fix.multipath_sigma_m else None
        return cls(node, fix.time_ns, (x, y), (a, b, c, d), *seen, multipath)

    def fix(self) -> Fix:
        """Return the fix as the program sees it."""
        position_m, covariance_m2 = np.array(self.position_m), np.array(self.covariance_m2).reshape(2, 2)
        seen = self.heading_rad, self.speed_m_s, self.gap_m, self.gap_rate_m_s, self.sensors or NOTHING_SENSED
        return Fix(self.time_ns, position_m, covariance_m2, *seen, *(self.multipath or ()))


class Ending(msgspec.Struct, frozen=True, array_like=True):
    """The end of a program: it returned, raised, died, or did not let time advance (`details`: the stack)."""

    node: str
    kind: Literal["finished", "crashed", "spun", "died"]
    error: str = ""
    details: str = ""
    place: str = ""
    """File and line of the program at which it ended, if that is known."""
    time_ns: TimeNs | None = None
    """The instant of the end: what is told after the run (real time) counts if it was within."""


class Unhandled(msgspec.Struct, frozen=True, array_like=True):
    """An exception of a node's program that nobody handled, and when it was raised.

    A `time_ns` of None: as the program was ended. `error` is its type and message, `place` says where it came up,
    `details` is the traceback.
    """

    node: str
    time_ns: TimeNs | None
    error: str
    place: str = ""
    details: str = ""


class Note(msgspec.Struct, frozen=True, array_like=True):
    """A line of a node's log, or an event of its program, which `text` then names, with its `details`."""

    node: str
    time_ns: TimeNs
    kind: Literal["log", "event"]
    level: Literal["debug", "info", "warning", "error", "critical"]
    text: str
    details: dict[str, bool | int | float | str] = {}


class Traffic(msgspec.Struct, frozen=True, array_like=True):
    """Frames and all else that the nodes of one process made, in order; `deviations` where orders are tried."""

    frames: Sequence[SentFrame] = ()
    reports: Sequence[Report] = ()
    endings: Sequence[Ending] = ()
    unhandled: Sequence[Unhandled] = ()
    notes: Sequence[Note] = ()
    deviations: Sequence[Deviation] = ()
    actions: Sequence[Action] = ()
    messages: Sequence[MessageRef] = ()

    def __bool__(self) -> bool:
        """Return true if there is anything in it."""
        told = self.frames or self.reports or self.endings or self.unhandled or self.notes
        return bool(told or self.deviations or self.actions or self.messages)


class Step(msgspec.Struct, frozen=True, array_like=True):
    """Lockstep: what the nodes of one process enqueued at one instant of a window."""

    time_ns: TimeNs
    traffic: Traffic


class Hello(Message, frozen=True):
    """A node's request to join. `process_id` is the first node of its process, whose keys carry its traffic.

    `nonce` is a secret of the process; later messages contain it, so that no other process can impersonate the
    node. The message is sent again with `ready` after the welcome, once the program is loaded, or with the
    `failure` to load it. An agent that knows no `version` speaks the first. With `ahead` the process passes
    through quiet instants beyond its windows.
    """

    node: str
    process_id: str
    nonce: bytes
    pid: int
    host: str
    ready: bool = False
    failure: str | None = None
    version: Count = 1
    ahead: bool = False


class Yield(Message, frozen=True):
    """Lockstep: the process has nothing left to do before the end of the window of grant `seq`.

    `steps` are in the order of time; instants at which nothing was enqueued have none. Those of quiet instants are
    told in advance. `instants` is the number of all instants at which the process ran.
    """

    nonce: bytes
    seq: Count
    next_timer_ns: TimeNs | None
    waiting_radio: Sequence[str]
    waiting_gnss: Sequence[str]
    steps: Sequence[Step]
    instants: Count


class Lateness(msgspec.Struct, frozen=True, array_like=True):
    """Real time: packets to their process by how late, or early, they came, in the bins of `lateness_bin`."""

    counts: Annotated[Sequence[PacketCount], msgspec.Meta(min_length=LATENESS_BINS, max_length=LATENESS_BINS)]


class Frames(Message, frozen=True):
    """Real time: traffic since the last message; acknowledges batches up to `received_seq` without `missed`.

    `unseen` are messages of the backbone to which batches have referred and that have not come within a second.
    `late` are batches with a packet over 20 ms late: their `seq`, and the time of the run at which they came.
    """

    nonce: bytes
    seq: Count
    received_seq: Count
    missed: Sequence[tuple[Count, Count]]
    traffic: Traffic
    lateness: Lateness | None = None
    final: bool = False
    unseen: Sequence[MessageRef] = ()
    late: Sequence[tuple[Count, TimeNs]] = ()


class Final(Message, frozen=True):
    """The last traffic of a process whose programs were ended, after `End`; in lockstep, unless `provisional`.

    Provisional, in both pacings, are exceptions unhandled before they are ended: they count if nothing follows. The
    emulator answers it with another `End`.
    """

    nonce: bytes
    traffic: Traffic
    provisional: bool = False


class StackDump(Message, frozen=True):
    """The answer to `StackRequest`: the stacks of the process's program threads, and in lockstep its instant.

    In real time `seq` is the number of the next `Frames`: who answers after a restart has sent the ones before it.
    """

    nonce: bytes
    text: str
    time_ns: TimeNs | None = None
    seq: Count | None = None


class Welcome(Message, frozen=True):
    """Admission of a node, with all that it needs to run its program; the scenario itself is never sent.

    Without `runs` the program had ended before its process was restarted, and does not run again.
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
    version: Count = 1
    order: Order | None = None
    control_ns: Count = 0
    max_power_dbm: float | None = None
    rates_mbps: Sequence[float] = ()
    acknowledges: bool = False
    unit: UnitAbilities | None = None
    periods_ms: Sequence[float] = ()


class ClockError(msgspec.Struct, frozen=True, array_like=True):
    """Error of the clock of `node`: at time t it shows t + offset_ns + rate · (t − since_ns)."""

    node: str
    since_ns: TimeNs
    offset_ns: Annotated[int, msgspec.Meta(ge=-(2**53), le=2**53)] = 0
    rate: Annotated[float, msgspec.Meta(gt=-1, lt=2**20)] = 0.0

    @property
    def is_wrong(self) -> bool:
        """True if the clock deviates."""
        return bool(self.offset_ns or self.rate)

    def shown_ns(self, time_ns: int) -> int:
        """Return the reading of the clock at `time_ns`."""
        return time_ns + self.offset_ns + round(self.rate * (time_ns - self.since_ns))

    def time_ns(self, shown_ns: int) -> int:
        """Return the time at which the clock reads `shown_ns`."""
        return self.since_ns + round((shown_ns - self.since_ns - self.offset_ns) / (1 + self.rate))


class BusyRatios(msgspec.Struct, frozen=True, array_like=True):
    """Channel busy ratios of the nodes of a process, in their order, as they know them from `from_ns` on."""

    from_ns: TimeNs
    ratios: Sequence[Annotated[float, msgspec.Meta(ge=0, le=1)]]


class Grant(Message, frozen=True):
    """Lockstep: the window from `time_ns` to just before `end_ns`. Grant 0 starts a process.

    `time_ns` is the first instant at which the process has something to do. `packets` are those that arrive before
    the end, each at its `received_ns`; `fixes` are due at the first instant. `clocks` are the clock errors that
    have changed, `busy` the channel busy ratios of the window if vehicles share a medium,
    `results` those of frames to single nodes and `messages` those of the backbone, each at its `time_ns`.

    Instants before `quiet_ns` may be passed beyond the window as long as they are quiet; `next_fixes`, at
    `next_fixes_ns`, belong to such an instant. They are given only to processes that have said `ahead`.
    """

    seq: Count
    time_ns: TimeNs
    end_ns: TimeNs
    packets: Sequence[WirePacket] = ()
    fixes: Sequence[WireFix] = ()
    clocks: Sequence[ClockError] = ()
    quiet_ns: TimeNs = 0
    next_fixes: Sequence[WireFix] = ()
    next_fixes_ns: TimeNs | None = None
    busy: Sequence[BusyRatios] = ()
    results: Sequence[WireSendResult] = ()
    messages: Sequence[MessageRef] = ()


class Batch(Message, frozen=True):
    """Real time: the packets and fixes due by now. Batch 0 starts the process.

    The emulated time `start_ns` is at `origin_ns` + `start_ns` on the monotonic clock of the machine whose boot the
    welcome names; on other machines it is the arrival of batch 0. `held` is true if packets waited for a paused
    process, so that they do not count as late. `lost` are ranges of `Frames` that have never come.
    """

    fixes: Sequence[WireFix]
    seq: Count
    packets: Sequence[WirePacket] = ()
    origin_ns: int | None = None
    start_ns: TimeNs = 0
    held: bool = False
    clocks: Sequence[ClockError] = ()
    busy: Sequence[BusyRatios] = ()
    results: Sequence[WireSendResult] = ()
    messages: Sequence[MessageRef] = ()
    lost: Sequence[tuple[Count, Count]] = ()


class Receipts:
    """Real time: the batches that have come to a process, and what it acknowledges with its next `Frames`."""

    def __init__(self) -> None:
        self.seq = 0
        """Number of the next `Frames`."""
        self._expected = 0
        self._missed: list[tuple[int, int]] = []
        self._lateness = [0] * LATENESS_BINS
        self._late: list[tuple[int, int]] = []

    def take(self, batch: Batch, now_ns: int) -> None:
        """Take note of a batch that has come at `now_ns` of the run."""
        if batch.seq > self._expected:
            self._missed.append((self._expected, batch.seq - 1))
        self._expected = batch.seq + 1
        late_ns = [] if batch.held else [now_ns - packet.received_ns for packet in batch.packets]
        for each_ns in late_ns:
            self._lateness[lateness_bin(abs(each_ns))] += 1  # early where a host's clock is slow, or was stopped
        if max(late_ns, default=0) >= LATENESS_LIMIT_NS:
            self._late.append((batch.seq, now_ns))

    def frames(
        self, nonce: bytes, traffic: Traffic, final: bool = False, unseen: Sequence[MessageRef] = ()
    ) -> Frames:
        """Return the next message of the process."""
        seq, missed, late = self.seq, self._missed, self._late
        self.seq, self._missed, self._late = seq + 1, [], []
        lateness = Lateness(tuple(self._lateness))
        return Frames(nonce, seq, self._expected, missed, traffic, lateness, final, unseen, late)


class StackRequest(Message, frozen=True):
    """Request for the stacks of a process for which the emulator has waited too long."""


class Await(Message, frozen=True):
    """Notice that the emulator, or its router, will be absent, for at most `within_s` seconds."""

    within_s: float


class End(Message, frozen=True):
    """End of the run, or refusal of this node. In lockstep it may say when: programs end at that time."""

    nonce: bytes | None
    reason: str
    refused: bool = False
    time_ns: TimeNs | None = None


AgentMessage = Hello | Yield | Frames | Final | StackDump
EmulatorMessage = Welcome | Grant | Batch | StackRequest | Await | End

_M = TypeVar("_M")
_encoder = msgspec.msgpack.Encoder()
_agent_decoder: msgspec.msgpack.Decoder[AgentMessage] = msgspec.msgpack.Decoder(AgentMessage)
_emulator_decoder: msgspec.msgpack.Decoder[EmulatorMessage] = msgspec.msgpack.Decoder(EmulatorMessage)


def encode(message: AgentMessage | EmulatorMessage | Report | Sent | Arrived) -> bytes:
    """Encode a message."""
    return _encoder.encode(message)


def decode_tx(data: bytes) -> AgentMessage:
    """Decode a message of an agent. Raise WireError for a bad one, or one above `LARGEST_MESSAGE_BYTES`."""
    check_size(data)
    return decode(_agent_decoder, data)


def decode_rx(data: bytes) -> EmulatorMessage:
    """Decode a message of the emulator. Raise WireError for a bad one."""
    return decode(_emulator_decoder, data)


def encode_observation(message: dict[str, Any]) -> bytes:
    """Encode a message to observers: numbers, text, bytes, lists and maps of these."""
    return _encoder.encode(message)


def decode_observation(data: bytes) -> dict[str, Any]:
    """Decode a message to observers. Raise WireError for a bad one."""
    return decode(msgspec.msgpack.Decoder(dict[str, Any]), data)


def is_yield(data: bytes) -> bool:
    """Return true if an encoded message is a yield, judged by its first bytes without decoding it."""
    return data[1:7] == b"\xa5Yield"


def other_version(speaker: str, version: int, listener: str) -> str:
    """Return the one line for an agent or an emulator whose messages have another version."""
    return (
        f"the {speaker} speaks version {version} of the messages, this {listener} version {VERSION}: "
        "use the same version of vnet"
    )


def is_batch(data: bytes) -> bool:
    """Return true if an encoded message is a batch, judged by its first bytes without decoding it."""
    return data[1:7] == b"\xa5Batch"


def is_packets_only(data: bytes) -> bool:
    """Return true if an encoded message is a batch without fixes."""
    return is_batch(data) and data[7:8] == b"\x90"


def decode(decoder: msgspec.msgpack.Decoder[_M], data: bytes) -> _M:
    """Decode a message of one kind. Raise WireError for a bad one."""
    try:
        return decoder.decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise WireError(f"{len(data)} bytes are not a message: {printable(str(error), 200)}") from None


def check_size(data: bytes) -> None:
    """Raise WireError for a message above `LARGEST_MESSAGE_BYTES`."""
    # A byte can take 30 when decoded: this bounds the memory that an untrusted sender can make the emulator
    # allocate.
    if len(data) > LARGEST_MESSAGE_BYTES:
        raise WireError(f"message of {len(data)} bytes: at most {LARGEST_MESSAGE_BYTES} allowed")


FIRST_TIME_NAMESPACE = "time:[4026531834]"
"""Constant of Linux (PROC_TIME_INIT_INO): the time namespace whose clocks are the machine's own."""


def boot_id() -> str:
    """Return the id of this machine's boot, and of the time namespace unless that is the first.

    Processes with the same id share a monotonic clock.
    """
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return ""
    with suppress(OSError):  # before Linux 5.6
        if (namespace := str(Path("/proc/self/ns/time").readlink())) != FIRST_TIME_NAMESPACE:
            return f"{boot} {namespace}"
    return boot


# Messages of the backbone on keys of the units' own.


class Sent(Message, frozen=True):
    """A message that a unit sends, on its `tx`; `nonce` is that of its process."""

    nonce: bytes
    number: Count
    to: str | None
    payload: bytes

    def message(self, unit: str) -> SentMessage:
        """Return the message, as what `unit` has put."""
        return SentMessage(unit, self.number, self.to, self.payload)


class Arrived(Message, frozen=True):
    """A message for a unit, on its `rx`."""

    number: Count
    sender: str
    sent_ns: TimeNs
    time_ns: TimeNs
    payload: bytes

    def message(self, unit: str) -> WireMessage:
        """Return the message, as what came for `unit`."""
        return WireMessage(unit, self.number, self.sender, self.sent_ns, self.time_ns, self.payload)


_sent_decoder: msgspec.msgpack.Decoder[Sent] = msgspec.msgpack.Decoder(Sent)
_arrived_decoder: msgspec.msgpack.Decoder[Arrived] = msgspec.msgpack.Decoder(Arrived)


def decode_sent(data: bytes) -> Sent:
    """Decode what is on a unit's `tx`. Raise WireError for a bad one, or one above `LARGEST_MESSAGE_BYTES`."""
    check_size(data)
    return decode(_sent_decoder, data)


def decode_arrived(data: bytes) -> Arrived:
    """Decode what is on a unit's `rx`. Raise WireError for a bad one."""
    return decode(_arrived_decoder, data)


# Splitting, before a message is put.


def _split(traffic: Traffic, nonce: bytes) -> tuple[Traffic, list[tuple[str, Sent]]]:
    """Return traffic with references in the place of its messages, and these."""
    contents = [
        (each.node, Sent(nonce, each.number, each.to, each.payload)) for each in sent_in_full(traffic.messages)
    ]
    return replace(traffic, messages=_refs(traffic.messages)), contents


def split_yield(message: Yield) -> tuple[Yield, list[tuple[str, Sent]]]:
    """Return a yield with references in the place of its messages, and what its units are to put on their `tx`."""
    parts = [_split(step.traffic, message.nonce) for step in message.steps]
    steps = [replace(step, traffic=part) for step, (part, _) in zip(message.steps, parts, strict=True)]
    return replace(message, steps=steps), [content for _, contents in parts for content in contents]


def split_frames(message: Frames) -> tuple[Frames, list[tuple[str, Sent]]]:
    """Return frames with references in the place of their messages, as `split_yield` does."""
    traffic, contents = _split(message.traffic, message.nonce)
    return replace(message, traffic=traffic), contents


def split_grant(message: Grant | Batch) -> tuple[Grant | Batch, list[tuple[str, Arrived]]]:
    """Return a grant or a batch with references to its messages, and what is to be put on its units' `rx`."""
    contents = [
        (each.node, Arrived(each.number, each.sender, each.sent_ns, each.time_ns, each.payload))
        for each in arrived_in_full(message.messages)
    ]
    return replace(message, messages=_refs(message.messages)), contents


def _refs(messages: Sequence[MessageRef]) -> list[MessageRef]:
    return [MessageRef(each.node, each.number) for each in messages]


# Joining, at the other end.

_R = TypeVar("_R", bound=MessageRef)


class Contents(Generic[_R]):
    """Messages that have come on units' keys and to which nothing has referred yet."""

    def __init__(self) -> None:
        self._messages: dict[tuple[str, int], _R] = {}

    def add(self, message: _R) -> None:
        """Add a message."""
        self._messages[message.node, message.number] = message

    def split(self, refs: Sequence[MessageRef]) -> tuple[list[_R], list[MessageRef]]:
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


def refs_of(message: Yield) -> list[MessageRef]:
    """Return all references of a yield, in order."""
    return [ref for step in message.steps for ref in step.traffic.messages]


def join_yield(message: Yield, sent: Contents[SentMessage]) -> Yield:
    """Return a yield with messages that have come in the place of its references: the reverse of `split_yield`."""
    messages = [sent.split(step.traffic.messages)[0] for step in message.steps]
    steps = [
        replace(step, traffic=replace(step.traffic, messages=own))
        for step, own in zip(message.steps, messages, strict=True)
    ]
    return replace(message, steps=steps)
