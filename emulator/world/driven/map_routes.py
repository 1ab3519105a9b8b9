"""Routes of driven vehicles on a map: drawn at random, or along roads that the scenario names."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain

import numpy as np

from emulator.world.driven.map_links import Links
from emulator.world.driven.map_paths import Paths
from vnet.errors import ScenarioError, did_you_mean, first_names

AGAINST = "-"
"""Sign before the name of a road on which a route goes against the road's direction."""
KEY = "network.driven.routes"
_INSIDE = 3
"""Most links inside an intersection between two roads that a route names."""


def elements_of(paths: Paths, links: Iterator[int], least_m: float) -> tuple[int, ...]:
    """Return the paths of a route along `links`, with the turns between, until they are at least `least_m` long."""
    found, length_m, before = list[int](), 0.0, -1
    for link in links:
        turn = paths.of_turn(before, link) if before >= 0 else None
        added = [paths.of_link(link)] if turn is None else [turn, paths.of_link(link)]
        found += added
        length_m += sum(paths.paths[each].length_m for each in added)
        if length_m >= least_m:
            break
        before = link
    return tuple(found)


def drawn_links(links: Links, rng: np.random.Generator, first: int) -> Iterator[int]:
    """Yield the links of a route that begins with `first`, and takes any exit of each junction but a U-turn.

    Dead ends and hairpins are taken only where there is no other exit. A route ends where there is none at all.
    """
    link = first
    while True:
        yield link
        if not (exits := links.drivable_exits(link)):
            return
        link = exits[int(rng.integers(len(exits)))]


class NamedRoutes:
    """Routes that name their roads; `source` is the map. `-NAME` is the road NAME against its direction."""

    def __init__(self, source: object, links: Links) -> None:
        self._source, self._links = source, links
        self._of_name: dict[str, list[int]] = {}
        for link, road in enumerate(links.road.tolist()):
            name = links.roads.name[road]
            self._of_name.setdefault(f"{AGAINST}{name}" if link % 2 else name, []).append(link)

    def links_of(self, names: Sequence[str]) -> Iterator[int]:
        """Return the links of a route: each road to where it meets the next, the last to its end, if it has one.

        Raise ScenarioError for roads that are not on the map, or do not meet.
        """
        roads = [self._open_links(name) for name in names]
        found = [self._beginning(names[0], roads[0])]
        for name, road, next_name, next_road in zip(names, roads, names[1:], roads[1:], strict=False):
            seen = {found[-1]}
            while not (way := self._way_to(found[-1], next_road)):
                link = self._onward(found[-1], road)
                if link is None or link in seen:
                    raise ScenarioError(f"{KEY}: {next_name!r} does not begin or go on where {name!r} leads to")
                seen.add(link)
                found.append(link)
            found += way
        return chain(found, self._rest(found[-1], roads[-1]))

    def _rest(self, link: int, road: set[int]) -> Iterator[int]:
        while (after := self._onward(link, road)) is not None:
            yield after
            link = after

    def _onward(self, link: int, road: set[int]) -> int | None:
        """Return the next link of a road, straight on if there are several; None at its end."""
        exits = [each for each in self._links.exits(link).tolist() if each in road]
        return min(exits, key=lambda each: (abs(self._links.turn_rad(link, each)), each), default=None)

    def _open_links(self, name: str) -> set[int]:
        if name not in self._of_name:
            meant = did_you_mean(name, list(self._of_name))
            meant = meant or f"; it has {first_names(list(dict.fromkeys(self._links.roads.name)))}"
            raise ScenarioError(f"{KEY}: {name!r}: no such road in {self._source}{meant}")
        found = {link for link in self._of_name[name] if self._links.is_open[link]}
        if not found:
            raise ScenarioError(f"{KEY}: {name!r}: no lane in this direction is as wide as a vehicle")
        return found

    def _beginning(self, name: str, road: set[int]) -> int:
        """Return the link with which a road begins; of a closed road the first in the file."""
        ends = {int(self._links.end[link]) for link in road}
        begins = sorted(link for link in road if int(self._links.start[link]) not in ends)
        if len(begins) > 1:
            raise ScenarioError(f"{KEY}: {name!r}: {len(begins)} roads of this name begin at different places")
        return begins[0] if begins else min(road)

    def _way_to(self, link: int, road: set[int]) -> list[int]:
        """Return the links from one to the first of a road, through the inside of an intersection if need be."""
        ways = [[each] for each in self._links.exits(link).tolist()]
        for _ in range(_INSIDE + 1):
            for way in ways:
                if way[-1] in road:
                    return way
            inside = (way for way in ways if self._links.is_crossing[way[-1]])
            ways = [[*way, after] for way in inside for after in self._links.exits(way[-1]).tolist()]
        return []
