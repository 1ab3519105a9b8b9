"""Links of a map: directed stretches of its roads from one point where vehicles may turn to the next."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from emulator.world.maps.classes import NUMBER
from emulator.world.maps.roads import Ints, Roads
from vnet.types import Array, Mask

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


class Links:
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
