"""Generated traffic: routes through a map, and the trips along them.

Each vehicle is drawn from a random stream of its own, so one more changes nothing for the others. A route becomes
the centre line of a lane, and its corners become arcs. Speeds are bounded by the streets' classes, by the lateral
acceleration `LATERAL_MPS2` in curves and turns, by stops at some crossings, and by `STARTING_MPS2` and
`BRAKING_MPS2` between them. Vehicles do not interact. Some start on a parking lot beside the road, some enter late,
and some leave early.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from emulator.world.maps.roads import MIN_HALF_WIDTH_M, NAMES, VEHICLE_WIDTH_M, Ints, Roads
from emulator.world.networks import numbered_ids
from emulator.world.trips.motion import MOST_STATES, SHORTEST_STAY_S, Motion, lateral_offsets_m
from vnet.errors import ScenarioError
from vnet.extras import require
from vnet.types import Array
from vnet.units import NS_PER_S

SPEED_M_S = {
    "motorway": 29.0,
    "trunk": 24.0,
    "primary": 16.0,
    "secondary": 14.0,
    "tertiary": 13.0,
    "unclassified": 12.0,
    "residential": 10.0,
    "living_street": 5.0,
    "service": 5.0,
    "crossing": 8.0,
    "road": 12.0,
}
"""Free-flow speeds by road class."""
LINK_SHARE = 0.7
"""Speed on a ramp relative to the road that it belongs to."""
TRIES = 8
"""Destinations that are tried to find one that can be reached without a U-turn."""
LATERAL_MPS2 = 2.5
"""Greatest lateral acceleration in a curve: that of a brisk driver."""
STARTING_MPS2 = 2.0
"""Acceleration."""
BRAKING_MPS2 = 2.5
"""Deceleration."""
SLOWEST_MPS = 1.5
"""Speed in the tightest turn."""
STOPS_AT = 0.3
"""Probability of a stop at a crossing."""
STOPPED_S, LONGEST_STOP_S = 8.0, 40.0
"""Mean time of a stop beyond its first second, and longest stop."""
PARKED, LATE, EARLY = 0.15, 0.2, 0.2
"""Shares of vehicles that start on a parking lot, that enter during the run, and that leave during it."""
PARKED_OFFSET_M, PARKED_S = (7.0, 18.0), (5.0, 40.0)
"""Ranges of a parking lot's distance from the lane, and of the time that a vehicle stays there."""
LATERAL_SIGMA_M, LATERAL_TAU_S = 0.3, 20.0
"""Standard deviation and time constant of the lateral offset in a lane."""
SLOWEST_SHARE, FASTEST_SHARE = 0.85, 1.05
"""Range of a vehicle's speed relative to the streets' free-flow speeds."""
STEP_M, SMOOTH_STEPS = 1.0, 5
"""Distance between the points of a trajectory, and number of points over which it is smoothed."""
CORNER_RAD, CORNER_M = 0.35, 8.0
"""Least turn that is rounded by an arc, and distance of the arc's ends from the corner."""


@dataclass(frozen=True)
class Streets:
    """E directed edges between points of `roads`; arrays (E,).

    `start` and `end` are points, `road` the edge's road, and `against` is 1 for an edge against the road's
    direction.
    """

    roads: Roads
    start: Ints
    end: Ints
    road: Ints
    against: Array
    speed_m_s: Array
    time_s: Array


class StreetNetwork:
    """The largest strongly connected component of a map's streets."""

    def __init__(self, source: object, roads: Roads) -> None:
        """Find the component. Raise ScenarioError, naming `source`, if it has fewer than two points."""
        require(f"{source}: a route on its roads", "scipy", error=ScenarioError)
        from scipy.sparse import csr_matrix
        from scipy.sparse.csgraph import connected_components

        self.streets = streets = _streets(roads)
        count = len(roads.node_m)
        graph = csr_matrix((streets.time_s, (streets.start, streets.end)), shape=(count, count))
        _, label = connected_components(graph, connection="strong")
        best = int(np.argmax(np.bincount(label)))
        members = np.flatnonzero(label == best)
        neighbours = np.unique(np.sort(np.column_stack([streets.start, streets.end]), axis=1), axis=0)
        self.is_crossing = np.bincount(neighbours.ravel(), minlength=count) > 2
        if len(members) < 2:
            raise ScenarioError(f"{source}: no two points of its roads can be reached from each other")
        inside = (label[streets.start] == best) & (label[streets.end] == best)
        self._graph = csr_matrix(
            (streets.time_s[inside], (streets.start[inside], streets.end[inside])), shape=(count, count)
        )
        crossings = members[self.is_crossing[members]]
        self._destinations = crossings if len(crossings) else members  # at crossings no U-turn is needed
        self._key = streets.start * count + streets.end  # ascending
        self._count = count
        self._starts = np.flatnonzero(inside)
        step_m = roads.node_m[streets.end[self._starts]] - roads.node_m[streets.start[self._starts]]
        sum_m = np.cumsum(np.hypot(*step_m.T))
        self._starts_by_length = sum_m / sum_m[-1]

    def edge(self, start: Ints, end: Ints) -> Ints:
        """Return the edges (n,) between points `start` and `end` (n,)."""
        return np.asarray(np.searchsorted(self._key, start * self._count + end))

    def route(self, rng: np.random.Generator, least_s: float) -> Ints:
        """Return the points (n,) of a random route that takes at least `least_s`.

        It begins at a random edge and joins fastest paths to random destinations, without U-turns. It ends early
        where only a U-turn remains.
        """
        from scipy.sparse.csgraph import dijkstra

        for _ in range(TRIES):
            first = self._starts[np.searchsorted(self._starts_by_length, rng.random())]
            route = [int(self.streets.start[first]), int(self.streets.end[first])]
            if self._ahead(route):
                break
        taken_s = float(self.streets.time_s[first])
        while taken_s < least_s and (ahead := self._ahead(route)):
            time_s, before = dijkstra(self._graph, indices=route[-1], return_predecessors=True)
            destinations = self._destinations[rng.integers(len(self._destinations), size=TRIES)].tolist()
            legs = (_leg(before, route[-1], destination) for destination in destinations)
            leg = next((leg for leg in legs if leg and leg[0] != route[-2]), None)
            leg = leg or [ahead[rng.integers(len(ahead))]]  # every path begins with a U-turn: go on to a neighbour
            route += leg
            taken_s += float(time_s[leg[-1]])
        return np.array(route, dtype=np.intp)

    def _ahead(self, route: list[int]) -> list[int]:
        """Return the points that follow the end of a route without a U-turn."""
        row = slice(*self._graph.indptr[route[-1] : route[-1] + 2])
        return [point for point in self._graph.indices[row].tolist() if point != route[-2]]


def _streets(roads: Roads) -> Streets:
    """Return all edges in ascending order of their points; of several between two points only the fastest."""
    entry = roads.segment
    road = roads.road_of[entry]
    speed = np.array([_speed_m_s(name) for name in NAMES])[roads.kind[road]]
    time_s = np.maximum(roads.segment_length_m, 0.1) / speed
    ahead, back = roads.forward[road] > 0, roads.backward[road] > 0
    one, other = roads.node[entry], roads.node[entry + 1]
    start, end = np.concatenate([one[ahead], other[back]]), np.concatenate([other[ahead], one[back]])
    road_of, against = np.concatenate([road[ahead], road[back]]), np.repeat([0.0, 1.0], [ahead.sum(), back.sum()])
    speed_of, time_of = np.concatenate([speed[ahead], speed[back]]), np.concatenate([time_s[ahead], time_s[back]])
    order = np.lexsort((time_of, end, start))
    first = np.ones(len(order), dtype=np.bool_)
    first[1:] = (np.diff(start[order]) != 0) | (np.diff(end[order]) != 0)
    kept = order[first]
    return Streets(
        roads=roads,
        start=start[kept],
        end=end[kept],
        road=road_of[kept],
        against=against[kept],
        speed_m_s=speed_of[kept],
        time_s=time_of[kept],
    )


def _speed_m_s(name: str) -> float:
    base = name.removesuffix("_link")
    return SPEED_M_S[base] * (LINK_SHARE if base != name else 1.0)


def _leg(before: Ints, start: int, end: int) -> list[int]:
    """Return the points after `start` up to `end`; `before` (N,) are predecessors on the fastest paths."""
    found = []
    while end != start and end >= 0:
        found.append(end)
        end = int(before[end])
    return found[::-1]


@dataclass(frozen=True)
class Side:
    """The side of a road on which people drive (`sign` 1: right, -1: left).

    `aside_m` is their mean offset to the right of the lane's centre.
    """

    sign: float
    aside_m: float = 0.0


RIGHT, LEFT = Side(1.0), Side(-1.0)


def generate_motion(
    source: object, roads: Roads, vehicles: int, seed: int, periods: int, period_ns: int, side: Side = RIGHT
) -> Motion:
    """Return the motion of `vehicles` (v01, v02, …) through `roads` over `periods`, on this `side` of the roads.

    Raise ScenarioError, naming `source`, if no vehicle is present, or the truth does not fit into memory.
    """
    if vehicles * periods > MOST_STATES:
        raise ScenarioError(f"{vehicles} vehicles for {periods} periods: at most {MOST_STATES:,} states")
    network = StreetNetwork(source, roads)
    time_s = np.asarray(np.arange(periods) * (period_ns / NS_PER_S), dtype=np.float64)
    states = np.full((periods, vehicles, 3), np.nan)
    for number in range(vehicles):
        rng = np.random.default_rng((seed, number))
        states[:, number] = _Trip(network, rng, float(time_s[-1]), side).at(time_s)
    present = np.flatnonzero(np.isfinite(states[: periods - 1, :, 0]).any(axis=0))
    if not len(present):
        raise ScenarioError(
            f"{source}: no vehicle is present within {time_s[-1]:g} s; set more vehicles or a longer duration"
        )
    ids = numbered_ids(vehicles)
    return Motion(tuple(ids[number] for number in present.tolist()), states[:, present, :2], states[:, present, 2])


class _Trip:
    """One vehicle's trajectory: points `point_m` (S, 2), and the times of arrival and departure there."""

    def __init__(self, network: StreetNetwork, rng: np.random.Generator, duration_s: float, side: Side) -> None:
        self._rng = rng
        parked, late, early = rng.random(3) < (PARKED, LATE, EARLY)
        enters_s = duration_s * rng.uniform(0, 0.5) * late
        stays_s = (duration_s - enters_s) * (rng.uniform(0.4, 0.9) if early else 1.0)
        self._leaves_s = max(enters_s + stays_s, enters_s + SHORTEST_STAY_S) if early else math.inf
        route = network.route(rng, FASTEST_SHARE * stays_s)
        edge = network.edge(route[:-1], route[1:])
        offset_m, self._half_width_m = _lane(network.streets, edge, int(rng.integers(16)), side)
        line_m, speed_m_s, crossing = _centre_line(network, route, offset_m, network.streets.speed_m_s[edge])
        if parked:
            line_m, speed_m_s, crossing = _from_parking_lot(rng, line_m, speed_m_s, crossing, side.sign)
        self._follow(line_m, speed_m_s * rng.uniform(SLOWEST_SHARE, FASTEST_SHARE), crossing, parked, enters_s)

    def _follow(self, line_m: Array, speed_m_s: Array, crossing: Array, parked: bool, enters_s: float) -> None:
        """Divide the line into steps, and compute the times of arrival and departure at each."""
        long_m = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(line_m, axis=0).T))])
        along_m = np.arange(0, max(long_m[-1], 2 * STEP_M), STEP_M)
        point_m = np.column_stack([np.interp(along_m, long_m, axis) for axis in line_m.T])
        self.point_m = _smooth(point_m)
        of_line = np.minimum(np.searchsorted(long_m, along_m, side="right") - 1, len(speed_m_s) - 1)
        max_m_s = np.minimum(speed_m_s[of_line], _curve_speed_m_s(self.point_m))
        stops = np.zeros(len(along_m))
        for at_m in long_m[np.flatnonzero(crossing)].tolist():
            if self._rng.random() < STOPS_AT:
                stopped_s = min(1.0 + self._rng.exponential(STOPPED_S), LONGEST_STOP_S)
                stops[min(int(max(at_m - 3, 0) / STEP_M), len(stops) - 1)] = stopped_s
        if parked:
            stops[0] = self._rng.uniform(*PARKED_S)
        max_m_s[stops > 0] = 0.0
        speed = _reachable_m_s(max_m_s)
        took_s = STEP_M / np.maximum((speed[1:] + speed[:-1]) / 2, 0.25)
        self._arrives_s = enters_s + np.concatenate([[0], np.cumsum(took_s + stops[:-1])])
        self._departs_s = self._arrives_s + stops

    def at(self, time_s: Array) -> Array:
        """Return position and heading (K, 3) at these times; NaN while the vehicle is absent."""
        known_s = np.column_stack([self._arrives_s, self._departs_s]).ravel()
        along = np.interp(time_s, known_s, np.repeat(np.arange(len(self.point_m), dtype=float), 2))
        present = (time_s >= self._arrives_s[0]) & (time_s <= min(self._departs_s[-1], self._leaves_s))
        before = np.minimum(along.astype(np.intp), len(self.point_m) - 2)
        part = (along - before)[:, None]
        ahead = _headings(self.point_m)
        heading = ahead[before] + part[:, 0] * np.diff(np.append(ahead, ahead[-1]))[before]
        position_m = (1 - part) * self.point_m[before] + part * self.point_m[before + 1]
        right = np.column_stack([np.sin(heading), -np.cos(heading)])
        position_m += self._lateral_m(time_s, along)[:, None] * right
        state = np.column_stack([position_m, np.mod(heading, 2 * np.pi)])
        state[~present] = np.nan
        return state

    def _lateral_m(self, time_s: Array, along: Array) -> Array:
        """Return the offsets (K,) right of the lane's centre: a process that is paused while the vehicle stands."""
        step_s = float(time_s[1] - time_s[0]) if len(time_s) > 1 else 1.0
        moves = np.concatenate([[0], np.cumsum(np.diff(along) > 0.02 * step_s)])
        normal = self._rng.standard_normal(len(time_s))
        offset = lateral_offsets_m(normal, LATERAL_SIGMA_M, math.exp(-step_s / LATERAL_TAU_S), self._half_width_m)
        return np.asarray(offset[moves])


def _lane(streets: Streets, edge: Ints, number: int, side: Side) -> tuple[Array, float]:
    """Return the offsets (n,) of a lane to the right of the edges (n,) of a route, and half its least width.

    On each street it is lane `number` from the right, modulo the lanes in this direction.
    """
    roads = streets.roads
    road, against = streets.road[edge], streets.against[edge] > 0
    count = np.where(against, roads.backward[road], roads.forward[road])
    both = roads.forward[road] + roads.backward[road]
    width_m = roads.lane_width_m[road]
    # Lanes are counted from the road's edge, half its width from its centre line.
    from_right = np.minimum(number % np.maximum(count, 1), count - 1) + 0.5
    half_width_m = max(float(((width_m - VEHICLE_WIDTH_M) / 2).min()), MIN_HALF_WIDTH_M)
    return side.sign * (both / 2 - from_right) * width_m + side.aside_m, half_width_m


def _centre_line(
    network: StreetNetwork, route: Ints, offset_m: Array, edge_speed_m_s: Array
) -> tuple[Array, Array, Array]:
    """Return a lane's centre line (n, 2), the speed from each point on, and a mask of points at crossings."""
    node_m = network.streets.roads.node_m[route]
    step = np.diff(node_m, axis=0)
    length_m = np.maximum(np.hypot(*step.T), 1e-6)
    ahead = step / length_m[:, None]
    right = np.column_stack([ahead[:, 1], -ahead[:, 0]])
    start = node_m[:-1] + offset_m[:, None] * right
    end = node_m[1:] + offset_m[:, None] * right
    heading = np.arctan2(ahead[:, 1], ahead[:, 0])
    turn = np.abs(np.mod(np.diff(heading) + np.pi, 2 * np.pi) - np.pi)
    points, speed, crossing = [start[:1]], [edge_speed_m_s[0]], [False]
    is_crossing = network.is_crossing[route[1:-1]]
    for k in range(len(turn)):
        if turn[k] > CORNER_RAD:
            cut = min(CORNER_M, 0.45 * length_m[k], 0.45 * length_m[k + 1])
            arc = _arc(end[k] - cut * ahead[k], ahead[k], start[k + 1] + cut * ahead[k + 1], ahead[k + 1])
        else:
            arc = (end[k : k + 1] + start[k + 1 : k + 2]) / 2
        points.append(arc)
        speed += [edge_speed_m_s[k + 1]] * len(arc)
        crossing += [bool(is_crossing[k])] + [False] * (len(arc) - 1)
    points.append(end[-1:])
    return np.concatenate(points), np.array(speed), np.array([*crossing, False])


def _arc(start: Array, ahead: Array, end: Array, then: Array) -> Array:
    """Return a quadratic Bézier curve (7, 2) from `start` in direction `ahead` to `end` in direction `then`."""
    between = end - start
    cross = ahead[0] * then[1] - ahead[1] * then[0]
    reach = (between[0] * then[1] - between[1] * then[0]) / cross if abs(cross) > 0.05 else -1.0
    corner = start + reach * ahead if 0 < reach < 4 * CORNER_M else (start + end) / 2 + 2.0 * ahead
    t = np.linspace(0, 1, 7)[:, None]
    return np.asarray((1 - t) ** 2 * start + 2 * t * (1 - t) * corner + t**2 * end)


def _from_parking_lot(
    rng: np.random.Generator, line_m: Array, speed_m_s: Array, crossing: Array, sign: float
) -> tuple[Array, Array, Array]:
    """Return the line with a path to its start from a parking lot: on the right if `sign` is 1, left if -1."""
    ahead = line_m[1] - line_m[0]
    ahead /= max(float(np.hypot(*ahead)), 1e-6)
    right = sign * np.array([ahead[1], -ahead[0]])
    offset_m = rng.uniform(*PARKED_OFFSET_M)
    lot = line_m[0] + offset_m * right - 10.0 * ahead
    arc = _arc(lot, -right, line_m[0], ahead)
    return (
        np.concatenate([arc[:-1], line_m]),
        np.concatenate([np.full(len(arc) - 1, 4.0), speed_m_s]),
        np.concatenate([np.zeros(len(arc) - 1, dtype=np.bool_), crossing]),
    )


def _smooth(point_m: Array) -> Array:
    """Return moving averages (S, 2) over `SMOOTH_STEPS` points; both ends stay."""
    if len(point_m) <= SMOOTH_STEPS:
        return point_m
    half = SMOOTH_STEPS // 2
    smooth = point_m.copy()
    total = np.cumsum(np.concatenate([np.zeros((1, 2)), point_m]), axis=0)
    smooth[half:-half] = (total[SMOOTH_STEPS:] - total[:-SMOOTH_STEPS]) / SMOOTH_STEPS
    return smooth


def _headings(point_m: Array) -> Array:
    """Return unwrapped headings (S,) along a line, from the points before and after each."""
    step = np.gradient(point_m, axis=0)
    return np.asarray(np.unwrap(np.arctan2(step[:, 1], step[:, 0])))


def _curve_speed_m_s(point_m: Array) -> Array:
    """Return the speeds (S,) at which a line (S, 2) is driven with a lateral acceleration of `LATERAL_MPS2`."""
    curvature = np.abs(np.gradient(_headings(point_m))) / STEP_M
    return np.maximum(np.sqrt(LATERAL_MPS2 / np.maximum(curvature, 1e-6)), SLOWEST_MPS)


def _reachable_m_s(max_m_s: Array) -> Array:
    """Return the highest speeds (S,) below `max_m_s` that acceleration and deceleration allow."""
    square = (max_m_s**2).tolist()
    for k in range(1, len(square)):
        square[k] = min(square[k], square[k - 1] + 2 * STARTING_MPS2 * STEP_M)
    for k in range(len(square) - 2, -1, -1):
        square[k] = min(square[k], square[k + 1] + 2 * BRAKING_MPS2 * STEP_M)
    return np.asarray(np.sqrt(np.array(square)))
