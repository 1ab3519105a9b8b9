"""How vehicles stray across their lanes: an Ornstein-Uhlenbeck process between two mirrors."""

from __future__ import annotations

import math

import numpy as np

from vnet.types import Array


def stray(normal: Array, sigma_m: float, keep: float, half_width_m: float) -> Array:
    """Offsets (K, …) in metres from standard normal numbers (K, …), one step after the other.

    `keep` is the correlation of two successive ones; at ± `half_width_m` they are reflected.
    """
    offset = np.empty_like(normal)
    offset[0] = _reflect(sigma_m * normal[0], half_width_m)
    for k in range(1, len(normal)):
        step = keep * offset[k - 1] + sigma_m * math.sqrt(1 - keep**2) * normal[k]
        offset[k] = _reflect(step, half_width_m)
    return offset


def _reflect(offset_m: Array, half_width_m: float) -> Array:
    """Fold offsets back into ±half_width, as between two mirrors."""
    folded = np.mod(offset_m + half_width_m, 4 * half_width_m)
    return np.asarray(np.where(folded > 2 * half_width_m, 4 * half_width_m - folded, folded) - half_width_m)
