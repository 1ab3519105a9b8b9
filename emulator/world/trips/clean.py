"""What of a trip is believed: positions that a receiver held, jumps, and times of which nothing is known.

Held: the same position again is a stand, unless the vehicle then moves faster than any can from a stand: then its
receiver held the position (as files do that repeat samples to reach a rate), and the repetitions are left out, for
at most `longest_gap_s`. Jumps: where two samples are further apart than `fastest_mps` allows, the largest set of
samples without a jump is kept. Gaps: up to `longest_gap_s` without a sample the vehicle drives straight on from one
sample to the next; after more it has left, and enters anew. docs/motion.md has examples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emulator.world.trips.samples import Trip
from vnet.errors import ScenarioError
from vnet.roads.lanes import Array

HARDEST_MPS2 = 10.0
"""No vehicle starts harder."""
MOST_JUMPS = 0.1
"""A trip with a larger share of jumps is no trip: units, projection or ids are wrong."""
FEW_JUMPS = 10
FARTHEST_RUNS = 50
"""A chain leaves out so many runs of samples at most."""

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

    Between two jumps there is a run of samples. A chain goes from the end of a run into a later one, at the first
    sample there that can be reached; the chain with most samples wins, the earlier of two equal ones.
    """
    time_s, position_m = trip.time_s[rows], trip.position_m[rows]
    step_m = np.hypot(*np.diff(position_m, axis=0).T)
    jumps = np.flatnonzero(step_m > rules.fastest_mps * np.diff(time_s))
    if len(jumps) > max(FEW_JUMPS, MOST_JUMPS * len(rows)):
        raise ScenarioError(
            f"{trip.node_id}: {len(jumps)} of {len(rows) - 1} steps are faster than {rules.fastest_mps:g} m/s: "
            "wrong units, degrees or metres, or several vehicles under one id?"
        )
    starts, ends = np.append(0, jumps + 1), np.append(jumps + 1, len(rows))
    before, entry = _best_chain(time_s, position_m, starts, ends, rules)
    kept = np.zeros(len(rows), dtype=bool)
    run = before[-1]
    while run >= 0:
        kept[entry[run] : ends[run]] = True
        run = before[run]
    return kept


def _best_chain(
    time_s: Array, position_m: Array, starts: Rows, ends: Rows, rules: Rules
) -> tuple[Sequence[int], Sequence[int]]:
    """For each run the run before it in its best chain, or -1, and the row at which it is entered.

    One more entry at the end of the former names the run with which the best of all chains ends.
    """
    length, before, entry = [0] * len(starts), [-1] * len(starts), starts.tolist()
    for run, (start, end) in enumerate(zip(starts.tolist(), ends.tolist(), strict=True)):
        length[run] = end - start
        for earlier in range(max(0, run - FARTHEST_RUNS), run):
            last = ends[earlier] - 1
            away_m = np.hypot(*(position_m[start:end] - position_m[last]).T)
            reached = np.flatnonzero(away_m <= rules.fastest_mps * (time_s[start:end] - time_s[last]))
            if len(reached) and length[earlier] + (end - start - reached[0]) > length[run]:
                length[run] = length[earlier] + end - start - int(reached[0])
                before[run], entry[run] = earlier, start + int(reached[0])
    return [*before, int(np.argmax(length))], entry
