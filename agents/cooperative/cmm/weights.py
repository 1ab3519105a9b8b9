"""Fusion weights: the share of each neighbour's estimate that a vehicle takes over (MODEL 5).

`OptimizedWeights` minimizes the paper's objective, the distance of the fused estimate to the network's mean, with a
ridge that says how uncertain each estimate is itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import scipy  # its parts are imported when they are first used: with OSQP they take a third of a second
from numpy.typing import NDArray

from agents.cooperative.cmm.information import inverted
from vnet.errors import VnetError
from vnet.types import Array

if TYPE_CHECKING:
    import osqp

RIDGE_FLOOR_M2 = 0.01
"""Least ridge (m²): an estimate that claims to be exact does not take all the weight."""
MAX_ROUNDS = 15
"""Number of rounds of Newton's method: of 20 000 random problems of 2 to 31 estimates none took more than 6."""
MAX_SOLVERS = 64
"""Number of solvers that are kept, one for each number of neighbours: a flood of senders would need hundreds."""

Points = Sequence[Sequence[float]]


class OptimizedWeights:
    """min ‖Σ_j a_j x_j − x̄‖² + Σ_j λ_j a_j²  subject to  Σ_j a_j = 1, 0 ≤ a_j ≤ 1, a_0 ≥ `self_floor`.

    λ_j = tr Cov(x_j), at least 0.01 m²: without the ridge two rows of data do not determine up to 31 weights. With
    `ridge_m2` λ is the same for all; the paper has none, and a small one stands for that.
    OSQP (Stellato et al. 2020) is set up once for each number of neighbours and updated afterwards. Its step size
    is carried over from problem to problem, so the last digits depend on the history, but never on the wall clock:
    the same problems in the same order give the same bits.
    """

    def __init__(self, self_floor: float = 0.0, ridge_m2: float | None = None) -> None:
        self._self_floor = self_floor
        self._ridge_m2 = ridge_m2
        self._solvers: dict[int, osqp.OSQP] = {}

    def solve(self, estimates_m: Array, covariances_m2: Array, mean_m: Array) -> Array:
        """Return weights (n,) for estimates (n, 2), the vehicle's own first, with covariances (n, 2, 2).

        Raises VnetError for a covariance that is not positive definite.
        """
        check_covariances(covariances_m2)
        variances_m2 = covariances_m2[:, 0, 0] + covariances_m2[:, 1, 1]
        return np.array(self.solve_by_variance(estimates_m.tolist(), variances_m2.tolist(), mean_m.tolist()))

    def solve_by_variance(
        self, estimates_m: Points, variances_m2: Sequence[float], mean_m: Sequence[float]
    ) -> list[float]:
        """Return the same as plain numbers for the sums (n,) of both variances of each, which are positive."""
        count = len(estimates_m)
        if count == 1:
            return [1.0]
        hessian = self._hessian(np.array(estimates_m), np.array(variances_m2), np.array(mean_m))
        weights = self._minimize(hessian)
        weights = np.minimum(np.maximum(weights, 0.0), 1.0)
        total = float(np.add.reduce(weights))
        weights = weights / total if math.isfinite(total) and total > 0 else no_fusion_weights(count)
        return list(weights.tolist())

    def _hessian(self, estimates_m: Array, variances_m2: Array, mean_m: Array) -> Array:
        count = len(estimates_m)
        offset = estimates_m - mean_m
        if self._ridge_m2 is None:
            ridge = np.maximum(variances_m2, RIDGE_FLOOR_M2)
        else:
            ridge = np.full(count, self._ridge_m2)
        hessian = offset.dot(offset.T)
        hessian *= 2
        ridge *= 2
        hessian.ravel()[:: count + 1] += ridge
        return np.asarray(hessian)

    def _minimize(self, hessian: Array) -> Array:
        """Return the weights (n,) that minimize ½ aᵀ H a, but for the solver's tolerance."""
        count = len(hessian)
        scale = float(hessian.flat[:: count + 1].mean())  # OSQP's tolerances are absolute
        rows, columns = _upper_triangle(count)
        solver = self._solver(count)
        solver.update(Px=(hessian / scale)[rows, columns])
        return np.asarray(solver.solve(raise_error=False).x)

    def _solver(self, count: int) -> osqp.OSQP:
        if count not in self._solvers:
            if len(self._solvers) >= MAX_SOLVERS:
                self._solvers.clear()
            rows, columns = _upper_triangle(count)
            hessian = scipy.sparse.csc_matrix((np.ones(len(rows)), (rows, columns)), shape=(count, count))
            constraints = scipy.sparse.vstack([np.ones((1, count)), scipy.sparse.eye(count)], format="csc")
            lower = np.zeros(count + 1)
            lower[0], lower[1] = 1.0, self._self_floor
            import osqp  # slow to import, and few runs need it

            solver = osqp.OSQP()
            solver.setup(hessian, np.zeros(count), constraints, lower, np.ones(count + 1), **_SETTINGS)
            self._solvers[count] = solver
        return self._solvers[count]


class ExactWeights(OptimizedWeights):
    """The same weights in closed form, in a third of the time.

    The matrix is diagonal but for two rows of data. So weights that no bound holds are a_j = (μ − d_j·s) / λ_j with
    d_j = x_j − x̄, and s = Σ a_j d_j and μ follow from sums over them. Newton's method changes which these are until
    all agree (a semismooth one: Hintermüller, Ito and Kunisch 2003), mostly at once. Where it goes in circles,
    as with some extreme problems, OSQP solves.
    """

    def solve_by_variance(
        self, estimates_m: Points, variances_m2: Sequence[float], mean_m: Sequence[float]
    ) -> list[float]:
        """Return the weights (n,) for estimates (n,), as `OptimizedWeights` does."""
        (first_x, first_y), (mean_x, mean_y), floor = estimates_m[0], mean_m, self._self_floor
        if len(estimates_m) == 1 or floor == 1:
            return list(no_fusion_weights(len(estimates_m)).tolist())
        scale = [1 / (self._ridge_m2 or max(variance, RIDGE_FLOOR_M2)) for variance in variances_m2]
        # Distances from the first are small also where the mean is far: that enters once.
        each = [(x - first_x, y - first_y, w) for (x, y), w in zip(estimates_m, scale, strict=True)]
        x_m, y_m = first_x - mean_x, first_y - mean_y
        weights, free = [1.0] * len(each), each
        for _ in range(MAX_ROUNDS):
            total = 1.0 if weights[0] > floor else 1 - floor
            sum_w = sum_x = sum_y = xx = xy = yy = 0.0
            for x, y, w in free:
                w_x, w_y = w * x, w * y
                sum_w += w
                sum_x += w_x
                sum_y += w_y
                xx += w_x * x
                xy += w_x * y
                yy += w_y * y
            by_x, by_y = sum_x / sum_w, sum_y / sum_w
            a, b, d = inverted(1 + xx - sum_x * by_x, xy - sum_x * by_y, 1 + yy - sum_y * by_y)
            r_x, r_y = x_m + total * by_x, y_m + total * by_y
            s_x, s_y = a * r_x + b * r_y, b * r_x + d * r_y
            level = total / sum_w + by_x * s_x + by_y * s_y
            weights = [max((level - x * s_x - y * s_y) * w, 0.0) for x, y, w in each]
            now = [one for one, weight in zip(each, weights, strict=True) if weight > 0]
            if not weights[0] > floor:
                weights[0], now = floor, [one for one in now if one is not each[0]]
            if now == free:
                total = math.fsum(weights)
                return [weight / total for weight in weights]
            if not now:
                break
            free = now
        return super().solve_by_variance(estimates_m, variances_m2, mean_m)


def no_fusion_weights(count: int) -> Array:
    """Return weights (count,) with everything on the vehicle itself, the first."""
    weights = np.zeros(count)
    weights[0] = 1.0
    return weights


def constant_weights(count: int, alpha: float) -> Array:
    """Return α on the vehicle itself, the rest in equal parts on its neighbours: the paper's ring. (count,)

    Raises VnetError for an α outside 0 … 1.
    """
    if not 0 <= alpha <= 1:
        raise VnetError(f"alpha = {alpha}: 0 to 1 allowed")
    if count == 1:
        return np.ones(1)
    weights = np.full(count, (1 - alpha) / (count - 1))
    weights[0] = alpha
    return weights


def metropolis_weights(degree: int, neighbour_degrees: Sequence[int]) -> Array:
    """Return 1 / (1 + max(d_i, d_j)) for neighbour j and the rest for the vehicle itself: (1 + n,), its own first.

    Degrees do not count the vehicle itself; the paper's do, so that its A_ij = 1 / max(d_i, d_j) is the same.
    Doubly stochastic on an undirected graph (Xiao and Boyd 2004).
    """
    others = [1 / (1 + max(degree, other)) for other in neighbour_degrees]
    return np.array([1 - math.fsum(others), *others])


def max_degree_weights(count: int, max_degree: int) -> Array:
    """Return 1 / (1 + d_max) for each neighbour and the rest for the vehicle itself: (count,), its own first.

    `max_degree` is that of the whole network. Raises VnetError if the vehicle itself has more neighbours.
    """
    if max_degree < count - 1:
        raise VnetError(f"max_degree = {max_degree}: at least the vehicle's own {count - 1} neighbours expected")
    weights = np.full(count, 1 / (1 + max_degree))
    weights[0] = 1 - (count - 1) / (1 + max_degree)
    return weights


def random_weights(count: int, rng: np.random.Generator) -> Array:
    """Draw uniformly random weights (count,) that add up to 1, as the paper's random fusion."""
    weights = rng.random(count)
    return np.asarray(weights / weights.sum())


def largest_remainder(weights: Array, total: int) -> Array:
    """Return whole numbers (n,) that add up to `total`, in proportion to `weights` (Hamilton's method)."""
    exact = weights * total
    counts = np.floor(exact).astype(np.intp)
    order = np.argsort(-(exact - counts), kind="stable")
    counts[order[: total - int(counts.sum())]] += 1
    return np.asarray(counts)


def check_covariances(covariances_m2: Array) -> None:
    """Raise VnetError unless all of (n, 2, 2) are positive definite."""
    a, b, d = covariances_m2[:, 0, 0], covariances_m2[:, 0, 1], covariances_m2[:, 1, 1]
    good = (a > 0) & (a * d > b * b)
    if np.count_nonzero(good) < len(good):
        first = int(np.argmin(good))
        raise VnetError(f"covariance {first} = {covariances_m2[first].tolist()}: not positive definite")


_SETTINGS = {
    "verbose": False,
    "eps_abs": 1e-6,
    "eps_rel": 1e-6,
    "max_iter": 2000,
    "check_termination": 10,
    "adaptive_rho": 1,  # by iterations: the default may go by elapsed time
    "adaptive_rho_interval": 50,
    "warm_starting": False,
    "polishing": False,
    "time_limit": 1e10,
}


@lru_cache(maxsize=256)
def _upper_triangle(count: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return rows and columns of the upper triangle in the order of OSQP's data: column by column."""
    rows, columns = np.triu_indices(count)
    order = np.lexsort((rows, columns))
    return rows[order], columns[order]
