"""The estimator's step against other ways to do it: what one gain for all particles of a vehicle buys.

`rbpf` is ours, 500 particles × 10 vehicles. `per_particle` is the same filter written the obvious way: every
particle carries the covariance of every vehicle. Stone Soup and filterpy have no such filter; what they do here is
the *bias part* alone: particles on the 2-D common error, each step weighed by the roads of all ten vehicles given
their latest fixes, nothing else; no Kalman filters, so that nothing is learnt of the vehicles. `own_bias` is that
part with our map matching and our resampling. `…_bare` rows are less than that: two numbers measured directly, no
roads. A step is timed together with the estimate after it. All take turns step by step, so that whatever else the
machine does hits all alike. Needs the extra `bench`.
"""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

import numpy as np
from filterpy.monte_carlo import systematic_resample
from scipy.special import ndtr
from scipy.stats import norm
from stonesoup.base import Property
from stonesoup.models.measurement import MeasurementModel
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.transition.linear import LinearGaussianTimeInvariantTransitionModel
from stonesoup.predictor.particle import ParticlePredictor
from stonesoup.resampler.particle import ESSResampler, SystematicResampler
from stonesoup.types.array import StateVectors
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import ParticleState
from stonesoup.updater.particle import ParticleUpdater

from agents.cooperative.cmm.common_error import systematic
from agents.cooperative.cmm.map_matching import candidate_lanes, log_on_lane
from agents.cooperative.cmm.rbpf import REST_SPEED_M_S, Observation, Rbpf, RbpfConfig
from vnet.roads.lanes import LaneMap
from vnet.types import Array

PARTICLES, VEHICLES, STEPS, WARM_UP = 500, 10, 400, 20
DT_S = 0.1
BIAS_M = np.array([2.0, -1.0])
CONFIG = RbpfConfig(particles=PARTICLES)
KEEP = float(np.exp(-DT_S / CONFIG.common_tau_s))
SPREAD_M = CONFIG.common_sigma_m * float(np.sqrt(1 - KEEP**2))
START = datetime(2026, 1, 1)
FIX_SIGMA_M = 1.0
RESAMPLING = ("resample", "filterpy_resample")
"""The one thing that ours and filterpy both bring: systematic resampling of the same weights."""
NEVER_ALL_ZERO = 1e-300
"""Added to weights as in the book of filterpy's author: they must not all vanish."""


class PerParticle:
    """The model of `cmm.rbpf` with means (K, M, 4) and covariances (K, M, 4, 4): a Kalman filter a particle.

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


def _process_noise(heading_rad: float | None) -> Array:
    """White acceleration over a step along the lane, a hundredth of it across, (4, 4)."""
    assert heading_rad is not None, "every fix of the benchmark has a heading"
    along = np.array([np.cos(heading_rad), np.sin(heading_rad)])
    across = np.array([-along[1], along[0]])
    shape = CONFIG.acceleration_m2_s4 * (np.outer(along, along) + 0.01 * np.outer(across, across))
    push = np.array([DT_S**2 / 2, DT_S])
    noise: Array = np.kron(np.outer(push, push), shape).astype(float)
    return noise


def _inverse_2x2(matrix: Array) -> tuple[Array, Array]:
    """Inverses and determinants of (..., 2, 2): several times faster than numpy's general routine."""
    a, b, c, d = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 0], matrix[..., 1, 1]
    determinant = a * d - b * c
    inverse = np.empty_like(matrix)
    inverse[..., 0, 0], inverse[..., 0, 1], inverse[..., 1, 0], inverse[..., 1, 1] = d, -b, -c, a
    return inverse / determinant[..., None, None], determinant


@dataclass(frozen=True)
class Roads:
    """The lane of each vehicle: what a fix says about the common error, because a vehicle is on its road."""

    normal: Array
    offset_m: Array
    half_width_m: float

    def all_at_once(self, common_m: Array, fix_m: Array) -> Array:
        """P(all are on their lanes) for hypotheses (2, K) and fixes (2 n,): the product over n vehicles, (K,)."""
        fix_offset_m = np.sum(self.normal * fix_m.reshape(-1, 2), axis=1) - self.offset_m
        offset_m = fix_offset_m[:, None] - self.normal @ common_m
        upper = ndtr((self.half_width_m - offset_m) / FIX_SIGMA_M)
        return np.prod(upper - ndtr((-self.half_width_m - offset_m) / FIX_SIGMA_M), axis=0)

    def one_by_one(self, common_m: Array, fix_m: Array) -> Array:
        """The same in the way of filterpy's book, which goes through its landmarks with scipy.stats."""
        likelihood = np.ones(common_m.shape[1])
        for normal, offset_m, fix in zip(self.normal, self.offset_m, fix_m.reshape(-1, 2), strict=True):
            off_m = normal @ fix - offset_m - normal @ common_m
            likelihood *= norm.cdf(self.half_width_m, off_m, FIX_SIGMA_M) - norm.cdf(
                -self.half_width_m, off_m, FIX_SIGMA_M
            )
        return likelihood


def measured_directly(common_m: Array, measured_m: Array) -> Array:
    """The likelihood of hypotheses (2, K) if somebody measured the common error, with covariance 1 m²."""
    off = measured_m[:, None] - common_m
    return np.exp(-0.5 * np.sum(off * off, axis=0))


class OnTheRoad(MeasurementModel):
    """`Roads` as a model of Stone Soup's: a measurement is the fixes of all vehicles, one below the other."""

    roads: Roads = Property(doc="Lanes of the vehicles")

    @property
    def ndim_meas(self) -> int:
        """Two for each vehicle."""
        return 2 * len(self.roads.normal)

    def logpdf(self, state1: Detection, state2: ParticleState, **_: object) -> Array:
        """Log-likelihood of the fixes `state1` for each of the particles `state2`."""
        common_m, fix_m = np.asarray(state2.state_vector), np.asarray(state1.state_vector).ravel()
        return np.log(self.roads.all_at_once(common_m, fix_m) + NEVER_ALL_ZERO)

    def pdf(self, state1: Detection, state2: ParticleState, **_: object) -> Array:
        """Not in the log domain. A particle filter asks for `logpdf` only."""
        return np.exp(self.logpdf(state1, state2))

    def function(self, state: ParticleState, noise: bool = False, **_: object) -> StateVectors:
        """No fix follows from a common error alone."""
        raise NotImplementedError

    def rvs(self, num_samples: int = 1, **_: object) -> StateVectors:
        """No noise of its own."""
        raise NotImplementedError


class StoneSoupBias:
    """Stone Soup's particle filter of the common error, with a measurement model."""

    def __init__(self, model: MeasurementModel, rng: np.random.Generator, every_step: bool) -> None:
        walk = LinearGaussianTimeInvariantTransitionModel(
            transition_matrix=KEEP * np.eye(2), covariance_matrix=SPREAD_M**2 * np.eye(2)
        )
        resampler = SystematicResampler() if every_step else ESSResampler()  # below half of the particles
        self._predictor = ParticlePredictor(walk)
        self._updater = ParticleUpdater(model, resampler)
        particles = StateVectors(CONFIG.common_sigma_m * rng.standard_normal((2, PARTICLES)))
        self._state = ParticleState(particles, weight=np.full(PARTICLES, 1 / PARTICLES), timestamp=START)

    def step(self, measured: Array) -> None:
        """Predict, update, resample."""
        now = self._state.timestamp + timedelta(seconds=DT_S)
        prediction = self._predictor.predict(self._state, timestamp=now)
        detection = Detection(measured[:, None], timestamp=now)
        self._state = self._updater.update(SingleHypothesis(prediction, detection))

    @property
    def estimate_m(self) -> Array:
        """The weighted mean, (2,)."""
        return np.asarray(self._state.mean, dtype=float).ravel()


class FilterpyBias:
    """The same with filterpy, which has the resampling; its documentation leaves the rest to the user's numpy."""

    def __init__(
        self, likelihood: Callable[[Array, Array], Array], rng: np.random.Generator, every_step: bool
    ) -> None:
        self._likelihood, self._rng, self._every_step = likelihood, rng, every_step
        self._common_m = CONFIG.common_sigma_m * rng.standard_normal((2, PARTICLES))
        self._weight = np.full(PARTICLES, 1 / PARTICLES)

    def step(self, measured: Array) -> None:
        """Predict, update, resample."""
        self._common_m *= KEEP
        self._common_m += SPREAD_M * self._rng.standard_normal((2, PARTICLES))
        self._weight *= self._likelihood(self._common_m, measured)
        self._weight += NEVER_ALL_ZERO
        self._weight /= self._weight.sum()
        if self._every_step or 1 / np.sum(self._weight**2) < PARTICLES / 2:
            self._common_m = self._common_m[:, systematic_resample(self._weight)]
            self._weight = np.full(PARTICLES, 1 / PARTICLES)

    @property
    def estimate_m(self) -> Array:
        """The weighted mean, (2,)."""
        return self._common_m @ self._weight


class OwnBias:
    """The same with what `agents.cooperative.cmm` brings: map matching in the log domain, and its resampling."""

    def __init__(self, roads: Roads, rng: np.random.Generator, every_step: bool) -> None:
        self._roads, self._rng, self._every_step = roads, rng, every_step
        self._common_m = CONFIG.common_sigma_m * rng.standard_normal((2, PARTICLES))
        self._log_weight = np.zeros(PARTICLES)
        self._weight: Array
        self._weigh()

    def step(self, fix_m: Array) -> None:
        """Predict, update, resample."""
        roads = self._roads
        self._common_m *= KEEP
        self._common_m += SPREAD_M * self._rng.standard_normal((2, PARTICLES))
        fix_offset_m = np.sum(roads.normal * fix_m.reshape(-1, 2), axis=1) - roads.offset_m
        offset_m = fix_offset_m[:, None] - roads.normal @ self._common_m
        self._log_weight += log_on_lane(offset_m, np.array([[FIX_SIGMA_M]]), roads.half_width_m).sum(axis=0)
        self._weigh()
        if self._every_step or 1 / (self._weight @ self._weight) < PARTICLES / 2:
            self._common_m = self._common_m.take(systematic(self._weight, PARTICLES, self._rng), axis=-1)
            self._log_weight = np.zeros(PARTICLES)
            self._weight = np.full(PARTICLES, 1 / PARTICLES)

    def _weigh(self) -> None:
        self._log_weight -= self._log_weight.max()
        weight = np.exp(self._log_weight)
        self._weight = weight / weight.sum()

    @property
    def estimate_m(self) -> Array:
        """The weighted mean, (2,)."""
        return self._common_m @ self._weight


Bias = StoneSoupBias | FilterpyBias | OwnBias


def _bias_filters(lanes: LaneMap, every_step: bool) -> dict[str, Bias]:
    """The bias part by all means, resampled when needed or at every step; lane j is vehicle j's."""
    roads = Roads(lanes.normal, lanes.offset_m, lanes.half_width_m)
    on_the_road = OnTheRoad(ndim_state=2, mapping=(0, 1), roads=roads)
    directly = LinearGaussian(2, (0, 1), np.eye(2))
    filters: dict[str, Bias] = {
        "stonesoup_bias": StoneSoupBias(on_the_road, np.random.default_rng(1), every_step),
        "filterpy_bias": FilterpyBias(roads.one_by_one, np.random.default_rng(1), every_step),
        "filterpy_bias_at_once": FilterpyBias(roads.all_at_once, np.random.default_rng(1), every_step),
        "own_bias": OwnBias(roads, np.random.default_rng(1), every_step),
        "stonesoup_bare": StoneSoupBias(directly, np.random.default_rng(1), every_step),
        "filterpy_bare": FilterpyBias(measured_directly, np.random.default_rng(1), every_step),
    }
    return {f"{name}_resampling" if every_step else name: each for name, each in filters.items()}


def compare() -> dict[str, float]:
    """Medians of a step in µs, ratios to ours, and how far the estimates are from the truth and each other."""
    rng = np.random.default_rng(0)
    heading = rng.uniform(0, 2 * np.pi, VEHICLES)
    point = rng.uniform(0, 5000, (VEHICLES, 2))
    lanes = LaneMap(point, heading, 0.85)

    def fixes() -> dict[str, Observation]:
        fix = point + BIAS_M + FIX_SIGMA_M * rng.normal(size=(VEHICLES, 2))
        noise = FIX_SIGMA_M**2 * np.eye(2)
        return {f"v{j}": Observation(fix[j], noise, float(heading[j])) for j in range(VEHICLES)}

    first = fixes()
    ours = Rbpf(CONFIG, lanes, np.random.default_rng(1))
    ours.step(DT_S, first)
    plain = PerParticle(lanes, np.random.default_rng(1), first)
    bias = _bias_filters(lanes, every_step=False) | _bias_filters(lanes, every_step=True)
    times_us: dict[str, list[float]] = {name: [] for name in ("rbpf", "per_particle", *bias, *RESAMPLING)}
    apart_m = 0.0
    for _ in range(WARM_UP + STEPS):
        seen, measured_m = fixes(), BIAS_M + rng.normal(size=2)
        fix_m = np.concatenate([fix.position_m for fix in seen.values()])
        times_us["rbpf"].append(_time_us(_advance, ours, DT_S, seen))
        times_us["per_particle"].append(_time_us(_advance, plain, seen))
        for name, each in bias.items():
            z = measured_m if "bare" in name else fix_m
            times_us[name].append(_time_us(_advance, each, z))
        weight = rng.dirichlet(np.ones(PARTICLES))
        times_us["resample"].append(_time_us(systematic, weight, PARTICLES, rng))
        times_us["filterpy_resample"].append(_time_us(systematic_resample, weight))
        apart_m = max(apart_m, float(np.linalg.norm(ours.estimate_m - plain.estimate_m)))
    errors_m = {name: float(np.linalg.norm(each.estimate_m - BIAS_M)) for name, each in bias.items()}
    return _figures(times_us) | {
        "rbpf_and_per_particle_apart_m": apart_m,
        "rbpf_error_m": float(np.linalg.norm(ours.estimate_m - BIAS_M)),
        "largest_error_of_a_bias_part_m": max(error for name, error in errors_m.items() if "bare" not in name),
    }


def _advance(estimator: Any, *arguments: object) -> Array:
    """Advance an estimator, of whichever kind, by one step and return its estimate."""
    estimator.step(*arguments)
    estimate_m: Array = estimator.estimate_m
    return estimate_m


def _time_us(step: Callable[..., object], *arguments: object) -> float:
    started = time.perf_counter()
    step(*arguments)
    return (time.perf_counter() - started) * 1e6


def _figures(times_us: dict[str, list[float]]) -> dict[str, float]:
    medians = {name: statistics.median(times[WARM_UP:]) for name, times in times_us.items()}
    steps = [name for name in medians if name not in ("rbpf", *RESAMPLING)]
    ratios = {f"{name}_over_rbpf": medians[name] / medians["rbpf"] for name in steps}
    ratios["filterpy_resample_over_resample"] = medians["filterpy_resample"] / medians["resample"]
    return {f"{name}_us": value for name, value in medians.items()} | ratios
