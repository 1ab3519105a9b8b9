"""Reading CSV and arrays of numpy that others wrote, with bounds and errors of one line."""

from __future__ import annotations

import csv
import math
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from vnet.errors import ScenarioError, printable, shown

MAX_ROWS = 10_000
"""Most rows of a file: the most vehicles of a scenario."""


@contextmanager
def open_csv(path: Path, longest_line: int) -> Iterator[Iterator[str]]:
    """Yield the lines of a CSV file, without a byte-order mark, for a reader of the csv module.

    `longest_line` is in characters. Raise ScenarioError for a bad file, also if the reader finds it bad.
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
    """Raise ScenarioError if there are more than `MAX_ROWS` rows."""
    if rows > MAX_ROWS:
        raise ScenarioError(f"{path}: more than {MAX_ROWS} rows; a scenario has at most so many vehicles")


def check_columns(path: Path, reader: csv.DictReader[str], columns: Sequence[str]) -> None:
    """Take the blanks off the names of columns. Raise ScenarioError unless each of `columns` is there once."""
    reader.fieldnames = names = [name.strip() for name in reader.fieldnames or []]
    for column in columns:
        if names.count(column) != 1:
            problem = "two columns" if column in names else "no column"
            there = f"; there are {printable(', '.join(names), 200)}" if names else ""
            raise ScenarioError(f"{path}: {problem} {column!r}; needed are {', '.join(columns)}{there}")


def number_of(text: str | None) -> float:
    """Return the number that a text is; NaN if it is none."""
    try:
        return float(text or "")
    except ValueError:
        return math.nan


def number_within(path: Path, line: int, row: Mapping[str, str | None], column: str, most: float) -> float:
    """Return the number in a column of the row of a line. Raise ScenarioError unless it is within ± `most`."""
    value = number_of(row[column])
    if not abs(value) <= most:
        raise ScenarioError(
            f"{path}: line {line}: {column} = {shown(row[column])}: a finite number is needed, within ±{most:g}"
        )
    return value


def read_arrays(path: Path, names: Iterable[str], largest_bytes: int) -> dict[str, NDArray[Any]]:
    """Return the arrays of an NPZ file that are among `names`. Raise ScenarioError if one is larger than allowed.

    No more memory is allocated than the file has content for.
    """
    arrays = {}
    try:
        with zipfile.ZipFile(path) as archive:
            members = set(archive.namelist())
            for name in names:
                if f"{name}.npy" in members:
                    _check_size(archive, f"{name}.npy", largest_bytes)
                    with archive.open(f"{name}.npy") as member:
                        arrays[name] = np.lib.format.read_array(member, allow_pickle=False)
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read: {error.strerror or error}") from None
    except Exception as error:  # zipfile, zlib and numpy raise a dozen types for a bad file
        raise ScenarioError(f"{path}: not an NPZ file: {printable(str(error), 300)}") from None
    return arrays


def _check_size(archive: zipfile.ZipFile, name: str, largest_bytes: int) -> None:
    """Raise ValueError if an array is larger than allowed, or its header claims more than its content."""
    size = archive.getinfo(name).file_size
    if size > largest_bytes:
        raise ValueError(f"{name}: {size:,} bytes; at most {largest_bytes:,} are allowed")
    with archive.open(name) as member:
        version = np.lib.format.read_magic(member)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, kind = read(member)
    if math.prod(shape) * kind.itemsize > size:
        raise ValueError(f"{name}: {shape} of {kind} in {size:,} bytes")
