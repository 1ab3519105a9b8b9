"""Checks of a user's own, one of which reads the files of a run."""

from collections.abc import Iterator

import pyarrow.parquet as pq

from emulator import Result, Run


def reads_files(run: Run) -> Iterator[Result]:
    """Read a table of the run out of its folder."""
    same = pq.read_table(run.folder / "trace.parquet").equals(run.trace)
    yield Result("files", "valid" if same else "invalid", "")


def reads_tables(run: Run) -> Iterator[Result]:
    """Look at the trace alone."""
    yield Result("tables", "valid" if len(run.trace) else "invalid", "")
