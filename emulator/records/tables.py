"""The tables of a run's folder, each declared once: its file, its rows, its columns, and which runs have it.

Writer, reader, manifest, CSV export and the reference page draw from `TABLES`. A table more is a `Table` here, and
the code that fills it (`emulator.drivers.conclude.gather`); `recorded.table(…)` gives it to readers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields

import pyarrow as pa

from emulator.records.period_figures import NUMBER, NUMBERS, PeriodFigures, ProgramFigures
from emulator.scenario.scenario import Scenario

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
    """Return the columns of a table in a run whose program declares these figures."""
    if table is METRICS:
        return _figures(declared.row)
    own = declared.columns.values() if table is STATES else ()
    return {
        **table.columns,
        **{each.name: Column(pa.list_(FLOAT, each.size or -1), each.text, True) for each in own},
    }


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
    further="Then the figures that the program declares: [own figures](../how-to/own-figures.md).",
)
STATES = Table(
    "states", "a row for each vehicle and period",
    {
        "period": Column(pa.int32(), "counts from 0"),
        "time_ns": Column(INT, "start of the period"),
        "node": Column(NAME, ID),
        "position_m": Column(POINT, "truth; NaN of a vehicle that is not there"),
        "heading_rad": Column(FLOAT, "truth, counter-clockwise from east; NaN of one that is not there, or that "
                                     "nobody "
                              "knows"),
        "fix_m": Column(POINT, "what the receiver gave; NaN in an outage"),
        "common_error_m": Column(POINT, "truth: the error that all receivers share"),
        "estimate_m": Column(POINT, "the position that the vehicle reported last in this period; null if it "
                                    "reported "
                             "none", True),
        "covariance_m2": Column(MATRIX, "of `estimate_m`, as it reported: a 2 × 2 matrix by rows", True),
        "values": Column(pa.map_(TEXT, pa.list_(FLOAT)), "what it reported besides and has no column, by name: "
                                                         "lists, "
                         "and values of each pair of vehicles", True),
    },
    which=": truth and beliefs",
    further="Then the columns that the program declares for lists, and a column for each number (`double`), "
            "boolean (`bool`) or text (`string`) that programs report by a "
    "name of their own, called as they call it: [own figures](../how-to/own-figures.md). Those after the first 64 "
    "names stay in `values`.",
)
BUSY = Table(
    "busy", "a row for each vehicle and 100 ms",
    {
        "time_ns": Column(INT, "when the 100 ms began"),
        "node": Column(NAME, ID),
        "busy_ratio": Column(FLOAT, "the share of them in which it sent, or sensed `radio.mac.carrier_sense_dbm` "
                                    "or more"),
    },
    which=": how busy the medium was that they share, with `[radio.mac]`", is_due=_with_mac,
)
DRIVEN = Table(
    "driven", "a row for each control instant and vehicle",
    {
        "time_ns": Column(INT, "the control instant"),
        "node": Column(NAME, ID),
        "along_m": Column(FLOAT, "truth: position of its centre along the road, or on a map its route; on a ring "
                                 "it "
                          "goes on counting. NaN once it has left. In SUMO the way since it was inserted"),
        "left_m": Column(FLOAT, "truth: its distance to the left of the rightmost lane's centre; in SUMO of its "
                                "own "
                         "lane's"),
        "speed_m_s": Column(FLOAT, "truth: its speed"),
        "acceleration_m_s2": Column(FLOAT, "truth: its acceleration"),
        "command_m_s2": Column(FLOAT, "the acceleration that it was told from this instant on, within its "
                                      "limits; NaN "
                               "if SUMO drives"),
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
        "arrival_ns": Column(INT, "when it arrived; null if it did not", True),
        "copy": Column(pa.int16(), "0; 1, 2, … for what a fault sends, or lets arrive, again"),
        "on_air_ns": Column(INT, "with `[radio.mac]` only: when its transmission began; null if it never did", True,
                            _with_mac),
        "left_ns": Column(INT, "with `[radio.mac]` only: when its transmission ended, or it was given up",
                          is_due=_with_mac),
        "rssi_dbm": Column(FLOAT, f"{_POWERS}received power; null if the frame was never on air", True, _never),
        "snr_db": Column(FLOAT, f"{_POWERS}received power over noise and interference, the mean of the payload",
                                 True,
                         _never),
        "gain_db": Column(FLOAT, f"{_CHOSEN}power of the frame above that of the scenario", is_due=_never),
        "bitrate_mbps": Column(FLOAT, f"{_CHOSEN}its bit rate", is_due=_never),
        "attempt": Column(pa.int16(), f"{_UNICAST}number of the transmission, each of which has one row, that of "
                                       "its "
                          "addressee, with another `copy`; 0 for a broadcast", is_due=_never),
        "ack_on_air_ns": Column(INT, f"{_UNICAST}start of the acknowledgement; null without one", True, _never),
        "acked": Column(pa.bool_(), f"{_UNICAST}whether the sender received that", is_due=_never),
        "late_ns": Column(INT, "where, in real time, the machine delivered over 20 ms late: its part of "
                               "`arrival_ns`, "
                          "which is when the packet came; the radio's own arrival is `arrival_ns - late_ns`", True,
                          _never),
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
# fmt: on
TABLES = [TRACE, STATES, BUSY, DRIVEN, BACKBONE, BACKGROUND, METRICS, PAYLOADS]
