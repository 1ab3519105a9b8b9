"""The truth of a run, its GNSS receivers and motion sensors, and what faults make of them, period by period.

Receivers err by what all share and by what each adds. The effects of faults on receivers and clocks are functions
of the fault plan and the time alone.
"""

from __future__ import annotations

import csv
import math
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from emulator.fault_plan import PlannedFault, fault_stream
from emulator.scenario.faults import Drift, GnssFault, GnssFreeze, GnssOutage, RandomPos, Skew
from emulator.scenario.program import RoadsideUnit
from emulator.scenario.random_streams import stream
from emulator.scenario.scenario import Gnss, Scenario
from emulator.scenario.sections import WILD_M
from emulator.world.input_files import number_of, open_csv
from emulator.world.own_sensors import OwnSensors, Reading, SensedTruth
from emulator.world.projection import CoordinateFrame
from emulator.world.radio_inputs import RadioInputs, load_buildings, load_links
from emulator.world.trips.motion import Motion
from vnet.errors import ScenarioError, first_names, shown
from vnet.node import NOTHING_SENSED, Fix
from vnet.roads.lanes import LaneMap
from vnet.roads.road_map import RoadMap
from vnet.transport.wire import ClockError
from vnet.types import Array
from vnet.units import NS_PER_S

MOST_ROWS = 1_000_000
"""Most rows of a file: a day of ten a second has fewer."""
LONGEST_LINE = 10_000
"""Characters of a line of the file."""
FARTHEST_M = 100 * WILD_M
"""Largest recorded error."""
_COMPONENT = re.compile(r"(.+_|)(?:east|north)_m")
M_PER_KM = 1000.0
SLOWEST_MPS = 1e-9
"""Speed of a vehicle that stands, as a divisor."""
EVERY = slice(None)
"""All periods."""


def common_errors(scenario: Scenario, periods: int) -> tuple[Array, Array | None]:
    """Return the common error (K, 2) at the start of each period, in metres, and what receivers have beyond it.

    The latter is (K, R, 2) for each of a file's receivers; None without several. Vehicle n has that of receiver n
    mod R. Raise ScenarioError for a file that cannot be used.
    """
    common = scenario.world.common_error
    if common.path is None:
        return gauss_markov(scenario, "common error", (common.sigma_m, common.tau_s), (periods, 2)), None
    time_s, error_m = _read(common.path)
    start_s = time_s[0] if common.start_s is None else common.start_s
    at_s = start_s + np.arange(periods) * scenario.period_ns / NS_PER_S
    if start_s < time_s[0] or at_s[-1] > time_s[-1]:
        raise ScenarioError(
            f"{common.path}: has errors from {time_s[0]:.10g} to {time_s[-1]:.10g} s; "
            f"the run needs them from {start_s:.10g} to {at_s[-1]:.10g} s"
        )
    columns = [np.interp(at_s, time_s, column) for column in error_m.reshape(len(time_s), -1).T]
    recorded_m = np.stack(columns, axis=1).reshape(periods, -1, 2)
    common_m = recorded_m.mean(axis=1)
    return common_m, recorded_m - common_m[:, None] if recorded_m.shape[1] > 1 else None


def gauss_markov(
    scenario: Scenario, name: str, law: tuple[float, float], shape: tuple[int, ...], item: int = 0
) -> Array:
    """Return a first-order Gauss-Markov process of `shape` (K, …) that starts in its stationary state.

    `law` is its standard deviation and its correlation time in s; `name` and `item` are those of its random stream.
    """
    sigma, tau_s = law
    normal = stream(scenario.run.seed, name, item).standard_normal(shape)
    keep = math.exp(-scenario.period_ns / NS_PER_S / tau_s)
    process = np.empty_like(normal)
    process[0] = sigma * normal[0]
    added = sigma * math.sqrt(1 - keep**2)
    for k in range(1, len(normal)):
        process[k] = keep * process[k - 1] + added * normal[k]
    return process


def _read(path: Path) -> tuple[Array, Array]:
    """Return times (k,) in s and errors (k, R, 2) in m of each receiver. Raise ScenarioError for a bad file."""
    with open_csv(path, LONGEST_LINE) as lines:
        reader = csv.DictReader(lines)
        columns = _columns(path, reader.fieldnames or ())
        rows, lines_read = [], []
        for row in reader:
            lines_read.append(reader.line_num)
            rows.append([_number(path, reader.line_num, name, row[name]) for name in columns])
            if len(rows) > MOST_ROWS:
                raise ScenarioError(f"{path}: more than {MOST_ROWS:,} rows")
    if not rows:
        raise ScenarioError(f"{path}: no rows of errors")
    table = np.array(rows)
    late = np.flatnonzero(np.diff(table[:, 0]) <= 0) + 1
    if len(late):
        where, (before_s, time_s) = f"{path}: line {lines_read[late[0]]}", table[late[0] - 1 : late[0] + 1, 0]
        raise ScenarioError(f"{where}: time_s = {time_s:.10g} follows {before_s:.10g}: times must increase")
    far_m = np.abs(table[:, 1:]).max(axis=1)
    if far_m.max() > FARTHEST_M:
        where = f"{path}: line {lines_read[far_m.argmax()]}"
        raise ScenarioError(f"{where}: an error of {far_m.max():g} m; at most {FARTHEST_M:g} m are allowed")
    return table[:, 0], table[:, 1:].reshape(len(table), -1, 2)


def _columns(path: Path, names: object) -> list[str]:
    """Return the columns that are read: time_s, then east and north of each receiver."""
    found = [str(name) for name in names] if isinstance(names, (list, tuple)) else []
    receivers = dict.fromkeys(match[1] for name in found if (match := _COMPONENT.fullmatch(name)))
    columns = ["time_s", *(f"{receiver}{axis}_m" for receiver in receivers for axis in ("east", "north"))]
    missing = [name for name in columns if name not in found] or (["east_m"] if len(columns) == 1 else [])
    if missing:
        raise ScenarioError(
            f"{path}: no column {missing[0]}; time_s, east_m and north_m are needed, or of several receivers "
            "NAME_east_m and NAME_north_m each"
        )
    for name in columns:
        if found.count(name) > 1:
            raise ScenarioError(f"{path}: column {name} is there twice")
    return columns


def _number(path: Path, line: int, name: str, text: str | None) -> float:
    number = number_of(text)
    if not math.isfinite(number):
        raise ScenarioError(f"{path}: line {line}: {name} = {shown(text)}: a finite number is needed")
    return number


def noise_m(scenario: Scenario, periods: int, count: int) -> Array:
    """Draw the receivers' white noise (K, N, 2) in metres."""
    seed = scenario.run.seed
    normal = [stream(seed, "gnss", vehicle).standard_normal((periods, 2)) for vehicle in range(count)]
    return scenario.world.gnss.sigma_m * np.stack(normal, axis=1)


def further_error_m(
    scenario: Scenario, position_m: Array, middle_m: Array, receiver_m: Array | None
) -> Array | None:
    """Return what fixes have beyond truth, common error and noise (K, N, 2), in metres; None if there is nothing.

    That is multipath, outliers, the gradient of the common error at `position_m` (K, N, 2) around `middle_m` (2,),
    and what the receivers of a file have beyond their mean, `receiver_m` (K, R, 2).
    """
    gnss, common = scenario.world.gnss, scenario.world.common_error
    periods, count = position_m.shape[:2]
    parts: list[Array] = []
    if gnss.multipath_sigma_m:
        parts.append(_multipath_m(scenario, periods, count))
    if gnss.outlier_probability and gnss.outlier_m:
        parts.append(_outliers_m(scenario, periods, count))
    if common.gradient_m_per_km:
        law = common.gradient_m_per_km, common.tau_s
        gradient = gauss_markov(scenario, "common error gradient", law, (periods, 2, 2))
        parts.append(np.einsum("kij,knj->kni", gradient, (position_m - middle_m) / M_PER_KM))
    if receiver_m is not None:
        parts.append(receiver_m[:periods, np.arange(count) % receiver_m.shape[1]])
    return np.sum(parts, axis=0) if parts else None


def _multipath_m(scenario: Scenario, periods: int, count: int) -> Array:
    law = scenario.world.gnss.multipath_sigma_m, scenario.world.gnss.multipath_tau_s
    return np.stack([gauss_markov(scenario, "multipath", law, (periods, 2), n) for n in range(count)], axis=1)


def _outliers_m(scenario: Scenario, periods: int, count: int) -> Array:
    gnss = scenario.world.gnss
    draws = np.stack([stream(scenario.run.seed, "outlier", n).random((periods, 2)) for n in range(count)], axis=1)
    angle = 2 * math.pi * draws[..., 1]
    away_m = np.where(draws[..., 0] < gnss.outlier_probability, gnss.outlier_m, 0.0)
    return np.stack([away_m * np.cos(angle), away_m * np.sin(angle)], axis=-1)


class MotionSensors:
    """Headings and speeds as receivers tell them: the truth with noise that is drawn in advance.

    `rows` are the periods of the truth that is given: all at once, or one after the other as vehicles drive.
    """

    def __init__(self, scenario: Scenario, periods: int, count: int) -> None:
        self._gnss, seed = scenario.world.gnss, scenario.run.seed

        def normal(name: str, is_needed: bool) -> Array | None:
            if not is_needed:
                return None
            return np.stack([stream(seed, name, n).standard_normal(periods) for n in range(count)], axis=1)

        self._heading_normal = normal("heading", self._gnss.heading)
        self._speed_normal = normal("speed", self._gnss.speed_sigma_mps > 0)

    def heading_rad(self, heading_rad: Array, speed: Array, rows: slice = EVERY) -> Array:
        """Return the headings (k, N) of fixes in radians, [0, 2π); NaN for a fix without one."""
        gnss = self._gnss
        if self._heading_normal is None:
            return np.full(heading_rad.shape, np.nan)
        sigma_rad: Array | float = gnss.heading_sigma_rad
        if gnss.heading_speed_sigma_mps:
            by_speed = gnss.heading_speed_sigma_mps / np.maximum(speed, SLOWEST_MPS)
            sigma_rad = np.minimum(np.hypot(sigma_rad, by_speed), math.pi)
        heading = np.mod(heading_rad + sigma_rad * self._heading_normal[rows], 2 * np.pi)
        if gnss.heading_min_speed_mps:
            heading[speed < gnss.heading_min_speed_mps] = np.nan
        return np.asarray(heading)

    def speed_mps(self, speed: Array, rows: slice = EVERY) -> Array:
        """Return the speeds (k, N) of fixes in m/s, which are never negative; NaN for an absent vehicle."""
        if self._speed_normal is None:
            return speed
        return np.asarray(np.abs(speed + self._gnss.speed_sigma_mps * self._speed_normal[rows]))


def speed_mps(position_m: Array, period_ns: int, moves: bool) -> Array:
    """Return the vehicles' speeds (K, N) from positions (K, N, 2) in metres; NaN for an absent vehicle.

    They are means over the periods before and after. Vehicles that do not drive stand, however they sway.
    """
    absent = np.isnan(position_m[..., 0])
    if not moves:
        return np.where(absent, np.nan, 0.0)
    step_mps = np.linalg.norm(np.diff(position_m, axis=0), axis=2) / (period_ns / NS_PER_S)
    edge = np.full((1, position_m.shape[1]), np.nan)
    before, after = np.concatenate([edge, step_mps]), np.concatenate([step_mps, edge])
    known = np.isfinite(before).astype(int) + np.isfinite(after)
    total = np.nan_to_num(before) + np.nan_to_num(after)
    return np.where(absent, np.nan, total / np.maximum(known, 1))


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
        self.node_ids = tuple(sys.intern(str(node)) for node in motion.node_ids)  # as agents have them
        self.moves = scenario.network.moves
        self.period_ns = scenario.period_ns
        self.periods = periods_of(scenario)
        self.lane_map = lane_map
        self.lane_of = lane_of
        self.notes = motion.notes
        self.course_m, self._heading_rad = motion.position_m, motion.heading_rad
        buildings = load_buildings(scenario, frame, self.area_m)
        self.radio_inputs = RadioInputs(load_links(scenario.radio, self.node_ids), buildings, scenario.roadside)
        if buildings is not None and not len(buildings):
            self.notes = (*self.notes, f"radio.buildings: none is between vehicles; check {_place_of(scenario)}")
        elif buildings is not None and buildings.clipped:
            clipped = f"buildings left out, as the file lacks their nodes: {buildings.clipped}"
            self.notes = (*self.notes, f"radio.buildings: {clipped}")
        present = np.isfinite(motion.position_m[: self.periods - 1, :, 0])
        self._changes = np.flatnonzero((present[1:] != present[:-1]).any(axis=1)) + 1  # periods
        _check_exceptions(scenario, motion.node_ids)
        if not present.all():
            refuse_shared_processes(scenario, "where vehicles enter or leave")
        self._multipath = _stated_multipath(scenario.world.gnss)
        self._covariance_m2 = np.eye(2) * (scenario.world.gnss.sigma_m**2 + self._multipath[0] ** 2)
        self._covariance_m2.flags.writeable = False  # one for all fixes
        self._common_m, self.receiver_m = common_errors(scenario, self.periods)
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
        return np.asarray(np.isfinite(self.position_m(period)[:, 0]))

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
    """Return the number of instants of truth of a world: the start of each period, and the end of the last."""
    return math.ceil(scenario.world_ns / scenario.period_ns) + 1


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


class FaultyGnss:
    """The fixes of a run as programs get them: the world's, changed by faults."""

    def __init__(self, world: World, faults: Sequence[PlannedFault], seed: int) -> None:
        self._world = world
        self._faults = faults
        self._seed = seed

    def fix(self, period: int, number: int) -> Fix | None:
        """Return the fix of vehicle `number` at the start of `period`; None in an outage."""
        if not self._faults:
            return self._world.fix(period, number)
        time_ns = period * self._world.period_ns
        acting = [
            planned
            for planned in self._faults
            if planned.acts_at(time_ns)
            and isinstance(planned.fault, GnssFault)
            and planned.placed(time_ns).nodes[number]
        ]
        fix = self._world.fix(period, number)
        if not acting:
            return fix
        if any(isinstance(planned.fault, GnssOutage) for planned in acting):
            return None
        position_m = self._start(acting, fix, number)
        for planned in acting:
            position_m = self._moved(planned, position_m, time_ns, period, number)
        return replace(fix, position_m=position_m)

    def at(self, period: int) -> Instant:
        """Return the truth at the start of `period`, with the fixes that programs get (NaN in an outage)."""
        instant = self._world.at(period)
        if not any(isinstance(p.fault, GnssFault) and p.acts_at(instant.time_ns) for p in self._faults):
            return instant
        nothing = np.full(2, np.nan)
        present = instant.present.tolist()
        fixes = [self.fix(period, number) if is_present else None for number, is_present in enumerate(present)]
        return replace(instant, fix_m=np.array([nothing if fix is None else fix.position_m for fix in fixes]))

    def _start(self, acting: Sequence[PlannedFault], fix: Fix, number: int) -> Array:
        """Return the position before other faults: the fix's, or that of a frozen receiver.

        A frozen receiver repeats its last position before the earliest freeze, or its first one since.
        """
        frozen = [planned.start_ns for planned in acting if isinstance(planned.fault, GnssFreeze)]
        if not frozen:
            return fix.position_m
        last = max(0, math.ceil(min(frozen) / self._world.period_ns) - 1)
        while not self._world.present(last)[number]:
            last += 1
        return self._world.fix_m(last, number)

    def _moved(self, planned: PlannedFault, position_m: Array, time_ns: int, period: int, number: int) -> Array:
        fault = planned.fault
        assert isinstance(fault, GnssFault)
        if isinstance(fault, RandomPos):
            # Drawn for each vehicle and period, independent of other draws.
            draws = fault_stream(self._seed, planned.draws_of, f"position {number} {period}").random(2)
            angle, away_m = 2 * math.pi * draws[0], fault.radius_m * math.sqrt(draws[1])
            return np.asarray(position_m + away_m * np.array([math.cos(angle), math.sin(angle)]))
        displacement_m = fault.displacement_m(time_ns - planned.start_ns)
        return position_m if displacement_m is None else np.asarray(position_m + displacement_m)


def clock_of(faults: Sequence[PlannedFault], node: str, number: int, time_ns: int) -> ClockError:
    """Return the clock error of a vehicle at `time_ns`: skews add; drifts multiply, so the clock never stops."""
    acting = [planned for planned in faults if planned.acts_at(time_ns) and planned.nodes[number]]
    offset_ns = sum(p.fault.offset_ms * 1e6 for p in acting if isinstance(p.fault, Skew))
    drifts = [(p.start_ns, p.fault.rate_ppm / 1e6) for p in acting if isinstance(p.fault, Drift)]
    pace, since_ns = 1.0, 0
    for start_ns, rate in [*sorted(drifts), (time_ns, 0.0)]:
        offset_ns += (pace - 1) * (start_ns - since_ns)
        pace, since_ns = pace * (1 + rate), start_ns
    return ClockError(node, time_ns, round(offset_ns), pace - 1)
