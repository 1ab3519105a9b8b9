"""Topology of the network: connectivity, link quality, and the senders that each receiver's peer cap admits."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from emulator.radio.connectivity import Connectivity, distances_m
from emulator.radio.propagation import Nakagami
from vnet.types import Array


@dataclass(frozen=True, slots=True)
class TopologySnapshot:
    """The links at one time: matrices (N, N) whose rows are senders; immutable.

    `in_range` marks the links in range, and `admitted` those that the receiver's peer cap admits. `power_mw` is the
    mean received power in mW and `fading` the shape of the fading as `Nakagami.shape` returns it; both are None
    without a physical radio.
    """

    distance_m: Array
    in_range: NDArray[np.bool_]
    admitted: NDArray[np.bool_]
    power_mw: Array | None = None
    fading: NDArray[np.uint64] | None = None


class Topology:
    """The topology `now`, recomputed when vehicles move or go up or down.

    Positions are (N, 2) in metres, NaN for an absent vehicle. Powers are computed only if `nakagami` is given.
    """

    def __init__(
        self, position_m: Array, connectivity: Connectivity, max_peers: int, nakagami: Nakagami | None = None
    ) -> None:
        self._connectivity = connectivity
        self._max_peers = max_peers
        self._nakagami = nakagami
        self.up = np.ones(len(position_m), dtype=bool)
        self.move(position_m)

    def move(self, position_m: Array) -> None:
        """Move the vehicles to `position_m` (N, 2)."""
        distance_m = distances_m(position_m)
        power_mw = fading = None
        if self._nakagami is None:
            in_range = self._connectivity.in_range(position_m, distance_m)
        else:
            power_mw = self._connectivity.power_mw(position_m, distance_m)
            in_range = power_mw > 0  # computing the powers twice would double the time of this method
            np.fill_diagonal(in_range, False)
            fading = self._nakagami.shape(distance_m)
        self.now = TopologySnapshot(
            distance_m=distance_m, in_range=in_range, admitted=in_range, power_mw=power_mw, fading=fading
        )
        self._rank()

    def set_up(self, node: int, up: bool) -> None:
        """Set a node up or down. A node that is down does not count towards any peer cap."""
        self.up[node] = up
        self._rank()

    def is_up(self, node: int) -> bool:
        """Return true if a node is up."""
        return bool(self.up[node])

    def _rank(self) -> None:
        """Set `admitted[s, r]`: sender s is among the `max_peers` nearest live senders in range of receiver r."""
        candidate = self.now.in_range & self.up[:, None]
        far_m = np.where(candidate, self.now.distance_m, np.inf)
        order = np.argsort(far_m, axis=0, kind="stable")  # ties go to the lower number
        rank = np.empty_like(order)
        np.put_along_axis(rank, order, np.arange(len(order))[:, None], axis=0)
        self.now = replace(self.now, admitted=candidate & (rank < self._max_peers))
