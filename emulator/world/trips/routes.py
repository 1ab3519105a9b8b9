"""Ways through a map: which streets lead where, in the direction in which one may drive them."""

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
"""What people drive where nothing is in the way."""
LINK_SHARE = 0.7
"""On ramps, of the speed of the road that they belong to."""
TRIES = 8
"""So many destinations are tried for one that does not begin with turning round."""


@dataclass(frozen=True)
class Streets:
    """E directed edges between points of `roads`, each (E,): `start`, `end`, its `road`, and 1 if `against` it."""

    roads: Roads
    start: Ints
    end: Ints
    road: Ints
    against: Array
    speed_m_s: Array
    time_s: Array


class Network:
    """Where one gets from where: the largest part of a map in which every place leads to every other."""

    def __init__(self, source: object, roads: Roads) -> None:
        """Raises ScenarioError, naming `source`, where no two places lead to each other."""
        self.streets = streets = _streets(roads)
        count = len(roads.node_m)
        graph = csr_matrix((streets.time_s, (streets.start, streets.end)), shape=(count, count))
        _, label = connected_components(graph, connection="strong")
        best = int(np.argmax(np.bincount(label)))
        self._place = np.flatnonzero(label == best)
        neighbours = np.unique(np.sort(np.column_stack([streets.start, streets.end]), axis=1), axis=0)
        self.is_crossing = np.bincount(neighbours.ravel(), minlength=count) > 2
        if len(self._place) < 2:
            raise ScenarioError(f"{source}: no two places on its roads between which one can drive there and back")
        inside = (label[streets.start] == best) & (label[streets.end] == best)
        self._graph = csr_matrix(
            (streets.time_s[inside], (streets.start[inside], streets.end[inside])), shape=(count, count)
        )
        on = self._place[self.is_crossing[self._place]]
        self._places = on if len(on) else self._place  # where one can go on without turning round
        self._key = streets.start * count + streets.end  # ascending
        self._count = count
        self._starts = np.flatnonzero(inside)
        long = np.cumsum(roads_length_m(streets)[self._starts])
        self._starts_by_length = long / long[-1]

    def edge(self, start: Ints, end: Ints) -> Ints:
        """The edges (n,) between points that follow each other."""
        return np.asarray(np.searchsorted(self._key, start * self._count + end))

    def route(self, rng: np.random.Generator, least_s: float) -> Ints:
        """Points (n,) of a way from somewhere to anywhere, and on from there, until it takes `least_s` at least.

        It starts anywhere, and does not turn round on the way: where it cannot but turn round, it ends.
        """
        for _ in range(TRIES):
            first = self._starts[np.searchsorted(self._starts_by_length, rng.random())]
            way = [int(self.streets.start[first]), int(self.streets.end[first])]
            if self._ahead(way):
                break
        taken_s = float(self.streets.time_s[first])
        while taken_s < least_s and (ahead := self._ahead(way)):
            time_s, before = dijkstra(self._graph, indices=way[-1], return_predecessors=True)
            places = self._places[rng.integers(len(self._places), size=TRIES)].tolist()
            legs = (_leg(before, way[-1], place) for place in places)
            leg = next((leg for leg in legs if leg and leg[0] != way[-2]), None)
            leg = leg or [ahead[rng.integers(len(ahead))]]  # all ways lead back: round the next corner, then
            way += leg
            taken_s += float(time_s[leg[-1]])
        return np.array(way, dtype=np.intp)

    def _ahead(self, way: list[int]) -> list[int]:
        """Where one can go on at the end of a way without turning round."""
        row = slice(*self._graph.indptr[way[-1] : way[-1] + 2])
        return [place for place in self._graph.indices[row].tolist() if place != way[-2]]


def roads_length_m(streets: Streets) -> Array:
    """Lengths (E,) of the edges."""
    node_m = streets.roads.node_m
    return np.asarray(np.hypot(*(node_m[streets.end] - node_m[streets.start]).T))


def _streets(roads: Roads) -> Streets:
    """All edges, of several between the same two points the fastest; in ascending order of their points."""
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
    return Streets(roads, start[kept], end[kept], road_of[kept], against[kept], speed_of[kept], time_of[kept])


def _speed_m_s(name: str) -> float:
    base = name.removesuffix("_link")
    return SPEED_M_S[base] * (LINK_SHARE if base != name else 1.0)


def _leg(before: Ints, start: int, end: int) -> list[int]:
    """The points after `start` up to `end`, from the points before each."""
    found = []
    while end != start and end >= 0:
        found.append(end)
        end = int(before[end])
    return found[::-1]
