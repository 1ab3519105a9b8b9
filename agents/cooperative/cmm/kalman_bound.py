"""The hears-all bound on straight lanes: one Kalman filter that hears every fix of a component without loss.

With straight lanes, one candidate each, cooperative map matching is a linear-Gaussian problem once the lateral
offset of a vehicle is a state: x = [c, (l_j, s_j, v_j) for all j], with the common error c, the offset l_j to the
right of the lane's centre line, and position and speed s_j, v_j along it (MODEL 10). No estimator that is told the
same can have a smaller error in the mean, so this filter is the bound of every other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
import scipy  # its parts are imported when they are first used: `linalg` takes longer than many a run

from vnet.types import Array

PRECISE_M2 = 0.64
"""Variance (m²) of a fix below which its receiver is precise (0.8 m): the movement of c between fixes, which is the
same for all vehicles, shows in their increments about c, and their sum claims too much (Bar-Shalom 1981)."""
USUAL_PERIOD_S = 0.1
"""Period of fixes for which that is the limit."""
LATERAL_SIGMA_M = 0.38
"""Deviation (m) of a lateral offset: that of 0.4 m after reflection at ±0.85 m."""
UNKNOWN_ALONG_M = 1e4
"""Deviation (m) of the position along the lane before the first fix: unknown."""


@dataclass(frozen=True)
class LaneModel:
    """Constants of the linear-Gaussian model; lengths in metres, times in seconds.

    common_sigma_m, common_tau_s: the common error, a Gauss-Markov process an axis.
    common_walk_m: in place of it, the deviation of a random walk after a second.
    lateral_sigma_m, lateral_tau_s: the lateral offset, a Gauss-Markov process.
    acceleration_m2_s4: variance of the white acceleration along the lane.
    speed_sigma_m_s: deviation of the speed at the start.
    """

    common_sigma_m: float = 3.0
    common_tau_s: float = 600.0
    common_walk_m: float | None = None
    lateral_sigma_m: float = LATERAL_SIGMA_M
    lateral_tau_s: float = 20.0
    acceleration_m2_s4: float = 1.0
    speed_sigma_m_s: float = 15.0

    @property
    def measured(self) -> list[list[int]]:
        """Indices in a vehicle's own state of what adds up to a fix, each for across and along the lane."""
        return [[0, 1]]

    @property
    def hidden(self) -> tuple[float, float, float] | None:
        """Share of l that is the vehicle's own offset, and variances (m²) that this and s have beyond: of the rest.

        None if all of it is.
        """
        return None

    def transition(self, dt_s: float) -> Array:
        """Return F (3, 3) of a vehicle's own state (l, s, v) over `dt_s`."""
        keep = np.exp(-dt_s / self.lateral_tau_s)
        return np.array([[keep, 0.0, 0.0], [0.0, 1.0, dt_s], [0.0, 0.0, 1.0]])

    def process_noise(self, dt_s: float) -> Array:
        """Return Q (3, 3) of a vehicle's own state over `dt_s`."""
        keep = np.exp(-dt_s / self.lateral_tau_s)
        noise = np.zeros((3, 3))
        noise[0, 0] = self.lateral_sigma_m**2 * (1 - keep**2)
        step = np.array([dt_s**2 / 2, dt_s])
        noise[1:, 1:] = self.acceleration_m2_s4 * np.outer(step, step)
        return noise

    def own_covariance(self) -> Array:
        """Return the covariance (3, 3) of a vehicle's own state before its first fix."""
        return np.diag([self.lateral_sigma_m**2, UNKNOWN_ALONG_M**2, self.speed_sigma_m_s**2])

    def common_step(self, dt_s: float) -> tuple[float, float]:
        """Return the factor of c over `dt_s`, and the variance (m²) that is added an axis."""
        return common_step(self.common_sigma_m, self.common_tau_s, self.common_walk_m, dt_s)


@dataclass(frozen=True)
class OffsetAndMultipath(LaneModel):
    """The model with multipath in l and s: what a fix shows of a vehicle's offset and of its place is their sum.

    l is one Gauss-Markov process with the variance of the sum and its power at low frequencies, which decides what
    a road says of c in the long run. s is known from fixes alone, and so up to the multipath.

    multipath_sigma_m, multipath_tau_s: its deviation an axis in metres and its correlation time in seconds.
    offset_sigma_m: deviation of the vehicle's own offset.
    """

    multipath_sigma_m: float = 0.0
    multipath_tau_s: float = 60.0
    offset_sigma_m: float = LATERAL_SIGMA_M

    @classmethod
    def of(cls, lane: LaneModel, sigma_m: float, tau_s: float) -> OffsetAndMultipath:
        """Return the model of a receiver with this multipath on a lane."""
        offset_m2, multipath_m2 = lane.lateral_sigma_m**2, sigma_m**2
        total_m2 = offset_m2 + multipath_m2
        together = {
            "lateral_sigma_m": math.sqrt(total_m2),
            "lateral_tau_s": (offset_m2 * lane.lateral_tau_s + multipath_m2 * tau_s) / total_m2,
        }
        laws = {each.name: getattr(lane, each.name) for each in fields(LaneModel)} | together
        return cls(**laws, multipath_sigma_m=sigma_m, multipath_tau_s=tau_s, offset_sigma_m=lane.lateral_sigma_m)

    @property
    def hidden(self) -> tuple[float, float, float]:
        """Share of l that is the vehicle's own offset, and variances (m²) that this and s have beyond."""
        offset_m2, multipath_m2 = self.offset_sigma_m**2, self.multipath_sigma_m**2
        share = offset_m2 / (offset_m2 + multipath_m2)
        return share, share * multipath_m2, multipath_m2

    def process_noise(self, dt_s: float) -> Array:
        """Return Q (3, 3) of a vehicle's own state over `dt_s`."""
        noise = super().process_noise(dt_s)
        noise[1, 1] += self.multipath_sigma_m**2 * (1 - math.exp(-2 * dt_s / self.multipath_tau_s))
        return noise


@dataclass(frozen=True)
class MultipathLaneModel(LaneModel):
    """The model with multipath (b_l, b_s) as further states of a vehicle, a Gauss-Markov process an axis.

    multipath_sigma_m, multipath_tau_s: its deviation in metres and its correlation time in seconds.
    """

    multipath_sigma_m: float = 1.0
    multipath_tau_s: float = 60.0

    @property
    def measured(self) -> list[list[int]]:
        """Indices in a vehicle's own state of what adds up to a fix, each for across and along the lane."""
        return [[0, 1], [3, 4]]

    def transition(self, dt_s: float) -> Array:
        """Return F (5, 5) of a vehicle's own state (l, s, v, b_l, b_s) over `dt_s`."""
        keep = np.exp(-dt_s / self.multipath_tau_s)
        return np.asarray(scipy.linalg.block_diag(super().transition(dt_s), keep * np.eye(2)))

    def process_noise(self, dt_s: float) -> Array:
        """Return Q (5, 5) of a vehicle's own state over `dt_s`."""
        keep = np.exp(-dt_s / self.multipath_tau_s)
        return np.asarray(
            scipy.linalg.block_diag(
                super().process_noise(dt_s), self.multipath_sigma_m**2 * (1 - keep**2) * np.eye(2)
            )
        )

    def own_covariance(self) -> Array:
        """Return the covariance (5, 5) of a vehicle's own state before its first fix."""
        return np.asarray(scipy.linalg.block_diag(super().own_covariance(), self.multipath_sigma_m**2 * np.eye(2)))


def common_step(sigma_m: float, tau_s: float, walk_m: float | None, dt_s: float) -> tuple[float, float]:
    """Return the factor of c over `dt_s` and the variance (m²) added an axis: Gauss-Markov, or a walk if given."""
    if walk_m is not None:
        return 1.0, walk_m**2 * dt_s
    keep = float(np.exp(-dt_s / tau_s))
    return keep, sigma_m**2 * (1 - keep**2)


def precise_m2(
    sigma_m: float,
    tau_s: float,
    walk_m: float | None,
    lateral_tau_s: float = LaneModel.lateral_tau_s,
    period_s: float = USUAL_PERIOD_S,
) -> float:
    """Return the variance (m²) of a fix below which its receiver is precise; see `PRECISE_M2`.

    That is of a c of 3 m and 600 s, of offsets in the lane that last for 20 s, and of ten fixes a second. It grows
    with what is added to c in a second, with the time for which offsets last, in which c moves, and with the number
    of fixes, which together say as much as a better one. What is slower, shorter or rarer does not change it.
    """
    usual = LaneModel()
    usual_m2 = common_step(usual.common_sigma_m, usual.common_tau_s, None, 1.0)[1]
    more = common_step(sigma_m, tau_s, walk_m, 1.0)[1] / usual_m2, lateral_tau_s / usual.lateral_tau_s
    return PRECISE_M2 * math.prod(max(1.0, each) for each in (*more, USUAL_PERIOD_S / period_s))


def lane_axes(heading_rad: Array | float) -> Array:
    """Return the rotation (…, 2, 2) into the lane's frame: to its right, and along it."""
    sine, cosine = np.sin(heading_rad), np.cos(heading_rad)
    return np.stack([np.stack([sine, -cosine], axis=-1), np.stack([cosine, sine], axis=-1)], axis=-2)


class KalmanBound:
    """The filter of one component of vehicles on straight lanes that are known.

    point_m (N, 2), heading_rad (N,): a point of each vehicle's lane, and the direction of travel.
    common_m (2,), common_covariance_m2 (2, 2): the estimate of the common error.
    """

    def __init__(self, point_m: Array, heading_rad: Array, model: LaneModel | None = None) -> None:
        self.model = model or LaneModel()
        self._point_m = point_m
        self._axes = lane_axes(heading_rad)
        own = self.model.own_covariance()
        self._size = len(own)
        self._covariance = scipy.linalg.block_diag(
            self.model.common_sigma_m**2 * np.eye(2), *[own] * len(heading_rad)
        )
        self._mean = np.zeros(len(self._covariance))

    @property
    def common_m(self) -> Array:
        """Estimate (2,) of the common error."""
        return np.asarray(self._mean[:2])

    @property
    def common_covariance_m2(self) -> Array:
        """Covariance (2, 2) of the common error."""
        return np.asarray(self._covariance[:2, :2])

    @property
    def position_m(self) -> Array:
        """Estimated positions (N, 2) of all vehicles."""
        own = self._mean[2:].reshape(-1, self._size)
        return np.asarray(self._point_m + np.einsum("nji,nj->ni", self._axes, own[:, :2]))

    def position_covariance_m2(self) -> Array:
        """Return the covariances (N, 2, 2) of the positions."""
        first = 2 + self._size * np.arange(len(self._axes))
        blocks = [self._covariance[row : row + 2, row : row + 2] for row in first.tolist()]
        return np.asarray(self._axes.transpose(0, 2, 1) @ np.array(blocks) @ self._axes)

    def step(self, dt_s: float, fix_m: Array, noise_m2: Array) -> None:
        """Advance by `dt_s` and take the fixes (N, 2), NaN where there is none, with noise covariance (2, 2)."""
        self._predict(dt_s)
        heard = np.flatnonzero(np.isfinite(fix_m[:, 0]))
        if not len(heard):
            return
        axes = self._axes[heard]
        parts = [(2 + self._size * heard[:, None] + part).ravel() for part in np.array(self.model.measured)]
        common = axes.reshape(-1, 2)
        measured = np.einsum("nij,nj->ni", axes, fix_m[heard] - self._point_m[heard]).ravel()
        projected = common @ self._covariance[:2] + sum(self._covariance[rows] for rows in parts)
        innovation = projected[:, :2] @ common.T + sum(projected[:, rows] for rows in parts)
        noise = axes @ noise_m2 @ axes.transpose(0, 2, 1)
        for k in range(len(heard)):
            innovation[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += noise[k]
        factor = scipy.linalg.cho_factor(innovation, lower=True)
        gain = scipy.linalg.cho_solve(factor, projected).T
        self._mean += gain @ (measured - common @ self._mean[:2] - sum(self._mean[rows] for rows in parts))
        self._covariance -= gain @ projected
        self._covariance = (self._covariance + self._covariance.T) / 2

    def _predict(self, dt_s: float) -> None:
        keep, variance_m2 = self.model.common_step(dt_s)
        moves, noise = self.model.transition(dt_s), self.model.process_noise(dt_s)
        count = len(self._axes)
        self._mean[:2] *= keep
        size = self._size
        self._mean[2:] = (self._mean[2:].reshape(-1, size) @ moves.T).ravel()
        covariance = self._covariance
        covariance[:2] *= keep
        covariance[:, :2] *= keep
        rows = covariance[2:].reshape(count, size, -1)
        covariance[2:] = (moves @ rows).reshape(size * count, -1)
        columns = covariance[:, 2:].reshape(-1, count, size)
        covariance[:, 2:] = (columns @ moves.T).reshape(-1, size * count)
        covariance[[0, 1], [0, 1]] += variance_m2
        for first in range(2, len(covariance), size):
            own = slice(first, first + size)
            covariance[own, own] += noise
