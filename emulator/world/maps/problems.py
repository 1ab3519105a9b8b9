"""Quality report of a map: its size, and counts of its likely errors, before a run meets them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from emulator.world.maps.classes import NAMES
from emulator.world.maps.roads import Ints, Roads

GAP_M = 1.0
"""A road's end this close to another point, but not joined to it, is more likely an error than a dead end."""


@dataclass(frozen=True)
class MapReport:
    """The figures that `vnet map show` prints: lengths in km, counts, and the `problems` that occur.

    `by_class` gives the number of roads and their length in km; `size_km` the extent east and north.
    """

    length_km: float
    lane_km: float
    roads: int
    nodes: int
    by_class: dict[str, tuple[int, float]]
    one_way_km: float
    size_km: tuple[float, float]
    problems: dict[str, str]


def examine(roads: Roads) -> MapReport:
    """Measure a map and count its likely errors."""
    km = roads.length_m / 1000
    by_class = {
        NAMES[kind]: (int((roads.kind == kind).sum()), float(km[roads.kind == kind].sum()))
        for kind in np.unique(roads.kind).tolist()
    }
    east, north = np.ptp(roads.node_m, axis=0) / 1000
    return MapReport(
        length_km=float(km.sum()),
        lane_km=float(km @ (roads.forward + roads.backward)),
        roads=len(roads),
        nodes=len(roads.node_m),
        by_class=dict(sorted(by_class.items(), key=lambda entry: -entry[1][1])),
        one_way_km=float(km[roads.one_way].sum()),
        size_km=(float(east), float(north)),
        problems=_problems(roads),
    )


def _piece_of_node(roads: Roads) -> Ints:
    """Return the connected component (N,) of each point; component 0 has the greatest length of road."""
    start, end = roads.node[roads.segment], roads.node[roads.segment + 1]
    count = len(roads.node_m)
    joined = coo_matrix((np.ones(len(start)), (start, end)), shape=(count, count))
    pieces, label = connected_components(joined, directed=False)
    length_m = np.bincount(label[start], roads.segment_length_m, minlength=pieces)
    rank = np.empty(pieces, dtype=np.intp)
    rank[np.argsort(-length_m, kind="stable")] = np.arange(pieces)
    return np.asarray(rank[label])


def _problems(roads: Roads) -> dict[str, str]:
    found = {oddity: f"{count:,}" for oddity, count in roads.notes.items()}
    start, end = roads.node[roads.segment], roads.node[roads.segment + 1]
    piece = _piece_of_node(roads)
    if piece.max():
        isolated_km = roads.segment_length_m[piece[start] > 0].sum() / 1000
        found["isolated pieces"] = f"{piece.max():,}, {isolated_km:.1f} km of road outside the largest piece"
    low, high = np.minimum(start, end), np.maximum(start, end)
    _, times = np.unique(low * len(roads.node_m) + high, return_counts=True)
    _add_count(found, "duplicate segments", int((times - 1).sum()))
    _add_count(found, "segments without length", int((roads.segment_length_m == 0).sum()))
    degree = np.bincount(np.concatenate([start, end]), minlength=len(roads.node_m))
    _add_count(found, "dead ends", int((degree == 1).sum()))
    _add_count(found, f"ends within {GAP_M:g} m of a point but not joined to it", _gaps(roads, degree, start, end))
    return found


def _add_count(found: dict[str, str], problem: str, count: int) -> None:
    if count:
        found[problem] = f"{count:,}"


def _gaps(roads: Roads, degree: Ints, start: Ints, end: Ints) -> int:
    tree = cKDTree(roads.node_m)
    ends = np.flatnonzero(degree == 1)
    neighbour = np.empty(len(roads.node_m), dtype=np.intp)
    neighbour[start] = end
    neighbour[end] = start  # an end has one neighbour only
    distance_m, nearest = tree.query(roads.node_m[ends], k=3, distance_upper_bound=GAP_M)
    present = np.isfinite(distance_m) & (nearest != ends[:, None]) & (nearest != neighbour[ends, None])
    return int(present.any(axis=1).sum())
