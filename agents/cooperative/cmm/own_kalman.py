"""The Kalman filter of one vehicle on a lane that is known: itself and the common error (MODEL 10).

With one lane all is linear and Gaussian, so that moments say what any number of particles could. The state is
(c, l, s, v): the common error, the offset to the right of the centre line, and position and speed along it. All is
in the lane's frame, to its right and along it, where a fix is z = c + (l, s) + noise. Five numbers and fifteen are
worked with as plain ones: as arrays they take four times as long, and products of BLAS differ in their last bits
from one processor to another.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from agents.cooperative.cmm.information import Five, Information, Three, inverted, plain_moments, rooted
from agents.cooperative.cmm.kalman_bound import LaneModel
from vnet.types import Array

LEAST_VARIANCE_M2 = 1e-4
"""Variance (m²) that is added to those of c where less than about so much is left: nothing is known to a
centimetre, and a covariance can be inverted."""


@dataclass(frozen=True)
class _Steps:
    """A step of `dt_s`: the factors of c and l, and the variances that it adds."""

    dt_s: float
    common_keep: float
    common_m2: float
    lateral_keep: float
    lateral_m2: float
    along: Three

    @classmethod
    def of(cls, model: LaneModel, dt_s: float) -> _Steps:
        """Return the step of a model."""
        moves, noise = model.transition(dt_s).tolist(), model.process_noise(dt_s).tolist()
        keep, variance_m2 = model.common_step(dt_s)
        along = noise[1][1], noise[1][2], noise[2][2]
        return cls(dt_s, keep, variance_m2, moves[0][0], noise[0][0], along)


class OwnKalman:
    """The filter of a vehicle on the lane through `point_m` (2,) with direction `heading_rad`.

    Beginning with the mean (5,) and the covariance (5, 5) of (c, l, s, v), c in east and north.

    point_m, heading_rad: those of the lane.
    """

    def __init__(self, point_m: Array, heading_rad: float, model: LaneModel, moments: tuple[Array, Array]) -> None:
        self.model = model
        self._steps = _Steps.of(model, 0.0)
        self.point_m, self.heading_rad = point_m, heading_rad
        self._point_x, self._point_y = point_m.tolist()
        # To the right is (sine, −cosine), along is (cosine, sine).
        self._sine, self._cosine = math.sin(heading_rad), math.cos(heading_rad)
        c_x, c_y, *own = moments[0].tolist()
        covariance = moments[1].tolist()
        self._common = self._into_lane(c_x, c_y)
        self._own = own[0], own[1], own[2]
        self._p = self._turned_into_lane(covariance[0][0], covariance[0][1], covariance[1][1])
        cross = [self._into_lane(covariance[row][0], covariance[row][1]) for row in (2, 3, 4)]
        self._cross = *cross[0], *cross[1], *cross[2]
        (ll, ls, lv), (_, ss, sv), (_, _, vv) = (covariance[row][2:] for row in (2, 3, 4))
        self._o = ll, ls, lv, ss, sv, vv
        self._keep_some_variance()
        self._moments: tuple[Three, Five] | None = None
        self._belief: tuple[Three, Information] | None = None

    @classmethod
    def start(cls, point_m: Array, heading_rad: float, model: LaneModel, belief: tuple[Array, Array]) -> OwnKalman:
        """Return the filter before the first fix, with this belief about c: mean (2,) and covariance (2, 2)."""
        mean, covariance = np.zeros(5), np.zeros((5, 5))
        mean[:2], covariance[:2, :2] = belief
        covariance[2:, 2:] = model.own_covariance()
        return cls(point_m, heading_rad, model, (mean, covariance))

    # Between the lane's frame, and east and north.

    def _into_lane(self, x: float, y: float) -> tuple[float, float]:
        return self._sine * x - self._cosine * y, self._cosine * x + self._sine * y

    def _out_of_lane(self, right: float, along: float) -> tuple[float, float]:
        return self._sine * right + self._cosine * along, self._sine * along - self._cosine * right

    def _turned_into_lane(self, xx: float, xy: float, yy: float) -> Three:
        """Return a symmetric matrix (right-right, right-along, along-along) of one in east and north."""
        sine, cosine = self._sine, self._cosine
        across, both, along = sine * sine, sine * cosine, cosine * cosine
        twice = 2 * both * xy
        return (
            across * xx - twice + along * yy,
            both * (xx - yy) + (across - along) * xy,
            along * xx + twice + across * yy,
        )

    def _turned_out_of_lane(self, rr: float, ra: float, aa: float) -> Three:
        sine, cosine = self._sine, self._cosine
        across, both, along = sine * sine, sine * cosine, cosine * cosine
        twice = 2 * both * ra
        return (
            across * rr + twice + along * aa,
            both * (aa - rr) + (across - along) * ra,
            along * rr - twice + across * aa,
        )

    # The belief.

    @property
    def estimate_m(self) -> Array:
        """Estimate (2,) of the common error."""
        return np.array(self.plain_moments[:2])

    @property
    def estimate_covariance_m2(self) -> Array:
        """Covariance (2, 2) of the common error."""
        _, _, xx, xy, yy = self.plain_moments
        return np.array([[xx, xy], [xy, yy]])

    # What changes a moment of c makes another tuple of its variances: as long as that is the same, so are these.

    @property
    def plain_moments(self) -> Five:
        """Mean (x, y) and covariance (xx, xy, yy) of c."""
        if self._moments is None or self._moments[0] is not self._p:
            moments = *self._out_of_lane(*self._common), *self._turned_out_of_lane(*self._p)
            self._moments = self._p, moments
        return self._moments[1]

    @property
    def belief(self) -> Information:
        """The belief about c."""
        if self._belief is None or self._belief[0] is not self._p:
            x, y, p, q, r = self.plain_moments
            a, b, d = inverted(p, q, r)
            self._belief = self._p, Information((a, b, d, a * x + b * y, b * x + d * y))
        return self._belief[1]

    def position_m(self) -> tuple[Array, Array]:
        """Return the position (2,) of the vehicle and its covariance (2, 2)."""
        offset, s, _ = self._own
        ll, ls, _, ss, _, _ = self._o
        if hidden := self.model.hidden:
            share, offset_m2, along_m2 = hidden
            offset, ll, ls, ss = share * offset, share * share * ll + offset_m2, share * ls, ss + along_m2
        x, y = self._out_of_lane(offset, s)
        xx, xy, yy = self._turned_out_of_lane(ll, ls, ss)
        return np.array([self._point_x + x, self._point_y + y]), np.array([[xx, xy], [xy, yy]])

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Draw `count` hypotheses (count, 2) of c."""
        x, y, *covariance_m2 = self.plain_moments
        a, b, d = rooted(*covariance_m2)
        first, second = rng.standard_normal((2, count))
        return np.stack([x + a * first + b * second, y + b * first + d * second], axis=1)

    def _keep_some_variance(self) -> None:
        rr, ra, aa = self._p
        if rr * aa - ra * ra <= LEAST_VARIANCE_M2 * (
            rr + aa
        ):  # at most the smaller eigenvalue, at least half of it
            self._p = rr + LEAST_VARIANCE_M2, ra, aa + LEAST_VARIANCE_M2

    # A period.

    def suit(self, model: LaneModel) -> None:
        """Go on with another model: something is added to the offset, or only its share in what was is left."""
        share = min(1.0, (model.lateral_sigma_m / self.model.lateral_sigma_m) ** 2)
        more_m2 = model.lateral_sigma_m**2 - (share * self.model.lateral_sigma_m) ** 2
        (offset, s, v), (l_r, l_a, s_r, s_a, v_r, v_a) = self._own, self._cross
        ll, ls, lv, ss, sv, vv = self._o
        self._own, self._cross = (share * offset, s, v), (share * l_r, share * l_a, s_r, s_a, v_r, v_a)
        self._o = share * share * ll + more_m2, share * ls, share * lv, ss, sv, vv
        self.model, self._steps = model, _Steps.of(model, self._steps.dt_s)

    def noise_across(self, noise_m2: Array) -> float:
        """Return the variance of a fix with noise covariance (2, 2) across the lane."""
        (xx, xy), (_, yy) = noise_m2.tolist()
        return self._turned_into_lane(xx, xy, yy)[0]

    def predict(self, dt_s: float) -> None:
        """Advance by `dt_s`."""
        if dt_s != self._steps.dt_s:
            self._steps = _Steps.of(self.model, dt_s)
        step = self._steps
        keep, stays = step.common_keep, step.lateral_keep
        (right, along), (offset, s, v) = self._common, self._own
        self._common, self._own = (keep * right, keep * along), (stays * offset, s + dt_s * v, v)
        rr, ra, aa = self._p
        more, keep_2 = step.common_m2, keep * keep
        self._p = keep_2 * rr + more, keep_2 * ra, keep_2 * aa + more
        l_r, l_a, s_r, s_a, v_r, v_a = self._cross
        both = keep * stays
        self._cross = (
            both * l_r,
            both * l_a,
            keep * (s_r + dt_s * v_r),
            keep * (s_a + dt_s * v_a),
            keep * v_r,
            keep * v_a,
        )
        ll, ls, lv, ss, sv, vv = self._o
        more_ss, more_sv, more_vv = step.along
        self._o = (
            stays * stays * ll + step.lateral_m2,
            stays * (ls + dt_s * lv),
            stays * lv,
            ss + dt_s * (2 * sv + dt_s * vv) + more_ss,
            sv + dt_s * vv + more_sv,
            vv + more_vv,
        )
        self._keep_some_variance()

    def _seen(self, fix_m: Array, noise_m2: Array) -> tuple[float, float, float, float, float]:
        """Return how far a fix is from what is expected, to the right and along, and the covariance of that."""
        x, y = fix_m.tolist()
        (xx, xy), (_, yy) = noise_m2.tolist()
        z_r, z_a = self._into_lane(x - self._point_x, y - self._point_y)
        n_rr, n_ra, n_aa = self._turned_into_lane(xx, xy, yy)
        (right, along), (offset, s, _) = self._common, self._own
        rr, ra, aa = self._p
        l_r, l_a, s_r, s_a, _, _ = self._cross
        ll, ls, _, ss, _, _ = self._o
        return (
            z_r - right - offset,
            z_a - along - s,
            rr + 2 * l_r + ll + n_rr,
            ra + l_a + s_r + ls + n_ra,
            aa + 2 * s_a + ss + n_aa,
        )

    def take(self, fix_m: Array, noise_m2: Array, gate: float = math.inf) -> Information | None:
        """Take the vehicle's own fix (2,) with noise covariance (2, 2); return what it says about c: the increment.

        A fix whose squared Mahalanobis distance from what is expected is above `gate` is not taken: None.
        """
        off_r, off_a, s_rr, s_ra, s_aa = self._seen(fix_m, noise_m2)
        a, b, d = inverted(s_rr, s_ra, s_aa)
        if a * off_r * off_r + 2 * b * off_r * off_a + d * off_a * off_a > gate:
            return None
        before = self.belief
        self._update(off_r, off_a, a, b, d)
        xx, xy, yy, x, y = self.belief.minus(before).numbers
        return Information((max(xx, 0.0), xy, max(yy, 0.0), x, y))  # along a lane only rounding may be left

    def _update(self, off_r: float, off_a: float, a: float, b: float, d: float) -> None:
        """Take a fix that is off by (`off_r`, `off_a`); (a, b, d) is the inverse of the covariance of that."""
        (right, along), (offset, s, v) = self._common, self._own
        rr, ra, aa = self._p
        l_r, l_a, s_r, s_a, v_r, v_a = self._cross
        ll, ls, lv, ss, sv, vv = self._o
        # For each of the five its covariance with the fix to the right and along, and its gain.
        c_rr, c_ra, c_ar, c_aa = rr + l_r, ra + s_r, ra + l_a, aa + s_a
        c_lr, c_la, c_sr, c_sa, c_vr, c_va = l_r + ll, l_a + ls, s_r + ls, s_a + ss, v_r + lv, v_a + sv
        g_rr, g_ra = c_rr * a + c_ra * b, c_rr * b + c_ra * d
        g_ar, g_aa = c_ar * a + c_aa * b, c_ar * b + c_aa * d
        g_lr, g_la = c_lr * a + c_la * b, c_lr * b + c_la * d
        g_sr, g_sa = c_sr * a + c_sa * b, c_sr * b + c_sa * d
        g_vr, g_va = c_vr * a + c_va * b, c_vr * b + c_va * d
        self._common = right + g_rr * off_r + g_ra * off_a, along + g_ar * off_r + g_aa * off_a
        self._own = (
            offset + g_lr * off_r + g_la * off_a,
            s + g_sr * off_r + g_sa * off_a,
            v + g_vr * off_r + g_va * off_a,
        )
        self._p = (
            rr - g_rr * c_rr - g_ra * c_ra,
            ra - g_rr * c_ar - g_ra * c_aa,
            aa - g_ar * c_ar - g_aa * c_aa,
        )
        self._cross = (
            l_r - g_lr * c_rr - g_la * c_ra,
            l_a - g_lr * c_ar - g_la * c_aa,
            s_r - g_sr * c_rr - g_sa * c_ra,
            s_a - g_sr * c_ar - g_sa * c_aa,
            v_r - g_vr * c_rr - g_va * c_ra,
            v_a - g_vr * c_ar - g_va * c_aa,
        )
        self._o = (
            ll - g_lr * c_lr - g_la * c_la,
            ls - g_lr * c_sr - g_la * c_sa,
            lv - g_lr * c_vr - g_la * c_va,
            ss - g_sr * c_sr - g_sa * c_sa,
            sv - g_sr * c_vr - g_sa * c_va,
            vv - g_vr * c_vr - g_va * c_va,
        )

    def absorb(self, pooled: Information) -> None:
        """Replace the belief about c by `pooled`: what is known of the vehicle given c stays."""
        x, y, *covariance_m2 = plain_moments(*pooled.numbers)
        common, p = self._into_lane(x, y), self._turned_into_lane(*covariance_m2)
        (right, along), (rr, ra, aa) = common, p
        more_r, more_a = right - self._common[0], along - self._common[1]
        a, b, d = inverted(*self._p)
        d_rr, d_ra, d_aa = rr - self._p[0], ra - self._p[1], aa - self._p[2]
        # The slopes B = C P⁻¹ of the own state on c; C moves to B P', and the covariance by B (P' − P) Bᵀ.
        l_r, l_a, s_r, s_a, v_r, v_a = self._cross
        l_r, l_a = l_r * a + l_a * b, l_r * b + l_a * d
        s_r, s_a = s_r * a + s_a * b, s_r * b + s_a * d
        v_r, v_a = v_r * a + v_a * b, v_r * b + v_a * d
        offset, s, v = self._own
        self._own = (
            offset + l_r * more_r + l_a * more_a,
            s + s_r * more_r + s_a * more_a,
            v + v_r * more_r + v_a * more_a,
        )
        ll, ls, lv, ss, sv, vv = self._o
        dl_r, dl_a = l_r * d_rr + l_a * d_ra, l_r * d_ra + l_a * d_aa
        ds_r, ds_a = s_r * d_rr + s_a * d_ra, s_r * d_ra + s_a * d_aa
        dv_r, dv_a = v_r * d_rr + v_a * d_ra, v_r * d_ra + v_a * d_aa
        self._o = (
            ll + dl_r * l_r + dl_a * l_a,
            ls + dl_r * s_r + dl_a * s_a,
            lv + dl_r * v_r + dl_a * v_a,
            ss + ds_r * s_r + ds_a * s_a,
            sv + ds_r * v_r + ds_a * v_a,
            vv + dv_r * v_r + dv_a * v_a,
        )
        self._cross = (
            l_r * rr + l_a * ra,
            l_r * ra + l_a * aa,
            s_r * rr + s_a * ra,
            s_r * ra + s_a * aa,
            v_r * rr + v_a * ra,
            v_r * ra + v_a * aa,
        )
        self._common, self._p = common, p
