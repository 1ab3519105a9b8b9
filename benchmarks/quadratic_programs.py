"""The quadratic program of the fusion weights with other solvers: is OSQP's `update` worth it, do all agree?

min ‖Σ a_j x_j − x̄‖² + Σ λ_j a_j² with Σ a = 1, 0 ≤ a ≤ 1, as in `cmm.fusion`, for 10, 20 and 30 neighbours.
Timed is the whole way from estimates to weights, which is the same for all but for the solver: checking the
covariances, the Hessian, the solver, clipping. `_update` sets the solver up once and gives it each new Hessian,
`_fresh` sets it up again for every problem. All take turns problem by problem. Needs the extra `bench`.
"""

import statistics
import time
from collections.abc import Callable
from functools import partial

import clarabel
import daqp
import numpy as np
import piqp
import scipy.sparse as sp

from agents.cooperative.cmm.fusion import RIDGE_FLOOR_M2, OptimizedWeights, check_covariances
from vnet.types import Array

NEIGHBOURS = (10, 20, 30)
PROBLEMS, WARM_UP = 300, 20
Problem = tuple[Array, Array, Array]  # estimates (n, 2), covariances (n, 2, 2), mean (2,)
Weights = Callable[[Array, Array, Array], Array]
EQUALITY = 5  # DAQP's code for a constraint that always holds with equality


class Daqp:
    """DAQP: dense, dual active set."""

    def __init__(self) -> None:
        self._model: daqp.Model | None = None

    def solve(self, hessian: Array) -> Array:
        """The minimizer."""
        count = len(hessian)
        if self._model is None:
            lower, upper = np.append(np.zeros(count), 1.0), np.ones(count + 1)
            sense = np.zeros(count + 1, dtype=np.int32)
            sense[count] = EQUALITY
            self._model = daqp.Model()
            self._model.setup(hessian, np.zeros(count), np.ones((1, count)), upper, lower, sense)
        else:
            self._model.update(H=hessian)
        return self._model.solve()[0]


class Piqp:
    """PIQP: dense, proximal interior point."""

    def __init__(self) -> None:
        self._solver: piqp.DenseSolver | None = None

    def solve(self, hessian: Array) -> Array:
        """The minimizer."""
        count = len(hessian)
        if self._solver is None:
            bounds = {"x_l": np.zeros(count), "x_u": np.ones(count)}
            self._solver = piqp.DenseSolver()
            # Else an `update` of the Hessian alone makes wrong solutions (0.6.4); one of all the data does not.
            self._solver.settings.preconditioner_reuse_on_update = True
            self._solver.setup(hessian, np.zeros(count), np.ones((1, count)), np.ones(1), **bounds)
        else:
            self._solver.update(P=hessian)
        self._solver.solve()
        return self._solver.result.x


class Clarabel:
    """Clarabel: sparse, interior point; a ≤ 1 follows from a ≥ 0 and Σ a = 1, and is left out."""

    def __init__(self, tolerance: float = 1e-8) -> None:
        self._solver: clarabel.DefaultSolver | None = None
        self._tolerance = tolerance

    def solve(self, hessian: Array) -> Array:
        """The minimizer."""
        upper = sp.csc_matrix(np.triu(hessian))
        if self._solver is None:
            count = len(hessian)
            settings = clarabel.DefaultSettings()
            settings.verbose = settings.presolve_enable = False  # with it, data cannot be updated
            settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = self._tolerance
            rows = sp.vstack([np.ones((1, count)), -sp.eye(count)], format="csc")
            bound = np.append(1.0, np.zeros(count))
            cones = [clarabel.ZeroConeT(1), clarabel.NonnegativeConeT(count)]
            self._solver = clarabel.DefaultSolver(upper, np.zeros(count), rows, bound, cones, settings)
        else:
            self._solver.update(P=upper)
        return np.array(self._solver.solve().x)


def weights_by(solve: Callable[[Array], Array]) -> Weights:
    """The weights with another solver of the quadratic program, else as `OptimizedWeights` does it."""

    def weights(estimates_m: Array, covariances_m2: Array, mean_m: Array) -> Array:
        check_covariances(covariances_m2)
        offset = estimates_m - mean_m
        ridge = np.maximum(np.trace(covariances_m2, axis1=1, axis2=2), RIDGE_FLOOR_M2)
        hessian = 2 * (offset @ offset.T + np.diag(ridge))
        clipped = np.clip(solve(hessian / float(np.mean(np.diag(hessian)))), 0.0, 1.0)
        return clipped / clipped.sum()

    return weights


def _solve_fresh(kind: type[Daqp | Piqp | Clarabel], hessian: Array) -> Array:
    """Solve with a solver that has kept nothing from the last problem."""
    return kind().solve(hessian)


def contenders() -> dict[str, Weights]:
    """By name; what is in use comes first."""
    result: dict[str, Weights] = {
        "osqp_update": OptimizedWeights().solve,
        "osqp_fresh": lambda *problem: OptimizedWeights().solve(*problem),
    }
    for name, kind in (("daqp", Daqp), ("piqp", Piqp), ("clarabel", Clarabel)):
        result[f"{name}_update"] = weights_by(kind().solve)
        result[f"{name}_fresh"] = weights_by(partial(_solve_fresh, kind))
    return result


def random_problem(rng: np.random.Generator, count: int) -> Problem:
    """Estimates within a metre or so of each other, each with its own uncertainty of 0.1 to 0.7 m."""
    estimates_m = rng.normal(scale=0.5, size=(count, 2))
    root = rng.normal(size=(count, 2, 2))
    shape = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(2)
    shape /= np.trace(shape, axis1=1, axis2=2)[:, None, None]
    covariances_m2 = shape * rng.uniform(0.02, 1.0, count)[:, None, None]
    return estimates_m, covariances_m2, estimates_m.mean(axis=0)


def compare() -> dict[str, float]:
    """Medians in µs and the largest difference of a weight from the reference, by solver and neighbours."""
    figures: dict[str, float] = {}
    for neighbours in NEIGHBOURS:
        figures |= _compare(neighbours)
    return figures


def _compare(neighbours: int) -> dict[str, float]:
    rng = np.random.default_rng(neighbours)
    reference = weights_by(lambda hessian: Clarabel(tolerance=1e-13).solve(hessian))
    solvers = contenders()
    times_us: dict[str, list[float]] = {name: [] for name in solvers}
    apart = dict.fromkeys(solvers, 0.0)
    for _ in range(WARM_UP + PROBLEMS):
        problem = random_problem(rng, neighbours + 1)  # the vehicle itself is one more
        exact = reference(*problem)
        for name, weights in solvers.items():
            started = time.perf_counter()
            found = weights(*problem)
            times_us[name].append((time.perf_counter() - started) * 1e6)
            apart[name] = max(apart[name], float(np.abs(found - exact).max()))
    medians = {name: statistics.median(times[WARM_UP:]) for name, times in times_us.items()}
    figures = {f"{name}_{neighbours}_us": value for name, value in medians.items()}
    ratios = {f"{name}_{neighbours}_over_osqp_update": medians[name] / medians["osqp_update"] for name in medians}
    return figures | ratios | {f"{name}_{neighbours}_max_difference": value for name, value in apart.items()}
