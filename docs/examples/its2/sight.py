"""The vehicles' own sensor: what is around each, unless a building or a vehicle is in between."""

from __future__ import annotations

import numpy as np

from emulator import SensedTruth
from vnet.types import Array, Mask

CORNER_M = 10.0
"""Distance of the buildings from the axes of both streets, which cross at the origin (blocks.csv)."""
HIDES_M = 1.5
"""Distance from the line of sight within which a vehicle hides what is behind it."""
MOST = 16
"""Objects of a reading, the nearest ones: four numbers each."""


def sensor(truth: SensedTruth, state: dict[str, object]) -> dict[str, tuple[float, ...]]:
    """Return what each vehicle sees: of each object its place, in m east and north of itself, and velocity, m/s."""
    options = truth.options
    direction = np.column_stack([np.cos(truth.heading_rad), np.sin(truth.heading_rad)])
    velocity_m_s = direction * truth.speed_m_s[:, None]
    readings = {}
    for number, vehicle in enumerate(truth.node_ids):
        away_m = truth.position_m - truth.position_m[number]
        distance_m = np.hypot(*away_m.T)
        sees = (distance_m <= options["range_m"]) & ~_hidden(truth.position_m, number)
        sees &= truth.rng.random(len(away_m)) >= options["misses"]
        sees[number] = False
        chosen = np.flatnonzero(sees)
        chosen = chosen[np.argsort(distance_m[chosen], kind="stable")][:MOST]
        measured = np.column_stack([away_m, velocity_m_s])[chosen]
        measured += truth.rng.normal(0.0, options["sigma"], measured.shape)
        if len(chosen):
            readings[vehicle] = tuple(measured.ravel().tolist())
    return readings


def _hidden(position_m: Array, number: int) -> Mask:
    """Return the vehicles (n,) that a building or another vehicle hides from vehicle `number`."""
    start_m, way_m = position_m[number], position_m - position_m[number]
    line_m = start_m + np.linspace(0.0, 1.0, 101)[:, None, None] * way_m  # (steps, n, 2)
    by_building = (np.abs(line_m) > CORNER_M).all(axis=2).any(axis=0)
    length2 = np.maximum((way_m**2).sum(axis=1), 1e-9)
    along = (way_m @ way_m.T) / length2[:, None]  # (n, n): place of the second on the way to the first, 0 to 1
    aside_m = np.abs(way_m[:, None, 0] * way_m[None, :, 1] - way_m[:, None, 1] * way_m[None, :, 0])
    between = (along > 1e-6) & (along < 1 - 1e-6) & (aside_m < HIDES_M * np.sqrt(length2)[:, None])
    return np.asarray(by_building | between.any(axis=1))
