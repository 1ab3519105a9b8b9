"""Attenuation by buildings (Sommer, Eckhoff, German and Dressler 2011), by walls crossed and metres inside.

The ray from one antenna to the other is straight, in the plane. A building adds `wall_db` for each time that the
ray crosses its outline, and `inside_db_per_m` for each metre of the ray inside. The result is the same for both
directions, wherever an outline begins, and whichever way it goes round. A ray that touches a corner, or runs along
a wall, has the loss of a ray a little to the north, and much less to the west.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emulator.scenario.radio import Buildings as Section
from emulator.world.buildings import Buildings
from vnet.types import Array, Mask

CELL_M = 20.0
"""Least side of the cells in which edges are looked up: about the length of a building's edge."""
MOST_CELLS = 10_000_000
"""Entries of the table of cells; with enormous buildings cells are larger."""
MARGIN = 1e-3
"""Share of a cell by which rays are widened, against rounding, where cells are chosen."""
FIRST_REACH_M = 50.0
"""Length over which rays are followed in the first round; then twice as far, and so on."""
MOST_RAYS = 20_000
"""Rays that are followed at once, which bounds the memory."""

Index = NDArray[np.intp]


class _Cells:
    """Boxes, from `low_m` to `high_m` (n, 2), by the square cells that they touch."""

    def __init__(self, low_m: Array, high_m: Array) -> None:
        self._corner_m = low_m.min(axis=0) if len(low_m) else np.zeros(2)
        self._cell_m = CELL_M
        while np.prod((high_m - low_m) / self._cell_m + 1, axis=1).sum() > MOST_CELLS + len(low_m):
            self._cell_m *= 2
        first, last = (
            np.floor((end_m - self._corner_m) / self._cell_m).astype(np.int64) for end_m in (low_m, high_m)
        )
        self._columns, self._rows = (int(most) + 1 for most in last.max(axis=0, initial=-1))
        wide, high = (last - first + 1).T
        box = np.repeat(np.arange(len(low_m)), wide * high)
        nth = np.arange(len(box)) - np.repeat(np.cumsum(wide * high) - wide * high, wide * high)
        column, row = first[box, 0] + nth // high[box], first[box, 1] + nth % high[box]
        key = column * self._rows + row
        order = np.argsort(key, kind="stable")
        self._key, self._box = key[order], box[order]

    def along(self, start_m: Array, end_m: Array) -> tuple[Index, Index]:
        """Return pairs (ray, box), perhaps twice: all boxes that rays touch, and others near them.

        Rays go from `start_m` to `end_m` (n, 2), and none of them to the west.
        """
        (west, south), (east, north) = ((end_m - self._corner_m).T / self._cell_m for end_m in (start_m, end_m))
        first = np.clip(np.floor(west - MARGIN), 0, self._columns).astype(np.intp)
        count = np.clip(np.floor(east + MARGIN) + 1, first, self._columns).astype(np.intp) - first
        ray = np.repeat(np.arange(len(first)), count)
        column = first[ray] + np.arange(len(ray)) - np.repeat(np.cumsum(count) - count, count)
        width = np.where(east > west, east - west, 1.0)
        ends = []
        for border in (column - MARGIN, column + 1 + MARGIN):
            share = (np.clip(border, west[ray], east[ray]) - west[ray]) / width[ray]
            ends.append(south[ray] + share * (north - south)[ray])
        ends[1] = np.where((east == west)[ray], north[ray], ends[1])
        low = np.maximum(np.floor(np.minimum(*ends) - MARGIN), 0)
        high = np.minimum(np.floor(np.maximum(*ends) + MARGIN), self._rows - 1)
        inside = high >= low
        ray, low, high = ray[inside], low[inside], high[inside]
        key = column[inside] * self._rows
        stretch = np.searchsorted(self._key, key + low, side="left")
        length = np.searchsorted(self._key, key + high, side="right") - stretch
        nth = np.arange(int(length.sum())) - np.repeat(np.cumsum(length) - length, length)
        return np.repeat(ray, length), self._box[np.repeat(stretch, length) + nth]


@dataclass
class _Crossings:
    """Crossings of rays and edges: number of the ray, number of the edge, and share of the ray (n,) each."""

    ray: Index
    edge: Index
    share: Array

    @classmethod
    def none(cls) -> _Crossings:
        """Return no crossings."""
        return cls(np.zeros(0, np.intp), np.zeros(0, np.intp), np.zeros(0))

    def and_(self, other: _Crossings, edges: int) -> _Crossings:
        """Return both, each ray with each of so many edges once, by ray and edge."""
        ray, edge = np.append(self.ray, other.ray), np.append(self.edge, other.edge)
        _, index = np.unique(ray * edges + edge, return_index=True)
        return _Crossings(ray[index], edge[index], np.append(self.share, other.share)[index])

    def of(self, kept: Mask) -> _Crossings:
        """Return the crossings that a mask (n,) marks."""
        return _Crossings(self.ray[kept], self.edge[kept], self.share[kept])


class Obstacles:
    """Buildings between antennas. Losses of the last positions are kept, for pairs of vehicles that stand."""

    def __init__(self, buildings: Buildings, section: Section) -> None:
        self._wall_db, self._inside_db_per_m = section.wall_db, section.inside_db_per_m
        edge_m = buildings.edges_m()
        backwards = _is_before(edge_m[:, 1], edge_m[:, 0])
        edge_m[backwards] = edge_m[backwards, ::-1]
        self._edge_m, self._building = edge_m, buildings.edge_buildings()
        self._buildings = len(buildings)
        self._cells = _Cells(edge_m.min(axis=1), edge_m.max(axis=1))
        self._position_m: Array = np.zeros((0, 2))
        self._margin_db: Array = np.zeros((0, 0))
        self._loss_db: Array = np.zeros((0, 0))

    def loss_db(self, position_m: Array, margin_db: Array) -> Array:
        """Return the loss (N, N) in dB between positions (N, 2), infinite where it exceeds `margin_db` (N, N).

        The margin is symmetric; where it is negative, or NaN, nothing is computed, and the loss is infinite.
        """
        known = np.zeros(margin_db.shape, dtype=bool)
        loss_db = np.full(margin_db.shape, np.inf)
        if self._margin_db.shape == margin_db.shape:
            stands = (self._position_m == position_m).all(axis=1)
            known = stands[:, None] & stands & (self._margin_db == margin_db)
            loss_db[known] = self._loss_db[known]
        one, other = np.nonzero(np.triu(~known & (margin_db >= 0), 1))
        for first in range(0, len(one), MOST_RAYS):
            some = one[first : first + MOST_RAYS], other[first : first + MOST_RAYS]
            found_db = self._between(position_m[some[0]], position_m[some[1]], margin_db[some])
            loss_db[some] = loss_db[some[::-1]] = found_db
        self._position_m, self._margin_db, self._loss_db = position_m.copy(), margin_db.copy(), loss_db.copy()
        return loss_db

    def _between(self, start_m: Array, end_m: Array, margin_db: Array) -> Array:
        """Return the losses (n,) of rays from `start_m` to `end_m` (n, 2), infinite beyond their margin."""
        swapped = _is_before(end_m, start_m)[:, None]
        start_m, end_m = np.where(swapped, end_m, start_m), np.where(swapped, start_m, end_m)
        length_m = np.hypot(*(end_m - start_m).T)
        crossings, reach_m = _Crossings.none(), FIRST_REACH_M
        followed, passes = np.zeros(len(start_m)), np.ones(len(start_m), dtype=bool)
        alive = np.arange(len(start_m))
        while len(alive):  # most rays through a town need not be followed far
            until = np.minimum(followed[alive] + reach_m / np.maximum(length_m[alive], reach_m / 2), 1.0)
            more = self._crossings(start_m[alive], end_m[alive], followed[alive], until)
            crossings = crossings.and_(_Crossings(alive[more.ray], more.edge, more.share), len(self._building))
            passes &= self._wall_db * np.bincount(crossings.ray, minlength=len(start_m)) <= margin_db
            crossings = crossings.of(passes[crossings.ray])
            followed[alive], reach_m = until, 2 * reach_m
            alive = alive[(until < 1) & passes[alive]]
        walls = np.bincount(crossings.ray, minlength=len(start_m))
        loss_db = self._wall_db * walls + self._inside_db_per_m * self._inside_m(start_m, end_m, crossings, passes)
        return np.where(passes & (loss_db <= margin_db), loss_db, np.inf)

    def _crossings(self, start_m: Array, end_m: Array, first: Array, last: Array) -> _Crossings:
        """Return where rays cross edges between these shares (n,) of them, perhaps some twice, and others beyond.

        Ends of edges on the ray's line count as right of it, ends of rays on the edge's line as left of that: as
        if the ray were moved by a little to the north, and by much less to the west.
        """
        from_m, to_m = (start_m + share[:, None] * (end_m - start_m) for share in (first, last))
        ray, edge = self._cells.along(from_m, to_m)
        (one, two), start, end = self._edge_m[edge].swapaxes(0, 1), start_m[ray], end_m[ray]
        crosses = (_left_of(start, end, one) > 0) != (_left_of(start, end, two) > 0)
        ray, edge, one, two, start, end = (each[crosses] for each in (ray, edge, one, two, start, end))
        before, behind = _left_of(one, two, start), _left_of(one, two, end)
        crosses = (before >= 0) != (behind >= 0)
        before, behind = before[crosses], behind[crosses]
        return _Crossings(ray[crosses], edge[crosses], before / (before - behind))

    def _inside_m(self, start_m: Array, end_m: Array, crossings: _Crossings, chosen: Mask) -> Array:
        """Return the metres (n,) of rays inside buildings, 0 of those that are not `chosen` (n,).

        Along a ray the crossings of a building, with the ends that are inside it, are entries and exits by turns.
        """
        parts = [(crossings.ray, self._building[crossings.edge], crossings.share)]
        for end, point_m in ((0.0, start_m), (1.0, end_m)):
            place, building = self._containing(point_m[chosen])
            parts.append((np.flatnonzero(chosen)[place], building, np.full(len(place), end)))
        ray, building, share = (np.concatenate(each) for each in zip(*parts, strict=True))
        order = np.lexsort((share, building, ray))
        ray, share, one = ray[order], share[order], ray[order] * self._buildings + building[order]
        first = np.append(True, np.diff(one) != 0)[: len(one)]
        nth = np.arange(len(one)) - np.flatnonzero(first)[np.cumsum(first) - 1]
        exits = np.flatnonzero(nth % 2)
        shares = np.bincount(ray[exits], share[exits] - share[exits - 1], minlength=len(start_m))
        return np.asarray(shares * np.hypot(*(end_m - start_m).T))

    def _containing(self, point_m: Array) -> tuple[Index, Index]:
        """Return pairs of a point and a building around it, which a ray to the east crosses an odd number of times.

        Rays to the east treat points on a wall as all rays do, so that entries and exits are as many.
        """
        place, number = np.unique(point_m, axis=0, return_inverse=True)
        east_m = np.maximum(place[:, 0], self._edge_m[..., 0].max(initial=0.0)) + CELL_M
        far_m = np.column_stack([east_m, place[:, 1]])
        found = self._crossings(place, far_m, np.zeros(len(place)), np.ones(len(place)))
        found = _Crossings.none().and_(found, len(self._building))
        pair, times = np.unique(found.ray * self._buildings + self._building[found.edge], return_counts=True)
        contained = pair[times % 2 == 1]
        of_place = np.argsort(number.ravel(), kind="stable")
        first = np.searchsorted(number.ravel()[of_place], np.arange(len(place) + 1))
        at, building = contained // max(self._buildings, 1), contained % max(self._buildings, 1)
        each = first[at + 1] - first[at]
        nth = np.arange(int(each.sum())) - np.repeat(np.cumsum(each) - each, each)
        return of_place[np.repeat(first[at], each) + nth], np.repeat(building, each)


def _is_before(one_m: Array, other_m: Array) -> Mask:
    """Return whether points (n, 2) are west of others, or south of them at the same easting."""
    return np.asarray(
        (one_m[:, 0] < other_m[:, 0]) | ((one_m[:, 0] == other_m[:, 0]) & (one_m[:, 1] < other_m[:, 1]))
    )


def _left_of(start_m: Array, end_m: Array, point_m: Array) -> Array:
    """Return twice the areas (n,) of triangles: positive where the point is left of the way from start to end."""
    way_m, to_m = end_m - start_m, point_m - start_m
    return np.asarray(way_m[:, 0] * to_m[:, 1] - way_m[:, 1] * to_m[:, 0])
