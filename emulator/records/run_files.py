"""The files of a run's folder, as files that others may have written: bounded, typed, and wrong in one line.

Nothing else opens them. `recorded_run` makes arrays of them, and says what they mean together.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import pyarrow as pa
import pyarrow.parquet as pq

from emulator.radio.trace import ACKNOWLEDGED
from emulator.records.events import Event, parse_events
from emulator.records.payloads import KeptPayloads
from emulator.records.period_figures import PeriodFigures
from emulator.records.recorded_world import RecordedWorld
from emulator.records.reported import value_columns
from emulator.records.run_folder import (
    EVENTS_FILE,
    FORMAT,
    SCENARIO_FILE,
    VERDICT_FILE,
    WORLD_FILE,
)
from emulator.records.run_tables import StatesReader, TableFile, TraceReader, open_table
from emulator.records.tables import METRICS, PAYLOADS, STATES, TRACE, Table
from emulator.records.verdict_file import Record, read_record
from emulator.scenario.recorded import parse_recorded_scenario
from emulator.scenario.scenario import Scenario, load_scenario
from emulator.scenario.toml import LARGEST_BYTES
from emulator.world.world import build_world
from vnet.bounded import read_regular
from vnet.errors import ScenarioError, VnetError, printable
from vnet.units import NS_PER_S

LARGEST_EVENTS_BYTES = 1 << 28
SPARE_ROWS = 1_000_000
"""Rows that every table may have, whatever verdict.json says."""
MARKS = (SCENARIO_FILE, VERDICT_FILE, EVENTS_FILE)
"""A folder with any of these is a run's."""
WITH_UNICASTS = ACKNOWLEDGED
"""Columns that the trace has where programs send to single vehicles; without them every row is a broadcast's."""
Columns = Mapping[Table, Collection[str]]
T = TypeVar("T")


class LaterFormatError(VnetError):
    """A folder is of a format that a later vnet writes."""


class RunFiles:
    """A run's folder. Each file is read when it is first asked for; VnetError says what is wrong with it.

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
            there = (self.folder / kind.file).is_file() if kind.is_due is None else kind.is_due(self.scenario)
            self._tables[kind] = self._read_table(kind) if there else None
        return self._tables[kind]

    @cached_property
    def payloads(self) -> KeptPayloads | None:
        """Payloads of frames; None where the run has kept none."""
        table = self.table(PAYLOADS)
        return None if table is None else KeptPayloads(table)

    # Tables a piece at a time.

    def trace_reader(self, number: Mapping[str, int]) -> TraceReader:
        """The trace forward in time; `number` gives each node's."""
        return TraceReader(self.folder / TRACE.file, number)

    def states_reader(self, number: Mapping[str, int]) -> StatesReader:
        """The states period by period; `number` gives each node's."""
        return StatesReader(self.folder / STATES.file, number, self.scenario.period_ns)

    def figures(self) -> list[PeriodFigures]:
        """The rows of the metrics. Raises VnetError unless there is one for each period in turn."""
        file = TableFile(self.folder / METRICS.file, list(METRICS.columns))
        figures = [PeriodFigures(**row) for piece in file.pieces() for row in piece.to_pylist()]
        if [row.period for row in figures] != list(range(len(figures))):
            raise file.error("its rows are not those of one period after the other")
        return figures

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
                return datetime.fromtimestamp(path.stat().st_mtime).astimezone()
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
        for name in wanted or kind.columns:
            column = kind.columns[name]
            found = name in kept.names and kept.field(name).type == column.type
            if not found and column.is_due(self.scenario):
                raise VnetError(f"{path}: has no column {name!r} of {column.type}")
        table: pa.Table = self._read(path, lambda: pq.read_table(path.absolute(), columns=names))
        for name in table.column_names:
            if name in kind.columns and not kind.columns[name].has_gaps and table[name].null_count:
                raise VnetError(f"{path}: column {name!r} has gaps")
        return table.unify_dictionaries()

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
            beside = [*WITH_UNICASTS, "on_air_ns"] if "attempt" in there else WITH_UNICASTS
            return [name for name in beside if name in there and name not in wanted]
        if kind is not STATES or "values" not in wanted:
            return []
        return self._read(path, lambda: value_columns(open_table(path, ()).schema_arrow))


def _from_here(command: str, folder: Path) -> str:
    """The command that runs a run again, from any folder, with the path of its scenario as it is called now."""
    try:
        words = shlex.split(command)
    except ValueError:
        return command
    named = [str(folder.absolute() / SCENARIO_FILE) if Path(word).name == SCENARIO_FILE else word for word in words]
    return command if named == words else shlex.join(named)


def is_run_folder(folder: Path) -> bool:
    """Return whether a folder is that of a run, broken ones included."""
    return any((folder / mark).is_file() for mark in MARKS)


def check_is_run(folder: Path) -> None:
    """Raise VnetError if the folder has no scenario, and so is not a run's."""
    if not (folder / SCENARIO_FILE).is_file():
        raise VnetError(f"{folder}: not a run's folder: there is no {SCENARIO_FILE} in it")


def check_is_finished(folder: Path) -> None:
    """Raise VnetError if the folder is that of a run without a verdict: it is on, or was killed."""
    if (folder / SCENARIO_FILE).is_file() and not (folder / VERDICT_FILE).exists():
        raise not_finished(folder, VERDICT_FILE)


def not_finished(folder: Path, name: str) -> VnetError:
    """Return the error for a run's folder without a file that the end of a run writes; it says what to do."""
    text = f"{folder}: not the folder of a finished run: there is no {name} in it"
    scenario = folder / SCENARIO_FILE
    if (folder / VERDICT_FILE).exists() or not scenario.is_file():
        return VnetError(text)
    again = f"vnet run {shlex.quote(str(scenario))}"
    return VnetError(f"{text}: it is on, or was killed, which leaves no tables; {again} makes the run again")
