"""Inputs of the radio besides positions: links and buildings from files, antennas of roadside units."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from emulator.scenario.program import RoadsideUnit
from emulator.scenario.scenario import Radio, Scenario
from emulator.scenario.sections import DAY_S
from emulator.world.buildings import Buildings
from emulator.world.input_files import MAX_ROWS, check_columns, check_row_count, number_of, number_within, open_csv
from emulator.world.projection import CoordinateFrame
from vnet.errors import ScenarioError, first_names, shown
from vnet.types import Array, IntArray, Mask
from vnet.units import NS_PER_S

COLUMNS = ("time_s", "sender", "receiver", "loss")
"""Columns of the file. A row without a loss takes the receiver out of range."""
MOST_ROWS = 5_000_000
"""Rows of a file; they are checked one by one."""
_LONGEST_LINE = 1000
"""Characters of a line."""
_LONGEST_MATRIX_LINE = 10 * MAX_ROWS
"""Characters of a line: an entry may be written as `1.000000,`."""
SAME_ORIGIN_M = 1.0
"""Distance within which two origins are taken for the same: degrees may be rounded."""


@dataclass(frozen=True, eq=False)
class LinkTable:
    """R rows about the links of vehicles, in the order of their times.

    From `time_ns` (R,) on, frames of `sender` (R,) are lost at `receiver` (R,) with probability `loss` (R,); NaN if
    it is out of range. So it is before its first row.
    """

    time_ns: IntArray
    sender: NDArray[np.intp]
    receiver: NDArray[np.intp]
    loss: Array

    @cached_property
    def changes_ns(self) -> IntArray:
        """Times at which links change, each once."""
        return np.unique(self.time_ns)

    @cached_property
    def pairs(self) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
        """Sender and receiver (P,) of each pair that has a row, sorted, and the pair (R,) of each row."""
        key, pair = np.unique(self._key(self.sender, self.receiver), return_inverse=True)
        return key // self._size, key % self._size, pair.astype(np.intp)

    @cached_property
    def _size(self) -> int:
        return int(max(self.receiver.max(initial=0), self.sender.max(initial=0))) + 1

    def _key(self, sender: NDArray[np.intp], receiver: NDArray[np.intp]) -> NDArray[np.intp]:
        return sender * self._size + receiver

    def of_pairs(self, values: Array, sender: NDArray[np.intp], receiver: NDArray[np.intp]) -> Array:
        """Return the entries (n,), of values (P,) of all pairs, of some; NaN for those that have no row."""
        known, asked = self._key(*self.pairs[:2]), self._key(sender, receiver)
        index = np.minimum(np.searchsorted(known, asked), len(known) - 1)
        return np.where((known[index] == asked) & (receiver < self._size), values[index], np.nan)

    def linked_before(self, end_ns: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return sender and receiver (n,) of the pairs that are in range at any time before `end_ns`, sorted."""
        sender, receiver, pair = self.pairs
        linked = np.unique(pair[np.isfinite(self.loss) & (self.time_ns < end_ns)])
        return sender[linked], receiver[linked]

    def loss_at(self, time_ns: int, before: Array | None = None, before_ns: int = -1) -> Array:
        """Return the losses (P,) of the pairs at a time, NaN out of range.

        `before` are those at an earlier time `before_ns`, from which it takes less time.
        """
        sender, _, pair = self.pairs
        loss = np.full(len(sender), np.nan) if before is None else before.copy()
        first, end = np.searchsorted(self.time_ns, [before_ns, time_ns], side="right")
        some = slice(0 if before is None else first, end)
        if len(last := pair[some][::-1]):
            _, index = np.unique(last, return_index=True)
            loss[last[index]] = self.loss[some][::-1][index]
        return loss


def read_link_table(path: Path, node_ids: Sequence[str]) -> LinkTable:
    """Read a file with the columns `COLUMNS`, sorted by time. Raise ScenarioError, naming the line."""
    number = {node: index for index, node in enumerate(node_ids)}
    rows: list[tuple[int, int, int, float]] = []
    seen: set[tuple[int, int]] = set()
    with open_csv(path, _LONGEST_LINE) as lines:
        reader = csv.DictReader(lines)
        check_columns(path, reader, COLUMNS)
        for row in reader:
            new = _read_row(path, reader.line_num, row, number)
            where = f"{path}: line {reader.line_num}"
            if rows and new[0] < rows[-1][0]:
                raise ScenarioError(f"{where}: time_s = {row['time_s']}: earlier than the row before; sort by time")
            if rows and new[0] > rows[-1][0]:
                seen.clear()
            if new[1:3] in seen:
                raise ScenarioError(
                    f"{where}: {row['sender']} to {row['receiver']} twice at one time; leave one out"
                )
            seen.add(new[1:3])
            rows.append(new)
            if len(rows) > MOST_ROWS:
                raise ScenarioError(f"{path}: more than {MOST_ROWS} rows")
    if not rows:
        raise ScenarioError(f"{path}: no rows; a row for each link is needed")
    time_ns, sender, receiver, loss = map(np.array, zip(*rows, strict=True))
    return LinkTable(time_ns.astype(np.int64), sender.astype(np.intp), receiver.astype(np.intp), loss.astype(float))


def _read_row(
    path: Path, line: int, row: dict[str, str | None], number: dict[str, int]
) -> tuple[int, int, int, float]:
    time_s = number_within(path, line, row, "time_s", DAY_S)
    if time_s < 0:
        raise ScenarioError(f"{path}: line {line}: time_s = {time_s:g}: 0 or more is needed")
    ends = [(row[name] or "").strip() for name in COLUMNS[1:3]]
    for name, node in zip(COLUMNS[1:3], ends, strict=True):
        if node not in number:
            some = first_names(list(number))
            raise ScenarioError(
                f"{path}: line {line}: {name} = {shown(node)}: no such vehicle; the network has {some}"
            )
    if ends[0] == ends[1]:
        raise ScenarioError(f"{path}: line {line}: {shown(ends[0])} to itself: two vehicles are needed")
    if row["loss"] is None:
        raise ScenarioError(f"{path}: line {line}: ends before its loss; {len(COLUMNS)} cells are needed")
    loss = _probability(path, line, row["loss"]) if row["loss"].strip() else np.nan
    return round(time_s * NS_PER_S), number[ends[0]], number[ends[1]], loss


def _probability(path: Path, line: int, text: str) -> float:
    """Return the loss in a row of a line. Raise ScenarioError unless it is from 0 to 1."""
    loss = number_of(text)
    if not 0 <= loss <= 1:
        needed = "0 to 1, or nothing out of range, is needed"
        raise ScenarioError(f"{path}: line {line}: loss = {shown(text)}: {needed}")
    return loss


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
    with open_csv(path, _LONGEST_MATRIX_LINE) as lines:
        first = next(iter(lines), "")
        return any(name in first for name in COLUMNS)  # a misspelt one is named as it is read


def _read(path: Path) -> NDArray[np.bool_]:
    rows = []
    with open_csv(path, _LONGEST_MATRIX_LINE) as lines:
        reader = csv.reader(lines)
        for entries in reader:
            if entries:
                rows.append(_read_matrix_row(path, reader.line_num, entries))
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


def _read_matrix_row(path: Path, line: int, row: list[str]) -> NDArray[np.bool_]:
    entries = [number_of(entry) for entry in row]
    for column, entry in enumerate(entries, start=1):
        if entry not in (0, 1):
            raise ScenarioError(f"{path}: line {line}: entry {column} = {shown(row[column - 1])}: 0 or 1 is needed")
    return np.array(entries, dtype=bool)


@dataclass(frozen=True, eq=False)
class RadioInputs:
    """Inputs of the radio; None where a scenario has none.

    `links` is `radio.links`: a table, or a matrix (N, N) whose entry (i, j) is true if i receives j. `buildings`
    are those of `[radio.buildings]`, as far as they are near nodes. `units` are the last nodes.
    """

    links: Mask | LinkTable | None = None
    buildings: Buildings | None = None
    units: tuple[RoadsideUnit, ...] = ()


def load_buildings(scenario: Scenario, frame: CoordinateFrame | None, area_m: Array) -> Buildings | None:
    """Return the buildings of a scenario that touch the box `area_m` (2, 2) of all vehicles; None without any.

    `frame` is that of the map's or the trips' metres, if it is known. Raise ScenarioError if they cannot be read.
    """
    section, roads = scenario.radio.buildings, scenario.map
    if section is None:
        return None
    from emulator.world.maps.files import read_buildings

    path = section.path if roads is None else section.path or roads.path
    assert path is not None

    def of_degrees() -> CoordinateFrame:
        origin = section.origin_deg
        if frame is None:
            if origin is None:
                raise ScenarioError(
                    f"{path}: in degrees, but nothing says where x = y = 0 m is: set radio.buildings.origin_deg"
                )
            return CoordinateFrame.around(*origin)
        off_m = 0.0 if origin is None else float(np.hypot(*frame.to_local(*origin)))
        if not off_m <= SAME_ORIGIN_M:
            raise ScenarioError(
                f"radio.buildings.origin_deg = {list(origin or ())}: {off_m:,.0f} m from the x = y = 0 m of the "
                "map or the trips; leave it out"
            )
        return frame

    buildings = read_buildings(path, of_degrees)
    if roads is not None and path == roads.path:
        buildings = buildings.moved(roads.datum_m)
    return replace(buildings.touching(*area_m), clipped=buildings.clipped)
