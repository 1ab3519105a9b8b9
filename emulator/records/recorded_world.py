"""The world as a run's folder keeps it beside the states, so that no input file has to be there: `world.npz`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emulator.world.arrays import read_arrays
from emulator.world.world import World
from vnet.errors import ScenarioError, VnetError
from vnet.types import Array, Mask

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
    "receiver_m": ("f", "k × r × 2"),
}
"""The arrays of the file: kind of number, and shape for n vehicles, l lanes, k periods and r receivers."""
OPTIONAL = ("links", "receiver_m")
"""Arrays that may be missing."""


@dataclass(frozen=True)
class RecordedWorld:
    """The vehicles, the lanes, and `radio.links` of a run.

    `position_m` (n, 2) are positions at time 0, NaN of a vehicle that is not there yet; `area_m` (2, 2) the corners
    of the box in which vehicles are during the run; lanes (l) have a point, a heading and a length from there,
    infinite for a line that goes both ways. `links` (n, n) is who (row) hears whom (column), or None; `receiver_m`
    (k, r, 2) is what each receiver of a recorded common error has beyond the common one in each period, or None.
    """

    node_ids: tuple[str, ...]
    position_m: Array
    area_m: Array
    lane_point_m: Array
    lane_heading_rad: Array
    lane_length_m: Array
    links: Mask | None = None
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
            links=world.links,
            receiver_m=world.receiver_m,
        )

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
            arrays = read_arrays(path, ARRAYS, LARGEST_BYTES)
        except ScenarioError as error:
            raise VnetError(str(error)) from None
        _check(path, arrays)
        node_ids = tuple(arrays.pop("node_ids").tolist())
        return cls(node_ids=node_ids, **arrays)


def _check(path: Path, arrays: dict[str, NDArray[Any]]) -> None:
    """Raise VnetError unless the arrays have their kinds and shapes."""
    sizes = {"2": 2, "n": len(arrays.get("node_ids", ())), "l": len(arrays.get("lane_heading_rad", ()))}
    sizes |= dict(zip("kr", np.shape(arrays.get("receiver_m", np.zeros((0, 0, 2)))), strict=False))
    for name, (kind, dimensions) in ARRAYS.items():
        if name not in arrays:
            if name not in OPTIONAL:
                raise VnetError(f"{path}: has no array {name!r}")
            continue
        shape = tuple(sizes[dimension] for dimension in dimensions.split(" × "))
        if arrays[name].dtype.kind != kind or arrays[name].shape != shape:
            raise VnetError(f"{path}: {name} is {arrays[name].dtype} {arrays[name].shape}, not {kind} {shape}")
