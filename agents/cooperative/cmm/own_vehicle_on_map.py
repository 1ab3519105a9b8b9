"""The filter of one vehicle that drives on the map of a city: itself and the common error (MODEL 10).

What it knows is a Gaussian sum over the lanes that compete. To others it says what it knew before a fix, and what
the fix and the map have added to that.

Given the lanes that a vehicle has driven on, all is linear: its fix is z = p + c + n, and a lane with normal n says
n·p = offset + l, where the vehicle's own offset l from the lane of the map stays what it is for hundreds of metres.
So each hypothesis is a Gaussian over [c, p, v, l, m], the common error, position and velocity, the offset, and
multipath:

- l ~ N(0, σ²) is new when the vehicle comes upon a lane or has turned into it;
- as it drives, l is renewed by and by: a Gauss-Markov process of the way, exp(−way / `lateral_m`);
- as long as it stands, l stays, and the map says nothing new.

That the vehicle is on no road is the last hypothesis: anywhere within 15 m of one. From it lanes are found again.

Multipath m that a receiver states is one more state, a Gauss-Markov process in time: fixes show c + p + m.

A precise receiver counts as one of `precise_m2`, as far as its fixes are about c: with what they say beyond that
the vehicles would correct c by many times its movement, and it would diverge. The position has their full
precision.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from agents.cooperative.cmm.information import NOTHING, Five, Information, gained, inverse, transport
from agents.cooperative.cmm.kalman_bound import common_step, precise_m2
from agents.cooperative.cmm.map_matching import MAX_GATE_M, MAX_LANES, MIN_GATE_M, OFF_ROAD_WITHIN_M, STAND_M
from agents.cooperative.cmm.plausibility import scaled_by
from agents.cooperative.cmm.rbpf import Observation, RbpfConfig
from agents.cooperative.cmm.tracks import transition, white_acceleration
from vnet.roads.road_map import RoadMap
from vnet.types import Array

OFFSET = 6
"""Coordinate of the offset in the lane, after c, p and v."""
MULTIPATH = slice(OFFSET + 1, OFFSET + 3)
"""Coordinates of multipath, if the receiver states it."""
BEND_M = 0.3
"""Deviation (m) of a vehicle from its own offset: lanes of a map have corners, which vehicles cut."""
OFF_ROAD = -1
"""Lane of the hypothesis that the vehicle is on no road."""
TURN_RAD = 0.5
"""Turn (rad) since the last full evidence beyond which a lane is another road, with another offset."""
CONTINUED_M = 2.0
"""Change (m) of the offset between two looks at the map up to which a lane continues the one before."""
SWITCH_M = 100.0
"""Way (m) in which a vehicle may come from off the road onto a lane, or leave it."""
DECIDED = 1e-4
"""Probability below which a hypothesis is dropped."""


@dataclass(frozen=True)
class Candidates:
    """Lanes (n,) on which a vehicle may be now, with their segments' geometry.

    lane: numbers. normal: (n, 2). offset_m: n·p of the centre lines. heading_rad: directions. sigma_m: deviations
    of a vehicle's offset from the lane of the map.
    """

    lane: NDArray[np.intp]
    normal: Array
    offset_m: Array
    heading_rad: Array
    sigma_m: Array

    def __len__(self) -> int:
        return len(self.lane)


@dataclass(frozen=True)
class _Hypothesis:
    """One Gaussian over [c, p, v, l, m], and the lane on which the vehicle is."""

    log_weight: float
    mean: Array
    covariance: Array
    lane: int
    normal: Array
    offset_m: float
    anchor_rad: float


class RoadHypotheses:
    """Weighted Gaussians of one vehicle, lanes and no road.

    log_weight: (H,), normalized. mean: (H, n) and covariance: (H, n, n) of [c, p, v, l], and m if there is
    multipath. lane: (H,), `OFF_ROAD` for none.
    """

    def __init__(self, mean: Array, covariance: Array, off_road: float, lateral_m: float) -> None:
        """Begin off the road with mean (n,) and covariance (n, n)."""
        self.mean, self.covariance = mean[None].copy(), covariance[None].copy()
        self.log_weight = np.zeros(1)
        self.lane = np.array([OFF_ROAD], dtype=np.intp)
        self._lateral_m = lateral_m
        self._off_road = off_road
        # The line of each lane at the last look at the map, and its heading when it was evidence in full.
        self._normal, self._offset_m = np.zeros((1, 2)), np.zeros(1)
        self._anchor_rad = np.full(1, np.nan)
        self._had_lanes = False

    @property
    def weight(self) -> Array:
        """Probabilities (H,) of the hypotheses."""
        return np.asarray(np.exp(self.log_weight))

    def moments(self) -> tuple[Array, Array]:
        """Return mean (n,) and covariance (n, n) over all hypotheses."""
        return mixture(self.weight, self.mean, self.covariance)

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Draw `count` values (count, 2) of c."""
        rows = rng.choice(len(self.mean), count, p=self.weight)
        roots = np.linalg.cholesky(self.covariance[:, :2, :2])
        return np.asarray(self.mean[rows, :2] + (roots[rows] @ rng.standard_normal((count, 2, 1)))[:, :, 0])

    def predict(self, move: Array, noise: Array) -> None:
        """Map each hypothesis by `move` (n, n) and add noise of covariance (n, n)."""
        self.mean = self.mean @ move.T
        self.covariance = move @ self.covariance @ move.T + noise

    def add_multipath(self, sigma_m: float) -> None:
        """Take multipath of this deviation in each axis, of which nothing is known, into the state."""
        self.mean = np.pad(self.mean, ((0, 0), (0, 2)))
        self.covariance = np.pad(self.covariance, ((0, 0), (0, 2), (0, 2)))
        self.covariance[:, MULTIPATH, MULTIPATH] = sigma_m**2 * np.eye(2)

    def update(self, fix_m: Array, noise_m2: Array) -> None:
        """Take a fix (2,) with noise covariance (2, 2)."""
        cross = _seen(self.covariance)
        seen = _seen(cross.swapaxes(1, 2)) + noise_m2
        root = np.linalg.inv(np.linalg.cholesky(seen))
        off = fix_m - _seen(self.mean)
        white = (root @ off[:, :, None])[:, :, 0]
        gain = cross @ root.transpose(0, 2, 1)
        self.mean = self.mean + (gain @ white[:, :, None])[:, :, 0]
        self.covariance = self.covariance - gain @ gain.transpose(0, 2, 1)
        if len(self.mean) > 1:
            self.log_weight = self.log_weight + np.log(root[:, 0, 0] * root[:, 1, 1]) - 0.5 * (white**2).sum(axis=1)
            self._normalize()

    def absorb(self, said: Information, pooled: Information) -> None:
        """Replace what has been `said` of c by `pooled`: a lane that fits better to it becomes more likely.

        A hypothesis is multiplied by what is new. Where more is taken from it than it had, it is moved. What could
        not be said, as lanes become more or less likely, stays: taken back, it would move hypotheses apart.
        """
        new_x, new_p = pooled.moments()
        if len(self.mean) == 1:
            self._condition(0, new_x, new_p)
            return
        x, p = said.moments()
        matrix, vector = pooled.matrix - said.matrix, pooled.vector - said.vector
        for row in range(len(self.mean)):
            own = Information.of(self.mean[row, :2], self.covariance[row, :2, :2])
            after = Information.from_arrays(own.matrix + matrix, own.vector + vector)
            a, b, d = after.matrix[0, 0], after.matrix[0, 1], after.matrix[1, 1]
            least = np.linalg.eigvalsh(pooled.matrix)[0] * 0.5
            if a + d > 0 and (a - least) * (d - least) - b * b > 0 and a > least:
                to_m, to_m2 = after.moments()
                scale = math.log(np.linalg.det(own.matrix) / np.linalg.det(after.matrix))
                fit = after.vector @ to_m - own.vector @ self.mean[row, :2]
                self.log_weight[row] += 0.5 * (scale + fit)
            else:
                affine = transport(p, new_p)
                to_m = new_x + affine @ (self.mean[row, :2] - x)
                to_m2 = affine @ self.covariance[row, :2, :2] @ affine.T
            self._condition(row, to_m, to_m2)
        self._normalize()

    def _condition(self, row: int, mean_m: Array, covariance_m2: Array) -> None:
        """Give c of a hypothesis these moments, and move what goes with it along its regression on c."""
        covariance = self.covariance[row]
        slope = covariance[:, :2] @ inverse(covariance[:2, :2])
        self.mean[row] = self.mean[row] + slope @ (mean_m - self.mean[row, :2])
        self.covariance[row] = covariance + slope @ (covariance_m2 - covariance[:2, :2]) @ slope.T

    # Lanes.

    def look(self, lanes: Candidates, driven_m: float) -> None:
        """Look at the map: `lanes` are where the vehicle may be now, `driven_m` the way since the last look.

        A lane goes on as the candidate that lies in its line. One that does not go on is given up for all
        candidates, and so is no road where none was before; else a vehicle comes back to a road, or leaves it, now
        and then.
        """
        switched = 1 - math.exp(-driven_m / SWITCH_M)
        off, on = self._off_road, 1 - self._off_road
        born = []
        for row, lane in enumerate(self.lane.tolist()):
            goes_on = None if lane == OFF_ROAD else self._continuation(row, lanes)
            if not len(lanes):
                born.append(self._off_the_road(row, 1.0))
            elif goes_on is not None:
                born.append(self._on_lane(row, lanes, goes_on, driven_m, 1 - off * switched))
                born.append(self._off_the_road(row, off * switched))
            else:
                again = switched if lane == OFF_ROAD and self._had_lanes else 1.0
                probability = again * on / len(lanes)
                born += [self._on_lane(row, lanes, n, None, probability) for n in range(len(lanes))]
                born.append(self._off_the_road(row, 1 - again * on))
        self._had_lanes = len(lanes) > 0
        self._take(born)

    def _continuation(self, row: int, lanes: Candidates) -> int | None:
        """Return the candidate that goes on the lane of hypothesis `row`, or None."""
        if not len(lanes):
            return None
        turn = np.cos(lanes.heading_rad - self._anchor_rad[row])
        position_m = self.mean[row, 2:4]
        offset_m = self._normal[row] @ position_m - self._offset_m[row]
        apart_m = np.abs(lanes.normal @ position_m - lanes.offset_m - offset_m)
        apart_m[turn < math.cos(TURN_RAD)] = np.inf
        best = int(np.argmin(apart_m))
        return best if apart_m[best] <= CONTINUED_M else None

    def _off_the_road(self, row: int, probability: float) -> _Hypothesis:
        """Return what becomes of hypothesis `row` if the vehicle is on no road now."""
        return _Hypothesis(
            self.log_weight[row] + math.log(probability),
            self.mean[row],
            self.covariance[row],
            OFF_ROAD,
            np.zeros(2),
            0.0,
            np.nan,
        )

    def _on_lane(
        self, row: int, lanes: Candidates, n: int, driven_m: float | None, probability: float
    ) -> _Hypothesis:
        """Return what becomes of hypothesis `row` on candidate `n`: after `driven_m` on it, or None to begin there.

        To begin there is as likely as that lane is, relative to a position anywhere within `OFF_ROAD_WITHIN_M`.
        """
        mean, covariance, sigma_m = self.mean[row].copy(), self.covariance[row].copy(), float(lanes.sigma_m[n])
        keep = 0.0 if driven_m is None else math.exp(-driven_m / self._lateral_m)
        mean[OFFSET] *= keep
        covariance[OFFSET] *= keep
        covariance[:, OFFSET] *= keep
        covariance[OFFSET, OFFSET] += sigma_m**2 * (1 - keep**2)
        normal = lanes.normal[n]
        off_m = float(lanes.offset_m[n] + mean[OFFSET] - normal @ mean[2:4])
        cross = covariance[:, 2:4] @ normal - covariance[:, OFFSET]
        total_m2 = float(normal @ cross[2:4] - cross[OFFSET]) + BEND_M**2
        squared = off_m**2 / total_m2
        if driven_m is None:
            log = -0.5 * (squared + math.log(2 * math.pi * total_m2)) + math.log(2 * OFF_ROAD_WITHIN_M)
        else:
            log = 0.5 * (1 - squared)
        return _Hypothesis(
            self.log_weight[row] + math.log(probability) + log,
            mean + cross * (off_m / total_m2),
            covariance - np.outer(cross, cross) / total_m2,
            int(lanes.lane[n]),
            normal,
            float(lanes.offset_m[n]),
            float(lanes.heading_rad[n] if driven_m is None else self._anchor_rad[row]),
        )

    def _take(self, born: Sequence[_Hypothesis]) -> None:
        """Go on with these hypotheses: one a lane, by its moments, and none that is out of question."""
        log = np.array([one.log_weight for one in born])
        weight = np.exp(log - log.max())
        weight /= weight.sum()
        by_lane: dict[int, list[int]] = {}
        for row, one in enumerate(born):
            by_lane.setdefault(one.lane, []).append(row)
        kept = []
        for rows in by_lane.values():
            total = weight[rows].sum()
            if total < DECIDED:
                continue
            part = weight[rows] / total
            best = born[rows[int(np.argmax(part))]]
            mean, covariance = mixture(
                part, np.array([born[row].mean for row in rows]), np.array([born[row].covariance for row in rows])
            )
            kept.append(replace(best, log_weight=math.log(total), mean=mean, covariance=covariance))
        self.log_weight = np.array([one.log_weight for one in kept])
        self.mean = np.array([one.mean for one in kept])
        self.covariance = np.array([one.covariance for one in kept])
        self.lane = np.array([one.lane for one in kept], dtype=np.intp)
        self._normal = np.array([one.normal for one in kept])
        self._offset_m = np.array([one.offset_m for one in kept])
        self._anchor_rad = np.array([one.anchor_rad for one in kept])
        self._normalize()

    def _normalize(self) -> None:
        self.log_weight = self.log_weight - self.log_weight.max()
        self.log_weight = self.log_weight - math.log(float(np.exp(self.log_weight).sum()))


def _seen(values: Array) -> Array:
    """Return of the last axis of values (…, n) what fixes show (…, 2): c + p, and m."""
    seen = values[..., :2] + values[..., 2:4]
    return seen + values[..., MULTIPATH] if values.shape[-1] > MULTIPATH.start else seen


def mixture(weight: Array, mean: Array, covariance: Array) -> tuple[Array, Array]:
    """Return mean (n,) and covariance (n, n) of H Gaussians.

    They have weights (H,), means (H, n) and covariances (H, n, n).
    """
    if len(weight) == 1:
        return mean[0], covariance[0]
    middle = weight @ mean
    spread = mean - middle
    return middle, np.asarray(np.tensordot(weight, covariance, 1) + (spread.T * weight) @ spread)


MULTIPATH_SHARE = 0.3
"""Share of an increment that is told where the offset is multipath alone. That lasts while c moves, for all
vehicles alike: told whole, increments of 15 vehicles add up to less than half the deviation that c has. Where the
offset is that of a lane, which changes with each turn, they are told whole."""
LOST_S = 2.0
"""Time (s) of nothing but outliers after which the vehicle is somewhere else, if the latest follow each other."""
LOST_FIXES = 3
"""Least number of consecutive outliers, where fixes are rare."""
TURNING_FIXES = 2
"""Consecutive outliers after which a vehicle has turned faster than the model allows for, if each is where the fix
before leads by speed and heading. A receiver that jumps is not."""
SAME_LANE_M = 0.5
SAME_LANE_RAD = 0.1
"""Distance (m) and angle (rad) within which two segments are taken for one lane: a road may be cut anywhere."""


class OwnVehicleOnMap:
    """The filter of one vehicle on the map of a city.

    prior: what was known of c before the latest fix. owed: negative, what increments have said too much.
    largest_increment: trace in 1/m² of what a lane says of c at once, when a vehicle comes upon it.
    """

    def __init__(self, config: RbpfConfig, roads: RoadMap, rng: np.random.Generator) -> None:
        self._config = config
        self._precise_m2 = precise_m2(config.common_sigma_m, config.common_tau_s, config.common_walk_m)
        self._roads = roads
        self._sigma_m = np.hypot(roads.sigma_m, roads.half_width_m / np.sqrt(3))
        self.largest_increment = 1 / float(self._sigma_m.min(initial=config.common_sigma_m)) ** 2
        self._rng = rng
        sigma_m = config.start_sigma_m or config.common_sigma_m
        mean, covariance = np.zeros(OFFSET + 1), np.eye(OFFSET + 1)
        mean[:2] = config.start_m
        covariance[:2, :2] *= sigma_m**2
        self._hypotheses = RoadHypotheses(mean, covariance, config.off_road, config.lateral_m)
        self._is_placed = False
        self._anchor_m = np.full(2, np.nan)
        self._outliers_s = 0.0
        self._turning = 0.0  # fixes in a row that were not taken, each of which follows the one before
        self._taken: Observation | None = None  # the fix that was taken last
        self._latest: Observation | None = None
        self._untaken_s = self._since_s = 0.0  # the times since these
        self._heading_rad: float | None = None
        self._multipath = (0.0, 0.0)
        self._rest: tuple[Array, Array] | None = None  # what the latest fix says beyond `_precise_m2`
        self.owed = NOTHING
        self._take_moments()
        self.prior = self._said = Information.of(*self.belief)

    def _take_moments(self) -> None:
        self._mean, self._covariance = self._hypotheses.moments()

    @property
    def estimate_m(self) -> Array:
        """Estimate (2,) of the common error."""
        return self._mean[:2]

    @property
    def estimate_covariance_m2(self) -> Array:
        """Covariance (2, 2) of the common error."""
        return self._covariance[:2, :2]

    @property
    def belief(self) -> tuple[Array, Array]:
        """Estimate (2,) of the common error, and its covariance (2, 2)."""
        return self.estimate_m, self.estimate_covariance_m2

    @property
    def plain_moments(self) -> Five:
        """Mean (x, y) and covariance (xx, xy, yy) of the common error."""
        (x, y), ((p, q), (_, r)) = self.estimate_m.tolist(), self.estimate_covariance_m2.tolist()
        return x, y, p, q, r

    @property
    def lanes(self) -> dict[int, float]:
        """Probability of each lane on which the vehicle may be, `OFF_ROAD` for none, by number."""
        hypotheses = self._hypotheses
        return dict(zip(hypotheses.lane.tolist(), hypotheses.weight.tolist(), strict=True))

    def position_m(self) -> tuple[Array, Array] | None:
        """Return position (2,) and covariance (2, 2); None as long as no fix tells it."""
        if not self._is_placed:
            return None
        mean_m, covariance_m2 = self._mean[2:4], self._covariance[2:4, 2:4]
        if self._rest:
            seen_m, noise_m2 = self._rest
            cross = _seen(self._covariance)
            gain = cross[2:4] @ inverse(_seen(cross.T) + noise_m2)
            mean_m = mean_m + gain @ (seen_m - _seen(self._mean))
            covariance_m2 = covariance_m2 - gain @ cross[2:4].T
        return mean_m, covariance_m2

    def sample(self, count: int) -> Array:
        """Draw `count` hypotheses (count, 2) of the common error."""
        return self._hypotheses.sample(count, self._rng)

    def step(self, dt_s: float, fix: Observation | None) -> Information:
        """Advance by `dt_s` and take the vehicle's own fix; returns the increment, which is 0 for an outlier."""
        self._predict(dt_s)
        if fix is not None:
            self._suit(fix.multipath)
        self._take_moments()
        self.prior = self._said = Information.of(*self.belief)
        self._rest = None
        self._untaken_s += dt_s
        self._since_s += dt_s
        if fix is None:
            return NOTHING
        if fix.heading_rad is not None:
            self._heading_rad = fix.heading_rad
        before, since_s = self._latest, self._since_s
        self._latest, self._since_s = fix, 0.0
        exact_m2 = fix.white_covariance_m2
        more_m2 = max(self._precise_m2 - float(exact_m2.diagonal().min()), 0.0)
        noise_m2 = exact_m2 + more_m2 * np.eye(2)
        if not self._is_placed:
            self._place(fix, noise_m2)
        elif self._is_outlier(fix) or not self._follows(fix, self._taken, self._untaken_s):
            self._outliers_s += dt_s
            follows = self._follows(fix, before, since_s)
            tell = fix.tells_velocity and before is not None and before.tells_velocity
            self._turning = self._turning + 1 if follows and tell else -math.inf
            is_lost = follows and self._outliers_s >= max(LOST_S, LOST_FIXES * since_s)
            if self._turning < TURNING_FIXES and not is_lost:
                return NOTHING
            self._place(fix, noise_m2)
        else:
            self._hypotheses.update(fix.position_m, noise_m2)
        self._outliers_s = self._turning = 0.0
        self._taken, self._untaken_s = fix, 0.0
        if more_m2:  # 1 / R − 1 / (R + more) is left
            self._rest = fix.position_m, exact_m2 + exact_m2 @ exact_m2 / more_m2
        self._look(fix)
        self._take_moments()
        gain = self._gained()
        self._said = self.prior.plus(gain)
        lane_m2, multipath_m2 = 1 / self.largest_increment, self._multipath[0] ** 2
        told = (lane_m2 + MULTIPATH_SHARE * multipath_m2) / (lane_m2 + multipath_m2)
        return Information(scaled_by(gain.numbers, told))

    def _predict(self, dt_s: float) -> None:
        config = self._config
        keep, variance_m2 = common_step(config.common_sigma_m, config.common_tau_s, config.common_walk_m, dt_s)
        move, noise = np.eye(len(self._mean)), np.zeros_like(self._covariance)
        move[:2, :2] *= keep
        move[2:OFFSET, 2:OFFSET] = transition(np.array([dt_s]))[0]
        noise[:2, :2] = variance_m2 * np.eye(2)
        gain = np.vstack([dt_s**2 / 2 * np.eye(2), dt_s * np.eye(2)])
        noise[2:OFFSET, 2:OFFSET] = gain @ white_acceleration(self._heading_rad, config.driving_m2_s4) @ gain.T
        sigma_m, tau_s = self._multipath
        if sigma_m:
            keep = math.exp(-dt_s / tau_s)
            move[MULTIPATH, MULTIPATH] *= keep
            noise[MULTIPATH, MULTIPATH] = sigma_m**2 * (1 - keep**2) * np.eye(2)
        self._hypotheses.predict(move, noise)

    def _suit(self, multipath: tuple[float, float]) -> None:
        """Take the model of a receiver with this multipath, deviation (m) and correlation time (s)."""
        if multipath == self._multipath:
            return
        self._multipath = multipath
        if len(self._mean) == MULTIPATH.start:
            self._hypotheses.add_multipath(multipath[0])

    def _is_outlier(self, fix: Observation) -> bool:
        off_m = fix.position_m - _seen(self._mean)
        seen = _seen(_seen(self._covariance).T) + fix.white_covariance_m2
        return bool(off_m @ np.linalg.solve(seen, off_m) > self._config.gate_sigmas**2)

    def _follows(self, fix: Observation, before: Observation | None, gap_s: float) -> bool:
        return before is None or fix.follows(before, gap_s, self._config.driving_m2_s4[0])

    def _place(self, fix: Observation, noise_m2: Array) -> None:
        """Begin where the fix says up to noise (2, 2), on an unknown lane, with what is known of c and m."""
        mean, covariance = np.zeros_like(self._mean), np.zeros_like(self._covariance)
        known = [0, 1, *range(MULTIPATH.start, len(mean))]
        mean[known], covariance[np.ix_(known, known)] = self._mean[known], self._covariance[np.ix_(known, known)]
        cross = _seen(covariance)
        mean[2:4] = fix.position_m - _seen(mean)
        covariance[2:4], covariance[:, 2:4] = -cross.T, -cross
        covariance[2:4, 2:4] = _seen(cross.T) + noise_m2
        covariance[4:OFFSET, 4:OFFSET] = self._config.driving_m_s**2 * np.eye(2)
        self._hypotheses = RoadHypotheses(mean, covariance, self._config.off_road, self._config.lateral_m)
        self._anchor_m = np.full(2, np.nan)
        self._is_placed = True

    def _look(self, fix: Observation) -> None:
        """Look at the map, if the vehicle has driven since it did."""
        self._take_moments()
        # Where the receiver says that it is: what is learned of c does not move it.
        seen_m = _seen(self._mean)
        driven_m = float(np.hypot(*(seen_m - self._anchor_m)))
        if driven_m <= STAND_M:
            return
        self._anchor_m = seen_m
        self._hypotheses.look(self._candidates(fix), 0.0 if np.isnan(driven_m) else driven_m)

    def _candidates(self, fix: Observation) -> Candidates:
        """Return the lanes on which the vehicle may be, the nearest first: of each lane its nearest segment."""
        roads = self._roads
        variance_m2 = self._covariance[2, 2] + self._covariance[3, 3]
        gate_m = min(3 * float(np.sqrt(variance_m2)) + MIN_GATE_M, MAX_GATE_M)
        heading_rad = np.nan if fix.heading_rad is None else fix.heading_rad
        position_m = self._mean[2:4]
        _, segments, _ = roads.near(position_m[None], np.array([heading_rad]), np.array([gate_m]))
        kept: list[int] = []
        offset_m = roads.normal[segments] @ position_m - roads.offset_m[segments]
        for row, segment in enumerate(segments.tolist()):
            alike = np.cos(roads.heading_rad[segments[kept]] - roads.heading_rad[segment]) > np.cos(SAME_LANE_RAD)
            beside = np.abs(offset_m[kept] - offset_m[row]) < SAME_LANE_M
            same = roads.lane[segments[kept]] == roads.lane[segment]
            if not np.any(same | (alike & beside)):
                kept.append(row)
            if len(kept) == MAX_LANES:
                break
        found = segments[kept]
        return Candidates(
            lane=roads.lane[found].astype(np.intp),
            normal=roads.normal[found],
            offset_m=roads.offset_m[found],
            heading_rad=roads.heading_rad[found],
            sigma_m=self._sigma_m[found],
        )

    def _gained(self) -> Information:
        """Return what the latest fix has added to what is known of c.

        Where lanes compete less may be known than before. That cannot be said, and is owed.
        """
        prior, owed, after = self.prior, self.owed, Information.of(*self.belief)
        said = gained(Information.from_arrays(prior.matrix - owed.matrix, prior.vector - owed.vector), after)
        self.owed = Information.from_arrays(
            owed.matrix + after.matrix - prior.matrix - said.matrix,
            owed.vector + after.vector - prior.vector - said.vector,
        )
        return said

    def absorb(self, pooled: Information) -> None:
        """Replace what is known of c by `pooled`."""
        self._hypotheses.absorb(self._said, pooled)
        self._take_moments()

    def restart(self, belief: Information) -> None:
        """Begin again with this belief about c, and seek the lane again."""
        mean_m, covariance_m2 = belief.moments()
        mean, covariance = np.zeros(OFFSET + 1), np.eye(OFFSET + 1)
        mean[:2], covariance[:2, :2] = mean_m, covariance_m2
        self._multipath = (0.0, 0.0)  # until a fix states it again
        self._hypotheses = RoadHypotheses(mean, covariance, self._config.off_road, self._config.lateral_m)
        self.owed = NOTHING
        self._is_placed = False
        self.prior = self._said = belief
        self._take_moments()
