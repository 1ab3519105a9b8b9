"""Where vehicles were when a frame was sent, and who was then in range of whom."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from vnet.roads.lanes import Array

Mask = NDArray[np.bool_]
Whole = NDArray[np.int64]


class Places:
    """Positions (K, N, 2) of K periods, or of one (K = 1) where nobody moves; NaN where a vehicle was not there.

    `links` (N, N) says who (row) hears whom (column), or is None where `range_m` decides.
    """

    def __init__(self, position_m: Array, moves: bool, period_ns: int, range_m: float, links: Mask | None) -> None:
        self._position_m = position_m
        self._moves = moves
        self._period_ns = period_ns
        self._range_m = range_m
        self.links = links

    def index(self, time_ns: Whole) -> Whole:
        """Which of the K positions count at these instants."""
        return np.asarray(time_ns // self._period_ns if self._moves else np.zeros_like(time_ns))

    def known(self, time_ns: Whole) -> Mask:
        """At which instants positions are known: a run may end within a period, of which no states are kept."""
        return np.asarray(self.index(time_ns) < len(self._position_m))

    def present(self) -> Mask:
        """(K, N), who was there."""
        return np.isfinite(self._position_m[..., 0])

    def position_m(self, index: int) -> Array:
        """(N, 2) of one of the K; the last of them for all later ones."""
        return np.asarray(self._position_m[min(index, len(self._position_m) - 1)])

    def distance_m(self, index: int) -> Array:
        """(N, N) between vehicles."""
        position_m = self.position_m(index)
        offset = position_m[:, None] - position_m[None]
        return np.asarray(np.hypot(offset[..., 0], offset[..., 1]))

    def in_range(self, index: int) -> Mask:
        """(N, N), rows are senders: who is in range of whom."""
        distance_m = self.distance_m(index)
        in_range = distance_m <= self._range_m if self.links is None else self.links.T & np.isfinite(distance_m)
        np.fill_diagonal(in_range, False)
        return np.asarray(in_range)

    def pair_distances_m(self, sender: NDArray[np.intp], receiver: NDArray[np.intp], time_ns: Whole) -> Array:
        """How far the two of each pair (n,) are apart at these instants; NaN where that is not known."""
        there = self.known(time_ns)
        index, sender, receiver = self.index(time_ns)[there], sender[there], receiver[there]
        offset = self._position_m[index, sender] - self._position_m[index, receiver]
        distance_m = np.full(len(there), np.nan)
        distance_m[there] = np.hypot(offset[:, 0], offset[:, 1])
        return distance_m

    def pairs_in_range(self, sender: NDArray[np.intp], receiver: NDArray[np.intp], time_ns: Whole) -> Mask:
        """Which pairs of vehicles are in range at these instants; none where that is not known."""
        distance_m = self.pair_distances_m(sender, receiver, time_ns)
        if self.links is None:
            near = distance_m <= self._range_m
        else:
            near = self.links[receiver, sender] & np.isfinite(distance_m)
        return np.asarray(near & (sender != receiver))

    @cached_property
    def _degrees(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """(K, N) each: how many are in range of a sender, and how many a receiver has in range."""
        matrices = (self.in_range(index) for index in range(len(self._position_m)))
        both = [(in_range.sum(axis=1), in_range.sum(axis=0)) for in_range in matrices]
        out, into = zip(*both, strict=True) if both else ((), ())
        shape = self._position_m.shape[:2]
        return np.array(out, np.intp).reshape(shape), np.array(into, np.intp).reshape(shape)

    def receivers_in_range(self, sender: NDArray[np.intp], time_ns: Whole) -> NDArray[np.intp]:
        """How many were in range of each of these senders at these instants; -1 where that is not known."""
        count = np.full(len(sender), -1, dtype=np.intp)
        there = self.known(time_ns)
        count[there] = self._degrees[0][self.index(time_ns)[there], sender[there]]
        return count

    def senders_in_range(self, index: int) -> NDArray[np.intp]:
        """(N,), how many each receiver has in range."""
        return np.asarray(self._degrees[1][min(index, len(self._position_m) - 1)])

    def mean_senders_in_range(self) -> Array:
        """(N,), how many each receiver has in range, in the mean over the time in which it is there."""
        there = self.present().sum(axis=0)
        return np.asarray(self._degrees[1].sum(axis=0) / np.maximum(there, 1))

    @property
    def most_in_range(self) -> int:
        """How many senders any receiver ever had in range."""
        return int(self._degrees[1].max(initial=0))

    @cached_property
    def ever_lonely(self) -> Mask:
        """(N,), who had nobody in range, or was not there itself, at some time, and somebody at another."""
        lonely = self._degrees[0] == 0
        return np.asarray(lonely.any(axis=0) & ~lonely.all(axis=0))

    def was_lonely(self, sender: int, time_ns: Whole) -> Mask:
        """(n - 1,), whether a sender had nobody in range at some time between one of n instants and the next."""
        lonely = np.concatenate([[0], np.cumsum(self._degrees[0][:, sender] == 0)])
        index = np.minimum(self.index(time_ns), len(self._position_m) - 1)
        return np.asarray(lonely[index[1:] + 1] > lonely[index[:-1]])
