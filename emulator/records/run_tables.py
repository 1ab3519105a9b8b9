"""Tables of a run's folder that others may have written: bounded before memory is taken for them."""

from __future__ import annotations

import os
import resource
import sys
from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from vnet.bounded import open_regular

BYTES_A_VALUE = {"BOOLEAN": 1, "INT32": 4, "FLOAT": 4, "INT64": 8, "DOUBLE": 8, "BYTE_ARRAY": 4}
"""Memory of a value by its type in the file; texts are kept once, and have a number of 4 bytes each."""
LARGEST_RATIO = 1000
"""Bytes of memory for a byte of a file; runs have written 15 at most."""
LEAST_BOUND_BYTES = 1 << 26
"""Memory that every table may take."""
VALUES_AS_LIST = pa.list_(pa.struct([("key", pa.string()), ("value", pa.list_(pa.float64()))]))
"""The type of the states' column `values` as a list, which more functions of Arrow know than maps."""


def open_table(path: Path, columns: Sequence[str] | None = None) -> pq.ParquetFile:
    """Open a Parquet file that others may have written, before memory is taken for its rows.

    Raises OSError, ArrowException, and ValueError for a pipe or a device, and for a file whose rows, or those of
    its `columns`, would take more memory than it has contents for, or than this machine has.
    """
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
    table = pq.ParquetFile(path.absolute())
    metadata = table.metadata
    needed = 0
    for group in range(metadata.num_row_groups):
        for number in range(metadata.num_columns):
            column = metadata.row_group(group).column(number)
            if columns is None or any(f"{column.path_in_schema}.".startswith(f"{name}.") for name in columns):
                needed += column.num_values * BYTES_A_VALUE.get(column.physical_type, 16)
    for bound, why in (
        (max(LEAST_BOUND_BYTES, LARGEST_RATIO * size), f"and it has {size:,} bytes itself"),
        (max(LEAST_BOUND_BYTES, available_bytes() // 2), "and half of the memory that is available is less"),
    ):
        if needed > bound:
            raise ValueError(f"{metadata.num_rows:,} rows need {needed / 1e6:,.0f} MB, {why}")
    return table


def available_bytes() -> int:
    """Return the memory that this process may still take: the machine's, or what its limit leaves."""
    try:
        lines = dict(line.split(":", 1) for line in Path("/proc/meminfo").read_text().splitlines())
        available = int(lines["MemAvailable"].split()[0]) * 1024
        taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    except (OSError, KeyError, ValueError):
        return sys.maxsize
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return available if limit == resource.RLIM_INFINITY else max(0, min(available, limit - taken))
