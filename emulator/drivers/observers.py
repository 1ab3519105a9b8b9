"""The messages of a running emulation to its observers."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from emulator.drivers.emulation import Emulation, PeriodView
from emulator.radio.outcomes import Outcome
from emulator.radio.trace import decided_ns
from emulator.records.events import Event
from emulator.records.recorded_world import RecordedWorld
from emulator.records.tables import mean_busy
from emulator.scenario.scenario import Scenario
from emulator.stream import beliefs_of, event_message, period_message, scene_message


class Messages:
    """Makes the messages of one run. Nothing is done, and next to nothing kept, for periods that nobody asks for.

    After its making, or `begin`, call `period` at the end of every period: it looks only at the rows of the trace
    that were undecided the last time, and at those that are new.
    """

    def __init__(self, emulation: Emulation) -> None:
        self._emulation = emulation
        self._sent_events = 0
        self._scene: dict[str, Any] = {}
        self._scenario: Scenario | None = None
        self.begin()

    def begin(self) -> None:
        """Watch from now on; what has been decided so far is nobody's business."""
        engine = self._emulation.engine
        self._undecided = np.array(engine.pending_rows(), dtype=np.intp)
        self._seen = len(engine.trace)

    def scene(self) -> dict[str, Any]:
        """Scene: what does not change in a run."""
        if self._scenario is not self._emulation.scenario:  # faults are planned while a run is on
            self._scenario = self._emulation.scenario
            world = RecordedWorld.of(self._emulation.world)
            text, views = self._emulation.folder.scenario_text, self._emulation.metrics.declared.views
            self._scene = scene_message(world, self._scenario, text, views)
        return self._scene

    def period(self, view: PeriodView) -> dict[str, Any]:
        """The period that has just ended."""
        emulation, start_ns = self._emulation, view.instant.time_ns
        end_ns = start_ns + emulation.world.period_ns
        return period_message(
            emulation.world.node_ids,
            view.instant,
            end_ns,
            beliefs_of(emulation.number, view.reports, emulation.metrics.declared),
            view.figures,
            self._rows(end_ns),
            [emulation.up[node] for node in emulation.world.node_ids],
            [planned.label for planned in emulation.faults.faults if planned.acts_between(start_ns, end_ns)],
            self._events(),
            mean_busy(emulation.engine.busy_ratios(end_ns), len(emulation.number), start_ns, end_ns),
            emulation.driving.background_m(view.instant.period),
        )

    def end(self) -> dict[str, Any]:
        """The run is over: what happened after its last period."""
        return {"events": list(map(event_message, self._events()))}

    def _rows(self, end_ns: int) -> NDArray[np.void]:
        """The rows that the last message did not see decided."""
        trace = self._emulation.engine.trace
        number = np.concatenate([self._undecided, np.arange(self._seen, len(trace))])
        rows = np.concatenate([trace.rows(self._undecided), trace.rows(slice(self._seen, len(trace)))])
        # In real time a frame of the next period may have been sent by now, and its outcome be known.
        self._undecided = number[(rows["outcome"] == Outcome.pending) | (decided_ns(rows) >= end_ns)]
        self._seen = len(trace)
        return rows

    def _events(self) -> list[Event]:
        events = self._emulation.folder.events[self._sent_events :]
        self._sent_events += len(events)
        return events
