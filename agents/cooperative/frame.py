"""The frame that a cooperative vehicle broadcasts each period, as bytes and back (MODEL 3).

It holds the fix, the estimate, the state of the consensus, the names of the vehicles heard, a sample of the
particles of the common error in steps of 1 cm, and relayed fixes. Vehicles are named by 4-byte hashes of their
ids. A frame names its sender, so that no other can send it again as its own, and ends with a CRC-32. Bytes that do
not decode, or decode to absurd values, raise a `FrameError` with a reason of one word: the radio delivers
anything.
"""

from __future__ import annotations

import hashlib
import math
import struct
import zlib
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from agents.cooperative.vehicle_cache import VehicleCache
from vnet.types import Array

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


class FrameError(ValueError):
    """A payload that is no frame of this program; the message is the reason by which it is counted."""


def _nothing_relayed() -> NDArray[np.void]:
    return np.empty(0, dtype=RELAYED)


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
    relayed: NDArray[np.void] = field(default_factory=_nothing_relayed)
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
