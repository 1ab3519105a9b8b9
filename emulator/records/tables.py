"""The tables of a run's folder, each declared once: its file, its rows, its columns, and which runs have it.

Writer, reader, manifest, CSV export and the reference page draw from `TABLES`. A table more is a `Table` here, and
the code that fills it (`emulator.drivers.conclude.gather`); `recorded.table(…)` gives it to readers.
"""

from __future__ import annotations

import os
import resource
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from emulator.radio.medium import WINDOW_NS
from emulator.radio.trace import payload_digest
from emulator.records.events import Event, EventKind
from emulator.records.period_figures import NUMBER, NUMBERS, PeriodFigures, ProgramFigures
from emulator.scenario.scenario import Scenario
from emulator.world.driven.stepped import Background
from emulator.world.driven.vehicles import Log
from vnet.bounded import open_regular
from vnet.errors import ScenarioError, VnetError
from vnet.types import Array, IntArray

BYTES_A_VALUE = {"BOOLEAN": 1, "INT32": 4, "FLOAT": 4, "INT64": 8, "DOUBLE": 8, "BYTE_ARRAY": 4}
"""Memory of a value by its type in the file; texts are kept once, and have a number of 4 bytes each."""
LARGEST_RATIO = 1000
"""Bytes of memory for a byte of a file; runs have written 15 at most."""
LEAST_BOUND_BYTES = 1 << 26
"""Memory that every table may take."""
VALUES_AS_LIST = pa.list_(pa.struct([("key", pa.string()), ("value", pa.list_(pa.float64()))]))
"""The type of the states' column `values` as a list, which more functions of Arrow know than maps."""


class _NoPandas:
    """Finder of modules that lets an import of pandas fail, as where it is not installed."""

    @staticmethod
    def find_spec(name: str, path: object = None, target: object = None) -> None:
        """Raise ModuleNotFoundError for pandas."""
        if name == "pandas":
            raise ModuleNotFoundError(name)


def _make_first_array() -> None:
    """Have pyarrow make its first array, for which it imports pandas where it can, and nothing here needs it.

    It takes as long as vnet's own start. What does need it, as `to_pandas()`, imports it then.
    """
    sys.meta_path.insert(0, _NoPandas)
    try:
        pa.array([0])
    finally:
        sys.meta_path.remove(_NoPandas)


_make_first_array()

Condition = Callable[[Scenario], bool]


def always(scenario: Scenario) -> bool:
    """Hold for every run; readers then need no scenario."""
    return True


def _never(scenario: Scenario) -> bool:
    return False


def _with_mac(scenario: Scenario) -> bool:
    return scenario.radio.mac is not None


@dataclass(frozen=True)
class Column:
    """A column: its type, its text, whether every row has a value, and which runs must have it."""

    type: pa.DataType
    text: str
    has_gaps: bool = False
    is_due: Condition = always


@dataclass(frozen=True, eq=False)
class Table:
    """A table of a run's folder, `name`.parquet.

    `rows` says what has a row, and `which` in which runs, for the reference page; `is_due` is the same as a
    condition, or None if only the folder knows. `about` stands above the columns and `further` below. Columns
    without a text are the fields of `fields_of`, whose docstrings describe them.
    """

    name: str
    rows: str
    columns: Mapping[str, Column]
    which: str = ""
    is_due: Condition | None = always
    about: str = ""
    further: str = ""
    fields_of: type | None = None

    @property
    def file(self) -> str:
        """Name of its file."""
        return f"{self.name}.parquet"

    @property
    def schema(self) -> pa.Schema:
        """All columns with their types."""
        return schema_of(self.columns)


def schema_of(columns: Mapping[str, Column]) -> pa.Schema:
    """Return the types of columns."""
    return pa.schema([(name, column.type) for name, column in columns.items()])


def columns_of(table: Table, declared: ProgramFigures) -> Mapping[str, Column]:
    """Return the columns of a table in a run whose program declares these figures.

    Raises ScenarioError if a column is there twice.
    """
    if table is METRICS:
        return _figures(declared.row)
    columns = dict(table.columns)
    for each in declared.columns.values() if table is STATES else ():
        if each.name in columns:
            raise ScenarioError(f"{declared.entry}: COLUMNS: {each.name} is a column of vnet's, or is there twice")
        columns[each.name] = Column(pa.list_(FLOAT, each.size or -1), each.text, True)
    return columns


def _figures(row: type) -> dict[str, Column]:
    return {each.name: Column(ARROW[str(each.type)], "", str(each.type) == NUMBER) for each in fields(row)}


ID = "id of the vehicle"
NAME, TEXT = pa.dictionary(pa.int32(), pa.string()), pa.string()
INT, FLOAT = pa.int64(), pa.float64()
POINT, MATRIX = pa.list_(FLOAT, 2), pa.list_(FLOAT, 4)
ARROW = {"int": INT, NUMBER: FLOAT, NUMBERS: pa.list_(FLOAT)}
"""Types of the columns of the metrics by those of the figures."""
TRUTH = ("period", "time_ns", "node", "position_m", "heading_rad", "fix_m", "common_error_m")
"""Columns of the states that reports have no part in."""

# fmt: off
METRICS = Table(
    "metrics", "a row for each period", _figures(PeriodFigures), which=": errors", fields_of=PeriodFigures,
    further="Then the figures that the program [declares](../how-to/results.md#declare-figures-of-periods).",
)
STATES = Table(
    "states", "a row for each vehicle and period",
    {
        "period": Column(pa.int32(), "counts from 0"),
        "time_ns": Column(INT, "start of the period"),
        "node": Column(NAME, ID),
        "position_m": Column(POINT, "truth; NaN of a vehicle that is not there"),
        "heading_rad": Column(FLOAT, "truth, counter-clockwise from east; NaN of one that is not there, or that "
                              "nobody knows"),
        "fix_m": Column(POINT, "what the receiver gave; NaN in an outage"),
        "common_error_m": Column(POINT, "truth: the error that all receivers share"),
        "estimate_m": Column(POINT, "the position in the vehicle's last report of this period; null if it "
                             "reported none", True),
        "covariance_m2": Column(MATRIX, "of `estimate_m`, as it reported: a 2 × 2 matrix by rows", True),
        "values": Column(pa.map_(TEXT, pa.list_(FLOAT)), "what it reported besides and has no column, by name: "
                         "lists, and values of each pair of vehicles", True),
    },
    which=": truth and beliefs",
    further="Then the columns that the program declares for lists, and a column for each number (`double`), "
            "boolean (`bool`) or text (`string`) that programs report by a "
    "name of their own, called as they call it: [own figures](../how-to/results.md#report-figures). Those after "
    "the first 64 names stay in `values`.",
)
BUSY = Table(
    "busy", "a row for each vehicle and 100 ms",
    {
        "time_ns": Column(INT, "when the 100 ms began"),
        "node": Column(NAME, ID),
        "busy_ratio": Column(FLOAT, "the share of them in which it sent, or sensed `radio.mac.carrier_sense_dbm` "
                                    "or more (sidelink: of subchannels); 0 of the absent"),
    },
    which=": how busy the medium was that they share, with `[radio.mac]`", is_due=_with_mac,
)
DRIVEN = Table(
    "driven", "a row for each control instant and vehicle",
    {
        "time_ns": Column(INT, "the control instant"),
        "node": Column(NAME, ID),
        "along_m": Column(FLOAT, "truth: position of its centre along the road, or on a map its route; on a ring "
                          "it goes on counting. NaN once it has left. In SUMO the way since it was inserted"),
        "left_m": Column(FLOAT, "truth: its distance to the left of the rightmost lane's centre; in SUMO of its "
                         "own lane's"),
        "speed_m_s": Column(FLOAT, "truth: its speed"),
        "acceleration_m_s2": Column(FLOAT, "truth: its acceleration"),
        "command_m_s2": Column(FLOAT, "the acceleration that it was told from this instant on, within its "
                               "limits; NaN if SUMO drives"),
    },
    which=", where programs drive", is_due=lambda scenario: scenario.network.programs_drive,
)
BACKBONE = Table(
    "backbone", "a row for each message and receiver",
    {
        "sent_ns": Column(INT, "when it was sent"),
        "sender": Column(TEXT, "id of the roadside unit that has sent it"),
        "number": Column(INT, "counts the messages of the sender, from 0"),
        "receiver": Column(TEXT, "id of a unit that it was meant for"),
        "size_bytes": Column(INT, "length of the payload"),
        "payload_digest": Column(pa.uint64(), "as in the trace"),
        "arrival_ns": Column(INT, "when it arrived, or would have; null if it was lost", True),
        "outcome": Column(TEXT, "`delivered`, `loss`, `receiver_down`, or `in_flight` at the end of the run"),
    },
    which=", where there are roadside units", is_due=lambda scenario: bool(scenario.roadside),
)
BACKGROUND = Table(
    "background", "a row for each period and vehicle without a program",
    {
        "time_ns": Column(INT, "the start of the period"),
        "vehicle": Column(NAME, "its id in SUMO"),
        "x_m": Column(FLOAT, "truth: east of the middle of its front bumper"),
        "y_m": Column(FLOAT, "truth: north of it"),
    },
    which=", with [SUMO in the loop](../how-to/sumo-in-the-loop.md)", is_due=None, about="No hash depends on it.",
)
_POWERS = "with `[radio.path_loss]` only: "
_CHOSEN = "where programs have [chosen powers or bit rates](../radio.md#power-and-bit-rate-of-a-frame): "
_UNICAST = "where programs have sent [frames to single vehicles](../radio.md#frames-to-one-vehicle): "
TRACE = Table(
    "trace", "a row for each frame and receiver in range",
    {
        "sent_ns": Column(INT, "when the program handed it to the radio"),
        "sender": Column(NAME, ID),
        "seq": Column(INT, "number of the frame, of this sender, from 0"),
        "receiver": Column(NAME, ID),
        "size_bytes": Column(pa.int32(), "length of the payload"),
        "payload_digest": Column(pa.uint64(), "BLAKE2b of what arrives, 8 bytes, little-endian"),
        "outcome": Column(NAME, "[what became of it](#outcomes)"),
        "cause": Column(TEXT, "the fault behind an outcome `fault`, a copy or changed bytes, as `loss-0`; else "
                              "empty"),
        "arrival_ns": Column(INT, "when it arrived, or (`transport`) was due; null if it did not", True),
        "copy": Column(pa.int16(), "0; 1, 2, … for what a fault sends, or lets arrive, again"),
        "on_air_ns": Column(INT, "with `[radio.mac]` only: when its transmission began; null if it never did", True,
                            _with_mac),
        "left_ns": Column(INT, "with `[radio.mac]` only: when its transmission ended, or it was given up",
                          is_due=_with_mac),
        "rssi_dbm": Column(FLOAT, f"{_POWERS}received power; null if the frame was never on air", True, _never),
        "snr_db": Column(FLOAT, f"{_POWERS}received power over noise and interference, the mean of the payload",
                         True, _never),
        "gain_db": Column(FLOAT, f"{_CHOSEN}power of the frame above that of the scenario", is_due=_never),
        "bitrate_mbps": Column(FLOAT, f"{_CHOSEN}its bit rate", is_due=_never),
        "period_ms": Column(pa.int16(), "on a sidelink where programs tell it: the period of the reservation, or 0",
                            is_due=_never),
        "attempt": Column(pa.int16(), f"{_UNICAST}number of the transmission, each of which has one row, that of "
                          "its addressee, with another `copy`; 0 for a broadcast", is_due=_never),
        "ack_on_air_ns": Column(INT, f"{_UNICAST}start of the acknowledgement; null without one", True, _never),
        "acked": Column(pa.bool_(), f"{_UNICAST}whether the sender received that", is_due=_never),
        "late_ns": Column(INT, "where, in real time, the machine delivered over 20 ms late: its part of "
                          "`arrival_ns`, which is when the packet came; the radio's own arrival is "
                          "`arrival_ns - late_ns`", True, _never),
    },
    about="In the order of `sent_ns`, sender, `seq`, receiver, `copy`.",
)
PAYLOADS = Table(
    "payloads", "a row for each frame",
    {
        "time_ns": Column(INT, "when the program handed it to the radio"),
        "sender": Column(TEXT, ID),
        "seq": Column(INT, "number of the frame, as in the trace"),
        "payload": Column(pa.large_binary(), "what the program sent; faults may let something else arrive"),
    },
    which=", with `run.keep_payloads`", is_due=None, about="No hash depends on it.",
)
SAMPLES = Table(
    "samples", "a row for each message of a Zenoh program that was sent by radio",
    {
        "time_ns": Column(INT, "when it was handed to the radio"),
        "sender": Column(TEXT, ID),
        "seq": Column(INT, "number of its first frame, as in the trace"),
        "frames": Column(pa.int32(), "number of its frames with a receiver in range"),
        "kind": Column(TEXT, "put, delete, query, reply, error, or tokens"),
        "key": Column(TEXT, "its key, a query's selector, or the keys of tokens"),
        "payload_bytes": Column(INT, "bytes of its payload"),
    },
    which=', with `program.kind = "zenoh"`', is_due=None, about="No hash depends on it.",
)
# fmt: on
TABLES = [TRACE, STATES, BUSY, DRIVEN, BACKBONE, BACKGROUND, METRICS, PAYLOADS, SAMPLES]


def background_table(background: Background | None) -> pa.Table | None:
    """Return a row for each period and vehicle that is there at its start; None where there is no such traffic."""
    if background is None:
        return None
    counts = [len(numbers) for numbers in background.numbers]
    number = np.concatenate([np.zeros(0, np.int32), *background.numbers])
    position_m = np.concatenate([np.zeros((0, 2)), *background.position_m])
    names = pa.array(list(background.names), pa.string())
    columns = [
        pa.array(np.repeat(np.array(background.time_ns, dtype=np.int64), counts)),
        pa.DictionaryArray.from_arrays(pa.array(number), names),
        pa.array(position_m[:, 0]),
        pa.array(position_m[:, 1]),
    ]
    return pa.table(columns, BACKGROUND.schema)


def positions_by_time(table: pa.Table | None) -> dict[int, Array]:
    """Return the positions (k, 2) of the vehicles by each time in ns at which there were any."""
    if table is None or not len(table):
        return {}
    time_ns, position_m = table["time_ns"].to_numpy(), np.column_stack([table["x_m"], table["y_m"]])
    first = np.flatnonzero(np.diff(time_ns, prepend=-1))
    return dict(zip(time_ns[first].tolist(), np.split(position_m, first[1:]), strict=True))


class BackboneRow(NamedTuple):
    """Outcome of a message at one receiver; `arrival_ns` is None if it was lost."""

    sent_ns: int
    sender: str
    number: int
    receiver: str
    size_bytes: int
    payload_digest: int
    arrival_ns: int | None
    outcome: str


def backbone_table(rows: Sequence[BackboneRow]) -> pa.Table:
    """Return a row for each message and receiver, in the order of sending, sender, number and receiver."""
    in_order = sorted(rows, key=lambda row: row[:4])
    columns = zip(*in_order, strict=True) if in_order else [[]] * len(BACKBONE.columns)
    return pa.table(list(map(pa.array, columns, BACKBONE.schema.types)), BACKBONE.schema)


def backbone_figures(table: pa.Table | None) -> dict[str, int]:
    """Return the number of receptions by outcome; none without roadside units."""
    if table is None:
        return {}
    counted = pc.value_counts(table["outcome"]).to_pylist()
    return {each["values"]: each["counts"] for each in sorted(counted, key=lambda each: each["values"])}


def on_backbone(figures: Mapping[str, int]) -> str:
    """Return the figures of a run's backbone in words."""
    return f"{figures.get('delivered', 0):,} of {sum(figures.values()):,} delivered"


def by_instant(time_ns: Sequence[int] | IntArray, node_ids: Sequence[str]) -> dict[str, pa.Array]:
    """Return the columns `time_ns` and `node` of a table with a row for each instant and node."""
    node = pa.array(np.tile(np.arange(len(node_ids), dtype=np.int32), len(time_ns)))
    return {
        "time_ns": pa.array(np.repeat(np.array(time_ns, dtype=np.int64), len(node_ids))),
        "node": pa.DictionaryArray.from_arrays(node, pa.array(list(node_ids), pa.string())),
    }


def busy_table(windows: Array, node_ids: Sequence[str]) -> pa.Table:
    """Busy ratios (windows, N) as a table, a row for each window and vehicle."""
    places = by_instant(np.arange(len(windows)) * WINDOW_NS, node_ids)
    return pa.table({**places, "busy_ratio": pa.array(windows.ravel())}, BUSY.schema)


def busy_windows(table: pa.Table | None, node_ids: Sequence[str]) -> Array:
    """The ratios (windows, N) of such a table; no windows if it is None. Raises VnetError if it is another one."""
    count = len(node_ids)
    if table is None:
        return np.zeros((0, count))
    windows = len(table) // max(1, count)
    number = pc.index_in(table["node"].cast(pa.string()), value_set=pa.array(list(node_ids), pa.string()))
    if not np.array_equal(pc.fill_null(number, -1).to_numpy(), np.tile(np.arange(count), windows)):
        raise VnetError(f"{BUSY.file}: its rows are not those of {count} vehicles, one window after the other")
    return np.asarray(table["busy_ratio"].cast(pa.float64()).to_numpy()).reshape(windows, count)


def mean_busy(windows: Sequence[Array] | Array, count: int, start_ns: int, end_ns: int) -> Array:
    """The means (count,) of the windows (count,) that ended in (start, end], else the last before; NaN if none."""
    end = min(end_ns // WINDOW_NS, len(windows))
    some = windows[max(0, min(start_ns // WINDOW_NS, end - 1)) : end]
    return np.mean(some, axis=0) if len(some) else np.full(count, np.nan)


class PayloadRecorder:
    """Collects the payloads of a run in memory. Nodes have the numbers 0 … N-1 in the order of `node_ids`."""

    def __init__(self, node_ids: Sequence[str]) -> None:
        self._node_ids = node_ids
        self._rows: list[tuple[int, int, int, bytes]] = []

    def add(self, time_ns: int, node: int, seq: int, payload: bytes) -> None:
        """Keep the payload of a frame."""
        self._rows.append((time_ns, node, seq, payload))

    def to_table(self) -> pa.Table:
        """Return the rows of `payloads.parquet`."""
        times_ns, nodes, seqs, payloads = zip(*self._rows, strict=True) if self._rows else ((), (), (), ())
        return pa.table(
            [times_ns, [self._node_ids[node] for node in nodes], seqs, payloads], schema=PAYLOADS.schema
        )


class KeptPayloads:
    """The payloads of a recorded run, by sender and number of the frame."""

    def __init__(self, table: pa.Table) -> None:
        self.table = table
        columns = (table[name].to_pylist() for name in ("sender", "seq", "payload"))
        self._payload = {(sender, seq): payload for sender, seq, payload in zip(*columns, strict=True)}

    def of(self, sender: str, seq: int, digests: Collection[int]) -> bytes | None:
        """Return the payload of a frame; None if no digest is its own, as where a fault has altered it."""
        payload = self._payload.get((sender, seq))
        return payload if payload is not None and payload_digest(payload) in digests else None


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


_TIME, _NODE, *QUANTITIES = DRIVEN.columns
"""The columns besides time and vehicle are in the order of the log's rows."""


def driven_table(log: Log, node_ids: Sequence[str]) -> pa.Table:
    """Return a row for each control instant and vehicle; NaN for a vehicle that has left."""
    rows = np.array(log.rows).reshape(len(log.time_ns), len(QUANTITIES), len(node_ids))
    columns = {name: pa.array(rows[:, index].ravel()) for index, name in enumerate(QUANTITIES)}
    return pa.table({**by_instant(log.time_ns, node_ids), **columns}, DRIVEN.schema)


def of_vehicles(table: pa.Table, name: str, count: int) -> tuple[Array, Array]:
    """Return times (K,) in s and one quantity of all `count` vehicles (K, N) of such a table."""
    time_s = table["time_ns"].to_numpy()[::count] / 1e9
    return time_s, np.asarray(table[name].to_numpy()).reshape(len(time_s), count)


def driving_figures(table: pa.Table | None, events: Sequence[Event]) -> dict[str, float | None]:
    """Return the figures of a run in which programs drive: collisions, limited actions, hardest braking (m/s²)."""
    if table is None:
        return {}
    lowest = pc.min(pc.if_else(pc.is_nan(table["acceleration_m_s2"]), None, table["acceleration_m_s2"])).as_py()
    return {
        "collisions": sum(event.kind == EventKind.collision for event in events),
        "limited_actions": sum(event.kind == EventKind.drive_limited for event in events),
        "hardest_braking_m_s2": None if lowest is None else max(0.0, -lowest),
    }
