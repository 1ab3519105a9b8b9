"""Fix table: the newest fix of every other vehicle, received from itself or relayed by others.

Kept as arrays, because fifty vehicles that each pass on fifty fixes are 25 000 fixes a period.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from agents.cooperative.admission import MAX_SENDERS
from agents.cooperative.cmm.rbpf import Observation
from agents.cooperative.frame import RELAYED, CooperativeFrame, heading_of_code, name_of_code
from vnet.types import Array
from vnet.units import NS_PER_S

NO_FIX_NS = -(2**61)
"""Time of a vehicle without a fix yet: older than any."""
OWN_FIX_NS = 2**61
"""Time of the vehicle itself: newer than any, so that no fix of it is taken from others."""
CAPACITY = 1024
"""Number of vehicles whose relayed fixes are kept: only an attacker could name more."""
REMEMBERED_PERIODS = 4
"""Periods for which first-hand fixes are kept, to compare relayed ones with them: a relay is no older."""
PERIOD_BITS = 31
"""Bits of a key for the number of the period; 2³¹ periods of 0.1 s are seven years."""
PERIOD_MASK = 2**PERIOD_BITS - 1


class FixTable:
    """The newest fixes by vehicle. `own_code` is the vehicle itself, which needs no fix from others."""

    def __init__(self, own_code: int, period_ns: int) -> None:
        self._period_ns = period_ns
        # In ascending order of the codes. The vehicle itself is among them, with a time that nothing exceeds.
        self._code = np.array([own_code], dtype=np.int64)
        self._time_ns = np.array([OWN_FIX_NS], dtype=np.int64)
        self._fix = np.zeros(1, dtype=RELAYED)
        self._names = [name_of_code(own_code)]
        # First-hand fixes of the last periods: keys (vehicle and period) in ascending order, and fingerprints.
        self._first_hand_key = np.array([np.iinfo(np.int64).max])
        self._first_hand = np.zeros(1, dtype=np.int64)

    def learn(self, frames: Sequence[tuple[int, CooperativeFrame]]) -> list[int]:
        """Take the fixes of frames (with their senders' codes), the senders' own and those that they relay.

        Returns the senders of forged frames, which are not used: of the fixes that they relay and that this vehicle
        has received first-hand as well, most differ.
        """
        if not frames:
            return []
        # Joined as bytes, because numpy is slow to concatenate records. Own fixes first, then relayed ones.
        count = len(frames)
        parts = [frame.own_fix(code).tobytes() for code, frame in frames]
        parts += [frame.relayed.tobytes() for _, frame in frames]
        fixes = np.frombuffer(b"".join(parts), dtype=RELAYED)
        relays = [len(frame.relayed) for _, frame in frames]
        sender = np.concatenate([np.arange(count), np.repeat(np.arange(count), relays)])
        sent_ns = np.array([frame.fix_time_ns for _, frame in frames])
        time_ns = sent_ns[sender] - fixes["age"].astype(np.int64) * self._period_ns
        code = fixes["name"].astype(np.int64)
        forged = self._forged(code, time_ns, _fingerprint(fixes), sender, count)
        kept = np.ones(len(sender), dtype=np.bool_) if not len(forged) else ~np.isin(sender, forged)
        self._take(code[kept], time_ns[kept], fixes[kept], int(kept[:count].sum()))
        return [frames[index][0] for index in forged.tolist()]

    def _forged(
        self,
        code: NDArray[np.int64],
        time_ns: NDArray[np.int64],
        fingerprint: NDArray[np.int64],
        sender: NDArray[np.intp],
        count: int,
    ) -> NDArray[np.intp]:
        """Find those of `count` senders that relay false fixes: indices. The first `count` fixes are their own."""
        key = (code << PERIOD_BITS) + time_ns // self._period_ns
        self._remember(key[:count], fingerprint[:count])
        key, fingerprint, sender = key[count:], fingerprint[count:], sender[count:]
        index = np.searchsorted(self._first_hand_key, key)
        known = self._first_hand_key[index] == key
        differs = known & (self._first_hand[index] != fingerprint)
        if not differs.any():
            return np.empty(0, dtype=np.intp)
        false = np.bincount(sender[differs], minlength=count)
        return np.flatnonzero(2 * false > np.bincount(sender[known], minlength=count))

    def _remember(self, key: NDArray[np.int64], fingerprint: NDArray[np.int64]) -> None:
        """Keep first-hand fixes for `REMEMBERED_PERIODS`."""
        now = (key & PERIOD_MASK).max()
        kept = (self._first_hand_key & PERIOD_MASK) > now - REMEMBERED_PERIODS  # and the last key
        key = np.concatenate([key, self._first_hand_key[kept]])
        order = np.argsort(key)
        self._first_hand_key = key[order]
        self._first_hand = np.concatenate([fingerprint, self._first_hand[kept]])[order]

    def _take(
        self, code: NDArray[np.int64], time_ns: NDArray[np.int64], fixes: NDArray[np.void], count: int
    ) -> None:
        """Keep the newest fix of each vehicle; of the same time the first-hand one, as the first `count` are."""
        rank = 2 * time_ns
        rank[:count] += 1
        order = np.argsort(rank, kind="stable")  # of several assignments to a row the last holds
        fixes, time_ns, rank, sorted_code = fixes[order], time_ns[order], rank[order], code[order]
        row = self._rows(sorted_code)
        if not np.array_equal(self._code[row], sorted_code):
            self._admit(code[:count], MAX_SENDERS)
            self._admit(code[count:], 0)
            row = self._rows(sorted_code)
        newer = (self._code[row] == sorted_code) & (rank > 2 * self._time_ns[row])
        row = row[newer]
        self._time_ns[row] = time_ns[newer]
        self._fix[row] = fixes[newer]

    def _rows(self, code: NDArray[np.int64]) -> NDArray[np.intp]:
        """Return the row of each code, or the row before which it would be inserted: its row may be another's."""
        return np.minimum(np.searchsorted(self._code, code), len(self._code) - 1)

    def _admit(self, code: NDArray[np.int64], reserve: int) -> None:
        """Make room for codes that are not known yet, up to the capacity and `reserve`."""
        new = np.setdiff1d(code, self._code)[: max(0, CAPACITY + reserve + 1 - len(self._code))]
        everybody = np.concatenate([self._code, new])
        order = np.argsort(everybody)
        self._code = everybody[order]
        self._time_ns = np.concatenate([self._time_ns, np.full(len(new), NO_FIX_NS)])[order]
        self._fix = np.concatenate([self._fix, np.zeros(len(new), dtype=RELAYED)])[order]
        self._names = [name_of_code(c) for c in self._code.tolist()]

    def forget(self, before_ns: int) -> None:
        """Drop what is older than `before_ns`."""
        kept = self._time_ns >= before_ns
        if not kept.all():
            self._code, self._time_ns, self._fix = self._code[kept], self._time_ns[kept], self._fix[kept]
            self._names = [name_of_code(c) for c in self._code.tolist()]

    def observations(self, now_ns: int, covariance_m2: Array) -> Iterator[tuple[str, Observation]]:
        """Yield all fixes up to `now_ns` by name, with the receiver's own `covariance_m2` (2, 2) for all."""
        position_m = np.column_stack([self._fix["x_cm"], self._fix["y_cm"]]) / 100
        age_s = ((now_ns - self._time_ns) / NS_PER_S).tolist()
        codes = self._fix["heading"].tolist()
        for name, position, code, age in zip(self._names, position_m, codes, age_s, strict=True):
            if age >= 0:
                yield name, Observation(position, covariance_m2, heading_of_code(code), age)

    def freshest(self, now_ns: int, count: int) -> NDArray[np.void]:
        """Return at most `count` fixes to relay in a frame with a fix of `now_ns`, the newest first."""
        age = np.round((now_ns - self._time_ns) / self._period_ns)
        order = np.argsort(age, kind="stable")
        order = order[(age[order] >= 0) & (age[order] <= 255)][:count]
        fixes = self._fix[order]
        fixes["age"] = age[order]
        return fixes


def _fingerprint(fixes: NDArray[np.void]) -> NDArray[np.int64]:
    """Return a number for each fix that differs where heading or position do: multiplicative hashing, may wrap."""
    x, y = fixes["x_cm"].astype(np.int64), fixes["y_cm"].astype(np.int64)
    return np.asarray((x * 0x9E3779B97F4A7C1 + y) * 0x2545F4914F6CDD1 + fixes["heading"])
