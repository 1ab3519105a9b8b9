"""Outlines of buildings in files: OpenStreetMap, GeoJSON, SUMO's polygons, and corners in metres as CSV.

OpenStreetMap's are closed ways and multipolygons with the tag `building`, GeoJSON's the polygons that have it as a
property; `building=no` is none. Courts are rings of their own.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from itertools import groupby
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from emulator.world.buildings import LEAST_CORNERS, Buildings
from emulator.world.csv_file import check_columns, number_within, open_csv
from emulator.world.maps.geojson import check_on_earth, read_collection
from emulator.world.maps.osm import osm_errors
from emulator.world.maps.roads import MAX_POINTS
from emulator.world.maps.sumo import read_sumo_polygons
from emulator.world.networks import MAX_COORDINATE_M
from emulator.world.projection import Frame
from vnet.counted import counted
from vnet.errors import ScenarioError, shown
from vnet.types import Array

COLUMNS = ("building", "x_m", "y_m")
"""Columns of a CSV file: rows with one name in `building`, one after the other, are its corners."""
_LONGEST_LINE = 1000
"""Characters of a line of CSV."""

Rings = list[Array]


def read_buildings(path: Path, frame: Callable[[], Frame]) -> Buildings:
    """Read buildings. `frame` returns the frame of the run's metres; it is called for a file in degrees.

    Raise ScenarioError, in one line that names the file and the line or feature, for a bad file.
    """
    ending = path.suffix.lower()
    if ending == ".csv":
        return Buildings.of(_some(path, _read_csv(path)))
    if path.name.lower().endswith(".poly.xml"):
        return Buildings.of(_some(path, [[np.array(corners)] for corners in read_sumo_polygons(path)]))
    if ending in (".osm", ".pbf"):
        found = _read_osm(path)
    elif ending in (".geojson", ".json"):
        found = _read_geojson(path)
    else:
        raise ScenarioError(
            f"{path}: no buildings are read from it; allowed are *.csv, *.osm, *.pbf, *.geojson, *.poly.xml"
        )
    return _projected(path, Buildings.of(_some(path, found)), frame())


def _some(path: Path, buildings: list[Rings]) -> list[Rings]:
    if not buildings:
        raise ScenarioError(f"{path}: no buildings in it")
    return buildings


def _projected(path: Path, degrees: Buildings, frame: Frame) -> Buildings:
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
    with open_csv(path, _LONGEST_LINE) as lines:
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


def _read_osm(path: Path) -> list[Rings]:
    buildings: list[Rings] = []
    corners = 0
    with osm_errors(path):
        import osmium

        tagged = osmium.filter.KeyFilter("building")
        for entity in osmium.FileProcessor(path).with_areas(tagged).with_filter(tagged):
            if not isinstance(entity, osmium.osm.Area) or entity.tags["building"] == "no":
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
    return buildings


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
