"""The digital map of a city: directed lanes, cut into straight segments, and found through a grid.

Positions are metres in a local east-north frame; headings are radians counter-clockwise from east, in [0, 2π).
A map does not tell where vehicles are. Programs get the part of it around the scenario's area.

A k-d tree (scipy's) finds segments as well, and takes eight times as long for the boxes of 1000 vehicles in a city:
it makes a Python list for each.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vnet.roads.lanes import LaneMap
from vnet.types import Array

Ints = NDArray[np.intp]
INDEX_STEP_M = 40.0
"""Distance (m) between two points of the index on a segment: a square or two."""
MAX_INDEXED = 1_000_000
"""Number of points in the index besides one a segment: 64 MB. It is coarser for a map that would need more."""
SQUARE_M = 25.0
"""Side (m) of the index's squares: about the distance within which lanes are sought."""
HEADING_TOLERANCE_RAD = 0.35
"""Difference (rad) of the headings of a vehicle and its lane: 20°, more than in a lane change."""
FARTHEST_M = 1e8
"""Largest coordinate and length (m) in a map that comes in a message: twice the circumference of the Earth."""
TAG = "roads"
"""Tag of a map's plain form."""
MAX_CLASSES = 255
"""Number of road classes in a map: their index is one byte."""
MAX_CLASS_LENGTH = 64
"""Characters of a class's name."""
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
"""Number format of each column in a message."""
_DEVIATIONS = ("sigma_m", "datum_sigma_m")
"""Numbers of a whole map."""


class PointGrid:
    """Points (P, 2) in squares of `side_m`; coordinates are within 10⁹ m.

    order: (P,), the indices of the points, sorted by square.
    """

    def __init__(self, point_m: Array, side_m: float) -> None:
        self._side_m = side_m
        self._low_m = point_m.min(axis=0) if len(point_m) else np.zeros(2)
        cell = self._cell(point_m).astype(np.intp)
        self._columns, self._rows = (cell.max(axis=0, initial=-1) + 1).tolist()
        number = cell[:, 1] * self._columns + cell[:, 0]
        self.order: Ints = np.argsort(number, kind="stable")
        self._number = number[self.order]

    def _cell(self, position_m: Array) -> Array:
        """Return columns and rows (n, 2) as whole floats, also outside the grid."""
        return np.asarray(np.floor((position_m - self._low_m) / self._side_m))

    def find(self, low_m: Array, high_m: Array) -> tuple[Ints, Ints]:
        """Find the points in the squares that boxes from `low_m` to `high_m` (M, 2) touch: all inside, and some
        beside.

        Returns pairs of a box and an index into `order`, by box. A box that is not a number holds none.
        """
        last = np.array([self._columns, self._rows]) - 1
        first = np.nan_to_num(np.maximum(self._cell(low_m), 0), nan=1.0, posinf=np.inf)
        final = np.nan_to_num(np.minimum(self._cell(high_m), last), nan=-1.0, neginf=-np.inf)
        empty = (first > final).any(axis=1)
        first[empty], final[empty] = 0.0, -1.0
        first, final = first.astype(np.intp), final.astype(np.intp)
        box, row = ranges(np.arange(len(first)), first[:, 1], final[:, 1] + 1)
        # The squares of a row, one beside the other, are one range of points.
        start = np.searchsorted(self._number, row * self._columns + first[:, 0][box], side="left")
        end = np.searchsorted(self._number, row * self._columns + final[:, 0][box], side="right")
        return ranges(box, start, end)


def ranges(label: Ints, start: Ints, end: Ints) -> tuple[Ints, Ints]:
    """Return all integers from `start` (n,) to `end` (n,), each after the `label` (n,) of its range."""
    count = np.maximum(end - start, 0)
    until = np.cumsum(count)
    total = int(until[-1]) if len(until) else 0
    return np.repeat(label, count), np.arange(total) + np.repeat(start - until + count, count)


@dataclass(frozen=True, eq=False)
class RoadMap:
    """All lanes of an area as S segments.

    `point_m` (S, 2) is where a segment begins, `heading_rad` (S,) the direction of travel, `length_m` (S,) > 0;
    `half_width_m` (S,) is the largest distance of a vehicle's centre from the lane's centre line. `kind` (S,) is
    the road's class, an index into `classes`; `one_way` (S,) is true if the road has no lane the other way; `road`
    and `lane` (S,) number roads and lanes, each lane of a road by a number of its own. `sigma_m` is the standard
    deviation of true lanes from the map's, and `datum_sigma_m` that of a shift of the whole map, in each axis.
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
    datum_sigma_m: float = 0.0

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
        step_m = max(INDEX_STEP_M, float(self.length_m.sum()) / MAX_INDEXED)
        pieces = np.maximum(1, np.ceil(self.length_m / step_m)).astype(np.intp)
        segment = np.repeat(np.arange(len(self)), pieces)
        number = np.arange(len(segment)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
        along_m = (number + 0.5) / pieces[segment] * self.length_m[segment]
        grid = PointGrid(self.point_m[segment] + along_m[:, None] * self.direction[segment], SQUARE_M)
        segment = segment[grid.order]
        east_m, north_m = self.point_m[segment].T.copy()
        to_east, to_north = self.direction[segment].T.copy()
        return _Index(
            grid=grid,
            half_m=step_m / 2,
            segment=segment,
            east_m=east_m,
            north_m=north_m,
            to_east=to_east,
            to_north=to_north,
            length_m=self.length_m[segment],
        )

    def near(
        self, position_m: Array, heading_rad: Array, reach_m: Array
    ) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
        """Find all segments within `reach_m` (M,) of positions (M, 2) that fit their headings (M,), NaN if unknown.

        Returns pairs of a row and a segment, by row and then by distance, and the distances in metres. A position
        that is NaN has none.
        """
        index = self._index
        margin_m = (reach_m + index.half_m)[:, None]
        row, point = index.grid.find(position_m - margin_m, position_m + margin_m)
        turn = index.to_east[point] * np.cos(heading_rad)[row] + index.to_north[point] * np.sin(heading_rad)[row]
        fits = np.flatnonzero(~(turn < np.cos(HEADING_TOLERANCE_RAD)))  # NaN fits
        row, point = row[fits], point[fits]
        distance_m = index.distance_m(position_m[:, 0][row], position_m[:, 1][row], point)
        within = np.flatnonzero(distance_m <= reach_m[row])
        row, segment, distance_m = row[within], index.segment[point[within]], distance_m[within]
        order = np.lexsort((segment, distance_m, row))
        row, segment, distance_m = row[order], segment[order], distance_m[order]
        new = np.ones(len(row), dtype=np.bool_)  # a long segment is found by several of its points
        new[1:] = (row[1:] != row[:-1]) | (segment[1:] != segment[:-1])
        return row[new], segment[new], distance_m[new]

    def within(self, low_m: Array, high_m: Array) -> RoadMap:
        """Return the part of the map that touches the box from `low_m` to `high_m` (2,), with the same numbers."""
        end_m = self.point_m + self.length_m[:, None] * self.direction
        kept = touch_box(self.point_m, end_m, low_m, high_m)
        columns: dict[str, Any] = {name: getattr(self, name)[kept] for name in _COLUMNS}
        return replace(self, **columns)

    # Messages.

    def to_wire(self) -> dict[str, Any]:
        """Return a plain form for a message; `from_wire` restores it bit by bit."""
        columns = {name: getattr(self, name).astype(kind).tobytes() for name, kind in _COLUMNS.items()}
        deviations = {name: getattr(self, name) for name in _DEVIATIONS}
        return {"tag": TAG, "classes": list(self.classes), **deviations, **columns}

    @classmethod
    def from_wire(cls, data: object) -> RoadMap:
        """Restore a map from `to_wire`; its arrays cannot be written to. Raises ValueError on anything else."""
        if not isinstance(data, dict) or data.keys() != {"tag", *(field.name for field in fields(cls))}:
            raise ValueError("no road map")
        classes = data["classes"]
        if data["tag"] != TAG or not isinstance(classes, list) or len(classes) > MAX_CLASSES:
            raise ValueError("a road map without its tag or classes")
        if not all(isinstance(name, str) and len(name) <= MAX_CLASS_LENGTH for name in classes):
            raise ValueError("a road map's classes are no names")
        for name in _DEVIATIONS:
            if type(data[name]) is not float or not 0 <= data[name] < np.inf:
                raise ValueError(f"{name} = {data[name]!r:.50}: a positive number is needed")
        columns: dict[str, Any] = {name: _column(name, data[name]) for name in _COLUMNS}
        columns["point_m"] = columns["point_m"].reshape(-1, 2)
        roads = cls(**columns, classes=tuple(classes), **{name: data[name] for name in _DEVIATIONS})
        roads._check()
        return roads

    def _check(self) -> None:
        """Raise ValueError if a column is not what the class says."""
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
    """Points on the segments (P,) in the order of a grid, each with its segment's number and geometry.

    Points near each other on the map are near each other in these arrays. A segment's end is at most `half_m` from
    one of its points.
    """

    grid: PointGrid
    half_m: float
    segment: NDArray[np.intp]
    east_m: Array
    north_m: Array
    to_east: Array
    to_north: Array
    length_m: Array

    def distance_m(self, east_m: Array, north_m: Array, point: NDArray[np.intp]) -> Array:
        """Return the distances (n,) of positions (n,) from the whole segments of the points `point` (n,)."""
        east_m, north_m = east_m - self.east_m[point], north_m - self.north_m[point]
        to_east, to_north = self.to_east[point], self.to_north[point]
        along_m = np.minimum(np.maximum(east_m * to_east + north_m * to_north, 0.0), self.length_m[point])
        return np.asarray(np.hypot(east_m - along_m * to_east, north_m - along_m * to_north))


def _column(name: str, data: object) -> NDArray[Any]:
    kind = np.dtype(_COLUMNS[name])
    if not isinstance(data, bytes) or len(data) % (kind.itemsize * (2 if name == "point_m" else 1)):
        raise ValueError(f"{name} of a road map: {kind} as bytes are needed")
    return np.frombuffer(data, dtype=kind)


def touch_box(start_m: Array, end_m: Array, low_m: Array, high_m: Array) -> NDArray[np.bool_]:
    """Find segments from `start_m` to `end_m` (n, 2) that touch the box from `low_m` to `high_m` (2,): a mask."""
    middle_m, half_m = (np.asarray(low_m) + high_m) / 2, (np.asarray(high_m) - low_m) / 2
    centre_m, reach_m = (start_m + end_m) / 2 - middle_m, (end_m - start_m) / 2
    # Two convex shapes are apart only if they are along an axis of the box, or across the segment.
    along_axes = (np.abs(centre_m) <= half_m + np.abs(reach_m)).all(axis=1)
    across = np.abs(centre_m[:, 0] * reach_m[:, 1] - centre_m[:, 1] * reach_m[:, 0])
    return np.asarray(
        along_axes & (across <= half_m[0] * np.abs(reach_m[:, 1]) + half_m[1] * np.abs(reach_m[:, 0]))
    )
