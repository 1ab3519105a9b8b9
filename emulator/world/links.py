"""Connectivity given as a matrix or a table instead of a range, read from CSV or from the scenario itself."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from emulator.scenario.scenario import Radio
from emulator.world.csv_file import MAX_ROWS, check_row_count, open_csv
from emulator.world.link_table import COLUMNS, LinkTable, read_link_table
from vnet.errors import ScenarioError, shown

_LONGEST_LINE = 10 * MAX_ROWS
"""Characters of a line: an entry may be written as `1.000000,`."""


def load_links(radio: Radio, node_ids: Sequence[str]) -> NDArray[np.bool_] | LinkTable | None:
    """Return `radio.links`: a table over time, or a matrix (N, N); None if there are none.

    Entry (i, j) of a matrix is true if vehicle i receives vehicle j. The diagonal is ignored: no vehicle receives
    itself. Raise ScenarioError unless it is a table of these vehicles, or a square matrix of 0 and 1 with a row for
    each.
    """
    vehicles = len(node_ids)
    if radio.links is None:
        return None
    if isinstance(radio.links, Path) and _is_table(radio.links):
        if radio.loss:
            raise ScenarioError(
                f"radio.loss = {radio.loss:g}: must be 0, because {radio.links} has the losses of links"
            )
        return read_link_table(radio.links, node_ids)
    if isinstance(radio.links, Path):
        where, links = str(radio.links), _read(radio.links)
    else:
        where, links = "the scenario", np.array(radio.links, dtype=bool)
    if len(links) != vehicles:
        raise ScenarioError(
            f"{where}: radio.links is {len(links)}×{len(links)}, but the network has {vehicles} vehicles; "
            "a row and a column for each of them are needed"
        )
    np.fill_diagonal(links, False)
    return links


def _is_table(path: Path) -> bool:
    """Return whether a file begins with the names of columns."""
    with open_csv(path, _LONGEST_LINE) as lines:
        first = next(iter(lines), "")
        return any(name in first for name in COLUMNS)  # a misspelt one is named as it is read


def _read(path: Path) -> NDArray[np.bool_]:
    rows = []
    with open_csv(path, _LONGEST_LINE) as lines:
        reader = csv.reader(lines)
        for entries in reader:
            if entries:
                rows.append(_read_row(path, reader.line_num, entries))
                check_row_count(path, len(rows))
    if not rows:
        raise ScenarioError(f"{path}: empty; a square matrix of 0 and 1, a row for each receiver, is needed")
    for number, row in enumerate(rows, start=1):
        if len(row) != len(rows):
            raise ScenarioError(
                f"{path}: not square: {len(rows)} rows, and {len(row)} entries in row {number}; "
                "a row and a column for each vehicle are needed"
            )
    return np.array(rows)


def _read_row(path: Path, line: int, row: list[str]) -> NDArray[np.bool_]:
    entries = [_number(entry) for entry in row]
    for column, entry in enumerate(entries, start=1):
        if entry not in (0, 1):
            raise ScenarioError(f"{path}: line {line}: entry {column} = {shown(row[column - 1])}: 0 or 1 is needed")
    return np.array(entries, dtype=bool)


def _number(entry: str) -> float | None:
    try:
        return float(entry)
    except ValueError:
        return None
