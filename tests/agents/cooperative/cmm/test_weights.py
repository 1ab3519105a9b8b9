"""Fusion weights against a general solver."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.cooperative.cmm.fusion import (
    ExactWeights,
    OptimizedWeights,
    constant_weights,
    largest_remainder,
    max_degree_weights,
    metropolis_weights,
    no_fusion_weights,
    random_weights,
)
from vnet.errors import VnetError


def problem(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(2, 32))
    estimates = rng.normal(size=(count, 2)) * rng.uniform(0.05, 3)
    covariances = np.eye(2) * rng.uniform(0.001, 0.5, (count, 1, 1))
    return estimates, covariances, rng.normal(size=2) * 0.3


SOLVERS = [OptimizedWeights, ExactWeights]


@pytest.mark.slow
@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("seed", range(30))
def test_optimized_weights_are_the_minimum(seed: int, solver: type[OptimizedWeights]) -> None:
    from scipy.optimize import minimize  # slow to import

    estimates, covariances, mean = problem(seed)
    weights = solver().solve(estimates, covariances, mean)
    offset = estimates - mean
    hessian = offset @ offset.T + np.diag(np.maximum(np.trace(covariances, axis1=1, axis2=2), 0.01))
    count = len(estimates)
    best = minimize(
        lambda a: a @ hessian @ a,
        np.full(count, 1 / count),
        jac=lambda a: 2 * hessian @ a,
        bounds=[(0, 1)] * count,
        constraints={"type": "eq", "fun": lambda a: a.sum() - 1, "jac": lambda a: np.ones(count)},
        method="SLSQP",
        options={"ftol": 1e-14, "maxiter": 1000},
    )
    assert weights @ hessian @ weights <= best.fun * (1 + 1e-5)
    assert weights.sum() == pytest.approx(1)
    assert np.all((weights >= 0) & (weights <= 1))


@pytest.mark.slow
def test_the_same_history_gives_the_same_bits() -> None:
    first, second = OptimizedWeights(), OptimizedWeights()
    for seed in range(40):
        assert np.array_equal(first.solve(*problem(seed)), second.solve(*problem(seed)))


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_floor_keeps_ones_own_estimate(solver: type[OptimizedWeights]) -> None:
    estimates = np.array([[5.0, 5.0], [0.0, 0.0], [0.1, 0.0]])
    covariances = np.eye(2) * np.full((3, 1, 1), 0.01)
    assert solver().solve(estimates, covariances, np.zeros(2))[0] < 0.01
    assert solver(0.25).solve(estimates, covariances, np.zeros(2))[0] == pytest.approx(0.25, abs=1e-4)


@pytest.mark.parametrize(
    "bad", [np.zeros((2, 2)), -np.eye(2), np.array([[1.0, 2.0], [2.0, 1.0]]), np.eye(2) * np.nan]
)
def test_a_covariance_that_is_none_is_refused(bad: np.ndarray) -> None:
    with pytest.raises(VnetError, match=r"covariance 1 = .* not positive definite"):
        OptimizedWeights().solve(np.zeros((2, 2)), np.array([np.eye(2), bad]), np.zeros(2))


@pytest.mark.slow
@settings(max_examples=100, deadline=None)
@given(st.lists(st.floats(0.001, 1), min_size=1, max_size=31), st.integers(0, 500))
def test_largest_remainder_shares_out_everything_in_proportion(raw: list[float], total: int) -> None:
    weights = np.array(raw) / np.sum(raw)
    counts = largest_remainder(weights, total)
    assert counts.sum() == total
    assert np.all(np.abs(counts - weights * total) < 1 + 1e-9)


def test_random_weights_add_up() -> None:
    weights = random_weights(5, np.random.default_rng(0))
    assert weights.sum() == pytest.approx(1)
    assert np.all(weights > 0)


def test_constant_weights_are_the_papers_ring() -> None:
    assert constant_weights(2, 0.2) == pytest.approx([0.2, 0.8])
    assert constant_weights(5, 0.2) == pytest.approx([0.2] * 5)
    assert constant_weights(1, 0.2) == pytest.approx([1.0]), "nobody to take anything from"
    with pytest.raises(VnetError, match=r"alpha = 1\.5: 0 to 1 allowed"):
        constant_weights(2, 1.5)


def test_metropolis_and_max_degree_weights_are_doubly_stochastic_on_a_path() -> None:
    neighbours = {0: [1], 1: [0, 2], 2: [1, 3], 3: [2]}
    for rule in ("metropolis", "max-degree"):
        matrix = np.zeros((4, 4))
        for i, others in neighbours.items():
            degrees = [len(neighbours[j]) for j in others]
            weights = metropolis_weights(len(others), degrees)
            matrix[i, [i, *others]] = weights if rule == "metropolis" else max_degree_weights(1 + len(others), 2)
        assert matrix.sum(axis=0) == pytest.approx(np.ones(4))
        assert matrix.sum(axis=1) == pytest.approx(np.ones(4))
        assert np.array_equal(matrix, matrix.T)
        assert (matrix >= 0).all()
    with pytest.raises(VnetError, match="max_degree = 1: at least the vehicle's own 2"):
        max_degree_weights(3, 1)


def test_no_fusion_keeps_everything() -> None:
    assert no_fusion_weights(3).tolist() == [1.0, 0.0, 0.0]


def test_weights_stay_weights_when_the_mean_is_absurd() -> None:
    estimates, covariances = np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([np.eye(2)] * 2)
    weights = OptimizedWeights().solve(estimates, covariances, np.array([1e14, -1e14]))
    assert weights.sum() == pytest.approx(1.0)
    assert np.all((weights >= 0) & (weights <= 1))
