"""Robust statistics: the median of estimates, and a gate around it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vnet.types import Array

GATE_SIGMAS = 5.0
"""Width of the gate in standard deviations: honest estimates are outside four times in a million."""
GATE_FLOOR_M = 0.25
"""Deviation (m) added in quadrature: filters are somewhat overconfident, and drift apart by chance."""


def median(points: Array) -> Array:
    """Return the coordinate-wise median (d,) of points (n, d); of two it is the middle."""
    ordered = np.sort(points, axis=0)
    count = len(points)
    return np.asarray((ordered[(count - 1) // 2] + ordered[count // 2]) / 2)


def near_the_median(estimates_m: Array, covariances_m2: Array, largest_sigma_m: float) -> NDArray[np.bool_]:
    """Find the estimates (n, 2) with covariances (n, 2, 2) that are near the median of all: a mask (n,).

    A gate around the median of all: d² ≤ g² (σ² + σ_j² + f²), with σ² the median of all variances an axis, and
    σ_j² the variance that j claims, but no more than `largest_sigma_m`². As long as attackers are a minority they
    move the centre no further than honest estimates scatter, and neither a small nor a large covariance helps
    them. A vehicle that knows little and says so, as after a restart, is inside.
    """
    variance = np.einsum("nii->n", covariances_m2) / 2
    usual = median(variance[:, None])[0]
    allowed = usual + np.minimum(variance, largest_sigma_m**2) + GATE_FLOOR_M**2
    offset = estimates_m - median(estimates_m)
    return np.asarray((offset * offset).sum(axis=1) <= GATE_SIGMAS**2 * allowed)
