"""A single road, straight or a ring, and where vehicles are on it at the start.

Its lanes are parallel, in one direction. `Road` is the interface that it shares with the roads of a map:
`map_driving.py` has them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from emulator.scenario.network import Driven
from vnet.errors import ScenarioError, counted
from vnet.types import Array

Ints = NDArray[np.intp]


class Road(Protocol):
    """Interface of the roads to the vehicles that are driven on them; arrays have an entry (N,) a vehicle.

    Positions are `along_m`, along the vehicle's way, NaN for an absent vehicle, and `left_m`, to the left of the
    rightmost lane's centre.
    """

    @property
    def end_m(self) -> Array:
        """Position at which the way of each vehicle (N,), or of all (), ends; infinite if it does not."""

    @property
    def has_crossings(self) -> bool:
        """True if vehicles of different ways may meet."""

    def place(self, along_m: Array, left_m: Array) -> tuple[Array, Array]:
        """Return positions (N, 2) in m and headings (N,) in [0, 2π)."""

    def ahead(self, along_m: Array, left_m: Array, width_m: float, range_m: float) -> tuple[Ints, Array]:
        """Return the number (N,) of the vehicle ahead of each, the next that it would run into, and the way to it.

        The number is -1, and the way (N,) in m NaN, if none is within `range_m`, from centre to centre. Vehicles
        are in each other's way if they overlap across the road, at `width_m` each.
        """

    def distance_m(self, along_m: Array, rear: int, front: int) -> float:
        """Return the way from one vehicle to another that is ahead of it and near."""

    def crossing_pairs(self, along_m: Array, position_m: Array, reach_m: float) -> tuple[Ints, Ints]:
        """Return the pairs (n,), (n,) of vehicles within `reach_m` of which neither is behind the other."""

    def lane_count(self, along_m: Array) -> Ints:
        """Return the number (N,) of lanes at these positions, in the direction of travel."""

    def left_m(self, along_m: Array, nominal_m: Array) -> Array:
        """Return `left_m` (N,) of vehicles at `nominal_m`, which is what it is if all lanes have the same width."""

    def rank(self, along_m: Array) -> Array:
        """Return numbers (N,) that order vehicles on the same road, the foremost last."""

    def area_m(self, furthest_m: Array) -> Array:
        """Return the corners (2, 2) of a box around the roads, as far as vehicles can come."""


@dataclass(frozen=True)
class SingleRoad:
    """A road from the origin to the east, or a ring around the origin, counter-clockwise.

    On a ring `along_m` counts along the rightmost lane, so vehicles further left cover as much of it a second.
    """

    length_m: float
    lanes: int
    lane_width_m: float
    is_ring: bool

    has_crossings = False

    @property
    def radius_m(self) -> float:
        """Radius of a ring's rightmost lane."""
        return self.length_m / (2 * math.pi)

    @property
    def end_m(self) -> Array:
        """End of the road (); infinite on a ring."""
        return np.array(math.inf if self.is_ring else self.length_m)

    def place(self, along_m: Array, left_m: Array) -> tuple[Array, Array]:
        """Return positions (N, 2) in m and headings (N,) in [0, 2π) at these positions (N,) on the road."""
        if not self.is_ring:
            return np.column_stack([along_m, left_m]), np.zeros(len(along_m))
        angle = np.mod(along_m, self.length_m) / self.radius_m
        radius_m = self.radius_m - left_m
        position_m = np.column_stack([radius_m * np.cos(angle), radius_m * np.sin(angle)])
        return position_m, np.mod(angle + math.pi / 2, 2 * math.pi)

    def area_m(self, furthest_m: Array) -> Array:
        """Return the corners (2, 2) of a box around the road, of a straight one as far as `furthest_m`."""
        if self.is_ring:
            return np.array([[-self.radius_m] * 2, [self.radius_m] * 2])
        end_m = min(float(furthest_m.max()), self.length_m)
        return np.array([[0.0, 0.0], [end_m, (self.lanes - 1) * self.lane_width_m]])

    def ahead(self, along_m: Array, left_m: Array, width_m: float, range_m: float) -> tuple[Ints, Array]:
        """Return the number (N,) of the vehicle ahead of each and the way to it, as `Road.ahead` does."""
        found = np.full(len(along_m), -1, dtype=np.intp)
        there = np.flatnonzero(np.isfinite(along_m))
        at_m = np.mod(along_m[there], self.length_m) if self.is_ring else along_m[there]
        order = np.argsort(at_m, kind="stable")
        number, at_m = there[order], at_m[order]
        seeking = np.arange(len(number))
        if self.is_ring:
            number, at_m = np.concatenate([number, number]), np.concatenate([at_m, at_m + self.length_m])
        across_m = left_m[number]
        for step in range(1, len(there)):
            seeking = seeking[seeking + step < len(number)]
            seeking = seeking[at_m[seeking + step] - at_m[seeking] <= range_m]
            if not len(seeking):
                break
            meets = np.abs(across_m[seeking + step] - across_m[seeking]) < width_m
            found[number[seeking[meets]]] = number[seeking[meets] + step]
            seeking = seeking[~meets]
        way_m = along_m[found] - along_m
        way_m = np.mod(way_m, self.length_m) if self.is_ring else way_m
        return found, np.where(found >= 0, way_m, np.nan)

    def distance_m(self, along_m: Array, rear: int, front: int) -> float:
        """Return the way along the road from one vehicle to another."""
        way_m = float(along_m[front] - along_m[rear])
        return way_m % self.length_m if self.is_ring else way_m

    def crossing_pairs(self, along_m: Array, position_m: Array, reach_m: float) -> tuple[Ints, Ints]:
        """Return no pair: on one road each vehicle is behind another."""
        return np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp)

    def lane_count(self, along_m: Array) -> Ints:
        """Return the number (N,) of lanes, the same everywhere."""
        return np.full(len(along_m), self.lanes, dtype=np.intp)

    def left_m(self, along_m: Array, nominal_m: Array) -> Array:
        """Return `nominal_m` (N,): all lanes have the same width."""
        return nominal_m

    def rank(self, along_m: Array) -> Array:
        """Return the positions (N,): the foremost is the furthest."""
        return along_m


@dataclass(frozen=True)
class Start:
    """The roads, and the position (N,) along its way and the lane (N,) of each vehicle at time 0."""

    road: Road
    along_m: Array
    lane: Ints


def start_on_single_road(driven: Driven, count: int) -> Start:
    """Return where `count` vehicles are on a straight road or a ring. Raise ScenarioError if they do not fit."""
    lane: Ints = np.arange(count) % driven.lanes
    if driven.start_lanes is not None:
        lane = np.array(one_each("start_lanes", driven.start_lanes, count), dtype=np.intp)
    if driven.start_m is None:
        check_room(driven, lane, driven.length_m, f"the road has length_m = {driven.length_m:g}")
        along_m = queue_m(driven, lane)
    else:
        along_m = np.array(one_each("start_m", driven.start_m, count))
    road = SingleRoad(driven.length_m, driven.lanes, driven.lane_width_m, driven.road == "ring")
    return Start(road, along_m, lane)


def check_room(driven: Driven, lane: Ints, length_m: float, has: str) -> None:
    """Raise ScenarioError, which says what the road `has`, if a queue in these lanes is longer than the road."""
    rows = int(np.bincount(lane).max())
    needed_m = rows * (driven.gap_m + driven.vehicle_length_m)
    if needed_m > length_m:
        raise ScenarioError(
            f"network.driven: {rows} vehicles a lane with gap_m = {driven.gap_m:g} take {needed_m:g} m: {has}"
        )


def queue_m(driven: Driven, lane: Ints) -> Array:
    """Return positions (N,) in m of vehicles one behind the other in their lanes (N,), the first ahead."""
    row = np.zeros(len(lane), dtype=np.int64)
    for each in range(int(lane.max()) + 1):
        row[lane == each] = np.arange(int((lane == each).sum()))
    step_m = driven.gap_m + driven.vehicle_length_m
    return np.asarray((int(row.max()) - row) * step_m + driven.vehicle_length_m / 2)


def one_each(name: str, values: Sequence[Any], count: int) -> Sequence[Any]:
    """Return `values`. Raise ScenarioError, naming the key, unless there are `count` of them."""
    if len(values) != count:
        numbers = f"{counted(len(values), 'value')} for {counted(count, 'vehicle')}"
        raise ScenarioError(f"network.driven.{name}: {numbers}: give one each")
    return values
