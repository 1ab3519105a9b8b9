"""The digital map of a city as vehicles know it: directed lanes, cut into straight segments.

Positions are metres in a local east-north frame; headings are radians counter-clockwise from east, in [0, 2π).
A map says nothing about who drives where. Programs get the part of it around the scenario's area.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vnet.roads.grid import Grid
from vnet.roads.lanes import LaneMap
from vnet.types import Array

INDEX_STEP_M = 40.0
"""The index holds a point for at least every so many metres of a segment."""
MOST_INDEXED = 1_000_000
"""About so many points besides one a segment are in the index; it is coarser where more would be needed."""
SQUARE_M = 25.0
"""The side of the index's squares."""
HEADING_TOLERANCE_RAD = 0.35
"""A lane fits a vehicle whose heading differs by no more than this."""
FARTHEST_M = 1e8
"""No place is further from the origin, and no segment longer, in a map that comes in a message."""
TAG = "roads"
"""What a map's plain form says it is."""
MOST_CLASSES = 255
LONGEST_CLASS = 64
_COLUMNS = {
    "point_m": "<f8",
    "heading_rad": "<f8",
    "length_m": "<f8",
    "half_width_m": "<f8",
    "kind": "|u1",
    "one_way": "|b1",
    "road": "<i4",
    "lane": "<i4",
}
"""How each column is written into a message."""


@dataclass(frozen=True, eq=False)
class RoadMap:
    """All lanes of an area as S segments.

    `point_m` (S, 2) is where a segment begins, `heading_rad` (S,) the direction of travel, `length_m` (S,) > 0;
    `half_width_m` (S,) is how far a vehicle's centre may be from the lane's centre line. `kind` (S,) is the road's
    class, an index into `classes`; `one_way` (S,) whether the road has no lane the other way; `road` and `lane`
    (S,) number roads and lanes, each lane of a road by a number of its own. `sigma_m` is how far, as a
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
    def _index(self) -> _Index:
        step_m = max(INDEX_STEP_M, float(self.length_m.sum()) / MOST_INDEXED)
        pieces = np.maximum(1, np.ceil(self.length_m / step_m)).astype(np.intp)
        whose = np.repeat(np.arange(len(self)), pieces)
        number = np.arange(len(whose)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
        along_m = (number + 0.5) / pieces[whose] * self.length_m[whose]
        grid = Grid(self.point_m[whose] + along_m[:, None] * self.direction[whose], SQUARE_M)
        whose = whose[grid.order]
        east_m, north_m = self.point_m[whose].T.copy()
        to_east, to_north = self.direction[whose].T.copy()
        return _Index(grid, step_m / 2, whose, east_m, north_m, to_east, to_north, self.length_m[whose])

    def near(
        self, position_m: Array, heading_rad: Array, reach_m: Array
    ) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
        """All segments within `reach_m` (M,) of positions (M, 2) that fit their headings (M,), NaN if unknown.

        Returns pairs of a row and a segment, by row and then by distance, and the distances in metres. A position
        that is NaN has none.
        """
        index = self._index
        margin_m = (reach_m + index.half_m)[:, None]
        row, place = index.grid.find(position_m - margin_m, position_m + margin_m)
        turn = index.to_east[place] * np.cos(heading_rad)[row] + index.to_north[place] * np.sin(heading_rad)[row]
        fits = np.flatnonzero(~(turn < np.cos(HEADING_TOLERANCE_RAD)))  # NaN fits
        row, place = row[fits], place[fits]
        distance_m = index.distance_m(position_m[:, 0][row], position_m[:, 1][row], place)
        within = np.flatnonzero(distance_m <= reach_m[row])
        row, segment, distance_m = row[within], index.whose[place[within]], distance_m[within]
        order = np.lexsort((segment, distance_m, row))
        row, segment, distance_m = row[order], segment[order], distance_m[order]
        new = np.ones(len(row), dtype=np.bool_)  # a long segment is found by several of its points
        new[1:] = (row[1:] != row[:-1]) | (segment[1:] != segment[:-1])
        return row[new], segment[new], distance_m[new]

    def within(self, low_m: Array, high_m: Array) -> RoadMap:
        """The segments that touch the box from `low_m` to `high_m` (2,); roads and lanes keep their numbers."""
        end_m = self.point_m + self.length_m[:, None] * self.direction
        kept = touch_box(self.point_m, end_m, low_m, high_m)
        columns: dict[str, Any] = {name: getattr(self, name)[kept] for name in _COLUMNS}
        return RoadMap(**columns, classes=self.classes, sigma_m=self.sigma_m)

    # Messages.

    def to_wire(self) -> dict[str, Any]:
        """A plain form for a message; `from_wire` restores it bit by bit."""
        columns = {name: getattr(self, name).astype(kind).tobytes() for name, kind in _COLUMNS.items()}
        return {"tag": TAG, "classes": list(self.classes), "sigma_m": self.sigma_m, **columns}

    @classmethod
    def from_wire(cls, data: object) -> RoadMap:
        """Restore a map from `to_wire`; its arrays cannot be written to. Raises ValueError on anything else."""
        if not isinstance(data, dict) or data.keys() != {"tag", *(field.name for field in fields(cls))}:
            raise ValueError("no road map")
        classes, sigma_m = data["classes"], data["sigma_m"]
        if data["tag"] != TAG or not isinstance(classes, list) or len(classes) > MOST_CLASSES:
            raise ValueError("a road map without its tag or classes")
        if not all(isinstance(name, str) and len(name) <= LONGEST_CLASS for name in classes):
            raise ValueError("a road map's classes are no names")
        if type(sigma_m) is not float or not 0 <= sigma_m < np.inf:
            raise ValueError(f"sigma_m = {sigma_m!r:.50}: a positive number is needed")
        columns: dict[str, Any] = {name: _column(name, data[name]) for name in _COLUMNS}
        columns["point_m"] = columns["point_m"].reshape(-1, 2)
        roads = cls(**columns, classes=tuple(classes), sigma_m=sigma_m)
        roads._check()
        return roads

    def _check(self) -> None:
        """Raises ValueError where a column is not what the class says."""
        if any(len(getattr(self, name)) != len(self) for name in _COLUMNS):
            raise ValueError("columns of a road map differ in length")
        right = {
            "point_m": (np.abs(self.point_m) <= FARTHEST_M).all(),
            "heading_rad": ((self.heading_rad >= 0) & (self.heading_rad < 2 * np.pi)).all(),
            "length_m": ((self.length_m > 0) & (self.length_m <= FARTHEST_M)).all(),
            "half_width_m": ((self.half_width_m >= 0) & (self.half_width_m < np.inf)).all(),
            "kind": (self.kind < len(self.classes)).all(),
            "one_way": (self.one_way.view(np.uint8) <= 1).all(),
            "road": (self.road >= 0).all(),
            "lane": (self.lane >= 0).all(),
        }
        for name, is_right in right.items():
            if not is_right:
                raise ValueError(f"{name} of a road map: a value that it cannot have")


def map_from_wire(data: Any) -> LaneMap | RoadMap:
    """Restore whichever map it is. Raises ValueError or TypeError on anything else."""
    return RoadMap.from_wire(data) if isinstance(data, dict) else LaneMap.from_wire(data)


@dataclass(frozen=True)
class _Index:
    """Points on the segments in the order of a grid (P,): whose each is, and again what is known of that segment.

    What is near each other on the map is near each other in these arrays; a segment's end is at most `half_m` from
    one of its points.
    """

    grid: Grid
    half_m: float
    whose: NDArray[np.intp]
    east_m: Array
    north_m: Array
    to_east: Array
    to_north: Array
    length_m: Array

    def distance_m(self, east_m: Array, north_m: Array, place: NDArray[np.intp]) -> Array:
        """How far positions (n,) are from the whole segments at `place` (n,)."""
        east_m, north_m = east_m - self.east_m[place], north_m - self.north_m[place]
        to_east, to_north = self.to_east[place], self.to_north[place]
        along_m = np.minimum(np.maximum(east_m * to_east + north_m * to_north, 0.0), self.length_m[place])
        return np.asarray(np.hypot(east_m - along_m * to_east, north_m - along_m * to_north))


def _column(name: str, data: object) -> NDArray[Any]:
    kind = np.dtype(_COLUMNS[name])
    if not isinstance(data, bytes) or len(data) % (kind.itemsize * (2 if name == "point_m" else 1)):
        raise ValueError(f"{name} of a road map: {kind} as bytes are needed")
    return np.frombuffer(data, dtype=kind)


def touch_box(start_m: Array, end_m: Array, low_m: Array, high_m: Array) -> NDArray[np.bool_]:
    """Which segments from `start_m` to `end_m` (n, 2) have a point in the box from `low_m` to `high_m` (2,)."""
    middle_m, half_m = (np.asarray(low_m) + high_m) / 2, (np.asarray(high_m) - low_m) / 2
    centre_m, reach_m = (start_m + end_m) / 2 - middle_m, (end_m - start_m) / 2
    # Two convex shapes are apart only if they are along an axis of the box, or across the segment.
    along_axes = (np.abs(centre_m) <= half_m + np.abs(reach_m)).all(axis=1)
    across = np.abs(centre_m[:, 0] * reach_m[:, 1] - centre_m[:, 1] * reach_m[:, 0])
    return np.asarray(
        along_axes & (across <= half_m[0] * np.abs(reach_m[:, 1]) + half_m[1] * np.abs(reach_m[:, 0]))
    )
