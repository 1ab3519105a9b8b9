"""Quantiles and tails of the χ² and the binomial distribution.

scipy.stats has them as well, but importing it takes longer than many a run; these use the special functions that it
uses, and import them on first use.
"""

from __future__ import annotations

from typing import cast

import numpy as np
from numpy.typing import ArrayLike

from vnet.types import Array


def chi2_cdf(value: float, degrees: int) -> float:
    """Return the probability that a χ² variable of so many degrees of freedom is at most `value`."""
    from scipy.special import chdtr

    return float(chdtr(degrees, value))


def chi2_sf(value: float, degrees: int) -> float:
    """Return the probability that a χ² variable of so many degrees of freedom is greater than `value`."""
    from scipy.special import chdtrc

    return float(chdtrc(degrees, value))


def chi2_quantiles(probabilities: ArrayLike, degrees: int) -> Array:
    """Return the values that a χ² variable of so many degrees of freedom exceeds with 1 − probability."""
    from scipy.special import gammaincinv

    return np.asarray(2 * gammaincinv(degrees / 2, probabilities))


def binomial_interval(share: float, trials: int, probability: float) -> tuple[int, int]:
    """Return the least and the most successes within the central interval of this share of a binomial variable."""
    tail = (1 - share) / 2
    return _binomial_quantile(tail, trials, probability), _binomial_quantile(1 - tail, trials, probability)


def _binomial_quantile(quantile: float, trials: int, probability: float) -> int:
    """Return the least number of successes whose cumulative probability reaches `quantile`, by bisection."""
    from scipy.special import bdtr

    least, most = 0, trials
    while least < most:
        middle = (least + most) // 2
        if cast(float, bdtr(middle, trials, probability)) >= quantile:
            most = middle
        else:
            least = middle + 1
    return least


def lowest_share(count: int, total: int, tail: float = 0.025) -> float:
    """Return the lower end of the confidence interval of a share, `count` of `total` (Clopper and Pearson 1934).

    A true share below it gives `count` or more with a probability of at most `tail`.
    """
    if count == 0:
        return 0.0
    from scipy.special import betaincinv

    return float(betaincinv(count, total - count + 1, tail))
