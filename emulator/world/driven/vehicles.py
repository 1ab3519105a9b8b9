"""Driven vehicles from control instant to control instant: commands, lane changes, collisions."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from emulator.scenario.driven import Driven
from emulator.world.driven.dynamics import Limits, Longitudinal
from emulator.world.driven.road import Road
from vnet.driving import Action
from vnet.errors import ScenarioError
from vnet.types import Array, Mask
from vnet.units import NS_PER_S

COLLISION = "collision"
LIMITED = "drive_limited"
"""Events of driven vehicles."""


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


class DrivenVehicles:
    """The true state of driven vehicles. `now_ns` is the last control instant that they have come to.

    A command holds from the first control instant at or after it until the next one. Vehicles are on `road`, their
    centres at `along_m` and `left_m` (N,), with `speed` and `acceleration` (N,), all NaN once they have left.
    """

    def __init__(self, driven: Driven, node_ids: Sequence[str], step_ns: int) -> None:
        count = len(node_ids)
        self._driven, self._node_ids, self.step_ns = driven, node_ids, step_ns
        self.now_ns = 0
        self.road = Road(driven.length_m, driven.lanes, driven.lane_width_m, driven.road == "ring")
        self._limits = Limits(
            driven.lag_s, driven.max_acceleration_mps2, driven.max_braking_mps2, driven.max_speed_mps
        )
        self._motion = Longitudinal(self._limits, step_ns / NS_PER_S)
        self.lane = start_lanes(driven, count)
        along_m = start_positions_m(driven, self.lane)
        speed = np.array(_one_each("speed_mps", driven.speeds_mps(count), count))
        self._state = np.array([along_m, speed, np.zeros(count)])
        self.left_m: Array = self.lane * np.float64(driven.lane_width_m)
        self._from_left_m = self.left_m.copy()
        self._before_m = along_m
        """Positions (N,) at the last control instant: a collision puts nobody further back."""
        self._change_steps = max(1, round(driven.lane_change_s * NS_PER_S / step_ns))
        self._changing = np.full(count, self._change_steps)
        """Control intervals (N,) since the last lane change began."""
        self._command = np.zeros(count)
        self._is_limited, self.is_wreck = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
        self._pending: deque[tuple[int, int, Action]] = deque()
        self._collided: set[tuple[int, int]] = set()
        self.log = Log()
        if crashed := self._overlapping():
            raise ScenarioError(
                f"network.driven: {node_ids[crashed[0][0]]} and {node_ids[crashed[0][1]]} overlap at the start"
            )

    @property
    def along_m(self) -> Array:
        """Positions (N,) of the centres along the road, in m; on a ring they go on counting."""
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
        ahead = self.road.ahead(self.along_m, self.left_m, self._driven.vehicle_width_m, reach_m)
        way_m = self.road.distance_m(self.along_m, self.along_m[ahead])
        gap_m = np.where(ahead >= 0, way_m - length_m, np.nan)
        return gap_m, np.where(ahead >= 0, self.speed[ahead] - self.speed, np.nan)

    def take(self, time_ns: int, number: int, action: Action) -> list[Happening]:
        """Take what a program asks for at `time_ns`, not before `now_ns`; returns whether it is limited."""
        self._pending.append((time_ns, number, action))
        asked = action.acceleration_m_s2
        if asked is None:
            return []
        limited = self._limits.limited(asked)
        was_limited, self._is_limited[number] = bool(self._is_limited[number]), limited != asked
        if limited == asked or was_limited:
            return []
        details = {"acceleration_m_s2": asked, "limit_m_s2": limited}
        return [Happening(time_ns, LIMITED, number, details)]

    def advance(self) -> list[Happening]:
        """Let all drive to the next control instant; returns what happens."""
        happened, command = self._told()
        self._record(command)
        self._before_m = self._state[0]
        self._state = self._motion.advance(self._state, command)
        self.now_ns += self.step_ns
        self._move_sideways()
        for rear, front in self._overlapping():
            happened += self._collide(rear, front)
        return happened

    def finished_log(self) -> Log:
        """Return the log of a run that is over, up to the last control instant."""
        if self.log.time_ns[-1:] != [self.now_ns]:
            self._record(self._told()[1])
        return self.log

    def remove_arrived(self) -> bool:
        """Take those off a straight road that have passed its end; returns whether there are any."""
        if self.road.is_ring:
            return False
        arrived = self._state[0] > self.road.length_m
        self._state[:, arrived] = np.nan
        return bool(arrived.any())

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
            self._command[number] = self._limits.limited(action.acceleration_m_s2)
        if not action.lane or self.is_wreck[number]:
            return []
        lane = int(self.lane[number]) + action.lane
        if self._changing[number] < self._change_steps or not 0 <= lane < self.road.lanes:
            reason = "there is no lane" if self._changing[number] >= self._change_steps else "changing already"
            return [Happening(self.now_ns, LIMITED, number, {"lane": action.lane, "reason": reason})]
        self._from_left_m[number] = self.left_m[number]
        self.lane[number], self._changing[number] = lane, 0
        return []

    def _move_sideways(self) -> None:
        """Move those that change lanes, smoothly: the sideways jerk is least."""
        if (self._changing < self._change_steps).any():
            self._changing += ~self.is_wreck & (self._changing < self._change_steps)
            done = self._changing / self._change_steps
            share = done**3 * (10 - 15 * done + 6 * done**2)
            target_m = self.lane * self.road.lane_width_m
            moved_m = self._from_left_m + share * (target_m - self._from_left_m)
            self.left_m = np.asarray(np.where(self.is_wreck, self.left_m, moved_m), dtype=np.float64)

    def _sideways_mps(self) -> Array:
        """Return the speeds (N,) to the left."""
        done = self._changing / self._change_steps
        way_m = self.lane * self.road.lane_width_m - self._from_left_m
        lasts_s = self._change_steps * self.step_ns / NS_PER_S
        return np.where(self.is_wreck, 0.0, way_m * 30 * done**2 * (1 - done) ** 2 / lasts_s)

    def _overlapping(self) -> list[tuple[int, int]]:
        """Return the pairs, rear and front, that overlap, the foremost first."""
        length_m, width_m = self._driven.vehicle_length_m, self._driven.vehicle_width_m
        ahead = self.road.ahead(self.along_m, self.left_m, width_m, length_m)
        close = np.flatnonzero(ahead >= 0)
        way_m = self.road.distance_m(self.along_m[close], self.along_m[ahead[close]])
        rear = close[way_m < length_m]
        rear = rear[np.argsort(-self.along_m[rear], kind="stable")]
        return list(zip(rear.tolist(), ahead[rear].tolist(), strict=True))

    def _collide(self, rear: int, front: int) -> list[Happening]:
        """Let two that overlap go on at their mean speed, as equal masses do, from where they touched.

        From now on both brake. Only the first time of each pair is told.
        """
        closing = float(self.speed[rear] - self.speed[front])
        if closing > 0:
            way_m = float(self.road.distance_m(self.along_m[[rear]], self.along_m[[front]])[0])
            overlap_m = self._driven.vehicle_length_m - way_m
            self._state[0, rear] = max(self._state[0, rear] - overlap_m, self._before_m[rear])
            self._state[1, [rear, front]] = (self.speed[rear] + self.speed[front]) / 2
            self._state[2, [rear, front]] = 0.0
        pair = (min(rear, front), max(rear, front))
        if pair in self._collided:
            return []
        self._collided.add(pair)
        self.is_wreck = self.is_wreck | np.isin(np.arange(len(self.is_wreck)), pair)
        details = {"with": self._node_ids[front], "closing_m_s": closing}
        return [Happening(self.now_ns, COLLISION, rear, details)]

    def _record(self, command: Array) -> None:
        there = self.present
        left_m, command = np.where(there, self.left_m, np.nan), np.where(there, command, np.nan)
        self.log.time_ns.append(self.now_ns)
        self.log.rows.append(np.array([self._state[0], left_m, self._state[1], self._state[2], command]))


def start_lanes(driven: Driven, count: int) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Return the lane (N,) of each vehicle at the start. Raise ScenarioError unless each has one."""
    if driven.start_lanes is None:
        return np.arange(count) % driven.lanes
    return np.array(_one_each("start_lanes", driven.start_lanes, count), dtype=np.int64)


def start_positions_m(driven: Driven, lane: np.ndarray[Any, np.dtype[np.int64]]) -> Array:
    """Return the positions (N,) along the road at the start, in m. Raise ScenarioError if there is no room."""
    if driven.start_m is not None:
        return np.array(_one_each("start_m", driven.start_m, len(lane)))
    row = np.zeros(len(lane), dtype=np.int64)
    for each in range(driven.lanes):
        row[lane == each] = np.arange(int((lane == each).sum()))
    rows, step_m = int(row.max()) + 1, driven.gap_m + driven.vehicle_length_m
    if rows * step_m > driven.length_m:
        raise ScenarioError(
            f"network.driven: {rows} vehicles a lane with gap_m = {driven.gap_m:g} take {rows * step_m:g} m: the "
            f"road has length_m = {driven.length_m:g}"
        )
    return np.asarray((rows - 1 - row) * step_m + driven.vehicle_length_m / 2)


def _one_each(name: str, values: Sequence[Any], count: int) -> Sequence[Any]:
    if len(values) != count:
        raise ScenarioError(f"network.driven.{name}: {len(values)} values for {count} vehicles: give one each")
    return values
