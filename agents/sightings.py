"""The newest fix of every other vehicle that word has come of: heard from itself, or passed on by others.

Kept as arrays, because fifty vehicles that each pass on fifty fixes are 25 000 fixes a period.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from agents.cooperative_frame import RELAYED, CooperativeFrame, heading_of_code, name_of_code
from vnet.cmm.rbpf import Observation
from vnet.roads.lanes import Array

NS_PER_S = 1_000_000_000
NEWEST_NS = np.iinfo(np.int64).max
CAPACITY = 4096
"""More vehicles than this are not remembered: only a liar could name so many."""


class Sightings:
    """Fixes by name. `own_code` is the vehicle itself, of which no word is needed."""

    def __init__(self, own_code: int, period_ns: int) -> None:
        self._period_ns = period_ns
        # In ascending order of the codes. The vehicle itself is among them, with word that nobody can outdo.
        self._code = np.array([own_code], dtype=np.int64)
        self._time_ns = np.array([NEWEST_NS], dtype=np.int64)
        self._fix = np.zeros(1, dtype=RELAYED)
        self._names = [name_of_code(own_code)]

    def learn(self, frames: Sequence[tuple[int, CooperativeFrame]]) -> None:
        """Take the fixes of frames (with their senders' codes), the senders' own and those that they pass on."""
        if not frames:
            return
        # Joined as bytes, because numpy is slow to concatenate records.
        parts = [part.tobytes() for code, frame in frames for part in (frame.own_fix(code), frame.relayed)]
        fixes = np.frombuffer(b"".join(parts), dtype=RELAYED)
        sizes = [1 + len(frame.relayed) for _, frame in frames]
        said_ns = np.repeat([frame.fix_time_ns for _, frame in frames], sizes)
        time_ns = said_ns - fixes["age"].astype(np.int64) * self._period_ns
        order = np.argsort(time_ns, kind="stable")  # of several assignments to a row the last holds
        fixes, time_ns = fixes[order], time_ns[order]
        code = fixes["name"].astype(np.int64)
        row = self._rows(code)
        if not np.array_equal(self._code[row], code):
            self._admit(code)
            row = self._rows(code)
        newer = (self._code[row] == code) & (time_ns > self._time_ns[row])
        row = row[newer]
        self._time_ns[row] = time_ns[newer]
        self._fix[row] = fixes[newer]

    def _rows(self, code: NDArray[np.int64]) -> NDArray[np.intp]:
        """Where each code stands, or would stand; its row may be another's."""
        return np.minimum(np.searchsorted(self._code, code), len(self._code) - 1)

    def _admit(self, code: NDArray[np.int64]) -> None:
        """Make room for codes that are not known yet."""
        new = np.setdiff1d(code, self._code)[: CAPACITY + 1 - len(self._code)]
        everybody = np.concatenate([self._code, new])
        order = np.argsort(everybody)
        self._code = everybody[order]
        self._time_ns = np.concatenate([self._time_ns, np.full(len(new), np.iinfo(np.int64).min)])[order]
        self._fix = np.concatenate([self._fix, np.zeros(len(new), dtype=RELAYED)])[order]
        self._names = [name_of_code(c) for c in self._code.tolist()]

    def forget(self, before_ns: int) -> None:
        """Drop what is older than `before_ns`."""
        kept = self._time_ns >= before_ns
        if not kept.all():
            self._code, self._time_ns, self._fix = self._code[kept], self._time_ns[kept], self._fix[kept]
            self._names = [name_of_code(c) for c in self._code.tolist()]

    def observations(self, now_ns: int, covariance_m2: Array) -> Iterator[tuple[str, Observation]]:
        """All fixes up to `now_ns`, with the receiver's own `covariance_m2` (2, 2) for all, by name."""
        position_m = np.column_stack([self._fix["x_cm"], self._fix["y_cm"]]) / 100
        age_s = ((now_ns - self._time_ns) / NS_PER_S).tolist()
        codes = self._fix["heading"].tolist()
        for name, position, code, age in zip(self._names, position_m, codes, age_s, strict=True):
            if age >= 0:
                yield name, Observation(position, covariance_m2, heading_of_code(code), age)

    def freshest(self, now_ns: int, most: int) -> NDArray[np.void]:
        """At most `most` fixes to pass on in a frame with a fix of `now_ns`, the newest first."""
        age = np.round((now_ns - self._time_ns) / self._period_ns)
        order = np.argsort(age, kind="stable")
        order = order[(age[order] >= 0) & (age[order] <= 255)][:most]
        fixes = self._fix[order]
        fixes["age"] = age[order]
        return fixes
