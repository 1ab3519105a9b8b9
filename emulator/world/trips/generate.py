"""Generated trips along a map: from anywhere to anywhere, in lanes, with bends, turns and stops.

Each vehicle is drawn from a stream of its own, so that one more changes nothing for the others. A route becomes the
middle of a lane, corners become arcs, and speeds follow: what its streets allow, a lateral acceleration of
`LATERAL_MPS2` in bends and turns, stops at some crossings, and `STARTING_MPS2` and `BRAKING_MPS2` between. Vehicles
do not see each other. Some come from a parking lot beside the road, some enter late, and some leave early.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from emulator.world.lateral import stray
from emulator.world.maps.classes import VEHICLE_WIDTH_M
from emulator.world.maps.roads import Ints, Roads
from emulator.world.trips.motion import MOST_STATES, SHORTEST_STAY_S, Motion
from emulator.world.trips.routes import Network
from vnet.errors import ScenarioError
from vnet.types import Array
from vnet.units import NS_PER_S

LATERAL_MPS2, STARTING_MPS2, BRAKING_MPS2 = 2.5, 2.0, 2.5
SLOWEST_MPS = 1.5
"""Through the tightest turn."""
STOPS_AT = 0.3
"""So many of the crossings make a vehicle stop, for `STOPPED_S` in the mean."""
STOPPED_S, LONGEST_STOP_S = 8.0, 40.0
PARKED, LATE, EARLY = 0.15, 0.2, 0.2
"""Shares of vehicles that come from a parking lot, that enter during the run, and that leave during it."""
PARKED_ASIDE_M, PARKED_S = (7.0, 18.0), (5.0, 40.0)
STRAY_SIGMA_M, STRAY_TAU_S, NARROWEST_M = 0.3, 20.0, 0.3
SLOWEST_SHARE, FASTEST_SHARE = 0.85, 1.05
"""Of what is usual on a road."""
STEP_M, SMOOTH_STEPS = 1.0, 5
"""A way is followed in steps of this length, over so many of which its last corners are rounded."""
CORNER_RAD, CORNER_M = 0.35, 8.0
"""What turns by more is a corner, and is cut by an arc from so far before it to so far after it."""


@dataclass(frozen=True)
class Side:
    """On which side of a road people drive, and how far right of their lane's middle, in the mean."""

    sign: float
    aside_m: float = 0.0


RIGHT, LEFT = Side(1.0), Side(-1.0)


def generate_motion(
    source: object, roads: Roads, vehicles: int, seed: int, periods: int, period_ns: int, side: Side = RIGHT
) -> Motion:
    """How `vehicles` (v01, v02, …) drive through `roads` over so many periods, on which `side` of them.

    Raises ScenarioError, naming `source`, if nobody drives there, or the truth does not fit into memory.
    """
    if vehicles * periods > MOST_STATES:
        raise ScenarioError(f"{vehicles} vehicles for {periods} periods: at most {MOST_STATES:,} states")
    network = Network(source, roads)
    time_s = np.asarray(np.arange(periods) * (period_ns / NS_PER_S), dtype=np.float64)
    states = np.full((periods, vehicles, 3), np.nan)
    for number in range(vehicles):
        rng = np.random.default_rng((seed, number))
        states[:, number] = _Trip(network, rng, float(time_s[-1]), side).at(time_s)
    there = np.flatnonzero(np.isfinite(states[: periods - 1, :, 0]).any(axis=0))
    if not len(there):
        raise ScenarioError(f"{source}: nobody drives there within {time_s[-1]:g} s: more vehicles, or for longer?")
    width = len(str(vehicles))
    ids = tuple(f"v{number + 1:0{max(2, width)}d}" for number in there.tolist())
    return Motion(ids, states[:, there, :2], states[:, there, 2])


class _Trip:
    """One vehicle's way: `place_m` (S, 2) every metre, and when it is at each of them, `when_s` (S,)."""

    def __init__(self, network: Network, rng: np.random.Generator, duration_s: float, side: Side) -> None:
        self._rng = rng
        parked, late, early = rng.random(3) < (PARKED, LATE, EARLY)
        enters_s = duration_s * rng.uniform(0, 0.5) * late
        stays_s = (duration_s - enters_s) * (rng.uniform(0.4, 0.9) if early else 1.0)
        self._leaves_s = max(enters_s + stays_s, enters_s + SHORTEST_STAY_S) if early else math.inf
        way = network.route(rng, FASTEST_SHARE * stays_s)
        edge = network.edge(way[:-1], way[1:])
        lane = _Lane(network, edge, int(rng.integers(16)), side)
        line_m, speed_m_s, crossing = lane.line(way)
        if parked:
            line_m, speed_m_s, crossing = _from_parking_lot(rng, line_m, speed_m_s, crossing, side.sign)
        self._room_m = lane.room_m
        self._follow(line_m, speed_m_s * rng.uniform(SLOWEST_SHARE, FASTEST_SHARE), crossing, parked, enters_s)
        self._stray = rng.standard_normal

    def _follow(self, line_m: Array, speed_m_s: Array, crossing: Array, parked: bool, enters_s: float) -> None:
        """Divide the line into steps, and work out when the vehicle is where."""
        long_m = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(line_m, axis=0).T))])
        along_m = np.arange(0, max(long_m[-1], 2 * STEP_M), STEP_M)
        place = np.column_stack([np.interp(along_m, long_m, axis) for axis in line_m.T])
        self.place_m = _smooth(place)
        of_line = np.minimum(np.searchsorted(long_m, along_m, side="right") - 1, len(speed_m_s) - 1)
        limit = np.minimum(speed_m_s[of_line], _bend_speed_m_s(self.place_m))
        stops = np.zeros(len(along_m))
        for at_m in long_m[np.flatnonzero(crossing)].tolist():
            if self._rng.random() < STOPS_AT:
                stops[min(int(max(at_m - 3, 0) / STEP_M), len(stops) - 1)] = self._stopped_s()
        if parked:
            stops[0] = self._rng.uniform(*PARKED_S)
        limit[stops > 0] = 0.0
        speed = _reachable_m_s(limit)
        took_s = STEP_M / np.maximum((speed[1:] + speed[:-1]) / 2, 0.25)
        self._arrives_s = enters_s + np.concatenate([[0], np.cumsum(took_s + stops[:-1])])
        self._departs_s = self._arrives_s + stops

    def _stopped_s(self) -> float:
        return min(1.0 + self._rng.exponential(STOPPED_S), LONGEST_STOP_S)

    def at(self, time_s: Array) -> Array:
        """Position and heading (K, 3) at these times, NaN where the vehicle is not there."""
        known_s = np.column_stack([self._arrives_s, self._departs_s]).ravel()
        along = np.interp(time_s, known_s, np.repeat(np.arange(len(self.place_m), dtype=float), 2))
        there = (time_s >= self._arrives_s[0]) & (time_s <= min(self._departs_s[-1], self._leaves_s))
        before = np.minimum(along.astype(np.intp), len(self.place_m) - 2)
        part = (along - before)[:, None]
        ahead = _headings(self.place_m)
        heading = ahead[before] + part[:, 0] * np.diff(np.append(ahead, ahead[-1]))[before]
        place = (1 - part) * self.place_m[before] + part * self.place_m[before + 1]
        place += self._aside(time_s, along)[:, None] * np.column_stack([np.sin(heading), -np.cos(heading)])
        state = np.column_stack([place, np.mod(heading, 2 * np.pi)])
        state[~there] = np.nan
        return state

    def _aside(self, time_s: Array, along: Array) -> Array:
        """How far right of the lane's middle: a process that stands still while the vehicle does."""
        step_s = float(time_s[1] - time_s[0]) if len(time_s) > 1 else 1.0
        moves = np.concatenate([[0], np.cumsum(np.diff(along) > 0.02 * step_s)])
        normal = self._stray(len(time_s))
        offset = stray(normal, STRAY_SIGMA_M, math.exp(-step_s / STRAY_TAU_S), self._room_m)
        return np.asarray(offset[moves])


class _Lane:
    """The lane of a way: on each street the `number`-th from the right of those in its direction, if there is."""

    def __init__(self, network: Network, edge: Ints, number: int, side: Side) -> None:
        streets = network.streets
        roads = streets.roads
        self._network, self._node_m = network, roads.node_m
        road, against = streets.road[edge], streets.against[edge] > 0
        count = np.where(against, roads.backward[road], roads.forward[road])
        both = roads.forward[road] + roads.backward[road]
        width_m = roads.lane_width_m[road]
        # The right-hand edge of the road is half its width off its line; lanes are counted from there.
        from_right = np.minimum(number % np.maximum(count, 1), count - 1) + 0.5
        self._aside_m = side.sign * (both / 2 - from_right) * width_m + side.aside_m
        self._speed_m_s = streets.speed_m_s[edge]
        self.room_m = max(float(((width_m - VEHICLE_WIDTH_M) / 2).min()), NARROWEST_M)

    def line(self, way: Ints) -> tuple[Array, Array, Array]:
        """The lane's middle (n, 2), the speed allowed from each point on, and which are before a crossing."""
        node_m = self._node_m[way]
        step = np.diff(node_m, axis=0)
        length_m = np.maximum(np.hypot(*step.T), 1e-6)
        ahead = step / length_m[:, None]
        right = np.column_stack([ahead[:, 1], -ahead[:, 0]])
        start = node_m[:-1] + self._aside_m[:, None] * right
        end = node_m[1:] + self._aside_m[:, None] * right
        heading = np.arctan2(ahead[:, 1], ahead[:, 0])
        turn = np.abs(np.mod(np.diff(heading) + np.pi, 2 * np.pi) - np.pi)
        points, speed, crossing = [start[:1]], [self._speed_m_s[0]], [False]
        is_crossing = self._network.is_crossing[way[1:-1]]
        for k in range(len(turn)):
            if turn[k] > CORNER_RAD:
                cut = min(CORNER_M, 0.45 * length_m[k], 0.45 * length_m[k + 1])
                arc = _arc(end[k] - cut * ahead[k], ahead[k], start[k + 1] + cut * ahead[k + 1], ahead[k + 1])
            else:
                arc = (end[k : k + 1] + start[k + 1 : k + 2]) / 2
            points.append(arc)
            speed += [self._speed_m_s[k + 1]] * len(arc)
            crossing += [bool(is_crossing[k])] + [False] * (len(arc) - 1)
        points.append(end[-1:])
        return np.concatenate(points), np.array(speed), np.array([*crossing, False])


def _arc(start: Array, ahead: Array, end: Array, then: Array) -> Array:
    """A quadratic Bézier curve (7, 2) from `start` to `end`, which leave and arrive in these directions."""
    between = end - start
    cross = ahead[0] * then[1] - ahead[1] * then[0]
    reach = (between[0] * then[1] - between[1] * then[0]) / cross if abs(cross) > 0.05 else -1.0
    corner = start + reach * ahead if 0 < reach < 4 * CORNER_M else (start + end) / 2 + 2.0 * ahead
    t = np.linspace(0, 1, 7)[:, None]
    return np.asarray((1 - t) ** 2 * start + 2 * t * (1 - t) * corner + t**2 * end)


def _from_parking_lot(
    rng: np.random.Generator, line_m: Array, speed_m_s: Array, crossing: Array, sign: float
) -> tuple[Array, Array, Array]:
    """The line, with a way to its start from a place beside the road: on the right if `sign` is 1, left if -1."""
    ahead = line_m[1] - line_m[0]
    ahead /= max(float(np.hypot(*ahead)), 1e-6)
    right = sign * np.array([ahead[1], -ahead[0]])
    aside_m = rng.uniform(*PARKED_ASIDE_M)
    lot = line_m[0] + aside_m * right - 10.0 * ahead
    arc = _arc(lot, -right, line_m[0], ahead)
    return (
        np.concatenate([arc[:-1], line_m]),
        np.concatenate([np.full(len(arc) - 1, 4.0), speed_m_s]),
        np.concatenate([np.zeros(len(arc) - 1, dtype=np.bool_), crossing]),
    )


def _smooth(place_m: Array) -> Array:
    """Means (S, 2) over `SMOOTH_STEPS` steps; both ends stay."""
    if len(place_m) <= SMOOTH_STEPS:
        return place_m
    half = SMOOTH_STEPS // 2
    smooth = place_m.copy()
    total = np.cumsum(np.concatenate([np.zeros((1, 2)), place_m]), axis=0)
    smooth[half:-half] = (total[SMOOTH_STEPS:] - total[:-SMOOTH_STEPS]) / SMOOTH_STEPS
    return smooth


def _headings(place_m: Array) -> Array:
    """Unwound headings (S,) along a line, from the points before and after each."""
    step = np.gradient(place_m, axis=0)
    return np.asarray(np.unwrap(np.arctan2(step[:, 1], step[:, 0])))


def _bend_speed_m_s(place_m: Array) -> Array:
    """What the bends of a line (S, 2) allow at each of its points."""
    curvature = np.abs(np.gradient(_headings(place_m))) / STEP_M
    return np.maximum(np.sqrt(LATERAL_MPS2 / np.maximum(curvature, 1e-6)), SLOWEST_MPS)


def _reachable_m_s(limit: Array) -> Array:
    """Speeds (S,) within limits, with what a vehicle can do from one step to the next. It comes at speed."""
    square = (limit**2).tolist()
    for k in range(1, len(square)):
        square[k] = min(square[k], square[k - 1] + 2 * STARTING_MPS2 * STEP_M)
    for k in range(len(square) - 2, -1, -1):
        square[k] = min(square[k], square[k + 1] + 2 * BRAKING_MPS2 * STEP_M)
    return np.asarray(np.sqrt(np.array(square)))
