"""The world as a run's folder keeps it, in `world.npz` and the states, so that no input file has to be there.

`Places` has the positions of vehicles when a frame was sent, and who was then in range of whom.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emulator.radio.topology import Connectivity, distances_m
from emulator.world.buildings import LEAST_CORNERS, Buildings
from emulator.world.input_files import read_arrays
from emulator.world.neighbours import Links
from emulator.world.radio_inputs import LinkTable, RadioInputs
from emulator.world.world import World
from vnet.bounded import open_regular
from vnet.errors import ScenarioError, VnetError
from vnet.types import Array, IntArray, Mask

LARGEST_BYTES = 1 << 30
"""Largest size of one array of the file; the links of ten thousand vehicles take 100 MB."""
ARRAYS: dict[str, tuple[str, str]] = {
    "node_ids": ("U", "n"),
    "position_m": ("f", "n × 2"),
    "area_m": ("f", "2 × 2"),
    "lane_point_m": ("f", "l × 2"),
    "lane_heading_rad": ("f", "l"),
    "lane_length_m": ("f", "l"),
    "links": ("b", "n × n"),
    "link_time_ns": ("i", "q"),
    "link_sender": ("i", "q"),
    "link_receiver": ("i", "q"),
    "link_loss": ("f", "q"),
    "building_corner_m": ("f", "v × 2"),
    "building_first": ("i", "f"),
    "building_number": ("i", "g"),
    "receiver_m": ("f", "k × r × 2"),
}
"""The arrays of the file: kind of number, and shape for n vehicles, l lanes, q rows about links, g rings of
buildings with v corners in all, f = g + 1, k periods and r receivers."""
BUILDINGS = ("building_corner_m", "building_first", "building_number")
LINKS = ("link_time_ns", "link_sender", "link_receiver", "link_loss")
OPTIONAL = ("links", *LINKS, *BUILDINGS, "receiver_m")
"""Arrays that may be missing."""
MOST_KEPT = 1_000_000
"""Links of epochs that are kept, in all (24 MB): several checks ask for them, and buildings make them expensive."""


@dataclass(frozen=True)
class RecordedWorld:
    """The vehicles, the lanes, the links and the buildings of a run.

    `position_m` (n, 2) are positions at time 0, NaN of a vehicle that is not there yet; `area_m` (2, 2) the corners
    of the box in which vehicles are during the run; lanes (l) have a point, a heading and a length from there,
    infinite for a line that goes both ways. `radio_inputs` are links and buildings. `receiver_m` (k, r, 2) is what
    each receiver of a recorded common error has beyond the common one in each period, or None.
    """

    node_ids: tuple[str, ...]
    position_m: Array
    area_m: Array
    lane_point_m: Array
    lane_heading_rad: Array
    lane_length_m: Array
    radio_inputs: RadioInputs
    receiver_m: Array | None = None

    @classmethod
    def of(cls, world: World) -> RecordedWorld:
        """Take from a world what is to be recorded."""
        lanes = world.lane_map
        return cls(
            node_ids=world.node_ids,
            position_m=world.position_m(0),
            area_m=world.area_m,
            lane_point_m=lanes.point_m,
            lane_heading_rad=lanes.heading_rad,
            lane_length_m=lanes.length_m,
            radio_inputs=replace(world.radio_inputs, units=()),
            receiver_m=world.receiver_m,
        )

    @property
    def buildings(self) -> Buildings | None:
        """The buildings between vehicles, where the radio has any."""
        return self.radio_inputs.buildings

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of the file, of `ARRAYS` those that this world has."""
        links, buildings = self.radio_inputs.links, self.radio_inputs.buildings
        arrays: dict[str, Any] = {name: getattr(self, name, None) for name in ARRAYS}
        arrays["node_ids"] = np.array(self.node_ids, dtype=np.str_)
        if isinstance(links, LinkTable):
            arrays |= zip(LINKS, (links.time_ns, links.sender, links.receiver, links.loss), strict=True)
        else:
            arrays["links"] = links
        if buildings is not None:
            arrays |= zip(BUILDINGS, (buildings.corner_m, buildings.first, buildings.building), strict=True)
        return {name: array for name, array in arrays.items() if array is not None}

    def write(self, path: Path) -> None:
        """Write the file. Raises OSError."""
        with path.open("wb") as file:  # by its name, numpy would append to it
            np.savez_compressed(file, allow_pickle=False, **self.arrays())

    @classmethod
    def read(cls, path: Path) -> RecordedWorld:
        """Read the file, which may be anything. Raises VnetError in one line."""
        try:
            open_regular(path).close()
            arrays = read_arrays(path, ARRAYS, LARGEST_BYTES)
        except ScenarioError as error:
            raise VnetError(str(error)) from None
        except ValueError as error:
            raise VnetError(f"{path}: {error}") from None
        _check(path, arrays)
        node_ids, links = tuple(arrays.pop("node_ids").tolist()), arrays.pop("links", None)
        over_time = [arrays.pop(name) for name in LINKS if name in arrays]
        outlines = [arrays.pop(name) for name in BUILDINGS if name in arrays]
        radio_inputs = RadioInputs(
            links=LinkTable(*over_time) if over_time else links,
            buildings=Buildings(outlines[0], outlines[1], outlines[2]) if outlines else None,
        )
        return cls(node_ids=node_ids, radio_inputs=radio_inputs, **arrays)


def _check(path: Path, arrays: dict[str, NDArray[Any]]) -> None:
    """Raise VnetError unless the arrays have their kinds and shapes."""
    sizes = {"2": 2, "n": len(arrays.get("node_ids", ())), "l": len(arrays.get("lane_heading_rad", ()))}
    rings = arrays.get("building_number", np.zeros(0))
    sizes |= {"v": len(arrays.get("building_corner_m", ())), "g": len(rings), "f": len(rings) + 1}
    sizes["q"] = len(arrays.get("link_time_ns", ()))
    sizes |= dict(zip("kr", np.shape(arrays.get("receiver_m", np.zeros((0, 0, 2)))), strict=False))
    for name, (kind, dimensions) in ARRAYS.items():
        if name not in arrays:
            if name not in OPTIONAL:
                raise VnetError(f"{path}: has no array {name!r}")
            continue
        shape = tuple(sizes[dimension] for dimension in dimensions.split(" × "))
        if arrays[name].dtype.kind != kind or arrays[name].shape != shape:
            raise VnetError(f"{path}: {name} is {arrays[name].dtype} {arrays[name].shape}, not {kind} {shape}")
    if _has(path, "links over time", LINKS, arrays):
        ends = np.stack([arrays["link_sender"], arrays["link_receiver"]])
        time_ns, loss = arrays["link_time_ns"], arrays["link_loss"]
        sound = (np.diff(time_ns, prepend=0) >= 0).all() and ((ends >= 0) & (ends < sizes["n"])).all()
        if not sound or not (np.isnan(loss) | ((loss >= 0) & (loss <= 1))).all():
            raise VnetError(f"{path}: link_time_ns, link_sender, link_receiver, link_loss: not links over time")
    if _has(path, "buildings", BUILDINGS, arrays):
        first, number = arrays["building_first"], arrays["building_number"]
        sound = first[0] == 0 and first[-1] == sizes["v"] and (np.diff(first) >= LEAST_CORNERS).all()
        if not sound or not (np.diff(number, prepend=0) >= 0).all() or number.max(initial=0) >= max(len(number), 1):
            raise VnetError(f"{path}: building_first, building_number: not the rings of buildings")


def _has(path: Path, what: str, names: tuple[str, ...], arrays: dict[str, NDArray[Any]]) -> bool:
    """Return whether these arrays are there. Raise VnetError if only some of them are."""
    present = [name for name in names if name in arrays]
    if len(present) not in (0, len(names)):
        raise VnetError(f"{path}: of the arrays of {what} only {', '.join(present)}")
    return bool(present)


class Places:
    """Positions (K, N, 2) of K periods, or of one (K = 1) where nobody moves; NaN where a vehicle was not there.

    `connectivity` says who is in range of whom. That is constant within each of the E *epochs*, which begin with
    periods where vehicles move, and where links are given over time. The last one ends at `end_ns`.
    """

    def __init__(
        self, position_m: Array, moves: bool, period_ns: int, connectivity: Connectivity, end_ns: int
    ) -> None:
        self._position_m = position_m
        self._moves = moves
        self._period_ns = period_ns
        self._connectivity = connectivity
        periods_ns = np.arange(len(position_m)) * period_ns
        self._end_ns = len(position_m) * period_ns if moves else end_ns
        self.is_whole = self._end_ns >= end_ns
        """False if the run ended within a period, in which positions are not known."""
        changes_ns = connectivity.changes_ns
        known = changes_ns < (self._end_ns if len(position_m) else 0)
        self.starts_ns = np.union1d(periods_ns, changes_ns[known])
        """Times at which epochs begin."""
        self._kept: dict[int, Links] = {}
        self._room = MOST_KEPT

    def index(self, time_ns: IntArray) -> IntArray:
        """Index of the position, of the K, at each of these instants."""
        return np.asarray(time_ns // self._period_ns if self._moves else np.zeros_like(time_ns))

    def known(self, time_ns: IntArray) -> Mask:
        """Mask of the instants at which positions are known: those of the periods that the run completed."""
        return np.asarray(self.index(time_ns) < len(self._position_m))

    def present(self) -> Mask:
        """(K, N), who was there."""
        return np.isfinite(self._position_m[..., 0])

    def position_m(self, index: int) -> Array:
        """(N, 2) of one of the K; the last of them for all later ones. Raises VnetError if K is 0."""
        if not len(self._position_m):
            raise VnetError("no period was completed, and no position is known")
        return np.asarray(self._position_m[min(index, len(self._position_m) - 1)])

    def distance_m(self, index: int) -> Array:
        """(N, N) between vehicles."""
        return distances_m(self.position_m(index))

    def links(self, time_ns: int) -> Links:
        """Links of a sender and a receiver in its range."""
        epoch = int(self._epoch(np.array([time_ns]))[0])
        if epoch not in self._kept:
            links = self._connectivity_at(time_ns).links(self._position_at(time_ns))
            if len(links.sender) > self._room:
                return links
            self._kept[epoch], self._room = links, self._room - len(links.sender)
        return self._kept[epoch]

    def _connectivity_at(self, time_ns: int) -> Connectivity:
        self._connectivity = self._connectivity.at(time_ns)  # the next time is often a later one
        return self._connectivity

    def _position_at(self, time_ns: int) -> Array:
        return self.position_m(int(self.index(np.array([time_ns]))[0]))

    def power_mw(self, time_ns: int) -> Array:
        """(N, N), rows are senders: the mean power of signals, 0 out of range."""
        position_m = self._position_at(time_ns)
        return self._connectivity_at(time_ns).power_mw(position_m, distances_m(position_m))

    def pair_distances_m(self, sender: NDArray[np.intp], receiver: NDArray[np.intp], time_ns: IntArray) -> Array:
        """Distances (n,) in m from senders to receivers at these instants; NaN where they are not known."""
        there = self.known(time_ns)
        index, sender, receiver = self.index(time_ns)[there], sender[there], receiver[there]
        offset = self._position_m[index, sender] - self._position_m[index, receiver]
        distance_m = np.full(len(there), np.nan)
        distance_m[there] = np.hypot(offset[:, 0], offset[:, 1])
        return distance_m

    def pairs_in_range(self, sender: NDArray[np.intp], receiver: NDArray[np.intp], time_ns: IntArray) -> Mask:
        """Mask (n,) of the senders and receivers in range at these instants; False where that is not known."""
        found = np.zeros(len(time_ns), dtype=bool)
        for start_ns, rows in self._rows_by_epoch(time_ns):
            found[rows] = self.links(start_ns).contain(sender[rows], receiver[rows])
        return found

    def pair_losses(self, sender: NDArray[np.intp], receiver: NDArray[np.intp], time_ns: IntArray) -> Array | None:
        """Loss probabilities (n,) of pairs in range at these instants; None if they are `radio.loss`."""
        if not len(self._connectivity.changes_ns):
            return None
        found = np.full(len(time_ns), np.nan)
        for start_ns, rows in self._rows_by_epoch(time_ns):
            losses = self._connectivity_at(start_ns).losses(sender[rows], receiver[rows])
            assert losses is not None
            found[rows] = losses
        return found

    def pair_powers_mw(self, sender: NDArray[np.intp], receiver: NDArray[np.intp], time_ns: IntArray) -> Array:
        """With which mean power signals arrive at these instants; 0 out of range, or where that is not known."""
        found = np.zeros(len(time_ns))
        for start_ns, rows in self._rows_by_epoch(time_ns):
            found[rows] = self.power_mw(start_ns)[sender[rows], receiver[rows]]
        return found

    def _epoch(self, time_ns: IntArray) -> NDArray[np.intp]:
        """Number of the epoch at each of these instants; the last one goes on."""
        return np.maximum(np.searchsorted(self.starts_ns, time_ns, side="right") - 1, 0)

    def _rows_by_epoch(self, time_ns: IntArray) -> Iterator[tuple[int, NDArray[np.intp]]]:
        """Yield the start of each epoch and the instants (of n) that are in it, if their positions are known."""
        rows = np.flatnonzero(self.known(time_ns))
        epoch = self._epoch(time_ns[rows])
        order = np.argsort(epoch, kind="stable")
        rows, epoch = rows[order], epoch[order]
        for some in np.split(np.arange(len(rows)), np.flatnonzero(np.diff(epoch)) + 1):
            if len(some):
                yield int(self.starts_ns[epoch[some[0]]]), rows[some]

    @cached_property
    def _degrees(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """(E, N) each: how many are in range of a sender, and how many a receiver has in range."""
        all_pairs = (self.links(start_ns) for start_ns in self.starts_ns.tolist())
        both = [(pairs.out_degrees(), pairs.in_degrees()) for pairs in all_pairs]
        out, into = zip(*both, strict=True) if both else ((), ())
        shape = len(self.starts_ns), self._position_m.shape[1]
        return np.array(out, np.intp).reshape(shape), np.array(into, np.intp).reshape(shape)

    def receivers_in_range(self, sender: NDArray[np.intp], time_ns: IntArray) -> NDArray[np.intp]:
        """Number of vehicles in range of each of these senders at these instants; -1 where that is not known."""
        count = np.full(len(sender), -1, dtype=np.intp)
        there = self.known(time_ns)
        count[there] = self._degrees[0][self._epoch(time_ns[there]), sender[there]]
        return count

    def senders_in_range(self, index: int) -> NDArray[np.intp]:
        """(N,), how many each receiver has in range at the start of a period."""
        return np.asarray(self._degrees[1][self._epoch(np.array([index * self._period_ns]))[0]])

    def mean_senders_in_range(self) -> Array:
        """(N,), how many each receiver has in range, in the mean over the time in which it is there."""
        epoch_ns = np.diff(self.starts_ns, append=self._end_ns)
        present = self.present()[self.index(self.starts_ns)]
        return np.asarray(epoch_ns @ self._degrees[1] / np.maximum(epoch_ns @ present, 1))

    @property
    def most_in_range(self) -> int:
        """Largest number of senders that any receiver ever had in range."""
        return int(self._degrees[1].max(initial=0))

    @cached_property
    def ever_lonely(self) -> Mask:
        """(N,), who had nobody in range, or was not there itself, at some time, and somebody at another."""
        lonely = self._degrees[0] == 0
        return np.asarray(lonely.any(axis=0) & ~lonely.all(axis=0))

    @cached_property
    def always_in_range(self) -> Mask:
        """(N,), who had somebody in range as long as positions are known: each of its frames then has rows."""
        return np.asarray((self._degrees[0] > 0).all(axis=0))

    def were_lonely(self, sender: NDArray[np.intp], start_ns: IntArray, end_ns: IntArray) -> Mask:
        """(n,), whether each of these senders had nobody in range at some time from one instant to another."""
        return np.asarray(self._last_lonely[self._epoch(end_ns), sender] >= self._epoch(start_ns))

    def last_lonely_ns(self, sender: NDArray[np.intp], time_ns: IntArray) -> IntArray:
        """(n,), the last instants up to these at which each of these senders had nobody in range; or else -1."""
        epoch = self._last_lonely[self._epoch(time_ns), sender]
        ends_ns = np.append(self.starts_ns[1:], self._end_ns)
        return np.where(epoch < 0, -1, np.minimum(ends_ns[epoch] - 1, time_ns))

    @cached_property
    def _last_lonely(self) -> NDArray[np.intp]:
        """(E, N), the last epoch up to each in which a sender had nobody in range; -1 if there was none."""
        lonely = self._degrees[0] == 0
        epochs = np.where(lonely, np.arange(len(lonely))[:, None], -1)
        return np.asarray(np.maximum.accumulate(epochs, axis=0))
