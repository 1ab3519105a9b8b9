"""The part of a map that programs get: the lanes around the vehicles' trajectories."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from emulator.scenario.network import Map
from emulator.world.maps.osm import CLIPPED
from emulator.world.maps.roads import Roads
from vnet.errors import ScenarioError
from vnet.roads.road_map import RoadMap
from vnet.types import Array

FAR_M = 100.0
"""Distance to the nearest lane beyond which a position is off the map."""
SAMPLES = 5000
"""Positions that are tested for it."""


def lanes_around(roads: Roads, section: Map, course_m: Array) -> RoadMap:
    """Return the lanes of `[map]`, read as `roads`, around the positions `course_m` (K, N, 2) of all vehicles.

    Raise ScenarioError if most positions are off the map.
    """
    position_m = course_m[np.isfinite(course_m[..., 0])]
    lanes = lanes_in_box(roads, section, position_m.min(axis=0), position_m.max(axis=0))
    if lanes is None or _far_share(lanes, position_m) > 0.5:
        (x, y), (left, low), (right, high) = np.median(position_m, axis=0), *_extent(roads)
        raise ScenarioError(
            f"{section.path}: most positions of vehicles are over {FAR_M:g} m from all roads: vehicles are around "
            f"({x:.0f}, {y:.0f}) m, and the roads from ({left:.0f}, {low:.0f}) to ({right:.0f}, {high:.0f}) m; "
            "check origin_deg and the projection"
        )
    return lanes


def lanes_in_box(roads: Roads, section: Map, low_m: Array, high_m: Array) -> RoadMap | None:
    """Return the lanes of `[map]` within its margin of the box from `low_m` to `high_m` (2,); None without any."""
    part = roads.within(low_m - section.margin_m, high_m + section.margin_m)
    if not len(part):
        return None
    lanes = part.lane_map(section.drive_on, section.sigma_m)
    point_m = lanes.point_m
    if section.aside_m:
        point_m = point_m + section.aside_m * lanes.normal
    if any(section.datum_m):
        point_m = point_m + np.array(section.datum_m)
    return replace(lanes, point_m=point_m, datum_sigma_m=section.datum_sigma_m)


def notes_of(path: Path, roads: Roads) -> tuple[str, ...]:
    """Return the line for the user about a map that was cut from a larger one."""
    clipped = roads.notes.get(CLIPPED, 0)
    return (f"{path}: {CLIPPED}: {clipped}",) if clipped else ()


def _far_share(lanes: RoadMap, position_m: Array) -> float:
    sample_m = position_m[:: max(1, len(position_m) // SAMPLES)]
    row, _, _ = lanes.near(sample_m, np.full(len(sample_m), np.nan), np.full(len(sample_m), FAR_M))
    return 1 - len(np.unique(row)) / len(sample_m)


def _extent(roads: Roads) -> tuple[Array, Array]:
    return roads.node_m.min(axis=0), roads.node_m.max(axis=0)
