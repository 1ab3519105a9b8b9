"""Messages between the emulator and the process in which SUMO runs: msgpack, behind its length in four bytes."""

from __future__ import annotations

from typing import BinaryIO

import msgspec

COLUMNS = ("x", "y", "angle", "speed", "acceleration", "distance", "lateral", "gap", "gap_rate")
"""Numbers of each vehicle in a state, in m, m/s, m/s² and degrees clockwise from north; NaN if it is absent."""
LENGTH_BYTES = 4
TIED = "--tied"
"""Option of the process: it is ended at once when the one that has started it ends."""


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


class Order(msgspec.Struct, array_like=True):
    """Order for the vehicle of this number: a speed in m/s, to drive by itself again, or a change of lanes."""

    number: int
    speed: float | None = None
    release: bool = False
    lane: int = 0


class Step(msgspec.Struct, tag=True):
    """Make one step, with these orders."""

    orders: list[Order]


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


Request = Begin | StepTo | Find | Watch | Step
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
