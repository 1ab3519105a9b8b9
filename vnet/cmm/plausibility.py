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
"""Largest squared deviation of an increment from what is believed."""
SUM_GATE = 4.0
"""Largest squared deviation of an origin's sum of many increments: the errors of what was believed partly cancel,
and one honest sum in ten thousand deviates by 3.5 (N2) to 4.5 (N1)."""
PRIOR_GATE = 4.0
"""Largest squared deviation of a prior's mean from one's own."""
SPREAD_GATE = 3.5
"""Largest distance of a prior's mean from the median of all, in deviations of their spread."""
MANY = 90.0
"""Number of increments in a sum, less what has decayed, from which on `SUM_GATE` applies; for one it is
`INCREMENT_GATE`."""
LEAN_LIMIT = 0.1
"""Largest mean distance of an origin's priors from the median of all, in deviations that both claim: in honest runs
one in a hundred has 0.07 (N1), 0.10 (N2), 0.18 (N3), where a few pass on what the others cannot know."""
SELF_SHARE = 0.3
"""Weight that a vehicle gives to its own prior before the others': what draws all along draws more slowly."""
SPREAD_FLOOR_M = 0.05
"""Distance (m) from the median that is always allowed."""
MAJORITY = 4
"""Least number of priors or increments of which a majority can be told."""
MEMORY_S = 10.0
"""Time (s) in which an origin's sums decay."""
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
    if not len(trace) or np.maximum.reduce(trace) <= largest_trace:
        return information
    return information * np.minimum(1.0, largest_trace / np.maximum(trace, 1e-300))[:, None]


def deviation(information: Array, mean_m: Array, covariance_m2: Array) -> Array:
    """Return rᵀ (Λ + Λ P Λ)⁻¹ r with r = η − Λ x for information (n, 5) about c ~ N(x, P): (n,)."""
    return _squared(_compared(information, mean_m, covariance_m2))


_LAYOUT = np.array(
    [
        [2, 3, 0, 0, 0],
        [0, 2, 3, 0, 0],
        [0, 4, 0, 0, 0],
        [0, 0, 4, 0, 0],
        [5, 6, 0, 1, 0],
        [0, 5, 6, 0, 1],
        [1, 0, 0, 0, 0],
        [0, 1, 0, 0, 0],
        [0, 0, 1, 0, 0],
    ]
)
"""Indices into 0, 1, C (xx, yx, yy), −x: a row for each term of `_compared`, a column for each number."""


def _compared(information: Array, mean_m: Array, covariance_m2: Array) -> Array:
    """Return the terms (9, n) of the deviation of information (n, 5) from c ~ N(x, P), which may be summed up.

    With P = C Cᵀ these are Λ C by columns, r = η − Λ x, and Λ (xx, xy, yy), the covariance of r given c.
    """
    (mean_x, mean_y), ((p, q), (_, r)) = mean_m.tolist(), covariance_m2.tolist()
    c_xx = math.sqrt(p)
    c_yx = q / c_xx
    c_yy = math.sqrt(max(r - c_yx * c_yx, 0.0))
    factors = np.array([0.0, 1.0, c_xx, c_yx, c_yy, -mean_x, -mean_y]).take(_LAYOUT)
    return np.asarray(factors.dot(information.T))


_LEFT, _RIGHT = np.array([0, 0, 1, 2, 2, 3, 4, 4, 5]), np.array([0, 1, 1, 2, 3, 3, 4, 5, 5])
"""Rows of the factors of the products xx, xy, yy of both columns of Λ C and of r."""


def _squared(compared: Array) -> Array:
    """Return the squared deviations (…, n) of terms (9, …, n)."""
    products = compared.take(_LEFT, axis=0)
    products *= compared.take(_RIGHT, axis=0)
    total = products[:3]
    total += products[3:6]
    total += compared[6:9]
    # A lane says nothing along itself: rounding there is not counted.
    total[::2] += 1e-4 * (total[0] + total[2]) + 1e-9
    x, xy, y = total
    squared = products[6:]
    squared *= total[::-1]
    squared[0] += squared[2]
    squared[0] -= 2 * squared[1]
    return np.asarray(squared[0] / (x * y - xy * xy))


def priors_agree(mean_m: Array, variance_m2: Array, own_mean_m: Array, own_variance_m2: Array) -> NDArray[np.bool_]:
    """Tell which priors with means (n, 2) and covariances (n, 3), entries (xx, xy, yy), are near one's own."""
    total, off = (variance_m2 + own_variance_m2).T, (mean_m - own_mean_m).T
    (a, b, d), (x, y) = total, off
    # Deviations that are small even where the least variance is: those of nearly all.
    squares, determinant = off * off, a * d - b * b
    near = (squares[0] + squares[1]) * (a + d) < PRIOR_GATE * determinant
    if np.count_nonzero(near) == len(near):
        return np.asarray(near)
    return np.asarray((d * x * x - 2 * b * x * y + a * y * y) < PRIOR_GATE * (a * d - b * b))


def spread_limit_m(means_m: Array) -> tuple[Array, float]:
    """Return the median (2,) of means (n, 2), and the distance from it within which they are taken as they are.

    Estimates that are pooled in each period differ by less than each is uncertain, because they err together: who
    stays within its uncertainty, but always on one side, would draw all others along.
    """
    median_m = _median(means_m)
    if len(means_m) < MAJORITY:
        return median_m, np.inf
    off_m = means_m - median_m
    distance_m = float(_median(np.hypot(off_m[:, 0], off_m[:, 1])))
    return median_m, SPREAD_FLOOR_M + SPREAD_GATE * distance_m / RAYLEIGH_MEDIAN


def cut_to(off_m: Array, limit_m: float) -> Array:
    """Return offsets (n, 2) with lengths of at most `limit_m`."""
    squared = off_m[:, 0] ** 2 + off_m[:, 1] ** 2
    if max(squared.tolist()) <= limit_m**2:
        return off_m
    return np.asarray(off_m * np.minimum(1.0, limit_m / np.sqrt(np.maximum(squared, 1e-300)))[:, None])


def _median(values: Array) -> Array:
    """Return the median of the rows of `values` (n, …): numpy's takes six times as long where they are few."""
    ordered, count = values.copy(), len(values)
    ordered.sort(axis=0)
    return np.asarray((ordered[(count - 1) // 2] + ordered[count // 2]) / 2)


def unless_most_disagree(agrees: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return all true where most are false: then it is what is believed that is wrong, and not they."""
    if len(agrees) >= MAJORITY - 1 and 2 * np.count_nonzero(agrees) < len(agrees):
        return np.ones_like(agrees)
    return agrees


class Memory:
    """Numbers of each origin, `size` of them, with the time at which they were stored."""

    def __init__(self, size: int) -> None:
        self._row: dict[int, int] = {}
        self._numbers = np.zeros((size + 1, 0))  # the last is the time

    def __len__(self) -> int:
        """Number of origins."""
        return len(self._row)

    def recall(self, codes: Sequence[int], now_s: float) -> tuple[NDArray[np.intp], Array, Array]:
        """Return the rows (n,) of origins, their numbers (size, n), and e^(−age / `MEMORY_S`) of these (n,).

        New origins are added with zeros, and old ones forgotten when there are too many.
        """
        known = list(map(self._row.get, codes))
        if None in known:
            self._add([code for code in codes if code not in self._row], now_s)
            known = list(map(self._row.get, codes))
        rows = np.array(known, dtype=np.intp)
        numbers = self._numbers.take(rows, axis=1)
        return rows, numbers[:-1], np.exp((numbers[-1] - now_s) / MEMORY_S)

    def store(self, rows: NDArray[np.intp], numbers: Array, now_s: float) -> None:
        """Replace the numbers (size, n) of the rows (n,)."""
        self._numbers[:-1, rows], self._numbers[-1, rows] = numbers, now_s

    def _add(self, new: list[int], now_s: float) -> None:
        if len(self._row) + len(new) > MAX_ORIGINS:
            kept = [code for code, row in self._row.items() if now_s - self._numbers[-1, row] < MEMORY_S]
            kept = kept[-(MAX_ORIGINS // 2) :]
            rows = [self._row[code] for code in kept]
            self._row = {code: row for row, code in enumerate(kept)}
            self._numbers = self._numbers[:, rows]
        first = self._numbers.shape[1]
        self._row |= {code: first + index for index, code in enumerate(new)}
        more = np.zeros((len(self._numbers), len(new)))
        more[-1] = now_s
        self._numbers = np.hstack([self._numbers, more])


_LEAST_GATES = np.array([[INCREMENT_GATE], [SUM_GATE]])
"""Gates of increments by themselves, and of sums of many."""


class Origins:
    """Decaying sums of the deviations of each origin: of its increments, and of its priors."""

    def __init__(self) -> None:
        self._increments = Memory(10)
        self._priors = Memory(2)

    def agree(
        self, codes: Sequence[int], increments: Array, belief: tuple[Array, Array], now_s: float
    ) -> NDArray[np.bool_]:
        """Tell which increments (n, 5) of the origins `codes` agree with the belief (x, P), singly and in sum.

        An increment that does not is summed up all the same: who has lied is believed again when it has decayed.
        Each is compared with what was believed when it came: c itself moves by half a metre in the sum's memory.
        """
        if not codes:
            return np.zeros(0, dtype=np.bool_)
        rows, sums, keep = self._increments.recall(codes, now_s)
        sums *= keep
        sums[6:9] *= keep
        said = np.empty((10, 2, len(codes)))  # each by itself, then the sums; the last row counts
        said[:9, 0] = _compared(increments, *belief)
        said[9, 0] = 1.0
        np.add(sums, said[:, 0], out=said[:, 1])
        self._increments.store(rows, said[:, 1], now_s)
        squared = _squared(said[:9])
        good = squared < _LEAST_GATES
        if np.count_nonzero(good) < good.size:  # a sum of few may deviate by more
            limit = INCREMENT_GATE + (SUM_GATE - INCREMENT_GATE) * np.minimum(1.0, said[9, 1] / MANY)
            good[1] = squared[1] < limit
        return np.asarray(good[0] & good[1])

    def without_lean(
        self, codes: Sequence[int], off_m: Array, variance_m2: Array, now_s: float
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Return the deviations (n, 2) of the priors of `codes` from the median, less what is always to one side.

        The second value (n,) tells which priors lean so.

        `variance_m2` (n, 3), entries (xx, xy, yy), is how far each may be off. Deviations of the honest change
        sides in a second; a mean of more than `LEAN_LIMIT` deviations is taken off.
        """
        root_xx = np.sqrt(variance_m2[:, 0])
        root_yx = variance_m2[:, 1] / root_xx
        root_yy = np.sqrt(variance_m2[:, 2] - root_yx * root_yx)
        rows, lean, keep = self._priors.recall(codes, now_s)
        x = off_m[:, 0] / root_xx
        now = np.array([x, (off_m[:, 1] - root_yx * x) / root_yy])
        lean = now + keep * (lean - now)
        self._priors.store(rows, lean, now_s)
        squared = lean[0] * lean[0] + lean[1] * lean[1]
        leans = squared > LEAN_LIMIT**2
        if not np.count_nonzero(leans):
            return off_m, leans
        x, y = lean * np.maximum(0.0, 1 - LEAN_LIMIT / np.sqrt(np.maximum(squared, 1e-300)))
        return off_m - np.stack([root_xx * x, root_yx * x + root_yy * y], axis=1), leans


def median_belief(priors: Array) -> Information:
    """Return a belief at the coordinate-wise median of the means of `priors` (n, 5), as wide as the widest."""
    means, covariance = moments(priors)
    mean = np.median(means, axis=0)
    variance = float(np.max(covariance[:, 0, 0] + covariance[:, 1, 1]))
    return Information.of(mean, variance * np.eye(2))
