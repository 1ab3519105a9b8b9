"""The course of a run: what its user wants to know while it is on, in plain figures with their units.

A `Course` listens to an emulation; its `Snapshot` is what the terminal, JSON lines and `vnet status` show.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from emulator.drivers.emulation import Emulation, PeriodView
from emulator.drivers.usage import resident_kb
from emulator.fault_plan import PlannedFault
from emulator.radio.outcomes import Outcome
from emulator.records.events import MEASURED, SAID, Event, merged
from emulator.records.period_figures import POSITION_FIGURES
from vnet.units import NS_PER_S

BINS = 120
"""Number of equal parts of the run in which figures over time are averaged."""
RATES_OVER_S = 1.0
"""Emulated time over which rates are averaged."""
SPEED_OVER_S = 10.0
"""Wall-clock time over which the speed is averaged."""
SPEED_EVERY_S = 0.1
EVENTS_KEPT = 8
EVENTS_LOOKED_AT = 200
"""Last events among which those of one kind of failure are told as one."""


@dataclass(frozen=True)
class FaultState:
    """A fault of the plan; `state` is "to come", "acting" or "ended", and `nodes` are those it concerns."""

    fault: str
    state: str
    start_s: float
    end_s: float
    nodes: tuple[str, ...]


@dataclass(frozen=True)
class Snapshot:
    """Status of a run.

    `phase` is "starting", "joining" (`missing` are the vehicles that are awaited, `join_timeout_s` how long),
    "running" or "judging"; `absent` are those that have not entered yet, or have left. Seconds are emulated ones,
    but for `remaining_s`, `idle_s` (since a period last ended), `wall_s` (since the command began) and
    `join_timeout_s`, which are of wall clock. `frames_by_outcome` counts attempted receptions so far,
    `frames_per_s` those of the last emulated second. Figures are those of the last period, and None where programs
    report nothing of the kind; `over_time` has their means in `BINS` equal parts of the run. `lines` are label and
    remark of those that a program wants to be shown, by figure.
    """

    run: str
    pacing: str
    seed: int
    node_ids: tuple[str, ...]
    phase: str
    missing: tuple[str, ...]
    down: tuple[str, ...]
    emulated_s: float
    duration_s: float
    join_timeout_s: float
    real_time_factor: float | None
    remaining_s: float | None
    idle_s: float
    wall_s: float
    figures: dict[str, float | None]
    over_time: dict[str, tuple[float | None, ...]]
    frames_by_outcome: dict[str, int]
    frames_per_s: dict[str, float]
    faults: tuple[FaultState, ...]
    events: tuple[Event, ...]
    emulator_memory_mb: float | None
    absent: tuple[str, ...] = ()
    lines: Mapping[str, tuple[str, str]] = field(default_factory=dict)

    def never_reported(self, figure: str) -> bool:
        """Return whether no program has reported anything of this kind yet."""
        return not any(value is not None for value in self.over_time[figure])


class Course:
    """Observed course of a run so far. `clock` gives the seconds of the wall clock."""

    def __init__(self, emulation: Emulation, clock: Callable[[], float] = time.monotonic) -> None:
        self._emulation = emulation
        self._clock = clock
        self._began_s = self._period_ended_s = clock()
        self._phase = "starting"
        self._missing: tuple[str, ...] = ()
        key = emulation.metrics.declared.key
        self._lines = {each.name: each.live for each in key if each.live is not None}
        self._figures: dict[str, float | None] = dict.fromkeys(
            [*self._lines, *(each.name for each in POSITION_FIGURES)]
        )
        self._periods = 0
        """Number of the periods whose figures are in `_over_time`."""
        self._over_time = {name: _Series(emulation.duration_ns) for name in self._figures}
        self._speed: deque[tuple[float, int]] = deque()  # wall clock in s, emulated ns
        self._counts: deque[tuple[int, dict[Outcome, int]]] = deque([(0, dict(emulation.engine.counts))])
        emulation.watch(self._period)

    def awaits(self, nodes: Sequence[str]) -> None:
        """These vehicles have not joined yet; when there are none any more the run starts."""
        self._missing = tuple(nodes)
        self._phase = "joining" if nodes else "running"

    def judging(self) -> None:
        """The run is over, and is being written down and judged."""
        self._phase = "judging"

    def _period(self, view: PeriodView) -> None:
        self._phase = "running"
        self._period_ended_s = now_s = self._clock()
        end_ns = self._emulation.emulated_ns
        if not self._speed or now_s - self._speed[-1][0] >= SPEED_EVERY_S:
            self._speed.append((now_s, end_ns))
        while len(self._speed) > 2 and self._speed[1][0] < now_s - SPEED_OVER_S:
            self._speed.popleft()
        self._counts.append((end_ns, dict(self._emulation.engine.counts)))
        while len(self._counts) > 2 and self._counts[1][0] <= end_ns - RATES_OVER_S * NS_PER_S:
            self._counts.popleft()

    def _take_figures(self) -> None:
        """Take the figures of the periods since the last call: many at once cost little more than one."""
        emulation = self._emulation
        rows = emulation.metrics.rows
        for row in rows[self._periods :]:
            self._figures = {name: getattr(row, name) for name in self._figures}
            end_ns = min((row.period + 1) * emulation.world.period_ns, emulation.duration_ns)
            for name, series in self._over_time.items():
                series.add(end_ns, self._figures[name])
        self._periods = len(rows)

    @property
    def wall_s(self) -> float:
        """Wall clock since the beginning."""
        return self._clock() - self._began_s

    def news(self, after: int = 0) -> list[Event]:
        """Events of the run, but for the first `after` events of the run."""
        return [event for event in self._emulation.folder.events[after:] if not event.has(MEASURED | SAID)]

    def snapshot(self, now_ns: int | None = None) -> Snapshot:
        """Status of the run at this emulated instant, or at the end of its last period."""
        self._take_figures()
        emulation = self._emulation
        run = emulation.scenario.run
        factor = self._real_time_factor()
        now_ns = emulation.emulated_ns if now_ns is None else min(now_ns, emulation.duration_ns)
        memory_kb = resident_kb()
        is_outside = emulation.presence.is_outside
        return Snapshot(
            run=run.name,
            pacing=run.pacing,
            seed=run.seed,
            node_ids=emulation.world.node_ids,
            phase=self._phase,
            missing=self._missing,
            down=tuple(node for node, up in emulation.up.items() if not up and not is_outside(node)),
            absent=tuple(filter(is_outside, emulation.world.node_ids)),
            emulated_s=now_ns / NS_PER_S,
            duration_s=emulation.duration_ns / NS_PER_S,
            join_timeout_s=run.join_timeout_s,
            real_time_factor=factor,
            remaining_s=None if not factor else (emulation.duration_ns - now_ns) / NS_PER_S / factor,
            idle_s=self._clock() - self._period_ended_s,
            wall_s=self.wall_s,
            figures=dict(self._figures),
            lines=self._lines,
            over_time={name: series.means() for name, series in self._over_time.items()},
            frames_by_outcome={outcome.name: count for outcome, count in emulation.engine.counts.items() if count},
            frames_per_s=self._rates(),
            faults=tuple(fault_state(planned, emulation, now_ns) for planned in emulation.faults.faults),
            events=tuple(merged(self.news(-EVENTS_LOOKED_AT))[-EVENTS_KEPT:]),
            emulator_memory_mb=None if memory_kb is None else memory_kb / 1024,
        )

    def _real_time_factor(self) -> float | None:
        """Emulated seconds a second, lately; None before there is anything to tell it from."""
        if not self._speed or self._speed[0][1] == self._emulation.emulated_ns:
            return None
        first_s, first_ns = self._speed[0]  # the first period of all is not in it: programs start in it
        return (self._emulation.emulated_ns - first_ns) / NS_PER_S / max(self._period_ended_s - first_s, 1e-9)

    def _rates(self) -> dict[str, float]:
        """Decided receptions an emulated second, by outcome."""
        (first_ns, before), (last_ns, after) = self._counts[0], self._counts[-1]
        changes = {outcome.name: after[outcome] - before[outcome] for outcome in Outcome if outcome.value}
        over_s = max(last_ns - first_ns, 1) / NS_PER_S
        return {name: change / over_s for name, change in changes.items() if change > 0}


def fault_state(planned: PlannedFault, emulation: Emulation, now_ns: int) -> FaultState:
    """A fault as its user sees it at an emulated instant."""
    over_ns = planned.end_ns if planned.end_ns > planned.start_ns else now_ns  # else it was healed before it began
    state = "acting" if planned.acts_at(now_ns) else ("ended" if over_ns <= now_ns else "to come")
    nodes = tuple(node for node, number in emulation.number.items() if planned.nodes[number])
    return FaultState(planned.label, state, planned.start_ns / NS_PER_S, planned.end_ns / NS_PER_S, nodes)


class _Series:
    """Means of a figure in equal parts of the run. A period that is longer than a part counts in all it touches."""

    def __init__(self, duration_ns: int) -> None:
        self._duration_ns = duration_ns
        self._sums: list[tuple[float, int]] = []

    def add(self, end_ns: int, value: float | None) -> None:
        """The value of the period that ends then."""
        parts = min((end_ns - 1) * BINS // self._duration_ns, BINS - 1) + 1
        first = min(len(self._sums), parts - 1)
        self._sums += [(0.0, 0)] * (parts - len(self._sums))
        if value is not None:
            self._sums[first:] = [(total + value, count + 1) for total, count in self._sums[first:]]

    def means(self) -> tuple[float | None, ...]:
        """The parts so far; None where there was no value."""
        return tuple(total / count if count else None for total, count in self._sums)
