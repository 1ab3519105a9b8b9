"""OpenStreetMap files (XML or PBF), read by pyosmium: the ways that cars may use."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from emulator.world.maps.roads import Roads, RoadsBuilder
from emulator.world.maps.tags import street
from vnet.errors import ScenarioError, printable

if TYPE_CHECKING:
    from osmium.osm import Way

CLIPPED = "ways clipped where the file lacks their nodes"
"""Count in `Roads.notes` of ways that leave the part of a map that was cut out."""
_UNDEFINED_DEG = 200.0
"""Nodes that a file lacks have a longitude beyond it."""
_LONGEST_LINE = 1 << 16
"""Bytes of a line that are searched at once."""


def read_osm(path: Path, origin_deg: tuple[float, float] | None) -> Roads:
    """Read roads; the origin is their centre unless given. Raise ScenarioError, naming the way, for a bad file."""
    builder = RoadsBuilder(path)
    with osm_errors(path):
        import osmium

        file = osmium.FileProcessor(path).with_locations().with_filter(osmium.filter.KeyFilter("highway"))
        for entity in file:
            if isinstance(entity, osmium.osm.Way):
                _add_way(path, builder, entity)
    if clipped := builder.is_empty and builder.notes.get(CLIPPED, 0):
        raise ScenarioError(f"{path}: it lacks the nodes of its {clipped} ways: extract maps with their nodes")
    return builder.build_from_degrees(origin_deg)


@contextmanager
def osm_errors(path: Path) -> Iterator[None]:
    """Raise ScenarioError in place of pyosmium's errors, also if it is not installed."""
    try:
        import osmium
    except ImportError:
        raise ScenarioError(
            f"{path}: OpenStreetMap files need pyosmium, which is not installed: pip install 'vnet-emulator[maps]'"
        ) from None
    try:
        yield
    except osmium.InvalidLocationError as error:
        value = str(error).partition("'")[2].removesuffix("'")
        raise ScenarioError(f"{path}: {_line_of(path, value)}{printable(str(error), 300)}") from None
    except (RuntimeError, ValueError, OSError) as error:
        raise ScenarioError(f"{path}: not an OpenStreetMap file: {printable(str(error), 300)}") from None


def _line_of(path: Path, value: str) -> str:
    """Return `line N: ` of a quoted value in an XML file, or nothing: pyosmium gives lines only for bad XML."""
    quoted, line = value.encode(), 1
    with path.open("rb") as file:
        while part := file.readline(_LONGEST_LINE):
            if b'"' + quoted + b'"' in part or b"'" + quoted + b"'" in part:
                return f"line {line}: "
            line += part.endswith(b"\n")
    return ""


def _add_way(path: Path, builder: RoadsBuilder, way: Way) -> None:
    found = street(dict(way.tags))
    if found is None:
        builder.note("ways not for cars")
        return
    name = f"way {way.id}"
    if len(way.nodes) < 2:
        raise ScenarioError(f"{path}: {name}: {len(way.nodes)} nodes; a road needs two")
    pieces = _pieces(path, way)
    if len(pieces) != 1 or len(pieces[0]) != len(way.nodes):
        builder.note(CLIPPED)
    for points in pieces:
        if found.reversed:
            points.reverse()
        if len(points) > 1:
            builder.add(name, points, found.kind, found.lanes, found.lane_width_m)


def _pieces(path: Path, way: Way) -> list[list[tuple[int, tuple[float, float]]]]:
    """Return the points of a way, (node, (longitude, latitude)), in pieces between nodes that the file lacks."""
    pieces: list[list[tuple[int, tuple[float, float]]]] = [[]]
    for node in way.nodes:
        if node.location.valid():
            pieces[-1].append((node.ref, (node.location.lon, node.location.lat)))
        elif abs(node.location.lon_without_check()) > _UNDEFINED_DEG:
            pieces.append([])
        else:
            raise ScenarioError(f"{path}: way {way.id}: node {node.ref} is not on the earth")
    return [piece for piece in pieces if piece]
