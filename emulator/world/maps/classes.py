"""Classes of roads, by the names of OpenStreetMap, and what is assumed of a road whose map does not say more.

Lane widths and numbers of lanes are those of ordinary design guides; speeds are what people drive there when nothing
is in the way. `road` is a road of which nothing is known, `crossing` the inside of a crossing (SUMO's internal lanes).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vnet.roads.lanes import Array


@dataclass(frozen=True)
class RoadClass:
    """What is assumed of a road: metres, lanes in each direction, metres a second."""

    lane_width_m: float
    lanes: int
    speed_m_s: float


CLASSES = {
    "motorway": RoadClass(3.6, 2, 29.0),
    "trunk": RoadClass(3.6, 2, 24.0),
    "primary": RoadClass(3.5, 1, 17.0),
    "secondary": RoadClass(3.5, 1, 15.0),
    "tertiary": RoadClass(3.3, 1, 13.0),
    "unclassified": RoadClass(3.0, 1, 12.0),
    "residential": RoadClass(3.0, 1, 10.0),
    "living_street": RoadClass(3.0, 1, 5.0),
    "service": RoadClass(2.8, 1, 5.0),
    "motorway_link": RoadClass(3.6, 1, 17.0),
    "trunk_link": RoadClass(3.6, 1, 15.0),
    "primary_link": RoadClass(3.5, 1, 12.0),
    "secondary_link": RoadClass(3.5, 1, 12.0),
    "tertiary_link": RoadClass(3.3, 1, 11.0),
    "road": RoadClass(3.5, 1, 12.0),
    "crossing": RoadClass(3.2, 1, 8.0),
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
SPEED_M_S: Array = np.array([each.speed_m_s for each in CLASSES.values()])
