"""What the checks look at: a run's files as arrays, who was up when, and which fault acted where and when.

The faults' plan is made anew from the scenario and the true positions, so that a run is judged from its files.
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

from emulator.faults.plan import FaultPlan, PlannedFault, swizzle_times_ns
from emulator.faults.selectors import Nodes
from emulator.radio.connectivity import connectivity_of
from emulator.radio.dot11p import airtimes_ns
from emulator.radio.outcomes import Stage, decided_at
from emulator.records.busy import busy_windows
from emulator.records.positions import Places
from emulator.records.run_folder import Event
from emulator.records.verdicts import MOST_ROWS
from emulator.scenario.fault_families import ProcessFault, SenderFault
from emulator.scenario.faults import Range, Swizzle
from emulator.scenario.scenario import Scenario
from emulator.world.links import load_links
from vnet.errors import VnetError
from vnet.types import Array, IntArray, Mask

NO_FAULT, UNHEARD_OF = -1, -2
NEVER_NS = np.iinfo(np.int64).max
REALTIME_GUARD_NS = 50_000_000
"""In real time nobody can say on which side of a fault's start or end a frame was that close to it."""
ARRIVED = decided_at(Stage.ARRIVAL)
ON_AIR = decided_at(Stage.RECEPTION, Stage.ARRIVAL)
"""What becomes of pairs that come as far as the radio."""
ENDINGS = ("died", "crashed", "finished", "spun")


@dataclass(frozen=True)
class Span:
    """A time [start, end) in which something is true of a node; `planned` where a fault wanted it."""

    node: int
    start_ns: int
    end_ns: int
    planned: bool

    def holds(self, time_ns: IntArray) -> Mask:
        """At which of these instants it is true."""
        return np.asarray((self.start_ns <= time_ns) & (time_ns < self.end_ns))


@dataclass(frozen=True)
class RecordedRun:
    """The scenario, the three tables, and the events."""

    scenario: Scenario
    trace: pa.Table
    states: pa.Table
    metrics: pa.Table
    events: Sequence[Event]
    known_m: Array | None = None
    """True positions (periods, N, 2), where the states have not got them all."""
    busy: pa.Table | None = None
    """busy.parquet, where senders share a medium."""

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

    @property
    def moves(self) -> bool:
        """Whether vehicles drive, enter and leave; else they stand but for their place in the lane."""
        return self.scenario.network.moves

    @cached_property
    def places(self) -> Places:
        """Where the vehicles were. Raises ScenarioError if the scenario's links do not fit them."""
        radio = self.scenario.radio
        connectivity = connectivity_of(radio, self.scenario.run.seed, load_links(radio, len(self.node_ids)))
        position_m = self.vectors("position_m") if self.known_m is None else self.known_m
        some = position_m if self.moves else position_m[:1]
        return Places(some, self.moves, self.scenario.period_ns, connectivity)

    @cached_property
    def busy_ratio(self) -> Array:
        """(windows, N), how busy each vehicle found the medium; no windows where senders share none."""
        return busy_windows(self.busy, self.node_ids)

    # The trace, column by column.

    def column(self, name: str) -> IntArray:
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
    def sent_ns(self) -> IntArray:
        """When it was sent."""
        return self.column("sent_ns")

    @cached_property
    def arrival_ns(self) -> IntArray:
        """When it arrived; -1 where it did not."""
        return self.column("arrival_ns")

    @cached_property
    def shares_air(self) -> bool:
        """Whether the trace tells when frames were on air."""
        return "on_air_ns" in self.trace.column_names

    @cached_property
    def on_air_ns(self) -> IntArray:
        """When its transmission began; -1 where it never did."""
        return self.column("on_air_ns")

    @cached_property
    def airtime_ns(self) -> IntArray:
        """How long its transmission takes, but for throttles."""
        return airtimes_ns(self.scenario.radio, self.column("size_bytes"))

    @cached_property
    def seq(self) -> IntArray:
        """Its number among its sender's."""
        return self.column("seq")

    @cached_property
    def copy(self) -> IntArray:
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
    def cause(self) -> IntArray:
        """The number of the fault that a row names; NO_FAULT, or UNHEARD_OF for a name that no fault has."""
        number = {planned.label: planned.number for planned in self.plan} | {"": NO_FAULT}
        column = self.trace["cause"].cast(pa.string()).combine_chunks().dictionary_encode()
        code = np.array([number.get(name, UNHEARD_OF) for name in column.dictionary.to_pylist()], dtype=np.int64)
        return np.asarray(code[column.indices.to_numpy()] if len(column) else np.zeros(0), dtype=np.int64)

    def caused_by(self, *kinds: str) -> Mask:
        """Which rows name a fault of one of these kinds."""
        return np.isin(self.cause, [planned.number for planned in self.plan if planned.fault.kind in kinds])

    @cached_property
    def placed(self) -> Mask:
        """Whether it is known where the vehicles were when a row's frame was sent."""
        return self.places.known(self.sent_ns)

    @cached_property
    def in_range(self) -> Mask:
        """Whether a row's sender and receiver were then in range of each other, as far as that is known."""
        return self.places.pairs_in_range(self.sender, self.receiver, self.sent_ns)

    @cached_property
    def _by_time(self) -> tuple[NDArray[np.intp], IntArray]:
        """The rows in the order in which their frames were sent, and when that was."""
        order = np.argsort(self.sent_ns, kind="stable")
        return order, self.sent_ns[order]

    def sent_between(self, start_ns: int, end_ns: int) -> NDArray[np.intp]:
        """The rows whose frames were sent in [start, end)."""
        order, sent_ns = self._by_time
        first, last = np.searchsorted(sent_ns, (start_ns, end_ns))
        return order[first:last]

    @cached_property
    def frame(self) -> IntArray:
        """One number for each (sender, seq)."""
        return np.asarray(self.sender * (int(self.seq.max(initial=0)) + 1) + self.seq)

    @cached_property
    def emission(self) -> IntArray:
        """One number for each (sender, seq, copy)."""
        return np.asarray(self.frame * (int(self.copy.max(initial=0)) + 1) + self.copy)

    def rows(self, broken: Mask | IntArray | NDArray[np.intp]) -> list[dict[str, Any]]:
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
        values = self.states["values"].combine_chunks().cast(VALUES_AS_LIST)
        something = np.asarray(pc.fill_null(pc.list_value_length(values), 0)) > 0
        for name in ("estimate_m", "common_error_estimate_m", "mean_m", "stacked_common_error_m", "cloud_m"):
            something |= np.asarray(self.states[name].combine_chunks().is_valid())
        reported = np.zeros((self.periods, len(self.node_ids)), dtype=bool)
        reported[self._place] = something
        return reported

    def period_starts_ns(self) -> IntArray:
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
        """When nodes were down: taken by a fault until it ended, not in the network, or for good."""
        spans = []
        for planned in self.plan:
            ends = isinstance(planned.fault, ProcessFault) and planned.fault.ends
            if ends and planned.start_ns < min(self.closed_ns, planned.end_ns):
                for node in np.flatnonzero(planned.nodes).tolist():
                    if self.deaths_ns.get(node, NEVER_NS) > planned.start_ns:
                        spans.append(Span(node, planned.start_ns, self._back_ns(node, planned.end_ns), True))
        deaths = [Span(node, time_ns, NEVER_NS, False) for node, time_ns in self.deaths_ns.items()]
        return [*spans, *self._absences(), *deaths]

    def _absences(self) -> Iterator[Span]:
        """When nodes were not in the network, as the events tell it."""
        if not self.moves or not self.node_ids:
            return
        since = dict.fromkeys(np.flatnonzero(~self.places.present()[0]).tolist(), 0)
        for event in self.event("left", "entered"):
            node = self.number_of(event.node)
            if event.kind == "left":
                since.setdefault(node, event.time_ns)
            elif node in since:
                yield Span(node, since.pop(node), event.time_ns, True)
        for node, start_ns in since.items():
            yield Span(node, start_ns, NEVER_NS, True)

    def _back_ns(self, node: int, end_ns: int) -> int:
        """When a node was up again after a fault: at its end, or in real time as soon as its process was there."""
        if self.scenario.run.pacing == "realtime":
            there = (e.time_ns for e in self.event("restarted", "entered") if e.node == self.node_ids[node])
            return min((time_ns for time_ns in there if time_ns >= end_ns), default=NEVER_NS)
        return end_ns if end_ns < self.closed_ns else NEVER_NS

    def is_down(self, node: NDArray[np.intp], time_ns: IntArray) -> Mask:
        """Which of these nodes are down at these instants."""
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
    def plan(self) -> list[PlannedFault]:
        """The faults and whom they chose. Raises ScenarioError if they do not fit the run's nodes."""
        if not self.node_ids or not self.scenario.fault:
            return []
        return FaultPlan(self.scenario, self._nodes_at(0), self._nodes_at if self.moves else None).faults

    def _nodes_at(self, period: int) -> Nodes:
        position_m = self.places.position_m(period)
        degree = np.where(np.isfinite(position_m[:, 0]), self.places.senders_in_range(period), -1)
        return Nodes(self.node_ids, position_m, degree)

    def acting(self, planned: PlannedFault, time_ns: IntArray, widen_ns: int = 0) -> Mask:
        """At which instants a fault acts; `widen_ns` before its start and after its end as well."""
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
        if not self.moves or not planned.fault.follows_vehicles:
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
        """Which rows of the trace were sent on a link while a fault acted there; those near a change count as well,
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
    def last_heal_ns(self) -> int:
        """From when on no fault acts any more; 0 without faults."""
        return max((planned.end_ns for planned in self.plan), default=0)


VALUES_AS_LIST = pa.list_(pa.struct([("key", pa.string()), ("value", pa.list_(pa.float64()))]))
