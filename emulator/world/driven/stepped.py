"""Worlds whose truth is computed during the run, because programs drive; vehicles of others beside them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from emulator.scenario.network import control_step_ns
from emulator.scenario.random_streams import stream
from emulator.scenario.scenario import Scenario
from emulator.world.driven.road import Start, start_on_single_road
from emulator.world.driven.vehicles import DrivenVehicles, Happening, SteppedVehicles
from emulator.world.networks import numbered_ids
from emulator.world.projection import CoordinateFrame
from emulator.world.trips.motion import Motion
from emulator.world.truth import MotionSensors, World, periods_of, refuse_shared_processes
from vnet.errors import ScenarioError
from vnet.node import Fix
from vnet.roads.lanes import LaneMap
from vnet.roads.road_map import RoadMap
from vnet.types import Array
from vnet.units import NS_PER_S


class Background:
    """Positions of vehicles that have no program and no radio, in columns: there may be many."""

    def __init__(self) -> None:
        self.names: dict[str, int] = {}
        """Number of each vehicle by its id, in the order in which they have come."""
        self.time_ns: list[int] = []
        self.numbers: list[NDArray[np.int32]] = []
        """Numbers (k,) of those that were there, at each of the times."""
        self.position_m: list[Array] = []
        """Their positions (k, 2)."""

    def add(self, time_ns: int, ids: Sequence[str], position_m: Array) -> None:
        """Add the vehicles that are there at a time."""
        self.time_ns.append(time_ns)
        self.numbers.append(np.array([self.names.setdefault(each, len(self.names)) for each in ids], np.int32))
        self.position_m.append(position_m)


class SteppedWorld(World):
    """A world whose truth is known up to the control instant that its `vehicles` have come to, and no further.

    Subclasses say in `vehicle_area_m` where vehicles can be, before they call this constructor.
    """

    vehicles: SteppedVehicles
    versions: Mapping[str, str] = MappingProxyType({})
    """Versions of programs that move the vehicles, by name, for the run's verdict."""
    background: Background | None = None
    """Vehicles without programs, where there are any."""

    def __init__(
        self,
        scenario: Scenario,
        node_ids: Sequence[str],
        lane_map: LaneMap | RoadMap,
        notes: tuple[str, ...] = (),
        frame: CoordinateFrame | None = None,
    ) -> None:
        self._count, periods = len(node_ids), periods_of(scenario)
        self._units_m = [unit.position_m for unit in scenario.roadside]
        self.ends_ns = scenario.duration_ns
        """Time at which the run ends: at it nobody drives any more."""
        self._known = 1  # periods whose truth is known
        self._changed: list[int] = []  # periods with which vehicles enter or leave
        position_m, heading_rad = self.vehicles.place()
        course_m, course_rad = np.tile(position_m, (periods, 1, 1)), np.tile(heading_rad, (periods, 1))
        motion = Motion(tuple(node_ids), course_m, course_rad, notes=notes)
        super().__init__(scenario, motion, lane_map, np.zeros(0, dtype=np.intp), frame)
        self._sensors = MotionSensors(scenario, periods, self._count)
        self._ranging = scenario.world.ranging
        self._gap_m, self._gap_rate_mps = np.full((2, periods, len(self.node_ids)), np.nan)
        if self._ranging is not None:
            seed = scenario.run.seed
            draws = [stream(seed, "ranging", n).standard_normal((periods, 2)) for n in range(self._count)]
            self._ranging_normal = np.stack(draws, axis=1)
        self._fill(0)

    @property
    def driven(self) -> tuple[str, ...]:
        """Ids of the vehicles that programs drive: all nodes but roadside units."""
        return self.node_ids[: self._count]

    @property
    def vehicle_area_m(self) -> Array:
        """Corners (2, 2) of the box in which vehicles can be during the run."""
        raise NotImplementedError

    @property
    def area_m(self) -> Array:
        """Corners (2, 2) of the box in which nodes can be during the run."""
        corners_m = np.array([*self.vehicle_area_m, *self._units_m])
        return np.array([corners_m.min(axis=0), corners_m.max(axis=0)])

    @property
    def last_known_period(self) -> int:
        """The last period that vehicles have come to."""
        return self._known - 1

    def position_m(self, period: int) -> Array:
        """Return the positions (N, 2) at the start of `period`; NaN for an absent vehicle.

        Raise ScenarioError for a period that vehicles have not come to.
        """
        if period >= self._known:
            time_s = period * self.period_ns / NS_PER_S
            raise ScenarioError(
                f"positions at {time_s:g} s depend on what programs do until then: where programs drive, "
                "select nodes by name"
            )
        return super().position_m(period)

    def next_change_ns(self, after_ns: int) -> int | None:
        """Return the first time after `after_ns` at which vehicles enter or leave, as far as is known, or None."""
        times_ns = (period * self.period_ns for period in self._changed)
        return next((time_ns for time_ns in times_ns if time_ns > after_ns), None)

    def next_control_ns(self) -> int | None:
        """Return the next control instant within the run, or None."""
        next_ns = self.vehicles.now_ns + self.vehicles.step_ns
        return next_ns if next_ns < self.ends_ns else None

    def advance(self) -> list[Happening]:
        """Let all drive to the next control instant; returns what happens."""
        happened = self.vehicles.advance()
        period, rest_ns = divmod(self.vehicles.now_ns, self.period_ns)
        if rest_ns == 0:
            self.vehicles.remove_arrived()
            self._fill(period)
            if (self.present(period) != self.present(period - 1)).any():
                self._changed.append(period)
        return happened

    def close(self) -> None:
        """Let go of what moves the vehicles; the run is over."""

    def detach(self) -> None:
        """Let go of it in a process forked from the emulator's, which goes on with it."""

    def _fill(self, period: int) -> None:
        """Take the truth at the start of a period, and what receivers and sensors make of it."""
        position_m, heading_rad = self.vehicles.place()
        rows, speed = slice(period, period + 1), self.vehicles.speed[None]
        driven = slice(self._count)  # behind them there are roadside units
        self.course_m[period, driven], self._heading_rad[period, driven] = position_m, heading_rad
        self._fix_m[period, driven] = position_m + self._common_m[period] + self._noise_m[period, driven]
        self._fix_heading_rad[rows, driven] = self._sensors.heading_rad(heading_rad[None], speed, rows)
        self._fix_speed_mps[rows, driven] = self._sensors.speed_mps(speed, rows)
        self._true_speed_mps[rows, driven] = speed
        if self._ranging is not None:
            gap_m, rate_mps = self.vehicles.gaps(self._ranging.range_m)
            noise = self._ranging_normal[period]
            self._gap_m[period, driven] = gap_m + self._ranging.sigma_m * noise[:, 0]
            self._gap_rate_mps[period, driven] = rate_mps + self._ranging.rate_sigma_mps * noise[:, 1]
        self._known = period + 1

    def fix(self, period: int, node: int) -> Fix:
        """Return the fix of vehicle number `node`, which must be present, with the gap that it measures."""
        fix = super().fix(period, node)
        gap_m = self._gap_m[period, node].item()
        if math.isnan(gap_m):
            return fix
        return replace(fix, gap_m=gap_m, gap_rate_m_s=self._gap_rate_mps[period, node].item())


class DrivenWorld(SteppedWorld):
    """A world of `vehicles` on a straight road, a ring or a map, where only programs drive."""

    vehicles: DrivenVehicles

    def __init__(self, scenario: Scenario) -> None:
        node_ids = numbered_ids(scenario.network.vehicles)
        start, lanes, frame, notes = _start(scenario, len(node_ids))
        self.vehicles = DrivenVehicles(scenario.driven, node_ids, control_step_ns(scenario.run.control_hz), start)
        self._furthest_m = start.along_m + scenario.driven.max_speed_mps * scenario.world_ns / NS_PER_S
        super().__init__(scenario, node_ids, lanes, notes, frame)
        if self.may_leave:
            end = f"they may come to the end of the road, after {self.vehicles.road.end_m.min():g} m"
            refuse_shared_processes(scenario, f"where vehicles may leave: {end}")

    @property
    def may_leave(self) -> bool:
        """True if a vehicle may come to the end of the road."""
        return bool((self._furthest_m > self.vehicles.road.end_m).any())

    @property
    def has_traffic(self) -> bool:
        """True if vehicles may leave during the run."""
        return self.may_leave

    @property
    def vehicle_area_m(self) -> Array:
        """Corners (2, 2) of the box in which vehicles can be during the run."""
        return self.vehicles.road.area_m(self._furthest_m)


def _start(
    scenario: Scenario, count: int
) -> tuple[Start, LaneMap | RoadMap, CoordinateFrame | None, tuple[str, ...]]:
    """Return where vehicles are at the start, the lanes that programs know, their frame, and notes for the user."""
    if scenario.driven.road == "map":
        from emulator.world.driven.map_driving import start_on_map

        return start_on_map(scenario)
    start = start_on_single_road(scenario.driven, count)
    return start, _lane_map(scenario), None, ()


def _lane_map(scenario: Scenario) -> LaneMap:
    """Return the lanes that programs know: those of a straight road; of a ring none, as it is not straight."""
    driven, half_width_m = scenario.driven, scenario.world.lateral.half_width_m
    if driven.road == "ring":
        return LaneMap(np.zeros((0, 2)), np.zeros(0), half_width_m)
    point_m = np.column_stack([np.zeros(driven.lanes), np.arange(driven.lanes) * driven.lane_width_m])
    return LaneMap(point_m, np.zeros(driven.lanes), half_width_m)
