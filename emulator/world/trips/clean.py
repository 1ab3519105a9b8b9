"""Cleaning of recorded trips: held positions, jumps and gaps.

Held positions: a repeated position means a standing vehicle, unless it then moves faster than a vehicle can from a
standstill. Then its receiver held the position (as files do that repeat samples to reach a rate), and repetitions
for up to `longest_gap_s` are dropped. Jumps: if two samples are further apart than `fastest_mps`, or the speed
around them, allows, the largest set of samples without a jump is kept. Gaps: across a gap of up to `longest_gap_s`
the vehicle moves linearly from sample to sample; after a longer one it has left, and enters again. docs/motion.md
has examples.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emulator.world.trips.samples import Trip
from vnet.errors import ScenarioError
from vnet.types import Array

MAX_ACCELERATION_MPS2 = 10.0
"""Greatest acceleration of a vehicle from a standstill."""
MAX_JUMP_SHARE = 0.05
"""Greatest share of jumps in a trip: with more, its units, projection or ids are wrong."""
ALWAYS_ALLOWED_JUMPS = 10
"""Jumps that are allowed in every trip, however short."""
MAX_SKIPPED_RUNS = 20
"""Most runs of samples that a chain skips."""
MAX_SKIPPED_SAMPLES = 5
"""Most samples before a jump that a chain skips: a filter in the receiver spreads a jump over a few."""

SPEED_WINDOW_S = 10.0
"""Time around a step whose median speed is that of the vehicle: longer than what a jump is spread over."""
FEWEST_IN_WINDOW = 11
"""Fewest steps in this time; with fewer samples a second a single step may differ from all around it."""
MOST_IN_WINDOW = 101
"""Most steps in this time, for speed."""
FASTER_THAN_AROUND = 1.5
FASTER_THAN_AROUND_MPS = 5.0
"""A vehicle is at most so many times, and so much, faster than it drives at the time. Hard braking and full
acceleration stay far below."""
SMALL_JUMP_M = 3.0
"""Shorter steps are no jumps by the speed around them: rounding and noise of standing receivers."""
_CHUNK = 10_000
"""Steps whose windows are in memory at once."""

Rows = NDArray[np.intp]


class ImpossibleTripError(ScenarioError):
    """A trip most of whose positions may be wrong: too many steps are faster than any vehicle."""

    def __init__(self, node_id: str, steps: int, of: int, fastest_mps: float) -> None:
        self.reason = f"{node_id}: {steps} of {of} steps are faster than {fastest_mps:g} m/s"
        super().__init__(f"{self.reason}: check units, degrees or metres, and that each id is one vehicle")


@dataclass(frozen=True)
class Rules:
    """Greatest speed of a vehicle, longest gap between its samples, whether impossible trips are left out, and the
    greatest acceleration that is driven, if there is one.
    """

    fastest_mps: float
    longest_gap_s: float
    leaves_out: bool = True
    hardest_mps2: float | None = None


def clean(trip: Trip, rules: Rules) -> list[Rows]:
    """Return the row numbers of the samples that are kept, one array for each part without a long gap.

    Parts have at least two samples. Raise ImpossibleTripError if too many steps are jumps.
    """
    kept = _fresh(trip, rules)
    kept = kept[_without_jumps(trip, kept, rules)]
    parts = np.split(kept, np.flatnonzero(np.diff(trip.time_s[kept]) > rules.longest_gap_s) + 1)
    return [part for part in parts if len(part) > 1]


def _fresh(trip: Trip, rules: Rules) -> Rows:
    """Return the row numbers of all samples but those in which a moving receiver held its position."""
    time_s, position_m = trip.time_s, trip.position_m
    step_m = np.hypot(*np.diff(position_m, axis=0).T)
    moves = np.flatnonzero(step_m > 0)  # row m and row m + 1 differ
    first = np.concatenate([[0], moves[:-1] + 1]) if len(moves) else np.zeros(0, np.intp)
    step_s = time_s[moves + 1] - time_s[moves]
    too_hard = step_m[moves] > MAX_ACCELERATION_MPS2 * step_s**2
    bridged = time_s[moves + 1] - time_s[first] <= rules.longest_gap_s
    held = np.zeros(len(time_s), dtype=bool)
    for begin, end in zip(first[too_hard & bridged].tolist(), moves[too_hard & bridged].tolist(), strict=True):
        held[begin + 1 : end + 1] = True
    return np.flatnonzero(~held)


def _without_jumps(trip: Trip, rows: Rows, rules: Rules) -> NDArray[np.bool_]:
    """Return the mask of the rows that belong to the largest set in which no step is a jump.

    Raise ImpossibleTripError if too many are.

    Between two jumps there is a run of samples. A chain leaves a run at its end, or a few samples before, and
    continues in a later run, at its first sample that can be reached or lies after a long gap. The chain with the
    most samples is kept.
    """
    time_s, position_m = trip.time_s[rows], trip.position_m[rows]
    step_m, step_s = np.hypot(*np.diff(position_m, axis=0).T), np.diff(time_s)
    most = max(ALWAYS_ALLOWED_JUMPS, MAX_JUMP_SHARE * len(rows))
    too_fast = int(np.count_nonzero(step_m > rules.fastest_mps * step_s))
    if too_fast > most:
        raise ImpossibleTripError(trip.node_id, too_fast, len(rows) - 1, rules.fastest_mps)
    limits = _Limits(_allowed_mps(step_m, step_s, rules), rules)
    jumps = np.flatnonzero(step_m > limits.reach_m(np.arange(len(step_m)), np.arange(1, len(rows)), step_s))
    if len(jumps) > most:  # noise: the speed around says nothing
        limits = _Limits(np.full(len(rows), rules.fastest_mps), rules)
        jumps = np.flatnonzero(step_m > rules.fastest_mps * step_s)
    runs = [_Run(start, end) for start, end in zip([0, *(jumps + 1)], [*(jumps + 1), len(rows)], strict=True)]
    for number, run in enumerate(runs):
        for earlier in runs[max(0, number - MAX_SKIPPED_RUNS) : number]:
            for last in range(earlier.end - 1, max(earlier.entry, earlier.end - 1 - MAX_SKIPPED_SAMPLES) - 1, -1):
                run.follow(earlier, last, time_s, position_m, limits)
    kept = np.zeros(len(rows), dtype=bool)
    best = max(runs, key=lambda run: run.length)
    kept[best.entry : best.end] = True
    while best.before is not None:
        kept[best.before.entry : best.left + 1] = True
        best = best.before
    return kept


def _allowed_mps(step_m: Array, step_s: Array, rules: Rules) -> Array:
    """Return the greatest speed (n,) at each sample, by the median of the speeds around it and by the rules."""
    window = int(np.clip(SPEED_WINDOW_S / np.median(step_s), 1, MOST_IN_WINDOW)) if len(step_s) else 0
    if window < FEWEST_IN_WINDOW or len(step_s) < window:
        return np.full(len(step_s) + 1, rules.fastest_mps)
    half = window // 2
    speed_mps = np.pad(step_m / step_s, half, mode="reflect")
    around = np.lib.stride_tricks.sliding_window_view(speed_mps, 2 * half + 1)
    parts = [np.median(around[first : first + _CHUNK], axis=1) for first in range(0, len(around), _CHUNK)]
    allowed_mps = np.minimum(FASTER_THAN_AROUND * np.concatenate(parts) + FASTER_THAN_AROUND_MPS, rules.fastest_mps)
    return np.asarray(np.maximum(np.append(allowed_mps, 0.0), np.append(0.0, allowed_mps)))


@dataclass(frozen=True)
class _Limits:
    """Greatest speed `allowed_mps` (n,) at each sample."""

    allowed_mps: Array
    rules: Rules

    def reach_m(self, first: Rows | np.intp, last: Rows, time_s: Array) -> Array:
        """Return how far the vehicle comes from samples `first` to `last` in `time_s`."""
        around_m = np.maximum(self.allowed_mps[first], self.allowed_mps[last]) * time_s
        return np.asarray(np.minimum(np.maximum(around_m, SMALL_JUMP_M), self.rules.fastest_mps * time_s))


@dataclass(eq=False)
class _Run:
    """Samples [start, end) without a jump, and the best chain so far that continues to their end.

    The chain has `length` samples. It enters this run at `entry`, after it left the run `before` at sample `left`.
    """

    start: int
    end: int
    length: int = 0
    entry: int = 0
    before: _Run | None = None
    left: int = 0

    def __post_init__(self) -> None:
        self.length, self.entry = self.end - self.start, self.start

    def follow(self, earlier: _Run, last: int, time_s: Array, position_m: Array, limits: _Limits) -> None:
        """Enter from sample `last` of an earlier run if that makes the chain longer."""
        rows = np.arange(self.start, self.end)
        later_s = time_s[rows] - time_s[last]
        away_m = np.hypot(*(position_m[rows] - position_m[last]).T)
        is_reached = away_m <= limits.reach_m(np.intp(last), rows, later_s)
        reached = np.flatnonzero(is_reached | (later_s > limits.rules.longest_gap_s))
        if not len(reached):
            return
        length = earlier.length - (earlier.end - 1 - last) + self.end - self.start - int(reached[0])
        if length > self.length:
            self.length, self.entry = length, self.start + int(reached[0])
            self.before, self.left = earlier, last
