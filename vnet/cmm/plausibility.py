"""Plausibility of what others say about the common error: whether it is believed, and how much it may weigh.

A liar's increment or prior is bounded by what the vehicle itself knows, and compared with what it believes. One
period's lie may be small; so the deviations of each origin are summed up as well, and decay over seconds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vnet.cmm.information import Five, Information, Three
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


Belief = tuple[Sequence[float], Three]
"""Mean (x, y) in m and covariance (xx, xy, yy) in m² of what is believed about c."""

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


def scaled_down(information: Array, largest_trace: float) -> Array:
    """Return information (n, 5) with traces of at most `largest_trace`; means stay."""
    trace = information[:, 0] + information[:, 2]
    if max(trace.tolist(), default=0.0) <= largest_trace:
        return information
    return information * np.minimum(1.0, largest_trace / np.maximum(trace, 1e-300))[:, None]


def deviation(information: Array, belief: Belief) -> Array:
    """Return rᵀ (Λ + Λ P Λ)⁻¹ r with r = η − Λ x for information (n, 5) about c ~ N(x, P): (n,)."""
    return _squared(_compared(information, belief))


_LAYOUT = np.array(
    [
        [2, 3, 0, 0, 0],
        [0, 2, 3, 0, 0],
        [0, 4, 0, 0, 0],
        [0, 0, 4, 0, 0],
        [5, 6, 0, 1, 0],
        [0, 5, 6, 0, 1],
        [7, 0, 0, 0, 0],
        [0, 7, 0, 0, 0],
        [0, 0, 7, 0, 0],
    ]
)
"""Indices into 0, 1, C (xx, yx, yy), −x, 1: a row for each term of `_compared`, a column for each number."""


def _compared(information: Array, belief: Belief, weight: float = 1.0) -> Array:
    """Return the terms (9, n) of the deviation of information (n, 5) from c ~ N(x, P), which may be summed up.

    With P = C Cᵀ these are Λ C by columns and r = η − Λ x, times `weight`, and Λ (xx, xy, yy), which is the
    covariance of r given c, times its square. The deviation is the same for any weight.
    """
    (mean_x, mean_y), (p, q, r) = belief
    c_xx = math.sqrt(p)
    c_yx = q / c_xx
    c_yy = math.sqrt(max(r - c_yx * c_yx, 0.0))
    factors = [0.0, 1.0, c_xx, c_yx, c_yy, -mean_x, -mean_y, weight]
    return np.asarray((weight * np.array(factors)).take(_LAYOUT).dot(information.T))


_LEFT, _RIGHT = np.array([0, 0, 1, 2, 2, 3, 4, 4, 5]), np.array([0, 1, 1, 2, 3, 3, 4, 5, 5])
"""Rows of the factors of the products xx, xy, yy of both columns of Λ C and of r."""
_OF_PRODUCTS = np.array(
    [
        [1e-4, 0, 1 + 1e-4, 1e-4, 0, 1 + 1e-4, 0, 0, 0],
        [0, 1, 0, 0, 1, 0, 0, 0, 0],
        [1 + 1e-4, 0, 1e-4, 1 + 1e-4, 0, 1e-4, 0, 0, 0],
        [0, 0, 0, 0, 0, 0, 1, 0, 0],
        [0, 0, 0, 0, 0, 0, 0, -2, 0],
        [0, 0, 0, 0, 0, 0, 0, 0, 1],
    ]
)
_OF_INFORMATION = np.array([[1e-4, 0, 1 + 1e-4], [0, 1, 0], [1 + 1e-4, 0, 1e-4]])
"""S = Λ + Λ P Λ (yy, xy, xx) and r rᵀ (xx, −2 xy, yy) as sums of the products and of Λ. A lane says nothing along
itself: a ten thousandth of the trace is added to S, so that rounding there is not counted."""
_TINY = 1e-300
"""Least squared deviation: that of an increment which says nothing is 0."""
_FLOOR = np.array([[1e-9], [0.0], [1e-9]])
_ADJUGATE, _SQUARES = np.array([0, 1, 2, 0, 1]), np.array([3, 4, 5, 2, 1])
_RATIO = np.array([[1.0, 1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0, -1.0]])
"""rᵀ adj(S) r and det S as sums of products of these rows."""


def _squared(compared: Array) -> Array:
    """Return the squared deviations rᵀ S⁻¹ r (m,) of terms (9, m)."""
    products = compared.take(_LEFT, axis=0)
    products *= compared.take(_RIGHT, axis=0)
    sums = _OF_PRODUCTS.dot(products)
    adjugate = sums[:3]
    adjugate += _OF_INFORMATION.dot(compared[6:9])
    adjugate += _FLOOR
    products = sums.take(_ADJUGATE, axis=0)
    products *= sums.take(_SQUARES, axis=0)
    squared, determinant = _RATIO.dot(products)
    return np.asarray(squared / determinant)


def priors_agree(priors: Sequence[Five], own: Five) -> list[bool]:
    """Tell which priors are near one's own: rᵀ S⁻¹ r < `PRIOR_GATE`, r being the difference of the means.

    S is the sum of both covariances. Each is the mean (x, y) and the covariance (xx, xy, yy).
    """
    own_x, own_y, own_xx, own_xy, own_yy = own
    agrees = []
    for mean_x, mean_y, xx, xy, yy in priors:
        x, y = mean_x - own_x, mean_y - own_y
        a, b, d = xx + own_xx, xy + own_xy, yy + own_yy
        agrees.append(d * x * x - 2 * b * x * y + a * y * y < PRIOR_GATE * (a * d - b * b))
    return agrees


def spread_limit_m(priors: Sequence[Five]) -> tuple[tuple[float, float], float]:
    """Return the median (x, y) of the means, and the distance from it within which they are taken as they are.

    Estimates that are pooled in each period differ by less than each is uncertain, because they err together: who
    stays within its uncertainty, but always on one side, would draw all others along.
    """
    x, y = _median([prior[0] for prior in priors]), _median([prior[1] for prior in priors])
    if len(priors) < MAJORITY:
        return (x, y), math.inf
    distance_m = _median([math.hypot(prior[0] - x, prior[1] - y) for prior in priors])
    return (x, y), SPREAD_FLOOR_M + SPREAD_GATE * distance_m / RAYLEIGH_MEDIAN


def _median(values: list[float]) -> float:
    values.sort()
    return (values[(len(values) - 1) // 2] + values[len(values) // 2]) / 2


def cut_to(off_m: list[tuple[float, float]], limit_m: float) -> list[tuple[float, float]]:
    """Return offsets (x, y) with lengths of at most `limit_m`."""
    length_m = [math.hypot(x, y) for x, y in off_m]
    if max(length_m) <= limit_m:
        return off_m
    share = [min(1.0, limit_m / max(length, 1e-300)) for length in length_m]
    return [(x * part, y * part) for (x, y), part in zip(off_m, share, strict=True)]


def unless_most_disagree(shares: list[float]) -> list[float]:
    """Return 1 for all where most are less: then it is what is believed that is wrong, and not they."""
    if len(shares) >= MAJORITY - 1 and 2 * shares.count(1.0) < len(shares):
        return [1.0] * len(shares)
    return shares


class Sums:
    """Sums of the terms of each origin's increments, that decay in `MEMORY_S`, and of their number.

    In place of a sum that decays, what is added is given a weight that grows: deviations are the same, and nothing
    is to be done for those who are silent. Once in `MEMORY_S` all sums are reduced to a weight of 1.
    """

    def __init__(self) -> None:
        self._row: dict[int, int] = {}
        self._numbers = np.zeros((11, 0))  # terms, weights, and the time at which they were stored
        self._since_s = 0.0

    def __len__(self) -> int:
        """Number of origins."""
        return len(self._row)

    def weight(self, now_s: float) -> float:
        """Return the weight of what is added now."""
        weight = math.exp((now_s - self._since_s) / MEMORY_S)
        if weight <= math.e:
            return weight
        self._numbers[:10] /= weight
        self._numbers[6:9] /= weight
        self._since_s = now_s
        return 1.0

    def recall(self, codes: Sequence[int], now_s: float) -> tuple[NDArray[np.intp], Array]:
        """Return the rows (n,) of origins, and their numbers (11, n).

        New origins are added with zeros, and old ones forgotten when there are too many.
        """
        known = list(map(self._row.get, codes))
        if None in known:
            self._add([code for code in codes if code not in self._row], now_s)
            known = list(map(self._row.get, codes))
        rows = np.array(known, dtype=np.intp)
        return rows, self._numbers.take(rows, axis=1)

    def store(self, rows: NDArray[np.intp], numbers: Array) -> None:
        """Replace the numbers (11, n) of the rows (n,)."""
        self._numbers[:, rows] = numbers

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


def _sum_gate(count: float) -> float:
    """Return the largest squared deviation of a sum of so many increments."""
    return INCREMENT_GATE + (SUM_GATE - INCREMENT_GATE) * min(1.0, count / MANY)


class Origins:
    """Decaying sums of the deviations of each origin: of its increments, and of its priors.

    drops_outliers: whether increments beyond the gates are dropped, or weighed.
    """

    def __init__(self, drops_outliers: bool = True) -> None:
        self._drops_outliers = drops_outliers
        self._increments = Sums()
        self._leans: dict[int, tuple[float, float, float]] = {}  # mean deviation (x, y) and its time

    def shares(self, codes: Sequence[int], increments: Array, belief: Belief, now_s: float) -> list[float]:
        """Return the share (n,) of each increment (n, 5) of the origins `codes` that is used.

        It is 1 within the gates, for the increment by itself and for the origin's sum. Beyond it is 0, or, if
        outliers are weighed, the gate relative to the squared deviation: an M-estimator whose influence descends.
        What is beyond is summed up all the same: who has lied is believed again when it has decayed. Each is
        compared with the belief (x, P) when it came: c itself moves by half a metre in the sum's memory.
        """
        if not codes:
            return []
        weight = self._increments.weight(now_s)
        rows, sums = self._increments.recall(codes, now_s)
        said = np.empty((11, 2, len(codes)))  # each by itself, then the sums: terms, weights and the time
        said[:9, 0] = _compared(increments, belief, weight)
        said[9, 0], said[10, 1] = weight, now_s
        np.add(sums[:10], said[:10, 0], out=said[:10, 1])
        self._increments.store(rows, said[:, 1])
        alone, in_sum = _squared(said[:9].reshape(9, -1)).reshape(2, -1).tolist()
        if max(alone) < INCREMENT_GATE and max(in_sum) < SUM_GATE:
            return [1.0] * len(codes)
        each = zip(alone, in_sum, (said[9, 1] / weight).tolist(), strict=True)
        shares = [
            min(INCREMENT_GATE / max(one, _TINY), _sum_gate(count) / max(many, _TINY)) for one, many, count in each
        ]
        return [1.0 if share > 1 else 0.0 if self._drops_outliers else share for share in shares]

    def without_lean(
        self, codes: Sequence[int], priors: Sequence[Five], own: Five, middle_m: tuple[float, float], now_s: float
    ) -> tuple[list[tuple[float, float]], list[bool] | None]:
        """Return by how much the means of `priors` of `codes` are off `middle_m`, less what is always to one side.

        The second value tells which priors lean so, None if none does. Each is a mean (x, y) and a covariance (xx,
        xy, yy), and may be off by as much as it and one's `own` claim. Deviations of the honest change sides in a
        second; a mean of more than `LEAN_LIMIT` deviations is taken off.
        """
        if len(self._leans) + len(codes) > MAX_ORIGINS:
            kept = [code for code, (_, _, then_s) in self._leans.items() if now_s - then_s < MEMORY_S]
            self._leans = {code: self._leans[code] for code in kept[-(MAX_ORIGINS // 2) :]}
        off_m: list[tuple[float, float]] = []
        leans: list[bool] = []
        for code, (mean_x, mean_y, xx, xy, yy) in zip(codes, priors, strict=True):
            # The deviation in terms of what is claimed: C⁻¹ off with C Cᵀ the sum of both covariances.
            root_xx = math.sqrt(xx + own[2])
            root_yx = (xy + own[3]) / root_xx
            root_yy = math.sqrt(yy + own[4] - root_yx * root_yx)
            off_x, off_y = mean_x - middle_m[0], mean_y - middle_m[1]
            x = off_x / root_xx
            y = (off_y - root_yx * x) / root_yy
            lean_x, lean_y, then_s = self._leans.get(code, (0.0, 0.0, now_s))
            keep = math.exp((then_s - now_s) / MEMORY_S)
            lean_x, lean_y = x + keep * (lean_x - x), y + keep * (lean_y - y)
            self._leans[code] = lean_x, lean_y, now_s
            squared = lean_x * lean_x + lean_y * lean_y
            is_leaning = squared > LEAN_LIMIT**2
            if is_leaning:
                less = 1 - LEAN_LIMIT / math.sqrt(squared)
                off_x -= less * root_xx * lean_x
                off_y -= less * (root_yx * lean_x + root_yy * lean_y)
            off_m.append((off_x, off_y))
            leans.append(is_leaning)
        return off_m, leans if True in leans else None


def median_belief(priors: Array) -> Information:
    """Return a belief at the coordinate-wise median of the means of `priors` (n, 5), as wide as the widest."""
    means, covariance = moments(priors)
    mean = np.median(means, axis=0)
    variance = float(np.max(covariance[:, 0, 0] + covariance[:, 1, 1]))
    return Information.of(mean, variance * np.eye(2))
