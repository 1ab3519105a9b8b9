"""Buildings: outlines in metres, as the radio, pictures and the run's folder have them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vnet.types import Array, Mask

LEAST_CORNERS = 3
"""Least corners of a ring."""


@dataclass(frozen=True, eq=False)
class Buildings:
    """The outlines of B buildings: R closed rings with V corners in all, in metres.

    Ring r has the corners `corner_m[first[r]:first[r + 1]]` (at least three) and an edge from the last to the
    first; it is part of the building numbered `building[r]`, 0 … B-1. A point is inside a building if it is inside
    an odd number of its rings, so that a court is a ring of its own. `clipped` buildings are left out, as their
    file lacks nodes of their outlines.
    """

    corner_m: Array
    first: NDArray[np.intp]
    building: NDArray[np.intp]
    clipped: int = 0

    @classmethod
    def of(cls, buildings: Sequence[Sequence[Array]]) -> Buildings:
        """Return buildings given as rings of corners (n, 2) in metres."""
        rings = [np.asarray(ring, dtype=float).reshape(-1, 2) for building in buildings for ring in building]
        first = np.cumsum([0, *map(len, rings)])
        number = np.repeat(np.arange(len(buildings)), [len(building) for building in buildings])
        return cls(np.concatenate([np.zeros((0, 2)), *rings]), first.astype(np.intp), number.astype(np.intp))

    def __len__(self) -> int:
        return int(self.building.max(initial=-1)) + 1

    def edges_m(self) -> Array:
        """Return the ends (V, 2, 2) of all edges: that of each corner goes to the next one of its ring."""
        following = np.arange(1, len(self.corner_m) + 1)
        following[self.first[1:] - 1] = self.first[:-1]
        return np.stack([self.corner_m, self.corner_m[following]], axis=1)

    def edge_buildings(self) -> NDArray[np.intp]:
        """Return the number (V,) of each edge's building."""
        return np.repeat(self.building, np.diff(self.first))

    def boxes_m(self) -> tuple[Array, Array]:
        """Return the lower left and upper right corners (B, 2) of the buildings' bounding boxes."""
        low_m, high_m = np.full((2, len(self), 2), np.inf) * np.array([1, -1])[:, None, None]
        np.minimum.at(low_m, self.edge_buildings(), self.corner_m)
        np.maximum.at(high_m, self.edge_buildings(), self.corner_m)
        return low_m, high_m

    def touching(self, low_m: Array, high_m: Array) -> Buildings:
        """Return the buildings whose bounding boxes touch that from `low_m` to `high_m` (2,)."""
        least_m, most_m = self.boxes_m()
        near = (least_m <= high_m) & (most_m >= low_m)
        return self._of(np.asarray(near.all(axis=1)))

    def largest(self, corners: int) -> Buildings:
        """Return the buildings with the largest bounding boxes, in their order, with at most so many corners."""
        low_m, high_m = self.boxes_m()
        order = np.argsort(-np.prod(high_m - low_m, axis=1), kind="stable")
        each = np.bincount(self.edge_buildings(), minlength=len(self))
        kept = np.zeros(len(self), dtype=bool)
        kept[order[np.cumsum(each[order]) <= corners]] = True
        return self._of(kept)

    def _of(self, kept: Mask) -> Buildings:
        """Return the buildings of a mask (B,)."""
        ring = kept[self.building]
        return Buildings(
            corner_m=self.corner_m[kept[self.edge_buildings()]],
            first=np.append(0, np.cumsum(np.diff(self.first)[ring])).astype(np.intp),
            building=(np.cumsum(kept) - 1)[self.building[ring]].astype(np.intp),
        )

    def moved(self, by_m: Sequence[float]) -> Buildings:
        """Return the buildings moved by metres east and north."""
        return replace(self, corner_m=self.corner_m + np.asarray(by_m)) if any(by_m) else self
