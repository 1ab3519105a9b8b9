"""The check that a run replays: two runs of one scenario, compared row by row."""

from __future__ import annotations

from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from emulator.records.recorded_run import OpenedRun, RecordedRun
from emulator.records.reported import value_columns
from emulator.records.run_folder import AGAIN
from emulator.records.verdicts import Finding, NotExercised, result
from vnet.errors import VnetError

ONCE = NotExercised("replay", "it ran once; --check-determinism runs it twice")
TABLES = ("trace", "states", "metrics")
ABOUT = ("sent_ns", "sender", "seq", "receiver", "copy", "period", "node", "outcome", "arrival_ns")
"""The columns that are shown of a differing row, beside those that differ."""


def check_replay(folder: Path) -> Finding:
    """Compare a run with the second one in its folder. Raises VnetError if a table cannot be read."""
    again = folder / AGAIN
    return compare_folders(folder, again) if RecordedRun.open(again).has_record else ONCE


def compare_folders(first: Path, second: Path) -> Finding:
    """Compare two finished runs. Raises VnetError if a table cannot be read, or has other columns in one."""
    ours, theirs = RecordedRun.open(first), RecordedRun.open(second)
    tables = []
    for name, mine, other in zip(TABLES, _tables(ours), _tables(theirs), strict=True):
        if name == "states":
            mine, other = _with_values(mine, other), _with_values(other, mine)
        if set(mine.column_names) != set(other.column_names):
            raise VnetError(f"{second}: the table of the {name} has other columns than the one of {first}")
        tables.append((name, mine, other))
    return compare(tables)


def _tables(run: OpenedRun) -> tuple[pa.Table, pa.Table, pa.Table]:
    """The tables of a run, as `TABLES` calls them."""
    return run.trace, run.states, run.metrics


def _with_values(states: pa.Table, others: pa.Table) -> pa.Table:
    """The states, with an empty column for each value that only the other run's programs report."""
    for name in value_columns(others.schema):
        if name not in states.column_names:
            states = states.append_column(name, pa.nulls(len(states), others.schema.field(name).type))
    return states


def compare(tables: list[tuple[str, pa.Table, pa.Table]]) -> Finding:
    """Compare tables (name, first, second) of two runs; the first difference is shown."""
    for name, first, second in tables:
        index = first_difference(first, second)
        if index is not None:
            return _difference(name, first, second, index)
    text = f"two runs agree: {len(tables[0][1]):,} rows of the trace, all states and metrics"
    return result("replay", 0, text, "", rows_each=len(tables[0][1]))


def _difference(name: str, first: pa.Table, second: pa.Table, index: int) -> Finding:
    ours, theirs = _row(first, index), _row(second, index)
    differing = [key for key in first.column_names if str(ours.get(key)) != str(theirs.get(key))]
    how = ", ".join(differing) if ours and theirs else "one has no such row"
    shown = [
        {"run": run, "row": index, **{key: _shown(row[key]) for key in row if key in ABOUT or key in differing}}
        for run, row in (("first", ours), ("again", theirs))
    ]
    text = f"two runs differ, first in row {index} of the {name}: {how}"
    return result("replay", 1, "", text, shown, table=name, row=index, differing=differing)


def first_difference(first: pa.Table, second: pa.Table) -> int | None:
    """The number of the first row in which two tables differ, or None."""
    shared = min(len(first), len(second))
    index = None if len(first) == len(second) else shared
    for name in first.column_names:
        ours, theirs = first[name].slice(0, shared), second[name].slice(0, shared)
        if not ours.equals(theirs):
            differing = _first(ours, theirs)
            index = differing if index is None or (differing is not None and differing < index) else index
    return index


def _first(ours: pa.ChunkedArray, theirs: pa.ChunkedArray) -> int | None:
    """Return the index of the first row in which two columns differ; NaN equals NaN."""
    if pa.types.is_integer(ours.type) and not ours.null_count and not theirs.null_count:
        differing = np.flatnonzero(ours.to_numpy() != theirs.to_numpy())
        return int(differing[0]) if len(differing) else None
    pairs = zip_longest(ours.to_pylist(), theirs.to_pylist())
    return next((number for number, (a, b) in enumerate(pairs) if a != b and str(a) != str(b)), None)


def _row(table: pa.Table, index: int) -> dict[str, Any]:
    return dict(table.slice(index, 1).to_pylist()[0]) if index < len(table) else {}


def _shown(value: Any) -> Any:
    return value if isinstance(value, (str, int)) else str(value)
