"""SUMO in a process of its own (`python -m emulator.world.driven.sumo_process`): it answers on its pipes.

libsumo is one simulation a process, ends the process on some errors, and has libraries of its own; so the emulator
never imports it. The process ends when its standard input does; with `--tied` also in the midst of a step.
"""

from __future__ import annotations

import gzip
import math
import os
import signal
import sys
from array import array
from pathlib import Path
from typing import Any, BinaryIO
from xml.etree import ElementTree

import msgspec

from vnet.runtime.die_with_parent import signal_at_parent_death

COLUMNS = ("x", "y", "angle", "speed", "acceleration", "distance", "lateral", "gap", "gap_rate")
"""Numbers of each vehicle in a state, in m, m/s, m/s² and degrees clockwise from north; NaN if it is absent."""
LENGTH_BYTES = 4
TIED = "--tied"
"""Option of the process: it is ended at once when the one that has started it ends."""
ALL_CHECKS = 31
"""SUMO's speed mode in which it keeps its own rules: safe gaps, limits, right of way, red lights."""
NO_CHECKS = 32
"""Speed mode in which the vehicle drives as it is told, whatever is in its way."""
ALL_LANE_CHANGES = 1621
"""SUMO's lane change mode in which it changes lanes whenever its driver would."""
ROUTE_LANE_CHANGES = 1537
"""Mode in which it changes lanes only where the route needs it, and when it is told to, without a collision."""
LANE_S = 5.0
"""Time for which SUMO tries to change to a lane, and stays there."""
_GZIP = b"\x1f\x8b"
"""The first bytes of what gzip has compressed (RFC 1952)."""
ABSENT = [math.nan] * len(COLUMNS)


class Begin(msgspec.Struct, tag=True):
    """Load a configuration with these options."""

    options: list[str]


class Begun(msgspec.Struct, tag=True):
    """SUMO has loaded it: its version, the corners of the network, and where junctions are, in m."""

    version: str
    boundary_m: tuple[tuple[float, float], tuple[float, float]]
    junctions_m: list[tuple[float, float]]


class StepTo(msgspec.Struct, tag=True):
    """Make all steps before this time of SUMO."""

    time_s: float


class Find(msgspec.Struct, tag=True):
    """Name the vehicles that SUMO inserts in the next `steps` steps; with 0 those that are there."""

    steps: int


class Found(msgspec.Struct, tag=True):
    """Ids of vehicles, in the order in which they have been inserted."""

    vehicles: list[str]


class Watch(msgspec.Struct, tag=True):
    """Tell of these vehicles from now on, of gaps up to `range_m`, and of traffic lights."""

    vehicles: list[str]
    range_m: float | None
    lights: bool


class Command(msgspec.Struct, array_like=True):
    """Command for the vehicle of this number: a speed in m/s, to drive by itself again, or lanes to its left."""

    number: int
    speed: float | None = None
    release: bool = False
    lane: int = 0


class StepRequest(msgspec.Struct, tag=True):
    """Make one step, with these commands."""

    commands: list[Command]


class Vehicle(msgspec.Struct, array_like=True):
    """Properties of the vehicle of this number, which has entered, in m, m/s² and m/s."""

    number: int
    length: float
    acceleration: float
    braking: float
    speed: float


class Collision(msgspec.Struct, array_like=True):
    """Two vehicles that overlap, by their ids in SUMO; the first ran into the other with `closing` m/s."""

    collider: str
    victim: str
    closing: float


class State(msgspec.Struct, tag=True):
    """State of the watched vehicles after a step: `values` are doubles, `COLUMNS` of each vehicle in turn.

    `refused` are numbers of vehicles that have no lane to change to, `vehicles` counts all that SUMO has, `others`
    are the ids of those that are not watched, and `other_m` their positions, x and y of each in turn.
    """

    values: bytes
    entered: list[Vehicle]
    collisions: list[Collision]
    lights: dict[str, str]
    refused: list[int]
    vehicles: int
    others: list[str]
    other_m: bytes


class Failure(msgspec.Struct, tag=True):
    """SUMO cannot do what it was asked for."""

    reason: str


Request = Begin | StepTo | Find | Watch | StepRequest
Answer = Begun | Found | State | Failure


def write(file: BinaryIO, message: Request | Answer) -> None:
    """Write a message to a pipe."""
    data = msgspec.msgpack.encode(message)
    left = memoryview(len(data).to_bytes(LENGTH_BYTES, "big") + data)
    while left:  # a signal may interrupt a write to a pipe without a buffer
        left = left[file.write(left) :]
    file.flush()


def read_request(file: BinaryIO) -> Request | None:
    """Return the next request; None at the end of the file."""
    length = file.read(LENGTH_BYTES)
    if len(length) < LENGTH_BYTES:
        return None
    decoded: Request = msgspec.msgpack.decode(file.read(int.from_bytes(length, "big")), type=Request)
    return decoded


def decode_answer(data: bytes) -> Answer:
    """Return an answer. Raise msgspec.DecodeError, or ValidationError, for what is none."""
    decoded: Answer = msgspec.msgpack.decode(data, type=Answer)
    return decoded


class Simulation:
    """The simulation of this process, through `sumo`, which is libsumo."""

    def __init__(self, sumo: Any) -> None:
        self._sumo = sumo
        self._vehicles: list[str] = []
        self._gap_m: float | None = None
        self._lights: list[str] = []
        self._there: set[str] = set()
        self._driven: set[str] = set()  # with the modes of a vehicle that is told its speed
        self._min_gap_m: dict[str, float] = {}
        self._is_on = False
        self._to_left = 1  # SUMO counts lanes, and places in them, from the side on which a network drives

    def answer(self, request: Request) -> Answer:
        """Do what is asked for."""
        match request:
            case Begin():
                return self._begin(request)
            case StepTo(time_s):
                if time_s > self._sumo.simulation.getTime():
                    self._sumo.simulationStep(time_s)
                return Found([])
            case Find(steps):
                return self._find(steps)
            case Watch():
                return self._watch(request)
            case StepRequest(commands):
                refused = [command.number for command in commands if not self._obey(command)]
                self._sumo.simulationStep()
                return self._state(refused)

    def close(self) -> None:
        """End the simulation, which writes what the configuration has it write."""
        if self._is_on:
            self._sumo.close()

    def _begin(self, request: Begin) -> Begun:
        sumo = self._sumo
        _, version = sumo.start(["sumo", *request.options])[:2]
        self._is_on = True
        self._to_left = -1 if _drives_on_left(sumo.simulation.getOption("net-file")) else 1
        junctions_m = [tuple(sumo.junction.getPosition(each)) for each in sumo.junction.getIDList()]
        low, high = sumo.simulation.getNetBoundary()
        return Begun(str(version), (tuple(low), tuple(high)), junctions_m)

    def _find(self, steps: int) -> Found:
        vehicle = self._sumo.vehicle
        if not steps:
            there = vehicle.getIDList()
            return Found(sorted(there, key=lambda each: (vehicle.getDeparture(each), each)))
        found: list[str] = []
        for _ in range(steps):
            self._sumo.simulationStep()
            found += self._sumo.simulation.getDepartedIDList()
        return Found(found)

    def _watch(self, request: Watch) -> State:
        self._vehicles, self._gap_m = request.vehicles, request.range_m
        self._lights = sorted(self._sumo.trafficlight.getIDList()) if request.lights else []
        return self._state([])

    def _obey(self, command: Command) -> bool:
        """Have a vehicle do what it is told; returns False if there is no lane to change to."""
        vehicle, name = self._sumo.vehicle, self._vehicles[command.number]
        if name not in self._there:
            return True
        if command.release:
            vehicle.setSpeed(name, -1)
            self._set_modes(name, ALL_CHECKS, ALL_LANE_CHANGES)
            self._driven.discard(name)
        elif command.speed is not None:
            if name not in self._driven:
                self._set_modes(name, NO_CHECKS, ROUTE_LANE_CHANGES)
                self._driven.add(name)
            vehicle.setSpeed(name, command.speed)
        if not command.lane:
            return True
        lane = vehicle.getLaneIndex(name) + self._to_left * command.lane
        if not 0 <= lane < self._sumo.edge.getLaneNumber(vehicle.getRoadID(name)):
            return False
        vehicle.changeLane(name, lane, LANE_S)
        return True

    def _set_modes(self, name: str, speed: int, lane: int) -> None:
        self._sumo.vehicle.setSpeedMode(name, speed)
        self._sumo.vehicle.setLaneChangeMode(name, lane)

    def _state(self, refused: list[int]) -> State:
        sumo, values, entered = self._sumo, array("d"), []
        there = set(sumo.vehicle.getIDList())
        for number, name in enumerate(self._vehicles):
            if name not in there:
                values.extend(ABSENT)
                continue
            if name not in self._there:
                entered.append(self._properties(number, name))
            values.extend(self._numbers(name))
        self._there = there.intersection(self._vehicles)
        self._driven &= self._there
        collisions = [
            Collision(each.collider, each.victim, each.colliderSpeed - each.victimSpeed)
            for each in sumo.simulation.getCollisions()
        ]
        lights = {name: sumo.trafficlight.getRedYellowGreenState(name) for name in self._lights}
        others = sorted(there.difference(self._vehicles))
        other_m = array("d", (each for name in others for each in sumo.vehicle.getPosition(name)))
        return State(values.tobytes(), entered, collisions, lights, refused, len(there), others, other_m.tobytes())

    def _properties(self, number: int, name: str) -> Vehicle:
        vehicle = self._sumo.vehicle
        self._min_gap_m[name] = vehicle.getMinGap(name)
        braking = max(vehicle.getDecel(name), vehicle.getEmergencyDecel(name))
        return Vehicle(number, vehicle.getLength(name), vehicle.getAccel(name), braking, vehicle.getMaxSpeed(name))

    def _numbers(self, name: str) -> list[float]:
        vehicle = self._sumo.vehicle
        speed = vehicle.getSpeed(name)
        gap_m, gap_rate = self._gap(name, speed)
        return [
            *vehicle.getPosition(name),
            vehicle.getAngle(name),
            speed,
            vehicle.getAcceleration(name),
            vehicle.getDistance(name),
            self._to_left * vehicle.getLateralLanePosition(name),
            gap_m,
            gap_rate,
        ]

    def _gap(self, name: str, speed: float) -> tuple[float, float]:
        """Return the clear distance to the vehicle ahead and its rate, or NaN if none is in range."""
        found = None if self._gap_m is None else self._sumo.vehicle.getLeader(name, self._gap_m)
        if found is None or not found[0] or self._gap_m is None:
            return math.nan, math.nan
        gap_m = found[1] + self._min_gap_m[name]  # SUMO counts from where the vehicle would like to be
        if gap_m > self._gap_m:
            return math.nan, math.nan
        return gap_m, self._sumo.vehicle.getSpeed(found[0]) - speed


def _drives_on_left(network: str) -> bool:
    """Tell whether vehicles of this network drive on the left, which its root element says."""
    with Path(network).open("rb") as file:
        is_compressed = file.read(len(_GZIP)) == _GZIP  # whatever its name
    with gzip.open(network) if is_compressed else Path(network).open("rb") as file:
        _, root = next(ElementTree.iterparse(file, events=("start",)))
    return root.get("lefthand") in ("true", "1")


def main() -> None:
    """Answer requests until there are no more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if TIED in sys.argv[1:]:
        signal_at_parent_death(signal.SIGKILL)
    with os.fdopen(os.dup(1), "wb") as answers:
        os.dup2(2, 1)  # SUMO prints
        os.environ.setdefault("LIBSUMO_AS_TRACI", "quiet")  # it warns of a pyarrow that nobody loads here
        import libsumo

        simulation = Simulation(libsumo)
        while (request := read_request(sys.stdin.buffer)) is not None:
            try:
                answer = simulation.answer(request)
            except Exception as error:  # of SUMO, whatever its class: the emulator says it in one line
                answer = Failure(str(error) or type(error).__name__)
            write(answers, answer)
        simulation.close()


if __name__ == "__main__":
    main()
