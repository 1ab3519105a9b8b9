"""Map files in all formats, by their names: roads, buildings, and the part that programs get.

OpenStreetMap's are closed ways and multipolygons with the tag `building`, GeoJSON's the polygons that have it as a
property; `building=no` is none. Courts are rings of their own.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec
import numpy as np

from emulator.scenario.network import OSM_ENDINGS, Map, Network
from emulator.world.buildings import LEAST_CORNERS, Buildings
from emulator.world.input_files import check_columns, number_within, open_csv
from emulator.world.maps.city import city_roads
from emulator.world.maps.formats import (
    check_on_earth,
    read_collection,
    read_geojson,
    read_graph,
    read_sumo,
    read_sumo_polygons,
    write_geojson,
    write_graph,
)
from emulator.world.maps.roads import MAX_POINTS, Roads, RoadsBuilder, street
from emulator.world.networks import MAX_COORDINATE_M
from emulator.world.projection import CoordinateFrame
from vnet.errors import ScenarioError, counted, printable, shown
from vnet.extras import require
from vnet.roads.road_map import RoadMap
from vnet.types import Array

if TYPE_CHECKING:
    from osmium.osm import Way

CLIPPED = "ways clipped where the file lacks their nodes"
"""Count in `Roads.notes` of ways that leave the part of a map that was cut out."""
NODES_FIRST = "nodes come before ways, with ids above 0"
"""Order of OpenStreetMap's files, so that they can be read in one pass."""
_UNDEFINED_DEG = 200.0
"""Nodes that a file lacks have a longitude beyond it."""
_LONGEST_LINE = 1 << 16
"""Bytes of a line that are searched at once."""
FAR_M = 100.0
"""Distance to the nearest lane beyond which a position is off the map."""
SAMPLES = 5000
"""Positions that are tested for it."""
COLUMNS = ("building", "x_m", "y_m")
"""Columns of a CSV file: rows with one name in `building`, one after the other, are its corners."""
_LONGEST_ROW = 1000
"""Characters of a line of CSV."""
Rings = list[Array]
_T = TypeVar("_T")
WRITERS: dict[str, Callable[[Roads, Path], None]] = {
    ".geojson": write_geojson,
    ".json": write_geojson,
    ".npz": write_graph,
}
LARGEST_BYTES = 2**31
"""Largest file that is read."""
_DELETED = re.compile(rb"""<way\b[^>]*\saction=["']delete["']""")
"""A way that is deleted once JOSM uploads it."""


def read_osm(path: Path, origin_deg: tuple[float, float] | None) -> Roads:
    """Read roads; the origin is their centre unless given. Raise ScenarioError, naming the way, for a bad file."""
    builder = RoadsBuilder(path)
    with osm_errors(path):
        import osmium

        # All ways, as one that has been deleted or is no road any more has no tags in its last version.
        ways = osmium.FileProcessor(path).with_locations().with_filter(osmium.filter.EntityFilter(osmium.osm.WAY))
        last = 0, 0
        for way in ways:
            assert isinstance(way, osmium.osm.Way)
            before, last = last, (way.id, way.version)
            if before[0] == way.id and before != last:  # files with history have the versions of a way side by side
                raise ScenarioError(f"{path}: way {way.id} is there in two versions: no map of one day")
            if "highway" in way.tags:
                if way.deleted:
                    builder.note("deleted ways")
                else:
                    _add_way(path, builder, way)
    if clipped := builder.is_empty and builder.notes.get(CLIPPED, 0):
        raise ScenarioError(f"{path}: it lacks the nodes of its {clipped} ways; {NODES_FIRST}")
    return builder.build_from_degrees(origin_deg)


@contextmanager
def osm_errors(path: Path) -> Iterator[None]:
    """Raise ScenarioError in place of pyosmium's errors, also if it is not installed."""
    require(f"{path}: a file of OpenStreetMap", "osmium", error=ScenarioError)
    import osmium

    try:
        # Of objects that JOSM's user has deleted pyosmium does not tell.
        if path.suffix == ".osm" and (line := _line_of(path, _DELETED)):
            raise ScenarioError(f"{path}: {line}deleted in JOSM: upload it there, or purge it, before saving")
        yield
    except osmium.InvalidLocationError as error:
        value = str(error).partition("'")[2].removesuffix("'")
        quoted = re.compile(b"[\"']" + re.escape(value.encode()) + b"[\"']")
        raise ScenarioError(f"{path}: {_line_of(path, quoted)}{printable(str(error), 300)}") from None
    except (RuntimeError, ValueError, OSError) as error:
        raise ScenarioError(f"{path}: not an OpenStreetMap file: {printable(str(error), 300)}") from None


def _line_of(path: Path, text: re.Pattern[bytes]) -> str:
    """Return `line N: ` of a text in an XML file, or nothing: pyosmium gives lines only for bad XML."""
    line = 1
    with path.open("rb") as file:
        while part := file.readline(_LONGEST_LINE):
            if text.search(part):
                return f"line {line}: "
            line += part.endswith(b"\n")
    return ""


def _add_way(path: Path, builder: RoadsBuilder, way: Way) -> None:
    found = street(dict(way.tags))
    if found is None:
        builder.note("ways not for cars")
        return
    name, pieces = f"way {way.id}", _pieces(path, way)
    if len(way.nodes) < 2:
        builder.note("ways with less than two points")
    elif len(pieces) != 1 or len(pieces[0]) != len(way.nodes):
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


def lanes_around(roads: Roads, section: Map, course_m: Array) -> RoadMap:
    """Return the lanes of `[map]`, read as `roads`, around the positions `course_m` (K, N, 2) of all vehicles.

    Raise ScenarioError if most positions are off the map.
    """
    position_m = course_m[np.isfinite(course_m[..., 0])]
    lanes = lanes_in_box(roads, section, position_m.min(axis=0), position_m.max(axis=0))
    if lanes is None or _far_share(lanes, position_m) > 0.5:
        x, y = np.median(position_m, axis=0)
        (left, low), (right, high) = roads.node_m.min(axis=0), roads.node_m.max(axis=0)
        raise ScenarioError(
            f"{section.path}: most positions of vehicles are over {FAR_M:g} m from all roads: vehicles are around "
            f"({x:.0f}, {y:.0f}) m, and the roads from ({left:.0f}, {low:.0f}) to ({right:.0f}, {high:.0f}) m; "
            "check origin_deg and the projection"
        )
    return lanes


def lanes_in_box(roads: Roads, section: Map, low_m: Array, high_m: Array) -> RoadMap | None:
    """Return the lanes of `[map]` within its margin of the box from `low_m` to `high_m` (2,); None without any."""
    part = roads.within(low_m - section.margin_m, high_m + section.margin_m)
    if not len(part):
        return None
    lanes = part.lane_map(section.drive_on, section.sigma_m)
    point_m = lanes.point_m
    if section.aside_m:
        point_m = point_m + section.aside_m * lanes.normal
    if any(section.datum_m):
        point_m = point_m + np.array(section.datum_m)
    return replace(lanes, point_m=point_m, datum_sigma_m=section.datum_sigma_m)


def notes_of(path: Path, roads: Roads) -> tuple[str, ...]:
    """Return the line for the user about a map that was cut from a larger one."""
    clipped = roads.notes.get(CLIPPED, 0)
    return (f"{path}: {CLIPPED}: {clipped}",) if clipped else ()


def _far_share(lanes: RoadMap, position_m: Array) -> float:
    sample_m = position_m[:: max(1, len(position_m) // SAMPLES)]
    row, _, _ = lanes.near(sample_m, np.full(len(sample_m), np.nan), np.full(len(sample_m), FAR_M))
    return 1 - len(np.unique(row)) / len(sample_m)


def read_buildings(path: Path, frame: Callable[[], CoordinateFrame]) -> Buildings:
    """Read buildings. `frame` returns the frame of the run's metres; it is called for a file in degrees.

    Raise ScenarioError, in one line that names the file and the line or feature, for a bad file.
    """
    ending = path.suffix.lower()
    if ending == ".csv":
        return Buildings.of(_some(path, _read_csv(path)))
    if path.name.lower().endswith(".poly.xml"):
        return Buildings.of(_some(path, [[np.array(corners)] for corners in read_sumo_polygons(path)]))
    clipped = 0
    if ending in OSM_ENDINGS:
        found, clipped = _read_osm(path)
    elif ending in (".geojson", ".json"):
        found = _read_geojson(path)
    else:
        raise ScenarioError(
            f"{path}: no buildings are read from it; allowed are *.csv, *.osm, *.pbf, *.geojson, *.poly.xml"
        )
    return replace(_projected(path, Buildings.of(_some(path, found, clipped)), frame()), clipped=clipped)


def _some(path: Path, buildings: list[Rings], clipped: int = 0) -> list[Rings]:
    if not buildings and clipped:
        raise ScenarioError(f"{path}: it lacks the nodes of its {clipped} buildings; {NODES_FIRST}")
    if not buildings:
        raise ScenarioError(f"{path}: no buildings in it")
    return buildings


def _projected(path: Path, degrees: Buildings, frame: CoordinateFrame) -> Buildings:
    """Return buildings in metres; their corners are longitudes and latitudes."""
    longitude, latitude = degrees.corner_m.T
    corner_m = frame.to_local(latitude, longitude)
    if not (np.abs(corner_m) <= MAX_COORDINATE_M).all():
        raise ScenarioError(f"{path}: buildings are too far from the origin of the run's metres; check origin_deg")
    return Buildings(corner_m, degrees.first, degrees.building)


def _bounded(path: Path, corners: int) -> None:
    if corners > MAX_POINTS:
        raise ScenarioError(f"{path}: more than {MAX_POINTS} corners; cut out a part first")


# Corners in metres.


def _read_csv(path: Path) -> list[Rings]:
    rows: list[tuple[str, int, tuple[float, float]]] = []
    with open_csv(path, _LONGEST_ROW) as lines:
        reader = csv.DictReader(lines)
        check_columns(path, reader, COLUMNS)
        for row in reader:
            x_m, y_m = (
                number_within(path, reader.line_num, row, column, MAX_COORDINATE_M) for column in COLUMNS[1:]
            )
            rows.append(((row["building"] or "").strip(), reader.line_num, (x_m, y_m)))
            _bounded(path, len(rows))
    rings: dict[str, tuple[str, Array]] = {}
    for name, group in groupby(rows, key=lambda row: row[0]):
        ring = list(group)
        where = f"{path}: line {ring[0][1]}: building = {shown(name)}"
        if not name:
            raise ScenarioError(f"{where}: a name is needed")
        if name in rings:
            raise ScenarioError(f"{where}: its corners have to stand in rows one after the other")
        rings[name] = where, np.array([corner for _, _, corner in ring])
    return [[_open_ring(where, corners)] for where, corners in rings.values()]


def _open_ring(where: str, corners: Array) -> Array:
    """Return a ring without the repetition of its first corner at its end. Raise ScenarioError if it is no area."""
    if len(corners) > 1 and (corners[0] == corners[-1]).all():
        corners = corners[:-1]
    if len(set(map(tuple, corners.tolist()))) < LEAST_CORNERS:  # np.unique takes ten times as long
        raise ScenarioError(f"{where}: {counted(len(corners), 'corner')}; three different ones are needed")
    return corners


# Degrees.


def _read_osm(path: Path) -> tuple[list[Rings], int]:
    """Return the buildings, and how many ways of others lack nodes."""
    buildings: list[Rings] = []
    corners = clipped = 0
    with osm_errors(path):
        import osmium

        tagged = osmium.filter.KeyFilter("building")
        for entity in osmium.FileProcessor(path).with_areas(tagged).with_filter(tagged):
            if not isinstance(entity, osmium.osm.Way | osmium.osm.Area):
                continue
            if entity.deleted or entity.tags["building"] == "no":
                continue
            if isinstance(entity, osmium.osm.Way):
                clipped += not all(node.location.valid() for node in entity.nodes)
                continue
            rings = [
                np.array([(node.lon, node.lat) for node in ring][:-1])
                for outer in entity.outer_rings()
                for ring in (outer, *entity.inner_rings(outer))
            ]
            if rings:  # an outline that crosses itself has none
                buildings.append(rings)
                corners += sum(map(len, rings))
                _bounded(path, corners)
    return buildings, clipped


def _read_geojson(path: Path) -> list[Rings]:
    buildings: list[Rings] = []
    corners = 0
    for number, feature in enumerate(read_collection(path).features):
        geometry = feature.geometry
        kind = (feature.properties or {}).get("building")
        if geometry is None or kind in (None, False, "no") or geometry.type not in ("Polygon", "MultiPolygon"):
            continue
        polygons = [geometry.coordinates] if geometry.type == "Polygon" else geometry.coordinates
        where = f"{path}: feature {number}"
        for polygon in polygons:
            buildings.append(_rings(where, polygon))
            corners += sum(map(len, buildings[-1]))
            _bounded(path, corners)
    return buildings


def _rings(where: str, polygon: Any) -> Rings:
    """Return the rings (n, 2) of a polygon in GeoJSON, longitude and latitude."""
    try:
        found = msgspec.convert(polygon, list[list[list[float]]])
        rings = [np.array([(x, y) for x, y, *_ in ring], dtype=float).reshape(-1, 2) for ring in found]
    except ValueError:  # also a point of one number
        rings = []
    if not rings:
        raise ScenarioError(f"{where}: its coordinates are not rings of three or more points")
    for ring in rings:
        check_on_earth(where, ring)
    return [_open_ring(where, ring) for ring in rings]


READERS: dict[str, Callable[[Path, tuple[float, float] | None], Roads]] = {
    ".osm": read_osm,
    ".pbf": read_osm,
    ".net.xml": read_sumo,
    ".geojson": read_geojson,
    ".json": read_geojson,
    ".npz": read_graph,
}


def read_roads(path: str | Path, origin_deg: tuple[float, float] | None = None) -> Roads:
    """Read a map. `origin_deg` (latitude, longitude) is the origin of its metres.

    Without it the origin is the centre of the map, or the one that a file in metres states. Raise ScenarioError, in
    one line that names the file and the line or feature, for a bad file.
    """
    path = Path(path)
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


def roads_of(network: Network, section: Map | None) -> tuple[object, Roads]:
    """Return the roads of `[map]`, or without it of a generated city, behind what messages call them.

    Raise ScenarioError if they cannot be read.
    """
    if section is None:
        return "the generated city", city_roads(network.seed, network.size_m)
    return section.path, read_roads(section.path, section.origin_deg)


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
