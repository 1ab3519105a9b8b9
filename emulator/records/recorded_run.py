"""A finished run, read from its folder: `RecordedRun.open` is the one reader, for everything that reads a run.

It has the run's files as arrays, who was up when, and which fault acted where and when. The faults' plan is worked
out again from the scenario and the true positions, so that a run is judged from its files.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from emulator.fault_plan import FaultPlan, Nodes, PlannedFault, swizzle_times_ns
from emulator.radio.dot11p import airtimes_ns
from emulator.radio.outcomes import Outcome, Stage, decided_at
from emulator.radio.topology import connectivity_of
from emulator.radio.trace import ACKNOWLEDGED, LATE
from emulator.records.events import CUTS_RUN, ENDS_PROGRAM, Event, EventKind, kinds_with, parse_events
from emulator.records.period_figures import ProgramFigures, Views, figures_if_here
from emulator.records.recorded_world import Places, RecordedWorld
from emulator.records.reported import numbers_of, reported_columns, value_columns
from emulator.records.run_folder import (
    EVENTS_FILE,
    FORMAT,
    SCENARIO_FILE,
    VERDICT_FILE,
    WORLD_FILE,
    LaterFormatError,
    check_is_run,
    is_run_folder,
    not_finished,
)
from emulator.records.tables import (
    BUSY,
    METRICS,
    PAYLOADS,
    STATES,
    TRACE,
    VALUES_AS_LIST,
    Column,
    Condition,
    KeptPayloads,
    Table,
    always,
    busy_windows,
    columns_of,
    open_table,
)
from emulator.records.verdicts import MOST_ROWS, Record, read_record
from emulator.scenario.faults import (
    EmulatorRestart,
    Fault,
    Infrastructure,
    ProcessFault,
    Range,
    SenderFault,
    Swizzle,
)
from emulator.scenario.loading import LARGEST_BYTES, load_scenario, parse_recorded_scenario
from emulator.scenario.scenario import Scenario
from emulator.world.neighbours import Links
from emulator.world.radio_inputs import LinkTable, RadioInputs, load_links
from emulator.world.world import build_world
from vnet.bounded import read_regular
from vnet.errors import ScenarioError, VnetError, printable
from vnet.types import Array, IntArray, Mask
from vnet.units import NS_PER_S

ARRIVED = decided_at(Stage.ARRIVAL)
ON_AIR = decided_at(Stage.RECEPTION, Stage.ARRIVAL)
"""Outcomes of receptions that get as far as the receiver's radio."""
LARGEST_EVENTS_BYTES = 1 << 28
SPARE_ROWS = 1_000_000
"""Rows that every table may have, whatever verdict.json says."""
MOST_ROWS_BY_ONE_THREAD = 10_000
"""Rows that one thread reads sooner than several, which cost a millisecond."""
Columns = Mapping[Table, Collection[str]]
T = TypeVar("T")


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


class Emissions(NamedTuple):
    """The frames of a trace, and the copies of frames (n,): the first row of each, and its number of receptions.

    `of_row` has the index of each row's.
    """

    first: NDArray[np.intp]
    of_row: NDArray[np.intp]
    receptions: IntArray


@dataclass(frozen=True)
class RecordedRun:
    """The scenario of a run, its tables as arrays, its events, and what they mean together."""

    scenario: Scenario
    trace: pa.Table
    states: pa.Table
    metrics: pa.Table
    events: Sequence[Event]
    known_m: Array | None = None
    """True positions (periods, N, 2), where the states have not got them all."""
    world: RecordedWorld | None = None
    """world.npz."""
    more: Mapping[Table, pa.Table | None] = field(default_factory=dict)
    """Tables that only some runs have."""

    def table(self, kind: Table) -> pa.Table | None:
        """Return a table of the run; None if it has none of this kind."""
        return {TRACE: self.trace, STATES: self.states, METRICS: self.metrics, **self.more}.get(kind)

    @staticmethod
    def open(folder: Path, columns: Columns | None = None) -> OpenedRun:
        """Return a run whose files are each read when they are first needed; then VnetError says what is wrong.

        Of the tables that `columns` names, only those columns are read.
        """
        return OpenedRun(folder, columns)

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
        if not self.number:
            raise VnetError("no period was completed")
        if node not in self.number:
            raise VnetError(f"node {node!r} in trace or events: the states know only {len(self.number)} others")
        return self.number[node]

    @cached_property
    def runs_the_program(self) -> Mask:
        """The nodes (N,) that run the scenario's program; those of its exceptions may well report what is false."""
        excepted = {node for exception in self.scenario.program.exceptions for node in exception.nodes}
        return np.array([node not in excepted for node in self.node_ids], dtype=bool)

    @property
    def moves(self) -> bool:
        """True if vehicles drive, enter and leave; else only their lateral offsets change."""
        return self.scenario.network.moves

    @cached_property
    def topology_changes(self) -> bool:
        """True if the vehicles in range of each other change during the run."""
        return self.moves or isinstance(self.radio_inputs.links, LinkTable)

    @cached_property
    def places(self) -> Places:
        """Positions of the vehicles. Raises ScenarioError if the scenario's links do not fit them."""
        connectivity = connectivity_of(self.scenario.radio, self.scenario.run.seed, self.radio_inputs)
        position_m = self.vectors("position_m") if self.known_m is None else self.known_m
        some = position_m if self.moves else position_m[:1]
        return Places(some, self.moves, self.scenario.period_ns, connectivity, self.scenario.duration_ns)

    def admitted(self, up: Mask, time_ns: int) -> Links:
        """Return the pairs of a sender and a receiver whose cap admits it when these nodes (N,) are up."""
        pairs = self.places.links(time_ns)
        pairs = pairs.of(up[pairs.sender])
        # For each receiver the nearest first, equally near ones by number.
        order = np.lexsort((pairs.sender, pairs.distance_m, pairs.receiver))
        first = np.cumsum(pairs.in_degrees()) - pairs.in_degrees()
        rank = np.arange(len(order)) - first[pairs.receiver[order]]
        admitted = np.zeros(len(order), dtype=bool)
        admitted[order] = rank < self.scenario.radio.max_peers
        return pairs.of(admitted)

    @cached_property
    def radio_inputs(self) -> RadioInputs:
        """Inputs of the radio from files, as they were recorded; no input file is read."""
        radio, count = self.scenario.radio, len(self.node_ids)
        recorded = RadioInputs() if self.world is None else self.world.radio_inputs
        recorded = replace(recorded, units=self.scenario.roadside)
        if radio.buildings is not None and recorded.buildings is None:
            raise VnetError("[radio.buildings]: no buildings were recorded")
        if not isinstance(radio.links, Path):
            return replace(recorded, links=load_links(radio, self.node_ids))
        links = recorded.links
        if links is None or (not isinstance(links, LinkTable) and len(links) != count):
            raise VnetError(f"radio.links = {str(radio.links)!r}: no links of {count} vehicles were recorded")
        return recorded

    @cached_property
    def busy_ratio(self) -> Array:
        """(windows, N), how busy each vehicle found the medium; no windows where senders share none."""
        return busy_windows(self.table(BUSY), self.node_ids)

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
        """Sender of each row's frame."""
        return self.nodes("sender")

    @cached_property
    def receiver(self) -> NDArray[np.intp]:
        """Receiver of each row."""
        return self.nodes("receiver")

    @cached_property
    def sent_ns(self) -> IntArray:
        """Instant at which each row's frame was sent."""
        return self.column("sent_ns")

    @cached_property
    def arrival_ns(self) -> IntArray:
        """Instant of each row's arrival; -1 where the frame did not arrive."""
        return self.column("arrival_ns")

    @cached_property
    def due_ns(self) -> IntArray:
        """Instant of each row's arrival by the radio: in real time `arrival_ns` without the machine's part."""
        if self.scenario.run.pacing != "realtime":
            return self.arrival_ns
        return self.arrival_ns - self._optional(LATE, 0)

    @cached_property
    def shares_air(self) -> bool:
        """True if the trace tells when frames were on air."""
        return "on_air_ns" in self.trace.column_names

    @cached_property
    def on_air_ns(self) -> IntArray:
        """Begin of each row's transmission; -1 where it never began."""
        return self.column("on_air_ns")

    @cached_property
    def airtime_ns(self) -> IntArray:
        """Duration of each row's transmission, but for throttles; on a sidelink until the last slot ends."""
        if (mac := self.scenario.radio.sidelink) is not None:
            lasts_ns = self.column("left_ns") - self.on_air_ns
            return np.where(self.on_air_ns >= 0, lasts_ns, mac.slot_ns)
        return airtimes_ns(self.scenario.radio, self.column("size_bytes"), self.bitrate_mbps)

    @cached_property
    def bitrate_mbps(self) -> Array:
        """Bit rate of each row's frame in Mbit/s."""
        return self._chosen("bitrate_mbps", self.scenario.radio.bitrate_mbps)

    @cached_property
    def gain_db(self) -> Array:
        """Power of each row's frame above the scenario's in dB."""
        return self._chosen("gain_db", 0.0)

    def _chosen(self, name: str, default: float) -> Array:
        """Return a column that the trace has where programs choose, or else the default."""
        if name not in self.trace.column_names:
            return np.broadcast_to(default, len(self.trace))
        return np.asarray(self.trace[name].to_numpy(), dtype=np.float64)

    @property
    def period_ms(self) -> IntArray:
        """The period of each row's reservation as its program told it; 0 if it did not."""
        return self._optional("period_ms", 0)

    @cached_property
    def attempt(self) -> IntArray:
        """Number of the transmission of a frame to a single vehicle, from 1 on; 0 for broadcasts."""
        return self._optional("attempt", 0)

    @cached_property
    def ack_on_air_ns(self) -> IntArray:
        """Begin of the acknowledgement of each row's frame; -1 without one."""
        return self._optional("ack_on_air_ns", -1)

    @cached_property
    def acked(self) -> Mask:
        """Mask of the rows whose frame's sender received an acknowledgement."""
        return self._optional("acked", 0) > 0

    def _optional(self, name: str, default: int) -> IntArray:
        """Return a column that only some traces have, or else the default."""
        if name not in self.trace.column_names:
            return np.broadcast_to(default, len(self.trace))
        return np.asarray(pc.fill_null(self.trace[name].cast(pa.int64()), default).to_numpy(), np.int64)

    @cached_property
    def seq(self) -> IntArray:
        """Sequence number of each row's frame."""
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
    def outcome(self) -> NDArray[np.int8]:
        """Number of each row's outcome. Raises VnetError for one that there is not."""
        code, known = self._outcome
        number = {each.name: each.value for each in Outcome}
        if strange := [name for name in known[:-1] if name not in number]:
            raise VnetError(f"outcome {strange[0]!r} in the trace: there is no such outcome")
        return np.array([*(number[str(name)] for name in known[:-1]), Outcome.pending], dtype=np.int8)[code]

    @cached_property
    def arrived(self) -> Mask:
        """Mask of the rows whose frame came as far as its receiver."""
        return self.outcome_is(*ARRIVED)

    def outcome_is(self, *names: str) -> Mask:
        """Mask of the rows with one of these outcomes."""
        code, known = self._outcome
        some = [code == index for index, name in enumerate(known) if name in names]  # faster than a look-up by row
        return np.logical_or.reduce(some) if some else np.zeros(len(code), dtype=bool)

    @cached_property
    def _outcome(self) -> tuple[NDArray[np.int32], list[str | None]]:
        """The outcome of each row as a code, and the outcomes that the codes stand for."""
        column = self.trace["outcome"].combine_chunks()
        if not pa.types.is_dictionary(column.type):
            column = column.dictionary_encode()
        names = [*column.dictionary.to_pylist(), None]
        code = pc.fill_null(column.indices, len(names) - 1) if column.null_count else column.indices
        return np.asarray(code.to_numpy()), names

    @cached_property
    def placed(self) -> Mask:
        """Mask of the rows for whose instant of sending positions are known."""
        return self.places.known(self.sent_ns)

    @cached_property
    def in_range(self) -> Mask:
        """Mask of the rows whose receiver was known to be in range of the sender."""
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

    @cached_property
    def emissions(self) -> Emissions:
        """The emissions of the trace: grouped once, and by runs of rows, because sorting all rows takes long."""
        is_new = np.ones(len(self.emission), dtype=bool)
        is_new[1:] = self.emission[1:] != self.emission[:-1]
        begins = np.flatnonzero(is_new)
        lengths = np.diff(begins, append=len(is_new))
        _, first, of_run = np.unique(self.emission[begins], return_index=True, return_inverse=True)
        counts = np.bincount(of_run, lengths, len(first)).astype(np.intp)
        return Emissions(begins[first], np.repeat(of_run, lengths), counts)

    @cached_property
    def frame_of_row(self) -> NDArray[np.intp]:
        """Number of each row's frame among all frames of the trace, in the order of `frame`."""
        first, of_row, _ = self.emissions
        return np.asarray(np.unique(self.frame[first], return_inverse=True)[1][of_row])

    def first_rows(self, wanted: Mask) -> NDArray[np.intp]:
        """The first of the rows `wanted` of each emission that has any, in the order of `emission`."""
        rows = np.flatnonzero(wanted)[::-1]  # of several the one assigned last stays
        first = np.full(len(self.emissions.first), -1)
        first[self.emissions.of_row[rows]] = rows
        return first[first >= 0]

    def rows(self, broken: Mask | IntArray | NDArray[np.intp]) -> list[dict[str, Any]]:
        """The first offending rows of the trace, by mask or by number."""
        indices = np.flatnonzero(broken) if broken.dtype == bool else np.asarray(broken)
        listed = self.trace.take(pa.array(np.sort(indices)[:MOST_ROWS].astype(np.int64))).to_pylist()
        return [{**row, "payload_digest": f"{row['payload_digest']:016x}"} for row in listed]

    # The states, as arrays over (period, node).

    @cached_property
    def place(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Period and number of the node of each row of the states."""
        period = np.asarray(self.states["period"].to_numpy(), dtype=np.intp)
        if len(period) and not 0 <= period.min() <= period.max() < len(period):
            raise VnetError(f"states: periods {period.min()} to {period.max()} in {len(period)} rows")
        node = self.states["node"].combine_chunks().dictionary_encode()
        names = [*node.dictionary.to_pylist(), *([None] if node.null_count else [])]
        code = np.array([self.number_of(name) for name in names], dtype=np.intp)
        return period, code[node.indices.to_numpy()]

    @cached_property
    def periods(self) -> int:
        """Number of periods that were kept."""
        return int(self.place[0].max(initial=-1)) + 1

    def vectors(self, name: str) -> Array:
        """A column of points of the states (periods, N, 2); NaN where there is none."""
        return self._spread(self.states[name].combine_chunks(), 2)

    def matrices(self, name: str) -> Array:
        """A column of covariances of the states (periods, N, 2, 2); NaN where there is none."""
        return self._spread(self.states[name].combine_chunks(), 4).reshape(self.periods, -1, 2, 2)

    def _spread(self, column: pa.Array, size: int) -> Array:
        spread = np.full((self.periods, len(self.node_ids), size), np.nan)
        there = np.asarray(column.is_valid())
        period, node = self.place
        flat = np.asarray(column.drop_null().flatten().to_numpy(zero_copy_only=False), dtype=float)
        spread[period[there], node[there]] = flat.reshape(-1, size)
        return spread

    def by_period(self, name: str) -> Array:
        """A column of the states, (periods, N) or (periods, N, size); NaN where there is none."""
        kind = self.states.schema.field(name).type
        if not pa.types.is_fixed_size_list(kind):
            return self.scalars(name)
        return self._spread(self.states[name].combine_chunks(), kind.list_size)

    def scalars(self, name: str) -> Array:
        """A column of numbers of the states (periods, N); NaN where there is none."""
        spread = np.full((self.periods, len(self.node_ids)), np.nan)
        spread[self.place] = numbers_of(self.states[name])
        return spread

    @property
    def reported_names(self) -> list[str]:
        """Names of the columns of the states for what programs report, without `values`."""
        return reported_columns(self.states.schema)

    @cached_property
    def declared(self) -> ProgramFigures:
        """Figures that the program declares; none where it is not installed."""
        return figures_if_here(self.scenario.program)

    @cached_property
    def value_names(self) -> list[str]:
        """Names of the values that have a column of the states, in the order in which they were first reported."""
        return value_columns(self.states.schema)

    def value(self, name: str) -> Array:
        """A number or boolean that programs report by this name (periods, N); NaN where there is none."""
        if name in self.value_names:
            return self.scalars(name)
        lists = pc.map_lookup(self.states["values"].combine_chunks(), name, "first")
        return self._spread(pc.if_else(pc.equal(pc.list_value_length(lists), 1), lists, None), 1)[..., 0]

    @cached_property
    def reported(self) -> Mask:
        """(periods, N), who reported anything in which period."""
        values = self.states["values"].combine_chunks().cast(VALUES_AS_LIST)
        something = np.asarray(pc.fill_null(pc.list_value_length(values), 0)) > 0
        for name in self.reported_names:
            something |= np.asarray(self.states[name].combine_chunks().is_valid())
        reported = np.zeros((self.periods, len(self.node_ids)), dtype=bool)
        reported[self.place] = something
        return reported

    def period_starts_ns(self) -> IntArray:
        """Instant at which each period starts."""
        return np.arange(self.periods, dtype=np.int64) * self.scenario.period_ns

    @property
    def times_s(self) -> Array:
        """Start of each period in s."""
        return self.period_starts_ns() / NS_PER_S

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

    def down_at(self, time_ns: int) -> Mask:
        """Mask (N,) of the nodes that are down at an instant."""
        down = np.zeros(len(self.node_ids), dtype=bool)
        down[[span.node for span in self.down if span.start_ns <= time_ns < span.end_ns]] = True
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
    def cause(self) -> NDArray[np.int32]:
        """The number of the fault that a row names; NO_FAULT, or UNHEARD_OF for a name that no fault has."""
        number = {planned.label: planned.number for planned in self.plan} | {"": NO_FAULT}
        column = self.trace["cause"].cast(pa.string()).combine_chunks().dictionary_encode()
        code = np.array([number.get(name, UNHEARD_OF) for name in column.dictionary.to_pylist()], dtype=np.int32)
        return np.asarray(code[column.indices.to_numpy()] if len(column) else np.zeros(0, np.int32))

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

    def may_reach(self, planned: PlannedFault) -> Mask:
        """Mask of the rows that may have been sent on a link while a fault acted there."""
        later_ns = [0, self.guard_ns, -self.guard_ns] if self.guard_ns else [0]
        return np.asarray(np.logical_or.reduce([self._reached(planned, each_ns, True) for each_ns in later_ns]))

    def may_reach_of(self, *kinds: type[Fault]) -> Mask:
        """Mask of the rows that may have been sent on a link while a fault of one of these classes acted there."""
        reached = np.zeros(len(self.trace), dtype=bool)
        for planned in self.plan:
            if isinstance(planned.fault, kinds):
                reached |= self.may_reach(planned)
        return reached

    def surely_reaches(self, planned: PlannedFault) -> Mask:
        """Mask of the rows that were certainly sent on a link while a fault acted there."""
        later_ns = [self.guard_ns, -self.guard_ns] if self.guard_ns else [0]
        return np.asarray(np.logical_and.reduce([self._reached(planned, each_ns, False) for each_ns in later_ns]))

    def _reached(self, planned: PlannedFault, later_ns: int, where_unknown: bool) -> Mask:
        """The same, as if every row had been sent so much later, and with an answer where positions are unknown."""
        reached = np.zeros(len(self.trace), dtype=bool)
        for start_ns, end_ns, links in self._links_under(planned, where_unknown):
            rows = self.sent_between(start_ns - later_ns, end_ns - later_ns)
            reached[rows] |= links[self.sender[rows], self.receiver[rows]]
        return reached

    def _links_under(self, planned: PlannedFault, where_unknown: bool) -> Iterator[tuple[int, int, Mask]]:
        """The links (N, N), rows are senders, whose rows may name a fault, and from when until when.

        Of the last period, if the run has not completed it, no position is known.
        """
        if planned.moving is None and not (self.moves and planned.fault.follows_vehicles):
            yield from self._connectivity(planned)
            return
        period_ns, count = self.scenario.period_ns, len(self.node_ids)
        end_period = min(-(-planned.end_ns // period_ns), self.periods + 1)
        for period in range(planned.start_ns // period_ns, end_period):
            start_ns = max(planned.start_ns, period * period_ns)
            end_ns = min(planned.end_ns, (period + 1) * period_ns)
            if period >= self.periods and (planned.moving is not None or isinstance(planned.fault, Range)):
                yield start_ns, end_ns, np.full((count, count), where_unknown)
                continue
            for _, _, links in self._connectivity(planned.placed(start_ns), period):
                yield start_ns, end_ns, links

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

    @cached_property
    def dropped_by_sender(self) -> Mask:
        """Mask of the rows of frames that a rule at their sender dropped: they were never enqueued."""
        return np.asarray(self.outcome_is("fault") & self.caused_by("custom_sender"))

    @cached_property
    def never_sent(self) -> Mask:
        """Mask of the rows of frames that never left their sender."""
        return np.asarray(self.outcome_is(*decided_at(Stage.SENDER)) | self.dropped_by_sender)

    @cached_property
    def restarts(self) -> list[tuple[int, int]]:
        """Spans [from, until) of restarts of emulator or router, which are longer than planned in real time."""
        return self._restarts_of(Infrastructure)

    @cached_property
    def holding_restarts(self) -> list[tuple[int, int]]:
        """Those within which the emulator reaches no process: while routers of Zenoh programs restart, it does."""
        return self._restarts_of(EmulatorRestart) if self.scenario.has_gateways else self.restarts

    def _restarts_of(self, family: type[Infrastructure]) -> list[tuple[int, int]]:
        spans = []
        for kind in {planned.fault.kind for planned in self.plan if isinstance(planned.fault, family)}:
            starts_ns = sorted(planned.start_ns for planned in self.plan if planned.fault.kind == kind)
            ends_ns = [event.time_ns for event in self.event(f"{kind}ed")]  # one after another
            spans += list(zip(starts_ns, ends_ns, strict=False))
        return sorted(spans)

    @cached_property
    def last_heal_ns(self) -> int:
        """From when on no fault acts any more; 0 without faults."""
        ends_ns = [end_ns for _, end_ns in self.restarts]
        return max([planned.end_ns for planned in self.plan] + ends_ns, default=0)


class OpenedRun(RecordedRun):
    """A run whose fields are the files of its folder, each read when it is first asked for.

    Others may have written them: they are bounded and typed, and VnetError says in one line what is wrong with one.

    Of the tables that `columns` names, only those columns are read.
    """

    def __init__(self, folder: Path, columns: Columns | None = None) -> None:
        self.folder = folder
        self._columns = columns or {}
        self._tables: dict[Table, pa.Table | None] = {}

    @cached_property
    def scenario_text(self) -> str:
        """The text of scenario.toml."""
        path = self.folder / SCENARIO_FILE
        return self._read(path, lambda: read_regular(path, LARGEST_BYTES).decode("utf-8", "replace"))

    @cached_property
    def scenario(self) -> Scenario:
        """The scenario; the files that it names need not be there any more."""
        return parse_recorded_scenario(self.scenario_text, self.folder / SCENARIO_FILE)

    @cached_property
    def record(self) -> Record:
        """Contents of verdict.json. A format that this vnet does not know is refused."""
        path = self.folder / VERDICT_FILE
        record = self._read(path, lambda: read_record(path))
        if not 1 <= record.format <= FORMAT:
            raise LaterFormatError(
                f"{path}: format {record.format}, of vnet {printable(record.versions.get('vnet', '?'))}; this vnet "
                f"reads 1 to {FORMAT}"
            )
        return replace(record, reproduce=_from_here(record.reproduce, self.folder))

    @cached_property
    def views(self) -> Views:
        """The program's declarations as the folder has them, also where the program is not installed."""
        try:
            kept = self.record.views
        except VnetError:  # a run that was killed
            kept = None
        return self.declared.views if kept is None else kept

    def refuse_later_format(self) -> None:
        """Raise VnetError if the folder is of a later format; its verdict may be missing or broken."""
        try:
            _ = self.record
        except LaterFormatError:
            raise
        except VnetError:
            return

    @cached_property
    def events(self) -> list[Event]:
        """The events, in the order in which they were written; a last line that was cut off is left out."""
        path = self.folder / EVENTS_FILE
        return self._read(path, lambda: parse_events(path, read_regular(path, LARGEST_EVENTS_BYTES)))

    @cached_property
    def world(self) -> RecordedWorld:
        """Contents of world.npz. Folders of format 1 have none: their input files are needed."""
        path = self.folder / WORLD_FILE
        self.refuse_later_format()
        if path.exists():
            return self._read(path, lambda: RecordedWorld.read(path))
        if self.record.format > 1:
            raise not_finished(self.folder, WORLD_FILE)
        try:
            return RecordedWorld.of(build_world(load_scenario(self.folder / SCENARIO_FILE)))
        except ScenarioError as error:
            text = f"{self.folder}: of format 1 (vnet 0.1.0), which needs the run's input files: {error}"
            raise VnetError(text) from None

    @property
    def trace(self) -> pa.Table:
        """A row for each frame and receiver in range."""
        return self.table(TRACE)

    @property
    def states(self) -> pa.Table:
        """A row for each vehicle and period."""
        return self.table(STATES)

    @property
    def metrics(self) -> pa.Table:
        """A row for each period."""
        return self.table(METRICS)

    def table(self, kind: Table) -> pa.Table | None:
        """Return a table; None if the run has none of this kind."""
        if kind not in self._tables:
            there = (self.folder / kind.file).is_file() if kind.is_due is None else self._holds(kind.is_due)
            self._tables[kind] = self._read_table(kind) if there else None
        return self._tables[kind]

    def required(self, kind: Table) -> pa.Table:
        """Return a table that the run must have. Raises VnetError if it is missing."""
        table = self.table(kind)
        return self._read_table(kind) if table is None else table

    @cached_property
    def payloads(self) -> KeptPayloads | None:
        """Payloads of frames; None where the run has kept none."""
        table = self.table(PAYLOADS)
        return None if table is None else KeptPayloads(table)

    # What lies in the folder.

    @property
    def has_record(self) -> bool:
        """True if there is a verdict.json: the run has come to its end."""
        return (self.folder / VERDICT_FILE).exists()

    @property
    def when(self) -> datetime:
        """Local time at which the run ended, or last wrote something. Raises VnetError if the folder is gone."""
        for path in (self.folder / VERDICT_FILE, self.folder / EVENTS_FILE, self.folder):
            try:
                return written_at(path)
            except OSError:
                continue
        raise VnetError(f"{self.folder}: no such folder")

    def _read(self, path: Path, read: Callable[[], T]) -> T:
        """Return what `read` makes of a file; VnetError says in one line what is wrong with it."""
        try:
            return read()
        except FileNotFoundError:
            if is_run_folder(self.folder):
                raise not_finished(self.folder, path.name) from None
            raise VnetError(f"{self.folder}: not a run's folder: there is no {path.name} in it") from None
        except OSError as error:
            raise VnetError(f"{path}: cannot be read: {error.strerror or error}") from None
        except (ValueError, pa.ArrowException) as error:
            raise VnetError(f"{path}: cannot be read: {printable(' '.join(str(error).split()), 300)}") from None

    def _holds(self, condition: Condition) -> bool:
        return condition is always or condition(self.scenario)

    def _read_table(self, kind: Table) -> pa.Table:
        """Return a table with the types that it must have."""
        path = self.folder / kind.file
        self.refuse_later_format()
        if not path.is_file():
            check_is_run(self.folder)
            if path.exists():
                raise VnetError(f"{path}: cannot be read: not a regular file")
            if unkept := [line for line in self._unkept() if Path(line.partition(": ")[0]).name == path.name]:
                raise VnetError(f"{self.folder}: its {VERDICT_FILE} says: not kept: {unkept[0]}")
            raise not_finished(self.folder, path.name)
        wanted = self._columns.get(kind)
        names = None if wanted is None else [*wanted, *self._columns_beside(kind, path, wanted)]
        file = self._read(path, lambda: open_table(path, names))
        self._bound_rows(kind, path, file.metadata.num_rows)
        kept = file.schema_arrow
        columns = self._columns_of(kind)
        for name in wanted or columns:
            column = columns.get(name) or Column(pa.null(), "")
            found = name in kept.names and kept.field(name).type == column.type
            if not found and self._holds(column.is_due):
                raise VnetError(f"{path}: has no column {name!r} of {column.type}")
        threads = file.metadata.num_rows > MOST_ROWS_BY_ONE_THREAD
        table: pa.Table = self._read(path, lambda: file.read(names, use_threads=threads))
        for name in table.column_names:
            if name in columns and not columns[name].has_gaps and table[name].null_count:
                raise VnetError(f"{path}: column {name!r} has gaps")
        return table.unify_dictionaries()

    def _columns_of(self, kind: Table) -> Mapping[str, Column]:
        """Return the columns that a table must have; those that a program declares if the scenario can be read."""
        try:
            return columns_of(kind, self.declared) if kind in (STATES, METRICS) else kind.columns
        except VnetError:
            return kind.columns

    def _unkept(self) -> list[str]:
        """Return a line for each file that the disk refused at the end of the run."""
        try:
            told = [check.figures.get("unkept") for check in self.record.checks]
        except VnetError:
            return []
        return [str(line) for lines in told if isinstance(lines, list) for line in lines]

    def _bound_rows(self, kind: Table, path: Path, rows: int) -> None:
        """Raise VnetError if a table has many times the rows that verdict.json speaks of."""
        try:
            record = self.record
        except VnetError:  # a run that is on, or that was killed
            return
        nodes = record.vehicles + record.roadside_units
        periods = record.emulated_s * NS_PER_S / self.scenario.period_ns + 1
        due = {TRACE: record.in_range, STATES: nodes * periods, METRICS: periods}
        if kind in due and rows > SPARE_ROWS + 2 * due[kind]:
            raise VnetError(f"{path}: {rows:,} rows, where {VERDICT_FILE} speaks of {due[kind]:,.0f}")

    def _columns_beside(self, kind: Table, path: Path, wanted: Collection[str]) -> list[str]:
        """Columns that only some runs have: reported values beside `values`, and what tells unicasts."""
        if kind is TRACE:
            there = self._read(path, lambda: open_table(path, ()).schema_arrow.names)
            beside = [*ACKNOWLEDGED, "on_air_ns"] if "attempt" in there else ACKNOWLEDGED
            return [name for name in beside if name in there and name not in wanted]
        if kind is not STATES or "values" not in wanted:
            return []
        return self._read(path, lambda: value_columns(open_table(path, ()).schema_arrow))


def written_at(path: Path) -> datetime:
    """Return the local time at which a file was last written; that of UTC in a zone that Python does not know.

    TZ may be a whole day away from UTC, and datetime's zones may not. Raises OSError.
    """
    at = datetime.fromtimestamp(path.stat().st_mtime, UTC)
    try:
        return at.astimezone()
    except ValueError:
        return at


def _from_here(command: str, folder: Path) -> str:
    """The command that runs a run again, from any folder, with the path of its scenario as it is called now."""
    try:
        words = shlex.split(command)
    except ValueError:
        return command
    named = [str(folder.absolute() / SCENARIO_FILE) if Path(word).name == SCENARIO_FILE else word for word in words]
    return command if named == words else shlex.join(named)
