"""The Rao-Blackwellized particle filter of one vehicle that tracks itself alone (MODEL 10).

Particle k is a hypothesis c^k of the common error. Given it, all else is analytic: which of the candidate lanes the
vehicle is on, and on lane h its own state (l, s, v), the offset to the right of the centre line, position and speed
along it, with a Kalman filter whose covariance V_h does not depend on k. The offset is a state, so that a lane is
evidence once and not ten times a second. To others the filter says what it knew before its fix (`prior`), and what
the fix says about c alone (`increment`); from them it takes the same (`absorb`).
"""

from __future__ import annotations

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
        count = self._wanted
        self.common_m = mean_m[:, None] + square_root(covariance_m2) @ rng.standard_normal((2, count))
        lanes_count = len(self._axes)
        self._own = np.zeros((lanes_count, 3, count))
        self._own_covariance = np.tile(model.own_covariance(), (lanes_count, 1, 1))
        self._lane_log = np.full((lanes_count, count), -np.log(lanes_count))
        self._log_weight = np.zeros(count)
        self._take_moments()

    @property
    def _wanted(self) -> int:
        """Number of particles: more as long as lanes compete, because then they are weighed and not moved."""
        return self._particles if len(self._axes) == 1 else COMPETING_FACTOR * self._particles

    # The belief.

    def _take_moments(self) -> None:
        """Compute the moments of the cloud over c and the vehicle's own state, all lanes taken together."""
        weight = np.exp(self._log_weight - self._log_weight.max())
        weight /= weight.sum()
        self.weight = weight
        if len(self._axes) > 1:
            self._collapse()
            return
        joint = np.concatenate([self.common_m, self._own[0]])
        mean = joint @ weight
        spread = joint - mean[:, None]
        covariance = (spread * weight) @ spread.T
        self.estimate_m, self.estimate_covariance_m2 = mean[:2], covariance[:2, :2]
        axes = self._axes[0]
        self._own_mean = mean[2:]
        self._slope = covariance[2:, :2] @ inverse(self.estimate_covariance_m2)
        given = self._own_covariance[0] + covariance[2:, 2:] - self._slope @ covariance[:2, 2:]
        self._given_m2 = axes.T @ given[:2, :2] @ axes
        self._place_m = self._point_m[0] + axes.T @ mean[2:4]
        self._place_slope = axes.T @ self._slope[:2]

    def _collapse(self) -> None:
        weight = np.exp(self._lane_log) * self.weight
        place = self._point_m[:, :, None] + self._axes.transpose(0, 2, 1) @ self._own[:, :2]
        self.estimate_m = self.common_m @ self.weight
        spread = self.common_m - self.estimate_m[:, None]
        self.estimate_covariance_m2 = (spread * self.weight) @ spread.T
        self._place_m = np.einsum("hik,hk->i", place, weight)
        off = place - self._place_m[:, None]
        cross = np.einsum("hik,hk,jk->ij", off, weight, spread)
        within = self._axes.transpose(0, 2, 1) @ self._own_covariance[:, :2, :2] @ self._axes
        total = np.einsum("hik,hk,hjk->ij", off, weight, off) + np.einsum("h,hij->ij", weight.sum(axis=1), within)
        self._place_slope = cross @ inverse(self.estimate_covariance_m2)
        self._given_m2 = total - self._place_slope @ cross.T

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
        slope = self._place_slope
        return self._place_m, self._given_m2 + slope @ self.estimate_covariance_m2 @ slope.T

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
        self.common_m = keep * self.common_m
        self.common_m += np.sqrt(variance_m2) * self._rng.standard_normal(self.common_m.shape)
        self._own = self._moves @ self._own
        self._own_covariance = self._moves @ self._own_covariance @ self._moves.T + self._noise
        self._take_moments()

    def distance(self, fix_m: Array, noise_m2: Array) -> float:
        """Return the squared Mahalanobis distance of a fix (2,) from what is expected."""
        direction = np.eye(2) + self._place_slope
        total = self._given_m2 + noise_m2 + direction @ self.estimate_covariance_m2 @ direction.T
        off = fix_m - self.estimate_m - self._place_m
        return float(off @ inverse(total) @ off)

    def increment(self, fix_m: Array, noise_m2: Array) -> Information:
        """Return what a fix (2,) with noise covariance (2, 2) says about c beyond the prior."""
        direction = np.eye(2) + self._place_slope
        measured = fix_m - self._place_m + self._place_slope @ self.estimate_m
        whitened = direction.T @ inverse(self._given_m2 + noise_m2)
        return Information(whitened @ direction, whitened @ measured)

    def absorb(self, pooled: Information) -> None:
        """Replace the belief about c by `pooled`: move the cloud where one lane is left, else weigh it.

        A cloud of several humps, one a lane, would be squeezed together if it were moved.
        """
        if len(self._axes) > 1:
            belief, c = self.belief, self.common_m
            matrix, vector = pooled.matrix - belief.matrix, pooled.vector - belief.vector
            self._log_weight = self._log_weight + vector @ c - 0.5 * np.einsum("ik,ik->k", c, matrix @ c)
            self._settle()
            return
        mean_m, covariance_m2 = pooled.moments()
        spread = self.common_m - self.estimate_m[:, None]
        moved = mean_m[:, None] + transport(self.estimate_covariance_m2, covariance_m2) @ spread
        self._own[0] += self._slope @ (moved - self.common_m)
        self.common_m = moved
        self._take_moments()

    def update(self, fix_m: Array, noise_m2: Array) -> None:
        """Take the vehicle's own fix (2,) with noise covariance (2, 2)."""
        axes = self._axes
        covariance = self._own_covariance
        innovation = np.linalg.inv(covariance[:, :2, :2] + axes @ noise_m2 @ axes.transpose(0, 2, 1))
        gain = covariance[:, :, :2] @ innovation
        off = (axes @ (fix_m - self._point_m)[:, :, None]) - axes @ self.common_m - self._own[:, :2]
        self._own = self._own + gain @ off
        self._own_covariance = covariance - gain @ covariance[:, :2]
        if len(axes) == 1:
            self._log_weight = self._log_weight - 0.5 * np.einsum("ik,ik->k", off[0], innovation[0] @ off[0])
        else:
            scale = 0.5 * np.log(np.linalg.det(innovation))
            self._lane_log = self._lane_log + scale[:, None] - 0.5 * np.einsum("hik,hik->hk", off, innovation @ off)
            total = np.logaddexp.reduce(self._lane_log, axis=0)
            self._lane_log -= total
            self._log_weight = self._log_weight + total
        self._settle()

    def _settle(self) -> None:
        """After the weights have changed: drop lanes that are out of question, and resample if it is due."""
        self._take_moments()
        self._drop_lanes()
        self._resample_if_due()

    def _drop_lanes(self) -> None:
        if len(self._axes) == 1:
            return
        kept = self.lane_probability > DECIDED
        if kept.all():
            return
        self._point_m, self._axes = self._point_m[kept], self._axes[kept]
        self._own, self._own_covariance = self._own[kept], self._own_covariance[kept]
        self._lane_log = self._lane_log[kept]
        total = np.logaddexp.reduce(self._lane_log, axis=0)
        self._lane_log -= total
        self._log_weight = self._log_weight + total
        self._take_moments()

    def _resample_if_due(self) -> None:
        count = self._wanted
        if count == len(self.weight) and 1 / (self.weight @ self.weight) >= count / 2:
            return
        self._take(systematic(self.weight, count, self._rng))

    def _take(self, index: NDArray[np.intp]) -> None:
        """Go on with the particles `index` (n,), equally likely."""
        self.common_m = self.common_m.take(index, axis=1)
        self._own = self._own.take(index, axis=2)
        self._lane_log = self._lane_log.take(index, axis=1)
        self._log_weight = np.zeros(len(index))
        self._take_moments()
