"""The world of driven vehicles: truth and fixes that come to be as the run goes on."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from emulator.scenario.driven import control_step_ns
from emulator.scenario.random_streams import stream
from emulator.scenario.scenario import Scenario
from emulator.world.driven.start import Start, start_on_single_road
from emulator.world.driven.vehicles import DrivenVehicles, Happening
from emulator.world.projection import Frame
from emulator.world.receivers import MotionSensors
from emulator.world.trips.motion import Motion
from emulator.world.truth import World, periods_of
from vnet.errors import ScenarioError
from vnet.node import Fix
from vnet.roads.lanes import LaneMap
from vnet.roads.road_map import RoadMap
from vnet.types import Array, Mask
from vnet.units import NS_PER_S


class DrivenWorld(World):
    """A world whose truth is known up to the control instant that its `vehicles` have come to, and no further."""

    def __init__(self, scenario: Scenario) -> None:
        node_ids = _node_ids(scenario.network.vehicles)
        start, lanes, frame, notes = _start(scenario, len(node_ids))
        self.vehicles = DrivenVehicles(scenario.driven, node_ids, control_step_ns(scenario.run.control_hz), start)
        self._units_m = [unit.position_m for unit in scenario.roadside]
        self._duration_ns = scenario.duration_ns
        self._furthest_m = start.along_m + scenario.driven.max_speed_mps * scenario.run.duration_s
        self._known = 1  # periods whose truth is known
        self._left: list[int] = []  # periods with which vehicles leave
        position_m, heading_rad = self.vehicles.place()
        periods = periods_of(scenario)
        motion = Motion(
            node_ids, np.tile(position_m, (periods, 1, 1)), np.tile(heading_rad, (periods, 1)), notes=notes
        )
        super().__init__(scenario, motion, lanes, np.zeros(0, dtype=np.intp), frame)
        self._sensors = MotionSensors(scenario, periods, len(node_ids))
        self._ranging = scenario.world.ranging
        self._gap_m, self._gap_rate_mps = _nothing(periods, len(self.node_ids))
        seed = scenario.run.seed
        if self._ranging is not None:
            draws = [stream(seed, "ranging", n).standard_normal((periods, 2)) for n in range(len(node_ids))]
            self._ranging_normal = np.stack(draws, axis=1)
        if scenario.run.nodes_per_process > 1 and self.may_leave:
            raise ScenarioError(
                f"run.nodes_per_process = {scenario.run.nodes_per_process}: must be 1 where vehicles may leave: "
                f"they may come to the end of the road, after {self.vehicles.road.end_m.min():g} m"
            )
        self._fill(0)

    @property
    def may_leave(self) -> bool:
        """True if a vehicle may come to the end of the road."""
        return bool((self._furthest_m > self.vehicles.road.end_m).any())

    @property
    def has_traffic(self) -> bool:
        """True if vehicles may leave during the run."""
        return self.may_leave

    @property
    def area_m(self) -> Array:
        """Corners (2, 2) of the box in which vehicles can be during the run."""
        corners_m = np.array([*self.vehicles.road.area_m(self._furthest_m), *self._units_m])
        return np.array([corners_m.min(axis=0), corners_m.max(axis=0)])

    def present(self, period: int) -> Mask:
        """Return the mask (N,) of the vehicles that are present in `period`."""
        return np.asarray(np.isfinite(self.position_m(period)[:, 0]))

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
        """Return the first time after `after_ns` at which vehicles have left, as far as is known, or None."""
        times_ns = (period * self.period_ns for period in self._left)
        return next((time_ns for time_ns in times_ns if time_ns > after_ns), None)

    @property
    def driven(self) -> tuple[str, ...]:
        """Ids of the vehicles that programs drive: all nodes but roadside units."""
        return self.node_ids[: len(self.node_ids) - len(self._units_m)]

    def next_control_ns(self) -> int | None:
        """Return the next control instant within the run, or None."""
        next_ns = self.vehicles.now_ns + self.vehicles.step_ns
        return next_ns if next_ns < self._duration_ns else None

    def advance(self) -> list[Happening]:
        """Let all drive to the next control instant; returns what happens."""
        happened = self.vehicles.advance()
        period, rest_ns = divmod(self.vehicles.now_ns, self.period_ns)
        if rest_ns == 0:
            if self.vehicles.remove_arrived():
                self._left.append(period)
            self._fill(period)
        return happened

    def _fill(self, period: int) -> None:
        """Take the truth at the start of a period, and what receivers and sensors make of it."""
        position_m, heading_rad = self.vehicles.place()
        rows, speed = slice(period, period + 1), self.vehicles.speed[None]
        driven = slice(len(position_m))  # behind them there are roadside units
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


def _nothing(periods: int, count: int) -> tuple[Array, Array]:
    return np.full((periods, count), np.nan), np.full((periods, count), np.nan)


def _node_ids(vehicles: int) -> tuple[str, ...]:
    width = max(2, len(str(vehicles)))
    return tuple(f"v{number:0{width}d}" for number in range(1, vehicles + 1))


def _start(scenario: Scenario, count: int) -> tuple[Start, LaneMap | RoadMap, Frame | None, tuple[str, ...]]:
    """Return where vehicles are at the start, the lanes that programs know, their frame, and notes for the user."""
    if scenario.driven.road == "map":
        from emulator.world.driven.map_start import start_on_map  # maps need much of scipy and are slow to import

        found = start_on_map(scenario)
        return found.start, found.lanes, found.frame, found.notes
    start = start_on_single_road(scenario.driven, count)
    return start, _lane_map(scenario), None, ()


def _lane_map(scenario: Scenario) -> LaneMap:
    """Return the lanes that programs know: those of a straight road; of a ring none, as it is not straight."""
    driven, half_width_m = scenario.driven, scenario.world.lateral.half_width_m
    if driven.road == "ring":
        return LaneMap(np.zeros((0, 2)), np.zeros(0), half_width_m)
    point_m = np.column_stack([np.zeros(driven.lanes), np.arange(driven.lanes) * driven.lane_width_m])
    return LaneMap(point_m, np.zeros(driven.lanes), half_width_m)
