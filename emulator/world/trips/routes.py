"""Routes through a map: its directed graph of streets, and random routes on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra

from emulator.world.maps.classes import NAMES
from emulator.world.maps.roads import Ints, Roads
from vnet.errors import ScenarioError
from vnet.types import Array

SPEED_M_S = {
    "motorway": 29.0,
    "trunk": 24.0,
    "primary": 16.0,
    "secondary": 14.0,
    "tertiary": 13.0,
    "unclassified": 12.0,
    "residential": 10.0,
    "living_street": 5.0,
    "service": 5.0,
    "crossing": 8.0,
    "road": 12.0,
}
"""Free-flow speeds by road class."""
LINK_SHARE = 0.7
"""Speed on a ramp relative to the road that it belongs to."""
TRIES = 8
"""Destinations that are tried to find one that can be reached without a U-turn."""


@dataclass(frozen=True)
class Streets:
    """E directed edges between points of `roads`; arrays (E,).

    `start` and `end` are points, `road` the edge's road, and `against` is 1 for an edge against the road's
    direction.
    """

    roads: Roads
    start: Ints
    end: Ints
    road: Ints
    against: Array
    speed_m_s: Array
    time_s: Array


class Network:
    """The largest strongly connected component of a map's streets."""

    def __init__(self, source: object, roads: Roads) -> None:
        """Find the component. Raise ScenarioError, naming `source`, if it has fewer than two points."""
        self.streets = streets = _streets(roads)
        count = len(roads.node_m)
        graph = csr_matrix((streets.time_s, (streets.start, streets.end)), shape=(count, count))
        _, label = connected_components(graph, connection="strong")
        best = int(np.argmax(np.bincount(label)))
        members = np.flatnonzero(label == best)
        neighbours = np.unique(np.sort(np.column_stack([streets.start, streets.end]), axis=1), axis=0)
        self.is_crossing = np.bincount(neighbours.ravel(), minlength=count) > 2
        if len(members) < 2:
            raise ScenarioError(f"{source}: no two points of its roads can be reached from each other")
        inside = (label[streets.start] == best) & (label[streets.end] == best)
        self._graph = csr_matrix(
            (streets.time_s[inside], (streets.start[inside], streets.end[inside])), shape=(count, count)
        )
        crossings = members[self.is_crossing[members]]
        self._destinations = crossings if len(crossings) else members  # at crossings no U-turn is needed
        self._key = streets.start * count + streets.end  # ascending
        self._count = count
        self._starts = np.flatnonzero(inside)
        sum_m = np.cumsum(edge_lengths_m(streets)[self._starts])
        self._starts_by_length = sum_m / sum_m[-1]

    def edge(self, start: Ints, end: Ints) -> Ints:
        """Return the edges (n,) between points `start` and `end` (n,)."""
        return np.asarray(np.searchsorted(self._key, start * self._count + end))

    def route(self, rng: np.random.Generator, least_s: float) -> Ints:
        """Return the points (n,) of a random route that takes at least `least_s`.

        It begins at a random edge and joins fastest paths to random destinations, without U-turns. It ends early
        where only a U-turn remains.
        """
        for _ in range(TRIES):
            first = self._starts[np.searchsorted(self._starts_by_length, rng.random())]
            route = [int(self.streets.start[first]), int(self.streets.end[first])]
            if self._ahead(route):
                break
        taken_s = float(self.streets.time_s[first])
        while taken_s < least_s and (ahead := self._ahead(route)):
            time_s, before = dijkstra(self._graph, indices=route[-1], return_predecessors=True)
            destinations = self._destinations[rng.integers(len(self._destinations), size=TRIES)].tolist()
            legs = (_leg(before, route[-1], destination) for destination in destinations)
            leg = next((leg for leg in legs if leg and leg[0] != route[-2]), None)
            leg = leg or [ahead[rng.integers(len(ahead))]]  # every path begins with a U-turn: go on to a neighbour
            route += leg
            taken_s += float(time_s[leg[-1]])
        return np.array(route, dtype=np.intp)

    def _ahead(self, route: list[int]) -> list[int]:
        """Return the points that follow the end of a route without a U-turn."""
        row = slice(*self._graph.indptr[route[-1] : route[-1] + 2])
        return [point for point in self._graph.indices[row].tolist() if point != route[-2]]


def edge_lengths_m(streets: Streets) -> Array:
    """Return the lengths (E,) of the edges."""
    node_m = streets.roads.node_m
    return np.asarray(np.hypot(*(node_m[streets.end] - node_m[streets.start]).T))


def _streets(roads: Roads) -> Streets:
    """Return all edges in ascending order of their points; of several between two points only the fastest."""
    entry = roads.segment
    road = roads.road_of[entry]
    speed = np.array([_speed_m_s(name) for name in NAMES])[roads.kind[road]]
    time_s = np.maximum(roads.segment_length_m, 0.1) / speed
    ahead, back = roads.forward[road] > 0, roads.backward[road] > 0
    one, other = roads.node[entry], roads.node[entry + 1]
    start, end = np.concatenate([one[ahead], other[back]]), np.concatenate([other[ahead], one[back]])
    road_of, against = np.concatenate([road[ahead], road[back]]), np.repeat([0.0, 1.0], [ahead.sum(), back.sum()])
    speed_of, time_of = np.concatenate([speed[ahead], speed[back]]), np.concatenate([time_s[ahead], time_s[back]])
    order = np.lexsort((time_of, end, start))
    first = np.ones(len(order), dtype=np.bool_)
    first[1:] = (np.diff(start[order]) != 0) | (np.diff(end[order]) != 0)
    kept = order[first]
    return Streets(
        roads=roads,
        start=start[kept],
        end=end[kept],
        road=road_of[kept],
        against=against[kept],
        speed_m_s=speed_of[kept],
        time_s=time_of[kept],
    )


def _speed_m_s(name: str) -> float:
    base = name.removesuffix("_link")
    return SPEED_M_S[base] * (LINK_SHARE if base != name else 1.0)


def _leg(before: Ints, start: int, end: int) -> list[int]:
    """Return the points after `start` up to `end`; `before` (N,) are predecessors on the fastest paths."""
    found = []
    while end != start and end >= 0:
        found.append(end)
        end = int(before[end])
    return found[::-1]
