"""CSV files that others wrote, read within bounds: what is no table is refused before it fills the memory."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from vnet.errors import ScenarioError

MOST_ROWS = 10_000
"""As many vehicles as a scenario may have."""


@contextmanager
def open_csv(path: Path, longest_line: int) -> Iterator[Iterator[str]]:
    """The lines of a CSV file, with or without a byte-order mark, for a reader of the csv module.

    `longest_line` is in characters. Whatever is wrong with the file, here or in the reader, is a ScenarioError.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            yield _lines(path, file, longest_line)
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read: {error.strerror}") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise ScenarioError(f"{path}: not a CSV file: {error}") from None


def _lines(path: Path, file: TextIO, longest_line: int) -> Iterator[str]:
    number = 0
    while line := file.readline(longest_line + 1):
        number += 1
        if len(line) > longest_line:
            raise ScenarioError(f"{path}: line {number}: longer than {longest_line} characters")
        yield line


def check_row_count(path: Path, rows: int) -> None:
    """Raises ScenarioError above `MOST_ROWS`."""
    if rows > MOST_ROWS:
        raise ScenarioError(f"{path}: more than {MOST_ROWS} rows; that is as many vehicles as there may be")
