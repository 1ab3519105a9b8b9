"""Lateral offsets of vehicles in their lanes: an Ornstein-Uhlenbeck process with reflecting bounds."""

from __future__ import annotations

import math

import numpy as np

from vnet.types import Array


def lateral_offsets_m(normal: Array, sigma_m: float, correlation: float, half_width_m: float) -> Array:
    """Return offsets (K, …) in metres from standard normal draws (K, …), a step at a time.

    `correlation` is that of successive offsets; at ± `half_width_m` they are reflected.
    """
    offset = np.empty_like(normal)
    offset[0] = _reflect(sigma_m * normal[0], half_width_m)
    for k in range(1, len(normal)):
        step = correlation * offset[k - 1] + sigma_m * math.sqrt(1 - correlation**2) * normal[k]
        offset[k] = _reflect(step, half_width_m)
    return offset


def _reflect(offset_m: Array, half_width_m: float) -> Array:
    """Reflect offsets into ± `half_width_m`."""
    folded = np.mod(offset_m + half_width_m, 4 * half_width_m)
    return np.asarray(np.where(folded > 2 * half_width_m, 4 * half_width_m - folded, folded) - half_width_m)
