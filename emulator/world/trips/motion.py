"""The true motion of all vehicles: position, heading and presence at the start of every period of a run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emulator.world.trips.clean import ImpossibleTripError, Rules, clean
from emulator.world.trips.samples import Trip
from vnet.counted import counted
from vnet.errors import ScenarioError, first_names
from vnet.types import Array
from vnet.units import NS_PER_S

STANDING_MPS = 0.5
"""Speed below which a vehicle stands and keeps its heading."""
ACCELERATION_S = 0.5
"""Time before and after an instant over which speeds are taken for an acceleration: recordings have noise."""
CHORD_S = 0.5
"""Half of the time over which a heading is computed from positions."""
SHORTEST_STAY_S = 1.0
"""Shortest presence of a vehicle that takes part."""
MOST_LEFT_OUT = 0.5
"""Largest share of vehicles that are left out; if more are impossible, the file's units or ids are wrong."""
MOST_STATES = 50_000_000
"""Most vehicles times periods, so that the truth fits into memory."""


@dataclass(frozen=True)
class Motion:
    """Positions `position_m` (K, N, 2) and headings `heading_rad` (K, N) at the start of each period.

    An absent vehicle's entries are NaN. The heading of a vehicle that is present is NaN only if it never moves and
    its trip has no headings. `origin_deg` (latitude, longitude) is the origin of the metres, if it is known.
    `notes` are lines for the user about the input.
    """

    node_ids: tuple[str, ...]
    position_m: Array
    heading_rad: Array
    origin_deg: tuple[float, float] | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Selection:
    """The part of the trips that a run takes: `periods` of `period_ns` from `start_s`, within the `disc` (x, y,
    radius in metres), at most `most` vehicles.
    """

    start_s: float
    periods: int
    period_ns: int
    disc: tuple[float, float, float] | None = None
    most: int | None = None


def motion_of(trips: list[Trip], selection: Selection, rules: Rules) -> Motion:
    """Resample trips to a run's periods; vehicles are in the order in which they enter, then in that of the file.

    Raise ScenarioError if no vehicle is present during the run, if the truth does not fit into memory, or for an
    impossible trip that is not to be left out.
    """
    driven: list[tuple[str, Array | None]] = []
    cuts: list[int] = []
    impossible: list[ImpossibleTripError] = []
    for trip in trips:
        try:
            states, cut = _drive(trip, selection, rules)
            driven.append((trip.node_id, states))
            cuts += [cut] if cut else []
        except ImpossibleTripError as error:
            impossible.append(error)
            if not rules.leaves_out or len(impossible) > MOST_LEFT_OUT * len(trips):
                raise
    present = [(int(np.flatnonzero(np.isfinite(d[:, 0]))[0]), name, d) for name, d in driven if d is not None]
    present.sort(key=lambda entry: entry[0])
    present = present[: selection.most]
    if not present:
        seconds = (selection.periods - 1) * selection.period_ns / NS_PER_S
        where = " within the disc" if selection.disc else ""
        raise ScenarioError(
            f"no vehicle is present{where} for {SHORTEST_STAY_S:g} s "
            f"of the {seconds:g} s from {selection.start_s:.10g} s"
        )
    if len(present) * selection.periods > MOST_STATES:
        raise ScenarioError(
            f"{len(present)} vehicles for {selection.periods} periods: at most {MOST_STATES:,} states; "
            "set max_vehicles, or a disc, or a shorter run"
        )
    states = np.stack([driven for _, _, driven in present], axis=1)
    names = tuple(name for _, name, _ in present)
    return Motion(
        names,
        states[..., :2],
        states[..., 2],
        notes=(*_left_out(impossible, len(trips)), *_cut(cuts, len(trips), rules)),
    )


def _left_out(impossible: Sequence[ImpossibleTripError], of: int) -> tuple[str, ...]:
    """Return the line that says which vehicles are omitted, with the reason."""
    if not impossible:
        return ()
    reasons = first_names([error.reason for error in impossible], most=3, with_total=True)
    return (f"{len(impossible)} of {of} vehicles left out as impossible: {reasons}",)


def _cut(cuts: Sequence[int], of: int, rules: Rules) -> tuple[str, ...]:
    """Return the line that says how many vehicles were cut, and how often."""
    if not cuts:
        return ()
    places = counted(sum(cuts), "place")
    return (f"{len(cuts)} of {of} vehicles cut at {places} where they would need over {rules.hardest_mps2:g} m/s²",)


def _drive(trip: Trip, selection: Selection, rules: Rules) -> tuple[Array | None, int]:
    """Return a vehicle's position and heading (K, 3) at the start of each period, and at how many places it is cut.

    None if it is never present.
    """
    driven = np.full((selection.periods, 3), np.nan)
    for rows in clean(trip, rules):
        _resample(driven, trip, rows, selection)
    impossible = _too_hard(driven[:, :2], selection.period_ns, rules)
    driven[impossible] = np.nan
    present = np.isfinite(driven[:, 0])
    if selection.disc is not None:
        x, y, radius_m = selection.disc
        inside = np.hypot(driven[:, 0] - x, driven[:, 1] - y) <= radius_m
        longest = math.ceil(rules.longest_gap_s * NS_PER_S / selection.period_ns)
        present = _without_excursions(inside, present, longest)
    shortest = min(math.ceil(SHORTEST_STAY_S * NS_PER_S / selection.period_ns), selection.periods)
    for begin, end in _runs_of_true(present):
        present[begin:end] = end - begin >= shortest
    driven[~present] = np.nan
    is_there = bool(present[: selection.periods - 1].any())
    return (driven, len(_runs_of_true(impossible))) if is_there else (None, 0)


def _too_hard(position_m: Array, period_ns: int, rules: Rules) -> NDArray[np.bool_]:
    """Return the mask (K,) of the periods between positions (K, 2) that no possible acceleration connects."""
    hard = np.zeros(len(position_m), dtype=bool)
    step = max(1, round(ACCELERATION_S * NS_PER_S / period_ns))
    if rules.hardest_mps2 is None or len(position_m) <= 2 * step:
        return hard
    speed_mps = (position_m[step:] - position_m[:-step]) / (step * period_ns / NS_PER_S)
    change_mps2 = np.hypot(*(speed_mps[step:] - speed_mps[:-step]).T) / (step * period_ns / NS_PER_S)
    for middle in (np.flatnonzero(change_mps2 > rules.hardest_mps2) + step).tolist():
        hard[middle - step + 1 : middle + step] = True
    return hard


def _without_excursions(inside: NDArray[np.bool_], present: NDArray[np.bool_], longest: int) -> NDArray[np.bool_]:
    """Return the mask (K,) `inside`, with absences from the disc of up to `longest` periods filled in.

    A vehicle that leaves the disc and returns counts as inside meanwhile, if its trip has no gap.
    """
    stays = inside.copy()
    for begin, end in _runs_of_true(present & ~inside):
        back = begin > 0 and end < len(inside) and inside[begin - 1] and inside[end]
        stays[begin:end] = back and end - begin <= longest
    return stays


def _runs_of_true(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the runs of true entries of a mask (K,) as [begin, end)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _resample(driven: Array, trip: Trip, rows: NDArray[np.intp], selection: Selection) -> None:
    """Set `driven` (K, 3) between the first and the last of the samples `rows`."""
    period_s = selection.period_ns / NS_PER_S
    time_s = trip.time_s[rows] - selection.start_s
    first = max(0, math.ceil(round(time_s[0] / period_s, 6)))
    last = min(selection.periods - 1, math.floor(round(time_s[-1] / period_s, 6)))
    if first > last:
        return
    at_s = np.arange(first, last + 1) * period_s

    def at(values: Array, query_s: Array) -> Array:
        return np.asarray(np.interp(query_s, time_s, values[rows]))

    periods = slice(first, last + 1)
    driven[periods, 0], driven[periods, 1] = (at(axis_m, at_s) for axis_m in trip.position_m.T)
    if trip.heading_rad is not None:
        unwound = np.unwrap(trip.heading_rad[rows])
        driven[periods, 2] = np.mod(np.interp(at_s, time_s, unwound), 2 * np.pi)
        return
    early_s, late_s = np.maximum(at_s - CHORD_S, time_s[0]), np.minimum(at_s + CHORD_S, time_s[-1])
    chord_m = np.array([at(axis_m, late_s) - at(axis_m, early_s) for axis_m in trip.position_m.T])
    if trip.speed_mps is not None:
        speed_mps = at(trip.speed_mps, at_s)
    else:
        speed_mps = np.hypot(*chord_m) / np.maximum(late_s - early_s, 1e-9)
    moving = (speed_mps >= STANDING_MPS) & chord_m.any(axis=0)
    driven[periods, 2] = _kept(np.mod(np.arctan2(chord_m[1], chord_m[0]), 2 * np.pi), moving)


def _kept(heading_rad: Array, moving: NDArray[np.bool_]) -> Array:
    """Return headings (k,) of which a standing vehicle keeps its last, or, before it first moves, has its first."""
    if not moving.any():
        return np.full(len(heading_rad), np.nan)
    last = np.maximum.accumulate(np.where(moving, np.arange(len(moving)), -1))
    return heading_rad[np.where(last < 0, int(np.argmax(moving)), last)]
