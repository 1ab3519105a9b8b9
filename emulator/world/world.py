"""The world of a run: truth and GNSS fixes at every period, from the scenario's seed.

Every process is drawn from a stream of its own, keyed by (seed, what, vehicle), so that one more vehicle changes
nothing for the others. In networks of straight lanes vehicles stand (MODEL 1), and only their lateral offset moves;
in networks of trips they drive, enter and leave, and are where their trips say. Both have the error that all share,
and the noise of each receiver.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from emulator.scenario.random_streams import stream
from emulator.scenario.scenario import Gnss, Scenario
from emulator.world.lateral import stray
from emulator.world.links import load_links
from emulator.world.maps.around import read_lanes
from emulator.world.networks import Network, generate_network, load_network
from emulator.world.trips.drive import drive, drive_through_city
from emulator.world.trips.motion import Motion
from vnet.errors import ScenarioError, first_names
from vnet.node import Fix
from vnet.roads.lanes import LaneMap
from vnet.roads.road_map import RoadMap
from vnet.types import Array
from vnet.units import NS_PER_S


@dataclass(frozen=True)
class Instant:
    """The truth and the fixes at the start of one period.

    `position_m` (N, 2), `heading_rad` (N,), `common_error_m` (2,), `fix_m` (N, 2), `fix_heading_rad` (N,) with
    NaN where the fix has none. Of a vehicle that is not there, all is NaN.
    """

    period: int
    time_ns: int
    position_m: Array
    heading_rad: Array
    common_error_m: Array
    fix_m: Array
    fix_heading_rad: Array

    @property
    def present(self) -> NDArray[np.bool_]:
        """(N,), which vehicles are there."""
        return np.isfinite(self.position_m[:, 0])


class World:
    """All that is true during a run: the `motion` of each vehicle, and what its receiver makes of it.

    `lane_map` is what vehicles may know; `lane_of` (N,) is the lane of each that stands on one, and their secret.
    `links` (N, N) is who (row) hears whom (column), or None where the radio's range decides. `moves` says whether
    vehicles drive, enter and leave, `course_m` (K, N, 2) where they are at each period's start (NaN: not there).
    Raises ScenarioError if the scenario's links, exceptions or processes do not fit the vehicles.
    """

    def __init__(
        self, scenario: Scenario, motion: Motion, lane_map: LaneMap | RoadMap, lane_of: NDArray[np.intp]
    ) -> None:
        seed = scenario.run.seed
        count = len(motion.node_ids)
        self.node_ids = motion.node_ids
        self.moves = scenario.network.moves
        self.links = load_links(scenario.radio, count)
        self.period_ns = scenario.period_ns
        self.periods = periods_of(scenario)
        self.lane_map = lane_map
        self.lane_of = lane_of
        self.course_m, self._heading_rad = motion.position_m, motion.heading_rad
        there = np.isfinite(motion.position_m[: self.periods - 1, :, 0])
        self._changes = np.flatnonzero((there[1:] != there[:-1]).any(axis=1)) + 1  # periods
        _check_exceptions(scenario, motion.node_ids)
        _check_processes(scenario, bool(there.all()))
        self._gnss = scenario.world.gnss
        self._common_m = self._draw_common(scenario)
        self._noise_m, self._heading_noise = self._draw_noise(self._gnss, seed, count)

    def present(self, period: int) -> NDArray[np.bool_]:
        """(N,), which vehicles are there in `period`."""
        return np.isfinite(self.course_m[period, :, 0])

    def position_m(self, period: int) -> Array:
        """(N, 2), where vehicles are at the start of `period`; NaN where one is not there."""
        return np.asarray(self.course_m[period])

    @property
    def has_traffic(self) -> bool:
        """Whether vehicles enter or leave during the run."""
        return len(self._changes) > 0

    def next_change_ns(self, after_ns: int) -> int | None:
        """When next, after this instant and during the run, a vehicle enters or leaves."""
        place = np.searchsorted(self._changes, after_ns // self.period_ns + 1)
        return int(self._changes[place]) * self.period_ns if place < len(self._changes) else None

    def _draw_common(self, scenario: Scenario) -> Array:
        """(K, 2): the common error, a Gauss-Markov process from its stationary distribution on."""
        common = scenario.world.common_error
        normal = stream(scenario.run.seed, "common error").standard_normal((self.periods, 2))
        keep = math.exp(-self.period_ns / NS_PER_S / common.tau_s)
        error = np.empty_like(normal)
        error[0] = common.sigma_m * normal[0]
        for k in range(1, self.periods):
            error[k] = keep * error[k - 1] + common.sigma_m * math.sqrt(1 - keep**2) * normal[k]
        return error

    def _draw_noise(self, gnss: Gnss, seed: int, count: int) -> tuple[Array, Array]:
        """(K, N, 2) position noise in metres and (K, N) heading noise in radians."""
        position = [stream(seed, "gnss", i).standard_normal((self.periods, 2)) for i in range(count)]
        heading = [stream(seed, "heading", i).standard_normal(self.periods) for i in range(count)]
        return gnss.sigma_m * np.stack(position, axis=1), gnss.heading_sigma_rad * np.stack(heading, axis=1)

    def at(self, period: int) -> Instant:
        """The truth at the start of `period`, 0 ≤ period < `periods`."""
        assert 0 <= period < self.periods, period
        position_m, heading_rad = self.course_m[period], self._heading_rad[period]
        common_m = self._common_m[period]
        if self._gnss.heading:
            fix_heading = np.mod(heading_rad + self._heading_noise[period], 2 * np.pi)
        else:
            fix_heading = np.full(len(heading_rad), np.nan)
        return Instant(
            period,
            period * self.period_ns,
            position_m,
            heading_rad,
            common_m,
            position_m + common_m + self._noise_m[period],
            fix_heading,
        )

    def fix(self, period: int, node: int) -> Fix:
        """What the receiver of vehicle number `node` says at the start of `period`, if it is there."""
        fix_m = self.course_m[period, node] + self._common_m[period] + self._noise_m[period, node]
        heading = None
        if self._gnss.heading and not np.isnan(self._heading_rad[period, node]):
            noisy = self._heading_rad[period, node] + self._heading_noise[period, node]
            heading = float(np.mod(noisy, 2 * np.pi))
        return Fix(period * self.period_ns, fix_m, np.eye(2) * self._gnss.sigma_m**2, heading)


def periods_of(scenario: Scenario) -> int:
    """How many instants of truth a run needs: one for the start of each period, and one for its end."""
    return math.ceil(scenario.duration_ns / scenario.period_ns) + 1


def _draw_lateral(scenario: Scenario, count: int) -> Array:
    """(K, N): Ornstein-Uhlenbeck offsets from the lane's centre, reflected at the half-width."""
    lateral, periods = scenario.world.lateral, periods_of(scenario)
    normal = np.column_stack(
        [stream(scenario.run.seed, "lateral", i).standard_normal(periods) for i in range(count)]
    )
    keep = math.exp(-scenario.period_ns / NS_PER_S / lateral.tau_s)
    return stray(normal, lateral.sigma_m, keep, lateral.half_width_m)


def _stand_on_lanes(scenario: Scenario, network: Network) -> World:
    """A world in which each vehicle stands on a straight lane of its own, and strays across it."""
    count = len(network.node_ids)
    order = stream(scenario.run.seed, "map order").permutation(count)
    half_width_m = scenario.world.lateral.half_width_m
    lane_map = LaneMap(network.position_m[order], network.heading_rad[order], half_width_m)
    normal = np.column_stack([np.sin(network.heading_rad), -np.cos(network.heading_rad)])
    lateral_m = _draw_lateral(scenario, count)
    position_m = network.position_m + lateral_m[:, :, None] * normal
    heading_rad = np.broadcast_to(network.heading_rad, lateral_m.shape)
    return World(scenario, Motion(network.node_ids, position_m, heading_rad), lane_map, np.argsort(order))


def _drive(scenario: Scenario) -> World:
    """A world in which vehicles drive: trips, on the roads of `[map]` if there is one, or through a city."""
    section, periods = scenario.map, periods_of(scenario)
    lanes: LaneMap | RoadMap = LaneMap(np.zeros((0, 2)), np.zeros(0), scenario.world.lateral.half_width_m)
    if scenario.network.kind == "city":
        motion, lanes = drive_through_city(scenario.network, section, periods, scenario.period_ns)
    else:
        motion = drive(scenario.network, periods, scenario.period_ns)
        if section is not None:
            lanes = read_lanes(section, motion.position_m, motion.origin_deg)
    return World(scenario, motion, lanes, np.zeros(0, dtype=np.intp))


def _check_exceptions(scenario: Scenario, node_ids: tuple[str, ...]) -> None:
    for exception in scenario.program.exceptions:
        for node in exception.nodes:
            if node not in node_ids:
                some = first_names(node_ids)
                raise ScenarioError(f"program.exceptions: {node!r} is no vehicle of the network; they are {some}")


def _check_processes(scenario: Scenario, all_present: bool) -> None:
    """Who shares a process starts and ends together."""
    if scenario.run.nodes_per_process > 1 and not all_present:
        raise ScenarioError(
            f"run.nodes_per_process = {scenario.run.nodes_per_process}: must be 1 where vehicles enter or leave"
        )


def build_world(scenario: Scenario) -> World:
    """The world of a scenario. Raises ScenarioError if its network or its links cannot be used."""
    network = scenario.network
    if network.moves:
        return _drive(scenario)
    if network.path is not None:
        return _stand_on_lanes(scenario, load_network(network.path))
    return _stand_on_lanes(scenario, generate_network(network.layout, network.vehicles, network.seed))


def components(position_m: Array, range_m: float, links: NDArray[np.bool_] | None = None) -> NDArray[np.intp]:
    """Which connected component each vehicle belongs to, as (N,) labels; -1 for those that are not there.

    Positions (N, 2) and the range are in metres. `links` (N, N), if given, says who hears whom in place of the
    range; a link of one direction connects as well (weakly).
    """
    there = np.isfinite(position_m[:, 0])
    here_m = position_m[there]
    offset = here_m[:, None] - here_m[None]
    linked = np.hypot(offset[..., 0], offset[..., 1]) <= range_m if links is None else links[np.ix_(there, there)]
    label = np.full(len(there), -1, dtype=np.intp)
    label[there] = connected_components(linked, directed=False)[1]
    return label
