"""Pairs of positions within a distance of each other, found through a grid of cells; components of a graph.

The cost follows the pairs that are found, and not all pairs there are. The result is that of comparing all pairs,
bit for bit: cells only choose the candidates, whose distances are computed and compared as for any other pair.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vnet.types import Array, Mask

MARGIN = 1e-6
"""Share by which cells are wider than the range: far more than coordinates divided by it are rounded by."""
MOST_CELLS = 1e6
"""Largest number of cells along an axis: beyond it, rounding would exceed the margin."""


@dataclass(frozen=True, slots=True)
class Links:
    """Ordered pairs of `count` vehicles, sorted by sender and then by receiver; nobody is paired with itself.

    `sender` and `receiver` (n,) are numbers of vehicles, `distance_m` (n,) are in metres.
    """

    count: int
    sender: NDArray[np.intp]
    receiver: NDArray[np.intp]
    distance_m: Array

    @classmethod
    def of_matrix(cls, linked: Mask, position_m: Array) -> Links:
        """Return the pairs that a mask (N, N) marks, whose rows are senders."""
        return cls.of_pairs(position_m, *np.nonzero(linked))

    @classmethod
    def of_pairs(cls, position_m: Array, sender: NDArray[np.intp], receiver: NDArray[np.intp]) -> Links:
        """Return these pairs (n,), which are sorted, of vehicles at positions (N, 2)."""
        return cls(len(position_m), sender, receiver, _distances_m(position_m, sender, receiver))

    def of(self, chosen: Mask) -> Links:
        """Return the pairs that a mask (n,) marks."""
        return Links(self.count, self.sender[chosen], self.receiver[chosen], self.distance_m[chosen])

    def matrix(self) -> Mask:
        """Return the mask (N, N) of the pairs; rows are senders."""
        linked = np.zeros((self.count, self.count), dtype=bool)
        linked[self.sender, self.receiver] = True
        return linked

    def out_degrees(self) -> NDArray[np.intp]:
        """Return the number of receivers of each sender (N,)."""
        return np.bincount(self.sender, minlength=self.count)

    def in_degrees(self) -> NDArray[np.intp]:
        """Return the number of senders of each receiver (N,)."""
        return np.bincount(self.receiver, minlength=self.count)

    def contain(self, sender: NDArray[np.intp], receiver: NDArray[np.intp]) -> Mask:
        """Return the mask (n,) of these senders and receivers that are among the pairs."""
        if self.count**2 <= len(sender):
            return np.asarray(self.matrix()[sender, receiver])
        known, asked = self.sender * self.count + self.receiver, sender * self.count + receiver
        if not len(known):
            return np.zeros(len(asked), dtype=bool)
        index = np.minimum(np.searchsorted(known, asked), len(known) - 1)
        return np.asarray(known[index] == asked)


def links_within(position_m: Array, range_m: float) -> Links:
    """Return the pairs of positions (N, 2) at most `range_m` from each other; an absent vehicle (NaN) has none."""
    present = np.flatnonzero(np.isfinite(position_m).all(axis=1))
    sender, receiver = _candidates(position_m[present], range_m)
    sender, receiver = present[sender], present[receiver]
    distance_m = _distances_m(position_m, sender, receiver)
    near = np.flatnonzero((distance_m <= range_m) & (sender != receiver))
    near = near[np.argsort(sender[near] * len(position_m) + receiver[near])]
    return Links(len(position_m), sender[near], receiver[near], distance_m[near])


def _distances_m(position_m: Array, sender: NDArray[np.intp], receiver: NDArray[np.intp]) -> Array:
    offset_m = position_m[sender] - position_m[receiver]
    return np.asarray(np.hypot(offset_m[:, 0], offset_m[:, 1]))


def _candidates(position_m: Array, range_m: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return all pairs (n,), (n,) of finite positions whose cells touch, each with itself among them."""
    if not len(position_m):
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    corner_m = position_m.min(axis=0)
    extent_m = float(np.ptp(position_m, axis=0).max())
    cell_m = max(range_m * (1 + MARGIN), extent_m / MOST_CELLS, np.finfo(float).tiny)
    column, row = np.floor((position_m - corner_m) / cell_m).astype(np.int64).T
    # Cells are numbered column by column, with an empty row before the first and after the last.
    key = (column + 1) * (int(row.max()) + 3) + row + 1
    order = np.argsort(key, kind="stable")
    sorted_key = key[order]
    beside = np.array([-1, 0, 1]) * (int(row.max()) + 3)
    # The cells of three rows in each of three columns: a stretch of the sorted keys for each column.
    first = np.searchsorted(sorted_key, key[:, None] + beside - 1, side="left")
    length = np.searchsorted(sorted_key, key[:, None] + beside + 1, side="right") - first
    each = length.sum(axis=1)
    stretch = np.repeat(first.ravel() - np.append(0, np.cumsum(length.ravel())[:-1]), length.ravel())
    return np.repeat(np.arange(len(key)), each), order[stretch + np.arange(len(stretch))]


def components_of_links(sender: NDArray[np.intp], receiver: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """Return the component (N,) of each of `count` nodes linked by pairs (n,), in one direction or both.

    Components are numbered from 0 in the order of their first nodes, as scipy.sparse.csgraph does; importing that
    takes longer than many a run. Each round gives the first node of a component to those that it is linked with,
    and follows the first nodes' own first nodes to the end, so that the number of rounds grows with the logarithm
    of the diameter.
    """
    first = np.arange(count)
    while True:
        lower = np.minimum(first[sender], first[receiver])
        joined = first.copy()
        np.minimum.at(joined, first[sender], lower)
        np.minimum.at(joined, first[receiver], lower)
        while (joined[joined] != joined).any():
            joined = joined[joined]
        if (joined == first).all():
            return np.asarray(np.unique(first, return_inverse=True)[1], dtype=np.intp)
        first = joined
