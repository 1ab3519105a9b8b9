"""Number of particles by the spread of the belief."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.cooperative.cmm.information import Information
from agents.cooperative.cmm.kalman_bound import LaneModel
from agents.cooperative.cmm.own_rbpf import CELL_M, DISTANCE, ELLIPSE_SIGMAS, OwnRbpf, sample_size

TOLD = Information.of(np.array([1.0, -2.0]), 0.1**2 * np.eye(2))
"""Belief about c after what others say in a period."""


@pytest.mark.slow
@pytest.mark.parametrize("sigma_m", [0.1, 0.2, 0.5, 2.0])
def test_it_is_the_quantile_of_the_divergence(sigma_m: float) -> None:
    """Twice the sample size times the divergence is distributed as χ² (Fox 2003)."""
    from scipy.stats import chi2  # slow to import

    cells = math.pi * (ELLIPSE_SIGMAS * sigma_m / CELL_M) ** 2
    wanted = chi2.ppf(0.99, cells - 1) / (2 * DISTANCE)
    assert sample_size(sigma_m**2 * np.eye(2), 1, 10**9) == pytest.approx(wanted, rel=0.01)


@pytest.mark.slow
@given(st.floats(0, 1e4), st.floats(0, 1e4), st.floats(-1, 1), st.integers(1, 500), st.integers(500, 5000))
def test_it_is_between_the_bounds(a: float, d: float, correlation: float, least: int, most: int) -> None:
    b = correlation * math.sqrt(a * d)
    assert least <= sample_size(np.array([[a, b], [b, d]]), least, most) <= most


@pytest.mark.slow
def test_particles_become_fewer_and_say_the_same() -> None:
    """As long as what is known of c is narrow, as in a network; lanes 0.5 m apart compete for long."""
    lanes = np.array([[0.0, 0.5], [0.0, 0.0]]), np.zeros(2)
    filters = [OwnRbpf(lanes, LaneModel(), 250, np.random.default_rng(4), None, least) for least in (0, 100)]
    rng = np.random.default_rng(5)
    for _ in range(100):
        fix_m = np.array([1.0, -2.0]) + rng.standard_normal(2)
        for own in filters:
            own.predict(0.1)
            own.absorb(TOLD)
            own.take(fix_m, np.eye(2))
    assert len(filters[0].lane_probability) == 2
    assert len(filters[0].weight) == 1000
    assert 100 <= len(filters[1].weight) < 500
    assert np.linalg.norm(filters[0].estimate_m - filters[1].estimate_m) < 0.1


def test_they_become_more_again() -> None:
    lanes = np.array([[0.0, 0.5], [0.0, 0.0]]), np.zeros(2)
    own = OwnRbpf(lanes, LaneModel(), 200, np.random.default_rng(4), None, 100)
    assert len(own.weight) == 800
    own.absorb(Information.of(np.zeros(2), 0.05**2 * np.eye(2)))
    own.take(np.zeros(2), np.eye(2))
    assert len(own.weight) < 300
    for _ in range(100):
        own.predict(30.0)  # c spreads as nothing is heard of it
    own.take(np.zeros(2), np.eye(2))
    assert len(own.weight) > 300
