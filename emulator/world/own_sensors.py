"""Sensors of the user's own: what functions make of the truth, once a period, for vehicles to read.

Functions are called period after period, whoever reads first, so that a run is the same in any division into
processes. One that raises, answers nonsense or does not answer is told once, and then gives no readings.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Set
from copy import deepcopy
from dataclasses import dataclass, field, replace
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emulator.scenario import own_functions
from emulator.scenario.own_functions import NonsenseError, load_function
from emulator.scenario.program import Program
from emulator.scenario.random_streams import frame_stream
from emulator.scenario.scenario import OwnSensor
from vnet.errors import shown
from vnet.runtime.programs import search_programs_in
from vnet.types import Array, Mask
from vnet.units import NS_PER_S

MOST_NUMBERS = 64
"""Numbers of one reading."""
USAGE = "of the truth and a state: def {}(truth, state)"
Reading = float | tuple[float, ...]


@dataclass(frozen=True)
class SensedTruth:
    """The truth at the start of a period, as the model of a sensor sees it.

    time_ns: emulated time. node_ids: the n vehicles that are present. position_m: (n, 2) in m east-north.
    heading_rad: (n,), counter-clockwise from east. speed_m_s: (n,). options: those of the scenario. rng: a random
    generator of this sensor and period, from which nothing else draws. Arrays are copies.
    """

    time_ns: int
    node_ids: tuple[str, ...]
    position_m: Array
    heading_rad: Array
    speed_m_s: Array
    options: Mapping[str, Any] = field(default_factory=dict)
    rng: np.random.Generator = field(default_factory=np.random.default_rng)

    @property
    def time_s(self) -> float:
        """Emulated time in seconds."""
        return self.time_ns / NS_PER_S


@dataclass(frozen=True)
class SensorFailure:
    """The failure of a sensor: its name, model, when, what is wrong, and the traceback."""

    sensor: str
    model: str
    time_ns: int
    error: str
    where: str = ""


@dataclass(frozen=True, eq=False)
class _Kept:
    """The k readings of a sensor in a period: as arrays, since runs keep those of all periods.

    `vehicle` (k,): numbers, sorted. `end` (k,): end of each reading in `numbers`; it begins where the one before
    ends. `is_single` (k,): a number by itself.
    """

    vehicle: NDArray[np.int32]
    end: NDArray[np.int32]
    is_single: Mask
    numbers: Array

    @classmethod
    def of(cls, readings: Mapping[int, Reading]) -> _Kept:
        """Keep readings by the vehicles' numbers."""
        vehicle = sorted(readings)
        single = [isinstance(readings[number], float) for number in vehicle]
        several = [reading if isinstance(reading := readings[number], tuple) else (reading,) for number in vehicle]
        end = np.cumsum([len(each) for each in several], dtype=np.int32)
        numbers = np.array([number for each in several for number in each], dtype=float)
        return cls(np.array(vehicle, dtype=np.int32), end, np.array(single, dtype=bool), numbers)

    def of_vehicle(self, number: int) -> Reading | None:
        """Return the reading of a vehicle; None if it has none."""
        index = int(np.searchsorted(self.vehicle, number))
        if index == len(self.vehicle) or self.vehicle[index] != number:
            return None
        start = self.end[index - 1] if index else 0
        several = tuple(self.numbers[start : self.end[index]].tolist())
        return several[0] if self.is_single[index] else several


class OwnSensors:
    """The sensors of one run, their states and readings. `on_failure` is told of each that fails."""

    def __init__(self, seed: int, sensors: Mapping[str, OwnSensor], program: Program) -> None:
        """Import the models. Raises ScenarioError for one that cannot be imported."""
        if sensors:
            search_programs_in(program.folders)
        self.on_failure: Callable[[SensorFailure], None] = lambda failure: None
        self._seed = seed
        self._sensors = dict(sensors)
        self._functions = {
            name: load_function(f"world.sensor.{name}.model", sensor.model, program, USAGE)
            for name, sensor in sensors.items()
        }
        self._states: dict[str, dict[str, Any]] = {name: {} for name in sensors}
        self._failed: set[str] = set()
        self._number: dict[str, int] = {}
        self._readings: list[dict[str, _Kept]] = []

    def __bool__(self) -> bool:
        return bool(self._sensors)

    def readings(self, period: int, node: str, truth: Callable[[int], SensedTruth]) -> dict[str, Reading]:
        """Return what a vehicle reads in a period, by sensor; `truth` has that of a period, without options."""
        while len(self._readings) <= period:
            self._readings.append(self._sense(truth(len(self._readings)), len(self._readings)))
        number = self._number.get(node, -1)
        found = {name: kept.of_vehicle(number) for name, kept in self._readings[period].items()}
        return {name: reading for name, reading in found.items() if reading is not None}

    def _sense(self, truth: SensedTruth, period: int) -> dict[str, _Kept]:
        """Return the readings of a period, by sensor."""
        for node in truth.node_ids:
            self._number.setdefault(node, len(self._number))
        names = [name for name in self._sensors if name not in self._failed]
        asked = {name: self._ask(name, truth, period) for name in names}
        return {
            name: _Kept.of({self._number[node]: reading for node, reading in read.items()})
            for name, read in asked.items()
            if read
        }

    def _ask(self, name: str, truth: SensedTruth, period: int) -> dict[str, Reading]:
        sensor = self._sensors[name]
        seen = replace(
            truth,
            position_m=truth.position_m.copy(),
            heading_rad=truth.heading_rad.copy(),
            speed_m_s=truth.speed_m_s.copy(),
            options=deepcopy(sensor.options),
            rng=frame_stream(self._seed, f"sensor {name}", 0, period),
        )
        try:
            answer = own_functions.call_bounded(self._functions[name], seen, self._states[name])
            return _understood(answer, frozenset(truth.node_ids))
        except (Exception, SystemExit, own_functions.NoAnswerError) as error:
            self._failed.add(name)
            self.on_failure(SensorFailure(name, sensor.model, truth.time_ns, *own_functions.told(error, __file__)))
            return {}


def _understood(answer: Any, node_ids: Set[str]) -> dict[str, Reading]:
    """Return readings as plain numbers. Raises NonsenseError."""
    if not isinstance(answer, Mapping):
        raise NonsenseError(f"{shown(answer)}: a dict from vehicles to readings is needed")
    if unknown := [node for node in answer if node not in node_ids]:
        raise NonsenseError(f"{shown(unknown[0])}: no vehicle that is present")
    return {node: _reading(node, value) for node, value in answer.items() if value is not None}


def _reading(node: str, value: Any) -> Reading:
    try:
        numbers = np.asarray(value, dtype=float) if _are_numbers(value) else np.full(1, math.nan)
    except (TypeError, ValueError, OverflowError):
        numbers = np.full(1, math.nan)
    if numbers.ndim > 1 or numbers.size > MOST_NUMBERS or not np.isfinite(numbers).all():
        needed = f"a finite number, or at most {MOST_NUMBERS} of them, is needed"
        raise NonsenseError(f"{shown(value)} for {node}: {needed}")
    return numbers.item() if numbers.ndim == 0 else tuple(numbers.tolist())


def _are_numbers(value: Any) -> bool:
    """Return whether a value is a number or several: no text that numpy could read, and no truth value."""
    array = value if isinstance(value, np.ndarray) else np.asarray(value, dtype=object)
    if array.dtype != object:
        return array.dtype.kind in "iuf"
    return all(isinstance(each, Real) and not isinstance(each, (bool, np.bool_)) for each in array.flat)
