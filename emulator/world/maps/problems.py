"""What is wrong with a map, counted, so that nobody has to find out from a run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from emulator.world.maps.classes import NAMES
from emulator.world.maps.roads import Ints, Roads

GAP_M = 1.0
"""A road's end so near to another point, and not joined to it, is more likely a mistake than a dead end."""


@dataclass(frozen=True)
class MapReport:
    """What `vnet map show` says: lengths in km, counts; `problems` by what they are, without those that are not."""

    length_km: float
    lane_km: float
    roads: int
    nodes: int
    by_class: dict[str, tuple[int, float]]
    one_way_km: float
    size_km: tuple[float, float]
    problems: dict[str, str]


def examine(roads: Roads) -> MapReport:
    """Measure a map and look for what is odd."""
    km = roads.length_m / 1000
    by_class = {
        NAMES[kind]: (int((roads.kind == kind).sum()), float(km[roads.kind == kind].sum()))
        for kind in np.unique(roads.kind).tolist()
    }
    east, north = np.ptp(roads.node_m, axis=0) / 1000
    return MapReport(
        float(km.sum()),
        float(km @ (roads.forward + roads.backward)),
        len(roads),
        len(roads.node_m),
        dict(sorted(by_class.items(), key=lambda entry: -entry[1][1])),
        float(km[roads.one_way].sum()),
        (float(east), float(north)),
        _problems(roads),
    )


def _piece_of_node(roads: Roads) -> Ints:
    """Which connected piece each point belongs to, (N,); 0 is the one of most road."""
    start, end = roads.node[roads.segment], roads.node[roads.segment + 1]
    count = len(roads.node_m)
    joined = coo_matrix((np.ones(len(start)), (start, end)), shape=(count, count))
    pieces, label = connected_components(joined, directed=False)
    length_m = np.bincount(label[start], roads.segment_length_m, minlength=pieces)
    rank = np.empty(pieces, dtype=np.intp)
    rank[np.argsort(-length_m, kind="stable")] = np.arange(pieces)
    return np.asarray(rank[label])


def _problems(roads: Roads) -> dict[str, str]:
    found = {what: f"{count:,}" for what, count in roads.notes.items()}
    start, end = roads.node[roads.segment], roads.node[roads.segment + 1]
    piece = _piece_of_node(roads)
    if piece.max():
        aside_km = roads.segment_length_m[piece[start] > 0].sum() / 1000
        found["isolated pieces"] = f"{piece.max():,}, {aside_km:.1f} km of road beside the largest piece"
    low, high = np.minimum(start, end), np.maximum(start, end)
    _, times = np.unique(low * len(roads.node_m) + high, return_counts=True)
    _say(found, "segments under another", int((times - 1).sum()))
    _say(found, "segments without length", int((roads.segment_length_m == 0).sum()))
    degree = np.bincount(np.concatenate([start, end]), minlength=len(roads.node_m))
    _say(found, "dead ends", int((degree == 1).sum()))
    _say(found, f"ends within {GAP_M:g} m of a point that they are not joined to", _gaps(roads, degree, start, end))
    return found


def _say(found: dict[str, str], what: str, count: int) -> None:
    if count:
        found[what] = f"{count:,}"


def _gaps(roads: Roads, degree: Ints, start: Ints, end: Ints) -> int:
    tree = cKDTree(roads.node_m)
    ends = np.flatnonzero(degree == 1)
    neighbour = np.empty(len(roads.node_m), dtype=np.intp)
    neighbour[start] = end
    neighbour[end] = start  # an end has one neighbour only
    distance_m, nearest = tree.query(roads.node_m[ends], k=3, distance_upper_bound=GAP_M)
    there = np.isfinite(distance_m) & (nearest != ends[:, None]) & (nearest != neighbour[ends, None])
    return int(there.any(axis=1).sum())
