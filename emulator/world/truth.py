"""The truth of a run and the fixes of its receivers, period by period."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from emulator.scenario.program import RoadsideUnit
from emulator.scenario.scenario import Scenario
from emulator.scenario.world import Gnss
from emulator.world.gnss import MotionSensors, common_errors, further_error_m, noise_m, speed_mps
from emulator.world.own_sensors import OwnSensors, Reading, SensedTruth
from emulator.world.projection import CoordinateFrame
from emulator.world.radio_inputs import RadioInputs, load_buildings, load_links
from emulator.world.trips.motion import Motion
from vnet.errors import ScenarioError, first_names, shown
from vnet.node import NOTHING_SENSED, Fix
from vnet.roads.lanes import LaneMap
from vnet.roads.road_map import RoadMap
from vnet.types import Array


def with_units(motion: Motion, units: Sequence[RoadsideUnit]) -> Motion:
    """Return the motion of vehicles and units. Raise ScenarioError for a unit that has a vehicle's name."""
    if not units:
        return motion
    names = tuple(unit.name for unit in units)
    for number, name in enumerate(names):
        if name in motion.node_ids:
            raise ScenarioError(f"roadside.{number}.id = {shown(name)}: a vehicle has this name")
    periods = len(motion.position_m)
    position_m = np.tile([unit.position_m for unit in units], (periods, 1, 1))
    return replace(
        motion,
        node_ids=(*motion.node_ids, *names),
        position_m=np.concatenate([motion.position_m, position_m], axis=1),
        heading_rad=np.concatenate([motion.heading_rad, np.full((periods, len(units)), np.nan)], axis=1),
    )


@dataclass(frozen=True)
class Instant:
    """The truth and the fixes at the start of one period.

    `position_m` (N, 2), `heading_rad` (N,), `common_error_m` (2,), `fix_m` (N, 2), and `fix_heading_rad` (N,),
    which is NaN for a fix without heading. All entries of an absent vehicle are NaN.
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
        """Mask (N,) of the vehicles that are present."""
        return np.isfinite(self.position_m[:, 0])


class World:
    """The truth of a run: the `motion` of all vehicles, and the fixes of their receivers.

    The scenario's roadside units are the last nodes, behind the vehicles of `motion`, and stand.

    `lane_map` is given to programs; `lane_of` (N,), the lane of each vehicle that stands on one, is not. `frame` is
    that of the metres, if it is known. `radio_inputs` is what the radio reads from files. `moves` is true if
    vehicles drive, enter and leave. `course_m` (K, N, 2) are the positions at the start of each period, NaN for an
    absent vehicle; `receiver_m` (K, R, 2) is what a file's receivers have beyond the common error, or None. `notes`
    are lines for the user about the input. Raise ScenarioError if the scenario's links, buildings, exceptions or
    processes do not fit the vehicles.
    """

    def __init__(
        self,
        scenario: Scenario,
        motion: Motion,
        lane_map: LaneMap | RoadMap,
        lane_of: NDArray[np.intp],
        frame: CoordinateFrame | None = None,
    ) -> None:
        motion = with_units(motion, scenario.roadside)
        count = len(motion.node_ids)
        self.node_ids = motion.node_ids
        self.moves = scenario.network.moves
        self.period_ns = scenario.period_ns
        self.periods = periods_of(scenario)
        self.lane_map = lane_map
        self.lane_of = lane_of
        self.notes = motion.notes
        self.course_m, self._heading_rad = motion.position_m, motion.heading_rad
        scenario.require_extras()
        buildings = load_buildings(scenario, frame, self.area_m)
        self.radio_inputs = RadioInputs(load_links(scenario.radio, self.node_ids), buildings, scenario.roadside)
        if buildings is not None and not len(buildings):
            self.notes = (*self.notes, f"radio.buildings: none is near a vehicle; check {_place_of(scenario)}")
        present = np.isfinite(motion.position_m[: self.periods - 1, :, 0])
        self._changes = np.flatnonzero((present[1:] != present[:-1]).any(axis=1)) + 1  # periods
        _check_exceptions(scenario, motion.node_ids)
        if not present.all():
            refuse_shared_processes(scenario, "where vehicles enter or leave")
        self._multipath = _stated_multipath(scenario.world.gnss)
        self._covariance_m2 = np.eye(2) * (scenario.world.gnss.sigma_m**2 + self._multipath[0] ** 2)
        self._covariance_m2.flags.writeable = False  # one for all fixes
        common = common_errors(scenario, self.periods)
        self._common_m, self.receiver_m = common.common_m, common.receiver_m
        self._noise_m = noise_m(scenario, self.periods, count)
        further_m = further_error_m(scenario, self.course_m, self.area_m.mean(axis=0), self.receiver_m)
        if further_m is not None:
            self._noise_m += further_m
        self._fix_m = self.course_m[: self.periods] + self._common_m[: self.periods, None] + self._noise_m
        sensors, speed = (
            MotionSensors(scenario, self.periods, count),
            speed_mps(self.course_m, self.period_ns, self.moves),
        )
        self._fix_heading_rad = sensors.heading_rad(self._heading_rad, speed)
        self._fix_speed_mps = sensors.speed_mps(speed)
        self._true_speed_mps = speed
        self.own_sensors = OwnSensors(scenario.run.seed, scenario.world.sensor, scenario.program)

    def present(self, period: int) -> NDArray[np.bool_]:
        """Return the mask (N,) of the vehicles that are present in `period`."""
        return np.isfinite(self.course_m[period, :, 0])

    @property
    def area_m(self) -> Array:
        """Corners (2, 2) of the box in which vehicles are during the run."""
        return np.array([np.nanmin(self.course_m, axis=(0, 1)), np.nanmax(self.course_m, axis=(0, 1))])

    @property
    def last_known_period(self) -> int:
        """The last period at whose start it is known where vehicles are."""
        return self.periods - 1

    def position_m(self, period: int) -> Array:
        """Return the positions (N, 2) at the start of `period`; NaN for an absent vehicle."""
        return np.asarray(self.course_m[period])

    @property
    def has_traffic(self) -> bool:
        """True if vehicles enter or leave during the run."""
        return len(self._changes) > 0

    def next_change_ns(self, after_ns: int) -> int | None:
        """Return the next time after `after_ns` at which a vehicle enters or leaves during the run, or None."""
        index = np.searchsorted(self._changes, after_ns // self.period_ns + 1)
        return int(self._changes[index]) * self.period_ns if index < len(self._changes) else None

    def at(self, period: int) -> Instant:
        """Return the truth and the fixes at the start of `period`, 0 ≤ period < `periods`."""
        assert 0 <= period < self.periods, period
        position_m, common_m = self.course_m[period], self._common_m[period]
        return Instant(
            period=period,
            time_ns=period * self.period_ns,
            position_m=position_m,
            heading_rad=self._heading_rad[period],
            common_error_m=common_m,
            fix_m=self._fix_m[period],
            fix_heading_rad=self._fix_heading_rad[period],
        )

    def fix(self, period: int, node: int) -> Fix:
        """Return the fix of vehicle number `node`, which must be present, at the start of `period`."""
        heading_rad = self._fix_heading_rad.item(period, node)
        # Copies: a program may do with its fix what it likes.
        fix_m, covariance_m2 = self._fix_m[period, node].copy(), self._covariance_m2.copy()
        return Fix(
            period * self.period_ns,
            fix_m,
            covariance_m2,
            None if math.isnan(heading_rad) else heading_rad,
            self._fix_speed_mps.item(period, node),
            sensors=self.sensed(period, node) if self.own_sensors else NOTHING_SENSED,
            multipath_sigma_m=self._multipath[0],
            multipath_tau_s=self._multipath[1],
        )

    def fix_m(self, period: int, node: int) -> Array:
        """Return the position (2,) of a fix alone, for which no sensor is asked."""
        return np.asarray(self._fix_m[period, node].copy())

    def sensed(self, period: int, node: int) -> dict[str, Reading]:
        """Return what the sensors of the user's own in vehicle number `node` read at the start of `period`."""
        return self.own_sensors.readings(period, self.node_ids[node], self._sensed_truth)

    def _sensed_truth(self, period: int) -> SensedTruth:
        there = np.flatnonzero(self.present(period))
        return SensedTruth(
            time_ns=period * self.period_ns,
            node_ids=tuple(self.node_ids[number] for number in there.tolist()),
            position_m=self.course_m[period, there],
            heading_rad=self._heading_rad[period, there],
            speed_m_s=self._true_speed_mps[period, there],
        )


def _place_of(scenario: Scenario) -> str:
    """Return what says where the buildings of a scenario are: those in metres have no origin."""
    section, roads = scenario.radio.buildings, scenario.map
    path = (section.path if section else None) or (roads.path if roads else None)
    assert path is not None
    in_metres = path.name.lower().endswith((".csv", ".poly.xml"))
    return "the coordinates of its corners" if in_metres else "its origin_deg"


def _stated_multipath(gnss: Gnss) -> tuple[float, float]:
    """Return deviation (m) and correlation time (s) of the multipath that fixes state; 0, 0 if none."""
    if gnss.covariance != "total" or not gnss.multipath_sigma_m:
        return 0.0, 0.0
    return gnss.multipath_sigma_m, gnss.multipath_tau_s


def periods_of(scenario: Scenario) -> int:
    """Return the number of instants of truth of a run: the start of each period, and the end of the last."""
    return math.ceil(scenario.duration_ns / scenario.period_ns) + 1


def _check_exceptions(scenario: Scenario, node_ids: tuple[str, ...]) -> None:
    for exception in scenario.program.exceptions:
        for node in exception.nodes:
            if node not in node_ids:
                some = first_names(node_ids)
                raise ScenarioError(f"program.exceptions: {node!r}: no such vehicle; the network has {some}")


def refuse_shared_processes(scenario: Scenario, where: str) -> None:
    """Raise ScenarioError if nodes share a process, which starts and ends as one, `where` they come and go."""
    if scenario.run.nodes_per_process > 1:
        raise ScenarioError(f"run.nodes_per_process = {scenario.run.nodes_per_process}: must be 1 {where}")
