"""Map matching: how likely it is that a vehicle is on a lane of the map.

For a straight lane with normal n and signed offset d of the vehicle's mean, and s² = nᵀP n,

    P(on the lane) = Φ((h − d)/s) − Φ((−h − d)/s)

with h the half-width left to a vehicle's centre. Near the lane Φ comes from a table, because exact ones take a
fifth of the filter's time: log P is off by less than 2·10⁻⁶ for s up to 10 m, and mostly by 10⁻⁹. Far from the
lane it is exact, in the log domain, so that it neither underflows nor cancels: a filter whose particles all score
exactly 0 has lost its way for good.

On the map of a city a vehicle has several candidates, `MAX_LANES` at most, which are sought again as it drives: the
lanes near where it is believed to be that fit its heading. They are hypotheses that exclude each other, so their
probabilities add up; that it is off every road, on a parking lot or on a road that the map does not have, is one
more:

    L = log[ Σ P(on lane) + o / (1 − o) · Σ h / b ]

with o the share of vehicles off the road, and those anywhere within ± b of a road, against ± h of a lane.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, ndtr

from vnet.roads.lanes import LaneMap
from vnet.roads.road_map import HEADING_TOLERANCE_RAD, RoadMap
from vnet.types import Array

FAR_SIGMAS = 5.0
"""Deviations outside the lane beyond which log P is exact: the difference of two Φ would lose its digits."""

MIN_MAP_LOG_LIKELIHOOD = -6.0
"""Least log-likelihood of being on the road that programs use: a truncated likelihood, so that a vehicle whose
fixes are false says the same of all hypotheses and cannot outvote the others (Huber and Ronchetti 2009,
redescending M-estimators). On a wide lane −6 is reached 2.8 deviations beyond its edge."""

STEPS = 128
"""Steps of the table of Φ in a deviation. A finer table drops out of the processor's cache between two steps of the
filter, and is then no faster than the exact Φ."""
REACH = 9
"""Deviations beyond which the table is 0 or 1, true to 10⁻¹⁸."""

MAX_LANES = 4
"""Number of candidates of a vehicle in a city, the nearest: one direction of a road has no more."""
OFF_ROAD_WITHIN_M = 15.0
"""Distance (m) from a road within which vehicles off the road are: parking lots are no deeper, as a rule."""

OFF_MAP_M = 30.0
"""Distance (m) from every lane that fits beyond which a vehicle is not on this map: its road is no evidence."""


def log_on_lane(offset_m: Array, sigma_m: Array, half_width_m: float) -> Array:
    """Return log P(on the lane) for offsets (..., K) and deviations that broadcast against them; metres."""
    near = np.abs(offset_m)
    np.subtract(half_width_m, near, out=near)
    near /= sigma_m
    beyond = near - 2 * half_width_m / sigma_m
    inside = normal_cdf(near)
    inside -= normal_cdf(beyond)
    far = near <= -FAR_SIGMAS
    inside[far] = 1.0
    result = np.log(inside, out=inside)
    if far.any():
        # log(Φ(a) − Φ(b)) = log Φ(a) + log(1 − Φ(b)/Φ(a)), a > b.
        upper = log_ndtr(near[far])
        result[far] = upper + np.log1p(-np.exp(log_ndtr(beyond[far]) - upper))
    return np.asarray(result)


def _parabolas() -> tuple[Array, Array, Array]:
    """Return the parabolas through Φ at the start, the middle and the end of each step of the table, by powers."""
    value = ndtr(np.arange(-2 * STEPS * REACH, 2 * STEPS * REACH + 1) / (2 * STEPS))
    start, middle, end = value[:-1:2], value[1::2], value[2::2]
    slope, bend = 4 * middle - 3 * start - end, 2 * (start - 2 * middle + end)
    slope[[0, -1]] = bend[[0, -1]] = 0.0  # what is beyond the table gets its first or last step, and is constant
    return start.copy(), slope, bend


_START, _SLOPE, _BEND = _parabolas()


def normal_cdf(x: Array) -> Array:
    """Return Φ(x) by table, off by less than 2·10⁻⁹, and for x ≥ −FAR_SIGMAS by less than 5·10⁻⁷ of its value."""
    fraction = x + REACH
    fraction *= STEPS
    step = fraction.astype(np.intp)
    fraction -= step
    value = _BEND.take(step, mode="clip")
    for coefficient in (_SLOPE, _START):
        value *= fraction
        value += coefficient.take(step, mode="clip")
    return np.asarray(value)


def log_left_of_edge(offset_m: Array, sigma_m: Array, half_width_m: float) -> Array:
    """Return log P(not beyond the right-hand edge): the paper's lane is the half-plane n·(p − p_lane) < h."""
    return np.asarray(log_ndtr((half_width_m - offset_m) / sigma_m))


def candidate_lanes(
    lanes: LaneMap,
    position_m: Array,
    heading_rad: float | None,
    gate_m: float,
    heading_tolerance_rad: float = HEADING_TOLERANCE_RAD,
) -> NDArray[np.intp]:
    """Return the lanes that a vehicle may be on: within `gate_m` of `position_m` (2,), and fitting its heading if
    known.

    Without a heading all lanes within the gate compete. With none in the gate, the nearest that fits, unless even
    that is too far away to be the vehicle's.
    """
    offset = np.abs(lanes.normal @ position_m - lanes.offset_m)
    fits = np.ones(len(lanes), dtype=bool)
    if heading_rad is not None:
        turn = np.abs(np.mod(lanes.heading_rad - heading_rad + np.pi, 2 * np.pi) - np.pi)
        fits = turn <= heading_tolerance_rad
    if not fits.any():
        return np.empty(0, dtype=np.intp)
    found = np.flatnonzero(fits & (offset <= gate_m))
    if len(found):
        return found
    nearest = int(np.argmin(np.where(fits, offset, np.inf)))
    return np.array([nearest] if offset[nearest] <= OFF_MAP_M else [], dtype=np.intp)


Rows = NDArray[np.intp]


class Matcher(Protocol):
    """The interface of a map to a filter: the lanes that a vehicle may be on, and its likelihood of being on one.

    drives: whether vehicles drive, so that their lanes are sought at each update.
    heading_rad: (L,), the headings of the lanes.
    """

    drives: bool
    heading_rad: Array

    def seek(self, position_m: Array, heading_rad: Array, gate_m: Array) -> tuple[Rows, Rows]:
        """Seek lanes within gates (m,) of (m, 2) that fit headings (m,), NaN if unknown: rows and lanes, by row."""
        ...

    def log_likelihood(self, position_m: Array, covariance_m2: Array, row: Rows, lane: Rows, count: int) -> Array:
        """Return log P(on a road) of `count` vehicles, (count, K); `row` (E,), `lane` (E,) are their candidates, by
        row.

        Positions (E, 2, K) and covariances (E, 2, 2) are the vehicles' of each candidate. Without a candidate: 0.
        """
        ...


class StraightLanes:
    """Matching of vehicles that stand to straight lanes (`LaneMap`): each keeps the candidates of its first fix.

    `one_sided` lanes are bounded on their right only; no log-likelihood is below `min_map_log_likelihood`.
    """

    drives = False

    def __init__(self, lanes: LaneMap, one_sided: bool, min_map_log_likelihood: float) -> None:
        self.heading_rad = lanes.heading_rad
        self._lanes = lanes
        self._normal, self._offset_m = lanes.normal, lanes.offset_m
        self._score = log_left_of_edge if one_sided else log_on_lane
        self._min = min_map_log_likelihood

    def seek(self, position_m: Array, heading_rad: Array, gate_m: Array) -> tuple[Rows, Rows]:
        """See `Matcher`."""
        headings = [None if np.isnan(heading) else heading for heading in heading_rad.tolist()]
        found = [
            candidate_lanes(self._lanes, *vehicle)
            for vehicle in zip(position_m, headings, gate_m.tolist(), strict=True)
        ]
        row = np.repeat(np.arange(len(found)), [len(lanes) for lanes in found])
        return row, np.concatenate([*found, np.empty(0, dtype=np.intp)])

    def log_likelihood(self, position_m: Array, covariance_m2: Array, row: Rows, lane: Rows, count: int) -> Array:
        """See `Matcher`."""
        offset_m, sigma_m = _across(self._normal[lane], self._offset_m[lane], position_m, covariance_m2)
        score = self._score(offset_m, sigma_m, self._lanes.half_width_m)
        if self._min > -np.inf:
            np.maximum(score, self._min, out=score)
        if len(row) == count and np.array_equal(row, np.arange(count)):
            return score
        return _by_row(np.logaddexp, score, row, count)


class CityRoads:
    """Matching of vehicles that drive to the map of a city (`RoadMap`); the share `off_road` is on no road."""

    drives = True

    def __init__(self, roads: RoadMap, off_road: float) -> None:
        self.heading_rad = roads.heading_rad
        self._roads = roads
        self._lanes = int(roads.lane.max(initial=0)) + 1
        self._off_road = off_road / (1 - off_road) / OFF_ROAD_WITHIN_M

    def seek(self, position_m: Array, heading_rad: Array, gate_m: Array) -> tuple[Rows, Rows]:
        """See `Matcher`; of each lane only its nearest segment counts, as if it had no end."""
        row, segment, _ = self._roads.near(position_m, heading_rad, gate_m)
        number = row * self._lanes + self._roads.lane[segment]
        _, first = np.unique(number, return_index=True)  # the nearest: they come by row, and then by distance
        first.sort()
        row, segment = row[first], segment[first]
        is_near = np.arange(len(row)) - np.searchsorted(row, row) < MAX_LANES
        return row[is_near], segment[is_near]

    def log_likelihood(self, position_m: Array, covariance_m2: Array, row: Rows, lane: Rows, count: int) -> Array:
        """See `Matcher`."""
        roads = self._roads
        offset_m, sigma_m = _across(roads.normal[lane], roads.offset_m[lane], position_m, covariance_m2)
        if roads.sigma_m:
            sigma_m = np.hypot(sigma_m, roads.sigma_m)
        half_width_m = roads.half_width_m[lane][:, None]
        inside = normal_cdf((half_width_m - offset_m) / sigma_m)
        inside -= normal_cdf((-half_width_m - offset_m) / sigma_m)
        inside += self._off_road * half_width_m
        np.maximum(inside, 1e-300, out=inside)
        return np.log(_by_row(np.add, inside, row, count, 1.0))


def matcher(lanes: LaneMap | RoadMap, one_sided: bool, min_map_log_likelihood: float, off_road: float) -> Matcher:
    """Return the matching for a map of this kind."""
    if isinstance(lanes, RoadMap):
        return CityRoads(lanes, off_road)
    return StraightLanes(lanes, one_sided, min_map_log_likelihood)


def _across(normal: Array, offset_m: Array, position_m: Array, covariance_m2: Array) -> tuple[Array, Array]:
    """Return signed offsets (E, K) from lanes with normals (E, 2) and n·p (E,), and their deviations (E, 1)."""
    normal = normal[:, None, :]
    offset = (normal @ position_m)[:, 0]
    offset -= offset_m[:, None]
    across = (normal @ covariance_m2 @ normal.transpose(0, 2, 1))[:, 0, 0]
    return offset, np.sqrt(across)[:, None]


def _by_row(add: np.ufunc, score: Array, row: Rows, count: int, nothing: float = 0.0) -> Array:
    """Add scores (E, K) up by row (E,), (count, K); `nothing` where a row has none."""
    result = np.full((count, score.shape[1]), nothing)
    if len(row):
        first = np.flatnonzero(np.diff(row, prepend=-1))  # entries of a row stand together
        result[row[first]] = add.reduceat(score, first, axis=0)
    return result
