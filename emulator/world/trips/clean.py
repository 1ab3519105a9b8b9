"""What of a trip is believed: positions that a receiver held, jumps, and times of which nothing is known.

Held: the same position again is a stand, unless the vehicle then moves faster than any can from a stand: then its
receiver held the position (as files do that repeat samples to reach a rate), and the repetitions are left out, for
at most `longest_gap_s`. Jumps: where two samples are further apart than `fastest_mps` allows, the largest set of
samples without a jump is kept. Gaps: up to `longest_gap_s` without a sample the vehicle drives straight on from one
sample to the next; after more it has left, and enters anew. docs/motion.md has examples.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emulator.world.trips.samples import Trip
from vnet.errors import ScenarioError
from vnet.types import Array

HARDEST_MPS2 = 10.0
"""No vehicle starts harder."""
MOST_JUMPS = 0.05
"""A trip with a larger share of jumps is no trip: units, projection or ids are wrong."""
FEW_JUMPS = 10
FARTHEST_RUNS = 20
"""A chain leaves out so many runs of samples at most."""
FARTHEST_EXIT = 5
"""And so many samples before a jump: what a filter in a receiver makes of one."""

Rows = NDArray[np.intp]


@dataclass(frozen=True)
class Rules:
    """What no vehicle does, and for how long it may be out of sight."""

    fastest_mps: float
    longest_gap_s: float


def clean(trip: Trip, rules: Rules) -> list[Rows]:
    """The samples that are believed, as row numbers for each time without a gap, of two samples at least.

    Raises ScenarioError, naming the vehicle, where so much is jumps that nothing should be believed.
    """
    kept = _fresh(trip, rules)
    kept = kept[_without_jumps(trip, kept, rules)]
    parts = np.split(kept, np.flatnonzero(np.diff(trip.time_s[kept]) > rules.longest_gap_s) + 1)
    return [part for part in parts if len(part) > 1]


def _fresh(trip: Trip, rules: Rules) -> Rows:
    """All samples but those in which a moving receiver held its position."""
    time_s, position_m = trip.time_s, trip.position_m
    step_m = np.hypot(*np.diff(position_m, axis=0).T)
    moves = np.flatnonzero(step_m > 0)  # row m and row m + 1 differ
    first = np.concatenate([[0], moves[:-1] + 1]) if len(moves) else np.zeros(0, np.intp)
    step_s = time_s[moves + 1] - time_s[moves]
    too_hard = step_m[moves] > HARDEST_MPS2 * step_s**2
    bridged = time_s[moves + 1] - time_s[first] <= rules.longest_gap_s
    held = np.zeros(len(time_s), dtype=bool)
    for begin, end in zip(first[too_hard & bridged].tolist(), moves[too_hard & bridged].tolist(), strict=True):
        held[begin + 1 : end + 1] = True
    return np.flatnonzero(~held)


def _without_jumps(trip: Trip, rows: Rows, rules: Rules) -> NDArray[np.bool_]:
    """Which of these rows belong to the largest set in which no step is a jump.

    Between two jumps there is a run of samples. A chain leaves a run at its end, or a few samples before, and goes
    on in a later one, at the first sample there that can be reached, or comes after the longest gap. The chain with
    most samples wins.
    """
    time_s, position_m = trip.time_s[rows], trip.position_m[rows]
    step_m = np.hypot(*np.diff(position_m, axis=0).T)
    jumps = np.flatnonzero(step_m > rules.fastest_mps * np.diff(time_s))
    if len(jumps) > max(FEW_JUMPS, MOST_JUMPS * len(rows)):
        raise ScenarioError(
            f"{trip.node_id}: {len(jumps)} of {len(rows) - 1} steps are faster than {rules.fastest_mps:g} m/s: "
            "wrong units, degrees or metres, or several vehicles under one id?"
        )
    runs = [_Run(start, end) for start, end in zip([0, *(jumps + 1)], [*(jumps + 1), len(rows)], strict=True)]
    for number, run in enumerate(runs):
        for earlier in runs[max(0, number - FARTHEST_RUNS) : number]:
            for last in range(earlier.end - 1, max(earlier.entry, earlier.end - 1 - FARTHEST_EXIT) - 1, -1):
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
    """Samples [start, end) without a jump, and the best chain so far that goes on to their end.

    The chain has `length` samples; it enters here at `entry`, having left the run `before` after its sample `left`.
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
        """Come from an earlier run's sample `last`, if that is better."""
        later_s = time_s[self.start : self.end] - time_s[last]
        away_m = np.hypot(*(position_m[self.start : self.end] - position_m[last]).T)
        reached = np.flatnonzero((away_m <= rules.fastest_mps * later_s) | (later_s > rules.longest_gap_s))
        if not len(reached):
            return
        length = earlier.length - (earlier.end - 1 - last) + self.end - self.start - int(reached[0])
        if length > self.length:
            self.length, self.entry = length, self.start + int(reached[0])
            self.before, self.left = earlier, last
