"""Vehicles that are driven: their dynamics, and the collisions of their rectangles.

Position x, speed v and acceleration a follow x' = v, v' = a, a' = (u - a) / lag, where the command u is held
between two control instants. So motion does not depend on how time is divided, and no step size has to be chosen.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from emulator.scenario.network import Driven
from emulator.world.driven.road import Start, one_each
from vnet.errors import ScenarioError
from vnet.node import Action
from vnet.types import Array, Mask
from vnet.units import NS_PER_S

_BISECTIONS = 80
"""Most halvings of the search for an instant; doubles are exhausted before."""
COLLISION = "collision"
LANE_ENDED = "lane_ended"
LIMITED = "drive_limited"
"""Events of driven vehicles."""


def rectangles_overlap(
    offset_m: Array, heading_rad: Array, other_rad: Array, length_m: float, width_m: float
) -> Mask:
    """Return the mask (n,) of the pairs of rectangles that overlap, by the separating axis theorem.

    `offset_m` (n, 2) leads from the centre of the one to that of the other; their longer sides, `length_m`, have
    the headings `heading_rad` and `other_rad` (n,). Rectangles that only touch do not overlap.
    """
    turn = other_rad - heading_rad
    lengthwise, across = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    # Half the extent of both along the longer and the shorter side of one of them.
    long_m = (length_m * (1 + lengthwise) + width_m * across) / 2
    wide_m = (width_m * (1 + lengthwise) + length_m * across) / 2
    overlap = np.ones(len(offset_m), dtype=bool)
    for each_rad in (heading_rad, other_rad):
        east, north = np.cos(each_rad), np.sin(each_rad)
        overlap &= np.abs(offset_m[:, 0] * east + offset_m[:, 1] * north) < long_m
        overlap &= np.abs(offset_m[:, 1] * east - offset_m[:, 0] * north) < wide_m
    return overlap


@dataclass(frozen=True)
class Limits:
    """Actuator lag in s, and largest acceleration, deceleration (m/s²) and speed (m/s) of a vehicle."""

    lag_s: float
    acceleration: float
    braking: float
    speed: float


class Longitudinal:
    """Motion of vehicles over one control interval of `step_s`. Commands are within the limits."""

    def __init__(self, limits: Limits, step_s: float) -> None:
        self._limits = limits
        self._step_s = step_s
        lag_s = limits.lag_s
        self._decay = _decay(step_s, lag_s)
        self._speed_s = lag_s * (1 - self._decay)
        self._position_s2 = lag_s * (step_s - self._speed_s)

    def advance(self, state: Array, command: Array) -> Array:
        """Return the state (3, N), position (m), speed (m/s) and acceleration (m/s²), one interval later.

        `command` (N,) is in m/s². Speeds stay within 0 and the largest: a vehicle that has come to a limit stays
        there, without acceleration, for as long as it is told to go beyond.
        """
        position, speed, acceleration = state
        step_s, top = self._step_s, self._limits.speed
        command = np.where((speed <= 0) & (acceleration <= 0), np.maximum(command, 0.0), command)
        command = np.where((speed >= top) & (acceleration >= 0), np.minimum(command, 0.0), command)
        at_limit = ((speed <= 0) & (acceleration < 0)) | ((speed >= top) & (acceleration > 0))
        acceleration = np.where(at_limit, 0.0, acceleration)
        excess = acceleration - command
        later = np.empty_like(state)
        later[0] = position + speed * step_s + command * (step_s * step_s / 2) + excess * self._position_s2
        later[1] = speed + command * step_s + excess * self._speed_s
        later[2] = command + excess * self._decay
        swing = np.where(acceleration * command < 0, np.abs(acceleration) * step_s, 0.0)
        low, high = np.minimum(later[1], speed - swing), np.maximum(later[1], speed + swing)
        for number in np.flatnonzero((low < 0) | (high > top)).tolist():
            start = position[number].item(), speed[number].item(), acceleration[number].item()
            later[:, number] = advance_limited(self._limits, start, command[number].item(), step_s)
        return later


def advance_limited(
    limits: Limits, state: tuple[float, float, float], command: float, step_s: float
) -> tuple[float, float, float]:
    """Return position (m), speed (m/s) and acceleration (m/s²) of one vehicle after `step_s`, however long.

    The interval is split at the instants at which the speed comes to 0 or to the largest.
    """
    (position, speed, acceleration), left_s = state, step_s
    if not limits.lag_s:
        acceleration = command
    while True:
        if speed <= 0 and acceleration <= 0:
            speed, acceleration = 0.0, 0.0
            if command <= 0:
                return position, speed, acceleration
        elif speed >= limits.speed and acceleration >= 0:
            speed, acceleration = limits.speed, 0.0
            if command >= 0:
                return position + speed * left_s, speed, acceleration
        state = position, speed, acceleration
        hit_s = _first_limit_s(limits, state, command, left_s)
        position, speed, acceleration = _free(limits.lag_s, state, command, min(hit_s, left_s))
        if hit_s >= left_s:
            return position, min(max(speed, 0.0), limits.speed), acceleration
        speed = 0.0 if speed < limits.speed / 2 else limits.speed
        left_s -= hit_s


def _free(
    lag_s: float, state: tuple[float, float, float], command: float, time_s: float
) -> tuple[float, float, float]:
    """Return the state after `time_s` without limits of the speed."""
    position, speed, acceleration = state
    excess, decay = acceleration - command, _decay(time_s, lag_s)
    lagging_s = lag_s * (1 - decay)
    position += speed * time_s + command * (time_s * time_s / 2) + excess * lag_s * (time_s - lagging_s)
    return position, speed + command * time_s + excess * lagging_s, command + excess * decay


def _first_limit_s(limits: Limits, state: tuple[float, float, float], command: float, within_s: float) -> float:
    """Return when the speed first comes to a limit from within; infinite if it does not in `within_s`."""
    _, _, acceleration = state
    ends_s = [within_s]
    if acceleration * command < 0 and limits.lag_s:  # the speed turns
        turn_s = limits.lag_s * math.log1p(-acceleration / command)
        ends_s = [min(turn_s, within_s), within_s]
    begin_s = 0.0
    for end_s in ends_s:
        speed = _free(limits.lag_s, state, command, end_s)[1]
        if speed < 0 or speed > limits.speed:
            return _bisected(limits, state, command, begin_s, end_s)
        begin_s = end_s
    return math.inf


def _bisected(
    limits: Limits, state: tuple[float, float, float], command: float, low_s: float, high_s: float
) -> float:
    """Return the instant between two at which the speed, which is within its limits at the first, leaves them."""
    for _ in range(_BISECTIONS):
        middle_s = (low_s + high_s) / 2
        if 0 <= _free(limits.lag_s, state, command, middle_s)[1] <= limits.speed:
            low_s = middle_s
        else:
            high_s = middle_s
    return high_s


def _decay(time_s: float, lag_s: float) -> float:
    return math.exp(-time_s / lag_s) if lag_s else 0.0


class Happening(NamedTuple):
    """Something that happened to a vehicle, for the events of the run."""

    time_ns: int
    kind: str
    number: int
    details: dict[str, Any]


@dataclass
class Log:
    """State of all vehicles at each control instant, and what they were told then; the rows of a run's table."""

    time_ns: list[int] = field(default_factory=list)
    rows: list[Array] = field(default_factory=list)
    """Arrays (5, N): along_m, left_m, speed, acceleration, command; NaN for an absent vehicle."""


class SteppedVehicles(ABC):
    """N vehicles from control instant to control instant, `step_ns` apart. `now_ns` is the last they have come to.

    A command holds from the first control instant at or after it until the next one.
    """

    def __init__(self, count: int, step_ns: int) -> None:
        self.step_ns, self.now_ns = step_ns, 0
        self._is_limited = np.zeros(count, dtype=bool)
        self._pending: deque[tuple[int, int, Action]] = deque()
        self.log = Log()

    @property
    @abstractmethod
    def speed(self) -> Array:
        """Speeds (N,) in m/s; NaN for an absent vehicle."""

    @abstractmethod
    def place(self) -> tuple[Array, Array]:
        """Return positions (N, 2) in m and headings (N,) in [0, 2π); NaN for an absent vehicle."""

    @abstractmethod
    def gaps(self, range_m: float) -> tuple[Array, Array]:
        """Return the gaps (N,) to the vehicles ahead, in m, and their rates in m/s; NaN where none is in range."""

    def take(self, time_ns: int, number: int, action: Action) -> list[Happening]:
        """Take what a program asks for at `time_ns`, not before `now_ns`; returns whether it is limited."""
        self._pending.append((time_ns, number, action))
        asked = action.acceleration_m_s2
        if asked is None:
            return []
        limit = self._limited(number, asked)
        was_limited, self._is_limited[number] = bool(self._is_limited[number]), limit != asked
        if limit == asked or was_limited:
            return []
        details = {"acceleration_m_s2": asked, "limit_m_s2": limit}
        return [Happening(time_ns, LIMITED, number, details)]

    @abstractmethod
    def advance(self) -> list[Happening]:
        """Let all drive to the next control instant; returns what happens."""

    def remove_arrived(self) -> None:  # noqa: B027  # nothing, where SUMO does
        """Take those off the road that have passed the end of their way."""

    @abstractmethod
    def finished_log(self) -> Log:
        """Return the log of a run that is over, up to the last control instant."""

    @abstractmethod
    def _limited(self, number: int, asked: float) -> float:
        """Return the acceleration nearest to what is asked for."""


class DrivenVehicles(SteppedVehicles):
    """The true state of driven vehicles, which are at `start` at first.

    Vehicles are on `road`, their centres at `along_m` and `left_m` (N,), with `speed` and `acceleration` (N,), all
    NaN once they have left.
    """

    def __init__(self, driven: Driven, node_ids: Sequence[str], step_ns: int, start: Start) -> None:
        count = len(node_ids)
        super().__init__(count, step_ns)
        self._driven, self._node_ids = driven, node_ids
        self.road = start.road
        self._limits = Limits(
            driven.lag_s, driven.max_acceleration_mps2, driven.max_braking_mps2, driven.max_speed_mps
        )
        self._motion = Longitudinal(self._limits, step_ns / NS_PER_S)
        self.lane = start.lane.copy()
        speed = np.array(one_each("speed_mps", driven.speeds_mps(count), count))
        self._state = np.array([start.along_m, speed, np.zeros(count)])
        self._nominal_m: Array = self.lane * np.float64(driven.lane_width_m)
        """Distances (N,) from the rightmost lane, if all lanes had the width of the scenario."""
        self._from_nominal_m = self._nominal_m.copy()
        self.left_m = self.road.left_m(self.along_m, self._nominal_m)
        self._before_m = self.along_m
        """Positions (N,) at the last control instant: a collision puts nobody further back."""
        self._change_steps = max(1, round(driven.lane_change_s * NS_PER_S / step_ns))
        self._changing = np.full(count, self._change_steps)
        """Control intervals (N,) since the last lane change began."""
        self._command = np.zeros(count)
        self.is_wreck = np.zeros(count, dtype=bool)
        self._collided: set[tuple[int, int]] = set()
        if crashed := self._overlapping() + self._crossing():
            one, other = crashed[0]
            raise ScenarioError(f"network.driven: {node_ids[one]} and {node_ids[other]} overlap at the start")

    @property
    def along_m(self) -> Array:
        """Positions (N,) of the centres along their ways, in m; on a ring they go on counting."""
        return np.asarray(self._state[0])

    @property
    def speed(self) -> Array:
        """Speeds (N,) in m/s."""
        return np.asarray(self._state[1])

    @property
    def present(self) -> Mask:
        """Mask (N,) of the vehicles that have not left."""
        return np.asarray(np.isfinite(self._state[0]))

    def place(self) -> tuple[Array, Array]:
        """Return positions (N, 2) in m and headings (N,) in [0, 2π); NaN for an absent vehicle."""
        position_m, heading_rad = self.road.place(self.along_m, self.left_m)
        turn = np.arctan2(self._sideways_mps(), np.maximum(self.speed, 1.0))
        there = self.present
        position_m[~there] = np.nan
        return position_m, np.where(there, np.mod(heading_rad + turn, 2 * np.pi), np.nan)

    def gaps(self, range_m: float) -> tuple[Array, Array]:
        """Return the gaps (N,) to the vehicles ahead, in m, and their rates in m/s; NaN where none is in range."""
        length_m = self._driven.vehicle_length_m
        reach_m = range_m + length_m
        ahead, way_m = self.road.ahead(self.along_m, self.left_m, self._driven.vehicle_width_m, reach_m)
        return way_m - length_m, np.where(ahead >= 0, self.speed[ahead] - self.speed, np.nan)

    def take(self, time_ns: int, number: int, action: Action) -> list[Happening]:
        """Take what a program asks for at `time_ns`, not before `now_ns`; returns whether it is limited."""
        if action.release:  # nobody else drives: the vehicle keeps its speed
            action = Action(action.node, 0.0, action.lane)
        return super().take(time_ns, number, action)

    def advance(self) -> list[Happening]:
        """Let all drive to the next control instant; returns what happens."""
        happened, command = self._told()
        self._record(command)
        self._before_m = self._state[0]
        self._state = self._motion.advance(self._state, command)
        self.now_ns += self.step_ns
        self._move_sideways()
        happened += self._end_lanes()
        self.left_m = self.road.left_m(self.along_m, self._nominal_m)
        for rear, front in self._overlapping():
            happened += self._collide(rear, front)
        for one, other in self._crossing():
            happened += self._collide_crossing(one, other)
        return happened

    def finished_log(self) -> Log:
        """Return the log of a run that is over, up to the last control instant."""
        if self.log.time_ns[-1:] != [self.now_ns]:
            self._record(self._told()[1])
        return self.log

    def remove_arrived(self) -> None:
        """Take those off the road that have passed the end of their way."""
        self._state[:, self._state[0] > self.road.end_m] = np.nan

    def _limited(self, number: int, asked: float) -> float:
        return min(max(asked, -self._limits.braking), self._limits.acceleration)

    # What vehicles do in one interval.

    def _told(self) -> tuple[list[Happening], Array]:
        """Take what programs have asked for by now; returns what happens, and the commands (N,) that hold."""
        happened: list[Happening] = []
        while self._pending and self._pending[0][0] <= self.now_ns:
            _, number, action = self._pending.popleft()
            happened += self._obey(number, action)
        return happened, np.where(self.is_wreck, -self._limits.braking, self._command)

    def _obey(self, number: int, action: Action) -> list[Happening]:
        """Have a vehicle do from now on what its program has asked for."""
        if action.acceleration_m_s2 is not None:
            self._command[number] = self._limited(number, action.acceleration_m_s2)
        if not action.lane or self.is_wreck[number]:
            return []
        lane = int(self.lane[number]) + action.lane
        lanes = int(self.road.lane_count(self.along_m)[number])
        if self._changing[number] < self._change_steps or not 0 <= lane < lanes:
            reason = "there is no lane" if self._changing[number] >= self._change_steps else "changing already"
            return [Happening(self.now_ns, LIMITED, number, {"lane": action.lane, "reason": reason})]
        self._from_nominal_m[number] = self._nominal_m[number]
        self.lane[number], self._changing[number] = lane, 0
        return []

    def _move_sideways(self) -> None:
        """Move those that change lanes, smoothly: the sideways jerk is least."""
        if (self._changing < self._change_steps).any():
            self._changing += ~self.is_wreck & (self._changing < self._change_steps)
            done = self._changing / self._change_steps
            share = done**3 * (10 - 15 * done + 6 * done**2)
            target_m = self.lane * self._driven.lane_width_m
            moved_m = self._from_nominal_m + share * (target_m - self._from_nominal_m)
            self._nominal_m = np.asarray(np.where(self.is_wreck, self._nominal_m, moved_m), dtype=np.float64)

    def _end_lanes(self) -> list[Happening]:
        """Have those in a lane that has ended, or on the way to one, be in the leftmost lane that there is."""
        last = self.road.lane_count(self.along_m) - 1
        ended = np.flatnonzero(self.present & (self.lane > last))
        if not len(ended):
            return []
        self.lane[ended] = last[ended]
        last_m = last[ended] * self._driven.lane_width_m
        self._nominal_m[ended] = np.minimum(self._nominal_m[ended], last_m)
        self._from_nominal_m[ended] = np.minimum(self._from_nominal_m[ended], last_m)
        return [
            Happening(self.now_ns, LANE_ENDED, number, {"lane": int(last[number])}) for number in ended.tolist()
        ]

    def _sideways_mps(self) -> Array:
        """Return the speeds (N,) to the left."""
        done = self._changing / self._change_steps
        way_m = self.lane * self._driven.lane_width_m - self._from_nominal_m
        lasts_s = self._change_steps * self.step_ns / NS_PER_S
        return np.where(self.is_wreck, 0.0, way_m * 30 * done**2 * (1 - done) ** 2 / lasts_s)

    def _overlapping(self) -> list[tuple[int, int]]:
        """Return the pairs, rear and front, that overlap in a lane, the foremost first."""
        length_m, width_m = self._driven.vehicle_length_m, self._driven.vehicle_width_m
        ahead, way_m = self.road.ahead(self.along_m, self.left_m, width_m, length_m)
        rear = np.flatnonzero((ahead >= 0) & (way_m < length_m))
        rear = rear[np.argsort(-self.road.rank(self.along_m)[rear], kind="stable")]
        return list(zip(rear.tolist(), ahead[rear].tolist(), strict=True))

    def _crossing(self) -> list[tuple[int, int]]:
        """Return the new pairs that overlap in the plane, as at crossings; the first has the other ahead of it."""
        if not self.road.has_crossings:
            return []
        length_m, width_m = self._driven.vehicle_length_m, self._driven.vehicle_width_m
        position_m, heading_rad = self.place()
        one, other = self.road.crossing_pairs(self.along_m, position_m, float(np.hypot(length_m, width_m)))
        offset_m = position_m[other] - position_m[one]
        hit = np.flatnonzero(rectangles_overlap(offset_m, heading_rad[one], heading_rad[other], length_m, width_m))
        pairs = []
        for each in hit.tolist():
            pair = int(one[each]), int(other[each])
            if pair not in self._collided:
                ahead_m = [float(offset_m[each] @ _unit(heading_rad[number])) for number in pair]
                pairs.append(pair if ahead_m[0] >= -ahead_m[1] else pair[::-1])
        return pairs

    def _collide(self, rear: int, front: int) -> list[Happening]:
        """Let two that overlap go on at their mean speed, as equal masses do, from where they touched.

        From now on both brake. Only the first time of each pair is told.
        """
        closing = float(self.speed[rear] - self.speed[front])
        if closing > 0:
            overlap_m = self._driven.vehicle_length_m - self.road.distance_m(self.along_m, rear, front)
            self._state[0, rear] = max(self._state[0, rear] - overlap_m, self._before_m[rear])
            self._state[1, [rear, front]] = (self.speed[rear] + self.speed[front]) / 2
            self._state[2, [rear, front]] = 0.0
        return self._wreck(rear, front, closing)

    def _collide_crossing(self, one: int, other: int) -> list[Happening]:
        """Let two that meet at an angle go on in their lanes with the shares of their mean velocity along these."""
        _, heading_rad = self.place()
        pair = np.array([one, other])
        ahead = np.stack([_unit(heading_rad[number]) for number in pair])
        velocity = self.speed[pair, None] * ahead
        self._state[1, pair] = np.maximum(ahead @ velocity.mean(axis=0), 0.0)
        self._state[2, pair] = 0.0
        return self._wreck(one, other, float(np.hypot(*(velocity[0] - velocity[1]))))

    def _wreck(self, one: int, other: int, closing: float) -> list[Happening]:
        """Have two that collide brake from now on; returns what happens, the first time of each pair."""
        pair = (min(one, other), max(one, other))
        if pair in self._collided:
            return []
        self._collided.add(pair)
        self.is_wreck = self.is_wreck | np.isin(np.arange(len(self.is_wreck)), pair)
        return [Happening(self.now_ns, COLLISION, one, {"with": self._node_ids[other], "closing_m_s": closing})]

    def _record(self, command: Array) -> None:
        there = self.present
        left_m, command = np.where(there, self.left_m, np.nan), np.where(there, command, np.nan)
        self.log.time_ns.append(self.now_ns)
        self.log.rows.append(np.array([self._state[0], left_m, self._state[1], self._state[2], command]))


def _unit(heading_rad: float) -> Array:
    return np.array([np.cos(heading_rad), np.sin(heading_rad)])
