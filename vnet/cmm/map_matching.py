"""Map matching: how likely it is that a vehicle is on a lane of the map.

For a straight lane with normal n and signed offset d of the vehicle's mean, and s² = nᵀP n,

    P(on the lane) = Φ((h − d)/s) − Φ((−h − d)/s)

with h the half-width left to a vehicle's centre. Far from the lane this is computed in the log domain, so that it
neither underflows nor cancels: a filter whose particles all score exactly 0 has lost its way for good.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, ndtr

from vnet.roads.lanes import Array, LaneMap

FAR_SIGMAS = 5.0
"""Beyond this many deviations outside the lane, the difference of two Φ would lose its digits."""


OFF_MAP_M = 30.0
"""A vehicle further from every lane that fits is not on this map: its road says nothing about the common error."""


def log_on_lane(offset_m: Array, sigma_m: Array, half_width_m: float) -> Array:
    """log P(on the lane) for offsets (..., K) and deviations that broadcast against them; metres."""
    near = np.abs(offset_m)
    np.subtract(half_width_m, near, out=near)
    near /= sigma_m
    width = 2 * half_width_m / sigma_m
    inside = ndtr(near)
    inside -= ndtr(near - width)
    far = near <= -FAR_SIGMAS
    if not far.any():
        return np.asarray(np.log(inside, out=inside))
    with np.errstate(divide="ignore", invalid="ignore"):
        result = np.log(inside)
    near_far, width_far = near[far], np.broadcast_to(width, near.shape)[far]
    upper = log_ndtr(near_far)
    # log(Φ(a) − Φ(b)) = log Φ(a) + log(1 − Φ(b)/Φ(a)), a > b.
    result[far] = upper + np.log1p(-np.exp(log_ndtr(near_far - width_far) - upper))
    return np.asarray(result)


def log_left_of_edge(offset_m: Array, sigma_m: Array, half_width_m: float) -> Array:
    """log P(not beyond the right-hand edge): the paper bounds a lane by the half-plane n·(p − p_lane) < h only."""
    return np.asarray(log_ndtr((half_width_m - offset_m) / sigma_m))


def candidate_lanes(
    lanes: LaneMap,
    position_m: Array,
    heading_rad: float | None,
    gate_m: float,
    heading_tolerance_rad: float = 0.35,
) -> NDArray[np.intp]:
    """Lanes that a vehicle may be on: within `gate_m` of `position_m` (2,), and fitting its heading if known.

    Without a heading all lanes within the gate compete. With none in the gate, the nearest that fits, unless even
    that is too far away to be the vehicle's.
    """
    offset = np.abs(lanes.normal @ position_m - lanes.offset_m)
    fits = np.ones(len(lanes), dtype=bool)
    if heading_rad is not None:
        turn = np.abs(np.mod(lanes.heading_rad - heading_rad + np.pi, 2 * np.pi) - np.pi)
        fits = turn <= heading_tolerance_rad
    if not fits.any():
        return np.empty(0, dtype=np.intp)
    found = np.flatnonzero(fits & (offset <= gate_m))
    if len(found):
        return found
    nearest = int(np.argmin(np.where(fits, offset, np.inf)))
    return np.array([nearest] if offset[nearest] <= OFF_MAP_M else [], dtype=np.intp)
