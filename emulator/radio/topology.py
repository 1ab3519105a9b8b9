"""Topology of the network: nodes in range of each other, link quality, and the senders that peer caps admit."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from emulator.radio.propagation import DIGITS, MeanPower, Nakagami, Obstacles
from emulator.scenario.scenario import Radio, Scenario
from emulator.world.neighbours import Links, links_within
from emulator.world.radio_inputs import LinkTable, RadioInputs
from vnet.types import Array, IntArray, Mask

MOST_IN_MATRICES = 64
"""Largest number of vehicles whose links are kept as matrices of all pairs, the fastest way for few vehicles."""


class Connectivity(ABC):
    """A model of the nodes in range of each other; rows are senders, and no node is in range of itself.

    It depends on positions alone, and all signals in range are equally strong, so that overlapping frames are lost:
    models override what is otherwise with them. `position_m` (N, 2) are positions, `distance_m` (N, N) the
    distances between them.
    """

    @property
    def changes_ns(self) -> IntArray:
        """Times at which the model changes, sorted, each once; none if it depends on positions alone."""
        return np.zeros(0, np.int64)

    def at(self, time_ns: int) -> Connectivity:
        """Return the model as it is at a time."""
        return self

    def losses(self, sender: NDArray[np.intp], receiver: NDArray[np.intp]) -> Array | None:
        """Return the loss probabilities (n,) of pairs in range; None if they are `radio.loss`."""
        return None

    @abstractmethod
    def links(self, position_m: Array) -> Links:
        """Return the pairs of a sender and a receiver in its range."""

    @abstractmethod
    def in_range(self, position_m: Array, distance_m: Array) -> Mask:
        """Return the mask (N, N) of receivers (columns) in range of each sender (rows)."""

    def power_mw(self, position_m: Array, distance_m: Array) -> Array:
        """Return the mean received power (N, N) in mW, 0 out of range; the diagonal is the transmit power."""
        power_mw = self.in_range(position_m, distance_m).astype(float)
        np.fill_diagonal(power_mw, 1.0)
        return power_mw


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
        return Links.of_pairs(position_m, *table.linked_before(scenario.world_ns))
    return connectivity_of(scenario.radio, scenario.run.seed, inputs).links(position_m)


def distances_m(position_m: Array) -> Array:
    """Return the distances (N, N) between positions (N, 2), in metres."""
    offset_m = position_m[:, None, :] - position_m[None, :, :]
    return np.asarray(np.hypot(offset_m[..., 0], offset_m[..., 1]))


class Disc(Connectivity):
    """Unit disc: all nodes within `range_m`, and no others."""

    def __init__(self, range_m: float) -> None:
        self._range_m = range_m

    def links(self, position_m: Array) -> Links:
        """See `Connectivity`."""
        return links_within(position_m, self._range_m)

    def in_range(self, position_m: Array, distance_m: Array) -> Mask:
        """See `Connectivity`."""
        return _without_itself(distance_m <= self._range_m)


class Matrix(Connectivity):
    """Links given by a matrix, independent of positions."""

    def __init__(self, links: Mask) -> None:
        self._links = links

    def links(self, position_m: Array) -> Links:
        """See `Connectivity`."""
        return Links.of_matrix(self.in_range(position_m, position_m[:, :1] - position_m[:, 0]), position_m)

    def in_range(self, position_m: Array, distance_m: Array) -> Mask:
        """See `Connectivity`."""
        return _without_itself(self._links.T & np.isfinite(distance_m))


class Measured(Connectivity):
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


class AboveFloor(Connectivity):
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


@dataclass(frozen=True, slots=True)
class TopologySnapshot:
    """The links at one time: arrays (N, M) whose rows are senders; immutable.

    Column j of a sender's row is the receiver numbered j if `receiver` is None: then M = N, and the arrays are
    matrices of all pairs. Else it is the receiver `receiver[sender, j]`: a row begins with the receivers in range,
    by number, and is filled up with columns that are not in range.

    `position_m` (N, 2) are the positions, NaN for an absent vehicle.

    `in_range` marks the links in range, and `admitted` those that the receiver's peer cap admits. `power_mw` is the
    mean received power in mW and `fading` the shape of the fading as `Nakagami.shape` returns it; both are None
    without a physical radio, and with one the arrays are matrices. `loss` is the probability with which a frame is
    lost on a link in range; None if it is `radio.loss`.
    """

    position_m: Array
    distance_m: Array
    in_range: Mask
    admitted: Mask
    power_mw: Array | None = None
    fading: NDArray[np.intp] | None = None
    receiver: NDArray[np.intp] | None = None
    loss: Array | None = None

    def receivers(self, sender: int) -> NDArray[np.intp] | slice:
        """Return the index that takes the columns of a sender's row from an array over all nodes (N,)."""
        return slice(None) if self.receiver is None else self.receiver[sender]


class Topology:
    """The topology `now`, recomputed when vehicles move or go up or down.

    Positions are (N, 2) in metres, NaN for an absent vehicle. Powers are computed only if `nakagami` is given.
    """

    def __init__(
        self, position_m: Array, connectivity: Connectivity, max_peers: int, nakagami: Nakagami | None = None
    ) -> None:
        self._connectivity = connectivity.at(0)
        self._changes_ns = connectivity.changes_ns
        self._valid_ns = self._span(0)
        self._max_peers = max_peers
        self._nakagami = nakagami
        self._position_m = position_m.copy()
        self._links: Links | None = None
        self._is_ranked = False
        self.up = np.ones(len(position_m), dtype=bool)
        self._now: TopologySnapshot
        self._link()

    @property
    def now(self) -> TopologySnapshot:
        """The present snapshot."""
        if not self._is_ranked:
            self._now = replace(self._now, admitted=self._admitted())
            self._is_ranked = True
        return self._now

    @property
    def links(self) -> Links:
        """The present pairs of a sender and a receiver in its range."""
        if self._links is None:
            self._links = Links.of_matrix(self._now.in_range, self._position_m)
        return self._links

    def admitted_links(self) -> Links:
        """Return the present pairs of a sender and a receiver whose peer cap admits it."""
        links = self.now
        if links.receiver is None:
            return Links.of_matrix(links.admitted, self._position_m)
        sender, column = np.nonzero(links.admitted)
        return Links(len(self.up), sender, links.receiver[sender, column], links.distance_m[sender, column])

    def advance(self, time_ns: int) -> None:
        """Let links be as they are at a time, where they are given over time."""
        first_ns, end_ns = self._valid_ns
        if not first_ns <= time_ns < end_ns:
            self._connectivity = self._connectivity.at(time_ns)
            self._valid_ns = self._span(time_ns)
            self._link()

    def _span(self, time_ns: int) -> tuple[float, float]:
        """Return the times from which and until which links are as they are at a time."""
        index = int(np.searchsorted(self._changes_ns, time_ns, side="right"))
        first_ns = self._changes_ns[index - 1].item() if index else -np.inf
        end_ns = self._changes_ns[index].item() if index < len(self._changes_ns) else np.inf
        return first_ns, end_ns

    def move(self, position_m: Array) -> None:
        """Move the vehicles to `position_m` (N, 2). Where all of them stand, nothing is computed again."""
        if not np.array_equal(position_m, self._position_m, equal_nan=True):
            self._position_m = position_m.copy()
            self._link()

    def _link(self) -> None:
        """Compute the snapshot at the present positions."""
        position_m, self._links = self._position_m, None
        if self._nakagami is None and len(position_m) > MOST_IN_MATRICES:
            self._links = self._connectivity.links(position_m)
            self._now = _snapshot_of(self._links, position_m)
        else:
            self._now = self._matrices(position_m)
        self._now = self._with_losses(self._now)
        self._is_ranked = False

    def _with_losses(self, links: TopologySnapshot) -> TopologySnapshot:
        """Return a snapshot with the losses of its links, if they have any of their own."""
        if not len(self._changes_ns):
            return links
        sender, column = np.nonzero(links.in_range)
        receiver = column if links.receiver is None else links.receiver[sender, column]
        if (losses := self._connectivity.losses(sender, receiver)) is None:
            return links
        loss = np.zeros(links.in_range.shape)
        loss[sender, column] = losses
        return replace(links, loss=loss)

    def _matrices(self, position_m: Array) -> TopologySnapshot:
        """Return the snapshot as matrices of all pairs."""
        distance_m = distances_m(position_m)
        power_mw = fading = None
        if self._nakagami is None:
            in_range = self._connectivity.in_range(position_m, distance_m)
        else:
            power_mw = self._connectivity.power_mw(position_m, distance_m)
            in_range = power_mw > 0  # computing the powers twice would double the time of this method
            np.fill_diagonal(in_range, False)
            fading = self._nakagami.shape(distance_m)
        return TopologySnapshot(
            position_m=position_m,
            distance_m=distance_m,
            in_range=in_range,
            admitted=in_range,
            power_mw=power_mw,
            fading=fading,
        )

    def set_up(self, node: int, up: bool) -> None:
        """Set a node up or down. A node that is down does not count towards any peer cap."""
        self._is_ranked = self._is_ranked and bool(self.up[node]) == up
        self.up[node] = up

    def is_up(self, node: int) -> bool:
        """Return true if a node is up."""
        return bool(self.up[node])

    def _admitted(self) -> Mask:
        """Return the mask of the links whose sender is among the `max_peers` nearest live ones of the receiver.

        It has the shape of `in_range`, in which the links must be. Of senders at one distance the lower number goes
        first.
        """
        links = self._now
        candidate: Mask = links.in_range & self.up[:, None]
        if links.receiver is None:
            if (candidate.sum(axis=0) <= self._max_peers).all():
                return candidate
            far_m = np.where(candidate, links.distance_m, np.inf)
            order = np.argsort(far_m, axis=0, kind="stable")
            rank = np.empty_like(order)
            np.put_along_axis(rank, order, np.arange(len(order))[:, None], axis=0)
            return np.asarray(candidate & (rank < self._max_peers))
        sender, column = np.nonzero(candidate)
        receiver = links.receiver[sender, column]
        each = np.bincount(receiver, minlength=len(candidate))
        order = np.lexsort((links.distance_m[sender, column], receiver))  # stable: pairs are ordered by sender
        rank = np.arange(len(order)) - np.repeat(np.cumsum(each) - each, each)
        beyond = order[rank >= self._max_peers]
        candidate[sender[beyond], column[beyond]] = False
        return candidate


def _snapshot_of(pairs: Links, position_m: Array) -> TopologySnapshot:
    """Return the snapshot of these pairs at these positions, with nobody's peer cap applied."""
    each = pairs.out_degrees()
    shape = pairs.count, int(each.max(initial=0))
    in_range = np.arange(shape[1]) < each[:, None]
    distance_m, receiver = np.full(shape, np.inf), np.zeros(shape, np.intp)
    distance_m[in_range], receiver[in_range] = pairs.distance_m, pairs.receiver
    return TopologySnapshot(
        position_m=position_m, distance_m=distance_m, in_range=in_range, admitted=in_range, receiver=receiver
    )
