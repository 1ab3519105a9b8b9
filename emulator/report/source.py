"""A run's files as reports read them: what is missing or broken is told in one line, and the rest is shown."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import ValidationError

from emulator.pages.canvas import Span
from emulator.records.busy import busy_windows, read_busy
from emulator.records.metrics import STATES as ALL_STATES
from emulator.records.radio_metrics import RadioMetrics, radio_metrics
from emulator.records.recorded_run import RecordedRun
from emulator.records.run_folder import Event, read_events
from emulator.records.verdict_file import Record, read_record
from emulator.scenario.scenario import Scenario
from emulator.scenario.sections import first_problem
from emulator.scenario.toml import LARGEST_BYTES, parse_toml
from vnet.bounded import read_bounded
from vnet.errors import VnetError, printable
from vnet.types import Array

_NAME = pa.dictionary(pa.int32(), pa.string())
# The columns that reports need, and their types.
TRACE = {
    "sent_ns": pa.int64(),
    "sender": _NAME,
    "seq": pa.int64(),
    "receiver": _NAME,
    "outcome": _NAME,
    "cause": pa.string(),
    "arrival_ns": pa.int64(),
    "copy": pa.int16(),
}
ON_AIR = {"left_ns": pa.int64()}
"""A column that the trace has where senders share a medium."""
STATES = {name: ALL_STATES.field(name).type for name in ("period", "time_ns", "node", "position_m", "values")}
FIGURES = (
    "common_error_rmse_m",
    "deviation_m",
    "position_rmse_m",
    "fix_rmse_m",
    "consensus_error_m",
    "common_error_anees",
    "position_anees",
)
METRICS = {"time_ns": pa.int64(), "reporting": pa.int64()} | dict.fromkeys(FIGURES, pa.float64())
CUT = ("interrupted", "stalled")
"""Events that end a run before its time."""
T = TypeVar("T")


@dataclass(frozen=True)
class Source:
    """A run's folder. Its properties read the files, and raise VnetError where one is not there or not vnet's."""

    folder: Path

    @cached_property
    def scenario_text(self) -> str:
        """scenario.toml."""
        path = self.folder / "scenario.toml"
        try:
            return read_bounded(path, LARGEST_BYTES).decode("utf-8", "replace")
        except (OSError, ValueError) as error:
            raise VnetError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None

    @cached_property
    def scenario(self) -> Scenario:
        """The scenario; files that it names need not be there any more."""
        path = self.folder / "scenario.toml"
        try:
            data = parse_toml(self.scenario_text)
            data.pop("inputs", None)
            return Scenario.model_validate(data)
        except ValidationError as error:
            raise VnetError(f"{path}: {first_problem(error, Scenario)}") from None
        except ValueError as error:
            raise VnetError(f"{path}: not valid TOML: {printable(str(error), 300)}") from None

    @cached_property
    def record(self) -> Record:
        """verdict.json."""
        return read_record(self.folder)

    @cached_property
    def events(self) -> list[Event]:
        """events.jsonl."""
        try:
            events = read_events(self.folder)
        except (KeyError, TypeError, AttributeError, ValueError, RecursionError) as error:
            raise VnetError(f"{self.folder / 'events.jsonl'}: not vnet's events: {error!r}") from None
        for event in events:
            if type(event.time_ns) is not int or not isinstance(event.kind, str):
                raise VnetError(f"{self.folder / 'events.jsonl'}: not vnet's events: {event.kind!r}")
        return events

    @cached_property
    def busy_ratio(self) -> Array:
        """(windows, N), how busy each vehicle found the medium. Raises VnetError if senders share none."""
        if self.scenario.radio.mac is None:
            raise VnetError("no MAC configured ([radio.mac])")
        windows = busy_windows(read_busy(self.folder), self.recorded.node_ids)
        if not len(windows):
            raise VnetError("the run was over within the first window")
        return windows

    @cached_property
    def recorded(self) -> RecordedRun:
        """The tables, so far as reports need them, as arrays."""
        on_air = {} if self.scenario.radio.mac is None else ON_AIR
        trace, states = self._table("trace", TRACE | on_air), self._table("states", STATES)
        busy = maybe(lambda: read_busy(self.folder)) if on_air else None
        not_needed = pa.table({})  # the metrics: what can be drawn without them is drawn
        return RecordedRun(self.scenario, trace, states, not_needed, self.events, busy=busy)

    @cached_property
    def radio(self) -> RadioMetrics:
        """The radio in figures."""
        return radio_metrics(self.recorded)

    @cached_property
    def metrics(self) -> pa.Table:
        """metrics.parquet."""
        return self._table("metrics", METRICS)

    def _table(self, name: str, columns: dict[str, pa.DataType]) -> pa.Table:
        path = self.folder / f"{name}.parquet"
        try:
            table = pq.read_table(path, columns=list(columns))
        except FileNotFoundError:
            raise VnetError(f"{path.name} is not there") from None
        except (OSError, pa.ArrowException) as error:
            raise VnetError(f"{path.name} cannot be read: {error}") from None
        for column, kind in columns.items():
            if column not in table.column_names or table.schema.field(column).type != kind:
                raise VnetError(f"{path.name} has no column {column} of {kind}")
        return table.unify_dictionaries()

    # Metrics, events and times, as the figures need them.

    @cached_property
    def time_s(self) -> Array:
        """(periods,) when the periods of the metrics start."""
        return np.asarray(self.metrics["time_ns"].to_numpy() / 1e9)

    def metric(self, name: str) -> Array:
        """(periods,) a column of the metrics; NaN where nobody reported. Raises VnetError if nobody ever did."""
        column = np.asarray(self.metrics[name].cast(pa.float64()).to_numpy(zero_copy_only=False), dtype=float)
        if not np.isfinite(column).any():
            raise VnetError("no program reported what it needs")
        return np.where(np.isfinite(column), column, np.nan)

    @cached_property
    def end_s(self) -> float:
        """When the run ended, or what is kept of it does; more than zero."""
        if found := maybe(lambda: self.record.emulated_s):
            return found
        last_ns = max((event.time_ns for event in maybe(lambda: self.events) or ()), default=0)
        return last_ns / 1e9 or (maybe(lambda: self.scenario.run.duration_s) or 1.0)

    @cached_property
    def spans(self) -> list[Span]:
        """When faults acted, as the events say."""
        started: dict[str, float] = {}
        spans = []
        for event in maybe(lambda: self.events) or ():
            label = printable(str(event.details.get("fault")))
            if event.kind == "fault_started":
                started[label] = event.time_ns / 1e9
            elif event.kind == "fault_ended" and label in started:
                spans.append(Span(label, started.pop(label), event.time_ns / 1e9))
        return spans + [Span(label, start_s, max(start_s, self.end_s)) for label, start_s in started.items()]

    @cached_property
    def cut(self) -> Event | None:
        """The event that ended the run before its time."""
        return next((event for event in maybe(lambda: self.events) or () if event.kind in CUT), None)

    @property
    def when(self) -> datetime:
        """When the run ended, or was last heard of. Raises VnetError if the folder is gone."""
        return when(self.folder)


def when(folder: Path) -> datetime:
    """When a run ended, or was last heard of, in local time. Raises VnetError if the folder is gone."""
    for path in (folder / "verdict.json", folder / "events.jsonl", folder):
        try:
            return datetime.fromtimestamp(path.stat().st_mtime).astimezone()
        except OSError:
            continue
    raise VnetError(f"{folder}: no such folder")


def maybe(read: Callable[[], T]) -> T | None:
    """What `read` returns, or None where it meets a VnetError."""
    try:
        return read()
    except VnetError:
        return None


def why_not(read: Callable[[], object]) -> str:
    """Why `read` raises VnetError; "" where it does not."""
    try:
        read()
    except VnetError as error:
        return str(error)
    return ""
