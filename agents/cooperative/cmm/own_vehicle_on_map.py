"""The filter of one vehicle that drives on the map of a city: itself and the common error (MODEL 10).

What it knows is a Gaussian sum over the lanes that compete (`road_hypotheses`). To others it says what it knew
before a fix, and what the fix and the map have added to that.
"""

from __future__ import annotations

import numpy as np

from agents.cooperative.cmm.information import NOTHING, Five, Information, gained
from agents.cooperative.cmm.kalman_bound import common_step
from agents.cooperative.cmm.map_matching import MAX_GATE_M, MAX_LANES, MIN_GATE_M, STAND_M
from agents.cooperative.cmm.rbpf import Observation, RbpfConfig
from agents.cooperative.cmm.road_hypotheses import OFFSET, Candidates, RoadHypotheses
from agents.cooperative.cmm.tracks import transition, white_acceleration
from vnet.roads.road_map import RoadMap
from vnet.types import Array

SIZE = OFFSET + 1
"""Coordinates of a hypothesis."""
LOST_S = 2.0
"""Time (s) of nothing but outliers after which the vehicle is somewhere else."""
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
        self._roads = roads
        self._sigma_m = np.hypot(roads.sigma_m, roads.half_width_m / np.sqrt(3))
        self.largest_increment = 1 / float(self._sigma_m.min(initial=config.common_sigma_m)) ** 2
        self._rng = rng
        sigma_m = config.start_sigma_m or config.common_sigma_m
        mean, covariance = np.zeros(SIZE), np.eye(SIZE)
        mean[:2] = config.start_m
        covariance[:2, :2] *= sigma_m**2
        self._hypotheses = RoadHypotheses(mean, covariance, config.off_road, config.lateral_m)
        self._is_placed = False
        self._anchor_m = np.full(2, np.nan)
        self._outliers_s = 0.0
        self._heading_rad: float | None = None
        self.owed = NOTHING
        self._take_moments()
        self.prior = Information.of(*self.belief)

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
        return (self._mean[2:4], self._covariance[2:4, 2:4]) if self._is_placed else None

    def sample(self, count: int) -> Array:
        """Draw `count` hypotheses (count, 2) of the common error."""
        return self._hypotheses.sample(count, self._rng)

    def step(self, dt_s: float, fix: Observation | None) -> Information:
        """Advance by `dt_s` and take the vehicle's own fix; returns the increment, which is 0 for an outlier."""
        self._predict(dt_s)
        self._take_moments()
        self.prior = Information.of(*self.belief)
        if fix is None:
            return NOTHING
        if fix.heading_rad is not None:
            self._heading_rad = fix.heading_rad
        if not self._is_placed:
            self._place(fix)
        elif self._is_outlier(fix):
            self._outliers_s += dt_s
            if self._outliers_s < LOST_S:
                return NOTHING
            self._place(fix)
        else:
            self._hypotheses.update(fix.position_m, fix.covariance_m2)
        self._outliers_s = 0.0
        self._look(fix)
        self._take_moments()
        return self._gained()

    def _predict(self, dt_s: float) -> None:
        config = self._config
        keep, variance_m2 = common_step(config.common_sigma_m, config.common_tau_s, config.common_walk_m, dt_s)
        move, noise = np.eye(SIZE), np.zeros((SIZE, SIZE))
        move[:2, :2] *= keep
        move[2:OFFSET, 2:OFFSET] = transition(np.array([dt_s]))[0]
        noise[:2, :2] = variance_m2 * np.eye(2)
        gain = np.vstack([dt_s**2 / 2 * np.eye(2), dt_s * np.eye(2)])
        noise[2:OFFSET, 2:OFFSET] = gain @ white_acceleration(self._heading_rad, config.driving_m2_s4) @ gain.T
        self._hypotheses.predict(move, noise)

    def _is_outlier(self, fix: Observation) -> bool:
        off_m = fix.position_m - self._mean[:2] - self._mean[2:4]
        rows = self._covariance[:2] + self._covariance[2:4]
        seen = rows[:, :2] + rows[:, 2:4] + fix.covariance_m2
        return bool(off_m @ np.linalg.solve(seen, off_m) > self._config.gate_sigmas**2)

    def _place(self, fix: Observation) -> None:
        """Begin where the fix says, on an unknown lane, with what is known of c."""
        mean_m, covariance_m2 = self.belief
        mean, covariance = np.zeros(SIZE), np.zeros((SIZE, SIZE))
        mean[:2], mean[2:4] = mean_m, fix.position_m - mean_m
        covariance[:2, :2] = covariance_m2
        covariance[:2, 2:4] = covariance[2:4, :2] = -covariance_m2
        covariance[2:4, 2:4] = covariance_m2 + fix.covariance_m2
        covariance[4:OFFSET, 4:OFFSET] = self._config.driving_m_s**2 * np.eye(2)
        self._hypotheses = RoadHypotheses(mean, covariance, self._config.off_road, self._config.lateral_m)
        self._anchor_m = np.full(2, np.nan)
        self._is_placed = True

    def _look(self, fix: Observation) -> None:
        """Look at the map, if the vehicle has driven since it did."""
        self._take_moments()
        # Where the receiver says that it is: what is learned of c does not move it.
        seen_m = self._mean[:2] + self._mean[2:4]
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
        self._hypotheses.absorb(pooled)
        self._take_moments()

    def restart(self, belief: Information) -> None:
        """Begin again with this belief about c, and seek the lane again."""
        mean_m, covariance_m2 = belief.moments()
        mean, covariance = np.zeros(SIZE), np.eye(SIZE)
        mean[:2], covariance[:2, :2] = mean_m, covariance_m2
        self._hypotheses = RoadHypotheses(mean, covariance, self._config.off_road, self._config.lateral_m)
        self.owed = NOTHING
        self._is_placed = False
        self.prior = belief
        self._take_moments()
