"""OpenStreetMap files (XML or PBF), read by pyosmium: the ways that cars may use."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from emulator.world.maps.roads import Roads, RoadsBuilder
from emulator.world.maps.tags import street
from vnet.errors import ScenarioError, printable

if TYPE_CHECKING:
    from osmium.osm import Way

_LONGEST_LINE = 1 << 16
"""Bytes of a line that are searched at once."""


def read_osm(path: Path, origin_deg: tuple[float, float] | None) -> Roads:
    """Read roads; the origin is their centre unless given. Raise ScenarioError, naming the way, for a bad file."""
    try:
        import osmium
    except ImportError:
        raise ScenarioError(
            f"{path}: OpenStreetMap files need pyosmium, which is not installed: pip install 'vnet-emulator[maps]'"
        ) from None
    builder = RoadsBuilder(path)
    try:
        file = osmium.FileProcessor(path).with_locations().with_filter(osmium.filter.KeyFilter("highway"))
        for entity in file:
            if isinstance(entity, osmium.osm.Way):
                _add_way(path, builder, entity)
    except osmium.InvalidLocationError as error:
        value = str(error).partition("'")[2].removesuffix("'")
        raise ScenarioError(f"{path}: {_line_of(path, value)}{printable(str(error), 300)}") from None
    except (RuntimeError, ValueError, OSError) as error:
        raise ScenarioError(f"{path}: not an OpenStreetMap file: {printable(str(error), 300)}") from None
    return builder.build_from_degrees(origin_deg)


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
    points = []
    for node in way.nodes:
        if not node.location.valid():
            raise ScenarioError(
                f"{path}: {name}: node {node.ref} is not in the file, or not on the earth; "
                "extract maps with complete ways"
            )
        points.append((node.ref, (node.location.lon, node.location.lat)))
    if found.reversed:
        points.reverse()
    builder.add(name, points, found.kind, found.lanes, found.lane_width_m)
