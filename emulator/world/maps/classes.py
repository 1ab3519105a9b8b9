"""Road classes, by their names in OpenStreetMap, with the lane widths and numbers of lanes assumed by default.

The defaults are those of common design guides. `road` is a road of unknown class, `crossing` the inside of an
intersection (SUMO's internal lanes).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vnet.types import Array


@dataclass(frozen=True)
class RoadClass:
    """Defaults of a road class: width of a lane, and lanes in each direction."""

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
"""Names of the classes, indexed by their numbers."""
NUMBER = {name: number for number, name in enumerate(NAMES)}
"""Number of a class by its name."""
UNKNOWN = NUMBER["road"]
"""Number of the class of a road whose class is unknown."""

VEHICLE_WIDTH_M = 1.8
"""Width of every vehicle: that of a passenger car."""
MIN_LANE_WIDTH_M = 2.0
"""Least width of a lane in a map."""
MAX_LANE_WIDTH_M = 20.0
"""Greatest width of a lane in a map: some maps have one strip for all lanes of a road."""
MAX_LANES = 16
"""Most lanes of a road in one direction."""

LANE_WIDTH_M: Array = np.array([each.lane_width_m for each in CLASSES.values()])
"""Default lane widths, indexed by class."""
LANES = np.array([each.lanes for each in CLASSES.values()])
"""Default numbers of lanes in each direction, indexed by class."""
