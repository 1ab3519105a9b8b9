"""A run's big tables, read forward in time and a piece at a time, so that memory does not grow with the run."""

from __future__ import annotations

import contextlib
import os
import resource
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import ArrayLike, NDArray

from emulator.radio.outcomes import Outcome
from emulator.radio.trace import NOT_ARRIVING, ROW, decided_ns
from emulator.records.period_figures import VECTORS, ProgramFigures
from emulator.records.reported import is_text, numbers_of, reported_columns, value_columns
from emulator.world.world import Instant
from vnet.bounded import open_regular
from vnet.errors import VnetError
from vnet.types import Array

ROWS_AT_ONCE = 1 << 14
BYTES_A_VALUE = {"BOOLEAN": 1, "INT32": 4, "FLOAT": 4, "INT64": 8, "DOUBLE": 8, "BYTE_ARRAY": 4}
"""Memory of a value by its type in the file; texts are kept once, and have a number of 4 bytes each."""
LARGEST_RATIO = 1000
"""Bytes of memory for a byte of a file; runs have written 15 at most."""
LEAST_BOUND_BYTES = 1 << 26
"""Memory that every table may take."""
_TRUTH = {"position_m": 2, "fix_m": 2, "common_error_m": 2}
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


class TableFile:
    """A Parquet file and those of its columns that are wanted. Raises VnetError if it has not got them.

    Columns that it has `perhaps` may be missing.
    """

    def __init__(self, path: Path, columns: Sequence[str], perhaps: Sequence[str] = ()) -> None:
        self.path = path
        try:
            self._file = open_table(path)
        except FileNotFoundError:
            text = f"{path.parent}: not the folder of a finished run: there is no {path.name} in it"
            raise VnetError(text) from None
        except (OSError, pa.ArrowException, ValueError) as error:
            raise self.error(f"cannot be read: {_one_line(error)}") from None
        missing = [column for column in columns if column not in self._file.schema_arrow.names]
        if missing:
            raise self.error(f"has no column {missing[0]!r}")
        self._columns = [*columns, *(name for name in perhaps if name in self._file.schema_arrow.names)]

    @property
    def schema(self) -> pa.Schema:
        """All columns of the file, with their types."""
        return self._file.schema_arrow

    def want(self, columns: Sequence[str]) -> None:
        """Read these columns, which the file has, as well."""
        self._columns += columns

    def error(self, text: str) -> VnetError:
        """Make the error that says what is wrong with the file."""
        return VnetError(f"{self.path}: {text}")

    def pieces(self, rows: int = ROWS_AT_ONCE) -> Iterator[pa.Table]:
        """The rows, so many at a time. Raises VnetError if they cannot be read."""
        with self.sound():
            for batch in self._file.iter_batches(rows, columns=self._columns):
                yield pa.Table.from_batches([batch])

    @contextlib.contextmanager
    def sound(self) -> Iterator[None]:
        """Blame the file for what fails in here."""
        try:
            yield
        except (OSError, pa.ArrowException, ValueError) as error:
            raise self.error(f"cannot be read: {_one_line(error)}") from None


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())


class TraceReader:
    """The trace of a run, forward in time."""

    def __init__(self, path: Path, number: Mapping[str, int]) -> None:
        columns = ("sent_ns", "sender", "seq", "receiver", "size_bytes", "outcome", "arrival_ns", "copy")
        self._file = TableFile(path, columns, perhaps=["left_ns"])
        self._codes = {"sender": number, "receiver": number, "outcome": {o.name: o.value for o in Outcome}}
        self._pieces = self._file.pieces()
        self._ahead = np.zeros(0, ROW)
        self._undecided = np.zeros(0, ROW)
        self._last_ns = 0
        self._ended = False

    def until(self, end_ns: int) -> NDArray[np.void]:
        """Return what was sent before `end_ns` and not decided by the last time, as records of type `ROW`.

        Digests and causes are left out. Raises VnetError if the trace cannot be read or is no trace of this run.
        """
        while not self._ended and self._last_ns < end_ns:
            self._read_on()
        cut = int(np.searchsorted(self._ahead["sent_ns"], end_ns))
        rows = np.concatenate([self._undecided, self._ahead[:cut]])
        self._ahead = self._ahead[cut:]
        self._undecided = rows[decided_ns(rows) >= end_ns]
        return rows

    def _read_on(self) -> None:
        piece = next(self._pieces, None)
        if piece is None:
            self._ended = True
            return
        rows = np.zeros(len(piece), ROW)
        for name in ("sent_ns", "seq", "size_bytes", "copy"):
            rows[name] = self._whole(piece, name)
        for name, codes in self._codes.items():
            rows[name] = self._coded(piece, name, codes)
        rows["arrival_ns"] = self._whole(piece, "arrival_ns", NOT_ARRIVING)
        rows["left_ns"] = self._whole(piece, "left_ns") if "left_ns" in piece.column_names else rows["sent_ns"]
        sent_ns = rows["sent_ns"]
        if len(rows):
            if sent_ns[0] < self._last_ns or (np.diff(sent_ns) < 0).any():
                raise self._file.error("its rows are not in the order in which frames were sent")
            self._last_ns = int(sent_ns[-1])
        self._ahead = np.concatenate([self._ahead, rows])

    def _whole(self, piece: pa.Table, name: str, missing: int | None = None) -> NDArray[np.int64]:
        with self._file.sound():
            column = piece[name] if missing is None else pc.fill_null(piece[name], missing)
            if column.null_count:
                raise ValueError(f"column {name!r} has gaps")
            return np.asarray(column.to_numpy(), dtype=np.int64)

    def _coded(self, piece: pa.Table, name: str, codes: Mapping[str, int]) -> NDArray[np.int64]:
        """A column of names as numbers."""
        with self._file.sound():
            column = piece[name].cast(pa.string()).combine_chunks().dictionary_encode()
        known = [codes.get(each, -1) for each in column.dictionary.to_pylist()]
        if column.null_count or -1 in known:
            stranger = None if column.null_count else column.dictionary[known.index(-1)].as_py()
            raise self._file.error(f"column {name!r} names {stranger!r}, which this run has not got")
        return np.asarray(np.array(known, dtype=np.int64)[column.indices.to_numpy()])


@dataclass(frozen=True)
class Beliefs:
    """Reports of one period: arrays (n, size) of the states' columns by name, NaN where a node reported nothing.

    By column and node, the numbers of `lists` of any length. By name and node, the values (n,) that it has for its
    `peers`. By name, the figures (n,) of programs' own, true as 1, and texts (n), "" where a node reported none.
    """

    columns: Mapping[str, Array]
    lists: Mapping[str, Mapping[str, ArrayLike]]
    peers: Mapping[str, Mapping[str, Array]]
    values: Mapping[str, Array]
    texts: Mapping[str, list[str]]


class StatesReader:
    """The states of a run, period by period. `number` gives each node's, in the order of the rows of a period."""

    def __init__(self, path: Path, number: Mapping[str, int], period_ns: int, declared: ProgramFigures) -> None:
        columns = ("period", "node", "heading_rad", *_TRUTH, *VECTORS, "values")
        self._file = TableFile(path, columns)
        schema = self._file.schema
        self._value_names = value_columns(schema)
        lists = {name: schema.field(name).type for name in reported_columns(schema)}
        self._vectors = {n: kind.list_size for n, kind in lists.items() if pa.types.is_fixed_size_list(kind)}
        self._lists = [name for name, kind in lists.items() if pa.types.is_list(kind)]
        self._file.want([n for n in (*self._value_names, *self._vectors, *self._lists) if n not in columns])
        self._peers = declared.peers
        self._number = number
        self._period_ns = period_ns
        self._next_period = 0

    @property
    def path(self) -> Path:
        """The file."""
        return self._file.path

    def first(self) -> pa.Table:
        """The rows of the first period; none if the run ended within it."""
        return next(self._file.pieces(len(self._number)), pa.table({}))

    def periods(self) -> Iterator[tuple[Instant, Beliefs]]:
        """The truth and the fixes of each period in turn, and what nodes reported in it.

        Headings of fixes are not kept (NaN). Raises VnetError if the states cannot be read or are not of this run.
        """
        for table in self._whole_periods():
            with self._file.sound():
                parts = list(self._split(table))
            yield from parts

    def _whole_periods(self) -> Iterator[pa.Table]:
        """Pieces that each hold a row of every node for one period or more."""
        count = len(self._number)
        rest: list[pa.Table] = []
        for piece in self._file.pieces():
            table = pa.concat_tables([*rest, piece])
            whole = len(table) // count * count
            rest = [table.slice(whole)]
            if whole:
                yield self._in_order(table.slice(0, whole).combine_chunks())
        if rest and len(rest[0]):
            raise self._file.error("ends in the middle of a period, or is of other vehicles")

    def _in_order(self, table: pa.Table) -> pa.Table:
        count = len(self._number)
        periods = np.arange(self._next_period, self._next_period + len(table) // count)
        nodes = table["node"].to_pylist()
        if set(nodes) != set(self._number):
            raise self._file.error("is of other vehicles than scenario.toml")
        in_turn = np.array_equal(table["period"].to_numpy(), np.repeat(periods, count))
        if not in_turn or nodes != list(self._number) * len(periods):
            raise self._file.error("its rows are not those of one period after the other")
        self._next_period += len(periods)
        return table

    def _split(self, table: pa.Table) -> Iterator[tuple[Instant, Beliefs]]:
        count, node_ids = len(self._number), list(self._number)
        heading = np.asarray(table["heading_rad"].to_numpy(), dtype=float).reshape(-1, count)
        vectors = {
            name: _vectors(table[name].combine_chunks(), size).reshape(-1, count, size)
            for name, size in {**_TRUTH, **self._vectors}.items()
        }
        lists = {name: _by_row(table[name].combine_chunks()) for name in self._lists}
        values_of = table["values"].combine_chunks()
        peers = {name: _of_peers(values_of, f"{name}.", self._number) for name in self._peers}
        values, texts = self._values(table)
        first = table["period"][0].as_py()
        for place in range(len(heading)):
            here = {name: array[place] for name, array in vectors.items()}
            row_of = dict(zip(node_ids, range(place * count, (place + 1) * count), strict=True))
            in_rows = partial(_of_nodes, row_of)
            instant = Instant(
                first + place,
                (first + place) * self._period_ns,
                here["position_m"],
                heading[place],
                here["common_error_m"][0],
                here["fix_m"],
                np.full(count, np.nan),
            )
            yield (
                instant,
                Beliefs(
                    {name: here[name] for name in self._vectors},
                    {name: in_rows(each) for name, each in lists.items()},
                    {name: in_rows(each) for name, each in peers.items()},
                    {name: each[place] for name, each in values.items() if np.isfinite(each[place]).any()},
                    {name: each[place] for name, each in texts.items() if any(each[place])},
                ),
            )

    def _values(self, table: pa.Table) -> tuple[dict[str, Array], dict[str, list[list[str]]]]:
        """The figures (periods, n) of programs' own by name, and their texts, period by period."""
        count = len(self._number)
        values: dict[str, Array] = {}
        texts: dict[str, list[list[str]]] = {}
        for name in self._value_names:
            if is_text(table[name].type):
                flat = [text or "" for text in table[name].to_pylist()]
                texts[name] = [flat[first : first + count] for first in range(0, len(flat), count)]
            else:
                values[name] = numbers_of(table[name]).reshape(-1, count)
        return values, texts


def _vectors(column: pa.Array, size: int) -> Array:
    """A column of points or matrices as (rows, size); NaN where there is none."""
    array = np.full((len(column), size), np.nan)
    there = np.asarray(column.is_valid())
    array[there] = np.asarray(column.drop_null().flatten(), dtype=float).reshape(-1, size)
    return array


def _of_nodes(row_of: Mapping[str, int], found: Mapping[int, Array]) -> dict[str, Array]:
    """Find by node the entries of the rows of a period."""
    return {node: found[row] for node, row in row_of.items() if row in found}


def _by_row(column: pa.Array) -> dict[int, Array]:
    """The numbers of each list, by row."""
    rows = np.flatnonzero(np.asarray(column.is_valid()))
    lists = column.drop_null()
    ends = np.cumsum(np.asarray(pc.list_value_length(lists), dtype=np.intp))
    numbers = np.split(np.asarray(lists.flatten(), dtype=float), ends[:-1]) if len(rows) else []
    return dict(zip(rows.tolist(), numbers, strict=True))


def _of_peers(column: pa.Array, prefix: str, number: Mapping[str, int]) -> dict[int, Array]:
    """The values (n,) that each node has for others, by row; 0 where none, and no entry where none at all."""
    lists = column.cast(VALUES_AS_LIST)
    entries = lists.flatten()
    name, value = pc.struct_field(entries, "key"), pc.struct_field(entries, "value")
    one = pc.and_(pc.starts_with(name, prefix), pc.equal(pc.list_value_length(value), 1))
    row = pc.list_parent_indices(lists).filter(one).to_numpy()
    amount = np.asarray(value.filter(one).flatten(), dtype=float)
    found: dict[int, Array] = {}
    for place, key, one_value in zip(row.tolist(), name.filter(one).to_pylist(), amount.tolist(), strict=True):
        other = number.get(key.removeprefix(prefix))
        if other is not None:
            found.setdefault(place, np.zeros(len(number)))[other] = one_value
    return found
