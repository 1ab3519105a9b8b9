"""Connectivity: the nodes in range of each other, by distance, by a matrix, or by the mean received power."""

from __future__ import annotations

from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from emulator.radio.obstacles import Obstacles
from emulator.radio.propagation import DIGITS, MeanPower
from emulator.scenario.scenario import Radio, Scenario
from emulator.world.neighbours import Links, links_within
from emulator.world.radio_inputs import LinkTable, RadioInputs
from vnet.types import Array, IntArray, Mask


class Connectivity(Protocol):
    """A model of the nodes in range of each other; rows are senders, and no node is in range of itself.

    `position_m` (N, 2) are positions, `distance_m` (N, N) the distances between them.
    """

    @property
    def changes_ns(self) -> IntArray:
        """Times at which the model changes, sorted, each once; none if it depends on positions alone."""

    def at(self, time_ns: int) -> Connectivity:
        """Return the model as it is at a time."""

    def losses(self, sender: NDArray[np.intp], receiver: NDArray[np.intp]) -> Array | None:
        """Return the loss probabilities (n,) of pairs in range; None if they are `radio.loss`."""

    def links(self, position_m: Array) -> Links:
        """Return the pairs of a sender and a receiver in its range."""

    def in_range(self, position_m: Array, distance_m: Array) -> Mask:
        """Return the mask (N, N) of receivers (columns) in range of each sender (rows)."""

    def power_mw(self, position_m: Array, distance_m: Array) -> Array:
        """Return the mean received power (N, N) in mW, 0 out of range; the diagonal is the transmit power."""


def connectivity_of(radio: Radio, seed: int, inputs: RadioInputs | None = None) -> Connectivity:
    """Return the model that a scenario configures, with what it has read from files."""
    inputs = inputs or RadioInputs()
    if radio.path_loss is not None:
        obstacles = None
        if radio.buildings is not None and inputs.buildings is not None:
            obstacles = Obstacles(inputs.buildings, radio.buildings)
        mean = MeanPower(radio.path_loss, radio.shadowing, seed, inputs.units)
        return AboveFloor(mean, radio.path_loss.floor_dbm, obstacles)
    if isinstance(inputs.links, LinkTable):
        return Measured(inputs.links)
    return Disc(radio.range_m) if inputs.links is None else Matrix(inputs.links)


def component_links(scenario: Scenario, inputs: RadioInputs, position_m: Array) -> Links:
    """Return the links at the start; where links are given over time and vehicles stand, all links of the run.

    By them vehicles are put into components whose members may ever know of each other.
    """
    table = inputs.links
    if isinstance(table, LinkTable) and not scenario.network.moves:
        return Links.of_pairs(position_m, *table.linked_before(scenario.duration_ns))
    return connectivity_of(scenario.radio, scenario.run.seed, inputs).links(position_m)


def distances_m(position_m: Array) -> Array:
    """Return the distances (N, N) between positions (N, 2), in metres."""
    offset_m = position_m[:, None, :] - position_m[None, :, :]
    return np.asarray(np.hypot(offset_m[..., 0], offset_m[..., 1]))


class _Timeless:
    """A model that depends on positions alone, and leaves losses to `radio.loss`."""

    @property
    def changes_ns(self) -> IntArray:
        """See `Connectivity`."""
        return np.zeros(0, np.int64)

    def at(self, time_ns: int) -> Self | Measured:
        """See `Connectivity`."""
        return self

    def losses(self, sender: NDArray[np.intp], receiver: NDArray[np.intp]) -> Array | None:
        """See `Connectivity`."""
        return None


class _EqualPower(_Timeless):
    """Connectivity without a path loss: all signals in range are equally strong, so overlapping frames are lost."""

    def links(self, position_m: Array) -> Links:
        """See `Connectivity`."""
        raise NotImplementedError

    def in_range(self, position_m: Array, distance_m: Array) -> Mask:
        """See `Connectivity`."""
        raise NotImplementedError

    def power_mw(self, position_m: Array, distance_m: Array) -> Array:
        """See `Connectivity`."""
        power_mw = self.in_range(position_m, distance_m).astype(float)
        np.fill_diagonal(power_mw, 1.0)
        return power_mw


class Disc(_EqualPower):
    """Unit disc: all nodes within `range_m`, and no others."""

    def __init__(self, range_m: float) -> None:
        self._range_m = range_m

    def links(self, position_m: Array) -> Links:
        """See `Connectivity`."""
        return links_within(position_m, self._range_m)

    def in_range(self, position_m: Array, distance_m: Array) -> Mask:
        """See `Connectivity`."""
        return _without_itself(distance_m <= self._range_m)


class Matrix(_EqualPower):
    """Links given by a matrix, independent of positions."""

    def __init__(self, links: Mask) -> None:
        self._links = links

    def links(self, position_m: Array) -> Links:
        """See `Connectivity`."""
        return Links.of_matrix(self.in_range(position_m, position_m[:, :1] - position_m[:, 0]), position_m)

    def in_range(self, position_m: Array, distance_m: Array) -> Mask:
        """See `Connectivity`."""
        return _without_itself(self._links.T & np.isfinite(distance_m))


class Measured(_EqualPower):
    """Links given by a table over time, independent of positions, as they are at `time_ns`."""

    def __init__(self, table: LinkTable, time_ns: int = 0, loss: Array | None = None) -> None:
        self._table, self._time_ns = table, time_ns
        self._sender, self._receiver, _ = table.pairs
        self._loss = table.loss_at(time_ns) if loss is None else loss

    @property
    def changes_ns(self) -> IntArray:
        """See `Connectivity`."""
        return self._table.changes_ns

    def at(self, time_ns: int) -> Measured:
        """See `Connectivity`."""
        if time_ns < self._time_ns:
            return Measured(self._table, time_ns)
        return Measured(self._table, time_ns, self._table.loss_at(time_ns, self._loss, self._time_ns))

    def losses(self, sender: NDArray[np.intp], receiver: NDArray[np.intp]) -> Array:
        """See `Connectivity`."""
        return self._table.of_pairs(self._loss, sender, receiver)

    def links(self, position_m: Array) -> Links:
        """See `Connectivity`."""
        there = np.isfinite(position_m[:, 0])
        linked = np.isfinite(self._loss) & there[self._sender] & there[self._receiver]
        return Links.of_pairs(position_m, self._sender[linked], self._receiver[linked])

    def in_range(self, position_m: Array, distance_m: Array) -> Mask:
        """See `Connectivity`."""
        return self.links(position_m).matrix()


class AboveFloor(_Timeless):
    """All nodes whose mean received power is at least `floor_dbm`, behind buildings too."""

    def __init__(self, mean: MeanPower, floor_dbm: float, obstacles: Obstacles | None = None) -> None:
        self.mean = mean
        self._floor_dbm = floor_dbm
        self._obstacles = obstacles

    def links(self, position_m: Array) -> Links:
        """See `Connectivity`."""
        return Links.of_matrix(self.in_range(position_m, distances_m(position_m)), position_m)

    def in_range(self, position_m: Array, distance_m: Array) -> Mask:
        """See `Connectivity`."""
        return _without_itself(self._dbm(position_m, distance_m) >= self._floor_dbm)

    def _dbm(self, position_m: Array, distance_m: Array) -> Array:
        """Return the mean received power (N, N); -inf where buildings take it below the floor."""
        power_dbm = self.mean.dbm(position_m, distance_m)
        if self._obstacles is None:
            return power_dbm
        margin_db = power_dbm - self._floor_dbm
        loss_db = self._obstacles.loss_db(position_m, np.maximum(margin_db, margin_db.T))
        np.fill_diagonal(loss_db, 0.0)
        return np.round(power_dbm - loss_db, DIGITS)

    def power_mw(self, position_m: Array, distance_m: Array) -> Array:
        """See `Connectivity`."""
        power_dbm = self._dbm(position_m, distance_m)
        itself = np.eye(len(power_dbm), dtype=bool)
        above = (power_dbm >= self._floor_dbm) | itself
        return np.asarray(np.where(above, 10 ** (np.where(above, power_dbm, 0.0) / 10), 0.0))


def _without_itself(in_range: Mask) -> Mask:
    np.fill_diagonal(in_range, False)
    return in_range
