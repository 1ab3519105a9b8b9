"""The Rao-Blackwellized particle filter of one vehicle that tracks itself alone (MODEL 10).

Particle k is a hypothesis c^k of the common error. Given it, all else is analytic: which of the candidate lanes the
vehicle is on, and on lane h its own state (l, s, v), the offset to the right of the centre line, position and speed
along it, with a Kalman filter whose covariance V_h does not depend on k. The offset is a state, so that a lane is
evidence once and not ten times a second. To others the filter says what it knew before its fix (`prior`), and what
the fix says about c alone (`increment`); from them it takes the same (`absorb`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vnet.cmm.affine_cloud import LEAST_VARIANCE_M2, AffineCloud
from vnet.cmm.common_error import systematic
from vnet.cmm.information import (
    Information,
    Three,
    inverse,
    inverted,
    plain_moments,
    rooted,
    square_root,
    transported,
)
from vnet.cmm.kalman_bound import LaneModel, lane_axes
from vnet.cmm.sample_size import sample_size
from vnet.types import Array

DECIDED = 1e-4
"""Probability below which a lane is out of question."""
COMPETING_FACTOR = 4
"""So many times the particles as long as lanes compete."""
SIZE_STEP = 1.5
"""Ratio by which the number of particles that is wanted must differ before it changes: each change resamples."""
_IDENTITY = np.eye(2)


class OwnRbpf:
    """The filter of a vehicle on one of the lanes through `point_m` (H, 2) with directions `heading_rad` (H,).

    common_m: (2, K), the hypotheses of the common error, and weight: (K,), their normalized weights. As long as
    lanes compete the cloud is an array with rows for each lane, later an `AffineCloud`.
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
        self._particles, self._least = particles, least_particles or particles
        self._rng = rng
        self._model = model
        self._point_m = np.array(point_m, dtype=float)
        self._axes = lane_axes(np.asarray(heading_rad))
        self._dt_s = np.nan
        mean_m, covariance_m2 = belief or (np.zeros(2), model.common_sigma_m**2 * np.eye(2))
        lanes_count = len(self._axes)
        count = self._most
        # Row 0 and 1 are c, then three rows a lane.
        cloud = np.zeros((2 + 3 * lanes_count, count))
        cloud[:2] = mean_m[:, None] + square_root(covariance_m2) @ rng.standard_normal((2, count))
        self._own_covariance = np.tile(model.own_covariance(), (lanes_count, 1, 1))
        self._one: AffineCloud | None = None
        if lanes_count == 1:
            self._decide(cloud, np.zeros(count))
            return
        self._cloud = cloud
        self._lane_log = np.full((lanes_count, count), -np.log(lanes_count))
        self._log_weight = np.zeros(count)
        self._normalize()
        self._collapse()

    def _decide(self, cloud: Array, log_weight: Array) -> None:
        """Go on with one lane; `cloud` (5, K) are its rows."""
        self._one = AffineCloud(cloud, log_weight)
        self._measure = np.hstack([self._axes[0], np.eye(2, 3)])
        self._measure_t = self._measure.T.copy()
        self._take_moments(self._one)

    @property
    def common_m(self) -> Array:
        """The hypotheses (2, K) of the common error."""
        return self._cloud[:2] if self._one is None else self._one.points[:2]

    @property
    def _own(self) -> Array:
        """The vehicle's own state (H, 3, K) on each lane, a view."""
        return self._cloud[2:].reshape(len(self._axes), 3, -1)

    @property
    def _most(self) -> int:
        """Number of particles: more as long as lanes compete, because then they are weighed and not moved."""
        return self._particles if len(self._axes) == 1 else COMPETING_FACTOR * self._particles

    @property
    def _wanted(self) -> int:
        """Number of particles to go on with: for the spread, unless that is near the present one."""
        most = self._most
        if self._least >= self._particles:
            return most
        count = len(self.weight)
        wanted = sample_size(self.estimate_covariance_m2, self._least, most)
        is_near = count / SIZE_STEP < wanted < count * SIZE_STEP
        return count if is_near and count <= most else wanted

    # The belief.

    def _normalize(self) -> None:
        weight = np.exp(self._log_weight - self._log_weight.max())
        self.weight = weight / weight.sum()

    def _take_moments(self, cloud: AffineCloud) -> None:
        """Take the moments of the cloud, where one lane is left."""
        self._mean, self._covariance, self.weight = cloud.mean, cloud.covariance, cloud.weight
        self.estimate_m, self.estimate_covariance_m2 = self._mean[:2], self._covariance[:2, :2]

    def _collapse(self) -> None:
        weight = np.exp(self._lane_log) * self.weight
        place = self._point_m[:, :, None] + self._axes.transpose(0, 2, 1) @ self._own[:, :2]
        self.estimate_m = self.common_m @ self.weight
        spread = self.common_m - self.estimate_m[:, None]
        self.estimate_covariance_m2 = (spread * self.weight) @ spread.T + LEAST_VARIANCE_M2 * _IDENTITY
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
        if self._one is not None:
            return np.ones(1)
        return np.asarray(np.exp(self._lane_log) @ self.weight)

    @property
    def belief(self) -> Information:
        """The belief about c."""
        return Information.of(self.estimate_m, self.estimate_covariance_m2)

    def position_m(self) -> tuple[Array, Array]:
        """Return the position (2,) of the vehicle and its covariance (2, 2)."""
        if self._one is not None:
            axes, axes_t = self._axes[0], self._measure_t[:2]
            covariance_m2 = self._own_covariance[0, :2, :2] + self._covariance[2:4, 2:4]
            return self._point_m[0] + axes_t.dot(self._mean[2:4]), axes_t.dot(covariance_m2).dot(axes)
        place_m, slope, given_m2 = self._place
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
            self._all_moves = np.eye(5)
            self._all_moves[:2, :2] *= keep
            self._all_moves[2:, 2:] = self._moves
            self._common_sigma_m = math.sqrt(variance_m2)
        if self._one is not None:
            own_covariance = self._moves.dot(self._own_covariance[0]).dot(self._moves.T)
            own_covariance += self._noise
            self._own_covariance = own_covariance[None]
            self._one.move(self._all_moves)
            self._one.diffuse(self._common_sigma_m, self._rng)
            self._take_moments(self._one)
            return
        self._own_covariance = self._moves @ self._own_covariance @ self._moves.T + self._noise
        noise_m = self._common_sigma_m * self._rng.standard_normal((2, len(self.weight)))
        own = (self._moves @ self._own).reshape(-1, len(self.weight))
        self._cloud = np.concatenate([self._all_moves[0, 0] * self._cloud[:2] + noise_m, own])
        self._collapse()

    def expects(self, fix_m: Array, noise_m2: Array) -> tuple[float, Information]:
        """Return the squared Mahalanobis distance of a fix (2,) with noise covariance (2, 2) from what is expected.

        The second is what the fix says about c beyond the prior: the increment.
        """
        if self._one is None:
            place_m, slope, given_m2 = self._place
            off = fix_m - self.estimate_m - place_m
            return _innovation(off, slope + _IDENTITY, given_m2 + noise_m2, self._moments)
        # The fix is z = H x + n, with x ~ N(mean, P) all that is known and n given the particle.
        seen = self._measure.dot(self._covariance)
        value, fix_noise_m2 = self._measured(fix_m, noise_m2)
        off = (value - self._measure.dot(self._mean)).tolist()
        total = (seen.dot(self._measure_t) + fix_noise_m2).tolist()
        return _expected(off, seen[:, :2].tolist(), total, *self._common)

    @property
    def _moments(self) -> tuple[Array, Array]:
        """Mean (2,) and covariance (2, 2) of c."""
        return self.estimate_m, self.estimate_covariance_m2

    @property
    def _common(self) -> tuple[list[float], Three]:
        """Mean and covariance (xx, xy, yy) of c."""
        (p, q), (_, r) = self.estimate_covariance_m2.tolist()
        return self.estimate_m.tolist(), (p, q, r)

    def _measured(self, fix_m: Array, noise_m2: Array) -> tuple[Array, Array]:
        """Return a fix (2,) along the axes of the only lane, and its covariance (2, 2) given a particle."""
        axes = self._axes[0]
        noise_m2 = axes.dot(noise_m2).dot(axes.T)
        return axes.dot(fix_m - self._point_m[0]), self._own_covariance[0, :2, :2] + noise_m2

    def absorb(self, pooled: Information) -> None:
        """Replace the belief about c by `pooled`: move the cloud where one lane is left, else weigh it.

        A cloud of several humps, one a lane, would be squeezed together if it were moved.
        """
        if self._one is None:
            belief, c = self.belief, self.common_m
            matrix, vector = pooled.matrix - belief.matrix, pooled.vector - belief.vector
            self._log_weight = self._log_weight + vector @ c - 0.5 * ((matrix @ c) * c).sum(axis=0)
            self._settle()
            return
        # What is known of c moves to the new mean by T, and the own state along its regression K on c: an affine
        # map of the whole cloud, [T 0; K (T − I) I], and by the rest of the way.
        new_x, new_y, *new_covariance_m2 = plain_moments(*pooled.numbers)
        (x, y), covariance_m2 = self._common
        a, b, d = transported(*covariance_m2, *new_covariance_m2)
        slope = self._covariance[2:, :2].dot(inverse(self.estimate_covariance_m2))
        affine, by = np.eye(5), np.empty(5)
        affine[:2, :2] = (a, b), (b, d)
        affine[2:, :2] = slope.dot(((a - 1, b), (b, d - 1)))
        by[:2] = new_x - (a * x + b * y), new_y - (b * x + d * y)
        by[2:] = slope.dot(by[:2])
        self._one.move(affine, by)
        self._take_moments(self._one)

    def update(self, fix_m: Array, noise_m2: Array) -> None:
        """Take the vehicle's own fix (2,) with noise covariance (2, 2)."""
        if self._one is not None:
            self._update_one(self._one, fix_m, noise_m2)
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

    def _update_one(self, cloud: AffineCloud, fix_m: Array, noise_m2: Array) -> None:
        """Take a fix where one lane is left."""
        value, noise_m2 = self._measured(fix_m, noise_m2)
        covariance, ((p, q), (_, r)) = self._own_covariance[0], noise_m2.tolist()
        a, b, d = inverted(p, q, r)
        root_a, root_b, root_d = rooted(a, b, d)
        gain = np.zeros((5, 2))
        gain[2:] = covariance[:, :2].dot(np.array([[a, b], [b, d]]))
        self._own_covariance = (covariance - gain[2:].dot(covariance[:2]))[None]
        cloud.weigh(self._measure, value, np.array([[root_a, root_b], [root_b, root_d]]), gain)
        cloud.settle(self._wanted, self._rng)
        self._take_moments(cloud)

    def _settle(self) -> None:
        """After the weights of competing lanes have changed: drop lanes, and resample if it is due."""
        self._normalize()
        self._drop_lanes()
        if len(self._axes) == 1:
            self._decide(self._cloud, self._log_weight)
            assert self._one is not None
            self._one.settle(self._wanted, self._rng)
            self._take_moments(self._one)
            return
        count = self._wanted
        if 1 / (self.weight @ self.weight) < count / 2:
            self._take(systematic(self.weight, count, self._rng))
        self._collapse()

    def _sum_lanes(self) -> None:
        """Normalize the probabilities of the lanes given c; their sum goes into the weights."""
        total = np.logaddexp.reduce(self._lane_log, axis=0)
        self._lane_log -= total
        self._log_weight = self._log_weight + total

    def _drop_lanes(self) -> None:
        kept = self.lane_probability > DECIDED
        if kept.all():
            return
        self._point_m, self._axes = self._point_m[kept], self._axes[kept]
        self._cloud = self._cloud[np.append([True, True], np.repeat(kept, 3))]
        self._own_covariance = self._own_covariance[kept]
        self._lane_log = self._lane_log[kept]
        self._sum_lanes()
        self._normalize()

    def _take(self, index: NDArray[np.intp]) -> None:
        """Go on with the particles `index` (n,), equally likely."""
        self._cloud = self._cloud.take(index, axis=1)
        self._lane_log = self._lane_log.take(index, axis=1)
        self._log_weight = np.zeros(len(index))
        self.weight = np.full(len(index), 1 / len(index))


def _expected(
    off: Sequence[float],
    seen: Sequence[Sequence[float]],
    total: Sequence[Sequence[float]],
    mean_m: Sequence[float],
    covariance_m2: Three,
) -> tuple[float, Information]:
    """Return the squared Mahalanobis distance of a fix, and what it says about c ~ N(`mean_m`, `covariance_m2`).

    The fix is `off` (2,) from what is expected, with covariance `total` (2, 2) and `seen` (2, 2) that with c.
    """
    (off_x, off_y), (x, y) = off, mean_m
    (s_xx, s_xy), (_, s_yy) = total
    a, b, d = inverted(s_xx, s_xy, s_yy)
    distance = a * off_x * off_x + 2 * b * off_x * off_y + d * off_y * off_y
    # The slope K = C P⁻¹ of the fix on c, and the information (S − K Cᵀ)⁻¹ of the fix given c.
    (c_xx, c_xy), (c_yx, c_yy) = seen
    a, b, d = inverted(*covariance_m2)
    k_xx, k_xy, k_yx, k_yy = c_xx * a + c_xy * b, c_xx * b + c_xy * d, c_yx * a + c_yy * b, c_yx * b + c_yy * d
    given_xx, given_yy = s_xx - k_xx * c_xx - k_xy * c_xy, s_yy - k_yx * c_yx - k_yy * c_yy
    a, b, d = inverted(given_xx, s_xy - k_xx * c_yx - k_xy * c_yy, given_yy)
    # W = Kᵀ (S − K Cᵀ)⁻¹, Λ = W K, η = W off + Λ x.
    w_xx, w_xy, w_yx, w_yy = k_xx * a + k_yx * b, k_xx * b + k_yx * d, k_xy * a + k_yy * b, k_xy * b + k_yy * d
    a, b, d = w_xx * k_xx + w_xy * k_yx, w_xx * k_xy + w_xy * k_yy, w_yx * k_xy + w_yy * k_yy
    eta_x, eta_y = w_xx * off_x + w_xy * off_y, w_yx * off_x + w_yy * off_y
    return distance, Information((a, b, d, eta_x + a * x + b * y, eta_y + b * x + d * y))


def _innovation(
    off: Array, slope: Array, given_m2: Array, belief: tuple[Array, Array]
) -> tuple[float, Information]:
    """Return the squared Mahalanobis distance of a fix, and what it says about c ~ `belief`.

    The fix is `off` (2,) from what is expected; given c, which moves it by `slope` (2, 2), its covariance is
    `given_m2` (2, 2).
    """
    mean_m, covariance_m2 = belief
    distance = inverse(given_m2 + slope.dot(covariance_m2).dot(slope.T)).dot(off).dot(off)
    whitened = slope.T.dot(inverse(given_m2))
    matrix = whitened.dot(slope)
    return float(distance), Information.from_arrays(matrix, whitened.dot(off) + matrix.dot(mean_m))
