"""The linear model's closed forms against simulation, and against the paper's ring of four."""

import numpy as np
import pytest

from emulator.linear_model import convergence_factor, deviation_covariance, steady_state_covariance
from vnet.errors import VnetError


def ring(alpha: float) -> np.ndarray:
    """The paper's four vehicles: each hears the next one only."""
    return alpha * np.eye(4) + (1 - alpha) * np.roll(np.eye(4), 1, axis=1)


def test_one_dimension_is_the_geometric_series() -> None:
    assert steady_state_covariance(np.array([[0.8]]), np.array([[2.0]])) == pytest.approx(2 / (1 - 0.64))


def test_it_satisfies_its_equation_and_is_what_a_simulation_comes_to() -> None:
    rng = np.random.default_rng(0)
    transition = rng.normal(size=(3, 3))
    transition *= 0.8 / np.abs(np.linalg.eigvals(transition)).max()
    root = rng.normal(size=(3, 3))
    covariance = steady_state_covariance(transition, root @ root.T)
    assert covariance == pytest.approx(transition @ covariance @ transition.T + root @ root.T)
    states = np.zeros((3, 20_000))
    for _ in range(60):
        states = transition @ states + root @ rng.normal(size=states.shape)
    assert np.cov(states) == pytest.approx(covariance, rel=0.1, abs=0.05 * np.trace(covariance))


@pytest.mark.parametrize("alpha", [0.05, 0.2, 0.5, 0.9])
def test_deviations_in_the_ring_are_the_sum_over_its_modes(alpha: float) -> None:
    """The ring is a circulant matrix: mode k has the eigenvalue α + (1 − α) exp(2πik/4)."""
    mode = alpha + (1 - alpha) * np.exp(2j * np.pi * np.arange(1, 4) / 4)
    covariance = deviation_covariance(ring(alpha), np.eye(4))
    assert np.trace(covariance) == pytest.approx(np.sum(1 / (1 - np.abs(mode) ** 2)))
    assert covariance.sum() == pytest.approx(0.0, abs=1e-9), "deviations from the mean add up to 0"
    assert convergence_factor(ring(alpha)) == pytest.approx(np.abs(mode).max())


def test_half_and_half_keeps_the_ring_closest_together() -> None:
    """The order of the paper's Table I: the deviation is smallest at α = 0.5 and grows to both sides."""
    spread = [np.trace(deviation_covariance(ring(a), np.eye(4))) for a in (0.05, 0.2, 0.5, 0.8, 0.95)]
    assert np.argmin(spread) == 2
    assert spread == pytest.approx(spread[::-1])


def test_no_steady_state_without_contraction() -> None:
    with pytest.raises(VnetError, match="spectral radius 1: there is a steady state only below 1"):
        steady_state_covariance(ring(0.5), np.eye(4))
    with pytest.raises(VnetError, match="spectral radius 1"):
        deviation_covariance(np.eye(4), np.eye(4))
    with pytest.raises(VnetError, match=r"row 1 add up to 1\.5: 1 expected"):
        deviation_covariance(np.array([[1.0, 0.0], [0.5, 1.0]]), np.eye(2))


def test_the_convergence_factor_needs_no_doubly_stochastic_matrix() -> None:
    """Two absorb at different rates: eigenvalues 1 and 0.6, though ρ(A − 11ᵀ/N) is larger."""
    weights = np.array([[0.9, 0.1], [0.3, 0.7]])
    assert convergence_factor(weights) == pytest.approx(0.6)
    assert convergence_factor(np.ones((1, 1))) == 0.0
