"""A finished run, read from its folder: `RecordedRun.open` is the one reader, for everything that reads a run.

It has the run's files as arrays, who was up when, and which fault acted where and when. The faults' plan is worked
out again from the scenario and the true positions, so that a run is judged from its files.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from emulator.faults.plan import FaultPlan, PlannedFault, swizzle_times_ns
from emulator.faults.selectors import Nodes
from emulator.radio.outcomes import Stage, decided_at
from emulator.records.events import CUTS_RUN, ENDS_PROGRAM, Event, EventKind, kinds_with
from emulator.records.recorded_tables import ARRIVED, ON_AIR, RecordedTables
from emulator.records.run_files import Columns, RunFiles
from emulator.scenario.fault_families import ProcessFault, SenderFault
from emulator.scenario.faults import Range, Swizzle
from vnet.types import IntArray, Mask

__all__ = ["ARRIVED", "ON_AIR", "OpenedRun", "RecordedRun", "Span"]

NO_FAULT, UNHEARD_OF = -1, -2
END_OF_TIME_NS = np.iinfo(np.int64).max
"""Later than every instant of a run."""
REALTIME_GUARD_NS = 50_000_000
"""In real time nobody can say on which side of a fault's start or end a frame was that close to it."""


@dataclass(frozen=True)
class Span:
    """A time [start, end) in which something is true of a node; `planned` where a fault wanted it."""

    node: int
    start_ns: int
    end_ns: int
    planned: bool

    def holds(self, time_ns: IntArray) -> Mask:
        """Mask of the instants within the span."""
        return np.asarray((self.start_ns <= time_ns) & (time_ns < self.end_ns))


@dataclass(frozen=True)
class RecordedRun(RecordedTables):
    """A run's tables, and what they mean together."""

    @staticmethod
    def open(folder: Path, columns: Columns | None = None) -> OpenedRun:
        """Return a run whose files are each read when they are first needed; then VnetError says what is wrong.

        Of the tables that `columns` names, only those columns are read.
        """
        return OpenedRun(folder, columns)

    # Events, and who was up when.

    def event(self, *kinds: str) -> list[Event]:
        """The events of these kinds."""
        return [event for event in self.events if event.kind in kinds]

    @property
    def guard_ns(self) -> int:
        """Time before and after a change of faults in which nothing can be said."""
        return REALTIME_GUARD_NS if self.scenario.run.pacing == "realtime" else 0

    @cached_property
    def closed_ns(self) -> int:
        """Instant at which emulated time ended."""
        cut = [event.time_ns for event in self.event(*kinds_with(CUTS_RUN))]
        return min([self.scenario.duration_ns, *cut])

    @cached_property
    def deaths_ns(self) -> dict[int, int]:
        """Instants at which nodes ended by themselves, by their numbers: they stay down."""
        deaths: dict[int, int] = {}
        for event in self.event(*kinds_with(ENDS_PROGRAM)):
            if event.node is not None:
                number = self.number_of(event.node)
                deaths[number] = min(deaths.get(number, event.time_ns), event.time_ns)
        return deaths

    @cached_property
    def down(self) -> list[Span]:
        """Spans in which nodes were down: taken by a fault until it ended, not in the network, or for good."""
        spans = []
        for planned in self.plan:
            ends = isinstance(planned.fault, ProcessFault) and planned.fault.ends
            if ends and planned.start_ns < min(self.closed_ns, planned.end_ns):
                for node in np.flatnonzero(planned.nodes).tolist():
                    if self.deaths_ns.get(node, END_OF_TIME_NS) > planned.start_ns:
                        spans.append(Span(node, planned.start_ns, self._back_ns(node, planned.end_ns), True))
        deaths = [Span(node, time_ns, END_OF_TIME_NS, False) for node, time_ns in self.deaths_ns.items()]
        return [*spans, *self._absences(), *deaths]

    def _absences(self) -> Iterator[Span]:
        """Spans in which nodes were not in the network, as the events tell it."""
        if not self.moves or not self.node_ids:
            return
        since = dict.fromkeys(np.flatnonzero(~self.places.present()[0]).tolist(), 0)
        for event in self.event(EventKind.left, EventKind.entered):
            node = self.number_of(event.node)
            if event.kind == EventKind.left:
                since.setdefault(node, event.time_ns)
            elif node in since:
                yield Span(node, since.pop(node), event.time_ns, True)
        for node, start_ns in since.items():
            yield Span(node, start_ns, END_OF_TIME_NS, True)

    def _back_ns(self, node: int, end_ns: int) -> int:
        """Instant at which a node was up again after a fault: its end, or in real time its process's return."""
        if self.scenario.run.pacing == "realtime":
            there = (
                e.time_ns
                for e in self.event(EventKind.restarted, EventKind.entered)
                if e.node == self.node_ids[node]
            )
            return min((time_ns for time_ns in there if time_ns >= end_ns), default=END_OF_TIME_NS)
        return end_ns if end_ns < self.closed_ns else END_OF_TIME_NS

    def is_down(self, node: NDArray[np.intp], time_ns: IntArray) -> Mask:
        """Mask of these nodes that are down at these instants."""
        nodes = np.array([span.node for span in self.down], dtype=np.intp)
        edges_ns = np.array([(span.start_ns, span.end_ns) for span in self.down], dtype=np.int64).reshape(-1, 2)
        down = np.zeros(len(node), dtype=bool)
        for number in np.unique(nodes).tolist():
            mine = np.flatnonzero(node == number)
            begun, ended = (
                np.searchsorted(np.sort(edges_ns[nodes == number, edge]), time_ns[mine], side="right")
                for edge in (0, 1)
            )
            down[mine] = begun > ended
        return down

    def is_unsure(self, time_ns: IntArray) -> Mask:
        """Instants of which nobody can say who was up: those of a death, in real time those near a change."""
        unsure = np.isin(time_ns, list(self.deaths_ns.values()))
        if self.guard_ns and self.down:
            edges_ns = np.unique([edge for span in self.down for edge in (span.start_ns, span.end_ns)]).astype(
                float
            )
            after = np.searchsorted(edges_ns, time_ns)
            for near in (np.maximum(after - 1, 0), np.minimum(after, len(edges_ns) - 1)):
                unsure |= np.abs(time_ns - edges_ns[near]) <= self.guard_ns
        return np.asarray(unsure)

    # Faults.

    @cached_property
    def cause(self) -> IntArray:
        """The number of the fault that a row names; NO_FAULT, or UNHEARD_OF for a name that no fault has."""
        number = {planned.label: planned.number for planned in self.plan} | {"": NO_FAULT}
        column = self.trace["cause"].cast(pa.string()).combine_chunks().dictionary_encode()
        code = np.array([number.get(name, UNHEARD_OF) for name in column.dictionary.to_pylist()], dtype=np.int64)
        return np.asarray(code[column.indices.to_numpy()] if len(column) else np.zeros(0), dtype=np.int64)

    def caused_by(self, *kinds: str) -> Mask:
        """Mask of the rows that name a fault of one of these kinds."""
        wanted = [planned.number for planned in self.plan if planned.fault.kind in kinds]
        return np.isin(self.cause, wanted) if wanted else np.zeros(len(self.cause), dtype=bool)

    @cached_property
    def plan(self) -> list[PlannedFault]:
        """The faults and whom they chose. Raises ScenarioError if they do not fit the run's nodes."""
        return [] if self.fault_plan is None else self.fault_plan.faults

    @cached_property
    def fault_plan(self) -> FaultPlan | None:
        """The plan of the faults; None without faults."""
        if not self.node_ids or not self.scenario.fault:
            return None
        nodes_at = self._nodes_at if self.topology_changes else None
        return FaultPlan(self.scenario, self._nodes_at(0), nodes_at)

    def _nodes_at(self, period: int) -> Nodes:
        position_m = self.places.position_m(period)
        degree = np.where(np.isfinite(position_m[:, 0]), self.places.senders_in_range(period), -1)
        return Nodes(self.node_ids, position_m, degree)

    def acting(self, planned: PlannedFault, time_ns: IntArray, widen_ns: int = 0) -> Mask:
        """Mask of the instants at which a fault acts, or is less than `widen_ns` away."""
        return np.asarray((planned.start_ns - widen_ns <= time_ns) & (time_ns < planned.end_ns + widen_ns))

    def struck(self, planned: PlannedFault) -> Mask:
        """(periods, N), on whose receivers a fault acts at the start of which period."""
        start_ns = self.period_starts_ns()
        struck = self.acting(planned, start_ns)[:, None] & planned.nodes[None, :]
        if planned.moving is not None:
            for period in np.flatnonzero(self.acting(planned, start_ns)).tolist():
                struck[period] = planned.placed(period * self.scenario.period_ns).nodes
        return np.asarray(struck)

    def connectivity(self, planned: PlannedFault) -> Iterator[tuple[int, int, Mask]]:
        """The links (N, N), rows are senders, whose rows may name a fault, and from when until when."""
        if planned.moving is None and not (self.moves and planned.fault.follows_vehicles):
            yield from self._connectivity(planned)
            return
        period_ns = self.scenario.period_ns
        for period in range(planned.start_ns // period_ns, min(-(-planned.end_ns // period_ns), self.periods)):
            start_ns = max(planned.start_ns, period * period_ns)
            for _, _, links in self._connectivity(planned.placed(start_ns), period):
                yield start_ns, min(planned.end_ns, (period + 1) * period_ns), links

    def _connectivity(self, planned: PlannedFault, period: int = 0) -> Iterator[tuple[int, int, Mask]]:
        """The same, for a fault that acts on the same nodes all the time, with the distances of a period."""
        fault, start_ns, end_ns = planned.fault, planned.start_ns, planned.end_ns
        if planned.links is not None:
            yield start_ns, end_ns, planned.links
        elif isinstance(fault, Range):
            touched = planned.nodes[:, None] | planned.nodes[None, :]
            yield start_ns, end_ns, touched & (self.places.distance_m(period) > fault.range_m)
        elif isinstance(fault, SenderFault):
            yield start_ns, end_ns, np.repeat(planned.nodes[:, None], len(self.node_ids), axis=1)
        elif isinstance(fault, Swizzle):
            for node, off_ns, back_ns in swizzle_times_ns(planned, self.scenario.run.seed):
                one = np.arange(len(self.node_ids)) == node
                yield off_ns, min(back_ns, end_ns), one[:, None] | one[None, :]

    def reached(self, planned: PlannedFault, widen_ns: int = 0) -> Mask:
        """Mask of the rows that were sent on a link while a fault acted there; those near a change count as well,
        or not if `widen_ns` is negative.
        """
        late, early = self._reached(planned, widen_ns), self._reached(planned, -widen_ns)
        return early | late | self._reached(planned, 0) if widen_ns > 0 else early & late

    def _reached(self, planned: PlannedFault, later_ns: int) -> Mask:
        """The same, as if every row had been sent so much later."""
        reached = np.zeros(len(self.trace), dtype=bool)
        for start_ns, end_ns, links in self.connectivity(planned):
            rows = self.sent_between(start_ns - later_ns, end_ns - later_ns)
            reached[rows] |= links[self.sender[rows], self.receiver[rows]]
        return reached

    @cached_property
    def dropped_by_sender(self) -> Mask:
        """Mask of the rows of frames that a rule at their sender dropped: they were never enqueued."""
        return np.asarray(self.outcome_is("fault") & self.caused_by("custom_sender"))

    @cached_property
    def never_sent(self) -> Mask:
        """Mask of the rows of frames that never left their sender."""
        return np.asarray(self.outcome_is(*decided_at(Stage.SENDER)) | self.dropped_by_sender)

    @cached_property
    def last_heal_ns(self) -> int:
        """From when on no fault acts any more; 0 without faults."""
        return max((planned.end_ns for planned in self.plan), default=0)


class OpenedRun(RunFiles, RecordedRun):
    """A run whose fields are the files of its folder."""
