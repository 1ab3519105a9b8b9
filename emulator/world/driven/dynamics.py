"""Longitudinal motion of vehicles under a constant command, in closed form.

Position x, speed v and acceleration a follow x' = v, v' = a, a' = (u - a) / lag, where the command u is held
between two control instants. So motion does not depend on how time is divided, and no step size has to be chosen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from vnet.types import Array

_BISECTIONS = 80
"""Most halvings of the search for an instant; doubles are exhausted before."""


@dataclass(frozen=True)
class Limits:
    """Actuator lag in s, and largest acceleration, deceleration (m/s²) and speed (m/s) of a vehicle."""

    lag_s: float
    acceleration: float
    braking: float
    speed: float

    def limited(self, command: float) -> float:
        """Return the acceleration nearest to what is asked for, in m/s²."""
        return min(max(command, -self.braking), self.acceleration)


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
