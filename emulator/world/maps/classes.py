"""Classes of roads, by the names of OpenStreetMap, and what is assumed of a road whose map does not say more.

Lane widths and numbers of lanes are those of ordinary design guides. `road` is a road of
which nothing is known, `crossing` the inside of a crossing (SUMO's internal lanes).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vnet.types import Array


@dataclass(frozen=True)
class RoadClass:
    """What is assumed of a road: the width of a lane, and lanes in each direction."""

    lane_width_m: float
    lanes: int


CLASSES = {
    "motorway": RoadClass(3.6, 2),
    "trunk": RoadClass(3.6, 2),
    "primary": RoadClass(3.5, 1),
    "secondary": RoadClass(3.5, 1),
    "tertiary": RoadClass(3.3, 1),
    "unclassified": RoadClass(3.0, 1),
    "residential": RoadClass(3.0, 1),
    "living_street": RoadClass(3.0, 1),
    "service": RoadClass(2.8, 1),
    "motorway_link": RoadClass(3.6, 1),
    "trunk_link": RoadClass(3.6, 1),
    "primary_link": RoadClass(3.5, 1),
    "secondary_link": RoadClass(3.5, 1),
    "tertiary_link": RoadClass(3.3, 1),
    "road": RoadClass(3.5, 1),
    "crossing": RoadClass(3.2, 1),
}
NAMES = tuple(CLASSES)
NUMBER = {name: number for number, name in enumerate(NAMES)}
UNKNOWN = NUMBER["road"]

VEHICLE_WIDTH_M = 1.8
NARROWEST_M, WIDEST_M = 2.0, 20.0
"""Lanes are no narrower and no wider; a strip that stands for all lanes of a road may be wide."""
MOST_LANES = 16

LANE_WIDTH_M: Array = np.array([each.lane_width_m for each in CLASSES.values()])
LANES = np.array([each.lanes for each in CLASSES.values()])
