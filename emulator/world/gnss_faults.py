"""Effects of faults on GNSS receivers and clocks: functions of the fault plan and the time alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from emulator.fault_plan import PlannedFault, stream
from emulator.scenario.faults import Drift, GnssFault, GnssFreeze, GnssOutage, RandomPos, Skew
from emulator.world.world import Instant, World
from vnet.node import Fix
from vnet.transport.wire import ClockError
from vnet.types import Array


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
            draws = stream(self._seed, planned.number, f"position {number} {period}").random(2)
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
