"""The roads of a map as driven vehicles have them: each has a way of its own along paths that all share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from emulator.world.driven.map_paths import Path
from emulator.world.driven.road import Ints
from emulator.world.neighbours import links_within
from vnet.roads.grid import ranges
from vnet.types import Array

APART_M = 100.0
"""Distance between two paths on the common scale: more than a vehicle's length, and what it drives in a period."""

_NEAR = 3
"""Most paths between two vehicles that overlap."""


class _Place(NamedTuple):
    """Places of vehicles (N,): entry of the routes' tables, path, position on the common scale in m."""

    entry: Ints
    path: Ints
    at_m: Array


class _Pairs(NamedTuple):
    """Pairs (n,) of a vehicle and one ahead of it on its way, the nearest first, and the way between in m."""

    rear: Ints
    front: Ints
    way_m: Array


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

    def _locate(self, along_m: Array) -> _Place:
        entry = self._entry(np.arange(len(along_m)), along_m)
        path = self._path[entry]
        return _Place(entry, path, self._base_m[path] + (along_m - self._start_m[entry]))

    def place(self, along_m: Array, left_m: Array) -> tuple[Array, Array]:
        """Return positions (N, 2) in m and headings (N,) in [0, 2π)."""
        _, path, at_m = self._locate(along_m)
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
        _, path, _ = self._locate(along_m)
        return np.asarray(self._lanes[path].max(axis=1))

    def left_m(self, along_m: Array, nominal_m: Array) -> Array:
        """Return distances (N,) from the rightmost lane. In a turn they change to those of the next road."""
        _, path, at_m = self._locate(along_m)
        lane = nominal_m / self._nominal_m
        done = np.clip((at_m - self._base_m[path]) / self._path_m[path], 0.0, 1.0)
        done = done**2 * (3 - 2 * done)
        sides_m = np.minimum(lane[:, None], self._lanes[path] - 1) * self._width_m[path]
        return np.asarray(sides_m[:, 0] + done * (sides_m[:, 1] - sides_m[:, 0]))

    def rank(self, along_m: Array) -> Array:
        """Return the positions (N,) on the common scale."""
        return self._locate(along_m).at_m

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

    def _following(self, along_m: Array, range_m: float) -> _Pairs:
        """Return all pairs of which one is at most `range_m` behind the other on its way."""
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
        return _Pairs(behind[order], front[order], way_m[order])

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
