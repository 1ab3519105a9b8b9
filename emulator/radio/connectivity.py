"""Who is in range of whom: by the disc, by a matrix, or by the power with which signals arrive on average."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from emulator.radio.propagation import MeanPower
from emulator.scenario.scenario import Radio
from vnet.types import Array, Mask


class Connectivity(Protocol):
    """A law of who is in range of whom; rows are senders, and nobody is in range of itself."""

    def in_range(self, position_m: Array, distance_m: Array) -> Mask:
        """(N, N), for positions (N, 2) and the distances (N, N) between them."""

    def power_mw(self, position_m: Array, distance_m: Array) -> Array:
        """(N, N), the mean power of signals, 0 out of range; on the diagonal what a sender sends with."""


def connectivity_of(radio: Radio, seed: int, links: Mask | None) -> Connectivity:
    """The law that a scenario chooses; `links` (N, N) is `radio.links` as loaded, whose rows are receivers."""
    if radio.path_loss is not None:
        return AboveFloor(MeanPower(radio.path_loss, radio.shadowing, seed), radio.path_loss.floor_dbm)
    return Disc(radio.range_m) if links is None else Matrix(links)


def distances_m(position_m: Array) -> Array:
    """(N, N) between positions (N, 2)."""
    offset_m = position_m[:, None, :] - position_m[None, :, :]
    return np.asarray(np.hypot(offset_m[..., 0], offset_m[..., 1]))


class _Equal:
    """Without a path loss all signals in range are equally strong: wherever two of them meet, neither arrives."""

    def in_range(self, position_m: Array, distance_m: Array) -> Mask:
        """See `Connectivity`."""
        raise NotImplementedError

    def power_mw(self, position_m: Array, distance_m: Array) -> Array:
        """See `Connectivity`."""
        power_mw = self.in_range(position_m, distance_m).astype(float)
        np.fill_diagonal(power_mw, 1.0)
        return power_mw


class Disc(_Equal):
    """Everybody within `range_m`, and nobody else."""

    def __init__(self, range_m: float) -> None:
        self._range_m = range_m

    def in_range(self, position_m: Array, distance_m: Array) -> Mask:
        """See `Connectivity`."""
        return _without_itself(distance_m <= self._range_m)


class Matrix(_Equal):
    """Whom a matrix lets hear, wherever they are."""

    def __init__(self, links: Mask) -> None:
        self._links = links

    def in_range(self, position_m: Array, distance_m: Array) -> Mask:
        """See `Connectivity`."""
        return _without_itself(self._links.T & np.isfinite(distance_m))


class AboveFloor:
    """Everybody at whom a signal arrives, on average, with at least `floor_dbm`."""

    def __init__(self, mean: MeanPower, floor_dbm: float) -> None:
        self.mean = mean
        self._floor_dbm = floor_dbm

    def in_range(self, position_m: Array, distance_m: Array) -> Mask:
        """See `Connectivity`."""
        return _without_itself(self.mean.dbm(position_m, distance_m) >= self._floor_dbm)

    def power_mw(self, position_m: Array, distance_m: Array) -> Array:
        """See `Connectivity`."""
        power_dbm = self.mean.dbm(position_m, distance_m)
        itself = np.eye(len(power_dbm), dtype=bool)
        heard = (power_dbm >= self._floor_dbm) | itself
        return np.asarray(np.where(heard, 10 ** (np.where(heard, power_dbm, 0.0) / 10), 0.0))


def _without_itself(in_range: Mask) -> Mask:
    np.fill_diagonal(in_range, False)
    return in_range
