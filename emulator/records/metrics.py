"""The figures of a run, period by period (MODEL 6), and those of the reference that its program declares.

`states` has a row for each node and period, `metrics` one for each period: how wrong the vehicles are, and what
their program declares. What programs do not report is null.

The reference is an estimator that is told more than any vehicle, run over a run. The declared module names its
class as `REFERENCE = "module:class"`. Its figures stand beside those of the run that have their names.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, make_dataclass
from functools import cached_property
from keyword import iskeyword
from typing import Any, ClassVar, Protocol

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from emulator.radio.topology import component_links
from emulator.records.distributions import chi2_quantile
from emulator.records.period_figures import (
    NUMBER,
    Period,
    ProgramFigures,
    figures_if_here,
    figures_of,
    program_figures,
    vectors,
)
from emulator.records.recorded_run import RecordedRun
from emulator.records.reported import ValueColumns, figures_among
from emulator.records.tables import ARROW, METRICS, STATES, TRUTH, by_instant, columns_of, schema_of
from emulator.scenario.own_functions import declared, load_entry, told
from emulator.scenario.program import Program
from emulator.scenario.scenario import Scenario
from emulator.world.world import Instant, components
from vnet.errors import VnetError, shown
from vnet.reports import Report, Value
from vnet.runtime.programs import search_programs_in
from vnet.types import Array

ROWS_A_PIECE = 2048
"""Largest number of states kept as Python numbers, except for the rest of a period."""


class Metrics:
    """Collects reports and truth. `component` (N,) labels each node's connected component; -1 if not there."""

    def __init__(
        self, node_ids: Sequence[str], component: NDArray[np.intp], period_ns: int, program: Program | None = None
    ) -> None:
        self._program = program or Program()
        self._number = {node: number for number, node in enumerate(node_ids)}
        self._node_ids = list(node_ids)
        self._component = component
        self._period_ns = period_ns
        self._rows: list[Any] = []
        self._waiting: list[Period] = []
        """Periods whose reports are the last of `_states`, and whose figures nobody has asked for yet."""
        self._recorded = 0
        self._instants: list[Instant] = []
        """Truth of the periods whose reports are in `_states`."""
        self._states: dict[str, list[Any]] = {}
        self._values = ValueColumns()
        self.on_failure: Callable[[int, str, str, str], None] = lambda *failure: None
        """Called where the program's figures fail: with the time in ns, their entry, and how, in one line and long.

        They are unknown from then on.
        """
        self._packed: list[pa.Table] = []
        self._table: pa.Table | None = None

    @cached_property
    def declared(self) -> ProgramFigures:
        """Declaration of the program. Raises ScenarioError for what cannot be."""
        search_programs_in(self._program.folders)
        return program_figures(self._program)

    @cached_property
    def schema(self) -> pa.Schema:
        """The columns of the states, without those of reported values."""
        return schema_of(columns_of(STATES, self.declared))

    @property
    def rows(self) -> list[Any]:
        """The figures of all periods so far: `PeriodFigures`, with those that the program declares."""
        self._compute()
        return self._rows

    def record(
        self, instant: Instant, reports: Sequence[Report], component: NDArray[np.intp] | None = None
    ) -> None:
        """Take the last report of each node in one period.

        Where vehicles move, `component` is that of the period.
        """
        if component is not None:
            self._component = component
        last = {report.node: report for report in reports}
        not_finite = sum(map(_is_not_finite, reports))
        self._waiting.append(Period(instant, self._component, len(last), not_finite))
        self._store(instant, last)

    def _compute(self) -> None:
        """Compute the figures of the periods that wait: many at once cost little more than one."""
        if not self._waiting:
            return
        first = (len(self._instants) - len(self._waiting)) * len(self._node_ids)
        of = self.declared
        reported = {name: vectors(self._states[name][first:], size) for name, size in of.vectors.items()}
        rows, failure = figures_of(self._waiting, reported, of)
        self._rows += rows
        self._waiting = []
        if failure is not None:
            period, error = failure
            self.declared = of.absent()
            self.on_failure(period.instant.time_ns, of.entry, str(error), error.where)

    def _store(self, instant: Instant, last: dict[str, Report]) -> None:
        states, count = self._states, len(self._node_ids)
        if not states:
            states |= {name: [] for name in self.schema.names if name not in TRUTH}
        self._instants.append(instant)
        self._table = None
        reports = [last.get(node) for node in self._node_ids]
        states["estimate_m"] += [None if report is None else report.estimate_m for report in reports]
        states["covariance_m2"] += [None if report is None else report.covariance_m2 for report in reports]
        values = [{} if report is None else report.values for report in reports]
        for name, column in self.declared.columns.items():
            states[column.name] += [_fitting(each.get(name), column.size) for each in values]
        first_row = self._recorded * count
        states["values"] += [self._other_values(row, each) for row, each in enumerate(values, first_row)]
        self._recorded += 1
        if len(self._instants) * count >= ROWS_A_PIECE:
            self._pack()

    def _other_values(self, row: int, values: Mapping[str, Value]) -> list[tuple[str, list[float]]]:
        """Put the figures of a row of the states into columns; returns the values that have none."""
        others: list[tuple[str, list[float]]] = []
        if not values:
            return others
        figures, declared = figures_among(values, self.declared), self.declared.columns
        for name, value in sorted(values.items()):
            has_column = name in figures and self._values.put(row, name, figures[name])
            if not has_column and not isinstance(value, str) and name not in declared:
                others.append((name, value if isinstance(value, list) else [value]))
        return others

    def _pack(self) -> None:
        """Put the rows so far into a table: as Python's numbers they take up many times the room."""
        self._compute()
        if self._instants:
            columns = {**_truth(self._instants, self._node_ids), **self._states}
            self._packed.append(pa.table(columns, self.schema))
        self._instants, self._states = [], {}

    def states_table(self) -> pa.Table:
        """A row for each node and period; the columns of `STATES`, then those of reported values."""
        if self._table is None:
            self._pack()
            packed = pa.concat_tables(self._packed) if self._packed else self.schema.empty_table()
            self._table = self._values.add_to(packed.unify_dictionaries())
        return self._table

    def metrics_table(self) -> pa.Table:
        """A row for each period; columns are the fields of `PeriodFigures`, and those that the program declares."""
        schema = schema_of(columns_of(METRICS, self.declared))
        return pa.table({name: [getattr(row, name) for row in self.rows] for name in schema.names}, schema)

    def sha256(self) -> str:
        """A hash of the metrics' content, bit by bit."""
        return sha256_of_rows(self.rows)


def sha256_of_rows(rows: Sequence[Any]) -> str:
    """Return a hash of the figures of all periods, bit by bit."""
    return hashlib.sha256(repr(list(rows)).encode()).hexdigest()


def rows_of(metrics: pa.Table) -> list[Any]:
    """Return the rows of a table of metrics, with all columns that it has."""
    types = {each.name: [name for name, kind in ARROW.items() if kind == each.type] for each in metrics.schema}
    known = {name: kind[0] for name, kind in types.items() if kind and _is_name(name)}
    row = make_dataclass("PeriodFigures", known.items(), frozen=True)
    return [row(**each) for each in metrics.select(list(known)).to_pylist()]


def _is_name(name: str) -> bool:
    return name.isidentifier() and not iskeyword(name)


def _truth(instants: Sequence[Instant], node_ids: Sequence[str]) -> dict[str, pa.Array]:
    """Return the columns of the states that reports have no part in."""
    count = len(node_ids)
    common_m = np.array([instant.common_error_m for instant in instants])
    points = {
        "position_m": np.concatenate([instant.position_m for instant in instants]),
        "fix_m": np.concatenate([instant.fix_m for instant in instants]),
        "common_error_m": np.repeat(common_m, count, axis=0),
    }
    return {
        "period": pa.array(np.repeat(np.array([instant.period for instant in instants], np.int32), count)),
        **by_instant([instant.time_ns for instant in instants], node_ids),
        "heading_rad": pa.array(np.concatenate([instant.heading_rad for instant in instants])),
        **{name: pa.FixedSizeListArray.from_arrays(array.ravel(), 2) for name, array in points.items()},
    }


def summarize(rows: Sequence[Any]) -> dict[str, float | None]:
    """Means over the run after its first fifth, in which filters find their feet; nothing without periods."""
    settled = rows[len(rows) // 5 :]
    names = [each.name for each in fields(rows[0]) if each.type == NUMBER] if rows else []
    summary: dict[str, float | None] = {}
    for name in names:
        values = [value for row in settled if (value := getattr(row, name)) is not None]
        summary[name] = float(np.mean(values)) if values else None
    return summary


def _fitting(value: Value | None, size: int | None) -> Value | None:
    """Return a reported value, or None if it is no list of the size of its column."""
    return value if isinstance(value, list) and size in (None, len(value)) else None


def anees_band(samples: int) -> tuple[float, float]:
    """The 95 % band of the mean of so many independent samples of two degrees of freedom, 1 being consistent."""
    degrees = 2 * samples
    return chi2_quantile(0.025, degrees) / degrees, chi2_quantile(0.975, degrees) / degrees


def _is_not_finite(report: Report) -> bool:
    """Return whether any number of a report is NaN or infinite."""
    numbers = [*(report.estimate_m or ()), *(report.covariance_m2 or ())]
    for value in report.values.values():
        if not isinstance(value, str):
            numbers += value if isinstance(value, list) else [value]
    return not all(map(math.isfinite, numbers))


@dataclass(frozen=True)
class Setting:
    """The inputs of a reference.

    `component` (N,) labels each vehicle's component; `periods` is the number of a run that is over.
    """

    scenario: Scenario
    component: NDArray[np.integer[Any]]
    lane_point_m: Array
    lane_heading_rad: Array
    periods: int | None = None


class Reference(Protocol):
    """A reference. It raises VnetError in one line for a setting in which there is none."""

    NAME: ClassVar[str]
    """Its name in legends."""
    TEXT: ClassVar[str]
    """Its description, a noun phrase."""
    COLUMNS: ClassVar[tuple[str, ...]]
    """The columns of the states that it needs."""

    def __init__(self, setting: Setting) -> None: ...

    def step(self, time_ns: int, states: Mapping[str, Array]) -> Mapping[str, float | list[float]]:
        """Take a period, in which each column has a row for each vehicle; returns figures by name.

        A figure with a value for each component is a list. No figures where there is nothing to compare with.
        """


class ReferenceFailedError(VnetError):
    """The reference of a program fails, or returns what is not a figure."""


class DeclaredReference:
    """The reference that a scenario's program declares. Raises VnetError if it declares none.

    Whatever of it fails, or has another type, is a ReferenceFailedError that names it.
    """

    def __init__(self, scenario: Scenario) -> None:
        entries = declared(scenario.program, "REFERENCE")
        if not entries:
            raise VnetError("the program declares no reference")
        self._kind, self.what = load_entry(entries[0]), f"REFERENCE {entries[0]}"
        with named(self.what):
            self.name, self.text = str(self._kind.NAME), str(self._kind.TEXT)
            columns = tuple(map(str, self._kind.COLUMNS))
        known = columns_of(STATES, figures_if_here(scenario.program))
        if unknown := [name for name in columns if name not in known]:
            raise ReferenceFailedError(f"{self.what}: {shown(unknown[0])} is no column of the states")
        self.columns = {name: known[name] for name in columns}

    def begin(self, setting: Setting) -> Callable[[int, Mapping[str, Array]], dict[str, float | list[float]]]:
        """Return `Reference.step` of one that is made for this setting."""
        with named(self.what):
            made: Reference = self._kind(setting)

        def step(time_ns: int, states: Mapping[str, Array]) -> dict[str, float | list[float]]:
            with named(self.what):
                found = made.step(time_ns, states).items()
                return {
                    name: [float(one) for one in each] if isinstance(each, list) else float(each)
                    for name, each in found
                }

        return step


@contextmanager
def named(what: str) -> Iterator[None]:
    """Raise ReferenceFailedError, which names `what` and its line, for an exception of a program's code."""
    try:
        yield
    except VnetError:
        raise
    except (Exception, SystemExit) as error:
        raise ReferenceFailedError(f"{what} {told(error, __file__)[0]}") from error


def reference_series(recorded: RecordedRun) -> dict[str, Array]:
    """Return the figures of a run's reference by name, (periods,) or (periods, components); NaN where it has none.

    Of the states the columns that the reference names are needed. Raises VnetError with the reason if the run has
    no reference.
    """
    scenario, world = recorded.scenario, recorded.world
    reference = DeclaredReference(scenario)
    if world is None:
        raise VnetError("the lanes of the run were not recorded")
    links = component_links(scenario, world.radio_inputs, world.position_m)
    component = components(world.position_m, links)
    setting = Setting(scenario, component, world.lane_point_m, world.lane_heading_rad, recorded.periods)
    step = reference.begin(setting)
    columns = {name: recorded.by_period(name) for name in reference.columns}
    rows = [
        step(k * scenario.period_ns, {name: column[k] for name, column in columns.items()})
        for k in range(recorded.periods)
    ]
    some = next(filter(None, rows), None)
    if some is None:
        raise VnetError(f"no program reported what the {reference.name} is compared with")
    missing = {name: np.full_like(value, np.nan, dtype=float) for name, value in some.items()}
    with named(reference.what):  # lists of different lengths
        return {name: np.array([row.get(name, missing[name]) for row in rows], dtype=float) for name in some}
