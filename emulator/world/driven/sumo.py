"""SUMO stepped with the run: its process, its start, its vehicles, and the world that they make."""

from __future__ import annotations

import contextlib
import os
import select
import subprocess
import sys
import tempfile
import threading
import time
import weakref
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import IO, TypeVar

import msgspec
import numpy as np

from emulator.scenario.network import Network, Sumo, control_step_ns, node_id, read_begin_s
from emulator.scenario.scenario import Scenario
from emulator.world.driven.stepped import Background, SteppedWorld
from emulator.world.driven.sumo_process import (
    COLUMNS,
    LENGTH_BYTES,
    TIED,
    Answer,
    Begin,
    Begun,
    Command,
    Failure,
    Find,
    Found,
    Request,
    State,
    StepRequest,
    StepTo,
    Watch,
    decode_answer,
    write,
)
from emulator.world.driven.vehicles import COLLISION, LIMITED, Happening, Log, SteppedVehicles
from emulator.world.projection import CoordinateFrame
from emulator.world.truth import refuse_shared_processes
from vnet.errors import ScenarioError, VnetError, first_names, printable, shown
from vnet.node import Fix
from vnet.roads.lanes import LaneMap
from vnet.roads.road_map import RoadMap
from vnet.types import Array
from vnet.units import NS_PER_S

CHILD = "emulator.world.driven.sumo_process"
CLOSE_S = 5.0
"""Wall-clock seconds for which SUMO may write its files at the end of a run."""
EXPLAIN_LINES = 3
"""Lines of SUMO's errors that are shown."""
LARGEST_ERRORS = 1 << 16
"""Bytes at the end of SUMO's output that are searched for them."""
A = TypeVar("A", bound=msgspec.Struct)
STEPS = 100
"""Steps that SUMO makes for one answer before the run, so that this comes well within the time for it."""
TRAFFIC_LIGHTS = "traffic_lights"
"""Name of the reading of a node that is told the traffic lights."""


class SumoProcess:
    """A process with one simulation of SUMO. It ends with this object, and with this process, however that ends.

    `path` is the configuration, which errors name. Answers take `timeout_s` of wall-clock time at most.
    """

    def __init__(self, path: Path, timeout_s: float) -> None:
        self._path, self.timeout_s = path, timeout_s
        # The kernel tells the end of the thread that has started a process, not that of its process.
        tied = [TIED] if threading.current_thread() is threading.main_thread() else []
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 (closed with the process)
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", CHILD, *tied],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            bufsize=0,
            start_new_session=True,  # Ctrl-C is for the emulator, which then ends it
        )
        self.has_failed = False
        self._end = weakref.finalize(self, _kill, self._process, self._errors, os.getpid())

    @property
    def pid(self) -> int:
        """Id of the process."""
        return self._process.pid

    def ask(self, request: Request, kind: type[A]) -> A:
        """Return the answer to a request, of this kind. Raise VnetError, in one line, if SUMO fails, and end it."""
        assert self._process.stdin is not None
        try:
            write(self._process.stdin, request)  # type: ignore[arg-type]
            answer = self._read()
        except TimeoutError:  # an OSError, too
            answer = Failure(f"no answer for {self.timeout_s:g} s")
        except (OSError, EOFError):
            answer = Failure(self._reason_of_end())
        except msgspec.MsgspecError as error:
            answer = Failure(f"an answer that is none: {error}")
        except BaseException:  # Ctrl-C in between: the next answer would be that to this request
            self.has_failed = True
            self._end()
            raise
        if isinstance(answer, Failure):
            raise self._failed(answer.reason)
        assert isinstance(answer, kind), (answer, kind)
        return answer

    def close(self) -> None:
        """End SUMO, which may write its files first."""
        if self._end.alive and self._process.stdin is not None:
            self._process.stdin.close()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(CLOSE_S)
            self._end()

    def kill(self) -> None:
        """End SUMO at once."""
        self._end()

    def _read(self) -> Answer:
        """Return the next answer. Raise EOFError if the process has ended, TimeoutError if it takes too long."""
        deadline_s = time.monotonic() + self.timeout_s
        length = int.from_bytes(self._bytes(LENGTH_BYTES, deadline_s), "big")
        return decode_answer(self._bytes(length, deadline_s))

    def _bytes(self, count: int, deadline_s: float) -> bytes:
        assert self._process.stdout is not None
        pipe, read = self._process.stdout.fileno(), bytearray()
        while len(read) < count:
            ready, _, _ = select.select([pipe], [], [], max(0.0, deadline_s - time.monotonic()))
            if not ready:
                raise TimeoutError
            part = os.read(pipe, count - len(read))
            if not part:
                raise EOFError
            read += part
        return bytes(read)

    def _failed(self, reason: str) -> VnetError:
        """Return the error of a simulation that goes no further, which ends with it."""
        self.has_failed = True
        said = self._said()
        self._end()
        return VnetError(f"{self._path}: SUMO: {' '.join(said) or printable(reason, 300)}")

    def _reason_of_end(self) -> str:
        with contextlib.suppress(subprocess.TimeoutExpired):
            status = self._process.wait(CLOSE_S)
            return f"it was ended by signal {-status}" if status < 0 else f"it ended with exit status {status}"
        return "its pipe is closed"

    def _said(self) -> list[str]:
        """Return the first errors that SUMO has printed."""
        size = self._errors.seek(0, os.SEEK_END)
        self._errors.seek(max(0, size - LARGEST_ERRORS))
        lines = self._errors.read().decode(errors="replace").splitlines()
        return [line.strip() for line in lines if line.startswith("Error")][:EXPLAIN_LINES]


def _kill(process: subprocess.Popen[bytes], errors: IO[bytes], owner: int) -> None:
    """End a process, at the latest when the one that started it ends; not when a fork of that does."""
    if os.getpid() == owner:
        process.kill()
        process.wait()
    for file in (process.stdin, process.stdout, errors):
        if file is not None:
            with contextlib.suppress(OSError):
                file.close()


def start_sumo(scenario: Scenario, path: Path, step_ns: int) -> tuple[SumoProcess, Begun, list[str]]:
    """Start SUMO and let it come to the run's beginning; returns also the vehicles that have a program.

    They are in the order in which SUMO inserts them by itself. Where not all are there from the beginning, SUMO
    goes on without programs until they are, and is then started again. Raise ScenarioError if none is inserted in
    the run's time, or one that is named is not.
    """
    process, begun = _begin(scenario, path, step_ns)
    search = _Search(scenario.network)
    if not search.take(process.ask(Find(0), Found).vehicles):
        left = (scenario.world_ns - 1) // step_ns
        while left > 0 and not search.take(process.ask(Find(min(left, STEPS)), Found).vehicles):
            left -= STEPS
        process.kill()
        process, begun = _begin(scenario, path, step_ns)
    search.check(path, scenario.world_ns / NS_PER_S)
    process.timeout_s = scenario.run.stall_timeout_s
    return process, begun, search.found


class _Search:
    """Vehicles that have a program, as they are found: those that are named, or the first."""

    def __init__(self, network: Network) -> None:
        self._named = None if network.sumo is None else network.sumo.nodes
        self._most = network.max_vehicles if self._named is None else len(set(self._named))
        self.found: list[str] = []
        self._inserted: list[str] = []

    def take(self, inserted: Sequence[str]) -> bool:
        """Take vehicles that SUMO has inserted; returns whether all are found."""
        self._inserted += inserted
        wanted = [each for each in inserted if self._named is None or each in self._named]
        self.found = [*dict.fromkeys([*self.found, *wanted])][: self._most]
        return len(self.found) == self._most

    def check(self, path: Path, duration_s: float) -> None:
        """Raise ScenarioError unless all that are named are found, at least one, and nodes can have their ids."""
        for name in self._named or ():
            if name not in self.found:
                raise ScenarioError(
                    f"network.sumo.nodes = {shown(name)}: SUMO inserts no such vehicle in the run's "
                    f"{duration_s:g} s ({path}), but {first_names(self._inserted) or 'none'}"
                )
        if not self.found:
            raise ScenarioError(f"{path}: SUMO inserts no vehicle in the run's {duration_s:g} s")
        by_id: dict[str, str] = {}
        for name in self.found:
            if (other := by_id.setdefault(node_id(name), name)) != name:
                raise ScenarioError(f"{path}: ids {shown(other)} and {shown(name)} are both {node_id(name)}")


def _begin(scenario: Scenario, path: Path, step_ns: int) -> tuple[SumoProcess, Begun]:
    """Start SUMO and have it make all steps up to that of the run's beginning, as it writes floating car data."""
    network, begin_s = scenario.network, read_begin_s(path)
    start_s = begin_s if network.start_s is None else network.start_s
    if start_s < begin_s:
        raise ScenarioError(f"network.start_s = {start_s:g}: SUMO begins at {begin_s:g} s ({path})")
    if round((start_s - begin_s) * NS_PER_S) % step_ns:
        raise ScenarioError(
            f"network.start_s = {start_s:g}: SUMO begins at {begin_s:g} s ({path}), and a whole number of steps of "
            f"{step_ns / NS_PER_S:g} s after that is needed"
        )
    process = SumoProcess(path, scenario.run.join_timeout_s)
    begun = process.ask(Begin(_options(path, network.seed, step_ns)), Begun)
    while begin_s < start_s:
        begin_s = min(start_s, begin_s + STEPS * step_ns / NS_PER_S)
        process.ask(StepTo(begin_s), Found)
    process.ask(StepRequest([]), State)
    return process, begun


def _options(path: Path, seed: int, step_ns: int) -> list[str]:
    """Return SUMO's options, which come before those of the configuration.

    One thread and the scenario's seed make a run reproducible. Vehicles that collide are told, and not removed.
    """
    options = {
        "configuration-file": path,
        "seed": seed,
        "random": "false",
        "step-length": f"{step_ns / NS_PER_S:g}",
        "threads": 1,
        "device.rerouting.threads": 1,
        "collision.action": "warn",
        "collision.check-junctions": "true",
        "collision.mingap-factor": 0,
        "no-step-log": "true",
        "no-warnings": "true",
        "duration-log.disable": "true",
    }
    return [part for name, value in options.items() for part in (f"--{name}", str(value))]


class SumoVehicles(SteppedVehicles):
    """Vehicles in SUMO, of which programs drive those that they have asked something of.

    `sumo_ids` are the vehicles' ids in SUMO, `range_m` that of their ranging, if they have any. A command also ends
    where it is given back. `lights` is the state of each traffic light at `now_ns`, if these are `with_lights`;
    `in_all` counts SUMO's vehicles, `others` are the ids of those without a program, and `other_m` (k, 2) their
    positions.
    """

    def __init__(
        self, process: SumoProcess, sumo_ids: Sequence[str], step_ns: int, range_m: float | None, with_lights: bool
    ) -> None:
        count = len(sumo_ids)
        super().__init__(count, step_ns)
        self._process = process
        self._number = {name: number for number, name in enumerate(sumo_ids)}
        self._properties = np.full((4, count), np.nan)
        """Length (m), largest acceleration and deceleration (m/s²) and largest speed (m/s) of each."""
        self._command = np.full(count, np.nan)
        """Acceleration (N,) that each has been told, in m/s²; NaN where SUMO drives."""
        self._collided: set[frozenset[str]] = set()
        self.lights: dict[str, str] = {}
        self._take_state(self._process.ask(Watch([*sumo_ids], range_m, with_lights), State))

    @property
    def speed(self) -> Array:
        """Speeds (N,) in m/s; NaN for an absent vehicle."""
        return np.asarray(self._values[COLUMNS.index("speed")])

    def place(self) -> tuple[Array, Array]:
        """Return positions (N, 2) in m and headings (N,) in [0, 2π); NaN for an absent vehicle.

        SUMO's positions are those of the middle of the front bumper, and its angles clockwise from north.
        """
        x_m, y_m, angle_deg = self._values[:3]
        heading_rad = np.mod(np.radians(90.0 - angle_deg), 2 * np.pi)
        front_m, half_m = np.column_stack([x_m, y_m]), self._properties[0] / 2
        ahead = np.column_stack([np.cos(heading_rad), np.sin(heading_rad)])
        return front_m - half_m[:, None] * ahead, heading_rad

    def gaps(self, range_m: float) -> tuple[Array, Array]:
        """Return the gaps (N,) to the vehicles ahead, in m, and their rates in m/s; NaN where none is in range."""
        gap_m, rate = self._values[COLUMNS.index("gap") :]
        return gap_m, rate

    def advance(self) -> list[Happening]:
        """Have SUMO make a step, to the next control instant; returns what happens."""
        commands = self._commands()
        self._record()
        state = self._process.ask(StepRequest(commands), State)
        refused = [self._no_lane(commands, number) for number in state.refused]
        self.now_ns += self.step_ns
        self._take_state(state)
        return refused + self._collisions(state)

    def finished_log(self) -> Log:
        """Return the log of a run that is over, up to the last control instant."""
        if self.log.time_ns[-1:] != [self.now_ns]:
            self._record()
        return self.log

    # What programs have asked for.

    def _commands(self) -> list[Command]:
        """Return what SUMO is to do in the next step: changes, and the next speed of each that is driven."""
        commands = []
        while self._pending and self._pending[0][0] <= self.now_ns:
            _, number, action = self._pending.popleft()
            if np.isnan(self.speed[number]):
                continue
            if action.acceleration_m_s2 is not None:
                self._command[number] = self._limited(number, action.acceleration_m_s2)
            elif action.release and not np.isnan(self._command[number]):
                self._command[number] = np.nan
                commands.append(Command(number, release=True))
            if action.lane:
                commands.append(Command(number, lane=action.lane))
        target = self.speed + self._command * (self.step_ns / NS_PER_S)
        target = np.clip(target, 0.0, self._properties[3])
        driven = np.flatnonzero(np.isfinite(target)).tolist()
        return commands + [Command(number, speed=target[number].item()) for number in driven]

    def _limited(self, number: int, asked: float) -> float:
        """Return the acceleration nearest to what is asked for; an absent vehicle's limits are not known."""
        _, acceleration, braking, _ = self._properties[:, number].tolist()
        return asked if np.isnan(acceleration) else min(max(asked, -braking), acceleration)

    def _no_lane(self, commands: Sequence[Command], number: int) -> Happening:
        asked = next(command.lane for command in commands if command.number == number and command.lane)
        return Happening(self.now_ns, LIMITED, number, {"lane": asked, "reason": "there is no lane"})

    # What SUMO answers.

    def _take_state(self, state: State) -> None:
        self._values = np.frombuffer(state.values).reshape(-1, len(COLUMNS)).T
        for vehicle in state.entered:
            limits = vehicle.length, vehicle.acceleration, vehicle.braking, vehicle.speed
            self._properties[:, vehicle.number] = limits
        self._command[np.isnan(self.speed)] = np.nan
        self.lights, self.in_all = state.lights, state.vehicles
        self.others, self.other_m = state.others, np.frombuffer(state.other_m).reshape(-1, 2)

    def _collisions(self, state: State) -> list[Happening]:
        """Return the collisions with vehicles that have a program, each pair of vehicles the first time."""
        happened = []
        for collider, victim, closing in ((each.collider, each.victim, each.closing) for each in state.collisions):
            pair = frozenset((collider, victim))
            if pair in self._collided or not pair & self._number.keys():
                continue
            self._collided.add(pair)
            own, other = (collider, victim) if collider in self._number else (victim, collider)
            details = {"with": node_id(other), "closing_m_s": closing}
            happened.append(Happening(self.now_ns, COLLISION, self._number[own], details))
        return happened

    def _record(self) -> None:
        speed, acceleration, along_m, left_m = self._values[3:7]
        self.log.time_ns.append(self.now_ns)
        self.log.rows.append(np.array([along_m, left_m, speed, acceleration, self._command]))


class SumoWorld(SteppedWorld):
    """A world whose `vehicles` drive in SUMO, the rest of whose traffic has no radio and no program."""

    vehicles: SumoVehicles
    background: Background

    def __init__(self, scenario: Scenario) -> None:
        path, sumo = scenario.network.path, scenario.network.sumo or Sumo()
        assert path is not None
        step_ns = control_step_ns(scenario.run.control_hz)
        self._process, begun, sumo_ids = start_sumo(scenario, path, step_ns)
        ranging = scenario.world.ranging
        range_m = None if ranging is None else ranging.range_m
        self.vehicles = SumoVehicles(self._process, sumo_ids, step_ns, range_m, bool(sumo.lights_to))
        self.versions = {"sumo": begun.version}
        self._corners_m = np.array(begun.boundary_m)
        self._lights_of: dict[int, dict[str, str]] = {}  # by period
        self.background = Background()
        lanes, frame, notes = _lanes(scenario, begun)
        super().__init__(scenario, tuple(map(node_id, sumo_ids)), lanes, notes, frame)
        self._see_lights = frozenset(sumo.lights_to)
        if unknown := [node for node in sumo.lights_to if node not in self.node_ids]:
            some = first_names(self.node_ids)
            raise ScenarioError(f"network.sumo.lights_to = {shown(unknown[0])}: no such node; there are {some}")
        refuse_shared_processes(scenario, "with network.step = true, where vehicles enter and leave")

    @property
    def has_traffic(self) -> bool:
        """True: vehicles enter and leave as SUMO says."""
        return True

    @property
    def vehicle_area_m(self) -> Array:
        """Corners (2, 2) of SUMO's network."""
        return self._corners_m

    def next_control_ns(self) -> int | None:
        """Return the next control instant within the run, or None; none comes once SUMO has failed."""
        return None if self._process.has_failed else super().next_control_ns()

    def traffic_lights(self, period: int) -> dict[str, str]:
        """Return the state of each traffic light at the start of `period`, a letter for each of its links."""
        return dict(self._lights_of[period])

    def fix(self, period: int, node: int) -> Fix:
        """Return the fix of node number `node`, which must be present, with the traffic lights if it sees them."""
        fix = super().fix(period, node)
        if self.node_ids[node] not in self._see_lights:
            return fix
        return replace(fix, sensors={**fix.sensors, TRAFFIC_LIGHTS: self.traffic_lights(period)})

    def close(self) -> None:
        """End SUMO; the run is over."""
        self._process.close()

    def detach(self) -> None:
        """Close the pipes of a forked process, without which SUMO would not see the emulator close its own."""
        self._process.kill()  # in a fork it closes no more than these

    def _fill(self, period: int) -> None:
        super()._fill(period)
        self._lights_of[period] = self.vehicles.lights
        self.background.add(self.vehicles.now_ns, self.vehicles.others, self.vehicles.other_m)


def _lanes(scenario: Scenario, begun: Begun) -> tuple[LaneMap | RoadMap, CoordinateFrame | None, tuple[str, ...]]:
    """Return the lanes that programs know, their frame, and notes about them: those of `[map]`, or none."""
    section = scenario.map
    if section is None:
        return LaneMap(np.zeros((0, 2)), np.zeros(0), scenario.world.lateral.half_width_m), None, ()
    # Maps need half of scipy, whose import takes longer than many a run.
    from emulator.world.maps.files import lanes_around, notes_of, read_roads

    roads = read_roads(section.path, section.origin_deg)
    junctions_m = np.array(begun.junctions_m or begun.boundary_m, dtype=float)[None]
    return lanes_around(roads, section, junctions_m), roads.frame, notes_of(section.path, roads)
