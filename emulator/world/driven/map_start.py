"""Driven vehicles on a map at the start: the map's roads, the vehicles' routes, and where on them they are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from emulator.scenario.network import Driven, Map
from emulator.scenario.random_streams import stream
from emulator.scenario.scenario import Scenario
from emulator.world.driven.map_links import Links
from emulator.world.driven.map_paths import Paths
from emulator.world.driven.map_roads import MapRoads
from emulator.world.driven.map_routes import NamedRoutes, drawn_links, elements_of
from emulator.world.driven.road import Ints
from emulator.world.driven.start import Start, check_room, one_each, queue_m
from emulator.world.maps.around import lanes_in_box, notes_of
from emulator.world.maps.city import city_roads
from emulator.world.maps.files import read_roads
from emulator.world.projection import Frame
from vnet.errors import ScenarioError
from vnet.roads.road_map import RoadMap
from vnet.types import Array

TRIES = 200
"""Places that are drawn for a vehicle before there is no room for it."""
STREAM = "driven routes"
"""Random stream of a vehicle's place at the start, and of its route."""

Route = tuple[int, ...]
Names = tuple[str, ...]


class _Place(NamedTuple):
    """Place that is drawn for a vehicle."""

    link: int
    along_m: float
    lane: int
    position_m: Array


@dataclass(frozen=True)
class MapStart:
    """Vehicles at the start, the lanes that programs know, the frame of the metres, and notes for the user."""

    start: Start
    lanes: RoadMap
    frame: Frame | None
    notes: tuple[str, ...]


def start_on_map(scenario: Scenario) -> MapStart:
    """Return where vehicles are on the scenario's map, or in a generated city without one.

    Raise ScenarioError if the map cannot be read, for a route that is none, and if there is no room.
    """
    section, driven, network = scenario.map, scenario.driven, scenario.network
    count = network.vehicles
    if section is None:
        source: object = "the generated city"
        roads = city_roads(network.seed, network.size_m)
    else:
        source, roads = section.path, read_roads(section.path, section.origin_deg)
    links = Links(roads, driven.vehicle_width_m)
    paths = Paths(*((links, 1.0, 0.0) if section is None else (links, _side(section), section.aside_m)))
    reach_m = driven.max_speed_mps * scenario.run.duration_s
    if scenario.world.ranging is not None:
        reach_m += scenario.world.ranging.range_m
    ways = _Ways(source, driven, paths, links, reach_m)
    start = ways.named(driven.routes, count) if driven.routes else ways.drawn(count, network.seed)
    assert isinstance(start.road, MapRoads)
    if section is None:
        return MapStart(start, roads.lane_map(), roads.frame, ())
    lanes = lanes_in_box(roads, section, *start.road.area_m(start.along_m))
    if lanes is None:
        raise ScenarioError(
            f"map.aside_m = {section.aside_m:g}: vehicles would be further than margin_m = {section.margin_m:g} m "
            f"from all roads of {source}"
        )
    return MapStart(start, lanes, roads.frame, notes_of(section.path, roads))


def _side(section: Map) -> float:
    return 1.0 if section.drive_on == "right" else -1.0


class _Ways:
    """Routes of vehicles and their places on them; routes go on for `reach_m` behind the places if they can."""

    def __init__(self, source: object, driven: Driven, paths: Paths, links: Links, reach_m: float) -> None:
        self._source, self._driven, self._paths, self._links = source, driven, paths, links
        self._reach_m = reach_m

    def _start(self, routes: list[Route], along_m: Array, lane: Ints) -> Start:
        driven = self._driven
        road = MapRoads(self._paths.paths, routes, driven.lane_width_m, driven.vehicle_length_m)
        return Start(road, along_m, lane)

    # Routes that the scenario names.

    def named(self, named: tuple[Names, ...], count: int) -> Start:
        """Return `count` vehicles on routes that name their roads, which they have in turn."""
        reader = NamedRoutes(self._source, self._links)
        number = np.arange(count)
        first = np.array([next(reader.links_of(names)) for names in named])[number % len(named)]
        lane, along_m = np.zeros(count, dtype=np.intp), np.zeros(count)
        for link in np.unique(first).tolist():
            own = number[first == link]
            lane[own], along_m[own] = self._queue(int(self._links.lanes[link]), own, count)
        routes: list[Route] = []
        for k, names in enumerate(named[:count]):
            own = number[number % len(named) == k]
            routes.append(self._route(reader, names, lane[own], along_m[own]))
        start = self._start([routes[n % len(named)] for n in range(count)], along_m, lane)
        lanes = start.road.lane_count(along_m)
        for n in np.flatnonzero(lane >= lanes)[:1].tolist():
            raise ScenarioError(
                f"network.driven.start_lanes: {lane[n]} for vehicle {n + 1}: its road has lanes 0 to {lanes[n] - 1}"
            )
        return start

    def _queue(self, lanes: int, own: Ints, count: int) -> tuple[Ints, Array]:
        """Return lanes and positions (n,) of the vehicles `own` (n,) that begin on a road with `lanes`."""
        driven = self._driven
        lane: Ints = np.arange(len(own)) % lanes
        if driven.start_lanes is not None:
            lane = np.array(one_each("start_lanes", driven.start_lanes, count), dtype=np.intp)[own]
        if driven.start_m is not None:
            return lane, np.array(one_each("start_m", driven.start_m, count))[own]
        return lane, queue_m(driven, lane)

    def _route(self, reader: NamedRoutes, names: Names, lane: Ints, along_m: Array) -> Route:
        """Return a route of vehicles in these lanes and places (n,). Raise ScenarioError if it is too short."""
        route = elements_of(self._paths, reader.links_of(names), float(along_m.max()) + self._reach_m)
        length_m = sum(self._paths.paths[path].length_m for path in route)
        has = f"route {list(names)} has {length_m:g} m"
        if self._driven.start_m is None:
            check_room(self._driven, lane, length_m, has)
        elif along_m.max() > length_m:
            raise ScenarioError(f"network.driven.start_m: {along_m.max():g}: {has}")
        return route

    # Routes that are drawn.

    def drawn(self, count: int, seed: int) -> Start:
        """Return `count` vehicles anywhere on the map, each drawn from a stream of its own."""
        links, length_m = self._links, self._driven.vehicle_length_m
        fits = links.is_open & ~links.is_crossing & (links.length_m > 2 * length_m)
        candidates = np.flatnonzero(fits & links.is_endless if (fits & links.is_endless).any() else fits)
        if not len(candidates):
            raise ScenarioError(f"{self._source}: no road is as long and wide as a vehicle needs it to start there")
        share = np.cumsum(links.length_m[candidates])
        places: list[_Place] = []
        routes: list[Route] = []
        place_m, link_of = np.zeros((count, 2)), np.zeros(count, dtype=np.intp)
        for number in range(count):
            rng = stream(seed, STREAM, number)
            drawn = (
                self._draw(rng, int(candidates[np.searchsorted(share, rng.random() * share[-1], side="right")]))
                for _ in range(TRIES)
            )
            others = link_of[:number], place_m[:number]
            place = next((each for each in drawn if self._is_free(each, *others)), None)
            if place is None:
                raise ScenarioError(
                    f"network.driven: no room for vehicle {number + 1} with gap_m = {self._driven.gap_m:g} on the "
                    f"roads of {self._source}: set fewer vehicles, or a smaller gap_m"
                )
            places.append(place)
            link_of[number], place_m[number] = place.link, place.position_m
            least_m = place.along_m + self._reach_m
            routes.append(elements_of(self._paths, drawn_links(links, rng, place.link), least_m))
        along_m, lane = np.array([place.along_m for place in places]), np.array([place.lane for place in places])
        return self._start(routes, along_m, lane)

    def _draw(self, rng: np.random.Generator, link: int) -> _Place:
        path, half_m = self._paths.paths[self._paths.of_link(link)], self._driven.vehicle_length_m / 2
        along_m = float(rng.uniform(half_m, max(path.length_m - half_m, half_m)))
        lane = int(rng.integers(path.lanes[0]))
        return _Place(link, along_m, lane, path.at(along_m, lane * path.width_m[0]))

    def _is_free(self, place: _Place, link_of: Ints, place_m: Array) -> bool:
        """Return whether a vehicle has its gap to those in its street, and is clear of those in other streets.

        The others are in the streets `link_of` (n,) at `place_m` (n, 2).
        """
        length_m = self._driven.vehicle_length_m
        clear_m = length_m + np.where(link_of == place.link, self._driven.gap_m, length_m)
        return bool((np.hypot(*(place_m - place.position_m).T) >= clear_m).all())
