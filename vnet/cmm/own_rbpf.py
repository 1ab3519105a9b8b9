"""The Rao-Blackwellized particle filter of one vehicle that tracks itself alone (MODEL 10).

Particle k is a hypothesis c^k of the common error. Given it, all else is analytic: which of the candidate lanes the
vehicle is on, and on lane h its own state (l, s, v), the offset to the right of the centre line, position and speed
along it, with a Kalman filter whose covariance V_h does not depend on k. The offset is a state, so that a lane is
evidence once and not ten times a second. To others the filter says what it knew before its fix (`prior`), and what
the fix says about c alone (`increment`); from them it takes the same (`absorb`).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vnet.cmm.common_error import systematic
from vnet.cmm.information import Information, inverse, square_root, transport
from vnet.cmm.kalman_bound import LaneModel, lane_axes
from vnet.types import Array

DECIDED = 1e-4
"""Probability below which a lane is out of question."""
COMPETING_FACTOR = 4
"""So many times the particles as long as lanes compete."""
_IDENTITY = np.eye(2)


class OwnRbpf:
    """The filter of a vehicle on one of the lanes through `point_m` (H, 2) with directions `heading_rad` (H,).

    common_m: (2, K), the hypotheses of the common error, and weight: (K,), their normalized weights.
    """

    def __init__(
        self,
        lanes: tuple[Array, Array],
        model: LaneModel,
        particles: int,
        rng: np.random.Generator,
        belief: tuple[Array, Array] | None = None,
    ) -> None:
        """Draw the first particles from `belief`, mean (2,) and covariance (2, 2), by default the model's of c."""
        point_m, heading_rad = lanes
        self._particles = particles
        self._rng = rng
        self._model = model
        self._point_m = np.array(point_m, dtype=float)
        self._axes = lane_axes(np.asarray(heading_rad))
        self._dt_s = np.nan
        mean_m, covariance_m2 = belief or (np.zeros(2), model.common_sigma_m**2 * np.eye(2))
        lanes_count, count = len(self._axes), self._wanted
        # Row 0 and 1 are c, then three rows a lane: what is affine is one product.
        self._cloud = np.zeros((2 + 3 * lanes_count, count))
        self._cloud[:2] = mean_m[:, None] + square_root(covariance_m2) @ rng.standard_normal((2, count))
        self._own_covariance = np.tile(model.own_covariance(), (lanes_count, 1, 1))
        self._lane_log = np.full((lanes_count, count), -np.log(lanes_count))
        self._log_weight = np.zeros(count)
        self._reserve()
        self._normalize()
        self._take_moments()

    def _reserve(self) -> None:
        """Reserve arrays for a period: for each new one of this size the system would map and clear pages."""
        shape = self._cloud.shape
        self._spread, self._spare, self._noise_m = np.empty(shape), np.empty(shape), np.empty((2, shape[1]))

    @property
    def common_m(self) -> Array:
        """The hypotheses (2, K) of the common error."""
        return self._cloud[:2]

    @property
    def _own(self) -> Array:
        """The vehicle's own state (H, 3, K) on each lane, a view."""
        return self._cloud[2:].reshape(len(self._axes), 3, -1)

    @property
    def _wanted(self) -> int:
        """Number of particles: more as long as lanes compete, because then they are weighed and not moved."""
        return self._particles if len(self._axes) == 1 else COMPETING_FACTOR * self._particles

    # The belief.

    def _normalize(self) -> None:
        weight = np.exp(self._log_weight - self._log_weight.max())
        self.weight = weight / weight.sum()

    def _take_moments(self) -> None:
        """Compute the moments of the cloud over c and the vehicle's own state, all lanes taken together."""
        if len(self._axes) > 1:
            self._collapse()
            return
        mean = self._cloud @ self.weight
        np.subtract(self._cloud, mean[:, None], out=self._spread)
        np.multiply(self._spread, self.weight, out=self._spare)
        self._set_moments(mean, self._spare @ self._spread.T)

    def _set_moments(self, mean: Array, covariance: Array) -> None:
        """Take mean (5,) and covariance (5, 5) of the cloud, where one lane is left."""
        self._mean, self._covariance = mean, covariance
        self.estimate_m, self.estimate_covariance_m2 = mean[:2], covariance[:2, :2]
        self._slope = covariance[2:, :2] @ inverse(self.estimate_covariance_m2)
        self._place: tuple[Array, Array, Array] | None = None

    def _placed(self) -> tuple[Array, Array, Array]:
        """Return position (2,), its slope (2, 2) on c and its covariance (2, 2) given c."""
        if self._place is None:
            axes, rows = self._axes[0], self._covariance[2:4]
            slope = self._slope[:2]
            given = self._own_covariance[0, :2, :2] + rows[:, 2:4] - slope @ rows[:, :2].T
            place_m = self._point_m[0] + self._mean[2:4] @ axes
            self._place = place_m, axes.T @ slope, axes.T @ given @ axes
        return self._place

    def _collapse(self) -> None:
        weight = np.exp(self._lane_log) * self.weight
        place = self._point_m[:, :, None] + self._axes.transpose(0, 2, 1) @ self._own[:, :2]
        self.estimate_m = self.common_m @ self.weight
        spread = self.common_m - self.estimate_m[:, None]
        self.estimate_covariance_m2 = (spread * self.weight) @ spread.T
        place_m = np.einsum("hik,hk->i", place, weight)
        off = place - place_m[:, None]
        # Weighted sums over lanes and particles as products: an einsum of three factors takes ten times as long.
        flat, weighted = off.transpose(1, 0, 2).reshape(2, -1), (off * weight[:, None]).transpose(1, 0, 2)
        cross = weighted.sum(axis=1) @ spread.T
        within = self._axes.transpose(0, 2, 1) @ self._own_covariance[:, :2, :2] @ self._axes
        total = weighted.reshape(2, -1) @ flat.T + np.einsum("h,hij->ij", weight.sum(axis=1), within)
        slope = cross @ inverse(self.estimate_covariance_m2)
        self._place = place_m, slope, total - slope @ cross.T

    @property
    def lane_probability(self) -> Array:
        """Probabilities (H,) of the lanes that are left."""
        return np.asarray(np.exp(self._lane_log) @ self.weight)

    @property
    def belief(self) -> Information:
        """The belief about c."""
        return Information.of(self.estimate_m, self.estimate_covariance_m2)

    def position_m(self) -> tuple[Array, Array]:
        """Return the position (2,) of the vehicle and its covariance (2, 2)."""
        place_m, slope, given_m2 = self._placed()
        return place_m, given_m2 + slope @ self.estimate_covariance_m2 @ slope.T

    def sample(self, count: int) -> Array:
        """Draw `count` equally likely hypotheses (count, 2) of c."""
        return np.asarray(self.common_m[:, systematic(self.weight, count, self._rng)].T)

    # A period.

    def predict(self, dt_s: float) -> None:
        """Advance by `dt_s`."""
        if dt_s != self._dt_s:
            self._dt_s, self._moves, self._noise = (
                dt_s,
                self._model.transition(dt_s),
                self._model.process_noise(dt_s),
            )
        keep, variance_m2 = self._model.common_step(dt_s)
        cloud, lanes = self._spare, len(self._axes)
        np.matmul(self._moves, self._own, out=cloud[2:].reshape(lanes, 3, -1))
        np.multiply(self._cloud[:2], keep, out=cloud[:2])
        self._rng.standard_normal(out=self._noise_m)
        self._noise_m *= math.sqrt(variance_m2)
        cloud[:2] += self._noise_m
        self._cloud, self._spare = cloud, self._cloud
        self._own_covariance = self._moves @ self._own_covariance @ self._moves.T + self._noise
        self._take_moments()

    def expects(self, fix_m: Array, noise_m2: Array) -> tuple[float, Information]:
        """Return the squared Mahalanobis distance of a fix (2,) with noise covariance (2, 2) from what is expected.

        The second is what the fix says about c beyond the prior: the increment.
        """
        place_m, slope, given_m2 = self._placed()
        direction = slope + _IDENTITY
        given_c = given_m2 + noise_m2
        off = fix_m - self.estimate_m - place_m
        distance = off @ inverse(given_c + direction @ self.estimate_covariance_m2 @ direction.T) @ off
        whitened = direction.T @ inverse(given_c)
        matrix = whitened @ direction
        return float(distance), Information(matrix, whitened @ off + matrix @ self.estimate_m)

    def absorb(self, pooled: Information) -> None:
        """Replace the belief about c by `pooled`: move the cloud where one lane is left, else weigh it.

        A cloud of several humps, one a lane, would be squeezed together if it were moved.
        """
        if len(self._axes) > 1:
            belief, c = self.belief, self.common_m
            matrix, vector = pooled.matrix - belief.matrix, pooled.vector - belief.vector
            self._log_weight = self._log_weight + vector @ c - 0.5 * ((matrix @ c) * c).sum(axis=0)
            self._settle()
            return
        mean_m, covariance_m2 = pooled.moments()
        # What is known of c moves, and the own state along its regression on c: an affine map of the whole cloud.
        affine = np.eye(5)
        affine[:2, :2] = transport(self.estimate_covariance_m2, covariance_m2)
        affine[2:, :2] = self._slope @ (affine[:2, :2] - _IDENTITY)
        mean = self._mean.copy()
        mean[2:] += self._slope @ (mean_m - self.estimate_m)
        mean[:2] = mean_m
        np.matmul(affine, self._spread, out=self._spare)
        self._spread, self._spare = self._spare, self._spread
        np.add(mean[:, None], self._spread, out=self._cloud)
        self._set_moments(mean, affine @ self._covariance @ affine.T)

    def update(self, fix_m: Array, noise_m2: Array) -> None:
        """Take the vehicle's own fix (2,) with noise covariance (2, 2)."""
        if len(self._axes) == 1:
            self._update_one(fix_m, noise_m2)
            return
        axes, own = self._axes, self._own
        covariance = self._own_covariance
        innovation = np.linalg.inv(covariance[:, :2, :2] + axes @ noise_m2 @ axes.transpose(0, 2, 1))
        gain = covariance[:, :, :2] @ innovation
        off = (axes @ (fix_m - self._point_m)[:, :, None]) - axes @ self.common_m - own[:, :2]
        own += gain @ off
        self._own_covariance = covariance - gain @ covariance[:, :2]
        squared = ((innovation @ off) * off).sum(axis=1)
        scale = 0.5 * np.log(np.linalg.det(innovation))
        self._lane_log = self._lane_log + scale[:, None] - 0.5 * squared
        self._sum_lanes()
        self._settle()

    def _update_one(self, fix_m: Array, noise_m2: Array) -> None:
        """Take a fix where one lane is left."""
        axes, covariance = self._axes[0], self._own_covariance[0]
        innovation = inverse(covariance[:2, :2] + axes @ noise_m2 @ axes.T)
        gain = covariance[:, :2] @ innovation
        off, spare = self._noise_m, self._spare
        np.matmul(axes, self._cloud[:2], out=off)
        off += self._cloud[2:4]
        np.subtract((axes @ (fix_m - self._point_m[0]))[:, None], off, out=off)
        np.matmul(gain, off, out=spare[2:])
        self._cloud[2:] += spare[2:]
        self._own_covariance = (covariance - gain @ covariance[:2])[None]
        np.matmul(innovation, off, out=spare[:2])
        off *= spare[:2]
        off *= 0.5
        self._log_weight -= off[0]
        self._log_weight -= off[1]
        self._settle()

    def _settle(self) -> None:
        """After the weights have changed: drop lanes that are out of question, and resample if it is due."""
        self._normalize()
        self._drop_lanes()
        count = self._wanted
        if count != len(self.weight) or 1 / (self.weight @ self.weight) < count / 2:
            self._take(systematic(self.weight, count, self._rng))
        self._take_moments()

    def _sum_lanes(self) -> None:
        """Normalize the probabilities of the lanes given c; their sum goes into the weights."""
        total = np.logaddexp.reduce(self._lane_log, axis=0)
        self._lane_log -= total
        self._log_weight = self._log_weight + total

    def _drop_lanes(self) -> None:
        if len(self._axes) == 1:
            return
        kept = self.lane_probability > DECIDED
        if kept.all():
            return
        self._point_m, self._axes = self._point_m[kept], self._axes[kept]
        self._cloud = self._cloud[np.append([True, True], np.repeat(kept, 3))]
        self._own_covariance = self._own_covariance[kept]
        self._lane_log = self._lane_log[kept]
        self._reserve()
        self._sum_lanes()
        self._normalize()

    def _take(self, index: NDArray[np.intp]) -> None:
        """Go on with the particles `index` (n,), equally likely."""
        self._cloud = self._cloud.take(index, axis=1)
        self._lane_log = self._lane_log.take(index, axis=1)
        self._reserve()
        self._log_weight = np.zeros(len(index))
        self.weight = np.full(len(index), 1 / len(index))
