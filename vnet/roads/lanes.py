"""The digital map of vehicles on straight roads: lanes without labels.

A lane is the straight line through a point with a direction of travel (MODEL 1). Positions are metres in a
local east-north frame; headings are radians counter-clockwise from east, in [0, 2π).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vnet.types import Array


@dataclass(frozen=True)
class LaneMap:
    """All lanes of an area: `point_m` (L, 2), `heading_rad` (L,), and the half-width available to a centre.

    `half_width_m` is the largest distance of a vehicle's centre from the lane's centre line: (3.5 - 1.8) / 2 =
    0.85 m for a 3.5 m lane and a 1.8 m car.
    """

    point_m: Array
    heading_rad: Array
    half_width_m: float

    def __len__(self) -> int:
        return len(self.heading_rad)

    @property
    def length_m(self) -> Array:
        """Lengths (L,): straight lanes have no end."""
        return np.full(len(self), np.inf)

    @property
    def normal(self) -> Array:
        """Unit normals (L, 2), to the right of the direction of travel: (sin θ, -cos θ)."""
        return np.column_stack([np.sin(self.heading_rad), -np.cos(self.heading_rad)])

    @property
    def offset_m(self) -> Array:
        """n·p of each centre line (L,), so that the signed offset of a point q is n·q - offset."""
        return np.asarray(np.einsum("ij,ij->i", self.normal, self.point_m))

    def signed_offset_m(self, position_m: Array, lane: NDArray[np.intp] | int) -> Array:
        """Signed distance of positions (..., 2) from the centre lines of `lane`, positive to the right."""
        across_m = np.sum(position_m * self.normal[lane], axis=-1)
        return np.asarray(across_m - self.offset_m[lane])

    def to_wire(self) -> list[float | list[float]]:
        """Return a plain form for a message; `from_wire` restores it bit by bit."""
        return [self.point_m.ravel().tolist(), self.heading_rad.tolist(), self.half_width_m]

    @classmethod
    def from_wire(cls, data: list[list[float] | float]) -> LaneMap:
        """Restore a map from `to_wire`, bit by bit and read-only. Raises ValueError or TypeError otherwise."""
        points, headings, half_width_m = data
        heading_rad = np.array(headings, dtype=float)
        point_m = np.array(points, dtype=float).reshape(len(heading_rad), 2)
        for array in (heading_rad, point_m):
            array.setflags(write=False)
        return cls(point_m, heading_rad, float(half_width_m))  # type: ignore[arg-type]
