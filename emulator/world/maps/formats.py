"""The formats of map files, beside OpenStreetMap's: GeoJSON, arrays of NumPy, and SUMO's networks.

GeoJSON (RFC 7946, always WGS-84) has maps as lines, read and written. Properties of a line: `class`,
`lanes_forward` and `lanes_backward` (or `oneway`), `lane_width_m`; or, without `class`, OpenStreetMap's `highway`
and its other tags. Features that are not lines are skipped and counted.

A NumPy archive (NPZ) has nodes, and directed edges or roads. Nodes are `node_lon_deg` and `node_lat_deg` (N,), or
`node_x_m` and `node_y_m` (N,), whose projection `frame_proj` and `frame_offset_m` may state. `edges` (E, 2) are
node numbers from 0. Optional for each edge (E,): `edge_class` (names), `edge_lanes`, `edge_lane_width_m`. A road
with lanes in both directions is two edges. Roads, which are written, are the arrays of `Roads`: `road_node`,
`road_first`, `road_forward`, `road_backward`, `road_lane_width_m`, `road_one_way`; optional are `road_class` and
`road_name`.

SUMO's networks (.net.xml) have the lanes that passenger cars may use, each as a road of its own; other files have
polygons. They are read by expat as a stream, within bounds. SUMO's own reader (sumolib) cannot name lines in its
errors, and expands all entities that a file declares; here a file that declares any is refused. Coordinates remain
SUMO's, so that they match its trips; its projection, if it states one, becomes the frame.
"""

from __future__ import annotations

import codecs
import xml.parsers.expat
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from emulator.world.buildings import LEAST_CORNERS
from emulator.world.input_files import number_of, read_arrays
from emulator.world.maps.roads import (
    CLASSES,
    LANE_WIDTH_M,
    LANES,
    MAX_LANE_WIDTH_M,
    MAX_LANES,
    MAX_POINTS,
    MIN_LANE_WIDTH_M,
    NAMES,
    NUMBER,
    ONE_WAY_CLASSES,
    UNKNOWN,
    Ints,
    Roads,
    RoadsBuilder,
    Street,
    check_extent,
    street,
)
from emulator.world.networks import MAX_COORDINATE_M
from emulator.world.projection import CoordinateFrame, project
from vnet.bounded import read_bounded
from vnet.errors import ScenarioError, printable, sendable, shown
from vnet.types import Array

LARGEST_GEOJSON_BYTES = 512 * 2**20
"""Largest file that is read."""
_WGS84_NAMES = ("CRS84", "EPSG::4326", "EPSG:4326")
"""Parts of the names of WGS-84 as a coordinate reference system."""
_DIRECTIONS = {"yes": 1, "true": 1, "1": 1, "no": 0, "false": 0, "0": 0, "-1": -1, "reverse": -1}
"""Values of `oneway`: along the line, in both directions, and against it."""
_SAME_DIGITS = 7
"""Decimals of a degree to which equal points agree (1 cm)."""
_DIGITS = 9
"""Decimals of a degree that are written (0.1 mm)."""
LARGEST_ARRAY_BYTES = 16 * MAX_POINTS
"""Largest array that is read: two 8-byte numbers a point."""
_NODES = ("node_lon_deg", "node_lat_deg", "node_x_m", "node_y_m")
_EDGES = ("edges", "edge_class", "edge_lanes", "edge_lane_width_m")
_ROADS = (
    *("road_node", "road_first", "road_name", "road_class", "road_forward", "road_backward"),
    *("road_lane_width_m", "road_one_way"),
)
_FRAME = ("frame_proj", "frame_offset_m")

Arrays = dict[str, NDArray[np.generic]]
LARGEST_SUMO_BYTES = 2**31
"""Largest file that is read."""
_CHUNK_BYTES = 2**20
"""Bytes that are parsed at once."""
_SUMO_WIDTH_M = 3.2
"""Width of a lane that does not state it: SUMO's default."""
_NO_ROADS = {"crossing", "walkingarea", "connector"}
"""Functions of edges that are not roads."""
_CARS = {"passenger", "all", "private"}
"""SUMO's vehicle classes that include passenger cars."""


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

    Points that are equal to seven decimals are the same, so that lines that meet are joined roads. A line with
    `class` is called by its `name`, if no other is.
    """
    builder, features = RoadsBuilder(path), read_collection(path).features
    named = Counter(map(_own_name, features))
    for number, feature in enumerate(features):
        name = _own_name(feature)
        _add_feature(path, builder, number, feature, name if name and named[name] == 1 else f"feature {number}")
    return builder.build_from_degrees(origin_deg)


def _own_name(feature: Feature) -> str:
    """Return the name of a road that is written as `write_geojson` does; in other files streets have names."""
    properties = feature.properties or {}
    name = properties.get("name")
    return name if "class" in properties and isinstance(name, str) else ""


def read_collection(path: Path) -> Collection:
    """Read a collection of features in WGS-84. Raise ScenarioError for a bad file."""
    try:
        text = read_bounded(path, LARGEST_GEOJSON_BYTES).removeprefix(codecs.BOM_UTF8)
        collection = msgspec.json.decode(text, type=Collection)
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


def _add_feature(path: Path, builder: RoadsBuilder, number: int, feature: Feature, name: str) -> None:
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
    for line in lines:
        points = _points(where, line)
        builder.add(name, points[::-1] if found.reversed else points, found.kind, found.lanes, found.lane_width_m)


def _own_street(where: str, properties: dict[str, Any]) -> Street:
    name = properties.get("class", NAMES[UNKNOWN])
    kind = NUMBER.get(name) if isinstance(name, str) else None
    if kind is None:
        raise ScenarioError(f"{where}: class = {shown(name)}: allowed are {', '.join(NAMES)}")
    usually = name in ONE_WAY_CLASSES and "lanes_backward" not in properties
    stated = properties.get("oneway") or ("yes" if usually else "no")
    whole = int(stated) if isinstance(stated, float) and stated.is_integer() else stated
    if (direction := _DIRECTIONS.get(str(whole).lower())) is None:
        raise ScenarioError(f"{where}: oneway = {shown(stated)}: allowed are {', '.join(_DIRECTIONS)}")
    one_way = direction != 0
    usual = CLASSES[NAMES[kind]].lanes
    lanes = [
        _number(where, properties, "lanes_forward", usual, 0, MAX_LANES),
        _number(where, properties, "lanes_backward", 0 if one_way else usual, 0, MAX_LANES),
    ]
    if not any(lanes) or any(count % 1 for count in lanes):
        raise ScenarioError(f"{where}: lanes_forward, lanes_backward = {lanes}: integers, not both 0, are needed")
    if one_way and lanes[1]:
        raise ScenarioError(
            f"{where}: oneway = {shown(stated)} with lanes_backward = {lanes[1]}: one of them is wrong"
        )
    usual_m = float(LANE_WIDTH_M[kind])
    width_m = _number(where, properties, "lane_width_m", usual_m, MIN_LANE_WIDTH_M, MAX_LANE_WIDTH_M)
    return Street(kind, (int(lanes[0]), int(lanes[1])), float(width_m), direction < 0)


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


def read_graph(path: Path, origin_deg: tuple[float, float] | None) -> Roads:
    """Read roads; without `origin_deg` the origin is their centre, or the file's own if it is in metres.

    Edges between the same nodes become one road, and so do those with the same attributes that meet at a node
    without other edges. Raise ScenarioError, naming the array and the entry, for a bad file.
    """
    arrays = read_arrays(path, (*_NODES, *_EDGES, *_ROADS, *_FRAME), LARGEST_ARRAY_BYTES)
    frame: CoordinateFrame | None
    if in_degrees := "node_lon_deg" in arrays:
        frame, node_m = project(path, *_degrees(path, arrays), origin_deg, "node {}".format)
    else:
        frame, node_m = _frame(path, arrays), _metres(path, arrays)
    if "road_node" in arrays:
        roads = _roads(path, arrays, node_m, frame)
    else:
        roads = _Merger(path, node_m, _edges(path, arrays, len(node_m)), frame).roads()
    return roads if in_degrees else roads.around(path, origin_deg)


def _roads(path: Path, arrays: Arrays, node_m: Array, frame: CoordinateFrame | None) -> Roads:
    node = _whole(path, arrays, "road_node", None, 0, len(node_m) - 1)
    first = _whole(path, arrays, "road_first", None, 0, len(node))
    if first[:1].tolist() != [0] or first[-1] != len(node) or (np.diff(first) < 2).any():
        raise ScenarioError(f"{path}: road_first: 0 to {len(node)} in steps of 2 or more are needed")
    count = len(first) - 1
    forward, backward = (
        _whole(path, arrays, name, count, 0, MAX_LANES) for name in ("road_forward", "road_backward")
    )
    if not (forward + backward).all():
        raise ScenarioError(f"{path}: road_forward[{int(np.argmin(forward + backward))}]: a road without lanes")
    check_extent(path, node_m, count, "node {}".format)
    numbered = np.char.add("road ", np.arange(count).astype(str))
    return Roads(
        node_m=node_m,
        node=node,
        first=first,
        name=tuple(
            _texts(path, arrays, "road_name", count).tolist() if "road_name" in arrays else numbered.tolist()
        ),
        kind=_kinds(path, arrays, "road_class", count),
        forward=forward,
        backward=backward,
        lane_width_m=_within(path, arrays, "road_lane_width_m", count, MIN_LANE_WIDTH_M, MAX_LANE_WIDTH_M),
        one_way=_whole(path, arrays, "road_one_way", count, 0, 1).astype(np.bool_),
        frame=frame,
    )


def _numbers(path: Path, arrays: Arrays, name: str, count: int | None = None) -> Array:
    """Return an array of finite numbers (count,)."""
    if name not in arrays:
        raise ScenarioError(f"{path}: no array {name!r}")
    array = arrays[name]
    if array.ndim != 1 or array.dtype.kind not in "biuf" or count not in (None, len(array)):
        wanted = f"({'n' if count is None else count},)"
        raise ScenarioError(
            f"{path}: {name}: numbers of shape {wanted} are needed, not {array.dtype} {array.shape}"
        )
    numbers = array.astype(float)
    if not np.isfinite(numbers).all():
        raise ScenarioError(f"{path}: {name}[{int(np.argmin(np.isfinite(numbers)))}]: a finite number is needed")
    return numbers


def _degrees(path: Path, arrays: Arrays) -> tuple[Array, Array]:
    """Return latitudes and longitudes (N,) of all nodes; there is at least one."""
    lon = _within(path, arrays, "node_lon_deg", None, -180.0, 180.0)
    lat = _within(path, arrays, "node_lat_deg", len(lon), -90.0, 90.0)
    if not len(lon):
        raise ScenarioError(f"{path}: no nodes")
    return lat, lon


def _metres(path: Path, arrays: Arrays) -> Array:
    if "node_x_m" not in arrays:
        raise ScenarioError(f"{path}: neither 'node_lon_deg' nor 'node_x_m' is among its arrays")
    x = _within(path, arrays, "node_x_m", None, -MAX_COORDINATE_M, MAX_COORDINATE_M)
    return np.column_stack([x, _within(path, arrays, "node_y_m", len(x), -MAX_COORDINATE_M, MAX_COORDINATE_M)])


def _frame(path: Path, arrays: Arrays) -> CoordinateFrame | None:
    if "frame_proj" not in arrays:
        return None
    proj = arrays["frame_proj"]
    if proj.shape or proj.dtype.kind != "U":
        raise ScenarioError(f"{path}: frame_proj: one text is needed, not {proj.dtype} {proj.shape}")
    x, y = _within(path, arrays, "frame_offset_m", 2, -MAX_COORDINATE_M, MAX_COORDINATE_M).tolist()
    try:
        return CoordinateFrame.named(str(proj), (x, y))
    except ScenarioError as error:
        raise ScenarioError(f"{path}: frame_proj: {error}") from None


@dataclass(frozen=True)
class _Edges:
    """Directed edges (E, 2) and their attributes (E,)."""

    ends: Ints
    kind: Ints
    lanes: Ints
    lane_width_m: Array


def _edges(path: Path, arrays: Arrays, nodes: int) -> _Edges:
    if "edges" not in arrays:
        raise ScenarioError(f"{path}: no array 'edges'")
    ends = arrays["edges"]
    if ends.ndim != 2 or ends.shape[1] != 2 or ends.dtype.kind not in "iu":
        raise ScenarioError(f"{path}: edges: pairs of integers are needed, not {ends.dtype} {ends.shape}")
    missing = (ends < 0) | (ends >= nodes)  # type: ignore[operator]
    if missing.any():
        at = int(np.argmax(missing.any(axis=1)))
        which = ends[at][missing[at]][0]
        raise ScenarioError(f"{path}: edges[{at}]: node {which} does not exist; nodes are 0 to {nodes - 1}")
    kind = _kinds(path, arrays, "edge_class", len(ends))
    lanes, width_m = LANES[kind], LANE_WIDTH_M[kind]
    if "edge_class" not in arrays:
        lanes = np.ones(len(ends), dtype=np.intp)
    if "edge_lanes" in arrays:
        lanes = _whole(path, arrays, "edge_lanes", len(ends), 1, MAX_LANES)
    if "edge_lane_width_m" in arrays:
        width_m = _within(path, arrays, "edge_lane_width_m", len(ends), MIN_LANE_WIDTH_M, MAX_LANE_WIDTH_M)
    return _Edges(ends.astype(np.intp), kind, lanes, width_m)


def _within(path: Path, arrays: Arrays, name: str, count: int | None, least: float, most: float) -> Array:
    numbers = _numbers(path, arrays, name, count)
    wrong = (numbers < least) | (numbers > most)
    if wrong.any():
        at = int(np.argmax(wrong))
        raise ScenarioError(f"{path}: {name}[{at}] = {numbers[at]:g}: {least:g} to {most:g} allowed")
    return numbers


def _whole(path: Path, arrays: Arrays, name: str, count: int | None, least: int, most: int) -> Ints:
    numbers = _within(path, arrays, name, count, least, most)
    if (odd := numbers != np.rint(numbers)).any():
        at = int(np.argmax(odd))
        raise ScenarioError(f"{path}: {name}[{at}] = {numbers[at]:g}: a whole number is needed")
    return numbers.astype(np.intp)


def _texts(path: Path, arrays: Arrays, name: str, count: int) -> NDArray[Any]:
    texts = arrays[name]
    if texts.shape != (count,) or texts.dtype.kind != "U":
        raise ScenarioError(
            f"{path}: {name}: texts of shape ({count},) are needed, not {texts.dtype} {texts.shape}"
        )
    if odd := next((text for text in texts.tolist() if sendable(text) != text), None):
        raise ScenarioError(f"{path}: {name}: {shown(odd)}: a text with a lone surrogate")
    return texts


def _kinds(path: Path, arrays: Arrays, name: str, count: int) -> Ints:
    if name not in arrays:
        return np.full(count, UNKNOWN)
    distinct, which = np.unique(_texts(path, arrays, name, count), return_inverse=True)
    for at, kind in enumerate(distinct.tolist()):
        if kind not in NUMBER:
            row = int(np.argmax(which == at))
            raise ScenarioError(f"{path}: {name}[{row}] = {shown(kind)}: allowed are {', '.join(NAMES)}")
    return np.array([NUMBER[kind] for kind in distinct.tolist()], dtype=np.intp)[which]


class _Merger:
    """Merger of edges into roads: both directions of an edge, then chains of edges without crossings."""

    def __init__(self, path: Path, node_m: Array, edges: _Edges, frame: CoordinateFrame | None) -> None:
        self._path, self._node_m, self._frame = path, node_m, frame
        self._notes: dict[str, int] = {}
        ends = self._undirected(edges)
        # Edges by node.
        self._order = np.argsort(ends.T.ravel(), kind="stable") % max(1, len(ends))
        self._degree = np.bincount(ends.ravel(), minlength=len(node_m))
        self._begin = np.concatenate([[0], np.cumsum(self._degree)])
        self._ends: list[list[int]] = ends.tolist()

    def _undirected(self, edges: _Edges) -> Ints:
        """Merge opposite and duplicate edges; set their attributes, and return their ends (U, 2)."""
        low, high = edges.ends.min(axis=1), edges.ends.max(axis=1)
        real = low != high
        self._note("edges without length", int((~real).sum()))
        against = edges.ends[:, 0] > edges.ends[:, 1]
        key = low * len(self._node_m) + high
        _, first, index = np.unique(key[real], return_index=True, return_inverse=True)
        number = np.flatnonzero(real)
        lanes = np.zeros((2, len(first)), dtype=np.intp)  # from the lower node to the higher, and back
        np.maximum.at(lanes, (against[number].astype(np.intp), index), edges.lanes[number])
        self._note("edges given twice", int(real.sum() - (lanes > 0).sum()))
        first = number[first]
        swapped = lanes[0] == 0
        self._lanes = np.where(swapped, lanes[::-1], lanes)
        self._kind, self._width_m, self._file_edge = edges.kind[first], edges.lane_width_m[first], first
        ends = np.column_stack([low[first], high[first]])
        ends[swapped] = ends[swapped, ::-1]
        return ends

    def _note(self, oddity: str, count: int) -> None:
        if count:
            self._notes[oddity] = count

    def roads(self) -> Roads:
        """Return all roads. Raise ScenarioError as `check_extent` does."""
        check_extent(self._path, self._node_m, len(self._ends), "node {}".format)
        chains = list(self._chains())
        node = np.array([n for chain, _ in chains for n in chain], dtype=np.intp)
        first = np.concatenate([[0], np.cumsum([len(chain) for chain, _ in chains])])
        edge = np.array([edge for _, edge in chains], dtype=np.intp)
        lanes = self._lanes[:, edge]
        used, node = np.unique(node, return_inverse=True)
        self._note("nodes without an edge", len(self._node_m) - len(used))
        return Roads(
            node_m=self._node_m[used],
            node=node,
            first=first,
            name=tuple(f"edge {number}" for number in self._file_edge[edge].tolist()),
            kind=self._kind[edge],
            forward=lanes[0],
            backward=lanes[1],
            lane_width_m=self._width_m[edge],
            one_way=lanes.min(axis=0) == 0,
            frame=self._frame,
            notes=self._notes,
        )

    def _chains(self) -> Iterator[tuple[list[int], int]]:
        """Yield the nodes of each road, and one of its edges, whose direction is the road's."""
        done = bytearray(len(self._ends))
        is_inner = self._inner_nodes().tolist()
        for edge, (start, end) in enumerate(self._ends):
            if not done[edge]:
                done[edge] = 1
                ahead = self._walk(edge, end, done, is_inner)
                behind = self._walk(edge, start, done, is_inner)
                yield [*reversed(behind), start, end, *ahead], edge

    def _walk(self, edge: int, node: int, done: bytearray, is_inner: list[bool]) -> list[int]:
        """Return the nodes that follow `node` on the road of `edge`; mark their edges as done."""
        found = []
        while is_inner[node]:
            begin = self._begin[node]
            one, other = self._order[begin], self._order[begin + 1]
            edge = int(other if one == edge else one)
            if done[edge]:
                break  # a ring
            done[edge] = 1
            start, end = self._ends[edge]
            node = end if start == node else start
            found.append(node)
        return found

    def _inner_nodes(self) -> NDArray[np.bool_]:
        """Return the mask (N,) of nodes at which exactly two edges meet that have the same attributes."""
        two = np.flatnonzero(self._degree == 2)
        one, other = self._order[self._begin[two]], self._order[self._begin[two] + 1]
        ends = np.array(self._ends, dtype=np.intp).reshape(-1, 2)
        # Seen from the node: the lanes that enter on one side leave on the other.
        out = [np.where(ends[e, 0] == two, self._lanes[0, e], self._lanes[1, e]) for e in (one, other)]
        into = [np.where(ends[e, 0] == two, self._lanes[1, e], self._lanes[0, e]) for e in (one, other)]
        same = (into[0] == out[1]) & (into[1] == out[0])
        same &= (self._kind[one] == self._kind[other]) & (self._width_m[one] == self._width_m[other])
        is_inner = np.zeros(len(self._node_m), dtype=np.bool_)
        is_inner[two[same]] = True
        return is_inner


def write_graph(roads: Roads, path: Path) -> None:
    """Write an NPZ in metres, as `read_graph` reads it. Raise OSError if it cannot be written."""
    arrays: dict[str, Any] = {
        "node_x_m": roads.node_m[:, 0],
        "node_y_m": roads.node_m[:, 1],
        "road_node": roads.node.astype(np.int32),
        "road_first": roads.first.astype(np.int32),
        "road_class": np.array(NAMES)[roads.kind],
        "road_forward": roads.forward.astype(np.uint8),
        "road_backward": roads.backward.astype(np.uint8),
        "road_lane_width_m": roads.lane_width_m,
        "road_one_way": roads.one_way.astype(np.uint8),
    }
    if 4 * len(roads) * max(map(len, roads.name), default=0) <= LARGEST_ARRAY_BYTES:
        arrays["road_name"] = np.array(roads.name)
    if roads.frame is not None:
        arrays["frame_proj"] = np.array(roads.frame.proj)
        arrays["frame_offset_m"] = np.array(roads.frame.offset_m)
    with path.open("wb") as file:
        np.savez_compressed(file, **arrays)


@dataclass
class _Lane:
    name: str
    kind: int
    width_m: float
    points: list[tuple[float, float]]
    ends: tuple[str, str] | None


class _Reader:
    """Handlers for expat; they keep the lanes of all edges until the opposite edges are known."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._parser = xml.parsers.expat.ParserCreate()
        self._parser.StartElementHandler = self._start
        self._parser.EndElementHandler = self._end
        self._parser.StartDoctypeDeclHandler = self._refuse_doctype
        self._depth = 0
        self._edge: dict[str, str] | None = None
        self.frame: CoordinateFrame | None = None
        self.lanes: list[_Lane] = []
        self._points_left = MAX_POINTS
        self.edge_ends: set[tuple[str, str]] = set()
        self.skipped = 0

    def wrong(self, problem: str) -> ScenarioError:
        """Return an error that names the line being read."""
        return ScenarioError(f"{self._path}: line {self._parser.CurrentLineNumber}: {problem}")

    def read(self) -> None:
        """Read the file."""
        size = 0
        try:
            with self._path.open("rb") as file:
                while chunk := file.read(_CHUNK_BYTES):
                    size += len(chunk)
                    if size > LARGEST_SUMO_BYTES:
                        raise self.wrong(f"larger than {LARGEST_SUMO_BYTES} bytes")
                    self._parser.Parse(chunk)
                self._parser.Parse(b"", True)
        except OSError as error:
            raise ScenarioError(f"{self._path}: cannot be read: {error.strerror}") from None
        except xml.parsers.expat.ExpatError as error:
            problem = xml.parsers.expat.ErrorString(error.code)
            raise ScenarioError(f"{self._path}: line {error.lineno}: not XML: {problem}") from None
        except (LookupError, ValueError) as error:  # an encoding that is unknown or not supported
            raise self.wrong(f"not XML: {printable(str(error))}") from None

    def _refuse_doctype(self, *_: object) -> None:
        raise self.wrong("a document type declaration; files of SUMO have none")

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        self._depth += 1
        if self._depth == 1 and name != "net":
            raise self.wrong(f"<{printable(name)}>: a network of SUMO starts with <net>")
        handlers: dict[str, Callable[[dict[str, str]], None]] = {
            "location": self._location,
            "edge": self._start_edge,
            "lane": self._lane,
        }
        if name in handlers:
            handlers[name](attributes)

    def _end(self, name: str) -> None:
        self._depth -= 1
        if name == "edge":
            self._edge = None

    def _location(self, attributes: dict[str, str]) -> None:
        proj = attributes.get("projParameter", "!")
        if proj.startswith(("+", "EPSG:")):
            points = self._points(attributes.get("netOffset", "0,0"), "netOffset")
            if len(points) != 1:
                raise self.wrong("netOffset: one x,y in metres is needed")
            try:
                self.frame = CoordinateFrame.named(proj, points[0])
            except ScenarioError as error:
                raise self.wrong(str(error)) from None

    def _start_edge(self, attributes: dict[str, str]) -> None:
        self._edge = attributes
        if "from" in attributes and "to" in attributes:
            self.edge_ends.add((attributes["from"], attributes["to"]))

    def _lane(self, attributes: dict[str, str]) -> None:
        edge = self._edge
        if edge is None:
            raise self.wrong("<lane> outside of an <edge>")
        if edge.get("function") in _NO_ROADS or not _for_cars(attributes):
            self.skipped += 1
            return
        name = attributes.get("id", "")
        points = self._points(attributes.get("shape", ""), f"lane {printable(name)}: shape")
        if len(points) < 2:
            raise self.wrong(f"lane {printable(name)}: a shape of two points or more is needed")
        kind = NUMBER.get(edge.get("type", "").rpartition(".")[2], UNKNOWN)
        if edge.get("function") == "internal":
            kind = NUMBER["crossing"]
        ends = (edge["from"], edge["to"]) if "from" in edge and "to" in edge else None
        self.lanes.append(_Lane(f"lane {name}", kind, self._width_m(attributes), points, ends))

    def _width_m(self, attributes: dict[str, str]) -> float:
        text = attributes.get("width", str(_SUMO_WIDTH_M))
        width_m = number_of(text)
        if not 0 < width_m <= MAX_LANE_WIDTH_M:
            raise self.wrong(
                f"width = {shown(text)}: a positive number of metres up to {MAX_LANE_WIDTH_M:g} is needed"
            )
        return max(width_m, MIN_LANE_WIDTH_M)

    def _points(self, text: str, name: str) -> list[tuple[float, float]]:
        """Return the points of a text `x,y x,y …`, without heights; `name` is used in errors."""
        points = []
        for part in text.split():
            try:
                numbers = [float(number) for number in part.split(",")]
            except ValueError:
                numbers = []
            if len(numbers) not in (2, 3) or not all(abs(number) <= MAX_COORDINATE_M for number in numbers):
                raise self.wrong(f"{name}: {shown(part)}: x,y in metres is needed")
            points.append((numbers[0], numbers[1]))
        self._points_left -= len(points)
        if self._points_left < 0:
            raise self.wrong(f"more than {MAX_POINTS} points; cut out a part first")
        return points


class _Polygons(_Reader):
    """Handlers for a file of polygons, as polyconvert writes it."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.buildings: list[list[tuple[float, float]]] = []

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        self._depth += 1
        if self._depth == 1 and name not in ("additional", "shapes"):
            raise self.wrong(f"<{printable(name)}>: a file of SUMO's polygons starts with <additional>")
        kind = attributes.get("type", "")
        if name != "poly" or not kind.startswith("building") or kind == "building.no":
            return
        where = f"poly {printable(attributes.get('id', ''))}"
        if attributes.get("geo", "0") in ("1", "true", "yes"):
            raise self.wrong(f"{where}: geo = {attributes['geo']}: polygons in metres are needed")
        points = self._points(attributes.get("shape", ""), f"{where}: shape")
        if attributes.get("fill") in ("0", "false") and points[:1] != points[-1:]:
            return  # polyconvert writes an outline of several ways in pieces
        if len(set(points)) < LEAST_CORNERS:
            raise self.wrong(f"{where}: shape: three corners or more are needed")
        self.buildings.append(points[:-1] if points[0] == points[-1] else points)


def read_sumo_polygons(path: Path) -> list[list[tuple[float, float]]]:
    """Return the corners in metres of each polygon whose type begins with `building`.

    Raise ScenarioError, naming the line, for a bad file.
    """
    reader = _Polygons(path)
    reader.read()
    return reader.buildings


def _for_cars(lane: dict[str, str]) -> bool:
    allowed, refused = lane.get("allow", "").split(), lane.get("disallow", "").split()
    if allowed:
        return not _CARS.isdisjoint(allowed)
    return _CARS.isdisjoint(refused)


def read_sumo(path: Path, origin_deg: tuple[float, float] | None) -> Roads:
    """Read the lanes; metres are SUMO's own unless an origin is given.

    Raise ScenarioError, naming the line, for a bad file.
    """
    reader = _Reader(path)
    reader.read()
    builder = RoadsBuilder(path)
    if reader.skipped:
        builder.notes["lanes not for cars"] = reader.skipped
    for lane in reader.lanes:
        # The ends of lanes inside intersections equal those of the lanes that they join, to the centimetre.
        points = [((round(100 * x), round(100 * y)), (x, y)) for x, y in lane.points]
        one_way = lane.ends is None or lane.ends[::-1] not in reader.edge_ends
        builder.add(lane.name, points, lane.kind, (1, 0), lane.width_m, one_way)
    return builder.build(builder.coordinates(), reader.frame).around(path, origin_deg)
