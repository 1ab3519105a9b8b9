"""Trips from tables: CSV and Parquet with the columns id, time_s and x_m, y_m or lat_deg, lon_deg.

The columns `heading_rad` and `speed_mps` are optional; others are ignored. Files are read in batches.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq

from emulator.world.csv_file import open_csv
from emulator.world.trips.samples import DEGREES, METRES, OPTIONAL, Samples
from vnet.errors import ScenarioError, printable

_LONGEST_LINE = 100_000
"""Characters of the header line."""
BATCH_ROWS = 1 << 16
"""Rows that are read at once."""


def read_csv(path: Path, window_s: tuple[float, float] | None) -> Samples:
    """Return the samples of a CSV file. Raise ScenarioError, naming the row (the header is 1), for a bad file."""
    with open_csv(path, _LONGEST_LINE) as lines:
        columns = choose_columns(path, next(csv.reader(lines), []))
    types = {name: pa.string() if name == "id" else pa.float64() for name in columns}
    convert = pacsv.ConvertOptions(
        column_types=types, include_columns=columns, null_values=[], strings_can_be_null=False
    )
    try:
        # With one thread pyarrow's errors name the row.
        reader = pacsv.open_csv(path, pacsv.ReadOptions(use_threads=False), convert_options=convert)
        return _collect(path, reader, columns, first_row=2, window_s=window_s)
    except (OSError, pa.ArrowInvalid) as error:
        raise ScenarioError(f"{path}: not a CSV file of trips: {printable(str(error), 300)}") from None


def read_parquet(path: Path, window_s: tuple[float, float] | None) -> Samples:
    """Return the samples of a Parquet file. Raise ScenarioError, naming the row (from 1), for a bad file."""
    try:
        with pq.ParquetFile(path.absolute()) as file:
            columns = choose_columns(path, file.schema_arrow.names)
            batches = file.iter_batches(BATCH_ROWS, columns=columns)
            return _collect(path, batches, columns, first_row=1, window_s=window_s)
    except (OSError, pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
        raise ScenarioError(f"{path}: not a Parquet file of trips: {printable(str(error), 300)}") from None


def choose_columns(path: Path, names: Sequence[str]) -> list[str]:
    """Return the columns of a file that are read: id, time_s, positions in metres or degrees, and optional ones.

    Raise ScenarioError if one is missing, or appears twice.
    """
    where = METRES if set(METRES) <= set(names) else DEGREES
    for name in ("id", "time_s", *where):
        if name not in names:
            raise ScenarioError(
                f"{path}: no column {name!r}; needed are id, time_s, and x_m, y_m or lat_deg, lon_deg"
            )
    columns = ["id", "time_s", *where, *(name for name in OPTIONAL if name in names)]
    for name in columns:
        if list(names).count(name) > 1:
            raise ScenarioError(f"{path}: two columns {name!r}")
    return columns


def _collect(
    path: Path,
    batches: Iterable[pa.RecordBatch],
    columns: Sequence[str],
    first_row: int,
    window_s: tuple[float, float] | None,
) -> Samples:
    samples = Samples(path, "row", window_s)
    for batch in batches:
        numbers = {name: batch[name].cast(pa.float64()) for name in columns[1:]}
        row = first_row + samples.taken + np.arange(len(batch), dtype=np.int64)
        values = {name: np.asarray(column.to_numpy(zero_copy_only=False)) for name, column in numbers.items()}
        samples.add(batch["id"].cast(pa.string()), row, values)
    return samples
