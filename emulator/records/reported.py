"""Values that programs report by names of their own: columns of the states, and a run's figures of them.

Numbers, booleans and texts have a column each. Lists stay in the column `values`, as do further names once there
are `MOST_COLUMNS`, and what a program declares to be a value of each pair of vehicles (`delay_ms.v03`).
"""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from emulator.records.period_figures import ProgramFigures
from emulator.records.tables import STATES, TRUTH, VALUES_AS_LIST
from vnet.reports import Value
from vnet.types import Array
from vnet.units import label_of

MOST_COLUMNS = 64
"""Names that have a column: a table of thousands of columns would help nobody."""
MOST_DOTTED = 32
"""Names with a dot among them: figures of each peer (`delay_ms.v03`) leave room for a program's others."""
Figure = bool | float | str
"""Types of a figure."""
TEXT = pa.dictionary(pa.int32(), pa.string())
"""Type of a column of texts."""
_BOOLEAN, _NUMBER, _TEXT = range(3)


def figures_among(values: Mapping[str, Value], declared: ProgramFigures) -> dict[str, Figure]:
    """Return the figures among the values of one report: numbers, booleans and texts with names of their own."""
    return {
        name: value
        for name, value in values.items()
        if not isinstance(value, list)
        and _is_name(name)
        and name not in declared.columns
        and not declared.is_of_peer(name)
    }


@lru_cache(maxsize=4096)  # asked of each value of each report
def _is_name(name: str) -> bool:
    return name.partition(".")[0].isidentifier() and name not in STATES.columns


@dataclass
class _Column:
    """The values of one name: their rows, their kinds, and numbers; of a text the number is its index."""

    row: array[int] = field(default_factory=lambda: array("q"))
    kind: array[int] = field(default_factory=lambda: array("b"))
    number: array[float] = field(default_factory=lambda: array("d"))


class ValueColumns:
    """Collects the values of the states' rows."""

    def __init__(self) -> None:
        self._columns: dict[str, _Column] = {}
        self._text_index: dict[str, int] = {}
        self._dotted = 0

    def put(self, row: int, name: str, value: Figure) -> bool:
        """Take a figure of a row; returns false for one that has no column."""
        column = self._columns.get(name)
        if column is None:
            if len(self._columns) == MOST_COLUMNS or ("." in name and self._dotted == MOST_DOTTED):
                return False
            self._dotted += "." in name
            column = self._columns[name] = _Column()
        column.row.append(row)
        if isinstance(value, str):
            column.kind.append(_TEXT)
            column.number.append(self._text_index.setdefault(value, len(self._text_index)))
        else:
            column.kind.append(_BOOLEAN if isinstance(value, bool) else _NUMBER)
            column.number.append(value)
        return True

    def add_to(self, states: pa.Table) -> pa.Table:
        """Return the states with a column for each name, in the order in which names were first reported."""
        for name, column in self._columns.items():
            states = states.append_column(name, self._spread(column, len(states)))
        return states

    def _spread(self, column: _Column, rows: int) -> pa.Array:
        """Return a column: of numbers if there is any; where vehicles disagree, texts do not spoil its mean."""
        row = np.frombuffer(column.row, dtype=np.int64)
        kind = np.frombuffer(column.kind, dtype=np.int8)
        number = np.frombuffer(column.number, dtype=float)
        missing = np.ones(rows, dtype=bool)
        if (kind == _TEXT).all():
            return self._texts(row, number, rows)
        missing[row[kind != _TEXT]] = False
        spread = np.zeros(rows)
        spread[row] = number
        if (kind != _NUMBER).all():
            return pa.array(spread.astype(bool), mask=missing)
        return pa.array(spread, mask=missing)

    def _texts(self, row: NDArray[Any], number: NDArray[Any], rows: int) -> pa.Array:
        """Return a column of texts."""
        known = list(self._text_index)
        texts: list[str | None] = [None] * rows
        for i, value in zip(row.tolist(), number.tolist(), strict=True):
            texts[i] = known[int(value)]
        return pa.array(texts, pa.string()).dictionary_encode()


def reported_columns(schema: pa.Schema) -> list[str]:
    """Return the names of all columns of what programs report, without `values`, which has what has no column."""
    return [name for name in schema.names if name not in (*TRUTH, "values")]


def value_columns(schema: pa.Schema) -> list[str]:
    """Return the names of the columns of reported values in the states' schema."""
    names = [each.name for each in schema if _is_name(each.name)]
    return [name for name in names if _is_value(schema.field(name).type)][:MOST_COLUMNS]


def _is_value(kind: pa.DataType) -> bool:
    return bool(kind == pa.float64() or kind == pa.bool_() or kind == TEXT or kind == pa.string())


def numbers_of(column: pa.ChunkedArray) -> Array:
    """Return a column of numbers or booleans as floats (rows,); NaN where nothing, or a text, was reported."""
    if is_text(column.type):
        return np.full(len(column), np.nan)
    return np.asarray(column.cast(pa.float64()).to_numpy(zero_copy_only=False), dtype=float)


def named_numbers(column: pa.Array, prefix: str) -> tuple[NDArray[np.intp], pa.Array, Array]:
    """Return row, name and number (n,) of each value in a column `values` whose name begins with `prefix`.

    Lists of more or fewer numbers than one are left out.
    """
    lists = column.cast(VALUES_AS_LIST)
    entries = lists.flatten()
    name, value = pc.struct_field(entries, "key"), pc.struct_field(entries, "value")
    one = pc.and_(pc.starts_with(name, prefix), pc.equal(pc.list_value_length(value), 1))
    row = pc.list_parent_indices(lists).filter(one).to_numpy()
    return row, name.filter(one), np.asarray(value.filter(one).flatten(), dtype=float)


@dataclass(frozen=True)
class ReportedFigure:
    """A value that programs report, over the run: all reports of all vehicles count alike.

    Of a boolean the numbers are shares of those that are true; of a text there is the most frequent one instead.
    """

    reports: int
    """Number of reports with a finite number, or with a text."""
    mean: float | None = None
    p05: float | None = None
    """5th percentile."""
    p95: float | None = None
    """95th percentile."""
    last: float | None = None
    """Mean over the vehicles of each one's last report: of a counter, how far it came."""
    is_share: bool = False
    """True for a boolean."""
    text: str | None = None
    """The most frequent text."""
    share: float | None = None
    """Share of the reports that have this text."""

    def words(self, name: str) -> tuple[str, str, str, str]:
        """Return its title with the unit, mean, 5 to 95 %, and the end of the run, for people."""
        title = label_of(name)
        if self.text is not None:
            return title, f"{self.text} ({self.share or 0:.0%})", "", ""
        if self.is_share:
            return title, _percent(self.mean), "", _percent(self.last)
        spread = "" if self.p05 is None else f"{figure_text(self.p05)} – {figure_text(self.p95)}"
        return title, figure_text(self.mean), spread, figure_text(self.last)


def figure_text(value: float | None) -> str:
    """Return a number with four significant digits, or all of an integer's below 10¹⁵."""
    if value is None:
        return "–"
    if abs(value) >= 1e15:
        return f"{value:.4g}"
    if abs(value) >= 1000 or value.is_integer():
        return f"{value:,.0f}"
    return f"{value:.4g}"


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{share:.1%}"


def reported_figures(states: pa.Table) -> dict[str, ReportedFigure]:
    """Return the figures of the reported values in the states, by name; the states are in the order of time."""
    found = {}
    node = states["node"].combine_chunks().dictionary_encode().indices.to_numpy() if len(states) else np.zeros(0)
    for name in value_columns(states.schema):
        column = states[name]
        figure = _of_texts(column) if is_text(column.type) else _of_numbers(column, node)
        if figure.reports:
            found[name] = figure
    return found


def is_text(kind: pa.DataType) -> bool:
    """Return whether a column of the states has texts."""
    return bool(kind == TEXT or kind == pa.string())


def _of_numbers(column: pa.ChunkedArray, node: Array) -> ReportedFigure:
    number = numbers_of(column)
    known = np.flatnonzero(np.isfinite(number))
    if not len(known):
        return ReportedFigure(0)
    low, high = np.percentile(number[known], [5, 95])
    of_node = np.full(int(node.max()) + 1, np.nan)
    of_node[node[known]] = number[known]  # rows are in the order of time: the last one stays
    return ReportedFigure(
        reports=len(known),
        mean=float(number[known].mean()),
        p05=float(low),
        p95=float(high),
        last=float(np.nanmean(of_node)),
        is_share=pa.types.is_boolean(column.type),
    )


def _of_texts(column: pa.ChunkedArray) -> ReportedFigure:
    texts = column.drop_null().cast(pa.string())
    if not len(texts):
        return ReportedFigure(0)
    counts = sorted(pc.value_counts(texts).to_pylist(), key=lambda each: (-each["counts"], each["values"]))
    return ReportedFigure(len(texts), text=counts[0]["values"], share=counts[0]["counts"] / len(texts))
