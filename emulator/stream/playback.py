"""The messages of a run that is over, from its files alone: what those who watched it were told."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from emulator.records.busy import busy_windows, mean_busy, read_busy
from emulator.records.metrics import PeriodFigures
from emulator.records.recorded_run import RecordedRun
from emulator.records.run_folder import Event, check_is_run, read_events
from emulator.records.run_tables import StatesReader, TableFile, TraceReader
from emulator.scenario.scenario import Scenario, load_scenario
from emulator.stream.messages import event_message, period_message, scene_message
from emulator.world.world import World, build_world
from vnet.errors import VnetError
from vnet.types import Array

Message = tuple[str, dict[str, Any]]


def messages(folder: Path) -> Iterator[Message]:
    """(stream, message) of a run that is over: its scene, its periods in order, and its end.

    Raises VnetError if the folder is not a finished run's; while its tables are read, if they do not fit together.
    """
    check_is_run(folder)
    events = read_events(folder)
    scenario = load_scenario(folder / "scenario.toml")
    world = build_world(scenario)
    number = {node: number for number, node in enumerate(world.node_ids)}
    states = StatesReader(folder / "states.parquet", number, world.period_ns)
    trace = TraceReader(folder / "trace.parquet", number)
    figures = _figures(TableFile(folder / "metrics.parquet", [field.name for field in fields(PeriodFigures)]))
    busy = busy_windows(None if scenario.radio.mac is None else read_busy(folder), world.node_ids)
    return _Playback(scenario, world, events, figures, trace, states, busy).messages()


def _figures(file: TableFile) -> list[PeriodFigures]:
    figures = [PeriodFigures(**row) for piece in file.pieces() for row in piece.to_pylist()]
    if [row.period for row in figures] != list(range(len(figures))):
        raise file.error("its rows are not those of one period after the other")
    return figures


@dataclass(frozen=True)
class _Playback:
    """A run's files."""

    scenario: Scenario
    world: World
    events: Sequence[Event]
    figures: Sequence[PeriodFigures]
    trace: TraceReader
    states: StatesReader
    busy: Array

    def messages(self) -> Iterator[Message]:
        """See the function."""
        yield "scene", scene_message(self.world, self.scenario)
        events = _by_period(self.events, self.world.period_ns, len(self.figures))
        if self.figures:
            yield from self._periods(events)
        yield "end", {"events": list(map(event_message, events[-1]))}

    def _periods(self, events: Sequence[Sequence[Event]]) -> Iterator[Message]:
        # Who was up, and which faults there are, is told by the events and the positions.
        nothing = pa.table({})
        course_m = self.world.course_m if self.world.moves else None
        recorded = RecordedRun(self.scenario, nothing, self.states.first(), nothing, self.events, course_m)
        down = _Down(recorded)
        states = self.states.periods()
        for figures, happened in zip(self.figures, events, strict=False):
            if (state := next(states, None)) is None:
                raise self._misfit("fewer")
            start_ns, end_ns = figures.time_ns, figures.time_ns + self.world.period_ns
            faults = [planned.label for planned in recorded.plan if planned.acts_between(start_ns, end_ns)]
            up = ~down.at(end_ns - 1)
            rows = self.trace.until(end_ns)
            instant, beliefs = state
            busy = mean_busy(self.busy, len(self.world.node_ids), start_ns, end_ns)
            message = period_message(
                self.world.node_ids, instant, end_ns, beliefs, figures, rows, up, faults, happened, busy
            )
            yield "period", message
        if next(states, None) is not None:
            raise self._misfit("more")

    def _misfit(self, how: str) -> VnetError:
        return VnetError(f"{self.states.path}: is of {how} periods than the {len(self.figures)} of metrics.parquet")


class _Down:
    """Who was down when."""

    def __init__(self, recorded: RecordedRun) -> None:
        self._count = len(recorded.node_ids)
        self._node = np.array([span.node for span in recorded.down], dtype=np.intp)
        self._start_ns = np.array([span.start_ns for span in recorded.down], dtype=np.int64)
        self._end_ns = np.array([span.end_ns for span in recorded.down], dtype=np.int64)

    def at(self, time_ns: int) -> NDArray[np.bool_]:
        """Who was down at an instant (n,)."""
        down = np.zeros(self._count, dtype=bool)
        down[self._node[(self._start_ns <= time_ns) & (time_ns < self._end_ns)]] = True
        return down


def _by_period(events: Iterable[Event], period_ns: int, periods: int) -> list[list[Event]]:
    """The events of each period, and at the end those that came after the last."""
    told: list[list[Event]] = [[] for _ in range(periods + 1)]
    for event in events:
        told[min(event.time_ns // period_ns, periods)].append(event)
    return told
