"""Fusion weights: the share of each neighbour's estimate that a vehicle takes over (MODEL 5).

`OptimizedWeights` minimizes the paper's objective, the distance of the fused estimate to the network's mean, with a
ridge that says how uncertain each estimate is itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import daqp
import numpy as np
import osqp
import scipy.sparse as sp
from numpy.typing import NDArray

from vnet.errors import VnetError
from vnet.types import Array

RIDGE_FLOOR_M2 = 0.01
"""Least ridge (m²): an estimate that claims to be exact does not take all the weight."""
MAX_SOLVERS = 64
"""Number of solvers that are kept, one for each number of neighbours: a flood of senders would need hundreds."""


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
        return self.solve_by_variance(estimates_m, covariances_m2[:, 0, 0] + covariances_m2[:, 1, 1], mean_m)

    def solve_by_variance(self, estimates_m: Array, variances_m2: Array, mean_m: Array) -> Array:
        """Return the same for the sums (n,) of both variances of each, which are positive."""
        count = len(estimates_m)
        if count == 1:
            return np.ones(1)
        hessian = self._hessian(estimates_m, variances_m2, mean_m)
        weights = self._minimize(hessian)
        weights = np.minimum(np.maximum(weights, 0.0), 1.0)
        total = float(np.add.reduce(weights))
        return np.asarray(weights / total) if math.isfinite(total) and total > 0 else no_fusion_weights(count)

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
            hessian = sp.csc_matrix((np.ones(len(rows)), (rows, columns)), shape=(count, count))
            constraints = sp.vstack([np.ones((1, count)), sp.eye(count)], format="csc")
            lower = np.zeros(count + 1)
            lower[0], lower[1] = 1.0, self._self_floor
            solver = osqp.OSQP()
            solver.setup(hessian, np.zeros(count), constraints, lower, np.ones(count + 1), **_SETTINGS)
            self._solvers[count] = solver
        return self._solvers[count]


class ActiveSetWeights(OptimizedWeights):
    """The same weights by DAQP (Arnström, Bemporad and Axehill 2022), a dual active-set solver.

    It solves exactly, from scratch each time, and in a fifth of OSQP's time: 12 in place of 56 µs with 8 estimates,
    26 in place of 133 µs with 31. The weights of OSQP differ by 10⁻⁵ at most.
    """

    def _minimize(self, hessian: Array) -> Array:
        count = len(hessian)
        linear, total, upper, lower, kinds = _simplex(count, self._self_floor)
        return np.asarray(daqp.solve(hessian, linear, total, upper, lower, kinds)[0])


_DAQP_EQUALITY = 5
"""DAQP's code of an equality constraint."""


@lru_cache(maxsize=256)
def _simplex(count: int, self_floor: float) -> tuple[Array, Array, Array, Array, NDArray[np.int32]]:
    """Return linear cost, constraint matrix, bounds and kinds: 0 ≤ a_j ≤ 1, a_0 ≥ floor, and Σ a_j = 1."""
    lower, kinds = np.zeros(count + 1), np.zeros(count + 1, dtype=np.int32)
    lower[0], lower[count], kinds[count] = self_floor, 1.0, _DAQP_EQUALITY
    return np.zeros(count), np.ones((1, count)), np.ones(count + 1), lower, kinds


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
    return np.array([1 - sum(others), *others])


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
