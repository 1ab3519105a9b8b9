"""Maps as nodes and directed edges in a NumPy archive (NPZ), read and written.

`edges` (E, 2) are node numbers from 0. Nodes are `node_lon_deg` and `node_lat_deg` (N,), or `node_x_m` and
`node_y_m` (N,), whose projection `frame_proj` and `frame_offset_m` may state. Optional for each edge (E,):
`edge_class` (names), `edge_lanes`, `edge_lane_width_m`. A road with lanes in both directions is two edges.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from emulator.world.input_files import read_arrays
from emulator.world.maps.roads import (
    LANE_WIDTH_M,
    LANES,
    MAX_LANE_WIDTH_M,
    MAX_LANES,
    MAX_POINTS,
    MIN_LANE_WIDTH_M,
    NAMES,
    NUMBER,
    UNKNOWN,
    Ints,
    Roads,
    check_extent,
)
from emulator.world.networks import MAX_COORDINATE_M
from emulator.world.projection import CoordinateFrame, project
from vnet.errors import ScenarioError, shown
from vnet.types import Array

LARGEST_ARRAY_BYTES = 16 * MAX_POINTS
"""Largest array that is read: two 8-byte numbers a point."""
_NODES = ("node_lon_deg", "node_lat_deg", "node_x_m", "node_y_m")
_EDGES = ("edges", "edge_class", "edge_lanes", "edge_lane_width_m")
_FRAME = ("frame_proj", "frame_offset_m")

Arrays = dict[str, NDArray[np.generic]]


def read_graph(path: Path, origin_deg: tuple[float, float] | None) -> Roads:
    """Read roads; without `origin_deg` the origin is their centre, or the file's own if it is in metres.

    Edges with the same attributes that meet at a node without other edges become one road. Raise ScenarioError,
    naming the array and the entry, for a bad file.
    """
    arrays = read_arrays(path, (*_NODES, *_EDGES, *_FRAME), LARGEST_ARRAY_BYTES)
    if "node_lon_deg" in arrays:
        frame, node_m = project(path, *_degrees(path, arrays), origin_deg, "node {}".format)
        return _Merger(path, node_m, _edges(path, arrays, len(node_m)), frame).roads()
    node_m = _metres(path, arrays)
    edges = _edges(path, arrays, len(node_m))
    return _Merger(path, node_m, edges, _frame(path, arrays)).roads().around(path, origin_deg)


def _numbers(path: Path, arrays: Arrays, name: str, count: int | None = None) -> Array:
    """Return an array of finite numbers (count,)."""
    if name not in arrays:
        raise ScenarioError(f"{path}: no array {name!r}")
    array = arrays[name]
    if array.ndim != 1 or array.dtype.kind not in "iuf" or count not in (None, len(array)):
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
    kind = _kinds(path, arrays, len(ends))
    lanes, width_m = LANES[kind], LANE_WIDTH_M[kind]
    if "edge_class" not in arrays:
        lanes = np.ones(len(ends), dtype=np.intp)
    if "edge_lanes" in arrays:
        lanes = _within(path, arrays, "edge_lanes", len(ends), 1, MAX_LANES).astype(np.intp)
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


def _kinds(path: Path, arrays: Arrays, count: int) -> Ints:
    if "edge_class" not in arrays:
        return np.full(count, UNKNOWN)
    names = arrays["edge_class"]
    if names.shape != (count,) or names.dtype.kind != "U":
        raise ScenarioError(
            f"{path}: edge_class: texts of shape ({count},) are needed, not {names.dtype} {names.shape}"
        )
    distinct, which = np.unique(names, return_inverse=True)
    for at, name in enumerate(distinct.tolist()):
        if name not in NUMBER:
            edge = int(np.argmax(which == at))
            raise ScenarioError(f"{path}: edge_class[{edge}] = {shown(name)}: allowed are {', '.join(NAMES)}")
    return np.array([NUMBER[name] for name in distinct.tolist()], dtype=np.intp)[which]


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
    start, end = roads.node[roads.segment], roads.node[roads.segment + 1]
    road = roads.road_of[roads.segment]
    ahead, back = roads.forward[road] > 0, roads.backward[road] > 0
    edge_road = np.concatenate([road[ahead], road[back]])
    arrays = {
        "node_x_m": roads.node_m[:, 0],
        "node_y_m": roads.node_m[:, 1],
        "edges": np.concatenate([np.column_stack([start, end])[ahead], np.column_stack([end, start])[back]]).astype(
            np.int32
        ),
        "edge_class": np.array(NAMES)[roads.kind[edge_road]],
        "edge_lanes": np.concatenate([roads.forward[road[ahead]], roads.backward[road[back]]]).astype(np.uint8),
        "edge_lane_width_m": roads.lane_width_m[edge_road],
    }
    if roads.frame is not None:
        arrays["frame_proj"] = np.array(roads.frame.proj)
        arrays["frame_offset_m"] = np.array(roads.frame.offset_m)
    with path.open("wb") as file:
        np.savez_compressed(file, **arrays)
