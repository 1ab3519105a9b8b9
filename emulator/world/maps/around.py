"""The part of a map that programs are given: the lanes around where vehicles drive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from emulator.scenario.scenario import Map
from emulator.world.maps.files import read_roads
from emulator.world.maps.roads import Roads
from vnet.errors import ScenarioError
from vnet.roads.road_map import RoadMap
from vnet.types import Array

FAR_M = 100.0
"""Who is further from all roads is off the map."""
SAMPLES = 5000


def read_lanes(section: Map, course_m: Array, origin_deg: tuple[float, float] | None) -> RoadMap:
    """The lanes of `[map]` around the course (K, N, 2) of all vehicles; `origin_deg` is where its metres start.

    Raises ScenarioError where the file cannot be read, or most of the course is nowhere near its roads.
    """
    roads = read_roads(section.path, section.origin_deg or origin_deg)
    return lanes_around(roads, section, course_m)


def lanes_around(roads: Roads, section: Map, course_m: Array) -> RoadMap:
    """As `read_lanes`, of roads that have been read."""
    place_m = course_m[np.isfinite(course_m[..., 0])]
    low_m, high_m = place_m.min(axis=0) - section.margin_m, place_m.max(axis=0) + section.margin_m
    part = roads.within(low_m, high_m)
    lanes = part.lane_map(section.drive_on, section.sigma_m) if len(part) else None
    if lanes is not None and section.aside_m:
        lanes = replace(lanes, point_m=lanes.point_m + section.aside_m * lanes.normal)
    if lanes is None or _far_share(lanes, place_m) > 0.5:
        (x, y), (left, low), (right, high) = np.median(place_m, axis=0), *_extent(roads)
        raise ScenarioError(
            f"{section.path}: most of what vehicles drive is over {FAR_M:g} m from all its roads: they are around "
            f"({x:.0f}, {y:.0f}) m, and the roads from ({left:.0f}, {low:.0f}) to ({right:.0f}, {high:.0f}) m: "
            "is another origin_deg, or another projection meant?"
        )
    return lanes


def _far_share(lanes: RoadMap, place_m: Array) -> float:
    some = place_m[:: max(1, len(place_m) // SAMPLES)]
    row, _, _ = lanes.near(some, np.full(len(some), np.nan), np.full(len(some), FAR_M))
    return 1 - len(np.unique(row)) / len(some)


def _extent(roads: Roads) -> tuple[Array, Array]:
    return roads.node_m.min(axis=0), roads.node_m.max(axis=0)
