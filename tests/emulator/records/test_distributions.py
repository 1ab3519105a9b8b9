"""Quantiles and tails agree with scipy.stats, which the core of vnet does without."""

import numpy as np
import pytest
import scipy  # its stats are imported when they are first used

from emulator.records.distributions import (
    binomial_interval,
    chi2_cdf,
    chi2_quantile,
    chi2_sf,
    lowest_share,
    student_quantile,
)

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("trials", [1, 2, 7, 100, 12_345, 30_000_000])
@pytest.mark.parametrize("probability", [0.0, 1e-6, 0.05, 0.3, 0.5, 0.999, 1.0])
def test_binomial_intervals(trials: int, probability: float) -> None:
    for share in (0.5, 0.99, 0.999):
        expected = tuple(int(edge) for edge in scipy.stats.binom.interval(share, trials, probability))
        assert binomial_interval(share, trials, probability) == expected


@pytest.mark.parametrize("degrees", [1, 2, 20, 12_345, 400_000])
def test_the_chi_squared_distribution_to_nine_digits(degrees: int) -> None:
    probabilities = [1e-9, 0.001, 0.025, 0.3, 0.5, 0.975, 0.999, 1 - 1e-5]
    quantiles = [chi2_quantile(probability, degrees) for probability in probabilities]
    assert quantiles == pytest.approx(scipy.stats.chi2.ppf(probabilities, degrees), rel=1e-9)
    values = [0.0, *quantiles, quantiles[-1] * 1.5 + 10, np.inf]
    assert [chi2_sf(v, degrees) for v in values] == pytest.approx(
        scipy.stats.chi2.sf(values, degrees), rel=1e-8, abs=1e-300
    )
    assert [chi2_cdf(v, degrees) for v in values] == pytest.approx(scipy.stats.chi2.cdf(values, degrees), rel=1e-8)


@pytest.mark.parametrize(("count", "total"), [(0, 10), (1, 776), (776, 776), (9, 5000), (2_000, 1_000_000)])
def test_the_lowest_share_is_that_of_clopper_and_pearson(count: int, total: int) -> None:
    interval = scipy.stats.binomtest(count, total).proportion_ci(0.95, method="exact")
    assert lowest_share(count, total) == pytest.approx(interval.low, rel=1e-9)


@pytest.mark.parametrize("degrees", [1, 2, 3, 4, 9, 30, 999])
@pytest.mark.parametrize("probability", [0.5, 0.9, 0.975, 0.9995])
def test_students_distribution(degrees: int, probability: float) -> None:
    expected = scipy.stats.t.ppf(probability, degrees)
    assert student_quantile(probability, degrees) == pytest.approx(expected, abs=1e-9)
