"""The one frame that a cooperative vehicle broadcasts each period, as bytes and back (MODEL 3).

Fix, estimate, consensus state, whom it hears, a sample of its hypotheses of the common error in steps of 1 cm, and
fixes of others that it passes on. Vehicles are named by 4-byte hashes of their ids. A frame says whose it is, so
that nobody can send it again as his own, and ends with a CRC-32. Whatever does not decode, or decodes to absurd
values, is a `FrameError` with a one-word reason: the radio brings anything.
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

from vnet.types import Array

VERSION = 3
NAME_BYTES = 4
COMMON_LIMIT_M = 327.0
"""Larger common errors are absurd; int16 centimetres end here."""
POSITION_LIMIT_M = 1e7
"""Fixes further from the origin of a local frame are absurd; int32 centimetres end at twice that."""
NO_HEADING = 0xFFFF
_FULL_TURN = 0xFFFF  # headings in steps of 2π / 65535; the last code means none

# version, heard, relayed, largest degree, particles, heading, name, fix time, fix in cm, x_i, Cov(x_i), epoch, sums
_HEADER = struct.Struct("<BBBBHHIQii2f3fI3d")
_CHECKSUM = struct.Struct("<I")
RELAYED = np.dtype([("name", "<u4"), ("age", "u1"), ("heading", "<u2"), ("x_cm", "<i4"), ("y_cm", "<i4")])
"""A fix that is passed on: whose, how many periods older than the frame's own, heading code, position in cm."""
RELAY_LIMIT = 255


class FrameError(ValueError):
    """A payload that is no frame of this program; the message is the reason it is counted under."""


def _nothing_relayed() -> NDArray[np.void]:
    return np.empty(0, dtype=RELAYED)


@dataclass(frozen=True)
class CooperativeFrame:
    """The contents of a frame. Names are `short_name`s; `heard` says of each whether it is given a share.

    `cloud_m` (n, 2) and `relayed` (m,) of `RELAYED` may be empty. `largest_degree` is the most neighbours that any
    vehicle has, as far as word of it has come. `name` is the sender's.
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
        """Those of `heard` that are given a share."""
        return frozenset(name for name, takes in self.heard.items() if takes)

    @cached_property
    def names_heard(self) -> frozenset[str]:
        """The names in `heard`."""
        return frozenset(self.heard)

    def own_fix(self, code: int) -> NDArray[np.void]:
        """The sender's own fix, (1,) of `RELAYED`, under its code."""
        x_cm, y_cm = centimetres(self.fix_m)
        return np.array([(code, 0, _heading_code(self.heading_rad), x_cm, y_cm)], dtype=RELAYED)


@lru_cache(maxsize=1024)
def short_name(node: str) -> str:
    """The name of a node in frames: 4 bytes in hexadecimal."""
    return hashlib.blake2b(node.encode(), digest_size=NAME_BYTES).hexdigest()


def name_of_code(code: int) -> str:
    """The `short_name` that a code in `RELAYED` stands for; `int(name, 16)` is the way back."""
    return f"{code:0{2 * NAME_BYTES}x}"


def room(heard: int, max_payload: int) -> int:
    """How many bytes are left for hypotheses and relayed fixes beside `heard` names in `max_payload` bytes."""
    return max(0, max_payload - _HEADER.size - _CHECKSUM.size - heard * NAME_BYTES - (heard + 7) // 8)


def encode(frame: CooperativeFrame) -> bytes:
    """A frame as bytes; hypotheses beyond ±327 m are clipped."""
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
    takes = np.packbits(np.array(list(frame.heard.values()), dtype=bool)).tobytes()
    cloud = np.clip(frame.cloud_m, -COMMON_LIMIT_M, COMMON_LIMIT_M)
    body = (
        header
        + names
        + takes
        + frame.relayed.astype(RELAYED).tobytes()
        + np.round(cloud * 100).astype("<i2").tobytes()
    )
    return body + _CHECKSUM.pack(zlib.crc32(body))


@lru_cache(maxsize=256)  # where many vehicles share a process, a frame is decoded once and not by each who hears it
def decode(payload: bytes) -> CooperativeFrame:
    """Restore a frame.

    Raises FrameError: `length`, `version`, `checksum`, `not_finite`, `absurd` or `covariance`.
    """
    end = len(payload) - _CHECKSUM.size
    if end < _HEADER.size:
        raise FrameError("length")
    (version, heard_count, relays, degree, particles, *rest) = _HEADER.unpack_from(payload)
    if version != VERSION:
        raise FrameError("version")
    names_end = _HEADER.size + heard_count * NAME_BYTES
    takes_end = names_end + (heard_count + 7) // 8
    relays_end = takes_end + relays * RELAYED.itemsize
    if end != relays_end + 4 * particles:
        raise FrameError("length")
    if (zlib.crc32(payload[:end]),) != _CHECKSUM.unpack_from(payload, end):
        raise FrameError("checksum")
    heading, name, fix_time_ns, x_cm, y_cm, x, y, c_xx, c_xy, c_yy, epoch, *running_sum = rest
    _check_numbers(x, y, c_xx, c_xy, c_yy, running_sum)
    if max(abs(x_cm), abs(y_cm)) > 100 * POSITION_LIMIT_M:
        raise FrameError("absurd")
    names = payload[_HEADER.size : names_end].hex()
    takes = np.unpackbits(np.frombuffer(payload[names_end:takes_end], dtype=np.uint8), count=heard_count)
    steps = np.frombuffer(payload[relays_end:end], dtype="<i2")
    starts = range(0, len(names), 2 * NAME_BYTES)
    heard = {
        names[i : i + 2 * NAME_BYTES]: take for i, take in zip(starts, takes.astype(bool).tolist(), strict=True)
    }
    return CooperativeFrame(
        fix_time_ns,
        np.array([x_cm / 100, y_cm / 100]),
        heading_of_code(heading),
        np.array([x, y]),
        np.array([[c_xx, c_xy], [c_xy, c_yy]]),
        epoch,
        (running_sum[0], running_sum[1], running_sum[2]),
        heard,
        steps.reshape(-1, 2) / 100,
        np.frombuffer(payload[takes_end:relays_end], dtype=RELAYED),
        degree,
        name_of_code(name),
    )


def centimetres(position_m: Array) -> tuple[int, int]:
    """A position (2,) as it is said."""
    x, y = position_m.tolist()
    return round(x * 100), round(y * 100)


def _heading_code(heading_rad: float | None) -> int:
    if heading_rad is None:
        return NO_HEADING
    return int(heading_rad % (2 * math.pi) / (2 * math.pi) * _FULL_TURN)


def heading_of_code(code: int) -> float | None:
    """The heading in radians that a code stands for; None if it stands for none."""
    return None if code == NO_HEADING else code / _FULL_TURN * 2 * math.pi


def _check_numbers(x: float, y: float, c_xx: float, c_xy: float, c_yy: float, running_sum: list[float]) -> None:
    if not all(map(math.isfinite, (x, y, c_xx, c_xy, c_yy, *running_sum))):
        raise FrameError("not_finite")
    s_x, s_y, w = running_sum
    if max(abs(x), abs(y)) > COMMON_LIMIT_M or max(c_xx, c_yy) > COMMON_LIMIT_M**2 or not 0 <= w < 1e12:
        raise FrameError("absurd")
    if max(abs(s_x), abs(s_y)) > COMMON_LIMIT_M * w:  # s / w is itself a mean of common errors
        raise FrameError("absurd")
    if not (c_xx > 0 and c_yy > 0 and c_xx * c_yy > c_xy * c_xy):
        raise FrameError("covariance")
