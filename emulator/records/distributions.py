"""Quantiles and tails of the χ², the binomial and Student's t distribution.

scipy has them as well, but it is an extra, and its import takes longer than many a run. A quantile is found by
bisection; results agree with scipy's to nine digits.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from vnet.types import Array

WINDOW_SIGMAS, WINDOW_COUNTS = 10, 60
"""Half of the window of a binomial variable: what lies beyond it has a probability of less than 1e-20."""
ROUNDING = 1e-12
"""Relative error up to which a cumulative probability has reached a quantile."""
BISECTIONS = 100
"""Halvings of an interval; after that many its ends are neighbouring numbers."""


def chi2_cdf(value: float, degrees: int) -> float:
    """Return the probability that a χ² variable of so many degrees of freedom is at most `value`."""
    return _gamma_tails(degrees / 2, value / 2)[0]


def chi2_sf(value: float, degrees: int) -> float:
    """Return the probability that a χ² variable of so many degrees of freedom is greater than `value`."""
    return _gamma_tails(degrees / 2, value / 2)[1]


def chi2_quantile(probability: float, degrees: int) -> float:
    """Return the value that a χ² variable of so many degrees of freedom exceeds with 1 − probability."""
    highest = degrees + 20 * math.sqrt(2 * degrees) + 100
    return _root(lambda value: chi2_cdf(value, degrees) >= probability, 0.0, highest)


def _root(is_reached: Callable[[float], bool], low: float, high: float) -> float:
    """Return the value between `low` and `high` from which on a condition holds."""
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        if is_reached(middle):
            high = middle
        else:
            low = middle
    return high


def _gamma_tails(shape: float, value: float) -> tuple[float, float]:
    """Return both regularized incomplete gamma functions, P and Q.

    Below the mean P is the series, above it Q the continued fraction (Abramowitz and Stegun 6.5.29 and 6.5.31, by
    Lentz's method); the other one is small nowhere there.
    """
    if value <= 0:
        return 0.0, 1.0
    if math.isinf(value):
        return 1.0, 0.0
    density = math.exp(shape * math.log(value) - value - math.lgamma(shape))
    if value < shape + 1:
        term = total = 1 / shape
        n = shape
        while term > total * 1e-17:
            n += 1
            term *= value / n
            total += term
        return density * total, 1 - density * total
    b = value + 1 - shape
    c, d = math.inf, 1 / b
    fraction, step, n = d, 0.0, 0.0
    while abs(step - 1) > 1e-15:
        n += 1
        factor = n * (shape - n)
        b += 2
        d = 1 / (factor * d + b)
        c = b + factor / c
        step = c * d
        fraction *= step
    return 1 - density * fraction, density * fraction


def binomial_interval(share: float, trials: int, probability: float) -> tuple[int, int]:
    """Return the least and the most successes within the central interval of this share of a binomial variable."""
    tail = (1 - share) / 2
    least, chances = _binomial(trials, probability)
    reached = np.searchsorted(np.cumsum(chances), np.array([tail, 1 - tail]) * (1 - ROUNDING))
    low, high = least + np.minimum(reached, len(chances) - 1)
    return int(low), int(high)


def _binomial(trials: int, probability: float) -> tuple[int, Array]:
    """Return the probabilities of the counts of successes around the mean, and the least of these counts."""
    if probability in (0, 1):
        return round(trials * probability), np.ones(1)
    mean = trials * probability
    half = WINDOW_SIGMAS * math.sqrt(mean * (1 - probability)) + WINDOW_COUNTS
    counts = np.arange(max(0, math.floor(mean - half)), min(trials, math.ceil(mean + half)) + 1)
    odds = probability / (1 - probability)
    log_chance = np.concatenate([[0.0], np.cumsum(np.log((trials - counts[:-1]) / counts[1:] * odds))])
    chance = np.exp(log_chance - log_chance.max())
    return int(counts[0]), chance / chance.sum()


def lowest_share(count: int, total: int, tail: float = 0.025) -> float:
    """Return the lower end of the confidence interval of a share, `count` of `total` (Clopper and Pearson 1934).

    A true share below it gives `count` or more with a probability of at most `tail`.
    """
    if count == 0:
        return 0.0

    def is_likely(share: float) -> bool:
        least, chances = _binomial(total, share)
        return float(chances[max(0, count - least) :].sum()) >= tail

    return _root(is_likely, 0.0, count / total)


def student_quantile(probability: float, degrees: int) -> float:
    """Return the value that a variable of Student's t exceeds with 1 − probability, which is at least a half."""
    angle = _root(lambda angle: (1 + _student_share(angle, degrees)) / 2 >= probability, 0.0, math.pi / 2)
    return math.sqrt(degrees) * math.tan(angle)


def _student_share(angle: float, degrees: int) -> float:
    """Return the probability of |t| ≤ √degrees · tan(angle) (Abramowitz and Stegun 26.7.3 and 26.7.4)."""
    sine, cosine = math.sin(angle), math.cos(angle)
    term, total = (cosine, 0.0) if degrees % 2 else (1.0, 0.0)
    for k in range(1 + degrees % 2, degrees, 2):
        total += term
        term *= cosine**2 * k / (k + 1)
    return 2 / math.pi * (angle + sine * total) if degrees % 2 else sine * total
