"""Maps as lines in GeoJSON (RFC 7946, always WGS-84), read and written.

Properties of a line: `class` (or OpenStreetMap's `highway`), `lanes_forward` and `lanes_backward` (or `oneway`),
`lane_width_m`, `name`. Features that are no lines are left out and counted.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from emulator.world.maps.classes import CLASSES, LANE_WIDTH_M, MOST_LANES, NAMES, NARROWEST_M, NUMBER, UNKNOWN, WIDEST_M
from emulator.world.maps.frame import Frame, frame_around
from emulator.world.maps.roads import Roads, RoadsBuilder
from vnet.bounded import read_bounded
from vnet.errors import ScenarioError, printable, shown
from vnet.roads.lanes import Array

LARGEST_BYTES = 512 * 2**20
_WGS84_NAMES = ("CRS84", "EPSG::4326", "EPSG:4326")
_DIGITS = 7
"""Decimals of a degree: a centimetre."""


class _Geometry(msgspec.Struct):
    type: str
    coordinates: list[Any] = []


class _Feature(msgspec.Struct):
    geometry: _Geometry | None = None
    properties: dict[str, Any] | None = None


class _Collection(msgspec.Struct):
    type: str
    features: list[_Feature]
    crs: Any = None


def read_geojson(path: Path, frame: Frame | None) -> Roads:
    """Read roads; the frame is around their middle unless given. Raises ScenarioError that names the feature.

    Points that are equal to seven decimals are one, so that roads meet where their lines do.
    """
    try:
        collection = msgspec.json.decode(read_bounded(path, LARGEST_BYTES), type=_Collection)
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, RecursionError) as error:  # msgspec's errors are ValueErrors
        raise ScenarioError(f"{path}: not a GeoJSON feature collection: {printable(str(error), 300)}") from None
    if collection.type != "FeatureCollection":
        raise ScenarioError(f"{path}: type = {shown(collection.type)}: a FeatureCollection is needed")
    if collection.crs is not None and not any(name in str(collection.crs) for name in _WGS84_NAMES):
        raise ScenarioError(f"{path}: crs = {shown(collection.crs)}: convert it to WGS-84 first")
    builder = RoadsBuilder(path)
    for number, feature in enumerate(collection.features):
        _add_feature(path, builder, number, feature)
    degrees = builder.places()
    if not len(degrees):
        raise ScenarioError(f"{path}: no lines among {len(collection.features)} features")
    frame = frame or frame_around(degrees[:, 1], degrees[:, 0])
    return builder.build(frame.to_local(degrees[:, 1], degrees[:, 0]), frame)


def _add_feature(path: Path, builder: RoadsBuilder, number: int, feature: _Feature) -> None:
    where = f"{path}: feature {number}"
    geometry, properties = feature.geometry, feature.properties or {}
    if geometry is None or geometry.type not in ("LineString", "MultiLineString"):
        builder.note("features that are no lines")
        return
    name = properties.get("class", properties.get("highway", "road"))
    kind = NUMBER.get(name) if isinstance(name, str) else None
    if kind is None and "class" in properties:
        raise ScenarioError(f"{where}: class = {shown(name)}: allowed are {', '.join(NAMES)}")
    if kind is None:
        builder.note("ways not for cars")
        return
    lanes = _lanes(where, properties, kind)
    width_m = properties.get("lane_width_m", float(LANE_WIDTH_M[kind]))
    if not isinstance(width_m, int | float) or not NARROWEST_M <= width_m <= WIDEST_M:
        raise ScenarioError(
            f"{where}: lane_width_m = {shown(width_m)}: {NARROWEST_M:g} to {WIDEST_M:g} allowed"
        )
    lines = [geometry.coordinates] if geometry.type == "LineString" else geometry.coordinates
    label = str(properties.get("name") or f"feature {number}")
    for line in lines:
        builder.add(label, _points(where, line), kind, lanes, float(width_m))


def _points(where: str, line: Any) -> Iterator[tuple[object, tuple[float, float]]]:
    try:
        degrees = np.array([point[:2] for point in line], dtype=float)
        valid = degrees.ndim == 2 and degrees.shape[1] == 2 and len(degrees) >= 2
    except (TypeError, ValueError, KeyError, OverflowError):
        valid = False
    if not valid:
        raise ScenarioError(f"{where}: its coordinates are no line of two or more points")
    beyond = ~(np.abs(degrees) <= [180.0, 90.0])
    if beyond.any():
        at, axis = np.argwhere(beyond)[0].tolist()
        what, limit = ("longitude", 180), ("latitude", 90)
        which, most = (what, limit)[axis]
        raise ScenarioError(f"{where}: {which} = {degrees[at, axis]:g}: not within ±{most}; is it WGS-84?")
    keys = np.round(degrees * 10**_DIGITS).astype(np.int64).tolist()
    for (east, north), (lon, lat) in zip(keys, degrees.tolist(), strict=True):
        yield (east, north), (lon, lat)


def _lanes(where: str, properties: dict[str, Any], kind: int) -> tuple[int, int]:
    one_way = properties.get("oneway") in (True, 1, "yes", "true", "1")
    each = CLASSES[NAMES[kind]].lanes if "class" in properties or "highway" in properties else 1
    found = []
    for key, default in (("lanes_forward", each), ("lanes_backward", 0 if one_way else each)):
        count = properties.get(key, default)
        if type(count) is not int or not 0 <= count <= MOST_LANES:
            raise ScenarioError(f"{where}: {key} = {shown(count)}: an integer from 0 to {MOST_LANES} is needed")
        found.append(count)
    if not any(found):
        raise ScenarioError(f"{where}: no lanes in either direction")
    return found[0], found[1]


def write_geojson(roads: Roads, path: Path) -> None:
    """Write the centre lines. Raises ScenarioError where nobody knows the roads' place on the earth."""
    if roads.frame is None:
        raise ScenarioError(f"{path}: GeoJSON is in degrees, and nothing says where on the earth this map is")
    degrees: Array = np.column_stack(roads.frame.to_wgs84(roads.node_m)[::-1]).round(_DIGITS)
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
