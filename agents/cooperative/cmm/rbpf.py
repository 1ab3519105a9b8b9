"""The Rao-Blackwellized particle filter of one vehicle (MODEL 2).

Particle k is a hypothesis c^k of the common GNSS error; given it, every tracked vehicle j has a Kalman filter on
[x, y, ẋ, ẏ]. Its covariance P_j, innovation covariance S and gain K do not depend on k, so that a vehicle has one
gain, and all particles are one matrix product: means are kept as (M, 4, K) with the particles contiguous.

A fix may be old: a neighbour's has crossed the radio, another's has been passed on. So each vehicle's Kalman filter
stands at the time of its own latest fix, and particles remember the c of the last seconds: an old fix is compared
with the c of its own time. Given a particle's trajectory that is exact; the only approximation is that the
trajectory was drawn without it.

The parts: `common_error` has the particles, `tracks` the vehicles, `map_evidence` what the map says of them;
`fusion` mixes the particles of several filters.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agents.cooperative.cmm.common_error import CommonErrorParticles, systematic
from agents.cooperative.cmm.map_matching import MapEvidence, matcher
from agents.cooperative.cmm.tracks import (
    SAME_TIME_S,
    Rows,
    Tracks,
    predicted_covariance,
    transition,
    white_acceleration,
)
from vnet.errors import VnetError
from vnet.roads.lanes import LaneMap
from vnet.roads.road_map import RoadMap
from vnet.types import Array

SPEED_SIGMA_M_S = 1.0
"""Deviation (m/s) of the speed that a receiver tells: ten times that of a Doppler measurement under open sky."""
SPEED_GATE_SIGMAS = 5.0
"""Two fixes further from what their speeds say do not follow each other."""
REST_SPEED_M_S = 0.5
"""Standard deviation (m/s) of a vehicle's speed at its first fix, on straight lanes, where vehicles stand."""
START_FACTOR = 10
"""So many times the particles at first: few of those that the prior spreads over metres survive the first fixes."""
START_S = 0.45
"""Time (s) with more particles: the first fixes of the neighbours come within it."""
LEAST_NOISE_M2 = 1e-4
"""Least variance of a fix in each axis: particles tell no more, and an exact fix would have no density."""
ACROSS_SHARE = 0.01
"""Variance of the acceleration across a straight lane, relative to that along it: vehicles hold their lane."""


@dataclass(frozen=True)
class RbpfConfig:
    """Constants of the filter; lengths in metres, times in seconds."""

    particles: int = 200
    """Hypotheses of the common error."""
    common_sigma_m: float = 3.0
    """Standard deviation of the common error, a Gauss-Markov process."""
    common_tau_s: float = 600.0
    """Correlation time of the common error."""
    common_walk_m: float | None = None
    """In place of both, a random walk with this deviation after a second: 0.5 / √0.1 for 0.5 m in 0.1 s."""
    acceleration_m2_s4: float = 1.0
    """Variance of the acceleration along a straight lane; a hundredth of it across."""
    lateral_tau_s: float = 20.0
    """Time for which a vehicle keeps its offset in the lane; see `map_evidence`."""
    gate_sigmas: float = 5.0
    """Fixes further from their prediction are outliers."""
    forget_s: float = 2.0
    """Vehicles not heard for that long are dropped."""
    memory_s: float = 1.5
    """Age of the oldest fix that is used."""
    start_m: tuple[float, float] = (0.0, 0.0)
    """Mean of the first particles."""
    start_sigma_m: float | None = None
    """Deviation of the first particles, if not `common_sigma_m`."""
    one_sided: bool = False
    """If set, lanes are bounded on the right only, as the paper's."""
    separate_map_update: bool = False
    """If set, a step leaves the map to `update_from_map`, as the paper's."""
    min_map_log_likelihood: float = -np.inf
    """Least log-likelihood of being on a straight road: see `MIN_MAP_LOG_LIKELIHOOD`."""
    off_road: float = 0.1
    """On the map of a city: share of the vehicles that are on no road."""
    driving_m2_s4: tuple[float, float] = (16.0, 4.0)
    """On the map of a city: variances of the acceleration along and across a vehicle's heading."""
    driving_m_s: float = 15.0
    """On the map of a city: deviation of a vehicle's speed at its first fix."""
    lateral_m: float = 500.0
    """On the map of a city: way for which a vehicle keeps its offset in the lane."""

    def __post_init__(self) -> None:
        if self.particles < 1:
            raise VnetError(f"particles = {self.particles}: at least 1 is needed")


@dataclass(frozen=True)
class Observation:
    """A fix of one vehicle: `position_m` (2,) by its receiver, covariance (2, 2), heading and speed if known, age.

    multipath: deviation (m) and correlation time (s) of the part of the covariance that lasts; 0, 0 for none.
    """

    position_m: Array
    covariance_m2: Array
    heading_rad: float | None
    age_s: float = 0.0
    multipath: tuple[float, float] = (0.0, 0.0)
    speed_m_s: float | None = None

    @property
    def white_covariance_m2(self) -> Array:
        """The covariance (2, 2) of the noise, which is new in each fix."""
        if not self.multipath[0]:
            return self.covariance_m2
        white_m2 = self.covariance_m2 - self.multipath[0] ** 2 * np.eye(2)
        (a, b), (_, d) = white_m2.tolist()
        return white_m2 if min(a, d) > 0 and a * d > b * b else LEAST_NOISE_M2 * np.eye(2)

    @property
    def inexact_covariance_m2(self) -> Array:
        """The noise covariance (2, 2), of a receiver that is not exact."""
        if self.covariance_m2.diagonal().min() >= LEAST_NOISE_M2:
            return self.covariance_m2
        return self.covariance_m2 + LEAST_NOISE_M2 * np.eye(2)

    @property
    def tells_velocity(self) -> bool:
        """True if speed and heading are known."""
        return self.speed_m_s is not None and self.heading_rad is not None

    def follows(self, before: Observation, gap_s: float, acceleration_m2_s4: float) -> bool:
        """Tell whether this fix is where another, `gap_s` before, leads by what both tell of speed and heading.

        The acceleration between them has the given variance. Without a speed any fix is, without a heading any that
        is as far away.
        """
        if before.speed_m_s is None or self.speed_m_s is None:
            return True
        half_s, (east_m, north_m) = gap_s / 2, (self.position_m - before.position_m).tolist()
        if before.heading_rad is None or self.heading_rad is None:
            off_m = math.hypot(east_m, north_m) - half_s * (before.speed_m_s + self.speed_m_s)
        else:
            for speed_m_s, heading_rad in (
                (before.speed_m_s, before.heading_rad),
                (self.speed_m_s, self.heading_rad),
            ):
                east_m -= half_s * speed_m_s * math.cos(heading_rad)
                north_m -= half_s * speed_m_s * math.sin(heading_rad)
            off_m = math.hypot(east_m, north_m)
        noise_m2 = float(np.trace(before.white_covariance_m2 + self.white_covariance_m2)) / 2
        if self.multipath[0]:
            noise_m2 += 2 * self.multipath[0] ** 2 * -math.expm1(-gap_s / self.multipath[1])
        speed_m2_s2 = SPEED_SIGMA_M_S**2 + acceleration_m2_s4 * gap_s**2 / 16
        within_m2 = SPEED_GATE_SIGMAS**2 * (noise_m2 + gap_s**2 * speed_m2_s2)
        return off_m**2 <= within_m2 or not math.isfinite(off_m)  # such a speed tells nothing


class Rbpf:
    """The filter of one vehicle: `particles` of the common error and `tracks` of the vehicles."""

    def __init__(self, config: RbpfConfig, lanes: LaneMap | RoadMap, rng: np.random.Generator) -> None:
        """Draw the first particles from `rng`, which serves the filter from then on."""
        self.config = config
        roads = matcher(lanes, config.one_sided, config.min_map_log_likelihood, config.off_road)
        self.map_evidence = MapEvidence(roads, config.lateral_tau_s, config.lateral_m)
        self._rng = rng
        straight_m2_s4 = config.acceleration_m2_s4, ACROSS_SHARE * config.acceleration_m2_s4
        self._acceleration_m2_s4 = config.driving_m2_s4 if roads.drives else straight_m2_s4
        self._starting_s = START_S if config.start_sigma_m is None else 0.0
        count = config.particles * (START_FACTOR if self._starting_s else 1)
        sigma_m = config.common_sigma_m if config.start_sigma_m is None else config.start_sigma_m
        start_m = np.array(config.start_m)[:, None]
        self.particles = CommonErrorParticles(start_m + sigma_m * rng.standard_normal((2, count)))
        self.tracks = Tracks(count)

    # One period.

    def step(self, dt_s: float, observations: Mapping[str, Observation]) -> None:
        """Advance by `dt_s` and take at most one fix of each vehicle, by its id.

        Fixes that are not newer than the vehicle's latest, or older than `memory_s`, are ignored.
        """
        self._predict(dt_s)
        oldest_s = self.particles.oldest_s + SAME_TIME_S
        seen = {}
        for row, (name, age_s) in enumerate(zip(self.tracks.names, self.tracks.age_s.tolist(), strict=True)):
            observation = observations.get(name)
            if observation and observation.age_s < age_s - SAME_TIME_S and observation.age_s <= oldest_s:
                seen[row] = observation
        self._update(seen)
        for name in sorted(observations.keys() - set(self.tracks.names)):
            if observations[name].age_s <= oldest_s:
                seen[len(self.tracks)] = observations[name]
                self._add(name, observations[name])
        rows = np.array(list(seen), dtype=np.intp)
        if not self.config.separate_map_update:
            self.map_evidence.update(self.tracks, self.particles, rows)
        self.tracks.drop_unseen(self.config.forget_s)
        self._resample_if_due(dt_s)

    def update_from_map(self) -> None:
        """Weight the particles by the roads of all vehicles, and resample: the paper's order, after fusion."""
        self.map_evidence.update_in_full(self.tracks, self.particles)
        self.resample()

    def _predict(self, dt_s: float) -> None:
        config = self.config
        if config.common_walk_m is None:
            keep = np.exp(-dt_s / config.common_tau_s)
            spread_m = config.common_sigma_m * np.sqrt(1 - keep**2)
        else:
            keep, spread_m = 1.0, config.common_walk_m * np.sqrt(dt_s)
        self.particles.predict(keep, spread_m, self._rng)
        self.particles.remember(dt_s, config.memory_s)
        self.tracks.advance(dt_s)

    # Fixes.

    def _update(self, seen: Mapping[int, Observation]) -> None:
        """Move the vehicles in `seen`, by row, to the time of their fix, and update them by it.

        With S⁻¹ = WᵀW for the innovation covariance S, everything about the innovation ν follows from Wν: its
        square is the Mahalanobis distance, and the gain is P Hᵀ Wᵀ.
        """
        if not seen:
            return
        tracks, rows, fixes = self.tracks, np.array(list(seen), dtype=np.intp), seen.values()
        age_s = np.array([fix.age_s for fix in fixes])
        elapsed_s = tracks.age_s[rows] - age_s
        moving = transition(elapsed_s)
        covariance = predicted_covariance(
            tracks.covariance[rows], moving, tracks.acceleration_m2_s4[rows], elapsed_s
        )
        whitening = _whitening(covariance[:, :2, :2] + np.array([fix.inexact_covariance_m2 for fix in fixes]))
        gain = covariance[:, :, :2] @ whitening.transpose(0, 2, 1)
        is_all = len(rows) == len(tracks)
        mean = tracks.mean if is_all else tracks.mean[rows]
        # −Wν = W (H m + c − z), as products of small matrices: numpy's fastest way over particles.
        off = (whitening @ moving[:, :2]) @ mean
        off += whitening @ self.particles.at(age_s)
        off -= whitening @ np.array([fix.position_m for fix in fixes])[:, :, None]
        kept = self._inside_gate(off)
        if not kept.all():
            gain[~kept] = 0
            off[~kept] = 0
        mean = moving @ mean
        mean -= gain @ off
        covariance -= gain @ gain.transpose(0, 2, 1)
        off = off.reshape(-1, off.shape[2])
        self.particles.log_weight -= 0.5 * np.einsum("ik,ik->k", off, off)
        if self.map_evidence.drives:
            self._turn(rows, fixes)
        if is_all:
            tracks.mean = mean
        else:
            tracks.mean[rows] = mean
        tracks.table["covariance"][rows] = 0.5 * (covariance + covariance.transpose(0, 2, 1))
        tracks.table["age_s"][rows] = age_s
        tracks.table["unseen_s"][rows[kept]] = age_s[kept]

    def _turn(self, rows: Rows, fixes: Iterable[Observation]) -> None:
        """Turn the acceleration of vehicles that drive into the heading of their latest fix."""
        for row, fix in zip(rows.tolist(), fixes, strict=True):
            if fix.heading_rad is not None:
                self.tracks.table["heading_rad"][row] = fix.heading_rad
                acceleration = white_acceleration(fix.heading_rad, self._acceleration_m2_s4)
                self.tracks.table["acceleration_m2_s4"][row] = np.tile(acceleration, (2, 2))

    def _inside_gate(self, off: Array) -> NDArray[np.bool_]:
        """Find the fixes (m,) that are no outliers, from −Wν in `off` (m, 2, K).

        Decided per vehicle and not per particle, because the gain must stay the same for all particles.
        """
        weight, gate = self.weight, self.config.gate_sigmas**2
        middle = off @ weight
        inside = np.asarray((middle * middle).sum(axis=1) <= gate)
        if inside.all():
            return inside
        # The particles' spread adds to the unit covariance of −Wν: that can only bring in a fix that is outside.
        far = np.flatnonzero(~inside)
        off, middle = off[far], middle[far, :, None]
        total = np.eye(2) + (off * weight) @ off.transpose(0, 2, 1) - middle @ middle.transpose(0, 2, 1)
        distance = middle.transpose(0, 2, 1) @ np.linalg.solve(total, middle)
        inside[far] = distance[:, 0, 0] <= gate
        return inside

    def _add(self, name: str, observation: Observation) -> None:
        """Track a vehicle from its first fix z: m = z − c, at rest, with the fix's covariance."""
        mean = np.zeros((4, len(self.particles)))
        mean[:2] = observation.position_m[:, None] - self.particles.at(np.array([observation.age_s]))
        speed_m_s = self.config.driving_m_s if self.map_evidence.drives else REST_SPEED_M_S
        covariance = np.zeros((4, 4))
        covariance[:2, :2] = observation.inexact_covariance_m2
        covariance[2:, 2:] = np.eye(2) * speed_m_s**2
        variance_m2 = np.trace(self.estimate_covariance_m2) + np.trace(observation.covariance_m2)
        expected_m = observation.position_m - self.estimate_m
        lanes = self.map_evidence.first_lanes(expected_m, observation.heading_rad, 3 * float(np.sqrt(variance_m2)))
        direction_rad = observation.heading_rad
        if direction_rad is None and len(lanes):
            direction_rad = float(self.map_evidence.matcher.heading_rad[lanes[0]])
        self.tracks.add(
            name,
            mean=mean,
            covariance=covariance,
            acceleration_m2_s4=white_acceleration(direction_rad, self._acceleration_m2_s4),
            age_s=observation.age_s,
            heading_rad=observation.heading_rad,
            lanes=lanes,
        )

    # Resampling.

    def resample(self) -> None:
        """Resample systematically to equal weights (Kitagawa 1996)."""
        self._resample_to(self.config.particles)

    def _resample_if_due(self, dt_s: float) -> None:
        """Resample when the start is over, or when the effective sample size is below half the particles."""
        count = self.config.particles
        if self._starting_s > 0:
            self._starting_s -= dt_s
            count *= START_FACTOR if self._starting_s > 0 else 1
        if len(self.particles) != count or self.particles.effective_sample_size < count / 2:
            self._resample_to(count)

    def _resample_to(self, count: int) -> None:
        index = systematic(self.weight, count, self._rng)
        self.particles.take(index)
        self.tracks.take_particles(index)

    def sample(self, count: int) -> Array:
        """Draw `count` equally likely hypotheses of c, (count, 2), for others."""
        return np.asarray(self.common_m[:, systematic(self.weight, count, self._rng)].T)

    # The filter's belief.

    @property
    def common_m(self) -> Array:
        """Hypotheses (2, K) of the common error."""
        return self.particles.common_m

    @property
    def weight(self) -> Array:
        """Normalized weights (K,) of the hypotheses."""
        return self.particles.weight

    @property
    def estimate_m(self) -> Array:
        """Estimate x = Σ w c of the common error, (2,)."""
        return self.particles.estimate_m

    @property
    def estimate_covariance_m2(self) -> Array:
        """Covariance (2, 2) of the common error."""
        return self.particles.covariance_m2

    @property
    def vehicles(self) -> list[str]:
        """Ids of the tracked vehicles, by row."""
        return self.tracks.names

    def position_m(self, vehicle: str) -> tuple[Array, Array]:
        """Position (2,) of a tracked vehicle now and its covariance (2, 2), over c as well."""
        row, tracks, weight = self.vehicles.index(vehicle), self.tracks, self.weight
        elapsed_s = tracks.age_s[row : row + 1]
        position = tracks.mean[row, :2] + elapsed_s * tracks.mean[row, 2:]
        mean = position @ weight
        spread = position - mean[:, None]
        covariance = predicted_covariance(
            tracks.covariance[row : row + 1],
            transition(elapsed_s),
            tracks.acceleration_m2_s4[row : row + 1],
            elapsed_s,
        )
        return mean, covariance[0, :2, :2] + (spread * weight) @ spread.T

    def velocity_m_s(self, vehicle: str) -> Array:
        """Velocity (2,) of a tracked vehicle."""
        return np.asarray(self.tracks.mean[self.vehicles.index(vehicle), 2:] @ self.weight)


def _whitening(covariance: Array) -> Array:
    """Return W with WᵀW = S⁻¹ for covariances S (M, 2, 2): the inverse of Cholesky's factor."""
    first = np.sqrt(covariance[:, 0, 0])
    slope = covariance[:, 1, 0] / covariance[:, 0, 0]
    second = np.sqrt(covariance[:, 1, 1] - slope * covariance[:, 1, 0])
    whitening = np.zeros(covariance.shape)
    whitening[:, 0, 0], whitening[:, 1, 0], whitening[:, 1, 1] = 1 / first, -slope / second, 1 / second
    return whitening
