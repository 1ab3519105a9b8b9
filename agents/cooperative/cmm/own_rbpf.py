"""The Rao-Blackwellized particle filter of one vehicle that tracks itself alone, while lanes compete (MODEL 10).

Particle k is a hypothesis c^k of the common error. Given it, all else is analytic: which of the candidate lanes the
vehicle is on, and on lane h its own state (l, s, v), the offset to the right of the centre line, position and speed
along it, with a Kalman filter whose covariance V_h does not depend on k. The offset is a state, so that a lane is
evidence once and not ten times a second. To others the filter says what it knew before its fix (`belief`), and what
the fix says about c alone, the increment (`take`); from them it takes the same (`absorb`). Once one lane is left,
all is Gaussian, and `own_kalman` goes on.

Sums of products are written out: those of BLAS differ in their last bits from one processor to another.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from agents.cooperative.cmm.common_error import systematic
from agents.cooperative.cmm.information import (
    Five,
    Information,
    inverse,
    new_at_mean,
    plain_moments,
    square_root,
)
from agents.cooperative.cmm.kalman_bound import LaneModel, lane_axes
from agents.cooperative.cmm.own_kalman import LEAST_VARIANCE_M2, OwnKalman
from vnet.types import Array

DECIDED = 1e-4
"""Probability below which a lane is out of question."""
COMPETING_FACTOR = 4
"""So many times the particles of the options: as lanes compete they are weighed, and not moved."""
LEAST_NOISE_M2 = 0.25
"""Variance (m²) of a fix at least, as long as lanes compete: with less the particles are too few, and the lanes of
a map are metres apart."""
SIZE_STEP = 1.5
"""Ratio by which the number of particles that is wanted must differ before it changes: each change resamples."""
LARGEST_PULL = 1.0
"""Largest distance, in deviations of what was known, by which what others know moves the mean in a period: further
out there are too few particles."""
PULL_REACH = 3.0
"""Deviations from the mean beyond which a particle is drawn no more than there: a hump on a lane far away, however
unlikely, would outweigh all others."""
_IDENTITY = np.eye(2)


class OwnRbpf:
    """The filter of a vehicle on one of the lanes through `point_m` (H, 2) with directions `heading_rad` (H,).

    common_m: (2, K), the hypotheses of the common error, and weight: (K,), their normalized weights.
    estimate_m, estimate_covariance_m2: mean (2,) and covariance (2, 2) of the common error.
    """

    def __init__(
        self,
        lanes: tuple[Array, Array],
        model: LaneModel,
        particles: int,
        rng: np.random.Generator,
        belief: tuple[Array, Array] | None = None,
        least_particles: int = 0,
    ) -> None:
        """Draw the first particles from `belief`, mean (2,) and covariance (2, 2), by default the model's of c.

        With `least_particles` their number goes down to that as their spread does.
        """
        point_m, heading_rad = lanes
        self._most = COMPETING_FACTOR * particles
        self._least = min(least_particles or self._most, self._most)
        self._rng = rng
        self._model = model
        self._point_m, self._heading_rad = np.array(point_m, dtype=float), np.array(heading_rad, dtype=float)
        self._axes = lane_axes(self._heading_rad)
        mean_m, covariance_m2 = belief or (np.zeros(2), model.common_sigma_m**2 * np.eye(2))
        count, most = len(self._axes), self._most
        self.common_m = mean_m[:, None] + _product(square_root(covariance_m2), rng.standard_normal((2, most)))
        self._own = np.zeros((count, 3, most))
        self._own_covariance = np.tile(model.own_covariance(), (count, 1, 1))
        self._lane_log = np.full((count, most), -np.log(count))
        self._log_weight = np.zeros(most)
        self._normalize()
        self._collapse()
        self._said, self._is_precise = self.belief, False

    @property
    def _wanted(self) -> int:
        """Number of particles to go on with: for the spread, unless that is near the present one."""
        if self._least == self._most:
            return self._most
        count = len(self.weight)
        wanted = sample_size(self.estimate_covariance_m2, self._least, self._most)
        return count if count / SIZE_STEP < wanted < count * SIZE_STEP else wanted

    # The belief.

    def _normalize(self) -> None:
        weight = np.exp(self._log_weight - self._log_weight.max())
        self.weight = weight / weight.sum()

    def _collapse(self) -> None:
        weight = np.exp(self._lane_log) * self.weight
        place = self._point_m[:, :, None] + _product(self._axes.transpose(0, 2, 1), self._own[:, :2])
        self.estimate_m = (self.common_m * self.weight).sum(axis=1)
        spread = self.common_m - self.estimate_m[:, None]
        self.estimate_covariance_m2 = _weighted(spread, spread, self.weight) + LEAST_VARIANCE_M2 * _IDENTITY
        place_m = (place * weight[:, None]).sum(axis=(0, 2))
        off = place - place_m[:, None]
        cross = _weighted(off, spread, weight).sum(axis=0)
        within = _product(_product(self._axes.transpose(0, 2, 1), self._own_covariance[:, :2, :2]), self._axes)
        total = _weighted(off, off, weight).sum(axis=0) + (weight.sum(axis=1)[:, None, None] * within).sum(axis=0)
        slope = _product(cross, inverse(self.estimate_covariance_m2))
        self._place = place_m, slope, total - _product(slope, cross.T)

    @property
    def lane_probability(self) -> Array:
        """Probabilities (H,) of the lanes that are left."""
        return np.asarray((np.exp(self._lane_log) * self.weight).sum(axis=1))

    @property
    def belief(self) -> Information:
        """The belief about c."""
        return Information.of(self.estimate_m, self.estimate_covariance_m2)

    @property
    def plain_moments(self) -> Five:
        """Mean (x, y) and covariance (xx, xy, yy) of c."""
        (x, y), ((p, q), (_, r)) = self.estimate_m.tolist(), self.estimate_covariance_m2.tolist()
        return x, y, p, q, r

    def position_m(self) -> tuple[Array, Array]:
        """Return the position (2,) of the vehicle and its covariance (2, 2)."""
        place_m, slope, given_m2 = self._place
        covariance_m2 = given_m2 + _product(_product(slope, self.estimate_covariance_m2), slope.T)
        if hidden := self._model.hidden:
            covariance_m2 = covariance_m2 + hidden[2] * _IDENTITY  # of the place that fixes show
        return place_m, covariance_m2

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Draw `count` equally likely hypotheses (count, 2) of c."""
        return np.asarray(self.common_m[:, systematic(self.weight, count, rng)].T)

    def decided(self) -> OwnKalman | None:
        """Return the filter to go on with if one lane is left: what is known is Gaussian from then on."""
        if len(self._axes) > 1:
            return None
        cloud = np.concatenate([self.common_m, self._own[0]])
        mean = (cloud * self.weight).sum(axis=1)
        spread = cloud - mean[:, None]
        covariance = _weighted(spread, spread, self.weight)
        covariance[2:, 2:] += self._own_covariance[0]
        return OwnKalman(self._point_m[0], float(self._heading_rad[0]), self._model, (mean, covariance))

    # A period.

    def suit(self, model: LaneModel) -> None:
        """Go on with another model: the offset may be further off by what is more there."""
        more_m2 = model.lateral_sigma_m**2 - self._model.lateral_sigma_m**2
        self._own_covariance[:, 0, 0] += max(more_m2, 0.0)
        self._model = model

    def predict(self, dt_s: float) -> None:
        """Advance by `dt_s`."""
        keep, variance_m2 = self._model.common_step(dt_s)
        moves, noise = self._model.transition(dt_s), self._model.process_noise(dt_s)
        noise_m = math.sqrt(variance_m2) * self._rng.standard_normal((2, len(self.weight)))
        self.common_m = keep * self.common_m + noise_m
        self._own = _product(moves, self._own)
        self._own_covariance = _product(_product(moves, self._own_covariance), moves.T) + noise
        self._collapse()
        self._said = self.belief

    def take(self, fix_m: Array, noise_m2: Array, gate: float = math.inf) -> Information | None:
        """Take the vehicle's own fix (2,) with noise covariance (2, 2); return what it says about c: the increment.

        A fix whose squared Mahalanobis distance from what is expected is above `gate` is not taken: None.
        """
        place_m, slope, given_m2 = self._place
        less_m2 = LEAST_NOISE_M2 - float(noise_m2.diagonal().min())
        self._is_precise = less_m2 > 0
        if self._is_precise:
            noise_m2 = noise_m2 + less_m2 * _IDENTITY
        off = fix_m - self.estimate_m - place_m
        belief = self.estimate_m, self.estimate_covariance_m2
        distance, increment = _innovation(off, slope + _IDENTITY, given_m2 + noise_m2, belief)
        if distance > gate:
            return None
        self._said = self._said.plus(increment)
        self._update(fix_m, noise_m2)
        return increment

    def _update(self, fix_m: Array, noise_m2: Array) -> None:
        axes, covariance = self._axes, self._own_covariance
        noise_m2 = _product(_product(axes, noise_m2), axes.transpose(0, 2, 1))
        total = covariance[:, :2, :2] + noise_m2
        determinant = total[:, 0, 0] * total[:, 1, 1] - total[:, 0, 1] ** 2
        adjugate = np.stack([total[:, 1, 1], -total[:, 0, 1], -total[:, 0, 1], total[:, 0, 0]], axis=1)
        innovation = adjugate.reshape(-1, 2, 2) / determinant[:, None, None]
        gain = _product(covariance[:, :, :2], innovation)
        seen_m = _product(axes, (fix_m - self._point_m)[:, :, None])
        off = seen_m - _product(axes, self.common_m) - self._own[:, :2]
        self._own = self._own + _product(gain, off)
        self._own_covariance = covariance - _product(gain, covariance[:, :2])
        squared = (_product(innovation, off) * off).sum(axis=1)
        self._lane_log = self._lane_log - 0.5 * np.log(determinant)[:, None] - 0.5 * squared
        self._sum_lanes()
        self._settle()

    def absorb(self, pooled: Information, is_of_lanes: bool = False) -> None:
        """Weigh the cloud by `pooled`, which is to replace the belief about c.

        A cloud of several humps, one a lane, would be squeezed together if it were moved. With a precise receiver
        humps are narrow, and the moments say much more after a fix than its increment does: then what is new is
        what `pooled` says beyond the belief before the fix and the increment. So it is where increments of others
        are those of lanes (`is_of_lanes`). Less than nothing is never new: it would drive the cloud outward. Beside
        what is new, which is at the mean of `pooled`, the cloud moves as the mean of what is replaced does.
        """
        before = self._said if self._is_precise or is_of_lanes else self.belief
        a, b, d, x, y = new_at_mean(before, pooled).numbers
        c_x, c_y = self.common_m
        new = c_x * (x - 0.5 * (a * c_x) - b * c_y) + c_y * (y - 0.5 * (d * c_y))
        self._log_weight = self._log_weight + new + self._pull(before, pooled)
        self._settle()

    def _pull(self, before: Information, pooled: Information) -> Array:
        """Return log weights (K,) that move the mean of `before` to that of `pooled`, by `LARGEST_PULL` at most."""
        to_x, to_y, *_ = plain_moments(*pooled.numbers)
        from_x, from_y, *_ = plain_moments(*before.numbers)
        a, b, d, _, _ = before.numbers
        off_x, off_y = to_x - from_x, to_y - from_y
        x, y = a * off_x + b * off_y, b * off_x + d * off_y
        distance = math.sqrt(max(off_x * x + off_y * y, 1e-300))
        (m_x, m_y), (c_x, c_y) = self.estimate_m.tolist(), self.common_m
        along = (x * (c_x - m_x) + y * (c_y - m_y)) / distance
        return np.asarray(min(distance, LARGEST_PULL) * np.clip(along, -PULL_REACH, PULL_REACH))

    def _settle(self) -> None:
        """After the weights have changed: drop lanes, and resample if it is due."""
        self._normalize()
        self._drop_lanes()
        self._collapse()
        count = self._wanted
        if count != len(self.weight) or 1 / (self.weight * self.weight).sum() < count / 2:
            self._take(systematic(self.weight, count, self._rng))
            self._collapse()

    def _sum_lanes(self) -> None:
        """Normalize the probabilities of the lanes given c; their sum goes into the weights."""
        total = np.logaddexp.reduce(self._lane_log, axis=0)
        self._lane_log = self._lane_log - total
        self._log_weight = self._log_weight + total

    def _drop_lanes(self) -> None:
        kept = self.lane_probability > DECIDED
        if kept.all():
            return
        self._point_m, self._heading_rad, self._axes = (
            self._point_m[kept],
            self._heading_rad[kept],
            self._axes[kept],
        )
        self._own, self._own_covariance = self._own[kept], self._own_covariance[kept]
        self._lane_log = self._lane_log[kept]
        self._sum_lanes()
        self._normalize()

    def _take(self, index: NDArray[np.intp]) -> None:
        """Go on with the particles `index` (n,), equally likely."""
        self.common_m = self.common_m.take(index, axis=-1)
        self._own = self._own.take(index, axis=-1)
        self._lane_log = self._lane_log.take(index, axis=-1)
        self._log_weight = np.zeros(len(index))
        self.weight = np.full(len(index), 1 / len(index))


def _product(left: Array, right: Array) -> Array:
    """Return the products (…, n, k) of matrices (…, n, m) and (…, m, k), without BLAS."""
    return np.asarray((left[..., :, :, None] * right[..., None, :, :]).sum(axis=-2))


def _weighted(left: Array, right: Array, weight: Array) -> Array:
    """Return the sums (…, n, m) over points (…, n, K) and (…, m, K) with weights (…, K)."""
    return np.asarray(((left * weight[..., None, :])[..., :, None, :] * right[..., None, :, :]).sum(axis=-1))


def _innovation(
    off: Array, slope: Array, given_m2: Array, belief: tuple[Array, Array]
) -> tuple[float, Information]:
    """Return the squared Mahalanobis distance of a fix, and what it says about c ~ `belief`.

    The fix is `off` (2,) from what is expected; given c, which moves it by `slope` (2, 2), its covariance is
    `given_m2` (2, 2).
    """
    mean_m, covariance_m2 = belief
    total = inverse(given_m2 + _product(_product(slope, covariance_m2), slope.T))
    distance = float((total * np.outer(off, off)).sum())
    whitened = _product(slope.T, inverse(given_m2))
    matrix = _product(whitened, slope)
    vector = (whitened * off).sum(axis=1) + (matrix * mean_m).sum(axis=1)
    return distance, Information.from_arrays(matrix, vector)


CELL_M = 0.1
"""Side (m) of a cell: a fraction of what one fix tells."""
DISTANCE = 0.1
"""Kullback-Leibler distance ε."""
QUANTILE = 2.326
"""z of 99 %."""
ELLIPSE_SIGMAS = 3.0
"""Deviations within which cells count."""


def sample_size(covariance_m2: Array, least: int, most: int) -> int:
    """Return the number of particles, between `least` and `most`, for a covariance (2, 2)."""
    (a, b), (_, d) = covariance_m2.tolist()
    area_m2 = math.pi * ELLIPSE_SIGMAS**2 * math.sqrt(max(a * d - b * b, 0.0))
    more = area_m2 / CELL_M**2 - 1
    if more <= 1:
        return least
    term = 2 / (9 * more)
    wanted = more / (2 * DISTANCE) * (1 - term + math.sqrt(term) * QUANTILE) ** 3
    return round(min(max(wanted, least), most))
