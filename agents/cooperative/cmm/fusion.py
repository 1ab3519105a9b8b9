"""Fusion: one filter's particles mixed with those of its neighbours, and the weight of each (MODEL 5).

Weights are the share of each neighbour's estimate that a vehicle takes over. `OptimizedWeights` minimizes the
paper's objective, the distance of the fused estimate to the network's mean, with a ridge that says how uncertain
each estimate is itself.

A share a_ij of the particles is replaced by hypotheses of neighbour j. The mixture of posteriors counts nothing
twice. The neighbour could not know the roads of those vehicles that it does not receive: these, and only these,
weight its hypotheses here.

A hypothesis from outside brings no vehicles with it. It is paired with a particle of this filter, whose vehicles
and past are moved along their regression on c: what c does not determine keeps its spread, and its correlations.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import scipy  # its parts are imported when they are first used: with OSQP they take a third of a second
from numpy.typing import NDArray

from agents.cooperative.cmm.common_error import systematic
from agents.cooperative.cmm.information import inverted
from agents.cooperative.cmm.rbpf import Rbpf
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
MIN_VARIANCE_M2 = 1e-6
"""Variance (m²) of c below which a cloud has collapsed: a millimetre tells nothing about a regression."""
MIN_VARIANCE_RATIO = 1e-6
"""Ratio of the smaller to the larger variance of c below which it has collapsed to a line."""


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


@dataclass(frozen=True)
class Cloud:
    """A neighbour's equally likely hypotheses `common_m` (n, 2), and the vehicles whose fixes are in them."""

    common_m: Array
    known: frozenset[str]


@dataclass(frozen=True)
class Slopes:
    """The regression on c, Cov(·, c) Cov(c)⁻¹, of what goes with a particle.

    mean: (M, 4, 2), of the vehicles' means. past: (L, 2, 2), of the past c. map_log_likelihood: (M, 2).
    """

    mean: Array
    past: Array
    map_log_likelihood: Array


@dataclass(frozen=True)
class Conditioned:
    """Hypotheses `common_m` (n, 2) with what a filter expects given each of them.

    mean: (M, 4, n). past_m: (L, 2, n). map_log_likelihood: (M, n), log P of each vehicle on a road.
    """

    common_m: Array
    mean: Array
    past_m: Array
    map_log_likelihood: Array


def regression_on_common_error(rbpf: Rbpf) -> Slopes:
    """Return the filter's regression on c.

    If the cloud has collapsed: −I for positions (a vehicle is where its fix says, less c), I for the past, and 0.
    """
    particles, tracks = rbpf.particles, rbpf.tracks
    covariance = particles.covariance_m2
    eigenvalues = np.linalg.eigvalsh(covariance)
    if eigenvalues[0] < MIN_VARIANCE_M2 or eigenvalues[0] < MIN_VARIANCE_RATIO * eigenvalues[1]:
        mean = np.zeros((len(tracks), 4, 2))
        mean[:, 0, 0] = mean[:, 1, 1] = -1.0
        return Slopes(mean, np.tile(np.eye(2), (len(particles.past_m), 1, 1)), np.zeros((len(tracks), 2)))
    spread_m = particles.common_m - particles.estimate_m[:, None]
    project = (spread_m * particles.weight).T @ np.linalg.inv(covariance)
    return Slopes(tracks.mean @ project, particles.past_m @ project, tracks.map_log_likelihood @ project)


def fuse(rbpf: Rbpf, clouds: Sequence[Cloud], weights: Array, rng: np.random.Generator) -> tuple[Array, int]:
    """Mix `clouds` into the filter by `weights` (1 + n,), its own first; the filter is changed in place.

    Returns the estimate (2,) right after fusion, before any road weights the particles, and how many hypotheses
    were imported. A filter with `separate_map_update` does not evaluate the map here either.
    """
    counts = largest_remainder(weights, rbpf.config.particles)
    used = [(cloud, int(count)) for cloud, count in zip(clouds, counts[1:], strict=True) if count]
    used = [(cloud, count) for cloud, count in used if len(cloud.common_m)]
    imported = sum(count for _, count in used)
    if not used:
        return rbpf.estimate_m, 0
    kept = rbpf.config.particles - imported
    own = systematic(rbpf.weight, kept, rng) if kept else np.empty(0, dtype=np.intp)
    common_m = np.concatenate([_evenly(cloud.common_m, count, rng) for cloud, count in used])
    fused_m = (rbpf.common_m[:, own].sum(axis=1) + common_m.sum(axis=0)) / rbpf.config.particles
    conditioned = condition_on(rbpf, common_m, rng)
    if rbpf.config.separate_map_update:
        log_weight = np.zeros(kept + imported)
    else:
        batch = np.repeat(np.arange(len(used)), [count for _, count in used])
        evidence = _evidence(rbpf, [cloud for cloud, _ in used], batch, conditioned.map_log_likelihood)
        log_weight = np.concatenate([np.zeros(kept), evidence])
    _replace(rbpf, own, conditioned, log_weight, rng)
    return np.asarray(fused_m), imported


def condition_on(rbpf: Rbpf, common_m: Array, rng: np.random.Generator) -> Conditioned:
    """Return what the filter expects given hypotheses (n, 2) from outside."""
    count = len(common_m)
    particles, tracks = rbpf.particles, rbpf.tracks
    partner = rng.permutation(systematic(particles.weight, count, rng))
    by_m = common_m.T - particles.common_m[:, partner]
    slopes = regression_on_common_error(rbpf)
    mean = tracks.mean.take(partner, axis=-1) + slopes.mean @ by_m
    past_m = particles.past_m.take(partner, axis=-1) + slopes.past @ by_m
    log_likelihood = rbpf.map_evidence.log_likelihood(tracks, mean)
    bare = tracks.without_candidate()
    if bare.any():  # on no lane just now: what the last one said still counts
        own = tracks.map_log_likelihood[bare][:, partner]
        log_likelihood[bare] = own + slopes.map_log_likelihood[bare] @ by_m
    return Conditioned(common_m, mean, past_m, log_likelihood)


def _evidence(rbpf: Rbpf, clouds: Sequence[Cloud], batch: NDArray[np.intp], map_log_likelihood: Array) -> Array:
    """Log-weights (n,) of imported hypotheses, from the roads of the vehicles that their senders do not know.

    `batch` (n,) is the index of each one's cloud and `map_log_likelihood` (M, n) its log P on road. Weights are
    relative to the mean likelihood in this filter's own cloud.
    """
    unknown = np.array([[v not in cloud.known for v in rbpf.vehicles] for cloud in clouds], dtype=float)
    if not unknown.any():
        return np.zeros(len(batch))
    own = unknown @ rbpf.tracks.map_log_likelihood
    top = own.max(axis=1)
    usual = top + np.log(np.exp(own - top[:, None]) @ rbpf.weight)
    return np.asarray(np.einsum("nm,mn->n", unknown[batch], map_log_likelihood) - usual[batch])


def _replace(
    rbpf: Rbpf,
    own: NDArray[np.intp],
    conditioned: Conditioned,
    log_weight: Array,
    rng: np.random.Generator,
) -> None:
    """Go on with the particles `own` (m,) and the hypotheses `conditioned` (n of them), resampled to K.

    `log_weight` (m + n,) are their weights, own first.
    """
    particles, tracks, count = rbpf.particles, rbpf.tracks, rbpf.config.particles
    weight = np.exp(log_weight - log_weight.max())
    index = systematic(weight / weight.sum(), count, rng)
    kept = own[index[index < len(own)]]
    imported = index[index >= len(own)] - len(own)
    past_m, mean, log_likelihood = conditioned.past_m, conditioned.mean, conditioned.map_log_likelihood
    particles.past_m = np.concatenate([particles.past_m[:, :, kept], past_m[:, :, imported]], axis=2)
    particles.common_m = np.concatenate([particles.common_m[:, kept], conditioned.common_m[imported].T], axis=1)
    particles.log_weight = np.zeros(count)
    tracks.mean = np.concatenate([tracks.mean[:, :, kept], mean[:, :, imported]], axis=2)
    own_log_likelihood = tracks.map_log_likelihood[:, kept]
    tracks.map_log_likelihood = np.concatenate([own_log_likelihood, log_likelihood[:, imported]], axis=1)


def _evenly(hypotheses: Array, count: int, rng: np.random.Generator) -> Array:
    """Draw a systematic sample of `count` from equally likely `hypotheses` (n, 2)."""
    index = (np.arange(count) + rng.random()) * (len(hypotheses) / count)
    return hypotheses[index.astype(np.intp)]
