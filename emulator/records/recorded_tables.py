"""A run's tables as arrays: its nodes, where they were, the trace column by column, the states by period."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from emulator.radio.connectivity import connectivity_of
from emulator.radio.dot11p import airtimes_ns
from emulator.radio.outcomes import Stage, decided_at
from emulator.radio.trace import LATE
from emulator.records.busy import busy_windows
from emulator.records.positions import Places
from emulator.records.recorded_world import RecordedWorld
from emulator.records.reported import numbers_of, value_columns
from emulator.records.run_folder import Event
from emulator.records.run_tables import VALUES_AS_LIST
from emulator.records.verdicts import MOST_ROWS
from emulator.scenario.scenario import Scenario
from emulator.world.link_table import LinkTable
from emulator.world.links import load_links
from emulator.world.neighbours import Links
from emulator.world.radio_inputs import RadioInputs
from vnet.errors import VnetError
from vnet.types import Array, IntArray, Mask

ARRIVED = decided_at(Stage.ARRIVAL)
ON_AIR = decided_at(Stage.RECEPTION, Stage.ARRIVAL)
"""Outcomes of receptions that get as far as the receiver's radio."""


@dataclass(frozen=True)
class RecordedTables:
    """The scenario, the three tables, and the events."""

    scenario: Scenario
    trace: pa.Table
    states: pa.Table
    metrics: pa.Table
    events: Sequence[Event]
    known_m: Array | None = None
    """True positions (periods, N, 2), where the states have not got them all."""
    busy: pa.Table | None = None
    """busy.parquet, where there is a MAC."""
    world: RecordedWorld | None = None
    """world.npz."""
    driven: pa.Table | None = None
    """driven.parquet, where programs drive."""
    backbone: pa.Table | None = None
    """backbone.parquet, where there are roadside units."""
    background: pa.Table | None = None
    """background.parquet, where SUMO is stepped with the run."""

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
        """Duration of each row's transmission, but for throttles."""
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
            return np.full(len(self.trace), default)
        return np.asarray(self.trace[name].to_numpy(), dtype=np.float64)

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
            return np.full(len(self.trace), default)
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
    def arrived(self) -> Mask:
        """Mask of the rows whose frame came as far as its receiver."""
        return self.outcome_is(*ARRIVED)

    def outcome_is(self, *names: str) -> Mask:
        """Mask of the rows with one of these outcomes."""
        code, known = self._outcome
        return np.asarray(np.array([name in names for name in known])[code], dtype=bool)

    @cached_property
    def _outcome(self) -> tuple[NDArray[np.intp], list[str | None]]:
        """The outcome of each row as a code, and the outcomes that the codes stand for."""
        column = self.trace["outcome"].combine_chunks()
        if not pa.types.is_dictionary(column.type):
            column = column.dictionary_encode()
        names = [*column.dictionary.to_pylist(), None]
        code = pc.fill_null(column.indices, len(names) - 1) if column.null_count else column.indices
        return np.asarray(code.to_numpy(), dtype=np.intp), names

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

    def rows(self, broken: Mask | IntArray | NDArray[np.intp]) -> list[dict[str, Any]]:
        """The first offending rows of the trace, by mask or by number."""
        indices = np.flatnonzero(broken) if broken.dtype == bool else np.asarray(broken)
        listed = self.trace.take(pa.array(np.sort(indices)[:MOST_ROWS].astype(np.int64))).to_pylist()
        return [{**row, "payload_digest": f"{row['payload_digest']:016x}"} for row in listed]

    # The states, as arrays over (period, node).

    @cached_property
    def _place(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
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
        return int(self._place[0].max(initial=-1)) + 1

    def vectors(self, name: str) -> Array:
        """A column of points of the states (periods, N, 2); NaN where there is none."""
        return self._spread(self.states[name].combine_chunks(), 2)

    def matrices(self, name: str) -> Array:
        """A column of covariances of the states (periods, N, 2, 2); NaN where there is none."""
        return self._spread(self.states[name].combine_chunks(), 4).reshape(self.periods, -1, 2, 2)

    def _spread(self, column: pa.Array, size: int) -> Array:
        spread = np.full((self.periods, len(self.node_ids), size), np.nan)
        there = np.asarray(column.is_valid())
        period, node = self._place
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
        spread[self._place] = numbers_of(self.states[name])
        return spread

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
        for name in ("estimate_m", "common_error_estimate_m", "mean_m", "stacked_common_error_m", "cloud_m"):
            something |= np.asarray(self.states[name].combine_chunks().is_valid())
        for name in self.value_names:
            something |= np.asarray(self.states[name].combine_chunks().is_valid())
        reported = np.zeros((self.periods, len(self.node_ids)), dtype=bool)
        reported[self._place] = something
        return reported

    def period_starts_ns(self) -> IntArray:
        """Instant at which each period starts."""
        return np.arange(self.periods, dtype=np.int64) * self.scenario.period_ns
