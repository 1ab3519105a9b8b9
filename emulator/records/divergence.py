"""Divergence of an estimate, as MODEL 6 defines it: a common error over 10 m for 5 s."""

from __future__ import annotations

import numpy as np

from vnet.types import Array, Mask
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
    return first_lasting(error_m > limit, period_ns, DIVERGENT_S)


def first_lasting(holds: Mask, period_ns: int, duration_s: float) -> dict[int, int]:
    """Return the period in which a condition (periods, N) had first held for `duration_s`, by vehicle."""
    needed = max(1, round(duration_s * NS_PER_S / period_ns))
    length = np.zeros(holds.shape[1], dtype=int)
    first: dict[int, int] = {}
    for period, over in enumerate(holds):
        length = np.where(over, length + 1, 0)
        for node in np.flatnonzero(length == needed).tolist():
            first.setdefault(node, period)
    return first
