"""The filter of one vehicle, from its first fix on: itself and the common error (MODEL 10).

On straight lanes that is `own_rbpf` while lanes compete, and `own_kalman` once one is left; on the map of a city it
is `own_vehicle_on_map`. All say to others what they knew before a fix, and what the fix says about the common
error: the *increment*.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from agents.cooperative.cmm.information import NOTHING, Five, Information
from agents.cooperative.cmm.kalman_bound import UNKNOWN_ALONG_M, LaneModel, OffsetAndMultipath
from agents.cooperative.cmm.map_matching import candidate_lanes
from agents.cooperative.cmm.own_kalman import OwnKalman
from agents.cooperative.cmm.own_rbpf import OwnRbpf
from agents.cooperative.cmm.own_vehicle_on_map import OwnVehicleOnMap
from agents.cooperative.cmm.plausibility import scaled_by
from agents.cooperative.cmm.rbpf import Observation, RbpfConfig
from vnet.roads.lanes import LaneMap
from vnet.roads.road_map import RoadMap
from vnet.types import Array

LATERAL_SHARE = 0.45
"""Deviation of a lateral offset relative to the half-width: 0.38 m at 0.85 m, where one of 0.4 m is reflected."""
GATE_SIGMAS = 5.0
"""Fixes further from their prediction are outliers."""
LOST_S = 2.0
"""Time (s) of nothing but outliers after which the vehicle is somewhere else, if the latest three agree."""
LOST_FIXES = 5
"""Least number of consecutive outliers, where fixes are rare."""
INCREMENT_SHARE = 0.9
"""Share of what a fix says about c that is told: c moves between fixes, for all alike, and the part of that which
filters take for offsets is an error that all increments have in common (Bar-Shalom 1981)."""
OFF_ROAD_WALK_M = 20.0
"""Random walk (m/√s) of a vehicle that is on no road, across its direction: a fix tells nearly all of its place."""
SAME_LANE_M = 0.3
SAME_LANE_RAD = 0.02
"""Distance (m) and angle (rad) within which two lanes of a map are taken for the same."""
MAX_LANES = 8
"""Number of lanes that compete, the nearest."""
SAME_HEADING_RAD = math.radians(10.0)
"""Angle within which headings of consecutive fixes agree."""
SAME_MULTIPATH = 0.2
"""Share by which what a receiver states of its multipath may change before the model does."""


@dataclass(frozen=True)
class OwnConfig:
    """Constants of a vehicle's filter: `rbpf` those of the filter on a map, `lateral_sigma_m` 0 for the map's.

    least_particles: number to which particles go down as their spread does, while lanes compete; 0 for as many
    always.
    """

    rbpf: RbpfConfig
    lateral_sigma_m: float = 0.0
    least_particles: int = 0


class OwnVehicle:
    """The filter of one vehicle on straight lanes.

    prior: what was known of c before the latest fix. largest_increment: 0, since all vehicles say alike much.
    model: constants of the filter on a lane. took_fix: false if the latest step was without a fix that fits.
    """

    largest_increment = 0.0

    def __init__(self, config: OwnConfig, lanes: LaneMap, rng: np.random.Generator) -> None:
        self._lanes = lanes
        self._rng = rng
        self._particles, self._least = config.rbpf.particles, config.least_particles
        self.model = LaneModel(
            common_sigma_m=config.rbpf.common_sigma_m,
            common_tau_s=config.rbpf.common_tau_s,
            common_walk_m=config.rbpf.common_walk_m,
            lateral_sigma_m=config.lateral_sigma_m or LATERAL_SHARE * lanes.half_width_m,
            lateral_tau_s=config.rbpf.lateral_tau_s,
            acceleration_m2_s4=config.rbpf.acceleration_m2_s4,
        )
        sigma_m = config.rbpf.start_sigma_m or config.rbpf.common_sigma_m
        start = np.array(config.rbpf.start_m), sigma_m**2 * np.eye(2)
        # On no road a vehicle keeps its place: a renewed offset would be anywhere after seconds without a fix.
        tau_s = 2 * (UNKNOWN_ALONG_M / OFF_ROAD_WALK_M) ** 2
        unknown = replace(
            self.model,
            lateral_sigma_m=UNKNOWN_ALONG_M,
            lateral_tau_s=tau_s,
            acceleration_m2_s4=config.rbpf.driving_m2_s4[0],
        )
        self._unknown = unknown
        self._on_lane, self._multipath = self.model, (0.0, 0.0)
        self._filter: OwnKalman | OwnRbpf = OwnKalman.start(np.zeros(2), 0.0, unknown, start)
        self._is_placed = False
        self._outliers_s = 0.0
        self._latest: list[tuple[float, Observation]] = []  # two fixes, each with the time since the one before
        self._taken: list[tuple[float, Observation]] = []  # the two that were taken last, likewise
        self._untaken_s = 0.0
        self._since_s = 0.0
        self.prior = self._filter.belief
        self.took_fix = False

    @property
    def lane(self) -> OwnKalman | None:
        """The filter on the lane that is left, None while lanes compete, or where there is none."""
        own = self._filter
        return own if self._is_placed and isinstance(own, OwnKalman) and own.model is self.model else None

    @property
    def estimate_m(self) -> Array:
        """Estimate (2,) of the common error."""
        return self._filter.estimate_m

    @property
    def estimate_covariance_m2(self) -> Array:
        """Covariance (2, 2) of the common error."""
        return self._filter.estimate_covariance_m2

    @property
    def belief(self) -> tuple[Array, Array]:
        """Estimate (2,) of the common error, and its covariance (2, 2)."""
        return self._filter.estimate_m, self._filter.estimate_covariance_m2

    @property
    def plain_moments(self) -> Five:
        """Mean (x, y) and covariance (xx, xy, yy) of the common error."""
        return self._filter.plain_moments

    def position_m(self) -> tuple[Array, Array] | None:
        """Return position (2,) and covariance (2, 2); None as long as no fix tells it."""
        return self._filter.position_m() if self._is_placed else None

    def sample(self, count: int) -> Array:
        """Draw `count` equally likely hypotheses (count, 2) of the common error."""
        return self._filter.sample(count, self._rng)

    def step(self, dt_s: float, fix: Observation | None) -> Information:
        """Advance by `dt_s` and take the vehicle's own fix; returns the increment to tell, 0 for an outlier."""
        if fix is not None:
            self._suit(fix.multipath)
        self._filter.predict(dt_s)
        self.prior = self._filter.belief
        self.took_fix = False
        self._since_s += dt_s
        if fix is None:
            return NOTHING
        since_s, self._since_s = self._since_s, 0.0
        before, self._latest = self._latest, [*self._latest[-1:], (since_s, fix)]
        was_placed = self._is_placed
        if not was_placed:
            if not self._agree(before, fix, since_s):
                return NOTHING
            self._place(fix, before)
            self._taken, self._untaken_s = before, 0.0
        self._untaken_s += since_s
        noise_m2, increment = fix.white_covariance_m2, None
        if self._is_likely(before, fix, since_s):
            increment = self._filter.take(fix.position_m, noise_m2, GATE_SIGMAS**2)
        if increment is None:
            self._is_placed = was_placed  # along a lane nothing is known before a fix has been taken
            self._outliers_s += since_s
            if self._outliers_s < max(LOST_S, LOST_FIXES * since_s) or not self._agree(before, fix, since_s):
                return NOTHING
            self._place(fix, before)
            increment = self._filter.take(fix.position_m, noise_m2)
            assert increment is not None, "without a gate each fix is taken"
        self._outliers_s = 0.0
        self._taken, self._untaken_s = [*self._taken[-1:], (self._untaken_s, fix)], 0.0
        self.took_fix = True
        self._go_on()
        return Information(scaled_by(increment.numbers, INCREMENT_SHARE))

    def _is_likely(self, before: list[tuple[float, Observation]], fix: Observation, since_s: float) -> bool:
        """Tell whether the gate may judge a fix: on no road that allows for any turn, and fixes must lead there."""
        if isinstance(self._filter, OwnRbpf) or self._filter.model is not self._unknown:
            return True
        return self._agree(self._taken, fix, self._untaken_s) or self._agree(before, fix, since_s)

    def _agree(self, before: list[tuple[float, Observation]], fix: Observation, since_s: float) -> bool:
        """Tell whether a fix, `since_s` after two others, is where these lead at a constant speed.

        That is the speed which receivers tell, or any. Fewer place no vehicle: one may be an outlier, and at 1 Hz
        two are as far apart where a vehicle drives.
        """
        if len(before) < 2 or before[1][0] <= 0:  # the clock of a vehicle may be set back
            return False
        (_, first), (gap_s, second) = before
        acceleration_m2_s4 = self._unknown.acceleration_m2_s4
        if not (
            second.follows(first, gap_s, acceleration_m2_s4) and fix.follows(second, since_s, acceleration_m2_s4)
        ):
            return False  # two outliers on opposite sides of a vehicle are on a straight line with it
        more = since_s / gap_s
        off_m = fix.position_m - second.position_m - more * (second.position_m - first.position_m)
        weighed = ((1.0, fix), ((1 + more) ** 2, second), (more**2, first))
        noise_m2 = sum(weight * float(np.trace(each.white_covariance_m2)) for weight, each in weighed) / 2
        moved_m2 = self._unknown.acceleration_m2_s4 * (since_s * (since_s + gap_s) / 2) ** 2
        return bool(off_m @ off_m <= GATE_SIGMAS**2 * (moved_m2 + noise_m2))

    def _suit(self, multipath: tuple[float, float]) -> None:
        """Take the model of a receiver with this multipath, deviation (m) and correlation time (s)."""
        before, now = self._multipath, multipath
        if all(abs(b - a) <= SAME_MULTIPATH * a for a, b in zip(before, now, strict=True)):
            return
        self._multipath = multipath
        was, self.model = self.model, OffsetAndMultipath.of(self._on_lane, *now) if now[0] else self._on_lane
        if isinstance(self._filter, OwnRbpf) or self._filter.model is was:
            self._filter.suit(self.model)

    def absorb(self, pooled: Information, is_of_lanes: bool = False) -> None:
        """Replace what is known of c by `pooled`, which has increments of lanes if so (`lane_memory`)."""
        if isinstance(self._filter, OwnRbpf):
            self._filter.absorb(pooled, is_of_lanes)
        else:
            self._filter.absorb(pooled)
        self._go_on()

    def _go_on(self) -> None:
        """Go on without particles once one lane is left."""
        if isinstance(self._filter, OwnRbpf):
            self._filter = self._filter.decided() or self._filter

    def restart(self, belief: Information) -> None:
        """Begin again with this belief about c, and seek the lane again."""
        self._filter = OwnKalman.start(np.zeros(2), 0.0, self._unknown, belief.moments())
        self._is_placed = False
        self._latest, self._outliers_s = [], 0.0
        self.prior = belief

    def _place(self, fix: Observation, before: list[tuple[float, Observation]]) -> None:
        """Seek the lanes on which the vehicle may be; without any its fixes say nothing about c.

        The heading counts if those of the two fixes `before` agree: of a vehicle that stands it may be any.
        """
        towards_rad = fix.heading_rad
        for _, other in before:
            if towards_rad is not None and other.heading_rad is not None:
                turn_rad = math.remainder(other.heading_rad - towards_rad, math.tau)
                towards_rad = towards_rad if abs(turn_rad) < SAME_HEADING_RAD else None
        belief = self.belief
        expected_m = fix.position_m - belief[0]
        variance_m2 = np.trace(belief[1]) + np.trace(fix.covariance_m2)
        lanes = candidate_lanes(self._lanes, expected_m, towards_rad, 3 * float(np.sqrt(variance_m2)))
        self._is_placed = True
        if not len(lanes):
            self._filter = OwnKalman.start(expected_m, 0.0, self._unknown, belief)
            return
        point_m, heading_rad = self._different(lanes, expected_m)
        if len(heading_rad) == 1:
            self._filter = OwnKalman.start(point_m[0], float(heading_rad[0]), self.model, belief)
        else:
            found = point_m, heading_rad
            self._filter = OwnRbpf(found, self.model, self._particles, self._rng, belief, self._least)

    def _different(self, lanes: NDArray[np.intp], expected_m: Array) -> tuple[Array, Array]:
        """Return point and direction of those lanes that differ, the nearest first: a map may have a lane often."""
        heading_rad, normal = self._lanes.heading_rad[lanes], self._lanes.normal[lanes]
        across_m = normal @ expected_m - self._lanes.offset_m[lanes]
        kept: list[int] = []
        for row in np.argsort(np.abs(across_m), kind="stable").tolist():
            turn_rad = np.abs(np.mod(heading_rad[kept] - heading_rad[row] + np.pi, 2 * np.pi) - np.pi)
            beside_m = np.abs(across_m[kept] - across_m[row])
            if not np.any((turn_rad < SAME_LANE_RAD) & (beside_m < SAME_LANE_M)) and len(kept) < MAX_LANES:
                kept.append(row)
        # The point of each lane that is nearest to the vehicle: coordinates along it stay small.
        return expected_m - across_m[kept, None] * normal[kept], heading_rad[kept]


def own_vehicle(
    config: OwnConfig, lanes: LaneMap | RoadMap, rng: np.random.Generator
) -> OwnVehicle | OwnVehicleOnMap:
    """Return the filter of a vehicle on a map of this kind."""
    if isinstance(lanes, RoadMap):
        return OwnVehicleOnMap(config.rbpf, lanes, rng)
    return OwnVehicle(config, lanes, rng)
