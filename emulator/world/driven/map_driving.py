"""Driving on a map: lanes and junctions as links, paths through them, routes, and where vehicles start."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from typing import NamedTuple

import numpy as np

from emulator.scenario.network import Driven
from emulator.scenario.random_streams import stream
from emulator.scenario.scenario import Scenario
from emulator.world.driven.road import Start, check_room, one_each, queue_m
from emulator.world.maps.files import lanes_in_box, notes_of, roads_of
from emulator.world.maps.roads import MIN_ONE_PLUS_COSINE, NUMBER, Ints, Roads
from emulator.world.neighbours import links_within
from emulator.world.projection import CoordinateFrame
from vnet.errors import ScenarioError, did_you_mean, first_names
from vnet.roads.road_map import RoadMap, ranges
from vnet.types import Array, Mask
from vnet.units import NS_PER_S

ROOM_M = 4.0
"""Distance from the edge of the widest road at a junction to the place at which turns begin."""
CORNER_M = 8.0
"""Greatest distance of the ends of an arc from the corner that it rounds."""
TAPER_M = 15.0
"""Distance from a point at which lanes begin or end to the place from which on vehicles move aside."""
HAIRPIN_RAD = 2.4
"""Turns above this, 137°, are hairpins: lanes of the two roads are too close for an arc between them."""
_STRAIGHT_RAD = 1e-6
"""Turns below this are none."""
_SHORTEST_M = 0.01
"""Links that are not longer than this are not driven on."""
SHARE = 0.45
"""Greatest share of a link, or of a straight part of it, that a turn at one of its ends takes."""
TURN_POINTS = 13
"""Points of the path of a turn."""
ARC_POINTS = 7
"""Points of the arc that rounds a corner: of a right angle one every 15°."""
_SAME_M = 1e-6
"""Points closer than this are the same."""
APART_M = 100.0
"""Distance between two paths on the common scale: more than a vehicle's length, and what it drives in a period."""
_NEAR = 3
"""Most paths between two vehicles that overlap."""
AGAINST = "-"
"""Sign before the name of a road on which a route goes against the road's direction."""
KEY = "network.driven.routes"
_INSIDE = 3
"""Most links inside an intersection between two roads that a route names."""
TRIES = 200
"""Places that are drawn for a vehicle before there is no room for it."""
STREAM = "driven routes"
"""Random stream of a vehicle's place at the start, and of its route."""
Route = tuple[int, ...]
Names = tuple[str, ...]


class RoadLinks:
    """The links of `roads`, two for each piece of a road: number 2p in the road's direction, 2p + 1 against it.

    Pieces end where a road ends or meets another. Arrays (L,): `start` and `end` are points, `road` the road,
    `lanes` the lanes in the link's direction, and `is_open` is true where vehicles that are `wide_m` may drive.
    """

    def __init__(self, roads: Roads, wide_m: float) -> None:
        self.roads = roads
        at = np.flatnonzero(_is_stop(roads)[roads.node])
        same = roads.road_of[at[:-1]] == roads.road_of[at[1:]]
        self._first, self._last = at[:-1][same], at[1:][same]
        piece_road = roads.road_of[self._first]
        one, other = roads.node[self._first], roads.node[self._last]
        self.start, self.end = np.column_stack([one, other]).ravel(), np.column_stack([other, one]).ravel()
        self.road: Ints = np.repeat(piece_road, 2)
        self.lanes: Ints = np.column_stack([roads.forward[piece_road], roads.backward[piece_road]]).ravel()
        is_wide = roads.lane_width_m[self.road] >= wide_m
        self.is_open: Mask = (self.lanes > 0) & is_wide & (self.length_m > _SHORTEST_M)
        self._drivable: dict[int, list[int]] = {}
        self._by_start = np.argsort(self.start, kind="stable")
        self._first_of = np.searchsorted(self.start[self._by_start], np.arange(len(roads.node_m) + 1))

    def __len__(self) -> int:
        return len(self.start)

    @cached_property
    def length_m(self) -> Array:
        """Lengths (L,) of the centre lines."""
        point_m = self.roads.node_m[self.roads.node]
        step_m = np.concatenate([[0.0], np.hypot(*np.diff(point_m, axis=0).T)])
        sum_m = np.cumsum(step_m)
        return np.repeat(sum_m[self._last] - sum_m[self._first], 2)

    @cached_property
    def is_crossing(self) -> Mask:
        """Mask (L,) of the links inside intersections."""
        return np.asarray(self.roads.kind[self.road] == NUMBER["crossing"])

    def line_m(self, link: int) -> Array:
        """Return the points (n, 2) of a link's centre line, in its direction."""
        first, last = self._first[link // 2], self._last[link // 2]
        line_m = self.roads.node_m[self.roads.node[first : last + 1]]
        return line_m[::-1] if link % 2 else line_m

    def offset_m(self, link: int, side: float) -> float:
        """Return the distance of the rightmost lane's centre to the right of the road's; `side` 1: people drive
        there, -1: left.
        """
        road, lanes = self.road[link], int(self.lanes[link])
        both = int(self.roads.forward[road] + self.roads.backward[road])
        return float(self.roads.lane_width_m[road]) * (both / 2 - 0.5 if side > 0 else lanes - 0.5 - both / 2)

    def starting(self, point: int) -> Ints:
        """Return the links that start at a point, also those that are not open."""
        return self._by_start[self._first_of[point] : self._first_of[point + 1]]

    def exits(self, link: int) -> Ints:
        """Return the links on which a vehicle may go on at the end of another, in ascending order: no U-turn."""
        found = self.starting(int(self.end[link]))
        return np.sort(found[self.is_open[found] & (found != link ^ 1)])

    @cached_property
    def is_endless(self) -> Mask:
        """Mask (L,) of the links from which a vehicle can go on for ever without a U-turn."""
        alive, before = self.is_open, -1
        while alive.sum() != before:
            before = alive.sum()
            starting = np.bincount(self.start[alive], minlength=len(self._first_of))
            back = alive.reshape(-1, 2)[:, ::-1].ravel()
            alive = alive & (starting[self.end] > back)
        return alive

    def drivable_exits(self, link: int) -> list[int]:
        """Return the exits of a link that lead to no dead end and are no hairpins, as far as there are any."""
        if link not in self._drivable:
            found = self.exits(link).tolist()
            found = [each for each in found if self.is_endless[each]] or found
            wide = [each for each in found if abs(self.turn_rad(link, each)) <= HAIRPIN_RAD]
            self._drivable[link] = wide or found
        return self._drivable[link]

    def turn_rad(self, link: int, other: int) -> float:
        """Return the turn, in [-π, π), from the end of a link to the start of another."""
        before, after = self.line_m(link)[-2:], self.line_m(other)[:2]
        (east, north), (then_east, then_north) = before[1] - before[0], after[1] - after[0]
        turn = np.arctan2(then_north, then_east) - np.arctan2(north, east)
        return float(np.mod(turn + np.pi, 2 * np.pi) - np.pi)

    def cut_m(self, point: int) -> float:
        """Return how far from a point links end, because vehicles turn or move aside there."""
        links = self.starting(point).tolist()
        if len(links) == 1:
            return 0.0
        if len(links) > 2:
            road = self.road[links]
            lanes = self.roads.forward[road] + self.roads.backward[road]
            return float((lanes * self.roads.lane_width_m[road]).max()) / 2 + ROOM_M
        one, other = links
        if self._layout(one ^ 1) != self._layout(other) or self._layout(other ^ 1) != self._layout(one):
            return TAPER_M
        return CORNER_M if abs(self.turn_rad(one ^ 1, other)) > _STRAIGHT_RAD else 0.0

    def _layout(self, link: int) -> tuple[int, int, float]:
        road = self.road[link]
        both = int(self.roads.forward[road] + self.roads.backward[road])
        return int(self.lanes[link]), both, float(self.roads.lane_width_m[road])


def _is_stop(roads: Roads) -> Mask:
    """Return the mask of the points at which roads end or meet."""
    entry = roads.segment
    count = len(roads.node_m)
    one, other = roads.node[entry], roads.node[entry + 1]
    steps = np.divmod(np.unique(np.minimum(one, other) * count + np.maximum(one, other)), count)
    is_stop = np.bincount(np.concatenate(steps), minlength=count) != 2
    is_stop[roads.node[roads.first[:-1]]] = True
    is_stop[roads.node[roads.first[1:] - 1]] = True
    return np.asarray(is_stop)


@dataclass(frozen=True, eq=False)
class Path:
    """Centre line (n, 2) of the rightmost lane of a link or a turn, with its headings (n,), which are unwrapped.

    `lanes` and `width_m` are the number of lanes and their width at its beginning and at its end.
    """

    point_m: Array
    heading_rad: Array
    lanes: tuple[int, int]
    width_m: tuple[float, float]

    @cached_property
    def along_m(self) -> Array:
        """Distances (n,) of the points from the first, along the line."""
        return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(self.point_m, axis=0).T))])

    @property
    def length_m(self) -> float:
        """Length of the line."""
        return float(self.along_m[-1])

    def at(self, along_m: float, left_m: float) -> Array:
        """Return the position (2,) at a distance from the beginning, to the left of the line."""
        east_m, north_m, heading_rad = (
            np.interp(along_m, self.along_m, values) for values in (*self.point_m.T, self.heading_rad)
        )
        return np.array([east_m - left_m * np.sin(heading_rad), north_m + left_m * np.cos(heading_rad)])


class Paths:
    """The paths of links and turns on `links`, made and numbered as they are asked for.

    `side` is 1 where people drive on the right, else -1; vehicles drive `aside_m` to the right of the lanes.
    """

    def __init__(self, links: RoadLinks, side: float, aside_m: float) -> None:
        self._links, self._side, self._aside_m = links, side, aside_m
        self.paths: list[Path] = []
        self._of_link: dict[int, int] = {}
        self._of_turn: dict[tuple[int, int], int | None] = {}

    def of_link(self, link: int) -> int:
        """Return the number of a link's path."""
        if link not in self._of_link:
            self._of_link[link] = self._add(self._make(link))
        return self._of_link[link]

    def of_turn(self, link: int, other: int) -> int | None:
        """Return the number of the path from the end of a link to another; None if they join without any."""
        if (link, other) not in self._of_turn:
            one, then = self.paths[self.of_link(link)], self.paths[self.of_link(other)]
            near = np.hypot(*(then.point_m[0] - one.point_m[-1])) < _SAME_M
            self._of_turn[link, other] = None if near else self._add(_turn(one, then))
        return self._of_turn[link, other]

    def _add(self, path: Path) -> int:
        self.paths.append(path)
        return len(self.paths) - 1

    def _make(self, link: int) -> Path:
        links = self._links
        line_m = links.line_m(link)
        most_m = SHARE * float(links.length_m[link])
        ends_m = [min(links.cut_m(int(point)), most_m) for point in (links.start[link], links.end[link])]
        lane_m = offset_line(cut_line(line_m, *ends_m), links.offset_m(link, self._side) + self._aside_m)
        lanes, width_m = int(links.lanes[link]), float(links.roads.lane_width_m[links.road[link]])
        return Path(*rounded(lane_m), (lanes, lanes), (width_m, width_m))


def cut_line(line_m: Array, begin_m: float, end_m: float) -> Array:
    """Return a line (n, 2) without so much of its beginning and of its end."""
    along_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line_m, axis=0).T))])
    last_m = along_m[-1] - end_m
    is_new = np.diff(along_m, prepend=-1.0) > _SAME_M
    inner = np.flatnonzero(is_new & (along_m > begin_m + _SAME_M) & (along_m < last_m - _SAME_M))
    ends = np.column_stack([np.interp([begin_m, last_m], along_m, axis) for axis in line_m.T])
    return np.concatenate([ends[:1], line_m[inner], ends[1:]])


def offset_line(line_m: Array, right_m: float) -> Array:
    """Return a line (n, 2) moved to the right, without parts that this would reverse on the inside of a curve."""
    if not right_m:
        return line_m
    step = np.diff(line_m, axis=0)
    right = np.column_stack([step[:, 1], -step[:, 0]]) / np.hypot(*step.T)[:, None]
    inner = right[1:] + right[:-1]
    scale = np.maximum(1 + np.einsum("ij,ij->i", right[1:], right[:-1]), MIN_ONE_PLUS_COSINE)
    moved_m = line_m + right_m * np.concatenate([right[:1], inner / scale[:, None], right[-1:]])
    if (np.einsum("ij,ij->i", np.diff(moved_m, axis=0), step) > 0).all():
        return np.asarray(moved_m)
    kept = [0]
    for k in range(1, len(line_m)):
        if float((moved_m[k] - moved_m[kept[-1]]) @ step[k - 1]) > 0:
            kept.append(k)
    if len(kept) == 1:
        kept.append(len(line_m) - 1)
    return np.asarray(moved_m[kept])


def rounded(line_m: Array) -> tuple[Array, Array]:
    """Return the points (n, 2) and the unwrapped headings (n,) of a line whose corners are arcs."""
    step = np.diff(line_m, axis=0)
    length_m = np.hypot(*step.T)
    heading = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    ahead = step / length_m[:, None]
    corner = np.flatnonzero(np.abs(np.diff(heading)) > _SAME_M)
    before, after, point_m = ahead[corner, None], ahead[corner + 1, None], line_m[corner + 1, None]
    cut_m = np.minimum(CORNER_M, SHARE * np.minimum(length_m[corner], length_m[corner + 1]))[:, None, None]
    # Quadratic Bézier curves with the corners as their control points.
    t = np.linspace(0, 1, ARC_POINTS)[:, None]
    arc_m = point_m + cut_m * (t**2 * after - (1 - t) ** 2 * before)
    tangent = (1 - t) * before + t * after
    start_rad = heading[corner, None]
    arc_rad = start_rad + _wrapped(np.arctan2(tangent[..., 1], tangent[..., 0]) - start_rad)
    points_m = np.concatenate([line_m[:1], arc_m.reshape(-1, 2), line_m[-1:]])
    return points_m, np.concatenate([heading[:1], arc_rad.ravel(), heading[-1:]])


def _turn(one: Path, then: Path) -> Path:
    """Return the path from the end of one to the beginning of another: a cubic Bézier curve, nearly an arc."""
    start_m, end_m = one.point_m[-1], then.point_m[0]
    start_rad, end_rad = float(one.heading_rad[-1]), float(then.heading_rad[0])
    turn = float(_wrapped(np.array(end_rad - start_rad)))
    # With this reach the curve of a symmetric turn is an arc of a circle, to a thousandth of its radius.
    reach_m = float(np.hypot(*(end_m - start_m))) / (3 * np.cos(turn / 4) ** 2)
    control_m = np.array(
        [
            start_m,
            start_m + reach_m * np.array([np.cos(start_rad), np.sin(start_rad)]),
            end_m - reach_m * np.array([np.cos(end_rad), np.sin(end_rad)]),
            end_m,
        ]
    )
    tangent = (_SLOPE[..., None] * np.diff(control_m, axis=0)).sum(axis=1)
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    lanes, width_m = (one.lanes[1], then.lanes[0]), (one.width_m[1], then.width_m[0])
    return Path((_WEIGHT[..., None] * control_m).sum(axis=1), heading, lanes, width_m)


def _cubic(t: Array) -> tuple[Array, Array]:
    """Return the weights of the four control points of a cubic Bézier curve, and of their steps in its slope."""
    weight = np.column_stack([(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3])
    return weight, np.column_stack([(1 - t) ** 2, 2 * t * (1 - t), t**2])


_WEIGHT, _SLOPE = _cubic(np.linspace(0, 1, TURN_POINTS))


def _wrapped(angle: Array) -> Array:
    """Return angles in [-π, π)."""
    return np.asarray(np.mod(angle + np.pi, 2 * np.pi) - np.pi)


class MapRoads:
    """Roads of a map: `paths`, and the `routes` of the vehicles, whose entries are numbers of paths.

    A vehicle's `along_m` counts from the beginning of its route along the rightmost lane. All paths have a place on
    one scale, so that vehicles on the same path are compared wherever they come from. Lanes have a nominal width of
    `lane_width_m`. A vehicle is in the way of those behind it on a path until it has left it with its whole length,
    `length_m`, wherever it turns.
    """

    has_crossings = True

    def __init__(
        self, paths: Sequence[Path], routes: Sequence[Sequence[int]], lane_width_m: float, length_m: float
    ) -> None:
        self._nominal_m, self._length_m = lane_width_m, length_m
        # Points of all paths, one path after another.
        count = [len(path.point_m) for path in paths]
        self._last_point: Ints = np.cumsum(count) - 1
        self._first_point: Ints = self._last_point + 1 - count
        self._path_m = np.array([path.length_m for path in paths])
        self._base_m = np.cumsum(self._path_m + APART_M) - self._path_m
        self._at_m = np.concatenate([base + path.along_m for base, path in zip(self._base_m, paths, strict=True)])
        self._point_m = np.concatenate([path.point_m for path in paths])
        self._heading_rad = np.concatenate([path.heading_rad for path in paths])
        step_m = np.maximum(np.diff(self._at_m), np.finfo(float).tiny)
        self._ahead = np.diff(self._point_m, axis=0) / step_m[:, None]
        self._bend = np.diff(self._heading_rad) / step_m
        self._lanes: Ints = np.array([path.lanes for path in paths], dtype=np.intp)
        self._width_m = np.array([path.width_m for path in paths])
        # Entries of all routes, one route after another.
        entries = [len(route) for route in routes]
        self._last_entry: Ints = np.cumsum(entries) - 1
        self._first_entry: Ints = self._last_entry + 1 - entries
        self._path: Ints = np.concatenate([np.asarray(route, dtype=np.intp) for route in routes])
        self._route: Ints = np.repeat(np.arange(len(routes)), entries)
        ends_m = [np.cumsum(self._path_m[list(route)]) for route in routes]
        self._start_m = np.concatenate([np.concatenate([[0.0], end_m[:-1]]) for end_m in ends_m])
        self.end_m: Array = np.array([end_m[-1] for end_m in ends_m])
        self._stride_m = float(self.end_m.max()) + APART_M
        self._scale_m = self._route * self._stride_m + self._start_m

    def _entry(self, number: Ints, along_m: Array) -> Ints:
        """Return the entries of these vehicles' routes at `along_m`; the last behind the end."""
        found = np.searchsorted(self._scale_m, number * self._stride_m + along_m, side="right") - 1
        return np.clip(found, self._first_entry[number], self._last_entry[number])

    def _locate(self, along_m: Array) -> tuple[Ints, Array]:
        """Return the paths (N,) of vehicles, and their positions on the common scale in m."""
        entry = self._entry(np.arange(len(along_m)), along_m)
        path = self._path[entry]
        return path, self._base_m[path] + (along_m - self._start_m[entry])

    def place(self, along_m: Array, left_m: Array) -> tuple[Array, Array]:
        """Return positions (N, 2) in m and headings (N,) in [0, 2π)."""
        path, at_m = self._locate(along_m)
        point = np.searchsorted(self._at_m, at_m, side="right") - 1
        point = np.clip(point, self._first_point[path], self._last_point[path] - 1)
        beyond_m = at_m - self._at_m[point]
        most_m = self._at_m[point + 1] - self._at_m[point]
        heading_rad = self._heading_rad[point] + np.clip(beyond_m, 0.0, most_m) * self._bend[point]
        left = np.column_stack([-np.sin(heading_rad), np.cos(heading_rad)])
        position_m = self._point_m[point] + beyond_m[:, None] * self._ahead[point] + left_m[:, None] * left
        return position_m, np.mod(heading_rad, 2 * np.pi)

    def lane_count(self, along_m: Array) -> Ints:
        """Return the number (N,) of lanes at these positions: in a turn that of the road with more."""
        path, _ = self._locate(along_m)
        return np.asarray(self._lanes[path].max(axis=1))

    def left_m(self, along_m: Array, nominal_m: Array) -> Array:
        """Return distances (N,) from the rightmost lane. In a turn they change to those of the next road."""
        path, at_m = self._locate(along_m)
        lane = nominal_m / self._nominal_m
        done = np.clip((at_m - self._base_m[path]) / self._path_m[path], 0.0, 1.0)
        done = done**2 * (3 - 2 * done)
        sides_m = np.minimum(lane[:, None], self._lanes[path] - 1) * self._width_m[path]
        return np.asarray(sides_m[:, 0] + done * (sides_m[:, 1] - sides_m[:, 0]))

    def rank(self, along_m: Array) -> Array:
        """Return the positions (N,) on the common scale."""
        return self._locate(along_m)[1]

    def area_m(self, furthest_m: Array) -> Array:
        """Return the corners (2, 2) of a box around all paths, and the lanes beside them."""
        beside_m = float((self._lanes * self._width_m).max()) + self._length_m
        return np.array([self._point_m.min(axis=0) - beside_m, self._point_m.max(axis=0) + beside_m])

    # Who is behind whom.

    def ahead(self, along_m: Array, left_m: Array, width_m: float, range_m: float) -> tuple[Ints, Array]:
        """Return the number (N,) of the vehicle ahead of each and the way to it, as `Road.ahead` does."""
        rear, front, way_m = self._following(along_m, range_m)
        meets = np.abs(left_m[front] - left_m[rear]) < width_m
        rear, front, way_m = rear[meets], front[meets], way_m[meets]
        rear, nearest = np.unique(rear, return_index=True)
        found, ways_m = np.full(len(along_m), -1, dtype=np.intp), np.full(len(along_m), np.nan)
        found[rear], ways_m[rear] = front[nearest], way_m[nearest]
        return found, ways_m

    def distance_m(self, along_m: Array, rear: int, front: int) -> float:
        """Return the way from one vehicle to another that is near; negative to one that is behind."""
        own, other = self._entry(np.array([rear, front]), along_m[[rear, front]]).tolist()
        ways_m = [
            self._start_m[here] - along_m[rear] + along_m[front] - self._start_m[there]
            for here in range(
                max(own - _NEAR, self._first_entry[rear]), min(own + _NEAR, self._last_entry[rear]) + 1
            )
            for there in range(max(other - _NEAR, self._first_entry[front]), other + 1)
            if self._path[here] == self._path[there]
        ]
        return float(min(ways_m, key=abs))

    def crossing_pairs(self, along_m: Array, position_m: Array, reach_m: float) -> tuple[Ints, Ints]:
        """Return the pairs (n,), (n,) of vehicles within `reach_m` of which neither is behind the other."""
        near, beyond_m = links_within(position_m, reach_m), along_m - self.end_m
        once = (near.sender < near.receiver) & (np.maximum(beyond_m[near.sender], beyond_m[near.receiver]) <= 0)
        one, other = near.sender[once], near.receiver[once]
        if not len(one):
            return one, other
        count = len(along_m)
        rear, front, _ = self._following(along_m, 2 * reach_m)  # in a curve the way is longer than the distance
        in_line = np.minimum(rear, front) * count + np.maximum(rear, front)
        apart = ~np.isin(one * count + other, in_line)
        return one[apart], other[apart]

    def _following(self, along_m: Array, range_m: float) -> tuple[Ints, Ints, Array]:
        """Return all pairs, rear (n,) and front (n,), at most `range_m` apart on the way of the rear one.

        The third array is that distance in m. The nearest come first.
        """
        number = np.flatnonzero(along_m < self.end_m + APART_M / 2)  # none that is absent: NaN
        own = self._entry(number, along_m[number])
        vehicle, path, there_m = self._occupants(number, along_m[number], own)
        at_m = self._base_m[path] + there_m
        order = np.lexsort((vehicle, at_m))
        vehicle, there_m, at_m = vehicle[order], there_m[order], at_m[order]
        # Each vehicle with each entry of its route in range.
        last = self._entry(number, along_m[number] + range_m)
        rear, entry = ranges(np.arange(len(number)), own, last + 1)
        base_m, here_m = self._base_m[self._path[entry]], along_m[number[rear]] - self._start_m[entry]
        is_own = entry == own[rear]
        from_m = base_m + np.where(is_own, here_m, -APART_M / 4)
        until_m = base_m + np.minimum(here_m + range_m, self._path_m[self._path[entry]] + APART_M / 2)
        pair, place = ranges(
            np.arange(len(entry)), np.searchsorted(at_m, from_m), np.searchsorted(at_m, until_m, side="right")
        )
        behind, front = number[rear[pair]], vehicle[place]
        way_m = there_m[place] - here_m[pair]
        # Of two side by side the one with the higher number is ahead.
        later = (front != behind) & ((way_m > 0) | (front > behind))
        behind, front, way_m = behind[later], front[later], way_m[later]
        order = np.lexsort((front, way_m, behind))
        return behind[order], front[order], way_m[order]

    def _occupants(self, number: Ints, along_m: Array, entry: Ints) -> tuple[Ints, Ints, Array]:
        """Return vehicles, the paths on which they are or which they are leaving, and their positions on these."""
        vehicles, paths, places = [number], [self._path[entry]], [along_m - self._start_m[entry]]
        leaving = np.arange(len(number))
        before = entry
        while len(leaving):
            before = before - 1
            is_tail = (before >= self._first_entry[number[leaving]]) & (
                along_m[leaving] - self._start_m[before + 1] < self._length_m
            )
            leaving, before = leaving[is_tail], before[is_tail]
            vehicles.append(number[leaving])
            paths.append(self._path[before])
            places.append(along_m[leaving] - self._start_m[before])
        return np.concatenate(vehicles), np.concatenate(paths), np.concatenate(places)


def elements_of(paths: Paths, links: Iterator[int], least_m: float) -> tuple[int, ...]:
    """Return the paths of a route along `links`, with the turns between, until they are at least `least_m` long."""
    found, length_m, before = list[int](), 0.0, -1
    for link in links:
        turn = paths.of_turn(before, link) if before >= 0 else None
        added = [paths.of_link(link)] if turn is None else [turn, paths.of_link(link)]
        found += added
        length_m += sum(paths.paths[each].length_m for each in added)
        if length_m >= least_m:
            break
        before = link
    return tuple(found)


def drawn_links(links: RoadLinks, rng: np.random.Generator, first: int) -> Iterator[int]:
    """Yield the links of a route that begins with `first`, and takes any exit of each junction but a U-turn.

    Dead ends and hairpins are taken only where there is no other exit. A route ends where there is none at all.
    """
    link = first
    while True:
        yield link
        if not (exits := links.drivable_exits(link)):
            return
        link = exits[int(rng.integers(len(exits)))]


class NamedRoutes:
    """Routes that name their roads; `source` is the map. `-NAME` is the road NAME against its direction."""

    def __init__(self, source: object, links: RoadLinks) -> None:
        self._source, self._links = source, links
        self._of_name: dict[str, list[int]] = {}
        for link, road in enumerate(links.road.tolist()):
            name = links.roads.name[road]
            self._of_name.setdefault(f"{AGAINST}{name}" if link % 2 else name, []).append(link)

    def links_of(self, names: Sequence[str]) -> Iterator[int]:
        """Return the links of a route: each road to where it meets the next, the last to its end, if it has one.

        Raise ScenarioError for roads that are not on the map, or do not meet.
        """
        roads = [self._open_links(name) for name in names]
        found = [self._beginning(names[0], roads[0])]
        for name, road, next_name, next_road in zip(names, roads, names[1:], roads[1:], strict=False):
            seen = {found[-1]}
            while not (way := self._way_to(found[-1], next_road)):
                link = self._onward(found[-1], road)
                if link is None or link in seen:
                    raise ScenarioError(f"{KEY}: {next_name!r} does not begin or go on where {name!r} leads to")
                seen.add(link)
                found.append(link)
            found += way
        return chain(found, self._rest(found[-1], roads[-1]))

    def _rest(self, link: int, road: set[int]) -> Iterator[int]:
        while (after := self._onward(link, road)) is not None:
            yield after
            link = after

    def _onward(self, link: int, road: set[int]) -> int | None:
        """Return the next link of a road, straight on if there are several; None at its end."""
        exits = [each for each in self._links.exits(link).tolist() if each in road]
        return min(exits, key=lambda each: (abs(self._links.turn_rad(link, each)), each), default=None)

    def _open_links(self, name: str) -> set[int]:
        if name not in self._of_name:
            meant = did_you_mean(name, list(self._of_name))
            meant = meant or f"; it has {first_names(list(dict.fromkeys(self._links.roads.name)))}"
            raise ScenarioError(f"{KEY}: {name!r}: no such road in {self._source}{meant}")
        found = {link for link in self._of_name[name] if self._links.is_open[link]}
        if not found:
            raise ScenarioError(f"{KEY}: {name!r}: no lane in this direction is as wide as a vehicle")
        return found

    def _beginning(self, name: str, road: set[int]) -> int:
        """Return the link with which a road begins; of a closed road the first in the file."""
        ends = {int(self._links.end[link]) for link in road}
        begins = sorted(link for link in road if int(self._links.start[link]) not in ends)
        if len(begins) > 1:
            raise ScenarioError(f"{KEY}: {name!r}: {len(begins)} roads of this name begin at different places")
        return begins[0] if begins else min(road)

    def _way_to(self, link: int, road: set[int]) -> list[int]:
        """Return the links from one to the first of a road, through the inside of an intersection if need be."""
        ways = [[each] for each in self._links.exits(link).tolist()]
        for _ in range(_INSIDE + 1):
            for way in ways:
                if way[-1] in road:
                    return way
            inside = (way for way in ways if self._links.is_crossing[way[-1]])
            ways = [[*way, after] for way in inside for after in self._links.exits(way[-1]).tolist()]
        return []


class _StartPlace(NamedTuple):
    """Place that is drawn for a vehicle."""

    link: int
    along_m: float
    lane: int
    position_m: Array


def start_on_map(scenario: Scenario) -> tuple[Start, RoadMap, CoordinateFrame | None, tuple[str, ...]]:
    """Return where vehicles are on the scenario's map, or in a generated city without one.

    Return also the lanes that programs know, the frame of the metres, and notes for the user.
    Raise ScenarioError if the map cannot be read, for a route that is none, and if there is no room.
    """
    section, driven, network = scenario.map, scenario.driven, scenario.network
    count = network.vehicles
    source, roads = roads_of(network, section)
    links = RoadLinks(roads, driven.vehicle_width_m)
    paths = Paths(*((links, 1.0, 0.0) if section is None else (links, section.side, section.aside_m)))
    reach_m = driven.max_speed_mps * scenario.world_ns / NS_PER_S
    if scenario.world.ranging is not None:
        reach_m += scenario.world.ranging.range_m
    ways = _Ways(source, driven, paths, links, reach_m)
    start = ways.named(driven.routes, count) if driven.routes else ways.drawn(count, network.seed)
    assert isinstance(start.road, MapRoads)
    if section is None:
        return start, roads.lane_map(), roads.frame, ()
    lanes = lanes_in_box(roads, section, *start.road.area_m(start.along_m))
    if lanes is None:
        raise ScenarioError(
            f"map.aside_m = {section.aside_m:g}: vehicles would be further than margin_m = {section.margin_m:g} m "
            f"from all roads of {source}"
        )
    return start, lanes, roads.frame, notes_of(section.path, roads)


class _Ways:
    """Routes of vehicles and their places on them; routes go on for `reach_m` behind the places if they can."""

    def __init__(self, source: object, driven: Driven, paths: Paths, links: RoadLinks, reach_m: float) -> None:
        self._source, self._driven, self._paths, self._links = source, driven, paths, links
        self._reach_m = reach_m

    def _start(self, routes: list[Route], along_m: Array, lane: Ints) -> Start:
        driven = self._driven
        road = MapRoads(self._paths.paths, routes, driven.lane_width_m, driven.vehicle_length_m)
        return Start(road, along_m, lane)

    # Routes that the scenario names.

    def named(self, named: tuple[Names, ...], count: int) -> Start:
        """Return `count` vehicles on routes that name their roads, which they have in turn."""
        reader = NamedRoutes(self._source, self._links)
        number = np.arange(count)
        first = np.array([next(reader.links_of(names)) for names in named])[number % len(named)]
        lane, along_m = np.zeros(count, dtype=np.intp), np.zeros(count)
        for link in np.unique(first).tolist():
            own = number[first == link]
            lane[own], along_m[own] = self._queue(int(self._links.lanes[link]), own, count)
        routes: list[Route] = []
        for k, names in enumerate(named[:count]):
            own = number[number % len(named) == k]
            routes.append(self._route(reader, names, lane[own], along_m[own]))
        start = self._start([routes[n % len(named)] for n in range(count)], along_m, lane)
        lanes = start.road.lane_count(along_m)
        for n in np.flatnonzero(lane >= lanes)[:1].tolist():
            raise ScenarioError(
                f"network.driven.start_lanes: {lane[n]} for vehicle {n + 1}: its road has lanes 0 to {lanes[n] - 1}"
            )
        return start

    def _queue(self, lanes: int, own: Ints, count: int) -> tuple[Ints, Array]:
        """Return lanes and positions (n,) of the vehicles `own` (n,) that begin on a road with `lanes`."""
        driven = self._driven
        lane: Ints = np.arange(len(own)) % lanes
        if driven.start_lanes is not None:
            lane = np.array(one_each("start_lanes", driven.start_lanes, count), dtype=np.intp)[own]
        if driven.start_m is not None:
            return lane, np.array(one_each("start_m", driven.start_m, count))[own]
        return lane, queue_m(driven, lane)

    def _route(self, reader: NamedRoutes, names: Names, lane: Ints, along_m: Array) -> Route:
        """Return a route of vehicles in these lanes and places (n,). Raise ScenarioError if it is too short."""
        route = elements_of(self._paths, reader.links_of(names), float(along_m.max()) + self._reach_m)
        length_m = sum(self._paths.paths[path].length_m for path in route)
        has = f"route {list(names)} has {length_m:g} m"
        if self._driven.start_m is None:
            check_room(self._driven, lane, length_m, has)
        elif along_m.max() > length_m:
            raise ScenarioError(f"network.driven.start_m: {along_m.max():g}: {has}")
        return route

    # Routes that are drawn.

    def drawn(self, count: int, seed: int) -> Start:
        """Return `count` vehicles anywhere on the map, each drawn from a stream of its own."""
        links, length_m = self._links, self._driven.vehicle_length_m
        fits = links.is_open & ~links.is_crossing & (links.length_m > 2 * length_m)
        candidates = np.flatnonzero(fits & links.is_endless if (fits & links.is_endless).any() else fits)
        if not len(candidates):
            raise ScenarioError(f"{self._source}: no road is as long and wide as a vehicle needs it to start there")
        share = np.cumsum(links.length_m[candidates])
        places: list[_StartPlace] = []
        routes: list[Route] = []
        place_m, link_of = np.zeros((count, 2)), np.zeros(count, dtype=np.intp)
        for number in range(count):
            rng = stream(seed, STREAM, number)
            drawn = (
                self._draw(rng, int(candidates[np.searchsorted(share, rng.random() * share[-1], side="right")]))
                for _ in range(TRIES)
            )
            others = link_of[:number], place_m[:number]
            place = next((each for each in drawn if self._is_free(each, *others)), None)
            if place is None:
                raise ScenarioError(
                    f"network.driven: no room for vehicle {number + 1} with gap_m = {self._driven.gap_m:g} on the "
                    f"roads of {self._source}: set fewer vehicles, or a smaller gap_m"
                )
            places.append(place)
            link_of[number], place_m[number] = place.link, place.position_m
            least_m = place.along_m + self._reach_m
            routes.append(elements_of(self._paths, drawn_links(links, rng, place.link), least_m))
        along_m, lane = np.array([place.along_m for place in places]), np.array([place.lane for place in places])
        return self._start(routes, along_m, lane)

    def _draw(self, rng: np.random.Generator, link: int) -> _StartPlace:
        path, half_m = self._paths.paths[self._paths.of_link(link)], self._driven.vehicle_length_m / 2
        along_m = float(rng.uniform(half_m, max(path.length_m - half_m, half_m)))
        lane = int(rng.integers(path.lanes[0]))
        return _StartPlace(link, along_m, lane, path.at(along_m, lane * path.width_m[0]))

    def _is_free(self, place: _StartPlace, link_of: Ints, place_m: Array) -> bool:
        """Return whether a vehicle has its gap to those in its street, and is clear of those in other streets.

        The others are in the streets `link_of` (n,) at `place_m` (n, 2).
        """
        length_m = self._driven.vehicle_length_m
        clear_m = length_m + np.where(link_of == place.link, self._driven.gap_m, length_m)
        return bool((np.hypot(*(place_m - place.position_m).T) >= clear_m).all())
