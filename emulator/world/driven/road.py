"""Geometry of the road of driven vehicles: a straight one or a ring, with parallel lanes in one direction."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vnet.types import Array


@dataclass(frozen=True)
class Road:
    """A road from the origin to the east, or a ring around the origin, counter-clockwise.

    Positions on it are `along_m`, in m from its start, and `left_m`, to the left of the rightmost lane's centre.
    On a ring `along_m` counts along the rightmost lane, so vehicles further left cover as much of it a second.
    """

    length_m: float
    lanes: int
    lane_width_m: float
    is_ring: bool

    @property
    def radius_m(self) -> float:
        """Radius of a ring's rightmost lane."""
        return self.length_m / (2 * math.pi)

    def place(self, along_m: Array, left_m: Array) -> tuple[Array, Array]:
        """Return positions (N, 2) in m and headings (N,) in [0, 2π) at these positions (N,) on the road."""
        if not self.is_ring:
            return np.column_stack([along_m, left_m]), np.zeros(len(along_m))
        angle = np.mod(along_m, self.length_m) / self.radius_m
        radius_m = self.radius_m - left_m
        position_m = np.column_stack([radius_m * np.cos(angle), radius_m * np.sin(angle)])
        return position_m, np.mod(angle + math.pi / 2, 2 * math.pi)

    def area_m(self, furthest_m: float) -> Array:
        """Return the corners (2, 2) of a box around the road, of a straight one as far as `furthest_m`."""
        if self.is_ring:
            return np.array([[-self.radius_m] * 2, [self.radius_m] * 2])
        return np.array([[0.0, 0.0], [min(furthest_m, self.length_m), (self.lanes - 1) * self.lane_width_m]])

    def ahead(self, along_m: Array, left_m: Array, width_m: float, range_m: float) -> NDArray[np.intp]:
        """Return the number (N,) of the vehicle ahead of each, the next that it would run into; -1 if none is.

        Positions on the road are (N,), NaN for an absent vehicle. Vehicles are in each other's way if they overlap
        across the road, at `width_m` each. Centres further away than `range_m` do not count.
        """
        found = np.full(len(along_m), -1, dtype=np.intp)
        there = np.flatnonzero(np.isfinite(along_m))
        at_m = np.mod(along_m[there], self.length_m) if self.is_ring else along_m[there]
        order = np.argsort(at_m, kind="stable")
        number, at_m = there[order], at_m[order]
        seeking = np.arange(len(number))
        if self.is_ring:
            number, at_m = np.concatenate([number, number]), np.concatenate([at_m, at_m + self.length_m])
        across_m = left_m[number]
        for step in range(1, len(there)):
            seeking = seeking[seeking + step < len(number)]
            seeking = seeking[at_m[seeking + step] - at_m[seeking] <= range_m]
            if not len(seeking):
                break
            meets = np.abs(across_m[seeking + step] - across_m[seeking]) < width_m
            found[number[seeking[meets]]] = number[seeking[meets] + step]
            seeking = seeking[~meets]
        return found

    def distance_m(self, along_m: Array, ahead_m: Array) -> Array:
        """Return the way (N,) along the road from positions to others ahead."""
        return np.mod(ahead_m - along_m, self.length_m) if self.is_ring else np.asarray(ahead_m - along_m)
