"""Figures of estimates: coverage, batches, convergence, both definitions of divergence."""

from __future__ import annotations

import numpy as np
import pytest

from emulator.records.distributions import chi2_quantile
from studies.measure import batch_means, converged_s, first_divergences, normalized
from vnet.units import NS_PER_S


def test_normalized_errors_of_a_consistent_estimate_are_chi_squared() -> None:
    rng = np.random.default_rng(1)
    covariance_m2 = np.array([[2.0, 0.7], [0.7, 0.5]])
    error_m = rng.multivariate_normal(np.zeros(2), covariance_m2, (400, 25))
    squares = normalized(error_m, np.broadcast_to(covariance_m2, (400, 25, 2, 2)))
    assert squares.mean() == pytest.approx(2.0, rel=0.05)
    assert np.mean(squares <= chi2_quantile(0.95, 2)) == pytest.approx(0.95, abs=0.01)
    assert batch_means(squares / 2, 100) == pytest.approx([1.0] * 4, abs=0.08)


def test_what_is_missing_or_no_covariance_does_not_count() -> None:
    error_m, covariance_m2 = np.ones((3, 1, 2)), np.tile(np.eye(2), (3, 1, 1, 1))
    error_m[0] = np.nan
    covariance_m2[1] = [[1.0, 2.0], [2.0, 1.0]]
    assert np.isnan(normalized(error_m, covariance_m2)).ravel().tolist() == [True, True, False]
    assert batch_means(normalized(error_m, covariance_m2), 3) == [2.0]


def test_a_network_has_converged_when_its_error_stays_small() -> None:
    error_m = np.zeros((300, 2, 2))
    error_m[..., 0] = 0.1
    error_m[:40, :, 0], error_m[60:70, :, 0] = 2.0, 2.0
    assert converged_s(error_m, 200, 100_000_000) == 7.0, "small for 2 s only at first"
    error_m[:, 0] = np.nan
    assert converged_s(error_m, 200, 100_000_000) == 7.0, "of those that report"
    assert converged_s(np.full((300, 2, 2), np.nan), 200, 100_000_000) is None


def test_divergence_by_stated_deviations_has_a_limit_of_its_own() -> None:
    sigmas = np.full((100, 2), 4.0)
    sigmas[20:80, 1] = 6.0
    assert first_divergences(sigmas, 100_000_000, 5.0) == {1: 69}
    assert first_divergences(sigmas, 100_000_000) == {}


def test_the_period_in_which_five_seconds_are_full_is_found() -> None:
    error_m = np.zeros((30, 4))
    error_m[3:8, 0] = 11.0
    error_m[3:7, 1] = 11.0
    error_m[2:20, 2] = 10.0
    error_m[20:, 3] = 1e6
    assert first_divergences(error_m, NS_PER_S) == {0: 7, 3: 24}


def test_an_unknown_error_interrupts_it() -> None:
    error_m = np.full((9, 1), 50.0)
    error_m[4] = np.nan
    assert first_divergences(error_m, NS_PER_S) == {}
    assert first_divergences(np.vstack([error_m, error_m[:1]]), NS_PER_S) == {0: 9}


@pytest.mark.parametrize(("period_ns", "first"), [(100_000_000, 49), (NS_PER_S, 4), (60 * NS_PER_S, 0)])
def test_periods_of_any_length_count_by_their_time(period_ns: int, first: int) -> None:
    assert first_divergences(np.full((60, 1), 50.0), period_ns) == {0: first}
