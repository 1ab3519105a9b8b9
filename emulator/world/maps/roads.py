"""Roads: centre lines between shared points, and what is known of each; all readers end here.

From roads to lanes: a road's lanes lie side by side, its centre line in the middle of all of them, those in its own
direction on the side on which people drive.
"""

from __future__ import annotations

from bisect import bisect
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from emulator.world.maps.classes import NAMES, VEHICLE_WIDTH_M
from emulator.world.projection import WIDEST_M, Frame, most_off, project
from vnet.errors import ScenarioError
from vnet.roads.road_map import RoadMap, touch_box
from vnet.types import Array

MOST_POINTS = 5_000_000
"""A map has no more points: a large city has a tenth of that."""
NARROWEST_SPACE_M = 0.3
"""Half-width left to a vehicle's centre in a lane that is hardly wider than the vehicle."""
_SHARPEST = 0.5
"""At a bend sharper than 120° a lane's corner is cut: 1 + cos of the turn is no less."""

Ints = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Roads:
    """R roads through N points.

    Road r runs through the points `node[first[r]:first[r + 1]]` of `node_m` (N, 2), two at least; roads meet where
    they share a point. `name` (R,) is what the file calls them; `kind` (R,) their class, an index into `NAMES`;
    `forward`, `backward` (R,) lanes in and against their direction; `lane_width_m` (R,); `one_way` (R,). `frame`
    says where on the earth this is, if anybody knows. `notes` counts what was odd about the file and put right.
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
    frame: Frame | None = None
    notes: dict[str, int] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.kind)

    @cached_property
    def road_of(self) -> Ints:
        """Which road each entry of `node` belongs to, (P,)."""
        return np.repeat(np.arange(len(self)), np.diff(self.first))

    @cached_property
    def segment(self) -> Ints:
        """Entries of `node` from which a segment goes to the next entry, (G,)."""
        return np.flatnonzero(self.road_of[:-1] == self.road_of[1:])

    @cached_property
    def segment_length_m(self) -> Array:
        """Lengths (G,) of the segments of the centre lines."""
        place = self.node_m[self.node]
        return np.asarray(np.hypot(*(place[self.segment + 1] - place[self.segment]).T))

    @cached_property
    def length_m(self) -> Array:
        """Lengths (R,) of the centre lines."""
        return np.asarray(
            np.bincount(self.road_of[self.segment], self.segment_length_m, minlength=len(self)), dtype=float
        )

    def within(self, low_m: Array, high_m: Array) -> Roads:
        """What of the roads touches the box from `low_m` (2,) to `high_m` (2,), in whole segments.

        A road that leaves the box and comes back becomes several of the same name. Notes are about the whole.
        """
        place = self.node_m[self.node]
        segment = self.segment[touch_box(place[self.segment], place[self.segment + 1], low_m, high_m)]
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
        """The same roads in metres around another origin, if one is given.

        Raises ScenarioError, naming `source`, where nobody knows where on the earth they are, or too far from it.
        """
        if origin_deg is None:
            return self
        if self.frame is None:
            raise ScenarioError(f"{source}: does not say where on the earth its metres are; leave out the origin")
        frame, node_m = project(source, *self.frame.to_wgs84(self.node_m), origin_deg)
        return replace(self, node_m=node_m, frame=frame)

    # Lanes.

    def lane_map(self, drive_on: str = "right", sigma_m: float = 0.0) -> RoadMap:
        """The directed lanes of all roads; `drive_on` is `right` or `left`, `sigma_m` as in `RoadMap`."""
        road, aside_m, against = self._lanes(1.0 if drive_on == "right" else -1.0)
        counts = np.diff(self.first)[road]
        lane = np.repeat(np.arange(len(road)), counts)
        number = np.arange(len(lane)) - np.repeat(np.cumsum(counts) - counts, counts)
        entry = np.where(against[lane], self.first[road + 1][lane] - 1 - number, self.first[road][lane] + number)
        place = self.node_m[self.node[entry]] + aside_m[lane, None] * self._aside[entry]
        step = place[1:] - place[:-1]
        ahead = self.node_m[self.node[entry[1:]]] - self.node_m[self.node[entry[:-1]]]
        # Inside a tight bend a lane's short segments turn round: they are no road.
        goes_on = (lane[1:] == lane[:-1]) & (np.einsum("ij,ij->i", step, ahead) > 0)
        segment = np.flatnonzero(goes_on)
        of_lane = lane[segment]
        of_road = road[of_lane]
        return RoadMap(
            place[segment],
            _heading_rad(step[segment]),
            np.hypot(step[segment, 0], step[segment, 1]),
            np.maximum((self.lane_width_m[of_road] - VEHICLE_WIDTH_M) / 2, NARROWEST_SPACE_M),
            self.kind[of_road].astype(np.uint8),
            self.one_way[of_road],
            of_road.astype(np.int32),
            of_lane.astype(np.int32),
            NAMES,
            sigma_m,
        )

    def _lanes(self, side: float) -> tuple[Ints, Array, NDArray[np.bool_]]:
        """All lanes: their road, how far right of its centre line as it goes, and which go against it."""
        counts = self.forward + self.backward
        road = np.repeat(np.arange(len(self)), counts)
        number = np.arange(len(road)) - np.repeat(np.cumsum(counts) - counts, counts)
        against = number >= self.forward[road]
        from_between = np.where(against, self.forward[road] - number - 0.5, number + 0.5)
        between = (self.backward - self.forward)[road] / 2  # the two directions meet there
        return road, side * (between + from_between) * self.lane_width_m[road], against

    @cached_property
    def _aside(self) -> Array:
        """Where the point of each entry of `node` goes when its road is moved right by a metre, (P, 2)."""
        place = self.node_m[self.node]
        step = place[1:] - place[:-1]
        length_m = np.hypot(step[:, 0], step[:, 1])
        right = np.column_stack([step[:, 1], -step[:, 0]]) / np.where(length_m > 0, length_m, 1)[:, None]
        right[self.road_of[:-1] != self.road_of[1:]] = 0.0
        after, before = np.vstack([right, [[0, 0]]]), np.vstack([[[0, 0]], right])
        both = after.any(axis=1) & before.any(axis=1)
        scale = np.where(both, np.maximum(1 + np.einsum("ij,ij->i", after, before), _SHARPEST), 1.0)
        return np.asarray((after + before) / scale[:, None])


def _heading_rad(step_m: Array) -> Array:
    """Directions (n,) of steps (n, 2), in [0, 2π)."""
    heading_rad = np.mod(np.arctan2(step_m[:, 1], step_m[:, 0]), 2 * np.pi)
    return np.where(heading_rad < 2 * np.pi, heading_rad, 0.0)  # of the smallest negative angles mod makes 2π


@dataclass
class _Row:
    """What is known of a road while a file is read."""

    name: str
    kind: int
    forward: int
    backward: int
    lane_width_m: float
    one_way: bool


class RoadsBuilder:
    """Collects roads as a reader comes by them; points are told apart by a key of the reader's choice."""

    def __init__(self, source: object) -> None:
        self._source = source
        self._number: dict[object, int] = {}
        self._place: list[tuple[float, float]] = []
        self._node: list[int] = []
        self._first = [0]
        self._rows: list[_Row] = []
        self.notes: dict[str, int] = {}

    def note(self, what: str) -> None:
        """Count something odd."""
        self.notes[what] = self.notes.get(what, 0) + 1

    def add(
        self,
        name: str,
        points: Iterable[tuple[object, tuple[float, float]]],
        kind: int,
        lanes: tuple[int, int],
        lane_width_m: float,
        one_way: bool | None = None,
    ) -> None:
        """A road through points, each with its key; `lanes` are forward and backward. Two equal points are one.

        Raises ScenarioError when there are more points than `MOST_POINTS`.
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
        for key, place in line:
            number = self._number.setdefault(key, len(self._place))
            if number == len(self._place):
                self._place.append(place)
            self._node.append(number)
        if len(self._node) > MOST_POINTS:
            raise ScenarioError(f"{self._source}: {name}: more than {MOST_POINTS} points; cut out a part first")
        self._first.append(len(self._node))
        if one_way is None:
            one_way = 0 in lanes
        self._rows.append(_Row(name, kind, *lanes, lane_width_m, one_way))

    def places(self) -> Array:
        """The coordinates of the points so far, (N, 2)."""
        return np.array(self._place, dtype=float).reshape(-1, 2)

    def build_from_degrees(self, origin_deg: tuple[float, float] | None) -> Roads:
        """The roads, whose points are longitudes and latitudes. Raises ScenarioError as `project` does."""
        if not self._rows:
            raise ScenarioError(f"{self._source}: no roads that vehicles may use")
        lon, lat = self.places().T
        frame, node_m = project(self._source, lat, lon, origin_deg, self._name_of)
        return self.build(node_m, frame)

    def _name_of(self, point: int) -> str:
        """The name of a road that runs through a point."""
        return self._rows[bisect(self._first, self._node.index(point)) - 1].name

    def build(self, node_m: Array, frame: Frame | None) -> Roads:
        """The roads, with the points' places in metres (N, 2). Raises ScenarioError as `check_extent` does."""
        check_extent(self._source, node_m, len(self._rows), self._name_of)
        return Roads(
            node_m,
            np.array(self._node, dtype=np.intp),
            np.array(self._first, dtype=np.intp),
            tuple(row.name for row in self._rows),
            _column([row.kind for row in self._rows]),
            _column([row.forward for row in self._rows]),
            _column([row.backward for row in self._rows]),
            np.array([row.lane_width_m for row in self._rows]),
            np.array([row.one_way for row in self._rows], dtype=np.bool_),
            frame,
            self.notes,
        )


def _column(values: Sequence[int]) -> Ints:
    return np.array(values, dtype=np.intp)


def check_extent(source: object, node_m: Array, roads: int, name: Callable[[int], str]) -> None:
    """Raises ScenarioError where there are no roads, or where points (N, 2) lie too far apart to be one map.

    `name` says what a point is in the file.
    """
    if not roads:
        raise ScenarioError(f"{source}: no roads that vehicles may use")
    if not np.isfinite(node_m).all():
        raise ScenarioError(f"{source}: positions that its projection does not reach")
    span_m = float(np.ptp(node_m, axis=0).max())
    if span_m > 2 * WIDEST_M:
        raise ScenarioError(
            f"{source}: {name(most_off(node_m))}: the map spans {span_m / 1000:.0f} km, and at most "
            f"{2 * WIDEST_M / 1000:.0f} are allowed; are all points in the same projection?"
        )
