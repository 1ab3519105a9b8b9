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

Map evidence weighs a filter's particles. The map tells of a vehicle's offset in its lane, which changes over many
seconds. Counted as independent evidence ten times a second it would make the filter far too sure of itself. So what
counts of L is its *change*,

    log w += L_t − (1 − ρ) L_{t−1},

with ρ = Δt / τ the share of new evidence: the latest evaluation replaces the one before. For that reason
evaluations may be rare: in each step of 0.1 s the map is evaluated for half the vehicles.
"""

from __future__ import annotations

from functools import cache
from typing import Protocol

import numpy as np
import scipy  # its parts are imported when they are first used: `special` takes a third of a second
from numpy.typing import NDArray

from agents.cooperative.cmm.common_error import CommonErrorParticles
from agents.cooperative.cmm.tracks import SAME_TIME_S, Rows, Tracks
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
        upper = scipy.special.log_ndtr(near[far])
        result[far] = upper + np.log1p(-np.exp(scipy.special.log_ndtr(beyond[far]) - upper))
    return np.asarray(result)


@cache
def _parabolas() -> tuple[Array, Array, Array]:
    """Return the parabolas through Φ at the start, the middle and the end of each step of the table, by powers."""
    value = scipy.special.ndtr(np.arange(-2 * STEPS * REACH, 2 * STEPS * REACH + 1) / (2 * STEPS))
    start, middle, end = value[:-1:2], value[1::2], value[2::2]
    slope, bend = 4 * middle - 3 * start - end, 2 * (start - 2 * middle + end)
    slope[[0, -1]] = bend[[0, -1]] = 0.0  # what is beyond the table gets its first or last step, and is constant
    return start.copy(), slope, bend


def normal_cdf(x: Array) -> Array:
    """Return Φ(x) by table, off by less than 2·10⁻⁹, and for x ≥ −FAR_SIGMAS by less than 5·10⁻⁷ of its value."""
    start, slope, bend = _parabolas()
    fraction = x + REACH
    fraction *= STEPS
    step = fraction.astype(np.intp)
    fraction -= step
    value = bend.take(step, mode="clip")
    for coefficient in (slope, start):
        value *= fraction
        value += coefficient.take(step, mode="clip")
    return np.asarray(value)


def log_left_of_edge(offset_m: Array, sigma_m: Array, half_width_m: float) -> Array:
    """Return log P(not beyond the right-hand edge): the paper's lane is the half-plane n·(p − p_lane) < h."""
    return np.asarray(scipy.special.log_ndtr((half_width_m - offset_m) / sigma_m))


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


MAP_UPDATE_S = 0.2
"""Time (s) between two evaluations of the map for a vehicle: every other step, by odd and even rows."""
TURN_RAD = 0.5
"""Turn (rad) since the last new evidence beyond which a vehicle drives on another road."""
STAND_M = 5.0
"""Way (m) since the last new evidence below which a vehicle stands, for all that its fixes can tell."""
MIN_GATE_M = 3.0
"""Margin (m) added to three deviations when lanes are sought: half a lane and an error of the map."""
MAX_GATE_M = 25.0
"""Distance (m) within which lanes are sought at most: beyond it another street is as near."""


class MapEvidence:
    """The update of the particles from the map.

    lateral_tau_s: time in which a vehicle's offset in a straight lane is renewed.
    lateral_m: direction in which it is, on the map of a city.
    """

    def __init__(self, matcher: Matcher, lateral_tau_s: float, lateral_m: float) -> None:
        self.matcher = matcher
        self._lateral_tau_s = lateral_tau_s
        self._lateral_m = lateral_m

    @property
    def drives(self) -> bool:
        """True if vehicles drive on this map, so that their lanes are sought at each update."""
        return self.matcher.drives

    def first_lanes(self, position_m: Array, heading_rad: float | None, gate_m: float) -> Rows:
        """Lanes for a new vehicle near (2,). None on the map of a city, where each update seeks them."""
        if self.drives:
            return np.empty(0, dtype=np.intp)
        heading = np.array([np.nan if heading_rad is None else heading_rad])
        _, lanes = self.matcher.seek(position_m[None], heading, np.array([gate_m]))
        return lanes

    def update(self, tracks: Tracks, particles: CommonErrorParticles, rows: Rows) -> None:
        """Weight the particles by the change of the map's log-likelihood, for those of `rows` that are due."""
        since_s = tracks.table["since_map_update_s"][rows]
        due = since_s > MAP_UPDATE_S - SAME_TIME_S
        rows, since_s = rows[due], since_s[due]
        replaced = np.maximum(0.0, 1 - since_s / self._lateral_tau_s)
        if self.drives and len(rows):
            rows, since_s, replaced = self._seek_lanes(tracks, particles, rows, since_s)
        if not len(rows) or not len(tracks.candidate_lane):
            return
        log_likelihood = self.log_likelihood(tracks, tracks.mean, rows)
        tracks.table["since_map_update_s"][rows] = MAP_UPDATE_S / 2 * (np.isinf(since_s) & (rows % 2 == 1))
        particles.log_weight += log_likelihood.sum(axis=0) - replaced @ tracks.map_log_likelihood[rows]
        tracks.map_log_likelihood[rows] = log_likelihood

    def update_in_full(self, tracks: Tracks, particles: CommonErrorParticles) -> None:
        """Weight the particles by the map's log-likelihood of all vehicles, as new evidence: the paper's update."""
        if self.drives and len(tracks):
            self._seek_lanes(tracks, particles, np.arange(len(tracks)), tracks.table["since_map_update_s"])
        tracks.map_log_likelihood = self.log_likelihood(tracks, tracks.mean)
        particles.log_weight = particles.log_weight + tracks.map_log_likelihood.sum(axis=0)

    def log_likelihood(self, tracks: Tracks, mean: Array, rows: Rows | None = None) -> Array:
        """Return log P(vehicle on a road), (M, K), for means (M, 4, K): the candidate lanes as a mixture.

        With `rows`, in ascending order, only of these vehicles, (len(rows), K). It is 0 for one without a lane.
        """
        if rows is None:
            rows = np.arange(len(tracks))
        vehicle, lane = tracks.candidates(rows)
        row = np.searchsorted(rows, vehicle)
        covariance_m2 = tracks.covariance[vehicle, :2, :2]
        return self.matcher.log_likelihood(mean[vehicle, :2], covariance_m2, row, lane, len(rows))

    def _seek_lanes(
        self, tracks: Tracks, particles: CommonErrorParticles, rows: Rows, since_s: Array
    ) -> tuple[Rows, Array, Array]:
        """Seek the lanes on which the vehicles `rows`, which drive, may be now.

        Returns the rows that have any, their `since_s`, and the share (m,) of their evidence so far that the new
        evaluation replaces.
        """
        middle_m, gate_m = _neighbourhood(tracks, particles.weight, rows)
        found, lane = self.matcher.seek(middle_m, tracks.table["heading_rad"][rows], gate_m)
        tracks.set_candidates(rows, rows[found], lane)
        first = np.flatnonzero(np.diff(found, prepend=-1))  # the nearest lane of each row that has any
        some = found[first]
        along_rad = self.matcher.heading_rad[lane[first]]
        kept, replaced = self._replaced(tracks, rows[some], middle_m[some], along_rad)
        return rows[some][kept], since_s[some][kept], replaced

    def _replaced(self, tracks: Tracks, rows: Rows, middle_m: Array, along_rad: Array) -> tuple[Array, Array]:
        """Find the share of the vehicles' evidence so far that an update from the map replaces.

        All of it where the vehicle stands, because its offset is what it was; less the further it has driven;
        nothing once it has turned, because another offset across another road says something else. `middle_m` (m,
        2) is where the vehicles are and `along_rad` (m,) the heading of their nearest lanes.

        Returns a mask of the rows to update, and for these the share, 0 to 1. Moves the anchors of those with new
        evidence.
        """
        table = tracks.table
        driven_m = np.hypot(*(middle_m - table["anchor_m"][rows]).T)
        alike = np.cos(along_rad - table["anchor_rad"][rows])
        alike = np.where(np.isnan(table["heading_rad"][rows]), np.abs(alike), alike)  # on the same road, either way
        turned = ~(alike > np.cos(TURN_RAD))  # NaN, so true, where it is seen for the first time
        sure = ~(turned & (driven_m <= STAND_M))  # one that stands has not turned: another lane seems nearer
        rows, middle_m, along_rad = rows[sure], middle_m[sure], along_rad[sure]
        driven_m, turned = driven_m[sure], turned[sure]
        new = np.where(driven_m > STAND_M, driven_m / self._lateral_m, 0.0)
        new[turned] = 1.0
        table["anchor_m"][rows[new > 0]] = middle_m[new > 0]
        table["anchor_rad"][rows[turned]] = along_rad[turned]
        return sure, np.maximum(0.0, 1 - new)


def _neighbourhood(tracks: Tracks, weight: Array, rows: Rows) -> tuple[Array, Array]:
    """Find expected positions (m, 2) of the vehicles `rows`, and distances (m,) within which to seek lanes."""
    position_m = tracks.mean[rows, :2]
    middle_m = position_m @ weight
    spread_m = position_m - middle_m[..., None]
    covariance = tracks.covariance[rows]
    variance_m2 = ((spread_m * spread_m) @ weight).sum(axis=1) + covariance[:, 0, 0]
    gate_m = 3 * np.sqrt(variance_m2 + covariance[:, 1, 1]) + MIN_GATE_M
    return middle_m, np.minimum(gate_m, MAX_GATE_M)
