"""Who can hear whom, and whom each receiver's peer cap admits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Surroundings:
    """How things stand between the vehicles, (N, N) each, rows are senders. Never changed once made.

    `distance_m` (N, N); `in_range` is who is in range of whom, and `admitted` whom the receiver's cap lets in.
    """

    distance_m: NDArray[np.float64]
    in_range: NDArray[np.bool_]
    admitted: NDArray[np.bool_]


class Topology:
    """The surroundings as they are `now`, made anew when vehicles move or go up or down.

    Positions are (N, 2) in metres. `links` (N, N), whose rows are receivers, says who is in range of whom in place
    of `range_m`; distances then only rank the peers.
    """

    def __init__(
        self,
        position_m: NDArray[np.float64],
        range_m: float,
        max_peers: int,
        links: NDArray[np.bool_] | None = None,
    ) -> None:
        self._range_m = range_m
        self._links = links
        self._max_peers = max_peers
        self.up = np.ones(len(position_m), dtype=bool)
        self.move(position_m)

    def move(self, position_m: NDArray[np.float64]) -> None:
        """Take new positions."""
        offset_m = position_m[:, None, :] - position_m[None, :, :]
        distance_m = np.hypot(offset_m[..., 0], offset_m[..., 1])
        in_range = distance_m <= self._range_m if self._links is None else self._links.T.copy()
        np.fill_diagonal(in_range, False)
        self._rank(distance_m, in_range)

    def set_up(self, node: int, up: bool) -> None:
        """A node that is down is nobody's peer."""
        self.up[node] = up
        self._rank(self.now.distance_m, self.now.in_range)

    def is_up(self, node: int) -> bool:
        """Whether a node is up."""
        return bool(self.up[node])

    def _rank(self, distance_m: NDArray[np.float64], in_range: NDArray[np.bool_]) -> None:
        """`admitted[s, r]`: sender s is among the `max_peers` nearest live senders in range of receiver r."""
        candidate = in_range & self.up[:, None]
        far_m = np.where(candidate, distance_m, np.inf)
        order = np.argsort(far_m, axis=0, kind="stable")  # ties go to the lower number
        rank = np.empty_like(order)
        np.put_along_axis(rank, order, np.arange(len(order))[:, None], axis=0)
        self.now = Surroundings(distance_m, in_range, candidate & (rank < self._max_peers))
