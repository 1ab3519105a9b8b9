"""Export of all tables of a run as CSV: points in two columns, matrices in four, other nested values as JSON."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pacsv

from emulator.records.radio_metrics import radio_metrics
from emulator.records.recorded_run import OpenedRun
from emulator.records.tables import TABLES

AXES = {2: ("x", "y"), 4: ("xx", "xy", "yx", "yy")}
"""Suffixes of the columns of a list by its length."""


def write_csv(recorded: OpenedRun, folder: Path) -> list[str]:
    """Write all tables into a folder; return the files' names. Raise OSError if one cannot be written."""
    events = [
        {"time_ns": e.time_ns, "kind": e.kind, "node": e.node, "details": json.dumps(e.details)}
        for e in recorded.events
    ]
    figures = radio_metrics(recorded)
    tables = {kind.name: table for kind in TABLES if (table := recorded.table(kind)) is not None}
    tables["events"] = pa.Table.from_pylist(events)
    tables |= {"links": figures.links, "vehicles": figures.vehicles, "distances": figures.distances}
    for name, table in tables.items():
        pacsv.write_csv(flat(table), folder / f"{name}.csv")
    return [f"{name}.csv" for name in tables]


def flat(table: pa.Table) -> pa.Table:
    """Return a table whose columns all hold numbers or text."""
    return pa.table(dict(_flat_columns(table)))


def _flat_columns(table: pa.Table) -> Iterator[tuple[str, pa.Array]]:
    for name in table.column_names:
        column = table[name].combine_chunks()
        kind = column.type
        if pa.types.is_dictionary(kind):
            yield name, column.cast(pa.string())
        elif pa.types.is_fixed_size_list(kind) and kind.list_size in AXES:
            for index, axis in enumerate(AXES[kind.list_size]):
                yield f"{name}_{axis}", pc.list_element(column, index)
        elif pa.types.is_large_binary(kind):
            yield f"{name}_hex", pa.array([entry.hex() for entry in column.to_pylist()], pa.string())
        elif pa.types.is_nested(kind):
            texts = (None if entry is None else json.dumps(_plain(entry)) for entry in column.to_pylist())
            yield name, pa.array(texts, pa.string())
        else:
            yield name, column


def _plain(entry: object) -> object:
    """Return a list as it is, and a map (a list of tuples) as a dictionary."""
    if isinstance(entry, list) and entry and all(isinstance(pair, tuple) for pair in entry):
        return dict(entry)
    return entry
