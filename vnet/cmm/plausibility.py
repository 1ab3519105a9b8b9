"""Plausibility of what others say about the common error: whether it is believed, and how much it may weigh.

A liar's increment or prior is bounded by what the vehicle itself knows, and compared with what it believes. One
period's lie may be small; so the deviations of each origin are summed up as well, and decay over seconds.
"""

from __future__ import annotations

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
MEMORY_S = 5.0
"""Time (s) in which an origin's sum decays."""
MAX_ORIGINS = 1024
"""Number of origins whose sums are kept: names cost an attacker nothing."""


_ENTRIES = np.array([0, 1, 1, 2])


def matrices(information: Array) -> Array:
    """Return the matrices (n, 2, 2) of information (n, 5): (xx, xy, yy) and the vector."""
    return information.take(_ENTRIES, axis=1).reshape(-1, 2, 2)


def inverses(matrix: Array) -> Array:
    """Return the inverses of symmetric matrices (n, 2, 2)."""
    a, b, d = matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 1]
    determinant = a * d - b * b
    inverse = np.empty_like(matrix)
    inverse[:, 0, 0], inverse[:, 1, 1] = d / determinant, a / determinant
    inverse[:, 0, 1] = inverse[:, 1, 0] = -b / determinant
    return inverse


def scaled_down(information: Array, largest_trace: float) -> Array:
    """Return information (n, 5) with traces of at most `largest_trace`; means stay."""
    trace = information[:, 0] + information[:, 2]
    return information * np.minimum(1.0, largest_trace / np.maximum(trace, 1e-300))[:, None]


def deviation(information: Array, mean_m: Array, covariance_m2: Array, noise: Array) -> Array:
    """Return rᵀ (D + Λ P Λ)⁻¹ r with r = η − Λ x for information (n, 5) about c ~ N(x, P): (n,).

    `noise` (n, 3) is the covariance D of η given c, (xx, xy, yy); that of one increment is its Λ.
    """
    matrix = matrices(information)
    total = matrices(noise) + matrix @ covariance_m2 @ matrix
    off = information[:, 3:] - matrix @ mean_m
    # A lane says nothing along itself: rounding there is not counted.
    slack = 1e-4 * (total[:, 0, 0] + total[:, 1, 1]) + 1e-9
    a, b, d = total[:, 0, 0] + slack, total[:, 0, 1], total[:, 1, 1] + slack
    x, y = off[:, 0], off[:, 1]
    return np.asarray((d * x * x - 2 * b * x * y + a * y * y) / (a * d - b * b))


def priors_agree(
    mean_m: Array, covariance_m2: Array, own_mean_m: Array, own_covariance_m2: Array
) -> NDArray[np.bool_]:
    """Tell which priors with means (n, 2) and covariances (n, 2, 2) are near one's own."""
    total, off = covariance_m2 + own_covariance_m2, mean_m - own_mean_m
    a, b, d, x, y = total[:, 0, 0], total[:, 0, 1], total[:, 1, 1], off[:, 0], off[:, 1]
    return np.asarray((d * x * x - 2 * b * x * y + a * y * y) < PRIOR_GATE * (a * d - b * b))


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
        rows = self._rows(codes, now_s)
        keep = np.exp((self._time_s[rows] - now_s) / MEMORY_S)[:, None]
        sums = self._sums[rows]
        sums *= np.hstack([np.tile(keep, 5), np.tile(keep * keep, 3)])
        sums[:, :5] += increments
        sums[:, 5:] += increments[:, :3]
        self._sums[rows], self._time_s[rows] = sums, now_s
        both = np.concatenate([increments, sums[:, :5]])
        noise = np.concatenate([increments[:, :3], sums[:, 5:]])
        near = deviation(both, *belief, noise) < INCREMENT_GATE
        return np.asarray(near[: len(codes)] & near[len(codes) :])

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
    covariance = inverses(matrices(priors))
    mean = np.median(np.einsum("nij,nj->ni", covariance, priors[:, 3:]), axis=0)
    variance = float(np.max(covariance[:, 0, 0] + covariance[:, 1, 1]))
    return Information.of(mean, variance * np.eye(2))
