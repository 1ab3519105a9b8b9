"""Conversion of drawn streets to joined roads: crossings are where streets cross or end at one another."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from emulator.world.maps.classes import LANE_WIDTH_M, LANES, NUMBER
from emulator.world.maps.roads import Ints, RoadsBuilder
from vnet.types import Array

STEP_M = 30.0
"""Greatest distance between neighbouring points of a street."""
MERGE_M = 14.0
"""Crossings closer than this become one."""
SHORTEST_DEAD_END_M = 35.0
"""Shortest dead end that is kept."""
_TOUCH_M = 0.5
"""A street that ends this close to another one ends at it."""
_MIN_SINE = 0.1
"""Sine of the least angle at which streets cross; streets at a smaller angle are parallel."""
_ABOVE_M = 1e6
"""Height that separates elevated streets from those on the ground in the search for crossings."""


@dataclass
class Street:
    """A street through `points_m` (n, 2).

    A street `above` the ground meets others only at its `joints`, which are indices of points. A street on the
    ground that joins one (a ramp) lists the index of its own point there.
    """

    name: str
    kind: str
    points_m: Array
    one_way: bool = False
    above: bool = False
    joints: tuple[int, ...] = ()


@dataclass
class _Piece:
    """Part of a street between the crossings numbered `ends`; `shape` are the indices of the points between."""

    street: int
    ends: tuple[int, int]
    shape: Ints
    length_m: float = field(default=0.0)


def divided(points_m: Array, step_m: float = STEP_M) -> Array:
    """Return a line (n, 2) with points added so that neighbours are at most `step_m` apart."""
    length_m = np.hypot(*np.diff(points_m, axis=0).T)
    parts = np.maximum(1, np.ceil(length_m / step_m)).astype(int)
    along = np.concatenate([n + np.arange(part) / part for n, part in enumerate(parts)] + [[len(parts)]])
    number = np.arange(len(points_m))
    return np.column_stack([np.interp(along, number, axis) for axis in points_m.T])


def add_streets(builder: RoadsBuilder, streets: Sequence[Street], warp: Callable[[Array], Array]) -> None:
    """Cut streets into roads at their crossings, and add the largest connected component.

    Streets are drawn on a plan; `warp` maps points (n, 2) of the plan to metres.
    """
    plan = _Plan(streets)
    pieces = _without_stubs(plan.pieces())
    crossing_m, point_m = warp(plan.crossing_m), warp(plan.point_m)
    for piece in _largest(pieces, len(crossing_m)):
        street = streets[piece.street]
        start, end = piece.ends
        points = [(("crossing", start), tuple(crossing_m[start]))]
        points += [(("point", n), tuple(point_m[n])) for n in piece.shape.tolist()]
        points += [(("crossing", end), tuple(crossing_m[end]))]
        kind = NUMBER[street.kind]
        lanes = int(LANES[kind])
        both = (lanes, 0) if street.one_way else (lanes, lanes)
        builder.add(street.name, points, kind, both, float(LANE_WIDTH_M[kind]))


class _Plan:
    """All points of all streets, and the crossings of streets."""

    def __init__(self, streets: Sequence[Street]) -> None:
        count = [len(street.points_m) for street in streets]
        self._first = np.concatenate([[0], np.cumsum(count)])
        self._street = np.repeat(np.arange(len(streets)), count)
        self._above = np.array([street.above for street in streets], dtype=bool)
        self.point_m: Array = np.concatenate([street.points_m for street in streets])
        joints = [self._first[n] + np.array(street.joints, dtype=np.intp) for n, street in enumerate(streets)]
        self._joints = np.concatenate(joints).astype(np.intp)
        self._along, self._number = self._meetings()

    def _meetings(self) -> tuple[Array, Ints]:
        """Return the positions of crossings along the streets, and the crossings' numbers.

        A position is the index of a point plus a fraction. Both arrays are sorted by street, then by position. Sets
        `crossing_m` and `_street_of`.
        """
        one, other, t, u = self._intersections()
        ends = np.concatenate([self._first[:-1], self._first[1:] - 1])
        along = np.concatenate([one + t, other + u, ends, self._joints]).astype(float)
        before = np.minimum(np.floor(along).astype(np.intp), len(self.point_m) - 2)
        part = (along - before)[:, None]
        at_m = (1 - part) * self.point_m[before] + part * self.point_m[before + 1]
        # Streets above the ground meet only each other's joints.
        street = np.concatenate(
            [self._street[one], self._street[other], self._street[ends], self._street[self._joints]]
        )
        is_above = self._above[street] | np.isin(along, self._joints)
        pairs = cKDTree(np.column_stack([at_m, _ABOVE_M * is_above])).query_pairs(MERGE_M, output_type="ndarray")
        same = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(along), len(along)))
        crossings, number = connected_components(same, directed=False)
        share = np.bincount(number, minlength=crossings)
        self.crossing_m: Array = np.column_stack([np.bincount(number, axis) / share for axis in at_m.T])
        order = np.lexsort((along, street))
        self._street_of = street[order]
        return along[order], number[order]

    def _intersections(self) -> tuple[Ints, Ints, Array, Array]:
        """Return the segments that cross on the ground, by the indices of their first points.

        The last two arrays are the fractions of the two segments at which they cross.
        """
        segment = np.flatnonzero((self._street[:-1] == self._street[1:]) & ~self._above[self._street[:-1]])
        start, step = self.point_m[segment], self.point_m[segment + 1] - self.point_m[segment]
        pairs = cKDTree(start + step / 2).query_pairs(STEP_M + 2 * _TOUCH_M, output_type="ndarray")
        pairs = pairs[self._street[segment[pairs[:, 0]]] != self._street[segment[pairs[:, 1]]]]
        one, other = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))].T
        length = np.hypot(*step.T)
        sine = _cross(step[one], step[other])
        crossing = np.abs(sine) > _MIN_SINE * length[one] * length[other]
        one, other, sine = one[crossing], other[crossing], sine[crossing]
        between = start[other] - start[one]
        t, u = _cross(between, step[other]) / sine, _cross(between, step[one]) / sine
        slack_t, slack_u = _TOUCH_M / length[one], _TOUCH_M / length[other]
        meet = (t >= -slack_t) & (t <= 1 + slack_t) & (u >= -slack_u) & (u <= 1 + slack_u)
        t, u = np.clip(t[meet], 0, 1), np.clip(u[meet], 0, 1)
        return segment[one[meet]], segment[other[meet]], t, u

    def pieces(self) -> list[_Piece]:
        """Return all parts of streets between neighbouring crossings, without near-copies between the same two."""
        found: list[_Piece] = []
        seen: dict[tuple[int, int], list[float]] = {}
        same = (self._street_of[1:] == self._street_of[:-1]) & (self._number[1:] != self._number[:-1])
        for n in np.flatnonzero(same).tolist():
            start, end = int(self._number[n]), int(self._number[n + 1])
            shape = np.arange(int(np.floor(self._along[n])) + 1, int(np.ceil(self._along[n + 1])))
            ends_m = self.crossing_m[[start, end]]
            clear = [np.hypot(*(self.point_m[shape] - end_m).T) > MERGE_M for end_m in ends_m]
            shape = shape[clear[0] & clear[1]]
            line_m = np.vstack([ends_m[:1], self.point_m[shape], ends_m[1:]])
            length_m = float(np.hypot(*np.diff(line_m, axis=0).T).sum())
            others = seen.setdefault((min(start, end), max(start, end)), [])
            if not any(abs(length_m - other) < 2 * MERGE_M for other in others):
                others.append(length_m)
                found.append(_Piece(int(self._street_of[n]), (start, end), shape, length_m))
        return found


def _cross(one: Array, other: Array) -> Array:
    return np.asarray(one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0])


def _without_stubs(pieces: list[_Piece]) -> list[_Piece]:
    """Return the pieces without short dead ends."""
    ends = np.array([piece.ends for piece in pieces], dtype=np.intp)
    degree = np.bincount(ends.ravel())
    dead_end = (degree[ends] == 1).any(axis=1)
    return [
        piece
        for piece, is_end in zip(pieces, dead_end.tolist(), strict=True)
        if not is_end or piece.length_m >= SHORTEST_DEAD_END_M
    ]


def _largest(pieces: list[_Piece], crossings: int) -> list[_Piece]:
    """Return the pieces of the connected component with the greatest length."""
    ends = np.array([piece.ends for piece in pieces], dtype=np.intp)
    joined = coo_matrix((np.ones(len(ends)), ends.T), shape=(crossings, crossings))
    _, label = connected_components(joined, directed=False)
    label = label[ends[:, 0]]
    best = int(np.argmax(np.bincount(label, [piece.length_m for piece in pieces])))
    return [piece for piece, its in zip(pieces, label.tolist(), strict=True) if its == best]
