"""Maps as lines in GeoJSON (RFC 7946, always WGS-84), read and written.

Properties of a line: `class`, `lanes_forward` and `lanes_backward` (or `oneway`), `lane_width_m`; or, without
`class`, OpenStreetMap's `highway` and its other tags. Features that are not lines are skipped and counted.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from emulator.world.maps.roads import (
    CLASSES,
    LANE_WIDTH_M,
    MAX_LANE_WIDTH_M,
    MAX_LANES,
    MIN_LANE_WIDTH_M,
    NAMES,
    NUMBER,
    UNKNOWN,
    Roads,
    RoadsBuilder,
    Street,
    street,
)
from vnet.bounded import read_bounded
from vnet.errors import ScenarioError, printable, shown
from vnet.types import Array

LARGEST_BYTES = 512 * 2**20
"""Largest file that is read."""
_WGS84_NAMES = ("CRS84", "EPSG::4326", "EPSG:4326")
"""Parts of the names of WGS-84 as a coordinate reference system."""
_SAME_DIGITS = 7
"""Decimals of a degree to which equal points agree (1 cm)."""
_DIGITS = 9
"""Decimals of a degree that are written (0.1 mm)."""


class Geometry(msgspec.Struct):
    """Geometry of a feature: its type, and coordinates, whose nesting depends on the type."""

    type: str
    coordinates: list[Any] = []


class Feature(msgspec.Struct):
    """A geometry with its properties."""

    geometry: Geometry | None = None
    properties: dict[str, Any] | None = None


class Collection(msgspec.Struct):
    """A feature collection."""

    type: str
    features: list[Feature]
    crs: Any = None


def read_geojson(path: Path, origin_deg: tuple[float, float] | None) -> Roads:
    """Read roads; the origin is their centre unless given. Raise ScenarioError, naming the feature, for a bad file.

    Points that are equal to seven decimals are the same, so that lines that meet are joined roads.
    """
    builder = RoadsBuilder(path)
    for number, feature in enumerate(read_collection(path).features):
        _add_feature(path, builder, number, feature)
    return builder.build_from_degrees(origin_deg)


def read_collection(path: Path) -> Collection:
    """Read a collection of features in WGS-84. Raise ScenarioError for a bad file."""
    try:
        collection = msgspec.json.decode(read_bounded(path, LARGEST_BYTES), type=Collection)
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, RecursionError) as error:  # msgspec's errors are ValueErrors
        raise ScenarioError(f"{path}: not a GeoJSON feature collection: {printable(str(error), 300)}") from None
    if collection.type != "FeatureCollection":
        raise ScenarioError(f"{path}: type = {shown(collection.type)}: a FeatureCollection is needed")
    if collection.crs is not None and not any(name in str(collection.crs) for name in _WGS84_NAMES):
        raise ScenarioError(f"{path}: crs = {shown(collection.crs)}: convert it to WGS-84 first")
    return collection


def check_on_earth(where: str, degrees: Array) -> None:
    """Raise ScenarioError unless these longitudes and latitudes (n, 2) are on the earth."""
    beyond = ~(np.abs(degrees) <= [180.0, 90.0])
    if beyond.any():
        at, axis = np.argwhere(beyond)[0].tolist()
        quantity, most = (("longitude", 180), ("latitude", 90))[axis]
        raise ScenarioError(f"{where}: {quantity} = {degrees[at, axis]:g}: not within ±{most}; is it WGS-84?")


def _add_feature(path: Path, builder: RoadsBuilder, number: int, feature: Feature) -> None:
    where = f"{path}: feature {number}"
    geometry, properties = feature.geometry, feature.properties or {}
    if geometry is None or geometry.type not in ("LineString", "MultiLineString"):
        builder.note("features that are not lines")
        return
    if "highway" in properties and "class" not in properties:
        found = street({key: str(value).lower() for key, value in properties.items()})
    else:
        found = _own_street(where, properties)
    if found is None:
        builder.note("ways not for cars")
        return
    lines = [geometry.coordinates] if geometry.type == "LineString" else geometry.coordinates
    name = f"feature {number}"
    for line in lines:
        points = _points(where, line)
        builder.add(name, points[::-1] if found.reversed else points, found.kind, found.lanes, found.lane_width_m)


def _own_street(where: str, properties: dict[str, Any]) -> Street:
    name = properties.get("class", NAMES[UNKNOWN])
    kind = NUMBER.get(name) if isinstance(name, str) else None
    if kind is None:
        raise ScenarioError(f"{where}: class = {shown(name)}: allowed are {', '.join(NAMES)}")
    one_way = properties.get("oneway") in (True, 1, "yes", "true", "1")
    usual = CLASSES[NAMES[kind]].lanes
    lanes = [
        _number(where, properties, "lanes_forward", usual, 0, MAX_LANES),
        _number(where, properties, "lanes_backward", 0 if one_way else usual, 0, MAX_LANES),
    ]
    if not any(lanes) or any(count % 1 for count in lanes):
        raise ScenarioError(f"{where}: lanes_forward, lanes_backward = {lanes}: integers, not both 0, are needed")
    usual_m = float(LANE_WIDTH_M[kind])
    width_m = _number(where, properties, "lane_width_m", usual_m, MIN_LANE_WIDTH_M, MAX_LANE_WIDTH_M)
    return Street(kind, (int(lanes[0]), int(lanes[1])), float(width_m), False)


def _number(where: str, properties: dict[str, Any], key: str, usual: float, least: float, most: float) -> float:
    value = properties.get(key, usual)
    if not isinstance(value, int | float) or not least <= value <= most:
        raise ScenarioError(f"{where}: {key} = {shown(value)}: {least:g} to {most:g} allowed")
    return value


def _points(where: str, line: Any) -> list[tuple[object, tuple[float, float]]]:
    """Return the points of a line as (key, (longitude, latitude)); equal points have equal keys."""
    try:
        found = msgspec.convert(line, list[list[float]])
    except ValueError:
        found = []
    if len(found) < 2 or any(len(point) < 2 for point in found):
        raise ScenarioError(f"{where}: its coordinates are not a line of two or more points")
    degrees = np.array([point[:2] for point in found])
    check_on_earth(where, degrees)
    keys = np.round(degrees * 10**_SAME_DIGITS).astype(np.int64).tolist()
    return [((east, north), (lon, lat)) for (east, north), (lon, lat) in zip(keys, degrees.tolist(), strict=True)]


def write_geojson(roads: Roads, path: Path) -> None:
    """Write the centre lines. Raise ScenarioError if the roads' projection is unknown."""
    if roads.frame is None:
        raise ScenarioError(f"{path}: GeoJSON is in degrees, and the projection of this map is unknown")
    degrees: Array = np.column_stack(roads.frame.to_wgs84(roads.node_m)[::-1]).round(_DIGITS)
    if not np.isfinite(degrees).all():
        raise ScenarioError(
            f"{path}: GeoJSON is in degrees, and some points of this map are outside its projection"
        )
    lines = np.split(roads.node, roads.first[1:-1])
    features = [
        {
            "type": "Feature",
            "properties": {
                "name": roads.name[road],
                "class": NAMES[roads.kind[road]],
                "lanes_forward": int(roads.forward[road]),
                "lanes_backward": int(roads.backward[road]),
                "lane_width_m": float(roads.lane_width_m[road]),
            },
            "geometry": {"type": "LineString", "coordinates": degrees[line].tolist()},
        }
        for road, line in enumerate(lines)
    ]
    path.write_bytes(msgspec.json.encode({"type": "FeatureCollection", "features": features}))
