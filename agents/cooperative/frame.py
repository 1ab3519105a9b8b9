"""The frame that a cooperative vehicle broadcasts each period, as bytes and back (MODEL 3), and who is heard.

It holds the fix, the estimate, the state of the consensus, the names of the vehicles heard, a sample of the
particles of the common error in steps of 1 cm, and relayed fixes. Vehicles are named by 4-byte hashes of their
ids. A frame names its sender, so that no other can send it again as its own, and ends with a CRC-32. Bytes that do
not decode, or decode to absurd values, raise a `FrameError` with a reason of one word: the radio delivers
anything.

Admission decides which frames a vehicle reads, and for which reasons it rejects the others. A frame is judged here
by itself, and against what its sender has sent before. Whether it agrees with what others send is judged where it
is used.

A process of one vehicle decodes each frame once, so a large cache would only take memory there. In a process of
many vehicles all that hear a frame share what it holds (`VehicleCache`): each vehicle adds to its size.
"""

from __future__ import annotations

import hashlib
import math
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Generic, ParamSpec, Protocol, TypeVar
from weakref import WeakSet

import numpy as np
from numpy.typing import NDArray

from vnet import Packet
from vnet.types import Array

P = ParamSpec("P")
R = TypeVar("R")

LEAST_ENTRIES = 64
"""Entries for one vehicle: what is heard in a period, by twice the default peer cap."""
ENTRIES_PER_VEHICLE = 4
"""Entries for each further vehicle: what it sends in two periods with two frames a period."""

_vehicles: WeakSet[object] = WeakSet()
_caches: list[VehicleCache[..., object]] = []
_entries = LEAST_ENTRIES

VERSION = 3
"""Version of the layout; a receiver refuses any other."""
NAME_BYTES = 4
"""Bytes of a vehicle's name: of 1000 vehicles two agree with a chance of 10⁻⁴."""
PARTICLE_BYTES = 4
"""Bytes of a particle: two int16, in centimetres."""
COMMON_LIMIT_M = 327.0
"""Largest common error (m) an axis: int16 centimetres end here."""
POSITION_LIMIT_M = 1e7
"""Largest coordinate (m) of a fix in a local frame: int32 centimetres end at twice that."""
MAX_WEIGHT = 1e12
"""Largest weight of a running sum: epochs are restarted long before."""
MAX_HEARD = 255
"""Number of names in a frame: their number is one byte."""
MAX_DEGREE = 255
"""Largest degree in a frame: it is one byte."""
NO_HEADING = 0xFFFF
"""Heading code of a fix without a heading."""
_FULL_TURN = 0xFFFF
"""Heading codes of a full turn: steps of 2π / 65535."""

# version, heard, relayed, largest degree, particles, heading, name, fix time, fix in cm, x_i, Cov(x_i), epoch, sums
_HEADER = struct.Struct("<BBBBHHIQii2f3fI3d")
_CHECKSUM = struct.Struct("<I")
RELAYED = np.dtype([("name", "<u4"), ("age", "u1"), ("heading", "<u2"), ("x_cm", "<i4"), ("y_cm", "<i4")])
"""A relayed fix: vehicle, age in periods relative to the frame's own fix, heading code, position in cm."""
RELAY_LIMIT = 255
"""Number of relayed fixes in a frame: their number is one byte."""
STALE_PERIODS = 3
"""Age in periods beyond which a frame is stale: the radio takes less than one, a late vehicle another."""
EPOCH_MARGIN = 10
"""Epochs by which a frame may be ahead of one a period since the start, the most that a network begins. A frame
that claims more is absurd, and its epoch would spread."""
MAX_SENDERS = 255
"""Number of senders that are read: a frame can name no more as heard. Known senders go before new ones."""
FORGET_PERIODS = 10
"""Periods between two times at which senders are forgotten: it need not be exact."""


class VehicleCache(Generic[P, R]):
    """A function whose latest results are kept, as many as the vehicles of the process need.

    cached: the function with the present cache, for loops: a call of it is a tenth of one of this object.
    """

    def __init__(self, function: Callable[P, R]) -> None:
        self._function = function
        self.__wrapped__ = function
        self.__doc__ = function.__doc__
        self.resize()
        _caches.append(self)  # type: ignore[arg-type]  # invariant in P

    def resize(self) -> None:
        """Begin a cache of the present size; what was kept is forgotten."""
        self.cached = lru_cache(maxsize=_entries)(self._function)

    @property
    def entries(self) -> int:
        """Most results that are kept."""
        return int(self.cached.cache_parameters()["maxsize"])

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """Return the function's result, from the cache if it is there."""
        return self.cached(*args, **kwargs)  # type: ignore[arg-type]  # all arguments are hashable


def add_vehicle(vehicle: object) -> None:
    """Count `vehicle` among those of the process for as long as it exists.

    Sizes double, so that vehicles that enter one by one do not empty the caches each time.
    """
    global _entries
    _vehicles.add(vehicle)
    needed = LEAST_ENTRIES + ENTRIES_PER_VEHICLE * (len(_vehicles) - 1)
    if needed > _entries:
        _entries = max(needed, 2 * _entries)
        for cache in _caches:
            cache.resize()


class FrameError(ValueError):
    """A payload that is no frame of this program; the message is the reason by which it is counted."""


@dataclass(frozen=True)
class CooperativeFrame:
    """The contents of a frame; names are `short_name`s.

    heard: the names of the vehicles received lately; true for out-neighbours, which are given a share.
    cloud_m, relayed: (n, 2) particles and (m,) records of `RELAYED`, which may be empty.
    largest_degree: the largest number of neighbours of any vehicle, as far as this one knows.
    name: the sender.
    """

    fix_time_ns: int
    fix_m: Array
    heading_rad: float | None
    estimate_m: Array
    covariance_m2: Array
    epoch: int
    running_sum: tuple[float, float, float]
    heard: dict[str, bool]
    cloud_m: Array
    relayed: NDArray[np.void] = field(default_factory=lambda: np.empty(0, dtype=RELAYED))
    largest_degree: int = 0
    name: str = "00000000"

    @cached_property
    def out_neighbours(self) -> frozenset[str]:
        """The out-neighbours: those of `heard` that are given a share."""
        return frozenset(name for name, is_given in self.heard.items() if is_given)

    @cached_property
    def names_heard(self) -> frozenset[str]:
        """The names in `heard`."""
        return frozenset(self.heard)

    @property
    def fingerprint(self) -> bytes:
        """The fix in centimetres, as bytes: no two receivers agree to the centimetre."""
        return struct.pack("<2i", *centimetres(self.fix_m))

    def own_fix(self, code: int) -> NDArray[np.void]:
        """The sender's own fix, (1,) of `RELAYED`, under its code."""
        x_cm, y_cm = centimetres(self.fix_m)
        return np.array([(code, 0, _heading_code(self.heading_rad), x_cm, y_cm)], dtype=RELAYED)


@lru_cache(maxsize=1024)
def short_name(node: str) -> str:
    """Return the name of a node in frames: 4 bytes in hexadecimal."""
    return hashlib.blake2b(node.encode(), digest_size=NAME_BYTES).hexdigest()


def name_of_code(code: int) -> str:
    """Return the `short_name` of a code in `RELAYED`; `int(name, 16)` is the inverse."""
    return f"{code:0{2 * NAME_BYTES}x}"


def room(heard: int, max_payload: int) -> int:
    """Return the bytes left for particles and relayed fixes beside `heard` names in `max_payload` bytes."""
    return max(0, max_payload - _HEADER.size - _CHECKSUM.size - heard * NAME_BYTES - (heard + 7) // 8)


def encode(frame: CooperativeFrame) -> bytes:
    """Encode a frame; particles beyond ±327 m are clipped."""
    covariance = frame.covariance_m2
    header = _HEADER.pack(
        VERSION,
        len(frame.heard),
        len(frame.relayed),
        frame.largest_degree,
        len(frame.cloud_m),
        _heading_code(frame.heading_rad),
        int(frame.name, 16),
        frame.fix_time_ns,
        *centimetres(frame.fix_m),
        *frame.estimate_m,
        covariance[0, 0],
        covariance[0, 1],
        covariance[1, 1],
        frame.epoch,
        *frame.running_sum,
    )
    names = bytes.fromhex("".join(frame.heard))
    flags = np.packbits(np.array(list(frame.heard.values()), dtype=bool)).tobytes()
    cloud = np.clip(frame.cloud_m, -COMMON_LIMIT_M, COMMON_LIMIT_M)
    body = (
        header
        + names
        + flags
        + frame.relayed.astype(RELAYED).tobytes()
        + np.round(cloud * 100).astype("<i2").tobytes()
    )
    return body + _CHECKSUM.pack(zlib.crc32(body))


@VehicleCache  # where many vehicles share a process, a frame is decoded once and not by each receiver
def decode(payload: bytes) -> CooperativeFrame:
    """Decode a frame.

    Raises FrameError: `length`, `version`, `checksum`, `not_finite`, `absurd` or `covariance`.
    """
    end = len(payload) - _CHECKSUM.size
    if end < _HEADER.size:
        raise FrameError("length")
    (version, heard_count, relays, degree, particles, *rest) = _HEADER.unpack_from(payload)
    if version != VERSION:
        raise FrameError("version")
    names_end = _HEADER.size + heard_count * NAME_BYTES
    flags_end = names_end + (heard_count + 7) // 8
    relays_end = flags_end + relays * RELAYED.itemsize
    if end != relays_end + PARTICLE_BYTES * particles:
        raise FrameError("length")
    if (zlib.crc32(payload[:end]),) != _CHECKSUM.unpack_from(payload, end):
        raise FrameError("checksum")
    heading, name, fix_time_ns, x_cm, y_cm, x, y, c_xx, c_xy, c_yy, epoch, *running_sum = rest
    _check_numbers(x, y, c_xx, c_xy, c_yy, running_sum)
    if max(abs(x_cm), abs(y_cm)) > 100 * POSITION_LIMIT_M:
        raise FrameError("absurd")
    names = payload[_HEADER.size : names_end].hex()
    flags = np.unpackbits(np.frombuffer(payload[names_end:flags_end], dtype=np.uint8), count=heard_count)
    steps = np.frombuffer(payload[relays_end:end], dtype="<i2")
    width = 2 * NAME_BYTES  # in hexadecimal
    each = (names[i : i + width] for i in range(0, len(names), width))
    heard = dict(zip(each, flags.astype(bool).tolist(), strict=True))
    return CooperativeFrame(
        fix_time_ns=fix_time_ns,
        fix_m=np.array([x_cm / 100, y_cm / 100]),
        heading_rad=heading_of_code(heading),
        estimate_m=np.array([x, y]),
        covariance_m2=np.array([[c_xx, c_xy], [c_xy, c_yy]]),
        epoch=epoch,
        running_sum=(running_sum[0], running_sum[1], running_sum[2]),
        heard=heard,
        cloud_m=steps.reshape(-1, 2) / 100,
        relayed=np.frombuffer(payload[flags_end:relays_end], dtype=RELAYED),
        largest_degree=degree,
        name=name_of_code(name),
    )


def centimetres(position_m: Array) -> tuple[int, int]:
    """Return a position (2,) in whole centimetres, as it is sent."""
    x, y = position_m.tolist()
    return round(x * 100), round(y * 100)


def _heading_code(heading_rad: float | None) -> int:
    if heading_rad is None:
        return NO_HEADING
    return int(heading_rad % (2 * math.pi) / (2 * math.pi) * _FULL_TURN)


def heading_of_code(code: int) -> float | None:
    """Return the heading in radians of a code; None for `NO_HEADING`."""
    return None if code == NO_HEADING else code / _FULL_TURN * 2 * math.pi


def _check_numbers(x: float, y: float, c_xx: float, c_xy: float, c_yy: float, running_sum: list[float]) -> None:
    if not all(map(math.isfinite, (x, y, c_xx, c_xy, c_yy, *running_sum))):
        raise FrameError("not_finite")
    s_x, s_y, w = running_sum
    if max(abs(x), abs(y)) > COMMON_LIMIT_M or max(c_xx, c_yy) > COMMON_LIMIT_M**2 or not 0 <= w < MAX_WEIGHT:
        raise FrameError("absurd")
    if max(abs(s_x), abs(s_y)) > COMMON_LIMIT_M * w:  # s / w is itself a mean of common errors
        raise FrameError("absurd")
    if not (c_xx > 0 and c_yy > 0 and c_xx * c_yy > c_xy * c_xy):
        raise FrameError("covariance")


class JudgedFrame(Protocol):
    """The part of a frame that is judged, whatever its layout."""

    @property
    def name(self) -> str:
        """The sender's short name."""
        ...

    @property
    def fix_time_ns(self) -> int:
        """Time of the sender's fix."""
        ...

    @property
    def epoch(self) -> int:
        """Epoch of the consensus."""
        ...

    @property
    def fingerprint(self) -> bytes:
        """Bytes that come from the noise of the sender's receiver."""
        ...


F = TypeVar("F", bound=JudgedFrame)


class Admission(Generic[F]):
    """The frames that the vehicle `name` admits.

    rejected: number of rejected frames by reason: those of `FrameError`, and replayed, stale, absurd,
        too_many_senders, duplicate.
    ids: node ids of the senders by short name.
    """

    def __init__(self, name: str, period_ns: int, decode: VehicleCache[[bytes], F], several: bool = False) -> None:
        """Frames are decoded by `decode`; with `several`, a sender may send several with the same fix."""
        add_vehicle(self)
        self._decode = decode
        self.rejected: Counter[str] = Counter()
        self.ids: dict[str, str] = {}
        self._name = name
        self._period_ns = period_ns
        self._several = several
        self._newest_ns: dict[str, int] = {}
        self._first_sender: dict[tuple[int, bytes], str] = {}
        self._early: dict[tuple[str, int], tuple[str, F]] = {}
        self._forgotten_ns = 0

    def admit(self, packets: Iterable[Packet], now_ns: int) -> list[tuple[str, F]]:
        """Return the frames to read, with their senders' short names, in the order of their arrival.

        In real time a vehicle that is late with its work finds frames of the next period: they wait for it.
        """
        if now_ns - self._forgotten_ns >= FORGET_PERIODS * self._period_ns:
            self._forget(now_ns)
        waiting, self._early = self._early, {}
        frames, decode = list(waiting.values()), self._decode.cached
        for packet in packets:
            try:
                frames.append((packet.sender, decode(packet.payload)))
            except FrameError as error:
                self.rejected[str(error)] += 1
        admitted = []
        newest_ns, first_sender = self._newest_ns, self._first_sender
        period_ns, late_ns = now_ns - now_ns % self._period_ns, STALE_PERIODS * self._period_ns
        largest_epoch = EPOCH_MARGIN + now_ns // self._period_ns
        for node, frame in frames:
            sender, time_ns = short_name(node), frame.fix_time_ns
            if frame.name != sender or sender == self._name:
                self.rejected["replayed"] += 1
            elif not -late_ns <= now_ns - time_ns <= late_ns:
                self.rejected["stale"] += 1
            elif frame.epoch > largest_epoch:
                self.rejected["absurd"] += 1
            elif sender not in newest_ns and len(newest_ns) + len(self._early) >= MAX_SENDERS:
                self.rejected["too_many_senders"] += 1
            elif not self._several and (
                newest_ns.get(sender, -1) >= time_ns or (self._early and (sender, time_ns) in self._early)
            ):
                self.rejected["duplicate"] += 1
            elif first_sender.setdefault((time_ns, frame.fingerprint), sender) != sender:
                self.rejected["replayed"] += 1
            elif time_ns > period_ns:
                self._early[sender, time_ns] = node, frame
            else:
                self.ids[sender] = node
                newest_ns[sender] = time_ns
                admitted.append((sender, frame))
        return admitted

    def claim(self, sender: str, time_ns: int, fingerprint: bytes) -> None:
        """Note that `sender` is the first with what comes from a fix: no two receivers' noise is the same."""
        self._first_sender.setdefault((time_ns, fingerprint), sender)

    def _forget(self, now_ns: int) -> None:
        """Forget senders and fixes that no frame can concern that is not stale."""
        self._forgotten_ns = now_ns
        oldest_ns = now_ns - (STALE_PERIODS + 1) * self._period_ns
        self._first_sender = {key: sender for key, sender in self._first_sender.items() if key[0] >= oldest_ns}
        self._newest_ns = {name: time_ns for name, time_ns in self._newest_ns.items() if time_ns >= oldest_ns}
        self.ids = {name: node for name, node in self.ids.items() if name in self._newest_ns}
