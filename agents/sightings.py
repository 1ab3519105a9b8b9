"""The newest fix of every other vehicle that word has come of: heard from itself, or passed on by others.

Kept as arrays, because fifty vehicles that each pass on fifty fixes are 25 000 fixes a period.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from agents.cooperative_frame import RELAYED, CooperativeFrame, heading_of_code, name_of_code
from vnet.cmm.rbpf import Observation
from vnet.roads.lanes import Array

NS_PER_S = 1_000_000_000
CAPACITY = 4096
"""More vehicles than this are not remembered: only a liar could name so many."""


class Sightings:
    """Fixes by name; a row a vehicle. `own_code` is the vehicle itself, of which no word is needed."""

    def __init__(self, own_code: int, period_ns: int) -> None:
        self._own_code = own_code
        self._period_ns = period_ns
        self._row: dict[int, int] = {}
        self._time_ns = np.empty(0, dtype=np.int64)
        self._fix = np.empty(0, dtype=RELAYED)

    def learn(self, sender_code: int, frame: CooperativeFrame) -> None:
        """Take the fixes of a frame, the sender's own and those that it passes on."""
        fixes = np.concatenate([frame.own_fix(sender_code), frame.relayed])
        time_ns = frame.fix_time_ns - fixes["age"].astype(np.int64) * self._period_ns
        rows = np.array([self._row_of(code) for code in fixes["name"].tolist()], dtype=np.intp)
        newer = (rows >= 0) & (time_ns > self._time_ns[rows])
        self._time_ns[rows[newer]] = time_ns[newer]
        self._fix[rows[newer]] = fixes[newer]

    def _row_of(self, code: int) -> int:
        row = self._row.get(code, -1)
        if row < 0 and code != self._own_code and len(self._row) < CAPACITY:
            row = self._row[code] = len(self._row)
            if row == len(self._time_ns):
                more = max(64, row)
                never = np.full(more, np.iinfo(np.int64).min)
                self._time_ns = np.concatenate([self._time_ns, never])
                self._fix = np.concatenate([self._fix, np.zeros(more, dtype=RELAYED)])
        return row

    def forget(self, before_ns: int) -> None:
        """Drop what is older than `before_ns`."""
        kept = [(code, row) for code, row in self._row.items() if self._time_ns[row] >= before_ns]
        if len(kept) < len(self._row):
            rows = [row for _, row in kept]
            self._time_ns, self._fix = self._time_ns[rows], self._fix[rows]
            self._row = {code: row for row, (code, _) in enumerate(kept)}

    def observations(self, now_ns: int, covariance_m2: Array) -> Iterator[tuple[str, Observation]]:
        """All fixes up to `now_ns`, with the receiver's own `covariance_m2` (2, 2) for all, by name."""
        position_m = self._position_m()
        for code, row in sorted(self._row.items()):
            age_s = (now_ns - int(self._time_ns[row])) / NS_PER_S
            if age_s >= 0:
                heading = heading_of_code(int(self._fix["heading"][row]))
                yield name_of_code(code), Observation(position_m[row], covariance_m2, heading, age_s)

    def _position_m(self) -> Array:
        return np.column_stack([self._fix["x_cm"], self._fix["y_cm"]]) / 100

    def freshest(self, now_ns: int, most: int) -> NDArray[np.void]:
        """At most `most` fixes to pass on in a frame with a fix of `now_ns`, the newest first."""
        count = len(self._row)
        age = np.round((now_ns - self._time_ns[:count]) / self._period_ns)
        order = np.argsort(age, kind="stable")
        order = order[(age[order] >= 0) & (age[order] <= 255)][:most]
        fixes = self._fix[order]
        fixes["age"] = age[order]
        return fixes
