"""The digital map of a city as vehicles know it: directed lanes, cut into straight segments.

Positions are metres in a local east-north frame; headings are radians counter-clockwise from east, in [0, 2π).
A map says nothing about who drives where. Programs get the part of it around the scenario's area.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property


import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vnet.roads.lanes import Array

INDEX_STEP_M = 40.0
"""The index holds a point for at least every so many metres of a segment."""
HEADING_TOLERANCE_RAD = 0.35
"""A lane fits a vehicle whose heading differs by no more than this."""
_TAG = "roads"
_COLUMNS = ("point_m", "heading_rad", "length_m", "half_width_m", "kind", "one_way", "road", "lane")
_KINDS = ("<f8", "<f8", "<f8", "<f8", "|u1", "|b1", "<i4", "<i4")


@dataclass(frozen=True, eq=False)
class RoadMap:
    """All lanes of an area as S segments.

    `point_m` (S, 2) is where a segment begins, `heading_rad` (S,) the direction of travel, `length_m` (S,) > 0;
    `half_width_m` (S,) is how far a vehicle's centre may be from the lane's centre line. `kind` (S,) is the road's
    class, an index into `classes`; `one_way` (S,) whether the road has no lane the other way; `road` and `lane`
    (S,) number roads and lanes from 0, each lane of a road by a number of its own. `sigma_m` is how far, as a
    deviation, true lanes stray from the map's.
    """

    point_m: Array
    heading_rad: Array
    length_m: Array
    half_width_m: Array
    kind: NDArray[np.uint8]
    one_way: NDArray[np.bool_]
    road: NDArray[np.int32]
    lane: NDArray[np.int32]
    classes: tuple[str, ...]
    sigma_m: float = 0.0

    def __len__(self) -> int:
        return len(self.heading_rad)

    @cached_property
    def direction(self) -> Array:
        """Unit vectors of travel (S, 2)."""
        return np.column_stack([np.cos(self.heading_rad), np.sin(self.heading_rad)])

    @cached_property
    def normal(self) -> Array:
        """Unit normals (S, 2), to the right of the direction of travel: (sin θ, -cos θ)."""
        return np.column_stack([np.sin(self.heading_rad), -np.cos(self.heading_rad)])

    @cached_property
    def offset_m(self) -> Array:
        """n·p of each centre line (S,), so that the signed offset of a point q is n·q - offset."""
        return np.asarray(np.einsum("ij,ij->i", self.normal, self.point_m))

    @cached_property
    def _index(self) -> tuple[cKDTree, NDArray[np.intp]]:
        """A tree of points on the segments, and whose they are."""
        pieces = np.maximum(1, np.ceil(self.length_m / INDEX_STEP_M)).astype(np.intp)
        whose = np.repeat(np.arange(len(self)), pieces)
        number = np.arange(len(whose)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
        along_m = (number + 0.5) / pieces[whose] * self.length_m[whose]
        return cKDTree(self.point_m[whose] + along_m[:, None] * self.direction[whose]), whose

    def near(
        self, position_m: Array, heading_rad: Array, reach_m: Array
    ) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
        """All segments within `reach_m` (M,) of positions (M, 2) that fit their headings (M,), NaN if unknown.

        Returns pairs of a row and a segment, by row and then by distance, and the distances in metres.
        """
        tree, whose = self._index
        radius_m = reach_m + INDEX_STEP_M / 2
        rows = tree.query_ball_point(position_m, radius_m, return_sorted=False)
        count = np.fromiter(map(len, rows), dtype=np.intp, count=len(rows))
        row = np.repeat(np.arange(len(rows)), count)
        segment = whose[np.fromiter((i for found in rows for i in found), dtype=np.intp, count=int(count.sum()))]
        turn = np.abs(np.mod(self.heading_rad[segment] - heading_rad[row] + np.pi, 2 * np.pi) - np.pi)
        fits = ~(turn > HEADING_TOLERANCE_RAD)
        row, segment = row[fits], segment[fits]
        distance_m = self.distance_m(position_m[row], segment)
        order = np.lexsort((segment, distance_m, row))
        order = order[distance_m[order] <= reach_m[row[order]]]
        return row[order], segment[order], distance_m[order]
