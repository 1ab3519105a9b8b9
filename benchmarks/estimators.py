"""The estimator's step against other ways to do it: what one gain for all particles of a vehicle buys.

`rbpf` is ours, 500 particles × 10 vehicles. `per_particle` is the same filter written the obvious way: every
particle carries the covariance of every vehicle. Stone Soup and filterpy have no such filter; they do the bias part
alone, a particle filter on the 2-D common error, which is measured directly once a step: no vehicles, no
covariances, no map. All take turns step by step, so that whatever else the machine does hits all alike. Needs the
extra `bench`.
"""

import statistics
import time
from collections.abc import Callable
from datetime import datetime, timedelta

import numpy as np
from filterpy.monte_carlo import systematic_resample
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, RandomWalk
from stonesoup.predictor.particle import ParticlePredictor
from stonesoup.resampler.particle import ESSResampler, SystematicResampler
from stonesoup.types.array import StateVectors
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import ParticleState
from stonesoup.updater.particle import ParticleUpdater

from vnet.cmm.map_matching import candidate_lanes, log_on_lane
from vnet.cmm.rbpf import REST_SPEED_M_S, Observation, Rbpf, RbpfConfig, systematic
from vnet.roads.lanes import Array, LaneMap

PARTICLES, VEHICLES, STEPS, WARM_UP = 500, 10, 400, 20
DT_S = 0.1
BIAS_M = np.array([2.0, -1.0])
CONFIG = RbpfConfig(particles=PARTICLES)
KEEP = float(np.exp(-DT_S / CONFIG.common_tau_s))
SPREAD_M = CONFIG.common_sigma_m * float(np.sqrt(1 - KEEP**2))
START = datetime(2026, 1, 1)
RESAMPLING = ("resample", "filterpy_resample")
"""The one thing that ours and filterpy both bring: systematic resampling of the same weights."""


class PerParticle:
    """The model of `vnet.cmm.rbpf` with means (K, M, 4) and covariances (K, M, 4, 4): a Kalman filter a particle.

    Vectorized over particles and vehicles; no loop in Python but over vehicles with several candidate lanes. In its
    favour it does without what ours also has: the outlier gate, old fixes, vehicles that come and go.
    """

    def __init__(self, lanes: LaneMap, rng: np.random.Generator, first: dict[str, Observation]) -> None:
        self._lanes, self._rng = lanes, rng
        self.common_m = CONFIG.common_sigma_m * rng.standard_normal((2, PARTICLES)).T
        self._predict_common()
        self.log_weight = np.zeros(PARTICLES)
        fix = np.array([o.position_m for o in first.values()])
        self._mean = np.zeros((PARTICLES, len(first), 4))
        self._mean[:, :, :2] = fix - self.common_m[:, None]
        self._covariance = np.zeros((PARTICLES, len(first), 4, 4))
        self._covariance[:, :, :2, :2] = [o.covariance_m2 for o in first.values()]
        self._covariance[:, :, 2:, 2:] = np.eye(2) * REST_SPEED_M_S**2
        self._transition = np.eye(4)
        self._transition[0, 2] = self._transition[1, 3] = DT_S
        self._process = np.array([_process_noise(o.heading_rad) for o in first.values()])
        self._find_lanes(first)
        self._log_road = self._match_map()
        self.log_weight += self._log_road.sum(axis=1)
        self._resample_if_needed()

    def step(self, observations: dict[str, Observation]) -> None:
        """Predict, update, match with the map, resample."""
        self._predict_common()
        self._mean = self._mean @ self._transition.T
        self._covariance = self._transition @ self._covariance @ self._transition.T + self._process
        self._update(observations)
        log_road = self._match_map()
        stays = 1 - DT_S / CONFIG.lateral_tau_s
        self.log_weight += (log_road - stays * self._log_road).sum(axis=1)
        self._log_road = log_road
        self._resample_if_needed()

    @property
    def estimate_m(self) -> Array:
        """The weighted mean of the common error, (2,)."""
        return self._weight() @ self.common_m

    def _predict_common(self) -> None:
        self.common_m = KEEP * self.common_m + SPREAD_M * self._rng.standard_normal((2, PARTICLES)).T

    def _update(self, observations: dict[str, Observation]) -> None:
        fix = np.array([o.position_m for o in observations.values()])
        noise = np.array([o.covariance_m2 for o in observations.values()])
        innovation = (fix - self.common_m[:, None] - self._mean[:, :, :2])[..., None]
        inverse, determinant = _inverse_2x2(self._covariance[:, :, :2, :2] + noise)
        gain = self._covariance[:, :, :, :2] @ inverse
        self._mean += (gain @ innovation)[..., 0]
        self._covariance -= gain @ self._covariance[:, :, :2, :]
        distance = np.sum(innovation * (inverse @ innovation), axis=(1, 2, 3))
        self.log_weight -= 0.5 * (distance + np.log(determinant).sum(axis=1))

    def _find_lanes(self, first: dict[str, Observation]) -> None:
        """Pairs of a vehicle and a lane it may be on, chosen as ours does."""
        estimate = self.common_m.mean(axis=0)
        spread = np.cov(self.common_m.T, bias=True)
        pairs = []
        for row, fix in enumerate(first.values()):
            gate_m = 3 * float(np.sqrt(np.trace(spread) + np.trace(fix.covariance_m2)))
            lanes = candidate_lanes(self._lanes, fix.position_m - estimate, fix.heading_rad, gate_m)
            pairs += [(row, lane) for lane in lanes]
        self._vehicle, lane = np.array(pairs).T
        self._normal, self._offset_m = self._lanes.normal[lane], self._lanes.offset_m[lane]

    def _match_map(self) -> Array:
        """log P on road, (K, M)."""
        one_each = np.array_equal(self._vehicle, np.arange(self._mean.shape[1]))
        mean = self._mean if one_each else self._mean[:, self._vehicle]
        covariance = self._covariance if one_each else self._covariance[:, self._vehicle]
        offset = np.einsum("kpi,pi->kp", mean[:, :, :2], self._normal) - self._offset_m
        across = np.einsum("pi,kpij,pj->kp", self._normal, covariance[:, :, :2, :2], self._normal)
        score = log_on_lane(offset, np.sqrt(across), self._lanes.half_width_m)
        if one_each:
            return score
        own = [score[:, self._vehicle == row] for row in range(self._mean.shape[1])]
        return np.stack([np.logaddexp.reduce(each, axis=1) for each in own], axis=1)

    def _weight(self) -> Array:
        weight = np.exp(self.log_weight - self.log_weight.max())
        return weight / weight.sum()

    def _resample_if_needed(self) -> None:
        weight = self._weight()
        if 1 / np.sum(weight**2) >= PARTICLES / 2:
            return
        index = systematic(weight, PARTICLES, self._rng)
        self.common_m, self._log_road = self.common_m[index], self._log_road[index]
        self._mean, self._covariance = self._mean[index], self._covariance[index]
        self.log_weight = np.zeros(PARTICLES)


def _process_noise(heading_rad: float) -> Array:
    """White acceleration over a step along the lane, a hundredth of it across, (4, 4)."""
    along = np.array([np.cos(heading_rad), np.sin(heading_rad)])
    across = np.array([-along[1], along[0]])
    shape = CONFIG.acceleration_m2_s4 * (np.outer(along, along) + 0.01 * np.outer(across, across))
    push = np.array([DT_S**2 / 2, DT_S])
    return np.kron(np.outer(push, push), shape)


def _inverse_2x2(matrix: Array) -> tuple[Array, Array]:
    """Inverses and determinants of (..., 2, 2): several times faster than numpy's general routine."""
    a, b, c, d = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 0], matrix[..., 1, 1]
    determinant = a * d - b * c
    inverse = np.empty_like(matrix)
    inverse[..., 0, 0], inverse[..., 0, 1], inverse[..., 1, 0], inverse[..., 1, 1] = d, -b, -c, a
    return inverse / determinant[..., None, None], determinant


class StoneSoupBias:
    """Stone Soup's particle filter of the common error, which is measured with covariance 1 m²."""

    def __init__(self, rng: np.random.Generator, every_step: bool) -> None:
        walk = RandomWalk(SPREAD_M**2 / DT_S)
        resampler = SystematicResampler() if every_step else ESSResampler()  # below half of the particles
        self._predictor = ParticlePredictor(CombinedLinearGaussianTransitionModel([walk, walk]))
        self._updater = ParticleUpdater(LinearGaussian(2, (0, 1), np.eye(2)), resampler)
        particles = StateVectors(CONFIG.common_sigma_m * rng.standard_normal((2, PARTICLES)))
        self._state = ParticleState(particles, weight=np.full(PARTICLES, 1 / PARTICLES), timestamp=START)

    def step(self, measured_m: Array) -> None:
        """Predict, update, resample."""
        now = self._state.timestamp + timedelta(seconds=DT_S)
        prediction = self._predictor.predict(self._state, timestamp=now)
        detection = Detection(measured_m[:, None], timestamp=now)
        self._state = self._updater.update(SingleHypothesis(prediction, detection))

    @property
    def estimate_m(self) -> Array:
        """The weighted mean, (2,)."""
        return np.asarray(self._state.mean, dtype=float).ravel()


class FilterpyBias:
    """The same with filterpy, which has the resampling; its documentation leaves the rest to the user's numpy."""

    def __init__(self, rng: np.random.Generator, every_step: bool) -> None:
        self._rng, self._every_step = rng, every_step
        self._common_m = CONFIG.common_sigma_m * rng.standard_normal((2, PARTICLES))
        self._weight = np.full(PARTICLES, 1 / PARTICLES)

    def step(self, measured_m: Array) -> None:
        """Predict, update, resample."""
        self._common_m += SPREAD_M * self._rng.standard_normal((2, PARTICLES))
        off = measured_m[:, None] - self._common_m
        self._weight *= np.exp(-0.5 * np.sum(off * off, axis=0))
        self._weight += 1e-300  # as in the book of filterpy's author: they must not all vanish
        self._weight /= self._weight.sum()
        if self._every_step or 1 / np.sum(self._weight**2) < PARTICLES / 2:
            self._common_m = self._common_m[:, systematic_resample(self._weight)]
            self._weight = np.full(PARTICLES, 1 / PARTICLES)

    @property
    def estimate_m(self) -> Array:
        """The weighted mean, (2,)."""
        return self._common_m @ self._weight


def compare() -> dict[str, float]:
    """Medians of a step in µs, ratios to ours, and how far the estimates are from the truth and each other."""
    rng = np.random.default_rng(0)
    heading = rng.uniform(0, 2 * np.pi, VEHICLES)
    point = rng.uniform(0, 5000, (VEHICLES, 2))
    lanes = LaneMap(point, heading, 0.85)

    def fixes() -> dict[str, Observation]:
        fix = point + BIAS_M + rng.normal(size=(VEHICLES, 2))
        return {f"v{j}": Observation(fix[j], np.eye(2), float(heading[j])) for j in range(VEHICLES)}

    first = fixes()
    ours = Rbpf(CONFIG, lanes, np.random.default_rng(1))
    ours.step(DT_S, first)
    plain = PerParticle(lanes, np.random.default_rng(1), first)
    others = {
        "stonesoup_bias": StoneSoupBias(np.random.default_rng(1), every_step=False),
        "filterpy_bias": FilterpyBias(np.random.default_rng(1), every_step=False),
        "stonesoup_bias_resampling": StoneSoupBias(np.random.default_rng(1), every_step=True),
        "filterpy_bias_resampling": FilterpyBias(np.random.default_rng(1), every_step=True),
    }
    times_us: dict[str, list[float]] = {name: [] for name in ("rbpf", "per_particle", *others, *RESAMPLING)}
    apart_m = 0.0
    for _ in range(WARM_UP + STEPS):
        seen, measured_m = fixes(), BIAS_M + rng.normal(size=2)
        times_us["rbpf"].append(_time_us(lambda seen=seen: ours.step(DT_S, seen)))
        times_us["per_particle"].append(_time_us(lambda seen=seen: plain.step(seen)))
        for name, other in others.items():
            times_us[name].append(_time_us(lambda other=other, z=measured_m: other.step(z)))
        weight = rng.dirichlet(np.ones(PARTICLES))
        times_us["resample"].append(_time_us(lambda w=weight: systematic(w, PARTICLES, rng)))
        times_us["filterpy_resample"].append(_time_us(lambda w=weight: systematic_resample(w)))
        apart_m = max(apart_m, float(np.linalg.norm(ours.estimate_m - plain.estimate_m)))
    errors_m = {name: float(np.linalg.norm(each.estimate_m - BIAS_M)) for name, each in others.items()}
    return _figures(times_us) | {
        "rbpf_and_per_particle_apart_m": apart_m,
        "rbpf_error_m": float(np.linalg.norm(ours.estimate_m - BIAS_M)),
        "largest_error_of_the_others_m": max(errors_m.values()),
    }


def _time_us(step: Callable[[], None]) -> float:
    started = time.perf_counter()
    step()
    return (time.perf_counter() - started) * 1e6


def _figures(times_us: dict[str, list[float]]) -> dict[str, float]:
    medians = {name: statistics.median(times[WARM_UP:]) for name, times in times_us.items()}
    steps = [name for name in medians if name not in ("rbpf", *RESAMPLING)]
    ratios = {f"{name}_over_rbpf": medians[name] / medians["rbpf"] for name in steps}
    ratios["filterpy_resample_over_resample"] = medians["filterpy_resample"] / medians["resample"]
    return {f"{name}_us": value for name, value in medians.items()} | ratios
