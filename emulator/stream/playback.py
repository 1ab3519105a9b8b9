"""The messages of a run that is over, from its files alone: what those who watched it were told."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from emulator.records.events import Event
from emulator.records.recorded_run import OpenedRun, RecordedRun
from emulator.records.run_folder import check_is_run
from emulator.records.run_tables import StatesReader, TraceReader
from emulator.records.tables import BACKGROUND, BUSY, STATES, busy_windows, mean_busy, positions_by_time
from emulator.stream.messages import event_message, period_message, scene_message
from vnet.errors import VnetError
from vnet.types import Array

POSITIONS = {STATES: ("period", "node", "position_m")}
Message = tuple[str, dict[str, Any]]


def messages(folder: Path) -> Iterator[Message]:
    """(stream, message) of a run that is over: its scene, its periods in order, and its end.

    Raises VnetError if the folder is not a finished run's; while its tables are read, if they do not fit together.
    """
    check_is_run(folder)
    run = RecordedRun.open(folder)
    number = {node: number for number, node in enumerate(run.world.node_ids)}
    trace, states = run.trace_reader(number), run.states_reader(number)
    busy = busy_windows(run.table(BUSY), run.world.node_ids)
    return _Playback(run, run.figures(), trace, states, busy).messages()


@dataclass(frozen=True)
class _Playback:
    """A run's files."""

    run: OpenedRun
    figures: Sequence[Any]
    trace: TraceReader
    states: StatesReader
    busy: Array

    def messages(self) -> Iterator[Message]:
        """See the function."""
        run = self.run
        yield "scene", scene_message(run.world, run.scenario, run.scenario_text)
        events = _by_period(run.events, run.scenario.period_ns, len(self.figures))
        if self.figures:
            yield from self._periods(events)
        yield "end", {"events": list(map(event_message, events[-1]))}

    def _periods(self, events: Sequence[Sequence[Event]]) -> Iterator[Message]:
        node_ids, period_ns = self.run.world.node_ids, self.run.scenario.period_ns
        told = self._events_and_positions()
        down = _Down(told)
        states, background = self.states.periods(), positions_by_time(self.run.table(BACKGROUND))
        for figures, happened in zip(self.figures, events, strict=False):
            if (state := next(states, None)) is None:
                raise self._misfit("fewer")
            start_ns, end_ns = figures.time_ns, figures.time_ns + period_ns
            faults = [planned.label for planned in told.plan if planned.acts_between(start_ns, end_ns)]
            up = ~down.at(end_ns - 1)
            rows = self.trace.until(end_ns)
            instant, beliefs = state
            busy = mean_busy(self.busy, len(node_ids), start_ns, end_ns)
            frames = rows, up, faults, happened, busy, background.get(start_ns, ())
            yield "period", period_message(node_ids, instant, end_ns, beliefs, figures, *frames)
        if next(states, None) is not None:
            raise self._misfit("more")

    def _events_and_positions(self) -> RecordedRun:
        """The run without its big tables: events and positions tell who was up, and which faults there were."""
        run, nothing = self.run, pa.table({})
        course_m = None
        if run.moves:
            course_m = RecordedRun.open(run.folder, POSITIONS).vectors("position_m")
        states = self.states.first()
        return RecordedRun(run.scenario, nothing, states, nothing, run.events, course_m, run.world)

    def _misfit(self, how: str) -> VnetError:
        return VnetError(f"{self.states.path}: is of {how} periods than the {len(self.figures)} of metrics.parquet")


class _Down:
    """Spans in which vehicles were down."""

    def __init__(self, recorded: RecordedRun) -> None:
        self._count = len(recorded.node_ids)
        self._node = np.array([span.node for span in recorded.down], dtype=np.intp)
        self._start_ns = np.array([span.start_ns for span in recorded.down], dtype=np.int64)
        self._end_ns = np.array([span.end_ns for span in recorded.down], dtype=np.int64)

    def at(self, time_ns: int) -> NDArray[np.bool_]:
        """Mask (n,) of the vehicles that were down at an instant."""
        down = np.zeros(self._count, dtype=bool)
        down[self._node[(self._start_ns <= time_ns) & (time_ns < self._end_ns)]] = True
        return down


def _by_period(events: Iterable[Event], period_ns: int, periods: int) -> list[list[Event]]:
    """The events of each period, and at the end those that came after the last."""
    told: list[list[Event]] = [[] for _ in range(periods + 1)]
    for event in events:
        told[min(event.time_ns // period_ns, periods)].append(event)
    return told


def schedule(
    messages: Iterable[Message], speed: float, from_ns: int = 0, to_ns: int | None = None
) -> Iterator[tuple[float, Message]]:
    """Yield the messages of the emulated times [from_ns, to_ns), each with its due time.

    Due times are in seconds of the wall clock from `from_ns` on. The scene is always first and the end last;
    periods that start before `from_ns`, or at `to_ns` or later, are skipped.
    """
    due_s = 0.0
    for stream, message in messages:
        if stream == "period":
            time_ns = message["time_ns"]
            if time_ns < from_ns:
                continue
            if to_ns is not None and time_ns >= to_ns:
                yield due_s, ("end", {"events": []})
                return
            due_s = (time_ns - from_ns) / 1e9 / speed
        yield due_s, (stream, message)


def play(
    scheduled: Iterable[tuple[float, Message]],
    show: Callable[[Message], None],
    now_s: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> int:
    """Show each message when it is due, or later if those before it take longer; return the number of periods.

    The clock starts with the first period, however long reading up to it takes.
    """
    periods = 0
    started_s = 0.0
    for due_s, message in scheduled:
        if message[0] == "period":
            if periods == 0:
                started_s = now_s() - due_s
            periods += 1
            if (early_s := started_s + due_s - now_s()) > 0:
                sleep(early_s)
        show(message)
    return periods
