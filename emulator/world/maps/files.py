"""Map files in all formats, distinguished by their names: reading and writing."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from emulator.world.maps.geojson import read_geojson, write_geojson
from emulator.world.maps.graph import read_graph, write_graph
from emulator.world.maps.osm import read_osm
from emulator.world.maps.roads import Roads
from emulator.world.maps.sumo import read_sumo
from vnet.errors import ScenarioError

_T = TypeVar("_T")

READERS: dict[str, Callable[[Path, tuple[float, float] | None], Roads]] = {
    ".osm": read_osm,
    ".pbf": read_osm,
    ".net.xml": read_sumo,
    ".geojson": read_geojson,
    ".json": read_geojson,
    ".npz": read_graph,
}
WRITERS: dict[str, Callable[[Roads, Path], None]] = {
    ".geojson": write_geojson,
    ".json": write_geojson,
    ".npz": write_graph,
}
LARGEST_BYTES = 2**31
"""Largest file that is read."""


def read_roads(path: Path, origin_deg: tuple[float, float] | None = None) -> Roads:
    """Read a map. `origin_deg` (latitude, longitude) is the origin of its metres.

    Without it the origin is the centre of the map, or the one that a file in metres states. Raise ScenarioError, in
    one line that names the file and the line or feature, for a bad file.
    """
    reader = _by_ending(path, READERS)
    try:
        size = path.stat().st_size
        if not path.is_file():
            raise ScenarioError(f"{path}: not a file")
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read: {error.strerror}") from None
    if not size:
        raise ScenarioError(f"{path}: empty")
    if size > LARGEST_BYTES:
        raise ScenarioError(f"{path}: larger than {LARGEST_BYTES} bytes; cut out a part first")
    return reader(path, origin_deg)


def write_roads(roads: Roads, path: Path) -> None:
    """Write a map. Raise ScenarioError if the format is unknown, or the file cannot be written."""
    writer = writer_of(path)
    try:
        writer(roads, path)
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be written: {error.strerror}") from None


def writer_of(path: Path) -> Callable[[Roads, Path], None]:
    """Return the function that writes files of this name. Raise ScenarioError if there is none."""
    return _by_ending(path, WRITERS)


def _by_ending(path: Path, table: dict[str, _T]) -> _T:
    for ending, entry in table.items():
        if path.name.lower().endswith(ending):
            return entry
    raise ScenarioError(f"{path}: unknown map format; allowed are {', '.join('*' + end for end in table)}")
