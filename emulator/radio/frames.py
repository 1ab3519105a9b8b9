"""Frames, their transmissions, and the receptions: one for each transmission and receiver.

A frame keeps the state of the network at the time it was enqueued (connectivity, acting faults). So its outcomes do
not depend on changes while it waits or is on air, nor on the steps in which the engine's time advances.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from emulator.radio.outcomes import PENDING, Outcome
from emulator.radio.propagation import DIGITS
from emulator.radio.topology import TopologySnapshot
from emulator.scenario.radio import RATES_MBPS
from emulator.scenario.scenario import Radio
from vnet.radio import MIN_POWER_DBM, SentFrame
from vnet.types import Mask

NO_CAUSE = -1
"""Number of the causing fault, if there is none."""
NOT_ON_AIR = -1
"""Start of the transmission of a frame that was never transmitted, or whose start is not modelled."""
BROADCAST = -1
"""Addressee of a frame to all."""


def random_flips(draw: float, size_bytes: int, count: int) -> Iterator[tuple[int, int]]:
    """Return `count` bytes of a frame to alter, as position and XOR mask, from a uniform draw in [0, 1).

    All bytes of a shorter frame are altered.
    """
    rng = np.random.default_rng(int(draw * 2**53))
    positions = rng.choice(size_bytes, size=min(count, size_bytes), replace=False)
    masks = rng.integers(1, 256, size=len(positions))
    return zip(positions.tolist(), masks.tolist(), strict=True)


def flips_between(sent: bytes, arrived: bytes) -> Iterator[tuple[int, int]]:
    """Yield where two payloads of one length differ, as position and XOR mask."""
    for position, (before, after) in enumerate(zip(sent, arrived, strict=True)):
        if before != after:
            yield position, before ^ after


def flipped(payload: bytes, flips: Sequence[tuple[int, int]]) -> bytes:
    """Return a payload with these bytes altered."""
    changed = bytearray(payload)
    for position, mask in flips:
        changed[position] ^= mask
    return bytes(changed)


def allowed_choices(radio: Radio, asked: SentFrame, largest_dbm: float | None) -> tuple[float, float]:
    """Return the power above `largest_dbm` in dB and the bit rate in Mbit/s that a program has chosen for a frame.

    They are those that the radio has. `largest_dbm` is the sender's largest power, None without a path loss.
    """
    gain_db, bitrate_mbps = 0.0, radio.bitrate_mbps
    if asked.power_dbm is not None and largest_dbm is not None and math.isfinite(asked.power_dbm):
        power_dbm = max(asked.power_dbm, MIN_POWER_DBM)
        gain_db = round(min(power_dbm - largest_dbm, 0.0), DIGITS)
    if asked.rate_mbps in RATES_MBPS and radio.is_physical and radio.sidelink is None:
        bitrate_mbps = float(asked.rate_mbps or bitrate_mbps)
    return gain_db, bitrate_mbps


class InSlot(NamedTuple):
    """A sidelink's transmission in a slot, on `length` subchannels: (N,) each over the receivers.

    `power_mw` is its power, `others_mw` that of all other signals on its resource; `deaf` marks the vehicles that
    transmitted in the slot, and heard nothing.
    """

    power_mw: NDArray[np.float64]
    others_mw: NDArray[np.float64]
    deaf: NDArray[np.bool_]
    length: int


class Signal(Struct, eq=False):
    """A frame's signal at the receivers, (N,) each; the entry of its own sender holds the transmit power.

    `random_draws` are words of 64 random bits, which give the draws that decide about it. `power_mw` is the
    received power in mW, 0 out of range. `sender_draws` is the word of the frame's own sender.

    `locked` marks the receivers that are locked on this frame; None if no other frame kept any from it. `pieces`
    are tuples (time, total power): until this time in ns the sum of all powers on air was this (N,), in mW. They
    are empty for a frame that was alone on air.

    On a sidelink `slots` has instead what became of it in each slot in which it was transmitted.
    """

    random_draws: NDArray[np.uint64]
    power_mw: NDArray[np.float64]
    sender_draws: int
    locked: NDArray[np.bool_] | None = None
    pieces: list[tuple[int, NDArray[np.float64]]] = []
    slots: list[InSlot] = []


@dataclass(frozen=True)
class Answered:
    """Answer of a rule of the user's own to a frame: arrays (n,) over its receivers, and payloads by index."""

    drop: Mask
    delay_ns: NDArray[np.int64]
    corrupt: NDArray[np.int64]
    payload: Mapping[int, bytes]
    copies: NDArray[np.int64]
    copy_delay_ns: int


class Frame(Struct, frozen=True, eq=False, kw_only=True):  # made much faster than a frozen dataclass
    """A frame, as it is sent. `sender` is a node's number; `seq` counts the sender's frames.

    `copy` counts the times that a fault sends the frame again, or that its sender transmits it again. Such a copy
    has rows and random draws of its own: `draw` tells its draws from the original's, and depends only on the
    fault and on the repeated frame. Its sender's name is `name`, and `cause` is the number of the fault that sends
    or changes it. A frame that a rule has `dropped` is recorded, but not sent.

    It is sent at `bitrate_mbps`, with a power of `gain_db` above that of the scenario. `to` is the number of its
    addressee, or BROADCAST; then `ticket` names what its program waits for. `period_ms` is the reservation interval
    that its program asks for, 0 if it leaves this to the MAC.

    `topology` and `effects` are those of the time it was enqueued.
    """

    sender: int
    seq: int
    sent_ns: int
    payload: bytes
    topology: TopologySnapshot
    effects: LinkEffects
    bitrate_mbps: float
    gain_db: float = 0.0
    copy: int = 0
    draw: int = 0
    name: str = ""
    cause: int = NO_CAUSE
    dropped: bool = False
    to: int = BROADCAST
    ticket: int = 0
    period_ms: int = 0

    @property
    def size_bytes(self) -> int:
        """Length of the payload."""
        return len(self.payload)


class Transmission(Struct, eq=False):
    """One transmission of a frame, and what becomes of it.

    `sender_outcome` is decided at the sender: oversize, queue_full, held_back, fault (a rule dropped it); pending
    for a frame that is sent. The frame is on air from `on_air_ns` (NOT_ON_AIR if that is not modelled) to `end_ns`.

    To one vehicle it is transmission number `attempt` of its frame, from 1 on, and `row` is its row of the trace.
    `received_as` is the earlier attempt that was received, and `is_missed` says that an addressee was down when it
    arrived. `decoded` marks the vehicles (N,) that could read this one, `garbled` those that could not, although
    they were locked on it. `ack` is its acknowledgement, and `acked` says that its sender received that.

    `altered` are the payloads that arrive with other bytes, by receiver. `answers` are those of rules of the user's
    own, by fault, with the columns that they speak of.
    """

    frame: Frame
    attempt: int = 0
    sender_outcome: Outcome = Outcome.pending
    on_air_ns: int = NOT_ON_AIR
    end_ns: int = 0
    signal: Signal | None = None
    row: int = -1
    received_as: Transmission | None = None
    is_missed: bool = False
    decoded: NDArray[np.bool_] | None = None
    garbled: NDArray[np.bool_] | None = None
    ack: Transmission | None = None
    acked: bool = False
    altered: dict[int, bytes] = {}
    answers: dict[int, tuple[NDArray[np.intp], Answered]] = {}


class CopyNumbers(Counter[tuple[int, int]]):
    """Numbers of the copies of each frame, by its sender and its number."""

    def next(self, sender: int, seq: int) -> int:
        """Return the number of another copy."""
        self[sender, seq] += 1
        return self[sender, seq]


class UnicastResult(NamedTuple):
    """Result of frame `number` of the node number `sender` to one vehicle, which its node learns at `time_ns`."""

    time_ns: int
    sender: int
    number: int
    delivered: bool
    attempts: int


class LinkEffects(Protocol):
    """The effects of link faults on the frames sent while they act."""

    @property
    def lose(self) -> bool:
        """True if any reception may be lost."""

    @property
    def change(self) -> bool:
        """True if a reception may arrive later, more than once, or with other bytes."""

    @property
    def copy(self) -> bool:
        """True if a reception may arrive more than once."""

    def losses(self, sent: Transmission) -> Iterator[tuple[int, Mask]]:
        """Yield, in the order in which faults act, a fault's number and the columns (M,) that lose the frame."""

    def changes(self, sent: Transmission, index: int, receptions: Receptions) -> None:
        """Delay, duplicate or alter the pending receptions of transmission number `index`."""


class Copied(NamedTuple):
    """Duplicates of transmission number `frame_index`: mask of columns (M,), delay in ns, number of the fault."""

    frame_index: int
    receivers: NDArray[np.bool_]
    later_ns: int
    cause: int


@dataclass(slots=True)
class Receptions:
    """The receptions of K transmissions: arrays (K, M), whose columns are those of their topology snapshots.

    `receiver` holds the receivers' numbers; if it is None, then M = N, and the columns are receivers' numbers.

    `outcome` holds values of `Outcome`; `arrival_ns` is the arrival time of a frame that arrives; `cause` is the
    number of the fault behind an outcome `fault` or behind altered bytes, else NO_CAUSE. `copies` are the
    duplicates that also arrive. `flips` are the altered bytes by (frame, column): position in the payload, and
    XOR mask.
    """

    outcome: NDArray[np.uint8]
    arrival_ns: NDArray[np.int64]
    cause: NDArray[np.int16]
    receiver: NDArray[np.intp] | None = None
    copies: list[Copied] = field(default_factory=list)
    flips: dict[tuple[int, int], list[tuple[int, int]]] = field(default_factory=dict)

    @classmethod
    def of(cls, transmissions: Sequence[Transmission], count: int) -> Receptions:
        """Return the receptions of transmissions among `count` nodes, all pending."""
        receiver = None if transmissions[0].frame.topology.receiver is None else rows(transmissions, "receiver")
        shape = (len(transmissions), count) if receiver is None else receiver.shape
        arrival_ns, cause = np.empty(shape, np.int64), np.empty(shape, np.int16)
        arrival_ns.T[:] = [sent.end_ns for sent in transmissions]
        cause.T[:] = [sent.frame.cause for sent in transmissions]
        return cls(np.zeros(shape, np.uint8), arrival_ns, cause, receiver)

    def receivers(self) -> NDArray[np.intp]:
        """Return the receivers' numbers (K, M)."""
        if self.receiver is None:
            return np.broadcast_to(np.arange(self.outcome.shape[1]), self.outcome.shape)
        return self.receiver

    def decide(self, mask: NDArray[np.bool_] | bool, outcome: Outcome) -> None:
        """Give `outcome` to the pending receptions of a mask that broadcasts to (K, M)."""
        decided = (self.outcome == PENDING) & mask  # pending is zero, so adding is setting
        self.outcome += decided.view(np.uint8) * np.uint8(outcome.value)

    def fault(self, index: int, columns: NDArray[np.bool_], cause: int) -> None:
        """Lose the frame at row `index` by fault number `cause` where it is still pending.

        `columns` are a mask of the first columns; those beyond it are no receptions.
        """
        width = len(columns)
        decided = (self.outcome[index, :width] == PENDING) & columns
        self.outcome[index, :width][decided] = Outcome.fault
        self.cause[index, :width][decided] = cause


def rows(transmissions: Sequence[Transmission], name: str) -> NDArray[Any]:
    """Return (K, M): for each frame, its sender's row of the array `name` of its topology snapshot.

    Shorter rows are filled up with zeros, or False.
    """
    frames = [sent.frame for sent in transmissions]
    first = frames[0].topology
    if all(frame.topology is first for frame in frames):
        return np.asarray(getattr(first, name)[[frame.sender for frame in frames]])
    each = [getattr(frame.topology, name)[frame.sender] for frame in frames]
    filled = np.zeros((len(each), max(map(len, each))), each[0].dtype)
    for index, row in enumerate(each):
        filled[index, : len(row)] = row
    return filled


def frame_keys(transmissions: Sequence[Transmission]) -> NDArray[np.uint64]:
    """Return what names the draws of each frame (K, 3): its sender, its number, and which copy it is."""
    keys = [(frame.sender, frame.seq, frame.draw) for sent in transmissions for frame in (sent.frame,)]
    return np.array(keys, np.uint64).reshape(-1, 3)


Stage = Callable[[Sequence[Transmission], Receptions], None]
"""One step of the channel: decides receptions, or changes when they arrive."""
