"""Quantiles and tails agree with scipy.stats, which is too slow to import for a command."""

import numpy as np
import pytest
from scipy import stats

from emulator.records.distributions import binomial_interval, chi2_cdf, chi2_quantiles, chi2_sf, lowest_share


@pytest.mark.parametrize("trials", [1, 2, 7, 100, 12_345, 30_000_000])
@pytest.mark.parametrize("probability", [0.0, 1e-6, 0.05, 0.3, 0.5, 0.999, 1.0])
def test_binomial_intervals(trials: int, probability: float) -> None:
    for share in (0.5, 0.99, 0.999):
        expected = tuple(int(edge) for edge in stats.binom.interval(share, trials, probability))
        assert binomial_interval(share, trials, probability) == expected


@pytest.mark.parametrize("degrees", [1, 2, 20, 12_345])
def test_the_chi_squared_distribution_to_the_last_bit(degrees: int) -> None:
    probabilities = np.linspace(0.001, 0.999, 101)
    quantiles = chi2_quantiles(probabilities, degrees)
    assert np.array_equal(quantiles, stats.chi2.ppf(probabilities, degrees))
    assert [chi2_sf(value, degrees) for value in quantiles] == stats.chi2.sf(quantiles, degrees).tolist()
    assert [chi2_cdf(value, degrees) for value in quantiles] == stats.chi2.cdf(quantiles, degrees).tolist()


@pytest.mark.parametrize(("count", "total"), [(0, 10), (1, 776), (776, 776), (9, 5000), (2_000, 1_000_000)])
def test_the_lowest_share_is_that_of_clopper_and_pearson(count: int, total: int) -> None:
    interval = stats.binomtest(count, total).proportion_ci(0.95, method="exact")
    assert lowest_share(count, total) == pytest.approx(interval.low)
