"""Divergence of an estimate, as MODEL 6 defines it: a common error over 10 m for 5 s."""

from __future__ import annotations

import numpy as np

from vnet.types import Array
from vnet.units import NS_PER_S

DIVERGENT_M = 10.0
"""Common error above which a vehicle is on its way to divergence, in metres."""
DIVERGENT_S = 5.0
"""Time for which the error has to stay above it, in seconds."""


DIVERGENT_SIGMAS = 5.0
"""Stated deviations of the common error above which a vehicle is, by another definition, on its way there."""


def first_divergences(error_m: Array, period_ns: int, limit: float = DIVERGENT_M) -> dict[int, int]:
    """Return the period in which each divergent vehicle first met the definition, by vehicle, in order of time.

    `error_m` (periods, N) are the common errors, in metres as the `limit` is, or both in stated deviations. NaN,
    where nobody knows or nobody judges, interrupts a divergence.
    """
    needed = max(1, round(DIVERGENT_S * NS_PER_S / period_ns))
    length = np.zeros(error_m.shape[1], dtype=int)
    first: dict[int, int] = {}
    for period, over in enumerate(error_m > limit):
        length = np.where(over, length + 1, 0)
        for node in np.flatnonzero(length == needed).tolist():
            first.setdefault(node, period)
    return first
