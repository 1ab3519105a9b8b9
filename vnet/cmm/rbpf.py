"""The Rao-Blackwellized particle filter of one vehicle (MODEL 2).

Particle k is a hypothesis c^k of the common GNSS error; given it, every tracked vehicle j has a Kalman filter on
[x, y, ẋ, ẏ]. Its covariance P_j, innovation covariance S and gain K do not depend on k, so that a vehicle has one
gain and all particles are one matrix product: means are kept as (M, 4, K) with the particles contiguous.

The road is evidence about a vehicle's offset in its lane, which changes over many seconds. Counting it anew ten
times a second would make the filter far too sure of itself. So what counts of the log-likelihood L of being on the
road is its *change*, log w += L_t − (1 − ρ) L_{t−1}: the latest look replaces the one before, and a share
ρ = Δt/τ of it is new evidence.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vnet.cmm.map_matching import candidate_lanes, log_on_lane
from vnet.errors import VnetError
from vnet.roads.lanes import Array, LaneMap


@dataclass(frozen=True)
class RbpfConfig:
    """Constants of the filter; lengths in metres, times in seconds.

    `common_sigma_m`, `common_tau_s`: the Gauss-Markov process of the common error; `common_walk_m` replaces it by a
    random walk that strays so far in a second (the paper's 0.5 m in 0.1 s are 0.5 / √0.1). `acceleration_m2_s4`:
    white acceleration along the lane, a hundredth of it across. `lateral_tau_s`: how long a vehicle keeps its
    offset in the lane (see the module's text). `gate_sigmas`: fixes further off are outliers. `forget_s`: vehicles
    not heard for that long are dropped.
    """

    particles: int = 200
    common_sigma_m: float = 3.0
    common_tau_s: float = 600.0
    common_walk_m: float | None = None
    acceleration_m2_s4: float = 1.0
    lateral_tau_s: float = 20.0
    gate_sigmas: float = 5.0
    forget_s: float = 2.0

    def __post_init__(self) -> None:
        if self.particles < 2:
            raise VnetError(f"particles = {self.particles}: at least 2 are needed")


@dataclass(frozen=True)
class Observation:
    """A fix of one vehicle: `position_m` (2,) as the receiver says it, noise covariance, heading if known."""

    position_m: Array
    covariance_m2: Array
    heading_rad: float | None


class Rbpf:
    """The filter's state: hypotheses `common_m` (2, K), `log_weight` (K,), and the tracked vehicles."""

    def __init__(self, config: RbpfConfig, lanes: LaneMap, rng: np.random.Generator) -> None:
        self.config = config
        self._lanes = lanes
        self._normal, self._offset_m = lanes.normal, lanes.offset_m
        self._rng = rng
        count = config.particles
        self.common_m = config.common_sigma_m * rng.standard_normal((2, count))
        self.log_weight = np.zeros(count)
        self.vehicles: list[str] = []
        self.mean = np.empty((0, 4, count))
        self.covariance = np.empty((0, 4, 4))
        self._process = np.empty((0, 4, 4))
        self._unseen_s = np.empty(0)
        self._lane_vehicle = np.empty(0, dtype=np.intp)  # one entry a (vehicle, candidate lane)
        self._lane = np.empty(0, dtype=np.intp)
        self._log_road = np.zeros((0, count))  # L of the step before, a row a vehicle

    # One period.

    def step(self, dt_s: float, observations: Mapping[str, Observation]) -> None:
        """Advance by `dt_s` and take the fixes of one instant, by vehicle. Vehicles without one are predicted."""
        self._predict(dt_s)
        self._unseen_s += dt_s
        self._update({name: observations[name] for name in self.vehicles if name in observations})
        for name in sorted(observations.keys() - set(self.vehicles)):
            self._add(name, observations[name], dt_s)
        self._forget()
        self._match_map(dt_s)
        self.log_weight -= self.log_weight.max()
        if self.effective_sample_size < self.config.particles / 2:
            self.resample()

    def _predict(self, dt_s: float) -> None:
        config = self.config
        if config.common_walk_m is None:
            keep = np.exp(-dt_s / config.common_tau_s)
            spread_m = config.common_sigma_m * np.sqrt(1 - keep**2)
            self.common_m *= keep
        else:
            spread_m = config.common_walk_m * np.sqrt(dt_s)
        self.common_m += spread_m * self._rng.standard_normal(self.common_m.shape)
        self.mean[:, :2] += dt_s * self.mean[:, 2:]
        transition = np.eye(4)
        transition[0, 2] = transition[1, 3] = dt_s
        self.covariance = transition @ self.covariance @ transition.T + self._process

    def _update(self, observations: Mapping[str, Observation]) -> None:
        if not observations:
            return
        rows = [self.vehicles.index(name) for name in observations]
        whole = len(rows) == len(self.vehicles)
        fix = np.array([o.position_m for o in observations.values()])
        noise = np.array([o.covariance_m2 for o in observations.values()])
        mean = self.mean if whole else self.mean[rows]
        covariance = self.covariance if whole else self.covariance[rows]
        innovation = fix[:, :, None] - self.common_m
        innovation -= mean[:, :2]
        expected = covariance[:, :2, :2] + noise
        inverse = _inverse_2x2(expected)
        gain = covariance[:, :, :2] @ inverse
        kept = self._inside_gate(innovation, expected)
        gain[~kept] = 0
        inverse[~kept] = 0
        mean += gain @ innovation
        weighted = inverse @ innovation
        weighted *= innovation
        self.log_weight -= 0.5 * weighted.reshape(-1, weighted.shape[2]).sum(axis=0)
        covariance = covariance - gain @ covariance[:, :2, :]
        self.mean[rows] = mean
        self.covariance[rows] = 0.5 * (covariance + covariance.transpose(0, 2, 1))
        self._unseen_s[np.array(rows)[kept]] = 0.0

    def _inside_gate(self, innovation: Array, covariance: Array) -> NDArray[np.bool_]:
        """Per vehicle, not per particle: the gain must stay the same for all particles."""
        weight = self.weight
        middle = innovation @ weight
        square = (innovation * weight) @ innovation.transpose(0, 2, 1)
        total = covariance + square - middle[:, :, None] * middle[:, None, :]
        distance = np.einsum("mi,mij,mj->m", middle, _inverse_2x2(total), middle)
        return np.asarray(distance <= self.config.gate_sigmas**2)

    def _add(self, name: str, observation: Observation, dt_s: float) -> None:
        """Track a vehicle from its first fix: m = z − c, at rest, with the fix's covariance."""
        count = self.config.particles
        mean = np.zeros((1, 4, count))
        mean[0, :2] = observation.position_m[:, None] - self.common_m
        covariance = np.zeros((1, 4, 4))
        covariance[0, :2, :2] = observation.covariance_m2
        covariance[0, 2:, 2:] = np.eye(2) * REST_SPEED_M_S**2
        expected_m = observation.position_m - self.estimate_m
        gate_m = 3 * float(np.sqrt(np.trace(self.estimate_covariance_m2) + np.trace(observation.covariance_m2)))
        lanes = candidate_lanes(self._lanes, expected_m, observation.heading_rad, gate_m)
        heading = observation.heading_rad
        if heading is None and len(lanes):
            heading = float(self._lanes.heading_rad[lanes[0]])
        row = len(self.vehicles)
        self.vehicles.append(name)
        self.mean = np.concatenate([self.mean, mean])
        self.covariance = np.concatenate([self.covariance, covariance])
        process = _process_noise(heading, self.config.acceleration_m2_s4, dt_s)
        self._process = np.concatenate([self._process, process[None]])
        self._unseen_s = np.append(self._unseen_s, 0.0)
        self._lane_vehicle = np.append(self._lane_vehicle, np.full(len(lanes), row))
        self._lane = np.append(self._lane, lanes)
        self._log_road = np.concatenate([self._log_road, np.zeros((1, count))])

    def _forget(self) -> None:
        gone = self._unseen_s > self.config.forget_s
        if not gone.any():
            return
        kept = np.flatnonzero(~gone)
        self.vehicles = [self.vehicles[row] for row in kept]
        self.mean, self.covariance = self.mean[kept], self.covariance[kept]
        self._process, self._unseen_s = self._process[kept], self._unseen_s[kept]
        self._log_road = self._log_road[kept]
        new_row = np.cumsum(~gone) - 1
        still = ~gone[self._lane_vehicle]
        self._lane_vehicle, self._lane = new_row[self._lane_vehicle[still]], self._lane[still]

    def _match_map(self, dt_s: float) -> None:
        if not len(self._lane):
            return
        log_road = self.log_road(self.mean, self.covariance)
        fresh = min(1.0, dt_s / self.config.lateral_tau_s)
        self.log_weight += log_road.sum(axis=0) - (1 - fresh) * self._log_road.sum(axis=0)
        self._log_road = log_road

    def log_road(self, mean: Array, covariance: Array) -> Array:
        """log P(vehicle on a road) as (M, K) for means (M, 4 or 2, K): the candidate lanes as a mixture."""
        one_each = np.array_equal(self._lane_vehicle, np.arange(len(self.vehicles)))
        position = mean if one_each else mean[self._lane_vehicle]
        normal = self._normal[self._lane]
        offset = normal[:, 0, None] * position[:, 0]
        offset += normal[:, 1, None] * position[:, 1]
        offset -= self._offset_m[self._lane][:, None]
        across = np.einsum("pi,pij,pj->p", normal, covariance[self._lane_vehicle, :2, :2], normal)
        score = log_on_lane(offset, np.sqrt(across)[:, None], self._lanes.half_width_m)
        if one_each:
            return score
        result = np.zeros((len(self.vehicles), score.shape[1]))
        for row in range(len(self.vehicles)):
            own = score[self._lane_vehicle == row]
            if len(own):
                result[row] = np.logaddexp.reduce(own, axis=0)
        return result

    # What the filter believes.

    @property
    def log_weight(self) -> Array:
        """Log-weights (K,), up to a constant."""
        return self._log_weight

    @log_weight.setter
    def log_weight(self, log_weight: Array) -> None:
        self._log_weight = log_weight
        self._weight: Array | None = None

    @property
    def weight(self) -> Array:
        """Normalized weights (K,)."""
        if self._weight is None:
            weight = np.exp(self._log_weight - self._log_weight.max())
            self._weight = weight / weight.sum()
        return self._weight

    @property
    def effective_sample_size(self) -> float:
        """1 / Σ w²."""
        return float(1.0 / np.sum(self.weight**2))

    @property
    def estimate_m(self) -> Array:
        """x = Σ w c, (2,)."""
        return np.asarray(self.common_m @ self.weight)

    @property
    def estimate_covariance_m2(self) -> Array:
        """Weighted covariance of c, (2, 2)."""
        spread = self.common_m - self.estimate_m[:, None]
        return np.asarray((spread * self.weight) @ spread.T)

    def position_m(self, vehicle: str) -> tuple[Array, Array]:
        """Position (2,) of a tracked vehicle and its covariance (2, 2), over c as well."""
        row = self.vehicles.index(vehicle)
        weight = self.weight
        mean = self.mean[row, :2] @ weight
        spread = self.mean[row, :2] - mean[:, None]
        return mean, self.covariance[row, :2, :2] + (spread * weight) @ spread.T

    def velocity_m_s(self, vehicle: str) -> Array:
        """Velocity (2,) of a tracked vehicle."""
        return np.asarray(self.mean[self.vehicles.index(vehicle), 2:] @ self.weight)

    # Resampling and fusion.

    def resample(self) -> None:
        """Systematic resampling (Kitagawa 1996) to equal weights."""
        self._take(systematic(self.weight, self.config.particles, self._rng))

    def _take(self, index: NDArray[np.intp]) -> None:
        self.common_m = self.common_m[:, index]
        self.mean = self.mean[:, :, index]
        self._log_road = self._log_road[:, index]
        self.log_weight = np.zeros(len(index))

    def sample(self, count: int) -> Array:
        """`count` equally likely hypotheses of c as (count, 2), for others."""
        return np.asarray(self.common_m[:, systematic(self.weight, count, self._rng)].T)

    def regression(self) -> tuple[Array, Array, Array]:
        """Conditional means on c: (m̄ (M, 4), B (M, 4, 2), c̄ (2,)) with m_j(c) = m̄_j + B_j (c − c̄).

        B_j = Cov(m_j, c) Cov(c)⁻¹; where the cloud has collapsed, −I for positions: a vehicle is where its fix
        says, less c.
        """
        weight = self.weight
        centre = self.common_m @ weight
        spread = self.common_m - centre[:, None]
        covariance = (spread * weight) @ spread.T
        mean = self.mean @ weight
        eigenvalues = np.linalg.eigvalsh(covariance)
        if eigenvalues[0] < COLLAPSED_M2 or eigenvalues[0] < 1e-6 * eigenvalues[1]:
            slope = np.zeros((len(self.vehicles), 4, 2))
            slope[:, 0, 0] = slope[:, 1, 1] = -1.0
            return mean, slope, centre
        cross = (self.mean - mean[:, :, None]) @ (spread * weight).T
        return mean, cross @ np.linalg.inv(covariance), centre

    def supply(self, common_m: Array) -> tuple[Array, Array]:
        """What this filter makes of hypotheses (n, 2): conditional means (M, 4, n), log P on road (M, n)."""
        mean, slope, centre = self.regression()
        supplied = mean[:, :, None] + slope @ (common_m.T - centre[:, None])
        if not len(self._lane):
            return supplied, np.zeros((len(mean), len(common_m)))
        return supplied, self.log_road(supplied, self.covariance)

    @property
    def own_log_road(self) -> Array:
        """log P on road of each tracked vehicle and particle (M, K), as counted in the weights."""
        return self._log_road

    def replace(
        self, own: NDArray[np.intp], common_m: Array, supplied: Array, log_road: Array, log_weight: Array
    ) -> None:
        """Go on with the particles `own` (indices) and hypotheses (n, 2) as `supply` made them, resampled to K.

        `log_weight` (n,) are the weights of the hypotheses relative to own particles.
        """
        count = self.config.particles
        weight = np.concatenate([np.ones(len(own)), np.exp(log_weight - max(0.0, log_weight.max()))])
        weight[: len(own)] *= np.exp(-max(0.0, log_weight.max()))
        index = systematic(weight / weight.sum(), count, self._rng)
        from_own = own[index[index < len(own)]]
        imported = index[index >= len(own)] - len(own)
        self.common_m = np.concatenate([self.common_m[:, from_own], common_m[imported].T], axis=1)
        self.mean = np.concatenate([self.mean[:, :, from_own], supplied[:, :, imported]], axis=2)
        self._log_road = np.concatenate([self._log_road[:, from_own], log_road[:, imported]], axis=1)
        self.log_weight = np.zeros(count)


REST_SPEED_M_S = 0.5
"""Deviation of a vehicle's speed at its first fix."""
COLLAPSED_M2 = 1e-6


def systematic(weight: Array, count: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Indices of a systematic sample: one draw, `count` equidistant pointers into the cumulated weights."""
    pointers = (np.arange(count) + rng.random()) / count
    index = np.searchsorted(np.cumsum(weight), pointers)
    return np.asarray(np.minimum(index, len(weight) - 1))


def _process_noise(heading_rad: float | None, acceleration_m2_s4: float, dt_s: float) -> Array:
    """White acceleration over `dt_s`, (4, 4): along the lane, and a hundredth of it across."""
    if heading_rad is None:
        shape = np.eye(2) * acceleration_m2_s4
    else:
        along = np.array([np.cos(heading_rad), np.sin(heading_rad)])
        across = np.array([-along[1], along[0]])
        shape = acceleration_m2_s4 * (np.outer(along, along) + 0.01 * np.outer(across, across))
    push = np.array([dt_s**2 / 2, dt_s])
    return np.asarray(np.kron(np.outer(push, push), shape))


def _inverse_2x2(matrix: Array) -> Array:
    """Inverses of (M, 2, 2): faster than the general routine."""
    a, b, c, d = matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 0], matrix[:, 1, 1]
    determinant = a * d - b * c
    inverse = np.empty_like(matrix)
    inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 0], inverse[:, 1, 1] = d, -b, -c, a
    return np.asarray(inverse / determinant[:, None, None])
