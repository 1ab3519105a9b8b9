"""What the checks look at: a run's files as arrays, who was up when, and which fault acted where and when.

The faults' plan is made anew from the scenario and the first positions, so that a run is judged from its files.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from emulator.channel.reach import Reach, distances_m, reach_of
from emulator.faults.plan import FaultPlan, PlannedFault, swizzle_times_ns
from emulator.faults.selectors import Nodes
from emulator.observe.checks.verdicts import MOST_ROWS
from emulator.observe.run_folder import Event
from emulator.world.links import load_links
from vnet.errors import VnetError
from vnet.faults import Range, SenderFault, Swizzle
from vnet.roads.lanes import Array
from vnet.scenario import Scenario

Mask = NDArray[np.bool_]
Whole = NDArray[np.int64]

NO_FAULT, UNHEARD_OF = -1, -2
NEVER_NS = np.iinfo(np.int64).max
REALTIME_GUARD_NS = 50_000_000
"""In real time nobody can say on which side of a fault's start or end a frame was that close to it."""
ARRIVED = ("delivered", "receiver_down", "transport")
ENDINGS = ("died", "crashed", "finished", "spun")


@dataclass(frozen=True)
class Span:
    """A time [start, end) in which something is true of a node; `planned` where a fault wanted it."""

    node: int
    start_ns: int
    end_ns: int
    planned: bool

    def holds(self, time_ns: Whole) -> Mask:
        """At which of these instants it is true."""
        return np.asarray((self.start_ns <= time_ns) & (time_ns < self.end_ns))


@dataclass(frozen=True)
class Evidence:
    """The scenario, the three tables, and the events."""

    scenario: Scenario
    trace: pa.Table
    states: pa.Table
    metrics: pa.Table
    events: Sequence[Event]

    # Nodes and where they are.

    @cached_property
    def node_ids(self) -> list[str]:
        """The nodes in the order of their numbers, which is that of the states' rows."""
        first = self.states.filter(pc.equal(self.states["period"], 0))
        return [str(node) for node in first["node"].to_pylist()]

    @cached_property
    def number(self) -> dict[str, int]:
        """The number of each node."""
        return {node: number for number, node in enumerate(self.node_ids)}

    def number_of(self, node: str | None) -> int:
        """The number of a node that trace or events name. Raises VnetError if the states do not know it."""
        if node not in self.number:
            raise VnetError(f"node {node!r} in trace or events: the states know only {len(self.number)} others")
        return self.number[node]

    def positions(self) -> Array:
        """First true positions (N, 2). Vehicles stand still but for their place in the lane."""
        return np.asarray(self.vectors("position_m")[0])

    @cached_property
    def distance_m(self) -> Array:
        """(N, N) between first positions."""
        return distances_m(self.positions())

    @cached_property
    def links(self) -> Mask | None:
        """(N, N), who (row) hears whom (column), or None where the range decides. Raises ScenarioError."""
        return load_links(self.scenario.radio, len(self.node_ids))

    @cached_property
    def law_of_reach(self) -> Reach:
        """The law of who is in range of whom. Raises ScenarioError."""
        return reach_of(self.scenario.radio, self.scenario.run.seed, self.links)

    @cached_property
    def in_range(self) -> Mask:
        """(N, N), rows are senders: who is in range of whom."""
        if not self.node_ids:  # a run that ended before its first period did
            return np.zeros((0, 0), dtype=bool)
        return self.law_of_reach.in_range(self.positions(), self.distance_m)

    # The trace, column by column.

    def column(self, name: str) -> Whole:
        """A column of whole numbers of the trace; -1 where there is none."""
        column = pc.fill_null(self.trace[name], -1) if self.trace[name].null_count else self.trace[name]
        return np.asarray(column.to_numpy(), dtype=np.int64)

    def nodes(self, name: str) -> NDArray[np.intp]:
        """A column of node ids of the trace as numbers."""
        column = self.trace[name].combine_chunks()
        code = np.array([self.number_of(node) for node in column.dictionary.to_pylist()], dtype=np.intp)
        return np.asarray(code[column.indices.to_numpy()], dtype=np.intp)

    @cached_property
    def sender(self) -> NDArray[np.intp]:
        """Who sent each row's frame."""
        return self.nodes("sender")

    @cached_property
    def receiver(self) -> NDArray[np.intp]:
        """Who was to hear it."""
        return self.nodes("receiver")

    @cached_property
    def sent_ns(self) -> Whole:
        """When it was sent."""
        return self.column("sent_ns")

    @cached_property
    def arrival_ns(self) -> Whole:
        """When it arrived; -1 where it did not."""
        return self.column("arrival_ns")

    @cached_property
    def seq(self) -> Whole:
        """Its number among its sender's."""
        return self.column("seq")

    @cached_property
    def copy(self) -> Whole:
        """0, or the number of the copy."""
        return self.column("copy")

    @cached_property
    def digest(self) -> NDArray[np.uint64]:
        """The digest of what arrives."""
        return np.asarray(self.trace["payload_digest"].to_numpy(), dtype=np.uint64)

    @cached_property
    def arrived(self) -> Mask:
        """Whether it came as far as its receiver."""
        return self.outcome_is(*ARRIVED)

    def outcome_is(self, *names: str) -> Mask:
        """Which rows have one of these outcomes."""
        mask = pc.is_in(self.trace["outcome"].cast(pa.string()), pa.array(names))
        return np.asarray(mask.to_numpy(zero_copy_only=False), dtype=bool)

    @cached_property
    def cause(self) -> Whole:
        """The number of the fault that a row names; NO_FAULT, or UNHEARD_OF for a name that no fault has."""
        number = {planned.label: planned.number for planned in self.plan} | {"": NO_FAULT}
        column = self.trace["cause"].cast(pa.string()).combine_chunks().dictionary_encode()
        code = np.array([number.get(name, UNHEARD_OF) for name in column.dictionary.to_pylist()], dtype=np.int64)
        return np.asarray(code[column.indices.to_numpy()] if len(column) else np.zeros(0), dtype=np.int64)

    def caused_by(self, *kinds: str) -> Mask:
        """Which rows name a fault of one of these kinds."""
        return np.isin(self.cause, [planned.number for planned in self.plan if planned.fault.kind in kinds])

    @cached_property
    def frame(self) -> Whole:
        """One number for each (sender, seq)."""
        return np.asarray(self.sender * (int(self.seq.max(initial=0)) + 1) + self.seq)

    @cached_property
    def emission(self) -> Whole:
        """One number for each (sender, seq, copy)."""
        return np.asarray(self.frame * (int(self.copy.max(initial=0)) + 1) + self.copy)

    def rows(self, broken: Mask | Whole | NDArray[np.intp]) -> list[dict[str, Any]]:
        """The first offending rows of the trace, by mask or by number."""
        indices = np.flatnonzero(broken) if broken.dtype == bool else np.asarray(broken)
        listed = self.trace.take(pa.array(np.sort(indices)[:MOST_ROWS].astype(np.int64))).to_pylist()
        return [{**row, "payload_digest": f"{row['payload_digest']:016x}"} for row in listed]

    # The states, as arrays over (period, node).

    @cached_property
    def _place(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        period = np.asarray(self.states["period"].to_numpy(), dtype=np.intp)
        return period, np.array([self.number_of(n) for n in self.states["node"].to_pylist()], dtype=np.intp)

    @property
    def periods(self) -> int:
        """How many periods were kept."""
        return int(self._place[0].max(initial=-1)) + 1

    def vectors(self, name: str) -> Array:
        """A column of points of the states (periods, N, 2); NaN where there is none."""
        return self._spread(self.states[name].combine_chunks(), 2)

    def _spread(self, column: pa.Array, size: int) -> Array:
        spread = np.full((self.periods, len(self.node_ids), size), np.nan)
        there = np.asarray(column.is_valid())
        period, node = self._place
        flat = np.asarray(column.drop_null().flatten().to_numpy(zero_copy_only=False), dtype=float)
        spread[period[there], node[there]] = flat.reshape(-1, size)
        return spread

    def value(self, name: str) -> Array:
        """A number that programs report by this name (periods, N); NaN where there is none."""
        lists = pc.map_lookup(self.states["values"].combine_chunks(), name, "first")
        return self._spread(pc.if_else(pc.equal(pc.list_value_length(lists), 1), lists, None), 1)[..., 0]

    @cached_property
    def reported(self) -> Mask:
        """(periods, N), who reported anything in which period."""
        values = self.states["values"].combine_chunks().cast(_AS_LIST)
        something = np.asarray(pc.fill_null(pc.list_value_length(values), 0)) > 0
        for name in ("estimate_m", "common_error_estimate_m", "mean_m", "stacked_common_error_m", "cloud_m"):
            something |= np.asarray(self.states[name].combine_chunks().is_valid())
        reported = np.zeros((self.periods, len(self.node_ids)), dtype=bool)
        reported[self._place] = something
        return reported

    def period_starts_ns(self) -> Whole:
        """When each period starts."""
        return np.arange(self.periods, dtype=np.int64) * self.scenario.period_ns

    # Events, and who was up when.

    def event(self, *kinds: str) -> list[Event]:
        """The events of these kinds."""
        return [event for event in self.events if event.kind in kinds]

    @property
    def guard_ns(self) -> int:
        """How close to a change of faults nothing can be said."""
        return REALTIME_GUARD_NS if self.scenario.run.pacing == "realtime" else 0

    @cached_property
    def closed_ns(self) -> int:
        """When emulated time came to its end."""
        cut = [event.time_ns for event in self.event("interrupted", "stalled")]
        return min([self.scenario.duration_ns, *cut])

    @cached_property
    def deaths_ns(self) -> dict[int, int]:
        """When nodes ended by themselves, by their numbers: they stay down."""
        deaths: dict[int, int] = {}
        for event in self.event(*ENDINGS):
            if event.node is not None:
                number = self.number_of(event.node)
                deaths[number] = min(deaths.get(number, event.time_ns), event.time_ns)
        return deaths

    @cached_property
    def down(self) -> list[Span]:
        """When nodes were down: taken by a fault until it ended, or for good."""
        spans = []
        for planned in self.plan:
            if planned.fault.kind in ("kill", "restart") and planned.start_ns < min(self.closed_ns, planned.end_ns):
                for node in np.flatnonzero(planned.nodes).tolist():
                    if self.deaths_ns.get(node, NEVER_NS) > planned.start_ns:
                        spans.append(Span(node, planned.start_ns, self._back_ns(node, planned.end_ns), True))
        return spans + [Span(node, time_ns, NEVER_NS, False) for node, time_ns in self.deaths_ns.items()]

    def _back_ns(self, node: int, end_ns: int) -> int:
        """When a node was up again after a fault: at its end, or in real time as soon as its process was there."""
        if self.scenario.run.pacing == "realtime":
            there = (e.time_ns for e in self.event("restarted") if e.node == self.node_ids[node])
            return min((time_ns for time_ns in there if time_ns >= end_ns), default=NEVER_NS)
        return end_ns if end_ns < self.closed_ns else NEVER_NS

    def is_down(self, node: NDArray[np.intp], time_ns: Whole) -> Mask:
        """Which of these nodes are down at these instants."""
        down = np.zeros(len(node), dtype=bool)
        for span in self.down:
            down |= (node == span.node) & span.holds(time_ns)
        return down

    def is_unsure(self, time_ns: Whole) -> Mask:
        """Instants of which nobody can say who was up: those of a death, and in real time those near a fault's."""
        unsure = np.isin(time_ns, list(self.deaths_ns.values()))
        if self.guard_ns:
            for span in self.down:
                for edge_ns in (span.start_ns, span.end_ns):
                    unsure |= np.abs(time_ns.astype(float) - edge_ns) <= self.guard_ns
        return np.asarray(unsure)

    # Faults.

    @cached_property
    def plan(self) -> list[PlannedFault]:
        """The faults and whom they chose. Raises ScenarioError if they do not fit the run's nodes."""
        if not self.node_ids or not self.scenario.fault:
            return []
        nodes = Nodes(self.node_ids, self.positions(), self.in_range.sum(axis=0))
        return FaultPlan(self.scenario, nodes).faults

    def acting(self, planned: PlannedFault, time_ns: Whole, widen_ns: int = 0) -> Mask:
        """At which instants a fault acts; `widen_ns` before its start and after its end as well."""
        return np.asarray((planned.start_ns - widen_ns <= time_ns) & (time_ns < planned.end_ns + widen_ns))

    def reach(self, planned: PlannedFault) -> Iterator[tuple[int, int, Mask]]:
        """The links (N, N), rows are senders, whose rows may name a fault, and from when until when."""
        fault, start_ns, end_ns = planned.fault, planned.start_ns, planned.end_ns
        if planned.links is not None:
            yield start_ns, end_ns, planned.links
        elif isinstance(fault, Range):
            touched = planned.nodes[:, None] | planned.nodes[None, :]
            yield start_ns, end_ns, touched & (self.distance_m > fault.range_m)
        elif isinstance(fault, SenderFault):
            yield start_ns, end_ns, np.repeat(planned.nodes[:, None], len(self.node_ids), axis=1)
        elif isinstance(fault, Swizzle):
            for node, off_ns, back_ns in swizzle_times_ns(planned, self.scenario.run.seed):
                one = np.arange(len(self.node_ids)) == node
                yield off_ns, min(back_ns, end_ns), one[:, None] | one[None, :]

    def reached(self, planned: PlannedFault, widen_ns: int = 0) -> Mask:
        """Which rows of the trace were sent on a link while a fault acted there."""
        reached = np.zeros(len(self.trace), dtype=bool)
        for start_ns, end_ns, links in self.reach(planned):
            when = (start_ns - widen_ns <= self.sent_ns) & (self.sent_ns < end_ns + widen_ns)
            reached |= when & links[self.sender, self.receiver]
        return reached

    @cached_property
    def last_heal_ns(self) -> int:
        """From when on no fault acts any more; 0 without faults."""
        return max((planned.end_ns for planned in self.plan), default=0)


_AS_LIST = pa.list_(pa.struct([("key", pa.string()), ("value", pa.list_(pa.float64()))]))
