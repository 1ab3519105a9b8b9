"""Vehicles with programs in a SUMO that is stepped with the run, from control instant to control instant."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from emulator.scenario.network import node_id
from emulator.world.driven.sumo_client import SumoProcess
from emulator.world.driven.sumo_messages import COLUMNS, Order, State, Step, Watch
from emulator.world.driven.vehicles import COLLISION, LIMITED, Happening, Log
from vnet.driving import Action
from vnet.types import Array
from vnet.units import NS_PER_S


class SumoVehicles:
    """Vehicles in SUMO, of which programs drive those that they have asked something of.

    `sumo_ids` are the vehicles' ids in SUMO, `range_m` that of their ranging, if they have any. A command holds
    from the first control instant at or after it until the next one, or until it is given back. `lights` is the
    state of each traffic light at `now_ns`, if these are `with_lights`; `in_all` counts SUMO's vehicles, `others`
    are the ids of those without a program, and `other_m` (k, 2) their positions.
    """

    def __init__(
        self, process: SumoProcess, sumo_ids: Sequence[str], step_ns: int, range_m: float | None, with_lights: bool
    ) -> None:
        count = len(sumo_ids)
        self._process, self.step_ns, self.now_ns = process, step_ns, 0
        self._number = {name: number for number, name in enumerate(sumo_ids)}
        self._properties = np.full((4, count), np.nan)
        """Length (m), largest acceleration and deceleration (m/s²) and largest speed (m/s) of each."""
        self._command = np.full(count, np.nan)
        """Acceleration (N,) that each has been told, in m/s²; NaN where SUMO drives."""
        self._is_limited = np.zeros(count, dtype=bool)
        self._pending: deque[tuple[int, int, Action]] = deque()
        self._collided: set[frozenset[str]] = set()
        self._log = Log()
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

    def advance(self) -> list[Happening]:
        """Have SUMO make a step, to the next control instant; returns what happens."""
        orders = self._orders()
        self._record()
        state = self._process.ask(Step(orders), State)
        refused = [self._no_lane(orders, number) for number in state.refused]
        self.now_ns += self.step_ns
        self._take_state(state)
        return refused + self._collisions(state)

    def remove_arrived(self) -> bool:
        """Do nothing: SUMO removes vehicles that have arrived."""
        return False

    def finished_log(self) -> Log:
        """Return the log of a run that is over, up to the last control instant."""
        if self._log.time_ns[-1:] != [self.now_ns]:
            self._record()
        return self._log

    # What programs have asked for.

    def _orders(self) -> list[Order]:
        """Return what SUMO is to do in the next step: changes, and the next speed of each that is driven."""
        orders = []
        while self._pending and self._pending[0][0] <= self.now_ns:
            _, number, action = self._pending.popleft()
            if np.isnan(self.speed[number]):
                continue
            if action.acceleration_m_s2 is not None:
                self._command[number] = self._limited(number, action.acceleration_m_s2)
            elif action.release and not np.isnan(self._command[number]):
                self._command[number] = np.nan
                orders.append(Order(number, release=True))
            if action.lane:
                orders.append(Order(number, lane=action.lane))
        target = self.speed + self._command * (self.step_ns / NS_PER_S)
        target = np.clip(target, 0.0, self._properties[3])
        driven = np.flatnonzero(np.isfinite(target)).tolist()
        return orders + [Order(number, speed=target[number].item()) for number in driven]

    def _limited(self, number: int, asked: float) -> float:
        """Return the acceleration nearest to what is asked for; an absent vehicle's limits are not known."""
        _, acceleration, braking, _ = self._properties[:, number].tolist()
        return asked if np.isnan(acceleration) else min(max(asked, -braking), acceleration)

    def _no_lane(self, orders: Sequence[Order], number: int) -> Happening:
        asked = next(order.lane for order in orders if order.number == number and order.lane)
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
        self._log.time_ns.append(self.now_ns)
        self._log.rows.append(np.array([along_m, left_m, speed, acceleration, self._command]))
