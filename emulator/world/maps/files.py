"""Map files of all kinds, told apart by their names: reading and writing."""

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


def read_roads(path: Path, origin_deg: tuple[float, float] | None = None) -> Roads:
    """Read a map. `origin_deg` (latitude, longitude) is where its metres start.

    Without it they start in the middle of the map, or where a file that is in metres says.

    Raises ScenarioError in one line that names the file, and the line or the feature.
    """
    reader = _of(path, READERS)
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
    """Write a map. Raises ScenarioError."""
    writer = writer_of(path)
    try:
        writer(roads, path)
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be written: {error.strerror}") from None


def writer_of(path: Path) -> Callable[[Roads, Path], None]:
    """What writes files of this name. Raises ScenarioError where nothing does."""
    return _of(path, WRITERS)


def _of(path: Path, table: dict[str, _T]) -> _T:
    for ending, entry in table.items():
        if path.name.lower().endswith(ending):
            return entry
    raise ScenarioError(f"{path}: no kind of map is called so; allowed are {', '.join('*' + end for end in table)}")
