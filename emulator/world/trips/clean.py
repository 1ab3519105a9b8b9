"""Cleaning of recorded trips: held positions, jumps and gaps.

Held positions: a repeated position means a standing vehicle, unless it then moves faster than a vehicle can from a
standstill. Then its receiver held the position (as files do that repeat samples to reach a rate), and repetitions
for up to `longest_gap_s` are dropped. Jumps: if two samples are further apart than `fastest_mps` allows, the
largest set of samples without a jump is kept. Gaps: across a gap of up to `longest_gap_s` the vehicle moves
linearly from sample to sample; after a longer one it has left, and enters again. docs/motion.md has examples.
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

Rows = NDArray[np.intp]


@dataclass(frozen=True)
class Rules:
    """Greatest speed of a vehicle, and longest gap between its samples."""

    fastest_mps: float
    longest_gap_s: float


def clean(trip: Trip, rules: Rules) -> list[Rows]:
    """Return the row numbers of the samples that are kept, one array for each part without a long gap.

    Parts have at least two samples. Raise ScenarioError, naming the vehicle, if too many steps are jumps.
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

    Between two jumps there is a run of samples. A chain leaves a run at its end, or a few samples before, and
    continues in a later run, at its first sample that can be reached or lies after a long gap. The chain with the
    most samples is kept.
    """
    time_s, position_m = trip.time_s[rows], trip.position_m[rows]
    step_m = np.hypot(*np.diff(position_m, axis=0).T)
    jumps = np.flatnonzero(step_m > rules.fastest_mps * np.diff(time_s))
    if len(jumps) > max(ALWAYS_ALLOWED_JUMPS, MAX_JUMP_SHARE * len(rows)):
        raise ScenarioError(
            f"{trip.node_id}: {len(jumps)} of {len(rows) - 1} steps are faster than {rules.fastest_mps:g} m/s: "
            "check units, degrees or metres, and that each id is one vehicle"
        )
    runs = [_Run(start, end) for start, end in zip([0, *(jumps + 1)], [*(jumps + 1), len(rows)], strict=True)]
    for number, run in enumerate(runs):
        for earlier in runs[max(0, number - MAX_SKIPPED_RUNS) : number]:
            for last in range(earlier.end - 1, max(earlier.entry, earlier.end - 1 - MAX_SKIPPED_SAMPLES) - 1, -1):
                run.follow(earlier, last, time_s, position_m, rules)
    kept = np.zeros(len(rows), dtype=bool)
    best = max(runs, key=lambda run: run.length)
    kept[best.entry : best.end] = True
    while best.before is not None:
        kept[best.before.entry : best.left + 1] = True
        best = best.before
    return kept


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

    def follow(self, earlier: _Run, last: int, time_s: Array, position_m: Array, rules: Rules) -> None:
        """Enter from sample `last` of an earlier run if that makes the chain longer."""
        later_s = time_s[self.start : self.end] - time_s[last]
        away_m = np.hypot(*(position_m[self.start : self.end] - position_m[last]).T)
        reached = np.flatnonzero((away_m <= rules.fastest_mps * later_s) | (later_s > rules.longest_gap_s))
        if not len(reached):
            return
        length = earlier.length - (earlier.end - 1 - last) + self.end - self.start - int(reached[0])
        if length > self.length:
            self.length, self.entry = length, self.start + int(reached[0])
            self.before, self.left = earlier, last
