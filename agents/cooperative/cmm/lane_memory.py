"""Increments of precise receivers on lanes, the memory that makes them independent, and their exchange (MODEL 10).

What a fix says about the common error c rests on what the vehicle has learned of its offset in the lane from
earlier fixes, and so on c at that time. Since then c has moved, for all vehicles alike: said about the present c
alone, their increments err together, and their sum claims too much (Bar-Shalom 1981).

So the offset is filtered with a gain K that depends on age alone. The filter is linear in fixes, and what it makes
of c is the same for all vehicles of that gain: its *memory* u of c, with u ← keep (u + K (c − u)). Given the way of
c, a vehicle's innovation across its lane is c − u and white noise of its own: increments about c − u are
independent, and add up exactly. `CommonMemory` is a Gaussian over c, its value one period before, and u of each
*kind* of gain.

Multipath is part of the offset, and makes it larger and last longer. So there are *families* of kinds, by deviation
and correlation time of the offset relative to those of a receiver without multipath, rounded up.

Where nobody has so precise a receiver (`precise_m2`) increments are about c: they also hold what fixes say along
the lane (4 % of the error of c), and what the vehicle has learned of c from others. A receiver that states
multipath is always taken for a precise one. Beside increments of lanes such a vehicle says nothing while it has
several lanes: about c it would claim c's latest movement once more.

An increment of a lane is written as (a_x, a_y, −kind, w, age): Λ = a aᵀ and η = a w about c − u. The exchange of a
vehicle holds its own increments, and those that it takes.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache

import numpy as np

from agents.cooperative.cmm.information import (
    NOTHING,
    Five,
    Information,
    Three,
    inverted,
    plain_moments,
)
from agents.cooperative.cmm.kalman_bound import LaneModel, precise_m2
from agents.cooperative.cmm.own_kalman import OwnKalman
from agents.cooperative.cmm.own_vehicle import OwnVehicle
from agents.cooperative.cmm.plausibility import MEMORY_S
from agents.cooperative.cmm.rbpf import Observation
from vnet.types import Array

FIRST_LOG_ODDS, LOG_ODDS_STEP = -14.0, 1.25
"""Base-2 logarithm of K / (1 − K) of the first kind, and its step from kind to kind: receivers of 0.01 to 100 m."""
SAME_NOISE = 0.7
"""Change of the logarithm of a fix's variance up to which the filter keeps its gain."""
KINDS = 16
"""Number of gains: those of neighbouring kinds differ by a factor of 2.4, and the nearest is nearly the best."""
SPREAD_STEP, SPREAD_STEPS = 2.0, 8
"""Factor of the variance of the offset from family to family, and their number: multipath of up to 4 m."""
TIME_STEP, TIME_STEPS = math.sqrt(2.0), 8
"""Factor of the correlation time of the offset, and the number of times: up to 11 times that without multipath."""
ALL_KINDS = KINDS * SPREAD_STEPS * TIME_STEPS
"""Number of kinds of all families; half precision has integers up to 2048."""
MAX_KINDS = 10
"""Number of kinds that are followed at a time: a dozen of 0.03 to 30 m have about nine."""
UNHEARD_PERIODS = 100
"""Periods after which a kind that nobody uses is forgotten."""
MAX_AGE = 255
"""Age in periods from which on a memory counts as old: the beginning has been forgotten."""
Moments = tuple[tuple[float, float], Three]

JOINING_PERIODS = 3
"""Periods in which a vehicle that has just begun waits for others, who tell when memories began."""
NOT_BEGUN: Five = (0.0, 0.0, -1.0, 0.0, -1.0)
"""The increment of a vehicle that waits: if nobody else has begun either, all begin with the next fix."""
UNDERSTATED = 0.5
"""Share by which averaged priors understate what is new: a vehicle adds the increments within two hops, and the
averages hold those of all. Without it the ANEES of c is 0.55 to 0.9 on N1, N2 and N3, the bound's 1.1 to 1.3."""
SMOOTHING = 0.05
"""Weight of the latest period in the share of increments that come from out of range."""


def law_of(kind: int, keep: float, spread_m2: float) -> tuple[float, float]:
    """Return the share of an offset that is left after a period, and its variance, in the family of a kind.

    `keep` and `spread_m2` are those without multipath.
    """
    times, spreads = divmod((kind - 1) // KINDS, SPREAD_STEPS)
    return keep ** (TIME_STEP**-times), spread_m2 * SPREAD_STEP**spreads


def first_kind(spread: float, time: float) -> int:
    """Return the first kind of the family of an offset with these multiples of variance and correlation time."""
    spreads, times = (
        min(max(math.ceil(math.log(value) / math.log(step) - 1e-9), 0), count - 1)
        for value, step, count in ((spread, SPREAD_STEP, SPREAD_STEPS), (time, TIME_STEP, TIME_STEPS))
    )
    return 1 + KINDS * (times * SPREAD_STEPS + spreads)


@lru_cache(maxsize=256)
def gains_of(kind: int, keep: float, spread_m2: float) -> tuple[float, ...]:
    """Return the gains K of a kind at each age up to `MAX_AGE`, the last that of its steady state.

    They are those of a Kalman filter of an offset with variance `spread_m2`, of which `keep` is left after a
    period, both without multipath: whoever begins when memories do has the best gain from the first fix on.
    """
    keep, spread_m2 = law_of(kind, keep, spread_m2)
    odds = 2.0 ** (FIRST_LOG_ODDS + LOG_ODDS_STEP * ((kind - 1) % KINDS))
    last = odds / (1 + odds)
    process_m2 = spread_m2 * (1 - keep * keep)
    noise_m2 = process_m2 / (1 - keep * keep * (1 - last)) * (1 - last) / last
    gains, variance_m2 = [], spread_m2
    for _ in range(MAX_AGE):
        gains.append(variance_m2 / (variance_m2 + noise_m2))
        variance_m2 = keep * keep * (1 - gains[-1]) * variance_m2 + process_m2
    return *gains, last


def kind_of(gain: float) -> int:
    """Return the kind with the nearest gain, 1 … `KINDS`."""
    log_odds = math.log2(gain / (1 - gain))
    return min(max(1 + round((log_odds - FIRST_LOG_ODDS) / LOG_ODDS_STEP), 1), KINDS)


def is_of_lane(increment: Five) -> bool:
    """Tell whether an increment is one of a lane, about c − u, and not about c."""
    return increment[2] < 0


def kind_of_increment(increment: Five) -> int:
    """Return the kind of an increment, 0 if it is about c."""
    return round(-increment[2]) if increment[2] < 0 else 0


def information_of(increment: Five) -> Five:
    """Return Λ (xx, xy, yy) and η (x, y) of an increment."""
    if increment[2] >= 0:
        return increment
    a_x, a_y, _, w, _ = increment
    return a_x * a_x, a_x * a_y, a_y * a_y, a_x * w, a_y * w


def all_information_of(increments: Iterable[Five]) -> list[Five]:
    """Return Λ and η of each increment."""
    return [increment if increment[2] >= 0 else information_of(increment) for increment in increments]


class LaneFilter:
    """The filter of the offset in one lane with gains that depend on age alone, and of what it makes of c.

    kind: that of its gains. multipath: variance and correlation time of the offset, relative to those of `model`,
    which is without multipath.
    """

    def __init__(
        self,
        lane: tuple[Array, float],
        model: LaneModel,
        noise_m2: Array,
        period_s: float,
        multipath: tuple[float, float] = (1.0, 1.0),
    ) -> None:
        """Begin on the lane through a point (2,) with a direction, by fixes of this noise (2, 2)."""
        point_m, heading_rad = lane
        self._normal = math.sin(heading_rad), -math.cos(heading_rad)
        self._at_m = self._across(point_m)
        self.multipath = multipath
        base = float(model.transition(period_s)[0, 0]), model.lateral_sigma_m**2
        first = first_kind(*multipath)
        self._keep, self._spread_m2 = law_of(first, *base)
        self._process_m2 = self._spread_m2 * (1 - self._keep**2)
        self._noise_m2 = self.noise_across(noise_m2)
        self.kind = first - 1 + kind_of(_best_gain(self._keep, self._process_m2, self._noise_m2))
        self._gains = gains_of(self.kind, *base)
        self._offset_m, self._variance_m2 = 0.0, math.inf

    def differs(self, noise_m2: Array) -> bool:
        """Tell whether fixes are now so much noisier, or less noisy, that another gain is better."""
        return abs(math.log(self.noise_across(noise_m2) / self._noise_m2)) > SAME_NOISE

    def _across(self, point_m: Array) -> float:
        x, y = point_m.tolist()
        return float(self._normal[0] * x + self._normal[1] * y)

    def noise_across(self, noise_m2: Array) -> float:
        """Return the variance of a fix across the lane."""
        (xx, xy), (_, yy) = noise_m2.tolist()
        return self._squared((xx, xy, yy))

    def _squared(self, matrix: Three) -> float:
        (x, y), (xx, xy, yy) = self._normal, matrix
        return max(x * x * xx + 2 * x * y * xy + y * y * yy, 1e-8)

    def begin(self, memory: Moments) -> None:
        """Begin with an unknown offset, if that is more than the filter knows.

        `memory` is the mean and the covariance of u: the filter's own begins there, whenever others' began.
        """
        (x, y), covariance_m2 = memory
        variance_m2 = self._spread_m2 + self._squared(covariance_m2)
        if variance_m2 < self._variance_m2:
            self._offset_m = self._normal[0] * x + self._normal[1] * y
            self._variance_m2 = variance_m2

    def take(self, fix_m: Array, age: int) -> Five:
        """Take a fix (2,); return its increment.

        As long as the filter knows less than in its steady state its errors last: they count once, in parts.
        """
        off_m, gain = self._across(fix_m) - self._at_m - self._offset_m, self._gains[age]
        # With this gain a filter of so many periods would know as much.
        expected_m2 = gain / (1 - gain) * self._noise_m2
        share = min(1.0, expected_m2 / self._variance_m2)
        root = math.sqrt(share / (self._variance_m2 + self._noise_m2))
        self._offset_m += gain * off_m
        self._variance_m2 = (1 - gain) ** 2 * self._variance_m2 + gain * gain * self._noise_m2
        x, y = self._normal
        return x * root, y * root, -float(self.kind), off_m * root, float(age)

    def miss(self, news: Moments, age: int) -> None:
        """Go on without a fix: `news` are the mean and the covariance of c − u, which all others have taken."""
        (x, y), covariance_m2 = news
        gain = self._gains[age]
        self._offset_m += gain * (self._normal[0] * x + self._normal[1] * y)
        self._variance_m2 += gain * gain * self._squared(covariance_m2)

    def predict(self) -> None:
        """Advance by a period."""
        self._offset_m *= self._keep
        self._variance_m2 = self._keep**2 * self._variance_m2 + self._process_m2


@lru_cache(maxsize=256)
def _best_gain(keep: float, process_m2: float, noise_m2: float) -> float:
    """Return the gain of the stationary Kalman filter of a Gauss-Markov process: P = keep² P R / (P + R) + Q."""
    b = noise_m2 * (1 - keep * keep) - process_m2
    p = (math.sqrt(b * b + 4 * process_m2 * noise_m2) - b) / 2
    return min(max(p / (p + noise_m2), 1e-9), 1 - 1e-9)


class CommonMemory:
    """A Gaussian over c, c one period before, and the memories u of c of some kinds (east and north of each).

    age: number of periods since the memories began, `MAX_AGE` at most.
    """

    def __init__(self, model: LaneModel, period_s: float, age: int = 0) -> None:
        self._keep_c, self._more_m2 = model.common_step(period_s)
        self._keep = float(model.transition(period_s)[0, 0])
        self._start_m2 = model.common_sigma_m**2
        self._spread_m2 = model.lateral_sigma_m**2
        self.age = age
        self._kinds: dict[int, int] = {}  # each kind's first row
        self._unheard: dict[int, int] = {}
        self._mean = np.zeros(4)
        self._covariance = self._start_m2 * np.array(
            [[1.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 1.0], [1.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 1.0]]
        )

    # Kinds.

    def follow(self, kind: int, is_own: bool = False) -> bool:
        """Follow a kind from now on; returns false if there are too many, unless it is the vehicle's own."""
        if kind in self._kinds:
            self._unheard[kind] = 0
            return True
        if len(self._kinds) >= MAX_KINDS and not is_own:
            return False
        self._unheard[kind] = 0
        common = self._keep_c, self._more_m2, self._start_m2
        by_c, by_before, own_m2 = _memory_given_c(self._gains(kind)[: self.age], self._keep_of(kind), common)
        mean, covariance = self._mean, self._covariance
        count = len(mean)
        rows = by_c * covariance[:2] + by_before * covariance[2:4]
        larger = np.empty((count + 2, count + 2))
        larger[:count, :count] = covariance
        larger[count:, :count], larger[:count, count:] = rows, rows.T
        larger[count:, count:] = by_c * rows[:, :2] + by_before * rows[:, 2:4] + own_m2 * np.eye(2)
        self._mean = np.concatenate([mean, by_c * mean[:2] + by_before * mean[2:4]])
        self._covariance = larger
        self._kinds[kind] = count
        return True

    def _gains(self, kind: int) -> tuple[float, ...]:
        return gains_of(kind, self._keep, self._spread_m2)

    def _keep_of(self, kind: int) -> float:
        return law_of(kind, self._keep, self._spread_m2)[0]

    def _forget(self) -> None:
        old = [kind for kind, periods in self._unheard.items() if periods > UNHEARD_PERIODS]
        if not old:
            return
        kept = [0, 1, 2, 3]
        rows, self._kinds = self._kinds, {}
        for kind, row in rows.items():
            if kind in old:
                del self._unheard[kind]
            else:
                self._kinds[kind] = len(kept)
                kept += [row, row + 1]
        self._mean, self._covariance = self._mean[kept], self._covariance[np.ix_(kept, kept)]

    # Time.

    def predict(self) -> None:
        """Advance by a period."""
        for kind in self._unheard:
            self._unheard[kind] += 1
        self._forget()
        mean, covariance, keep, kinds = self._mean, self._covariance, self._keep_c, len(self._kinds)
        if kinds:
            gains = np.array([self._gains(kind)[self.age] for kind in self._kinds]).repeat(2)
            left = np.array([self._keep_of(kind) for kind in self._kinds]).repeat(2)
            stays, takes = left * (1 - gains), left * gains
            mean[4:] = stays * mean[4:] + takes * np.tile(mean[:2], kinds)
            stays, takes = stays[:, None], takes[:, None]
            covariance[4:] = stays * covariance[4:] + takes * np.tile(covariance[:2], (kinds, 1))
            columns = stays.T * covariance[:, 4:] + takes.T * np.tile(covariance[:, :2], (1, kinds))
            covariance[:, 4:] = columns
        mean[2:4] = mean[:2]
        covariance[2:4] = covariance[:2]
        covariance[:, 2:4] = covariance[:, :2]
        mean[:2] *= keep
        covariance[:2] *= keep
        covariance[:, :2] *= keep
        covariance[0, 0] += self._more_m2
        covariance[1, 1] += self._more_m2
        self.age = min(self.age + 1, MAX_AGE)

    # What is known.

    @property
    def common(self) -> Moments:
        """Mean and covariance of c."""
        (xx, xy), (_, yy) = self._covariance[:2, :2].tolist()
        x, y = self._mean[:2].tolist()
        return (x, y), (xx, xy, yy)

    def memory(self, kind: int) -> Moments:
        """Return the mean and the covariance of u of a kind that is followed."""
        row = self._kinds[kind]
        (xx, xy), (_, yy) = self._covariance[row : row + 2, row : row + 2].tolist()
        x, y = self._mean[row : row + 2].tolist()
        return (x, y), (xx, xy, yy)

    def _of_news(self, kind: int, is_before: bool) -> tuple[int, float, int, float]:
        """Return rows and factors that make c − u of a kind, of this period or of the one before."""
        row = self._kinds[kind]
        if not is_before:
            return 0, 1.0, row, -1.0
        stays = 1 - self._gains(kind)[max(self.age - 1, 0)]
        return 2, 1 / stays, row, -1 / (stays * self._keep_of(kind))

    def news(self, kind: int, is_before: bool = False) -> Moments:
        """Return the mean and the covariance of c − u of a kind that is followed, before the period's fix."""
        i, f, j, g = self._of_news(kind, is_before)
        mean, covariance = self._mean, self._covariance
        (m_x, m_y), (u_x, u_y) = mean[i : i + 2].tolist(), mean[j : j + 2].tolist()
        (cxx, cxy), (_, cyy) = covariance[i : i + 2, i : i + 2].tolist()
        (dxx, dxy), (dyx, dyy) = covariance[i : i + 2, j : j + 2].tolist()
        (uxx, uxy), (_, uyy) = covariance[j : j + 2, j : j + 2].tolist()
        return (f * m_x + g * u_x, f * m_y + g * u_y), (
            f * f * cxx + 2 * f * g * dxx + g * g * uxx,
            f * f * cxy + f * g * (dxy + dyx) + g * g * uxy,
            f * f * cyy + 2 * f * g * dyy + g * g * uyy,
        )

    def take(self, kind: int, information: Five, is_before: bool = False) -> None:
        """Take information about c − u of a kind that is followed."""
        i, f, j, g = self._of_news(kind, is_before)
        (d_x, d_y), (s_xx, s_xy, s_yy) = self.news(kind, is_before)
        a, b, d, x, y = information
        # With T = Λ: G = (I + T S)⁻¹ T, and the mean moves by P Hᵀ (I + T S)⁻¹ (η − T d).
        m_xx, m_xy = 1 + a * s_xx + b * s_xy, a * s_xy + b * s_yy
        m_yx, m_yy = b * s_xx + d * s_xy, 1 + b * s_xy + d * s_yy
        determinant = m_xx * m_yy - m_xy * m_yx
        x, y = x - a * d_x - b * d_y, y - b * d_x - d * d_y
        x, y = (m_yy * x - m_xy * y) / determinant, (m_xx * y - m_yx * x) / determinant
        g_xx, g_xy, g_yy = (
            (m_yy * a - m_xy * b) / determinant,
            (m_yy * b - m_xy * d) / determinant,
            (m_xx * d - m_yx * b) / determinant,
        )
        covariance = self._covariance
        p = f * covariance[i : i + 2] + g * covariance[j : j + 2]
        self._mean += x * p[0] + y * p[1]
        self._covariance = covariance - _quadratic(p, g_xx, g_xy, g_yy)

    def absorb(self, belief: Information) -> None:
        """Replace what is known of c: what is known of all else given c stays."""
        x, y, p_xx, p_xy, p_yy = plain_moments(*belief.numbers)
        (c_x, c_y), (s_xx, s_xy, s_yy) = self.common
        a, b, d = inverted(s_xx, s_xy, s_yy)
        covariance = self._covariance
        slope_x = a * covariance[0] + b * covariance[1]
        slope_y = b * covariance[0] + d * covariance[1]
        self._mean += (x - c_x) * slope_x + (y - c_y) * slope_y
        slopes = np.stack([slope_x, slope_y])
        self._covariance = covariance + _quadratic(slopes, p_xx - s_xx, p_xy - s_xy, p_yy - s_yy)

    def fuse(self, pooled: Information, before: Mapping[int, Five], now: Mapping[int, Five]) -> Information:
        """Replace what is known of c by `pooled`, and take information of the last period and of this, by kind."""
        self.absorb(pooled)
        for is_before, each in ((True, before), (False, now)):
            for kind, information in each.items():
                self.take(kind, information, is_before)
        (x, y), covariance_m2 = self.common
        a, b, d = inverted(*covariance_m2)
        return Information((a, b, d, a * x + b * y, b * x + d * y))


def _quadratic(rows: Array, xx: float, xy: float, yy: float) -> Array:
    """Return Rᵀ M R of rows (2, n) and a symmetric matrix (xx, xy, yy), without BLAS."""
    first, second = rows
    left, right = xx * first + xy * second, xy * first + yy * second
    whole = first[:, None] * left + second[:, None] * right
    return np.asarray((whole + whole.T) / 2)


@lru_cache(maxsize=1024)
def _memory_given_c(
    gains: tuple[float, ...], keep: float, common: tuple[float, float, float]
) -> tuple[float, float, float]:
    """Return u's regression on c and on c one period before, and its variance given both, after periods of `gains`.

    `common` has the factor of c in a period, the variance that it adds, and that of c at the beginning.
    """
    keep_c, more_m2, start_m2 = common
    cc, cu, uu, bb, bc, ub = start_m2, 0.0, 0.0, start_m2, start_m2, 0.0
    for gain in gains:
        stays, takes = keep * (1 - gain), keep * gain
        bb, bc, ub = cc, keep_c * cc, stays * cu + takes * cc
        uu = stays * stays * uu + 2 * stays * takes * cu + takes * takes * cc
        cu = keep_c * (stays * cu + takes * cc)
        cc = keep_c * keep_c * cc + more_m2
    determinant = cc * bb - bc * bc
    if determinant <= 1e-12 * cc * bb:
        return 0.0, 0.0, 0.0
    by_c, by_b = (bb * cu - bc * ub) / determinant, (cc * ub - bc * cu) / determinant
    return by_c, by_b, max(uu - by_c * cu - by_b * ub, 0.0)


def summed(increments: Iterable[tuple[int, Five]]) -> dict[int, Five]:
    """Return the sums of information by kind."""
    sums: dict[int, Five] = {}
    for kind, (a, b, d, x, y) in increments:
        s_a, s_b, s_d, s_x, s_y = sums.get(kind, (0.0, 0.0, 0.0, 0.0, 0.0))
        sums[kind] = s_a + a, s_b + b, s_d + d, s_x + x, s_y + y
    return sums


class LaneExchange:
    """The increments of the vehicle `own`, whose fixes come each `period_s`, and those that it takes.

    has_joined: true once memories have begun, which they do as soon as somebody has a precise receiver.
    """

    def __init__(self, own: OwnVehicle, period_s: float) -> None:
        self._own = own
        self._period_s = period_s
        self._model = own.model  # without multipath, of which no fix has told yet
        model = self._model
        law = model.common_sigma_m, model.common_tau_s, model.common_walk_m, model.lateral_tau_s
        self._precise_m2 = precise_m2(*law, period_s)
        self._memory = CommonMemory(model, period_s)
        self.has_joined = False
        self._waits = False
        self._waited = 0
        self._lane: LaneFilter | None = None
        self._lane_of: OwnKalman | None = None
        self._beyond = 0.0
        self._begins = False
        self._since_older_s = math.inf

    # The own fix.

    def step(self, dt_s: float, fix: Observation | None) -> Five:
        """Advance by `dt_s` and take the own fix; returns its increment."""
        self._since_older_s += dt_s
        if self.has_joined:
            self._advance(max(1, round(dt_s / self._period_s)))
        increment = self._own.step(dt_s, fix)
        lane = self._own.lane
        if lane is None or not (self.has_joined or self._is_precise(lane, fix)):
            self._lane = self._lane_of = None
            is_silent = lane is None and self.has_joined and self._is_precise(None, fix)
            return NOTHING.numbers if is_silent else increment.numbers
        if not self.has_joined:
            self._waits = True
            return NOT_BEGUN
        if fix is None or not self._own.took_fix:
            self._miss()
            return NOTHING.numbers
        return self._filter_on(lane, fix).take(fix.position_m, self._memory.age)

    def _is_precise(self, lane: OwnKalman | None, fix: Observation | None) -> bool:
        if fix is None:
            return False
        noise_m2 = fix.white_covariance_m2
        across_m2 = float(noise_m2.diagonal().min()) if lane is None else lane.noise_across(noise_m2)
        return self._own.model is not self._model or across_m2 < self._precise_m2

    def _advance(self, periods: int) -> None:
        if self._begins:
            self._begins = False
            self._begin(0)
            return
        if periods > MAX_AGE:
            self._begin(MAX_AGE)
            return
        for period in range(periods):
            self._memory.predict()
            if self._lane:
                self._lane.predict()
                if period < periods - 1:
                    self._miss()

    def _miss(self) -> None:
        """Go on without a fix."""
        if self._lane:
            self._memory.follow(self._lane.kind, is_own=True)
            self._lane.miss(self._memory.news(self._lane.kind), self._memory.age)

    def _filter_on(self, lane: OwnKalman, fix: Observation) -> LaneFilter:
        """Return the filter on this lane, which begins if it is another lane, or another receiver."""
        kept, noise_m2, multipath = self._lane, fix.white_covariance_m2, self._multipath()
        if kept is None or lane is not self._lane_of or kept.differs(noise_m2) or kept.multipath != multipath:
            kept = LaneFilter((lane.point_m, lane.heading_rad), self._model, noise_m2, self._period_s, multipath)
            self._lane, self._lane_of = kept, lane
        self._memory.follow(kept.kind, is_own=True)
        kept.begin(self._memory.memory(kept.kind))
        return kept

    def _multipath(self) -> tuple[float, float]:
        """Variance and correlation time of the offset, relative to those without multipath."""
        own, lane = self._own.model, self._model
        return (own.lateral_sigma_m / lane.lateral_sigma_m) ** 2, own.lateral_tau_s / lane.lateral_tau_s

    # What others say.

    def _begin(self, age: int) -> None:
        """Begin again with memories of this age; what is known of c stays."""
        self._memory = CommonMemory(self._model, self._period_s, age)
        self.follow_own()
        self._lane = self._lane_of = None

    def join(self, increments: Sequence[Five], late: Sequence[Five] = ()) -> None:
        """Begin again with the age of the oldest memories that are heard; `late` ones are of the period before.

        A vehicle that has joined does so at most once in `MEMORY_S`: whoever claims an older memory in each period
        would stop the exchange.
        """
        ages = [round(increment[4]) for increment in increments if is_of_lane(increment)]
        then = [round(increment[4]) for increment in late if is_of_lane(increment)]
        ages += [age + 1 if age >= 0 else age for age in then]
        oldest = max(ages, default=-1)
        if self.has_joined:
            if oldest > self._memory.age and self._since_older_s >= MEMORY_S:
                self._since_older_s = 0.0
                self._begins = False
                self._begin(min(oldest, MAX_AGE))
            return
        self._waited += self._waits
        if oldest >= 0:
            self.has_joined = True
            self._begin(min(oldest, MAX_AGE))
        elif ages or self._waited >= JOINING_PERIODS:
            self.has_joined = self._begins = True

    def restart(self) -> None:
        """Begin again after the vehicle's filter has."""
        self._begin(self._memory.age)

    def can_use(self, increment: Five, is_before: bool) -> bool:
        """Tell whether an increment, of the period before if so, can be used.

        It is about c, or says something, is of a memory of the same age, and its kind is followed.
        """
        kind = kind_of_increment(increment)
        return kind == 0 or (self._is_of_age(increment, is_before) and self._memory.follow(kind))

    def _is_of_age(self, increment: Five, is_before: bool) -> bool:
        """Tell whether an increment of a lane says something, of a memory of the same age."""
        age, own = round(increment[4]), self._memory.age
        return any(increment[:2]) and (age == own - is_before or age == own == MAX_AGE)

    def news(self, kind: int, is_before: bool) -> Moments:
        """Return the mean and the covariance of what increments of a kind are about."""
        return self._memory.news(kind, is_before)

    def follow_own(self) -> None:
        """Know of c what the vehicle's filter knows."""
        self._memory.absorb(Information.of(*self._own.belief))

    def absorb(
        self, pooled: Information, now: Iterable[Five], before: Sequence[Five], heard: int, weight: float
    ) -> None:
        """Replace what is known of c by `pooled`, and increments of lanes, of this period and of the one before.

        Those of this period came from `heard` vehicles; `weight` is the weight of other vehicles' priors.
        """
        before = [each for each in before if self._is_of_age(each, True)]
        beyond = min(1.0, len(before) / heard) if heard else 0.0
        self._beyond += SMOOTHING * (beyond - self._beyond)
        factor = 1 + UNDERSTATED * self._beyond * min(1.0, weight)
        belief = self._memory.fuse(pooled, self._sums(before, factor, True), self._sums(now, factor, False))
        self._own.absorb(belief, is_of_lanes=True)

    def _sums(self, increments: Iterable[Five], factor: float, is_before: bool) -> dict[int, Five]:
        """Return the sums by kind of those increments that can be used."""
        usable = [each for each in increments if self.can_use(each, is_before)]
        sums = summed((kind_of_increment(each), information_of(each)) for each in usable)
        return {
            kind: (factor * a, factor * b, factor * d, factor * x, factor * y)
            for kind, (a, b, d, x, y) in sums.items()
        }
