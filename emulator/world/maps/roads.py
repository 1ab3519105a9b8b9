"""Roads of a map: their classes, tags, and lanes.

The defaults are those of common design guides. `road` is a road of unknown class, `crossing` the inside of an
intersection (SUMO's internal lanes).

Lanes of a road lie side by side, with its centre line in the middle of all of them. The lanes in the road's own
direction are on the side on which people drive.
"""

from __future__ import annotations

import re
from bisect import bisect
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from emulator.world.projection import MAX_FROM_ORIGIN_M, CoordinateFrame, outlier_index, project
from vnet.errors import ScenarioError
from vnet.roads.road_map import RoadMap, touch_box
from vnet.types import Array

VEHICLE_WIDTH_M = 1.8
"""Width of every vehicle: that of a passenger car."""
MIN_LANE_WIDTH_M = 2.0
"""Least width of a lane in a map."""
MAX_LANE_WIDTH_M = 20.0
"""Greatest width of a lane in a map: some maps have one strip for all lanes of a road."""
MAX_LANES = 16
"""Most lanes of a road in one direction."""
ONE_WAY_CLASSES = {"motorway", "motorway_link"}
"""Classes whose ways are one-way unless tagged otherwise."""
_ROUND = {"roundabout", "circular"}
"""Values of `junction` whose ways are one-way unless tagged otherwise."""
_WIDTH = re.compile(r"(\d{1,4}(?:\.\d{1,9})?)\s*(m|ft|feet|'(?:\s*(\d{1,2})\")?)?")
MAX_POINTS = 5_000_000
"""Most points of a map: ten times those of a large city."""
MIN_HALF_WIDTH_M = 0.3
"""Least half-width left to a vehicle's centre, in a lane hardly wider than the vehicle."""
MIN_ONE_PLUS_COSINE = 0.5
"""Lower bound of 1 + cos(turn): at a turn sharper than 120° the corner of a lane is cut off."""
Ints = NDArray[np.intp]


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


LANE_WIDTH_M: Array = np.array([each.lane_width_m for each in CLASSES.values()])
"""Default lane widths, indexed by class."""
LANES = np.array([each.lanes for each in CLASSES.values()])
"""Default numbers of lanes in each direction, indexed by class."""


@dataclass(frozen=True)
class Street:
    """A way for cars. `lanes` are those in and against its direction.

    `reversed` is true if the direction is against the order of the way's points.
    """

    kind: int
    lanes: tuple[int, int]
    lane_width_m: float
    reversed: bool


def street(tags: Mapping[str, str]) -> Street | None:
    """Return the attributes of a way, or None if it is not for cars. Invalid values of tags are ignored."""
    name = tags.get("highway", "")
    kind = NUMBER.get(name)
    if kind is None or name == "crossing" or tags.get("area") == "yes" or _closed_to_cars(tags):
        return None
    lanes, is_reversed = _lanes(tags, name)
    lane_width_m = float(LANE_WIDTH_M[kind])
    beside = sum(lanes) + (_count(tags.get("lanes:both_ways")) if all(lanes) else 0)
    if MIN_LANE_WIDTH_M <= (width_m := _width_m(tags.get("width", "")) / beside) <= MAX_LANE_WIDTH_M:
        lane_width_m = width_m
    return Street(kind, lanes, lane_width_m, is_reversed)


def _width_m(text: str) -> float:
    """Return a width in metres, or in feet and inches as `26'` and `16'3"`; 0 if it is none."""
    if (found := _WIDTH.fullmatch(text)) is None:
        return 0.0
    return float(found[1]) if found[2] in (None, "m") else 0.3048 * (float(found[1]) + int(found[3] or 0) / 12)


def _closed_to_cars(tags: Mapping[str, str]) -> bool:
    for key in ("motorcar", "motor_vehicle", "vehicle", "access"):  # the most specific decides
        if key in tags:
            return tags[key] == "no"
    return False


def _lanes(tags: Mapping[str, str], name: str) -> tuple[tuple[int, int], bool]:
    """Return the lanes forward and backward, and true if forward is against the order of the way's points."""
    is_one_way = name in ONE_WAY_CLASSES or tags.get("junction") in _ROUND
    one_way = tags.get("oneway", "yes" if is_one_way else "no")
    usual, total = CLASSES[name].lanes, _count(tags.get("lanes"))
    if one_way in ("yes", "true", "1", "-1", "reverse"):
        is_reversed = one_way in ("-1", "reverse")
        total = total or _count(tags.get("lanes:backward" if is_reversed else "lanes:forward"))
        return (total or usual, 0), is_reversed
    forward, backward = _count(tags.get("lanes:forward")), _count(tags.get("lanes:backward"))
    total = max(0, total - _count(tags.get("lanes:both_ways")))  # a lane between both is for turns
    if total:
        forward = forward or (max(1, total - backward) if backward else max(1, (total + 1) // 2))
        backward = backward or max(1, total - forward)
    return (forward or usual, backward or usual), False


def _count(text: str | None) -> int:
    """Return a number of lanes, or 0 if the tag is missing or invalid."""
    return int(text) if text and re.fullmatch("[0-9]{1,3}", text) and 1 <= int(text) <= MAX_LANES else 0


@dataclass(frozen=True, eq=False)
class Roads:
    """R roads through N points.

    Road r runs through the points `node[first[r]:first[r + 1]]` of `node_m` (N, 2), at least two; roads are joined
    where they share a point. `name` (R,) are their names in the file; `kind` (R,) their classes, indices into
    `NAMES`; `forward` and `backward` (R,) the lanes in and against their direction; `lane_width_m` (R,); `one_way`
    (R,). `frame` is the projection, or None if it is unknown. `notes` counts the oddities of the file that were
    corrected.
    """

    node_m: Array
    node: Ints
    first: Ints
    name: tuple[str, ...]
    kind: Ints
    forward: Ints
    backward: Ints
    lane_width_m: Array
    one_way: NDArray[np.bool_]
    frame: CoordinateFrame | None = None
    notes: dict[str, int] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.kind)

    @cached_property
    def road_of(self) -> Ints:
        """Road index (P,) of each entry of `node`."""
        return np.repeat(np.arange(len(self)), np.diff(self.first))

    @cached_property
    def segment(self) -> Ints:
        """Indices (G,) of the entries of `node` from which a segment goes to the next entry."""
        return np.flatnonzero(self.road_of[:-1] == self.road_of[1:])

    @cached_property
    def segment_length_m(self) -> Array:
        """Lengths (G,) of the segments of the centre lines."""
        point_m = self.node_m[self.node]
        return np.asarray(np.hypot(*(point_m[self.segment + 1] - point_m[self.segment]).T))

    @cached_property
    def length_m(self) -> Array:
        """Lengths (R,) of the centre lines."""
        return np.asarray(
            np.bincount(self.road_of[self.segment], self.segment_length_m, minlength=len(self)), dtype=float
        )

    def within(self, low_m: Array, high_m: Array) -> Roads:
        """Return the segments that touch the box from `low_m` (2,) to `high_m` (2,), as roads without notes.

        A road that leaves the box and returns becomes several of the same name.
        """
        point_m = self.node_m[self.node]
        segment = self.segment[touch_box(point_m[self.segment], point_m[self.segment + 1], low_m, high_m)]
        begins, ends = np.zeros((2, len(self.node)), dtype=np.bool_)
        begins[segment], ends[segment + 1] = True, True
        kept = begins | ends
        used, node = np.unique(self.node[kept], return_inverse=True)
        first = np.flatnonzero(begins & ~ends)
        road = self.road_of[first]
        return replace(
            self,
            node_m=self.node_m[used],
            node=node,
            first=np.append(np.cumsum(kept)[first] - 1, len(node)),
            name=tuple(self.name[r] for r in road.tolist()),
            kind=self.kind[road],
            forward=self.forward[road],
            backward=self.backward[road],
            lane_width_m=self.lane_width_m[road],
            one_way=self.one_way[road],
            notes={},
        )

    def around(self, source: object, origin_deg: tuple[float, float] | None) -> Roads:
        """Return the same roads in metres around another origin, if one is given.

        Raise ScenarioError, naming `source`, if the projection is unknown, or the origin too far away.
        """
        if origin_deg is None:
            return self
        if self.frame is None:
            raise ScenarioError(f"{source}: states no projection of its metres; leave out the origin")
        frame, node_m = project(source, *self.frame.to_wgs84(self.node_m), origin_deg)
        return replace(self, node_m=node_m, frame=frame)

    # Lanes.

    def lane_map(self, drive_on: str = "right", sigma_m: float = 0.0) -> RoadMap:
        """Return the directed lanes of all roads; `drive_on` is `right` or `left`, `sigma_m` as in `RoadMap`."""
        road, offset_m, against = self._lanes(1.0 if drive_on == "right" else -1.0)
        counts = np.diff(self.first)[road]
        lane = np.repeat(np.arange(len(road)), counts)
        number = np.arange(len(lane)) - np.repeat(np.cumsum(counts) - counts, counts)
        entry = np.where(against[lane], self.first[road + 1][lane] - 1 - number, self.first[road][lane] + number)
        point_m = self.node_m[self.node[entry]] + offset_m[lane, None] * self._right[entry]
        step = point_m[1:] - point_m[:-1]
        ahead = self.node_m[self.node[entry[1:]]] - self.node_m[self.node[entry[:-1]]]
        # On the inside of a tight curve a lane's short segments point backwards: they are dropped.
        is_segment = (lane[1:] == lane[:-1]) & (np.einsum("ij,ij->i", step, ahead) > 0)
        segment = np.flatnonzero(is_segment)
        of_lane = lane[segment]
        of_road = road[of_lane]
        return RoadMap(
            point_m=point_m[segment],
            heading_rad=_heading_rad(step[segment]),
            length_m=np.hypot(step[segment, 0], step[segment, 1]),
            half_width_m=np.maximum((self.lane_width_m[of_road] - VEHICLE_WIDTH_M) / 2, MIN_HALF_WIDTH_M),
            kind=self.kind[of_road].astype(np.uint8),
            one_way=self.one_way[of_road],
            road=of_road.astype(np.int32),
            lane=of_lane.astype(np.int32),
            classes=NAMES,
            sigma_m=sigma_m,
        )

    def _lanes(self, side: float) -> tuple[Ints, Array, NDArray[np.bool_]]:
        """Return the road of each lane, its offset in m right of the centre line, and a mask of opposite lanes."""
        counts = self.forward + self.backward
        road = np.repeat(np.arange(len(self)), counts)
        number = np.arange(len(road)) - np.repeat(np.cumsum(counts) - counts, counts)
        against = number >= self.forward[road]
        from_divider = np.where(against, self.forward[road] - number - 0.5, number + 0.5)
        divider = (self.backward - self.forward)[road] / 2  # the line between the two directions
        return road, side * (divider + from_divider) * self.lane_width_m[road], against

    @cached_property
    def _right(self) -> Array:
        """Displacement (P, 2) of the point of each entry of `node` if its road is moved right by a metre."""
        point_m = self.node_m[self.node]
        step = point_m[1:] - point_m[:-1]
        length_m = np.hypot(step[:, 0], step[:, 1])
        right = np.column_stack([step[:, 1], -step[:, 0]]) / np.where(length_m > 0, length_m, 1)[:, None]
        right[self.road_of[:-1] != self.road_of[1:]] = 0.0
        after, before = np.vstack([right, [[0, 0]]]), np.vstack([[[0, 0]], right])
        both = after.any(axis=1) & before.any(axis=1)
        scale = np.where(both, np.maximum(1 + np.einsum("ij,ij->i", after, before), MIN_ONE_PLUS_COSINE), 1.0)
        return np.asarray((after + before) / scale[:, None])


def _heading_rad(step_m: Array) -> Array:
    """Return the directions (n,) of steps (n, 2), in [0, 2π)."""
    heading_rad = np.mod(np.arctan2(step_m[:, 1], step_m[:, 0]), 2 * np.pi)
    return np.where(heading_rad < 2 * np.pi, heading_rad, 0.0)  # mod returns 2π for the smallest negative angles


@dataclass
class _Row:
    """Attributes of a road while a file is read."""

    name: str
    kind: int
    forward: int
    backward: int
    lane_width_m: float
    one_way: bool


class RoadsBuilder:
    """Builder of `Roads` from a file; points with the same key, which the reader chooses, are the same point."""

    def __init__(self, source: object) -> None:
        self._source = source
        self._number: dict[object, int] = {}
        self._coordinates: list[tuple[float, float]] = []
        self._node: list[int] = []
        self._first = [0]
        self._rows: list[_Row] = []
        self.notes: dict[str, int] = {}

    def note(self, oddity: str) -> None:
        """Count an oddity of the file."""
        self.notes[oddity] = self.notes.get(oddity, 0) + 1

    def add(
        self,
        name: str,
        points: Iterable[tuple[object, tuple[float, float]]],
        kind: int,
        lanes: tuple[int, int],
        lane_width_m: float,
        one_way: bool | None = None,
    ) -> None:
        """Add a road through points, given as (key, coordinates); `lanes` are those forward and backward.

        Equal successive points become one. Raise ScenarioError if there are more points than `MAX_POINTS`.
        """
        line: list[tuple[object, tuple[float, float]]] = []
        for point in points:
            if line and line[-1][0] == point[0]:
                self.note("points twice in a row")
            else:
                line.append(point)
        if len(line) < 2:
            self.note("roads without length")
            return
        for key, coordinates in line:
            number = self._number.setdefault(key, len(self._coordinates))
            if number == len(self._coordinates):
                self._coordinates.append(coordinates)
            self._node.append(number)
        if len(self._node) > MAX_POINTS:
            raise ScenarioError(f"{self._source}: {name}: more than {MAX_POINTS} points; cut out a part first")
        self._first.append(len(self._node))
        if one_way is None:
            one_way = 0 in lanes
        self._rows.append(_Row(name, kind, *lanes, lane_width_m, one_way))

    @property
    def is_empty(self) -> bool:
        """True as long as there are no roads."""
        return not self._rows

    def coordinates(self) -> Array:
        """Return the coordinates (N, 2) of the points so far."""
        return np.array(self._coordinates, dtype=float).reshape(-1, 2)

    def build_from_degrees(self, origin_deg: tuple[float, float] | None) -> Roads:
        """Return the roads, whose coordinates are longitude and latitude. Raise ScenarioError as `project` does."""
        if not self._rows:
            raise ScenarioError(f"{self._source}: no roads that vehicles may use")
        lon, lat = self.coordinates().T
        frame, node_m = project(self._source, lat, lon, origin_deg, self._name_of)
        return self.build(node_m, frame)

    def _name_of(self, point: int) -> str:
        """Return the name of a road that runs through a point."""
        return self._rows[bisect(self._first, self._node.index(point)) - 1].name

    def build(self, node_m: Array, frame: CoordinateFrame | None) -> Roads:
        """Return the roads, with the points at `node_m` (N, 2). Raise ScenarioError as `check_extent` does."""
        check_extent(self._source, node_m, len(self._rows), self._name_of)
        return Roads(
            node_m=node_m,
            node=np.array(self._node, dtype=np.intp),
            first=np.array(self._first, dtype=np.intp),
            name=tuple(row.name for row in self._rows),
            kind=_column([row.kind for row in self._rows]),
            forward=_column([row.forward for row in self._rows]),
            backward=_column([row.backward for row in self._rows]),
            lane_width_m=np.array([row.lane_width_m for row in self._rows]),
            one_way=np.array([row.one_way for row in self._rows], dtype=np.bool_),
            frame=frame,
            notes=self.notes,
        )


def _column(values: Sequence[int]) -> Ints:
    return np.array(values, dtype=np.intp)


def check_extent(source: object, node_m: Array, roads: int, name: Callable[[int], str]) -> None:
    """Raise ScenarioError if there are no roads, or points (N, 2) lie too far apart to be one map.

    `name` returns a point's name in the file.
    """
    if not roads:
        raise ScenarioError(f"{source}: no roads that vehicles may use")
    if not np.isfinite(node_m).all():
        raise ScenarioError(f"{source}: some positions are outside its projection")
    span_m = float(np.ptp(node_m, axis=0).max())
    if span_m > 2 * MAX_FROM_ORIGIN_M:
        raise ScenarioError(
            f"{source}: {name(outlier_index(node_m))}: the map spans {span_m / 1000:.0f} km, and at most "
            f"{2 * MAX_FROM_ORIGIN_M / 1000:.0f} are allowed; are all points in the same projection?"
        )
