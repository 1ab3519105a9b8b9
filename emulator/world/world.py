"""The world of a run: truth and GNSS fixes at every period, from the scenario's seed.

Every process is drawn from a random stream of its own, keyed by (seed, process, vehicle), so one more vehicle
changes nothing for the others. In networks of straight lanes vehicles stand (MODEL 1), and only their lateral
offset varies. In networks of trips they drive, enter and leave, as their trips say. Both have the common error of
all receivers, and the noise of each.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from emulator.scenario.random_streams import stream
from emulator.scenario.scenario import Scenario
from emulator.world.driven.stepped import DrivenWorld
from emulator.world.driven.sumo import SumoWorld
from emulator.world.neighbours import Links, components_of_links
from emulator.world.networks import PlacedVehicles, generate_network, load_network
from emulator.world.projection import CoordinateFrame
from emulator.world.trips.motion import Motion, lateral_offsets_m
from emulator.world.truth import Instant, World, periods_of
from vnet.roads.lanes import LaneMap
from vnet.roads.road_map import RoadMap
from vnet.types import Array
from vnet.units import NS_PER_S

__all__ = ["Instant", "World", "build_world", "components", "periods_of"]


def _draw_lateral(scenario: Scenario, count: int) -> Array:
    """Draw lateral offsets (K, N) in metres: Ornstein-Uhlenbeck processes reflected at the half-width."""
    lateral, periods = scenario.world.lateral, periods_of(scenario)
    normal = np.column_stack(
        [stream(scenario.run.seed, "lateral", i).standard_normal(periods) for i in range(count)]
    )
    keep = math.exp(-scenario.period_ns / NS_PER_S / lateral.tau_s)
    return lateral_offsets_m(normal, lateral.sigma_m, keep, lateral.half_width_m)


def _stand_on_lanes(scenario: Scenario, network: PlacedVehicles) -> World:
    """Return a world in which each vehicle stands on a straight lane of its own, with a varying lateral offset."""
    count = len(network.node_ids)
    order = stream(scenario.run.seed, "map order").permutation(count)
    half_width_m = scenario.world.lateral.half_width_m
    lane_map = LaneMap(network.position_m[order], network.heading_rad[order], half_width_m)
    normal = np.column_stack([np.sin(network.heading_rad), -np.cos(network.heading_rad)])
    lateral_m = _draw_lateral(scenario, count)
    position_m = network.position_m + lateral_m[:, :, None] * normal
    heading_rad = np.broadcast_to(network.heading_rad, lateral_m.shape)
    motion = Motion(network.node_ids, position_m, heading_rad, notes=network.notes)
    return World(scenario, motion, lane_map, np.argsort(order))


def _drive(scenario: Scenario) -> World:
    """Return a world in which vehicles drive recorded trips, or generated ones through a city or a map."""
    # Maps and trips take longer to import than many a run of vehicles that stand.
    from emulator.world.maps.files import lanes_around, notes_of, read_roads
    from emulator.world.trips.drive import drive, drive_through_city

    section, periods = scenario.map, periods_of(scenario)
    lanes: LaneMap | RoadMap = LaneMap(np.zeros((0, 2)), np.zeros(0), scenario.world.lateral.half_width_m)
    if scenario.network.kind == "city":
        motion, lanes, frame = drive_through_city(scenario.network, section, periods, scenario.period_ns)
    else:
        motion = drive(scenario.network, scenario.program, periods, scenario.period_ns)
        frame = None if motion.origin_deg is None else CoordinateFrame.around(*motion.origin_deg)
        if section is not None:
            roads = read_roads(section.path, section.origin_deg or motion.origin_deg)
            lanes, frame = lanes_around(roads, section, motion.position_m), roads.frame
            motion = replace(motion, notes=(*motion.notes, *notes_of(section.path, roads)))
    return World(scenario, motion, lanes, np.zeros(0, dtype=np.intp), frame)


def build_world(scenario: Scenario) -> World:
    """Return the world of a scenario. Raise ScenarioError if its network, map or links cannot be used."""
    scenario.require_extras()
    network = scenario.network
    if network.kind == "driven":
        return DrivenWorld(scenario)
    if network.step:
        return SumoWorld(scenario)
    if network.moves:
        return _drive(scenario)
    if network.path is not None:
        return _stand_on_lanes(scenario, load_network(network.path))
    return _stand_on_lanes(scenario, _generated(network.layout, network.vehicles, network.seed))


@lru_cache(64)
def _generated(layout: str, vehicles: int, seed: int) -> PlacedVehicles:
    """Draw a network once a process: annealing one of 50 vehicles takes longer than many a run."""
    network = generate_network(layout, vehicles, seed)
    for array in (network.position_m, network.heading_rad):
        array.flags.writeable = False
    return network


def components(position_m: Array, links: Links) -> NDArray[np.intp]:
    """Return the connected component (N,) of each vehicle as a label; -1 for an absent vehicle.

    Positions (N, 2) are in metres. A link in one direction connects too (weak components).
    """
    present = np.isfinite(position_m[:, 0])
    number = np.cumsum(present) - 1
    both = present[links.sender] & present[links.receiver]
    label = np.full(len(present), -1, dtype=np.intp)
    sender, receiver = number[links.sender[both]], number[links.receiver[both]]
    label[present] = components_of_links(sender, receiver, int(present.sum()))
    return label
