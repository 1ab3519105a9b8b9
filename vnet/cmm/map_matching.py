"""Map matching: how likely it is that a vehicle is on a lane of the map.

For a straight lane with normal n and signed offset d of the vehicle's mean, and s² = nᵀP n,

    P(on the lane) = Φ((h − d)/s) − Φ((−h − d)/s)

with h the half-width left to a vehicle's centre. Near the lane Φ comes from a table, because exact ones take a
fifth of the filter's time: log P is off by less than 2·10⁻⁶ for s up to 10 m, and mostly by 10⁻⁹. Far from the
lane it is exact, in the log domain, so that it neither underflows nor cancels: a filter whose particles all score
exactly 0 has lost its way for good.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, ndtr

from vnet.roads.lanes import Array, LaneMap

FAR_SIGMAS = 5.0
"""Beyond this many deviations outside the lane, the difference of two Φ would lose its digits."""

STEPS, REACH = 128, 9
"""The table of Φ: so many steps in a deviation; beyond so many deviations it says 0 or 1, true to 10⁻¹⁸.

A table of finer steps drops out of the processor's cache between two steps of the filter, and is then no faster
than the exact Φ.
"""

OFF_MAP_M = 30.0
"""A vehicle further from every lane that fits is not on this map: its road says nothing about the common error."""


def log_on_lane(offset_m: Array, sigma_m: Array, half_width_m: float) -> Array:
    """log P(on the lane) for offsets (..., K) and deviations that broadcast against them; metres."""
    near = np.abs(offset_m)
    np.subtract(half_width_m, near, out=near)
    near /= sigma_m
    beyond = near - 2 * half_width_m / sigma_m
    inside = normal_cdf(near)
    inside -= normal_cdf(beyond)
    far = near <= -FAR_SIGMAS
    inside[far] = 1.0
    result = np.log(inside, out=inside)
    if far.any():
        # log(Φ(a) − Φ(b)) = log Φ(a) + log(1 − Φ(b)/Φ(a)), a > b.
        upper = log_ndtr(near[far])
        result[far] = upper + np.log1p(-np.exp(log_ndtr(beyond[far]) - upper))
    return np.asarray(result)


def _parabolas() -> tuple[Array, Array, Array]:
    """The parabolas through Φ at the start, the middle and the end of each step of the table, by powers."""
    value = ndtr(np.arange(-2 * STEPS * REACH, 2 * STEPS * REACH + 1) / (2 * STEPS))
    start, middle, end = value[:-1:2], value[1::2], value[2::2]
    slope, bend = 4 * middle - 3 * start - end, 2 * (start - 2 * middle + end)
    slope[[0, -1]] = bend[[0, -1]] = 0.0  # what is beyond the table gets its first or last step, and is constant
    return start.copy(), slope, bend


_START, _SLOPE, _BEND = _parabolas()


def normal_cdf(x: Array) -> Array:
    """Φ(x) by table: off by less than 5·10⁻⁷ of its value for x ≥ −FAR_SIGMAS, and less than 2·10⁻⁹ anywhere."""
    place = x + REACH
    place *= STEPS
    step = place.astype(np.intp)
    place -= step
    value = _BEND.take(step, mode="clip")
    for coefficient in (_SLOPE, _START):
        value *= place
        value += coefficient.take(step, mode="clip")
    return np.asarray(value)


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
