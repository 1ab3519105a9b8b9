"""The frame of a vehicle that exchanges information about the common error, as bytes and back (MODEL 10).

It holds what the sender knew of the common error before its fix (the prior), what the fix says about it (the
increment), the state of the consensus, the names of the vehicles heard, and, if increments are passed on, those
that the sender used in the period before. It ends with a CRC-32, and names its sender. Bytes that do not decode, or
decode to absurd values, raise a `FrameError` with a reason of one word.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.cooperative.cmm.consensus import Share
from agents.cooperative.cmm.information import Five, inverted, plain_moments
from agents.cooperative.cmm.lane_memory import ALL_KINDS, MAX_AGE, information_of
from agents.cooperative.frame import COMMON_LIMIT_M, MAX_WEIGHT, NAME_BYTES, FrameError, VehicleCache, name_of_code
from vnet.types import Array

VERSION = 5
"""Version of the layout and of what its numbers mean, such as kinds of gains; `frame` has 3."""
INFORMATION_LIMIT = 1e6
"""Largest entry of a matrix (1/m²): a deviation of a millimetre."""
INCREMENT_LIMIT = 6e4
"""Largest number of an increment: those who pass it on have half precision, which ends at 65 504."""
PASSED_LIMIT = 255
"""Number of increments in a frame: it is one byte."""

# version, heard, passed on, largest degree, name, fix time, prior (Λ, η), increment (δΛ, δη), epoch, running sums
_HEADER = struct.Struct("<BBBBIq5f5fI3d")
_CHECKSUM = struct.Struct("<I")
_FINGERPRINT = struct.Struct("<5f")
PASSED = np.dtype([("name", "<u4"), ("information", "<f2", (5,))])
"""An increment that is passed on: its origin, and its five numbers with half precision."""
_RECORD = struct.Struct("<I5e")
_AS_BYTES = struct.Struct(f"{_RECORD.size}s")


@dataclass(frozen=True)
class InformationFrame:
    """The contents of a frame; names are `short_name`s.

    prior, increment: (5,), the matrix (xx, xy, yy) in 1/m² and the vector (x, y) in 1/m; the increment of a vehicle
    on a lane as in `lane_memory`.
    heard: the names of the vehicles received lately; true for out-neighbours, which are given a share.
    passed: (n,) records of `PASSED`, increments of the period before the frame's.
    largest_degree: the largest number of neighbours of any vehicle, as far as this one knows.
    """

    name: str
    fix_time_ns: int
    prior: Five
    increment: Five
    epoch: int
    running_sum: tuple[float, float, float]
    heard: Mapping[str, bool]
    passed: NDArray[np.void] = field(default_factory=lambda: np.empty(0, dtype=PASSED))
    largest_degree: int = 0

    # In a process of many vehicles a frame is decoded once and read by each receiver, so these are computed once.

    @cached_property
    def out_neighbours(self) -> frozenset[str]:
        """The out-neighbours: those of `heard` that are given a share."""
        return frozenset(name for name, is_given in self.heard.items() if is_given)

    @cached_property
    def names_heard(self) -> frozenset[str]:
        """The names in `heard`."""
        return frozenset(self.heard)

    @cached_property
    def row(self) -> Row:
        """Its row of `HeardFrames`."""
        share = Share(self.epoch, self.running_sum, self.out_neighbours, self.names_heard)
        return _row(self, int(self.name, 16), share, _records(self.passed.tobytes()))

    @property
    def passed_numbers(self) -> Array:
        """The increments (n, 5) that are passed on, as numbers."""
        return self.passed["information"].astype(np.float64)

    @cached_property
    def fingerprint(self) -> bytes:
        """Bytes that no two senders share at one time: they come from the noise of a receiver."""
        return _fingerprint(self.name, self.increment)


Row = tuple[int, Five, Five, tuple[float, float], Five, float, bytes, Share, tuple[bytes, ...], int, int]
"""The fields of `HeardFrames` of one frame."""


class HeardFrames(NamedTuple):
    """The frames of a period as columns (n,), in the order of their senders: one operation for each, and not n.

    codes: the senders' codes; `name_of_code` is the inverse.
    means_m: the priors' means; moments: these (x, y), and the covariances (xx, xy, yy) in m²; variances_m2: their
    traces.
    records: the increments as records of `PASSED`; passed: the records that each passes on, each once.
    degrees: the numbers of vehicles that each has heard.
    """

    codes: Sequence[int] = ()
    priors: Sequence[Five] = ()
    increments: Sequence[Five] = ()
    means_m: Sequence[tuple[float, float]] = ()
    moments: Sequence[Five] = ()
    variances_m2: Sequence[float] = ()
    records: Sequence[bytes] = ()
    shares: Sequence[Share] = ()
    passed: Sequence[tuple[bytes, ...]] = ()
    degrees: Sequence[int] = ()
    largest_degrees: Sequence[int] = ()

    @classmethod
    def of(cls, frames: Iterable[InformationFrame]) -> HeardFrames:
        """Return the columns of frames."""
        return cls(*zip(*[frame.row for frame in frames], strict=True))

    def and_earlier(self, frames: Sequence[InformationFrame], keep: float, variance_m2: float) -> HeardFrames:
        """Return these and earlier `frames`, whose priors are moved on: c keeps a share, and gains in variance."""
        if not frames:
            return self
        rows: list[tuple[Any, ...]] = [*zip(*self, strict=True)]
        for frame in frames:
            code, _, increment, _, (x, y, xx, xy, yy), _, *others = frame.row
            x, y, xx, xy, yy = (
                keep * x,
                keep * y,
                keep**2 * xx + variance_m2,
                keep**2 * xy,
                keep**2 * yy + variance_m2,
            )
            a, b, d = inverted(xx, xy, yy)
            prior = a, b, d, a * x + b * y, b * x + d * y
            rows.append((code, prior, increment, (x, y), (x, y, xx, xy, yy), xx + yy, *others))
        return HeardFrames(*zip(*rows, strict=True))


def _row(frame: InformationFrame, code: int, share: Share, passed: tuple[bytes, ...]) -> Row:
    moments = x, y, xx, _, yy = plain_moments(*frame.prior)
    record = passed_record(code, frame.increment)
    degrees = len(frame.heard), frame.largest_degree
    return code, frame.prior, frame.increment, (x, y), moments, xx + yy, record, share, passed, *degrees


def _records(passed: bytes) -> tuple[bytes, ...]:
    """Return the records among the bytes of a frame, each once."""
    return tuple(dict.fromkeys(chain.from_iterable(_AS_BYTES.iter_unpack(passed))))


def _fingerprint(name: str, increment: Five) -> bytes:
    """Return the fingerprint of a frame.

    An increment of 0, of an outlier, has no noise; to send it again under another name does no harm.
    """
    return _FINGERPRINT.pack(*increment) if any(information_of(increment)) else name.encode()


def passed_record(code: int, increment: Five) -> bytes:
    """Return the record of `PASSED` of an increment; its numbers are at most `INCREMENT_LIMIT`."""
    return _RECORD.pack(code, *increment)


def encode(frame: InformationFrame) -> bytes:
    """Encode a frame."""
    header = _HEADER.pack(
        VERSION,
        len(frame.heard),
        len(frame.passed),
        frame.largest_degree,
        int(frame.name, 16),
        frame.fix_time_ns,
        *frame.prior,
        *frame.increment,
        frame.epoch,
        *frame.running_sum,
    )
    body = header + _packed_names(tuple(frame.heard), tuple(frame.heard.values())) + frame.passed.tobytes()
    return body + _CHECKSUM.pack(zlib.crc32(body))


@VehicleCache  # a vehicle hears the same others for many periods
def _packed_names(names: tuple[str, ...], flags: tuple[bool, ...]) -> bytes:
    """Return names, and flags as bits, the first the highest of the first byte."""
    size = (len(flags) + 7) // 8
    bits = int("0" + "".join("1" if flag else "0" for flag in flags), 2)
    return bytes.fromhex("".join(names)) + (bits << (8 * size - len(flags))).to_bytes(size, "big")


def _unpack_flags(packed: bytes, count: int) -> list[bool]:
    """Return the first `count` flags of `_packed_names`."""
    bits = f"{int.from_bytes(packed, 'big'):0{8 * len(packed)}b}" if count else ""
    return [bit == "1" for bit in bits[:count]]


def room(heard: int, max_payload: int) -> int:
    """Return the number of increments that fit beside `heard` names in `max_payload` bytes."""
    left = max_payload - _HEADER.size - _CHECKSUM.size - heard * NAME_BYTES - (heard + 7) // 8
    return min(PASSED_LIMIT, max(0, left // PASSED.itemsize))


@VehicleCache  # a vehicle hears the same others for many periods
def _heard(names_and_flags: bytes, count: int) -> tuple[Mapping[str, bool], frozenset[str], frozenset[str]]:
    """Return whether each name heard is an out-neighbour, the out-neighbours, and the names."""
    names, width = names_and_flags[: count * NAME_BYTES].hex(), 2 * NAME_BYTES
    each = [names[i : i + width] for i in range(0, len(names), width)]
    flags = _unpack_flags(names_and_flags[count * NAME_BYTES :], count)
    heard = dict(zip(each, flags, strict=True))
    return MappingProxyType(heard), frozenset(name for name in heard if heard[name]), frozenset(heard)


@VehicleCache  # where many vehicles share a process, a frame is decoded once and not by each receiver
def decode(payload: bytes) -> InformationFrame:
    """Decode a frame.

    Raises FrameError: `length`, `version`, `checksum`, `not_finite`, `absurd` or `covariance`.
    """
    end = len(payload) - _CHECKSUM.size
    if end < _HEADER.size:
        raise FrameError("length")
    version, heard_count, passed_count, degree, name, fix_time_ns, *numbers = _HEADER.unpack_from(payload)
    if version != VERSION:
        raise FrameError("version")
    names_end = _HEADER.size + heard_count * NAME_BYTES
    flags_end = names_end + (heard_count + 7) // 8
    if end != flags_end + PASSED.itemsize * passed_count:
        raise FrameError("length")
    if (zlib.crc32(payload[:end]),) != _CHECKSUM.unpack_from(payload, end):
        raise FrameError("checksum")
    a, b, d, x, y, *increment, epoch, s_x, s_y, weight = numbers
    prior, running_sum = (a, b, d, x, y), (s_x, s_y, weight)
    _check(prior, increment, running_sum)
    heard, out_neighbours, names_heard = _heard(payload[_HEADER.size : flags_end], heard_count)
    records = _records(payload[flags_end:end])
    for record in records:
        passed_increment.cached(record)
    frame = InformationFrame(
        name=name_of_code(name),
        fix_time_ns=fix_time_ns,
        prior=prior,
        increment=_semidefinite(*increment),
        epoch=epoch,
        running_sum=running_sum,
        heard=heard,
        passed=np.frombuffer(payload, dtype=PASSED, count=passed_count, offset=flags_end),
        largest_degree=degree,
    )
    share = Share(epoch, running_sum, out_neighbours, names_heard)
    frame.__dict__.update(  # each receiver reads these, and a property takes longer when it is first read
        out_neighbours=out_neighbours,
        names_heard=names_heard,
        row=_row(frame, name, share, records),
        fingerprint=_fingerprint(frame.name, frame.increment),
    )
    return frame


def _check(prior: Five, increment: list[float], running_sum: tuple[float, float, float]) -> None:
    s_x, s_y, weight = running_sum
    if not math.isfinite(sum(prior) + sum(increment) + s_x + s_y + weight):
        raise FrameError("not_finite")
    if not 0 <= weight < MAX_WEIGHT or max(abs(s_x), abs(s_y)) > COMMON_LIMIT_M * weight:
        raise FrameError("absurd")
    a, b, d, x, y = prior
    determinant = a * d - b * b
    if not (a > 0 and d > 0 and determinant > 1e-6 * a * d):
        raise FrameError("covariance")
    _check_increment(increment)
    if max(map(abs, increment)) > INCREMENT_LIMIT:
        raise FrameError("absurd")
    mean_m = abs(d * x - b * y) / determinant, abs(a * y - b * x) / determinant
    if max(mean_m) > COMMON_LIMIT_M or max(a, d) > INFORMATION_LIMIT:
        raise FrameError("absurd")


@VehicleCache  # most that hear a vehicle pass its increment on
def passed_increment(record: bytes) -> tuple[int, Five]:
    """Return the origin's code and the increment of a record of `PASSED`.

    Raises FrameError if it cannot be one: `not_finite` or `covariance`.
    """
    code, a, b, d, x, y = _RECORD.unpack(record)
    if not math.isfinite(a + b + d + x + y):
        raise FrameError("not_finite")
    _check_increment((a, b, d, x, y))
    return code, _semidefinite(a, b, d, x, y)


def _check_increment(increment: Sequence[float]) -> None:
    """Raise FrameError for an increment that cannot be: about c `covariance`, of a lane `absurd`."""
    a, b, d, _, age = increment
    if d >= 0:
        if not _is_semidefinite(a, b, d):
            raise FrameError("covariance")
    elif not (d == round(d) >= -ALL_KINDS and -1 <= age <= MAX_AGE and a * a + b * b <= INCREMENT_LIMIT):
        raise FrameError("absurd")


def _is_semidefinite(a: float, b: float, d: float) -> bool:
    """Tell whether a matrix (xx, xy, yy) is positive semidefinite, but for rounding."""
    slack = 1e-2 * max(abs(a), abs(d)) + 1e-6
    return a >= 0 and d >= 0 and (a + slack) * (d + slack) >= b * b


def _semidefinite(a: float, b: float, d: float, x: float, y: float) -> Five:
    """Return an increment without what rounding leaves: with a negative eigenvalue it would pass all gates."""
    if d < 0 or b * b <= a * d:
        return a, b, d, x, y
    return a, math.copysign(math.sqrt(a * d), b), d, x, y
