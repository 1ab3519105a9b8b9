"""The world as a run's folder keeps it beside the states, so that no input file has to be there: `world.npz`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emulator.world.buildings import LEAST_CORNERS, Buildings
from emulator.world.input_files import read_arrays
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


@dataclass(frozen=True)
class RecordedWorld:
    """The vehicles, the lanes, the links and the buildings of a run.

    `position_m` (n, 2) are positions at time 0, NaN of a vehicle that is not there yet; `area_m` (2, 2) the corners
    of the box in which vehicles are during the run; lanes (l) have a point, a heading and a length from there,
    infinite for a line that goes both ways. `links` (n, n) is who (row) hears whom (column), or None; `link_…` are
    the arrays of `LinkTable`, and `building_…` those of `Buildings`, or None; `receiver_m` (k, r, 2) is what each
    receiver of a recorded common error has beyond the common one in each period, or None.
    """

    node_ids: tuple[str, ...]
    position_m: Array
    area_m: Array
    lane_point_m: Array
    lane_heading_rad: Array
    lane_length_m: Array
    links: Mask | None = None
    link_time_ns: IntArray | None = None
    link_sender: NDArray[np.intp] | None = None
    link_receiver: NDArray[np.intp] | None = None
    link_loss: Array | None = None
    building_corner_m: Array | None = None
    building_first: NDArray[np.intp] | None = None
    building_number: NDArray[np.intp] | None = None
    receiver_m: Array | None = None

    @classmethod
    def of(cls, world: World) -> RecordedWorld:
        """Take from a world what is to be recorded."""
        lanes, buildings = world.lane_map, world.radio_inputs.buildings
        links = world.radio_inputs.links
        table = links if isinstance(links, LinkTable) else None
        return cls(
            node_ids=world.node_ids,
            position_m=world.position_m(0),
            area_m=world.area_m,
            lane_point_m=lanes.point_m,
            lane_heading_rad=lanes.heading_rad,
            lane_length_m=lanes.length_m,
            links=None if isinstance(links, LinkTable) else links,
            link_time_ns=None if table is None else table.time_ns,
            link_sender=None if table is None else table.sender,
            link_receiver=None if table is None else table.receiver,
            link_loss=None if table is None else table.loss,
            building_corner_m=None if buildings is None else buildings.corner_m,
            building_first=None if buildings is None else buildings.first,
            building_number=None if buildings is None else buildings.building,
            receiver_m=world.receiver_m,
        )

    @cached_property
    def link_table(self) -> LinkTable | None:
        """Links over time, where the radio has measured ones."""
        if self.link_time_ns is None or self.link_sender is None:
            return None
        if self.link_receiver is None or self.link_loss is None:
            return None
        return LinkTable(self.link_time_ns, self.link_sender, self.link_receiver, self.link_loss)

    @cached_property
    def buildings(self) -> Buildings | None:
        """The buildings between vehicles, where the radio has any."""
        if self.building_corner_m is None or self.building_first is None or self.building_number is None:
            return None
        return Buildings(self.building_corner_m, self.building_first, self.building_number)

    @property
    def radio_inputs(self) -> RadioInputs:
        """Inputs of the radio from files."""
        return RadioInputs(self.links if self.link_table is None else self.link_table, self.buildings)

    def write(self, path: Path) -> None:
        """Write the file. Raises OSError."""
        arrays: dict[str, Any] = {name: getattr(self, name) for name in ARRAYS}
        arrays["node_ids"] = np.array(self.node_ids, dtype=np.str_)
        present = {name: array for name, array in arrays.items() if array is not None}
        with path.open("wb") as file:  # by its name, numpy would append to it
            np.savez_compressed(file, allow_pickle=False, **present)

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
        node_ids = tuple(arrays.pop("node_ids").tolist())
        return cls(node_ids=node_ids, **arrays)


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
