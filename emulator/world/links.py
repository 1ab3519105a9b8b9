"""Who hears whom, where a scenario gives it as a matrix instead of a range; read from CSV or as it stands there."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vnet.errors import ScenarioError
from vnet.scenario import Radio


def load_links(radio: Radio, vehicles: int) -> NDArray[np.bool_] | None:
    """`radio.links` as (N, N): whether vehicle i (row) hears vehicle j (column); None where the range decides.

    Nobody hears itself, whatever the diagonal says. Raises ScenarioError if it is no square matrix of 0 and 1, or
    not one of `vehicles` rows.
    """
    if radio.links is None:
        return None
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


def _read(path: Path) -> NDArray[np.bool_]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file)
            rows = [_read_row(path, reader.line_num, row) for row in reader if row]
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read: {error.strerror}") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise ScenarioError(f"{path}: not a CSV file: {error}") from None
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
            raise ScenarioError(f"{path}: line {line}: entry {column} = {row[column - 1]!r}: 0 or 1 is needed")
    return np.array(entries, dtype=bool)


def _number(entry: str) -> float | None:
    try:
        return float(entry)
    except ValueError:
        return None
