"""The true motion of all vehicles: where each is at the start of every period of a run, and when it is there."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emulator.world.trips.clean import Rules, clean
from emulator.world.trips.samples import Trip
from vnet.errors import ScenarioError
from vnet.types import Array
from vnet.units import NS_PER_S

STANDING_MPS = 0.5
"""A vehicle that is slower stands, and keeps its heading."""
CHORD_S = 0.5
"""Headings are those of the way from so long before to so long after."""
SHORTEST_STAY_S = 1.0
"""Whoever is there for less takes no part."""
MOST_STATES = 50_000_000
"""Vehicles times periods, so that the truth fits into memory."""


@dataclass(frozen=True)
class Motion:
    """`position_m` (K, N, 2) and `heading_rad` (K, N) at the start of each period; NaN where one is not there.

    A vehicle that is there has no heading, NaN, only if it never moves and nobody says how it stands. `origin_deg`
    (latitude, longitude) is where metres start, if anybody knows.
    """

    node_ids: tuple[str, ...]
    position_m: Array
    heading_rad: Array
    origin_deg: tuple[float, float] | None = None


@dataclass(frozen=True)
class Frame:
    """What of the trips a run takes: `periods` of `period_ns` from `start_s`, within the `disc` (x, y, radius),
    at most `most` vehicles.
    """

    start_s: float
    periods: int
    period_ns: int
    disc: tuple[float, float, float] | None = None
    most: int | None = None


def motion_of(trips: list[Trip], frame: Frame, rules: Rules) -> Motion:
    """Resample trips to a run's periods; vehicles in the order in which they enter, and then of the file.

    Raises ScenarioError if nobody is there during the run, or so many that the truth does not fit into memory.
    """
    driven = [(trip.node_id, _drive(trip, frame, rules)) for trip in trips]
    there = [(int(np.flatnonzero(np.isfinite(d[:, 0]))[0]), name, d) for name, d in driven if d is not None]
    there.sort(key=lambda entry: entry[0])
    there = there[: frame.most]
    if not there:
        seconds = (frame.periods - 1) * frame.period_ns / NS_PER_S
        where = " within the disc" if frame.disc else ""
        raise ScenarioError(
            f"no vehicle is there{where} for {SHORTEST_STAY_S:g} s of {seconds:g} s from {frame.start_s:.10g} s"
        )
    if len(there) * frame.periods > MOST_STATES:
        raise ScenarioError(
            f"{len(there)} vehicles for {frame.periods} periods: at most {MOST_STATES:,} states; "
            "set max_vehicles, or a disc, or a shorter run"
        )
    states = np.stack([driven for _, _, driven in there], axis=1)
    return Motion(tuple(name for _, name, _ in there), states[..., :2], states[..., 2])


def _drive(trip: Trip, frame: Frame, rules: Rules) -> Array | None:
    """One vehicle's position and heading (K, 3) at the start of each period; None if it is never there."""
    driven = np.full((frame.periods, 3), np.nan)
    for rows in clean(trip, rules):
        _resample(driven, trip, rows, frame)
    there = np.isfinite(driven[:, 0])
    if frame.disc is not None:
        x, y, radius_m = frame.disc
        inside = np.hypot(driven[:, 0] - x, driven[:, 1] - y) <= radius_m
        there = _without_excursions(inside, there, math.ceil(rules.longest_gap_s * NS_PER_S / frame.period_ns))
    shortest = min(math.ceil(SHORTEST_STAY_S * NS_PER_S / frame.period_ns), frame.periods)
    for begin, end in _rows_of(there):
        there[begin:end] = end - begin >= shortest
    driven[~there] = np.nan
    return driven if there[: frame.periods - 1].any() else None


def _without_excursions(inside: NDArray[np.bool_], there: NDArray[np.bool_], longest: int) -> NDArray[np.bool_]:
    """Who is inside (K,), or was and will be again within so many periods, having been there all the time."""
    stays = inside.copy()
    for begin, end in _rows_of(there & ~inside):
        back = begin > 0 and end < len(inside) and inside[begin - 1] and inside[end]
        stays[begin:end] = back and end - begin <= longest
    return stays


def _rows_of(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Where entries of a mask (K,) stand in a row, as [begin, end)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _resample(driven: Array, trip: Trip, rows: NDArray[np.intp], frame: Frame) -> None:
    """Enter what happens between the first and the last of these samples."""
    period_s = frame.period_ns / NS_PER_S
    time_s = trip.time_s[rows] - frame.start_s
    first = max(0, math.ceil(round(time_s[0] / period_s, 6)))
    last = min(frame.periods - 1, math.floor(round(time_s[-1] / period_s, 6)))
    if first > last:
        return
    at_s = np.arange(first, last + 1) * period_s

    def at(values: Array, when_s: Array) -> Array:
        return np.asarray(np.interp(when_s, time_s, values[rows]))

    place = slice(first, last + 1)
    driven[place, 0], driven[place, 1] = (at(axis_m, at_s) for axis_m in trip.position_m.T)
    if trip.heading_rad is not None:
        unwound = np.unwrap(trip.heading_rad[rows])
        driven[place, 2] = np.mod(np.interp(at_s, time_s, unwound), 2 * np.pi)
        return
    early_s, late_s = np.maximum(at_s - CHORD_S, time_s[0]), np.minimum(at_s + CHORD_S, time_s[-1])
    chord_m = np.array([at(axis_m, late_s) - at(axis_m, early_s) for axis_m in trip.position_m.T])
    if trip.speed_mps is not None:
        speed_mps = at(trip.speed_mps, at_s)
    else:
        speed_mps = np.hypot(*chord_m) / np.maximum(late_s - early_s, 1e-9)
    moving = (speed_mps >= STANDING_MPS) & chord_m.any(axis=0)
    driven[place, 2] = _kept(np.mod(np.arctan2(chord_m[1], chord_m[0]), 2 * np.pi), moving)


def _kept(heading_rad: Array, moving: NDArray[np.bool_]) -> Array:
    """Headings (k,) in which those who stand keep their last, or before they ever moved have their first."""
    if not moving.any():
        return np.full(len(heading_rad), np.nan)
    last = np.maximum.accumulate(np.where(moving, np.arange(len(moving)), -1))
    return heading_rad[np.where(last < 0, int(np.argmax(moving)), last)]
