"""Overlap of vehicles in the plane: rectangles with a position and a heading."""

from __future__ import annotations

import numpy as np

from vnet.types import Array, Mask


def rectangles_overlap(
    offset_m: Array, heading_rad: Array, other_rad: Array, length_m: float, width_m: float
) -> Mask:
    """Return the mask (n,) of the pairs of rectangles that overlap, by the separating axis theorem.

    `offset_m` (n, 2) leads from the centre of the one to that of the other; their longer sides, `length_m`, have
    the headings `heading_rad` and `other_rad` (n,). Rectangles that only touch do not overlap.
    """
    turn = other_rad - heading_rad
    lengthwise, across = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    # Half the extent of both along the longer and the shorter side of one of them.
    long_m = (length_m * (1 + lengthwise) + width_m * across) / 2
    wide_m = (width_m * (1 + lengthwise) + length_m * across) / 2
    overlap = np.ones(len(offset_m), dtype=bool)
    for each_rad in (heading_rad, other_rad):
        east, north = np.cos(each_rad), np.sin(each_rad)
        overlap &= np.abs(offset_m[:, 0] * east + offset_m[:, 1] * north) < long_m
        overlap &= np.abs(offset_m[:, 1] * east - offset_m[:, 0] * north) < wide_m
    return overlap
