"""A generated city with the character of a mid-sized American town such as Ann Arbor.

Arterial roads form a grid, slightly rotated and curved. Near the centre the squares between them are divided into
dense blocks, with one-way streets in pairs, and alleys. Further out streets curve in all directions, and many are
dead ends. There are diagonal roads, a river with a road along it, service roads beside the arterials and in front
of shops, and a motorway along two sides, with ramps.

Streets are drawn on a plan of straight lines and right angles, which is then rotated and warped.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emulator.world.maps.roads import LANE_WIDTH_M, LANES, NUMBER, Ints, Roads, RoadsBuilder
from emulator.world.projection import CoordinateFrame
from vnet.errors import ScenarioError
from vnet.extras import require
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
SIZE_M = 3000.0
"""Default size of the city."""
SMALLEST_M, LARGEST_M = 1000.0, 10_000.0
"""Least and greatest size of the city."""
ORIGIN_DEG = (42.0, -40.0)
"""Latitude and longitude of the centre: in the Atlantic, so that no real town is meant."""
_MARGIN = 1.1
"""Size of the warped plan relative to the plan."""
_ARTERIAL_M = (420.0, 640.0)
"""Range of the distance between neighbouring arterials."""
_CORE = 0.22
"""Radius of the dense core, relative to the city's size."""
_BLOCK_M, _CORE_BLOCK_M = 125.0, 95.0
"""Mean length of a block outside the core and in it."""
_MOTORWAY_OFFSET_M = 11.0
"""Distance of a motorway carriageway from the motorway's centre line."""
_NEAR_MOTORWAY_M = 115.0
"""Distance from the motorway within which no other streets are built."""
_RAMP_M = 290.0
"""Length of a ramp along the motorway."""
_RAMP_OFFSET_M = 62.0
"""Distance of a ramp's end from the motorway's centre line."""
_RIVER_STEP_M = 11.0
"""Distance between the points of the road along the river."""


@dataclass
class CityStreet:
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
    length_m: float


def divided(points_m: Array, step_m: float = STEP_M) -> Array:
    """Return a line (n, 2) with points added so that neighbours are at most `step_m` apart."""
    length_m = np.hypot(*np.diff(points_m, axis=0).T)
    parts = np.maximum(1, np.ceil(length_m / step_m)).astype(int)
    along = np.concatenate([n + np.arange(part) / part for n, part in enumerate(parts)] + [[len(parts)]])
    number = np.arange(len(points_m))
    return np.column_stack([np.interp(along, number, axis) for axis in points_m.T])


def add_streets(builder: RoadsBuilder, streets: Sequence[CityStreet], warp: Callable[[Array], Array]) -> None:
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

    def __init__(self, streets: Sequence[CityStreet]) -> None:
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
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import connected_components
        from scipy.spatial import cKDTree

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
        from scipy.spatial import cKDTree

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
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    ends = np.array([piece.ends for piece in pieces], dtype=np.intp)
    joined = coo_matrix((np.ones(len(ends)), ends.T), shape=(crossings, crossings))
    _, label = connected_components(joined, directed=False)
    label = label[ends[:, 0]]
    best = int(np.argmax(np.bincount(label, [piece.length_m for piece in pieces])))
    return [piece for piece, its in zip(pieces, label.tolist(), strict=True) if its == best]


def city_roads(seed: int, size_m: float = SIZE_M) -> Roads:
    """Return the roads of a generated city, about `size_m` across; the same arguments give the same city.

    Raise ScenarioError unless `size_m` is from `SMALLEST_M` to `LARGEST_M`, and if scipy is not installed.
    """
    if not SMALLEST_M <= size_m <= LARGEST_M:
        raise ScenarioError(f"size_m = {size_m:g}: {SMALLEST_M:g} to {LARGEST_M:g} allowed")
    require("a generated city", "scipy", error=ScenarioError)
    rng = np.random.default_rng((seed, 0))
    city = _City(rng, size_m / _MARGIN)
    builder = RoadsBuilder(f"city of seed {seed}")
    add_streets(builder, city.streets(), _Warp(rng, size_m))
    return builder.build(builder.coordinates(), CoordinateFrame.around(*ORIGIN_DEG))


class _Warp:
    """Map from the plan to metres: a small rotation, and a displacement by long waves."""

    def __init__(self, rng: np.random.Generator, size_m: float) -> None:
        self._turn_rad = math.radians(rng.uniform(4, 14)) * rng.choice([-1, 1])
        self._wave_m = rng.uniform(0.7, 1.2, 2) * max(size_m, 2000.0)
        self._high_m = rng.uniform(0.025, 0.04, 2) * self._wave_m
        self._phase = rng.uniform(0, 2 * math.pi, 2)

    def __call__(self, plan_m: Array) -> Array:
        waves = self._high_m * np.sin(2 * math.pi * plan_m[:, ::-1] / self._wave_m + self._phase)
        cosine, sine = math.cos(self._turn_rad), math.sin(self._turn_rad)
        return np.asarray((plan_m + waves) @ np.array([[cosine, sine], [-sine, cosine]]))


class _City:
    """The plan of the streets, a square centred at (0, 0)."""

    def __init__(self, rng: np.random.Generator, size_m: float) -> None:
        self._rng = rng
        self._half_m = size_m / 2
        self._core_m = max(_CORE * size_m, 300.0)
        self._lines = tuple(self._arterial_lines() for _ in range(2))
        self._river = rng.uniform(0.5, 0.62) * self._half_m, rng.uniform(0, 2 * math.pi, 2)
        self._motorway_m = self._motorway_line()
        self._shops: list[tuple[Array, Array]] = []

    def streets(self) -> list[CityStreet]:
        """Return all streets of the city."""
        return [
            *self._arterials(),
            *self._diagonals(),
            *self._river_road(),
            *self._motorway(),
            *self._services(),
            *self._cells(),
        ]

    # Main roads.

    def _arterial_lines(self) -> Array:
        """Return the sorted coordinates at which arterials cross an axis: 0, and others at irregular distances."""
        last_m = self._half_m - 330.0
        lines = [0.0]
        for side in (-1, 1):
            at_m = 0.0
            while (at_m := at_m + self._rng.uniform(*_ARTERIAL_M)) < last_m:
                lines.append(side * at_m)
        return np.array(sorted(lines))

    def _arterials(self) -> list[CityStreet]:
        streets = []
        for axis, lines in enumerate(self._lines):
            middle = int(np.argmin(np.abs(lines)))
            for number, at_m in enumerate(lines.tolist()):
                line = np.full((2, 2), at_m)
                line[:, 1 - axis] = -self._half_m, self._half_m
                far = abs(number - middle)
                kind = "primary" if not far else "secondary" if far % 2 == 0 or len(lines) < 4 else "tertiary"
                streets.append(CityStreet(f"{'Avenue' if axis else 'Road'} {number + 1}", kind, divided(line)))
        return streets

    def _diagonals(self) -> list[CityStreet]:
        """Return roads from near the core outwards, diagonal to the grid."""
        streets = []
        quadrants = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
        for number, quadrant in enumerate(quadrants[self._rng.permutation(4)[:2]].tolist()):
            start = np.array([self._next_line(axis, quadrant[axis]) for axis in range(2)])
            end = (
                np.array(quadrant)
                * self._half_m
                * np.array([self._rng.uniform(0.75, 0.95), self._rng.uniform(0.55, 0.8)])
            )
            bulge = np.array([end[1] - start[1], start[0] - end[0]]) * self._rng.uniform(-0.12, 0.12)
            part = np.linspace(0, 1, 60)[:, None]
            line = (1 - part) * start + part * end + 4 * part * (1 - part) * bulge
            streets.append(CityStreet(f"Cross Road {number + 1}", "secondary", divided(line)))
        return streets

    def _next_line(self, axis: int, side: int) -> float:
        """Return the coordinate of the first arterial beside the central one on a side, or halfway to the edge."""
        beyond = [at_m for at_m in self._lines[axis].tolist() if at_m * side > 1]
        return min(beyond, key=abs) if beyond else side * 0.5 * self._half_m

    def _river_m(self, east_m: Array) -> Array:
        """Return the river's coordinates (n,) north at coordinates (n,) east."""
        at_m, (early, late) = self._river
        return np.asarray(at_m + 90 * np.sin(east_m / 330 + early) + 45 * np.sin(east_m / 130 + late))

    def _river_road(self) -> list[CityStreet]:
        east_m = np.arange(-self._half_m, self._half_m, _RIVER_STEP_M)
        line = np.column_stack([east_m, self._river_m(east_m) - 75])
        return [CityStreet("River Road", "tertiary", line[~self._near_motorway(line)])]

    def _motorway_line(self) -> Array:
        """Return the motorway's centre line: from the north edge along the east side, then along the south side."""
        side_m, radius_m = self._half_m - 155.0, 0.35 * self._half_m
        turn = np.radians(np.linspace(0, -90, 40))[:, None]
        corner = np.array([side_m - radius_m, radius_m - side_m])
        arc = corner + radius_m * np.hstack([np.cos(turn), np.sin(turn)])
        line = np.vstack([[[side_m, 1.1 * self._half_m]], arc, [[-1.1 * self._half_m, -side_m]]])
        return divided(line, 10.0)

    def _near_motorway(self, points_m: Array) -> NDArray[np.bool_]:
        """Return the mask (n,) of the points (n, 2) near the motorway."""
        offset = points_m[:, None] - self._motorway_m[None, ::4]
        return np.asarray(np.hypot(offset[..., 0], offset[..., 1]).min(axis=1) < _NEAR_MOTORWAY_M)

    def _motorway(self) -> list[CityStreet]:
        """Return both carriageways, and ramps to a road on the east side and one on the south side."""
        line = self._motorway_m
        along = np.gradient(line, axis=0)
        along /= np.hypot(*along.T)[:, None]
        right = np.column_stack([along[:, 1], -along[:, 0]])
        crossings = [self._crossing(line, 1, 0), self._crossing(line, 0, len(line))]
        streets = []
        for side, name in ((1, "west"), (-1, "east")):
            carriageway = line + side * _MOTORWAY_OFFSET_M * right
            steps = round(_RAMP_M / 10.0)
            joints = []
            for number, at in enumerate(crossings):
                leave, join = at - side * steps, at + side * steps
                joints += [leave, join]
                foot = line[at] + side * _RAMP_OFFSET_M * right[at]
                ahead = side * along[at]
                ramps = ((carriageway[leave], foot, "off"), (foot, carriageway[join], "on"))
                for start, end, kind in ramps:
                    curve = _curve(start, start + 130 * ahead, end - 130 * ahead, end, 30)
                    joint = 0 if kind == "off" else len(curve) - 1
                    label = f"Motorway {name}, ramp {kind} {number + 1}"
                    streets.append(CityStreet(label, "motorway_link", curve, True, joints=(joint,)))
            order = slice(None, None, side)
            numbers = tuple(n if side > 0 else len(line) - 1 - n for n in joints)
            streets.append(CityStreet(f"Motorway {name}", "motorway", carriageway[order], True, True, numbers))
        return streets

    def _crossing(self, line: Array, axis: int, after: int) -> int:
        """Return the index of the motorway's point at which the central arterial crosses, where `axis` is 0."""
        away = np.abs(line[:, axis])
        half = len(line) // 2
        return int(np.argmin(away[:half])) if not after else half + int(np.argmin(away[half:]))

    # Streets between the main roads.

    def _services(self) -> list[CityStreet]:
        """Return roads beside arterials, and the lanes of car parks in front of shops."""
        streets: list[CityStreet] = []
        for axis, lines in enumerate(self._lines):
            across = self._lines[1 - axis]
            for at_m in lines[np.abs(lines) > 1].tolist():
                for low_m, high_m in zip(across[:-1].tolist(), across[1:].tolist(), strict=True):
                    if self._rng.random() < 0.4:
                        streets += self._frontage(axis, at_m, low_m, high_m)
        return streets

    def _frontage(self, axis: int, at_m: float, low_m: float, high_m: float) -> list[CityStreet]:
        """Return a road beside the arterial at `at_m`, half of the time with the rows of a car park behind it."""
        inwards = -math.copysign(1, at_m)
        start_m, end_m = low_m + 70, low_m + self._rng.uniform(0.5, 0.8) * (high_m - low_m)
        rows = int(self._rng.integers(3, 6)) if self._rng.random() < 0.5 else 1
        depth_m = [at_m + inwards * (27 + 24 * row) for row in range(rows)]
        if rows > 1:
            end_m = start_m + self._rng.uniform(110, 170)
        lines = [[(depth, start_m), (depth, end_m)] for depth in depth_m]
        lines += [[(at_m, along), (depth_m[-1], along)] for along in (start_m, end_m)]
        plan = [np.array(line)[:, :: -1 if axis else 1] for line in lines]
        corners = np.vstack(plan)
        if self._in_park(corners).any() or self._near_motorway(corners).any():
            return []
        self._shops.append((corners.min(axis=0) - 12, corners.max(axis=0) + 12))
        return [CityStreet("Service Road", "service", divided(line)) for line in plan]

    def _in_park(self, points_m: Array) -> Array:
        """Return the mask (n,) of the points (n, 2) in the park along the river, which is not built up."""
        north_m = points_m[:, 1] - self._river_m(points_m[:, 0])
        return np.asarray((north_m > -105) & (north_m < 55))

    def _is_free(self, line: Array) -> bool:
        """Return true if a street may be built on this line."""
        if self._in_park(line).any() or self._near_motorway(line).any():
            return False
        return not any(((line > low) & (line < high)).all(axis=1).any() for low, high in self._shops)

    def _cells(self) -> list[CityStreet]:
        """Return the streets in all cells between arterials."""
        edges = [np.concatenate([[-self._half_m], lines, [self._half_m]]) for lines in self._lines]
        streets = []
        for column in range(len(edges[0]) - 1):
            for row in range(len(edges[1]) - 1):
                low = np.array([edges[0][column], edges[1][row]])
                high = np.array([edges[0][column + 1], edges[1][row + 1]])
                near = np.hypot(*((low + high) / 2)) < self._core_m
                cell = _Cell(self._rng, low, high, bool(near))
                streets += [street for street in cell.streets() if self._is_free(street.points_m)]
        return streets


class _Cell:
    """The streets in one cell between arterials: a lattice, which outside the core is twisted and has gaps."""

    def __init__(self, rng: np.random.Generator, low_m: Array, high_m: Array, core: bool) -> None:
        self._rng, self._low_m, self._high_m, self._core = rng, low_m, high_m, core
        block_m = _CORE_BLOCK_M if core else _BLOCK_M * rng.uniform(0.8, 1.25)
        self._count = np.maximum(1, np.round((high_m - low_m) / block_m)).astype(int)
        self._turn_rad = 0.0 if core else rng.uniform(0.5, 1.5) * rng.choice([-1, 1])
        self._shift_m = np.zeros(2) if core else rng.uniform(-30, 30, 2)
        self._name = f"{'Core' if core else 'Quarter'} {low_m[0] / 100:.0f}/{low_m[1] / 100:.0f}"

    def streets(self) -> list[CityStreet]:
        """Return the streets of the cell, without the arterials at its edges."""
        found = []
        for axis in range(2):
            for line in range(1, int(self._count[axis])):
                one_way = self._direction(axis, line)
                for step in range(int(self._count[1 - axis])):
                    edge = step in (0, self._count[1 - axis] - 1)
                    if self._core or self._rng.random() < (0.45 if edge else 0.8):
                        found.append(self._street(axis, line, step, one_way))
        if self._core:
            found += self._alleys()
        return found

    def _direction(self, axis: int, line: int) -> int:
        """Return 1 or -1 for a one-way street of the core (those next to the central arterials), else 0."""
        if not self._core:
            return 0
        after = abs(self._low_m[axis]) < 1 and line == 1
        before = abs(self._high_m[axis]) < 1 and line == self._count[axis] - 1
        return (1 if after else -1 if before else 0) * (1 if axis == 0 else -1)

    def _street(self, axis: int, line: float, step: float, one_way: int) -> CityStreet:
        """Return the street of the lattice on `line` of `axis`, from `step` to the next."""
        points = 2 if self._core else 13
        lattice = np.full((points, 2), float(line))
        lattice[:, 1 - axis] = np.linspace(step, step + 1, points)
        plan = self._twisted(lattice / self._count)
        if one_way < 0:
            plan = plan[::-1]
        name = f"{self._name} {'Street' if axis == 0 else 'Place'} {line:g}"
        if one_way:
            return CityStreet(name, "secondary", divided(plan), True)
        wide = self._core and line % 2 == 0
        return CityStreet(name, "tertiary" if wide else "residential", divided(plan))

    def _alleys(self) -> list[CityStreet]:
        """Return service streets in the middle of some blocks."""
        alleys = []
        for line in range(int(self._count[0])):
            for step in range(int(self._count[1])):
                if self._rng.random() < 0.25:
                    alley = self._street(0, line + 0.5, step, 0)
                    alleys.append(CityStreet(alley.name, "service", alley.points_m))
        return alleys

    def _twisted(self, part: Array) -> Array:
        """Return plan coordinates (n, 2) of lattice points in [0, 1]²: rotated, most strongly at the centre."""
        weight = np.sin(np.pi * part).prod(axis=1)
        size_m = self._high_m - self._low_m
        from_middle = (part - 0.5) * size_m
        turn_rad = self._turn_rad * weight
        cosine, sine = np.cos(turn_rad), np.sin(turn_rad)
        turned = np.column_stack(
            [
                cosine * from_middle[:, 0] - sine * from_middle[:, 1],
                sine * from_middle[:, 0] + cosine * from_middle[:, 1],
            ]
        )
        return np.asarray((self._low_m + self._high_m) / 2 + turned + weight[:, None] * self._shift_m)


def _curve(start: Array, one: Array, other: Array, end: Array, count: int) -> Array:
    """Return a cubic Bézier curve (count, 2) with these control points."""
    t = np.linspace(0, 1, count)[:, None]
    return np.asarray((1 - t) ** 3 * start + 3 * t * (1 - t) ** 2 * one + 3 * t**2 * (1 - t) * other + t**3 * end)
