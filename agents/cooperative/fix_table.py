"""The newest fix of every other vehicle that word has come of: heard from itself, or passed on by others.

Kept as arrays, because fifty vehicles that each pass on fifty fixes are 25 000 fixes a period.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from agents.cooperative.admission import MOST_SENDERS
from agents.cooperative.frame import RELAYED, CooperativeFrame, heading_of_code, name_of_code
from vnet.cmm.rbpf import Observation
from vnet.types import Array
from vnet.units import NS_PER_S

NEVER_NS, NEWEST_NS = -(2**61), 2**61
CAPACITY = 1024
"""More vehicles than this are not remembered: only a liar could name so many."""
REMEMBERED_PERIODS = 4
"""How long the words of those who are heard are kept, to hold against them what others pass on."""
PERIOD_BITS = 31
PERIOD_MASK = 2**PERIOD_BITS - 1


class Sightings:
    """Fixes by name. `own_code` is the vehicle itself, of which no word is needed."""

    def __init__(self, own_code: int, period_ns: int) -> None:
        self._period_ns = period_ns
        # In ascending order of the codes. The vehicle itself is among them, with word that nobody can outdo.
        self._code = np.array([own_code], dtype=np.int64)
        self._time_ns = np.array([NEWEST_NS], dtype=np.int64)
        self._fix = np.zeros(1, dtype=RELAYED)
        self._names = [name_of_code(own_code)]
        # What vehicles that are heard have said themselves lately: whose and when, in ascending order, and what.
        self._own_key = np.array([np.iinfo(np.int64).max])
        self._own_word = np.zeros(1, dtype=np.int64)

    def learn(self, frames: Sequence[tuple[int, CooperativeFrame]]) -> list[int]:
        """Take the fixes of frames (with their senders' codes), the senders' own and those that they pass on.

        Returns the senders whose frames are not believed, because most of what they pass on of vehicles that are
        heard here as well is not what these have said.
        """
        if not frames:
            return []
        # Joined as bytes, because numpy is slow to concatenate records. Own words first, then what is passed on.
        count = len(frames)
        parts = [frame.own_fix(code).tobytes() for code, frame in frames]
        parts += [frame.relayed.tobytes() for _, frame in frames]
        fixes = np.frombuffer(b"".join(parts), dtype=RELAYED)
        who = np.concatenate([np.arange(count), np.repeat(np.arange(count), [len(f.relayed) for _, f in frames])])
        said_ns = np.array([frame.fix_time_ns for _, frame in frames])
        time_ns = said_ns[who] - fixes["age"].astype(np.int64) * self._period_ns
        code = fixes["name"].astype(np.int64)
        forged = self._forged(code, time_ns, _word(fixes), who, count)
        kept = np.ones(len(who), dtype=np.bool_) if not len(forged) else ~np.isin(who, forged)
        self._take(code[kept], time_ns[kept], fixes[kept], int(kept[:count].sum()))
        return [frames[sender][0] for sender in forged.tolist()]

    def _forged(
        self,
        code: NDArray[np.int64],
        time_ns: NDArray[np.int64],
        word: NDArray[np.int64],
        who: NDArray[np.intp],
        count: int,
    ) -> NDArray[np.intp]:
        """Which of `count` senders pass on what others have not said. The first `count` words are their own."""
        key = (code << PERIOD_BITS) + time_ns // self._period_ns
        self._remember(key[:count], word[:count])
        code, key, word, who = code[count:], key[count:], word[count:], who[count:]
        place = np.searchsorted(self._own_key, key)
        known = self._own_key[place] == key
        differs = known & (self._own_word[place] != word)
        if not differs.any():
            return np.empty(0, dtype=np.intp)
        false = np.bincount(who[differs], minlength=count)
        return np.flatnonzero(2 * false > np.bincount(who[known], minlength=count))

    def _remember(self, key: NDArray[np.int64], word: NDArray[np.int64]) -> None:
        """Keep what vehicles say themselves, for `REMEMBERED_PERIODS`."""
        now = (key & PERIOD_MASK).max()
        kept = (self._own_key & PERIOD_MASK) > now - REMEMBERED_PERIODS  # and the last, which ends all searches
        key = np.concatenate([key, self._own_key[kept]])
        order = np.argsort(key)
        self._own_key = key[order]
        self._own_word = np.concatenate([word, self._own_word[kept]])[order]

    def _take(
        self, code: NDArray[np.int64], time_ns: NDArray[np.int64], fixes: NDArray[np.void], count: int
    ) -> None:
        """Keep the newest fix of each vehicle; of the same time its own word, which the first `count` are."""
        rank = 2 * time_ns
        rank[:count] += 1
        order = np.argsort(rank, kind="stable")  # of several assignments to a row the last holds
        fixes, time_ns, rank, sorted_code = fixes[order], time_ns[order], rank[order], code[order]
        row = self._rows(sorted_code)
        if not np.array_equal(self._code[row], sorted_code):
            self._admit(code[:count], MOST_SENDERS)
            self._admit(code[count:], 0)
            row = self._rows(sorted_code)
        newer = (self._code[row] == sorted_code) & (rank > 2 * self._time_ns[row])
        row = row[newer]
        self._time_ns[row] = time_ns[newer]
        self._fix[row] = fixes[newer]

    def _rows(self, code: NDArray[np.int64]) -> NDArray[np.intp]:
        """Where each code stands, or would stand; its row may be another's."""
        return np.minimum(np.searchsorted(self._code, code), len(self._code) - 1)

    def _admit(self, code: NDArray[np.int64], reserve: int) -> None:
        """Make room for codes that are not known yet, up to the capacity and `reserve`."""
        new = np.setdiff1d(code, self._code)[: max(0, CAPACITY + reserve + 1 - len(self._code))]
        everybody = np.concatenate([self._code, new])
        order = np.argsort(everybody)
        self._code = everybody[order]
        self._time_ns = np.concatenate([self._time_ns, np.full(len(new), NEVER_NS)])[order]
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


def _word(fixes: NDArray[np.void]) -> NDArray[np.int64]:
    """A number for each fix that differs where heading or position do: multiplicative hashing, which may wrap."""
    x, y = fixes["x_cm"].astype(np.int64), fixes["y_cm"].astype(np.int64)
    return np.asarray((x * 0x9E3779B97F4A7C1 + y) * 0x2545F4914F6CDD1 + fixes["heading"])
