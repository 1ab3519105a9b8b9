"""Number of particles by the spread of the belief: KLD sampling (Fox 2003).

To be within ε of a distribution over k cells, by the Kullback-Leibler distance, a sample needs

    K = (k − 1) / 2ε · (1 − 2 / 9(k − 1) + √(2 / 9(k − 1)) z)³

with the probability of which z is the normal quantile. Here k is the number of cells that the ellipse of three
deviations covers: it is known before a particle is drawn.
"""

from __future__ import annotations

import math

from vnet.types import Array

CELL_M = 0.1
"""Side (m) of a cell: a fraction of what one fix tells."""
DISTANCE = 0.1
"""Kullback-Leibler distance ε."""
QUANTILE = 2.326
"""z of 99 %."""
ELLIPSE_SIGMAS = 3.0
"""Deviations within which cells count."""


def sample_size(covariance_m2: Array, least: int, most: int) -> int:
    """Return the number of particles, between `least` and `most`, for a covariance (2, 2)."""
    (a, b), (_, d) = covariance_m2.tolist()
    area_m2 = math.pi * ELLIPSE_SIGMAS**2 * math.sqrt(max(a * d - b * b, 0.0))
    more = area_m2 / CELL_M**2 - 1
    if more <= 1:
        return least
    term = 2 / (9 * more)
    wanted = more / (2 * DISTANCE) * (1 - term + math.sqrt(term) * QUANTILE) ** 3
    return round(min(max(wanted, least), most))
