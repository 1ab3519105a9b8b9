"""Plausibility of what others say about the common error: whether it is believed, and how much it may weigh.

A liar's increment or prior is bounded by what the vehicle itself knows, and compared with what it believes. One
period's lie may be small; so the deviations of each origin are summed up as well, and decay over seconds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vnet.cmm.information import Information
from vnet.types import Array

INCREMENT_FACTOR = 1.5
"""Largest trace of an increment, relative to one's own: what it says more is scaled down."""
PRIOR_FACTOR = 2.0
"""Largest trace of a prior's matrix, relative to one's own."""
INCREMENT_GATE = 16.0
"""Largest squared deviation of an increment, or of an origin's sum, from what is believed."""
PRIOR_GATE = 4.0
"""Largest squared deviation of a prior's mean from one's own."""
SPREAD_GATE = 3.5
"""Largest distance of a prior's mean from the median of all, in deviations of their spread."""
SPREAD_FLOOR_M = 0.05
"""Distance (m) from the median that is always allowed."""
MAJORITY = 4
"""Least number of priors or increments of which a majority can be told."""
MEMORY_S = 5.0
"""Time (s) in which an origin's sum decays."""
RAYLEIGH_MEDIAN = 1.1774
"""Median length of a normal vector in the plane, in deviations an axis."""
MAX_ORIGINS = 1024
"""Number of origins whose sums are kept: names cost an attacker nothing."""


_ENTRIES = np.array([0, 1, 1, 2])


def matrices(information: Array) -> Array:
    """Return the matrices (n, 2, 2) of information (n, 5): (xx, xy, yy) and the vector."""
    return information.take(_ENTRIES, axis=1).reshape(-1, 2, 2)


def moments(information: Array) -> tuple[Array, Array]:
    """Return means (n, 2) and covariances (n, 2, 2) of beliefs (n, 5)."""
    a, b, d, x, y = np.ascontiguousarray(information.T)
    entries = np.stack([d, -b, a]) / (a * d - b * b)
    variance_x, covariance, variance_y = entries
    mean = np.stack([variance_x * x + covariance * y, covariance * x + variance_y * y], axis=1)
    return mean, matrices(entries.T)


def prior_moments(a: float, b: float, d: float, x: float, y: float) -> tuple[float, float, float, float, float]:
    """Return the mean (x, y) in m and the covariance (xx, xy, yy) in m² of one belief, in plain numbers."""
    determinant = a * d - b * b
    variance_x, covariance, variance_y = d / determinant, -b / determinant, a / determinant
    mean_x, mean_y = variance_x * x + covariance * y, covariance * x + variance_y * y
    return mean_x, mean_y, variance_x, covariance, variance_y


def scaled_down(information: Array, largest_trace: float) -> Array:
    """Return information (n, 5) with traces of at most `largest_trace`; means stay."""
    trace = information[:, 0] + information[:, 2]
    if not len(trace) or trace.max() <= largest_trace:
        return information
    return information * np.minimum(1.0, largest_trace / np.maximum(trace, 1e-300))[:, None]


def deviation(information: Array, mean_m: Array, covariance_m2: Array, noise: Array) -> Array:
    """Return rᵀ (D + Λ P Λ)⁻¹ r with r = η − Λ x for information (n, 5) about c ~ N(x, P): (n,).

    `noise` (n, 3) is the covariance D of η given c, (xx, xy, yy); that of one increment is its Λ.
    """
    (mean_x, mean_y), ((p, q), (_, r)) = mean_m.tolist(), covariance_m2.tolist()
    # With P = C Cᵀ, one product for Λ C, with entries (u_x, v_x; u_y, v_y), and r: Λ P Λ = (Λ C)(Λ C)ᵀ.
    c_xx = math.sqrt(p)
    c_yx = q / c_xx
    c_yy = math.sqrt(max(r - c_yx * c_yx, 0.0))
    factors = np.array(
        [
            [c_xx, c_yx, 0.0, 0.0, 0.0],
            [0.0, c_xx, c_yx, 0.0, 0.0],
            [0.0, c_yy, 0.0, 0.0, 0.0],
            [0.0, 0.0, c_yy, 0.0, 0.0],
            [-mean_x, -mean_y, 0.0, 1.0, 0.0],
            [0.0, -mean_x, -mean_y, 0.0, 1.0],
        ]
    )
    numbers = factors.dot(information.T)
    squares = numbers * numbers
    u_x, u_y, v_x, v_y, off_x, off_y = numbers
    total = squares[:2] + squares[2:4] + noise.T[::2]
    total_xy = noise[:, 1] + u_x * u_y + v_x * v_y
    # A lane says nothing along itself: rounding there is not counted.
    total += 1e-4 * (total[0] + total[1]) + 1e-9
    total_x, total_y = total
    squared = total_y * squares[4] - 2 * total_xy * off_x * off_y + total_x * squares[5]
    return np.asarray(squared / (total_x * total_y - total_xy * total_xy))


def priors_agree(
    mean_m: Array, covariance_m2: Array, own_mean_m: Array, own_covariance_m2: Array
) -> NDArray[np.bool_]:
    """Tell which priors with means (n, 2) and covariances (n, 2, 2) are near one's own."""
    total, off = covariance_m2 + own_covariance_m2, mean_m - own_mean_m
    a, b, d, x, y = total[:, 0, 0], total[:, 0, 1], total[:, 1, 1], off[:, 0], off[:, 1]
    return np.asarray((d * x * x - 2 * b * x * y + a * y * y) < PRIOR_GATE * (a * d - b * b))


def spread_limit_m(means_m: Array) -> tuple[Array, float]:
    """Return the median (2,) of means (n, 2), and the distance from it beyond which one of them is an outlier.

    Estimates that are pooled in each period differ by less than each is uncertain, because they err together: who
    stays within its uncertainty, but always on one side, would draw all others along.
    """
    median_m = _median(means_m)
    if len(means_m) < MAJORITY:
        return median_m, np.inf
    off_m = means_m - median_m
    distance_m = float(_median(np.hypot(off_m[:, 0], off_m[:, 1])))
    return median_m, SPREAD_FLOOR_M + SPREAD_GATE * distance_m / RAYLEIGH_MEDIAN


def _median(values: Array) -> Array:
    """Return the median of the rows of `values` (n, …): numpy's takes six times as long where they are few."""
    ordered, count = np.sort(values, axis=0), len(values)
    return np.asarray((ordered[(count - 1) // 2] + ordered[count // 2]) / 2)


def unless_most_disagree(agrees: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return all true where most are false: then it is what is believed that is wrong, and not they."""
    if len(agrees) >= MAJORITY - 1 and 2 * np.count_nonzero(agrees) < len(agrees):
        return np.ones_like(agrees)
    return agrees


class Origins:
    """The decaying sums of what each origin has said: increments, and the covariance of their noise."""

    def __init__(self) -> None:
        self._row: dict[int, int] = {}
        self._sums = np.zeros((0, 8))
        self._time_s = np.zeros(0)

    def agree(
        self, codes: Sequence[int], increments: Array, belief: tuple[Array, Array], now_s: float
    ) -> NDArray[np.bool_]:
        """Tell which increments (n, 5) of the origins `codes` agree with the belief (x, P), singly and in sum.

        An increment that does not is summed up all the same: who has lied is believed again when it has decayed.
        What was said of an earlier c is compared with the present one, because it moves little in seconds.
        """
        if not codes:
            return np.zeros(0, dtype=np.bool_)
        rows, count = self._rows(codes, now_s), len(codes)
        keep = np.exp((self._time_s.take(rows) - now_s) / MEMORY_S)[:, None]
        sums = self._sums.take(rows, axis=0)
        sums *= keep
        sums[:, 5:] *= keep
        said = np.empty((2 * count, 8))  # each increment with its noise, then each sum
        said[:count, :5], said[:count, 5:] = increments, increments[:, :3]
        np.add(sums, said[:count], out=said[count:])
        self._sums[rows], self._time_s[rows] = said[count:], now_s
        near = deviation(said[:, :5], *belief, said[:, 5:]) < INCREMENT_GATE
        return np.asarray(near[:count] & near[count:])

    def _rows(self, codes: Sequence[int], now_s: float) -> NDArray[np.intp]:
        """Return the rows of origins; new ones are added, and old ones forgotten when there are too many."""
        new = [code for code in codes if code not in self._row]
        if new:
            if len(self._row) + len(new) > MAX_ORIGINS:
                kept = [code for code, row in self._row.items() if now_s - self._time_s[row] < MEMORY_S]
                kept = kept[-(MAX_ORIGINS // 2) :]
                rows = [self._row[code] for code in kept]
                self._row = {code: row for row, code in enumerate(kept)}
                self._sums, self._time_s = self._sums[rows], self._time_s[rows]
                new = [code for code in codes if code not in self._row]
            self._row |= {code: len(self._row) + place for place, code in enumerate(new)}
            self._sums = np.vstack([self._sums, np.zeros((len(new), 8))])
            self._time_s = np.append(self._time_s, np.full(len(new), now_s))
        return np.array([self._row[code] for code in codes], dtype=np.intp)


def median_belief(priors: Array) -> Information:
    """Return a belief at the coordinate-wise median of the means of `priors` (n, 5), as wide as the widest."""
    means, covariance = moments(priors)
    mean = np.median(means, axis=0)
    variance = float(np.max(covariance[:, 0, 0] + covariance[:, 1, 1]))
    return Information.of(mean, variance * np.eye(2))
