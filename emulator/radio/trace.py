"""The trace of a run: one row for each reception in range, and its hash.

Rows are appended as frames are sent, and completed as they arrive. The hash covers the content in canonical order,
so it depends neither on the order of appending nor on the file format.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import ArrayLike, NDArray

from emulator.radio.frames import NO_CAUSE
from emulator.radio.outcomes import PENDING, Outcome
from vnet.types import Array, IntArray

NOT_ARRIVING = -1
"""Arrival time of a reception that does not arrive."""
INITIAL_RECEPTIONS = 1 << 22
"""Initial room for receptions: growing means copying, and the system maps zeroed pages only as they are written."""
INITIAL_FRAMES = 1 << 12
"""Initial room for frames: a few megabytes would be zeroed at once, as the heap has had them before."""

_FRAME = np.dtype(
    [
        ("sent_ns", "<i8"),
        ("seq", "<i8"),
        ("sender", "<i4"),
        ("size_bytes", "<i4"),
        ("payload_digest", "<u8"),
        ("on_air_ns", "<i8"),
        ("left_ns", "<i8"),
        ("copy", "<i2"),
        ("gain_db", "<f8"),
        ("bitrate_mbps", "<f8"),
        ("period_ms", "<i2"),
        ("attempt", "<i2"),
        ("ack_on_air_ns", "<i8"),
        ("acked", "?"),
    ]
)
ACKNOWLEDGED = ("attempt", "ack_on_air_ns", "acked")
"""Columns of the trace where programs send frames to single vehicles."""
LATE = "late_ns"
"""Column of the trace where deliveries were over 20 ms late, in real time: the machine's part of the latency."""
CHOSEN = ("gain_db", "bitrate_mbps")
"""Columns of the trace where programs choose powers or bit rates."""
_RECEPTION = np.dtype(
    [
        ("frame", "<i4"),
        ("receiver", "<i4"),
        ("outcome", "u1"),
        ("altered", "?"),
        ("cause", "<i2"),
        ("arrival_ns", "<i8"),
    ]
)
ROW = np.dtype(
    [
        ("sent_ns", "<i8"),
        ("sender", "<i4"),
        ("seq", "<i8"),
        ("receiver", "<i4"),
        ("size_bytes", "<i4"),
        ("payload_digest", "<u8"),
        ("outcome", "u1"),
        ("cause", "<i2"),
        ("arrival_ns", "<i8"),
        ("copy", "<i2"),
        ("on_air_ns", "<i8"),
        ("left_ns", "<i8"),
    ]
)
_POWER = np.dtype([("rssi_dbm", "<i2"), ("snr_db", "<i2")])
"""Power of a reception, in hundredths of a decibel."""
POWER_STEPS_DB = 100
"""Steps of a decibel to which powers are rounded."""
UNKNOWN_POWER = -(1 << 15)
"""Power of a reception of a frame that was never on air."""
POWERS = ("rssi_dbm", "snr_db")
PERIOD = "period_ms"
"""Column of the trace where programs tell the period of a reservation."""
UNHASHED = (*POWERS, PERIOD)
"""Columns that the hash leaves out. What decides a reception is in others, and these have been added later."""
_NULLABLE = ("arrival_ns", "on_air_ns", "ack_on_air_ns")
_NAMED = ("sender", "receiver", "outcome", "cause")


def decided_ns(rows: NDArray[np.void]) -> NDArray[np.int64]:
    """Return the time (n,) at which each row is decided: its arrival, or else the time it leaves its sender.

    `rows` (n,) are records of type `ROW`.
    """
    return np.asarray(np.where(rows["arrival_ns"] == NOT_ARRIVING, rows["left_ns"], rows["arrival_ns"]))


class _Table:
    """A growing array of records of one type."""

    def __init__(self, kind: np.dtype[np.void], room: int) -> None:
        self._records = np.zeros(room, kind)
        self.count = 0

    @property
    def records(self) -> NDArray[np.void]:
        """The records added so far."""
        return self._records[: self.count]

    def add(self, count: int) -> NDArray[np.void]:
        """Add `count` records and return them, zeroed, for the caller to fill."""
        first, end = self.count, self.count + count
        if end > len(self._records):
            grown = np.zeros(max(2 * len(self._records), end), self._records.dtype)
            grown[:first] = self._records[:first]
            self._records = grown
        self.count = end
        return self._records[first:end]


class Trace:
    """The growing trace of a run. `node_ids` are indexed by the numbers in `sender` and `receiver`.

    The columns that the rows of a frame share are stored once a frame. `knows_air` says that the MAC models when
    frames start and end on air; without it a frame leaves its sender at the time it is sent. `knows_power` says
    that receptions have a power.
    """

    def __init__(self, node_ids: Sequence[str], knows_air: bool = False, knows_power: bool = False) -> None:
        self._node_ids = list(node_ids)
        self._knows_air = knows_air
        self._causes = [""]
        self._receptions = _Table(_RECEPTION, INITIAL_RECEPTIONS)
        self._frames = _Table(_FRAME, INITIAL_FRAMES)
        # 32 MiB, which malloc never takes from the heap: pages from there are zeroed, and so in memory, at once.
        self._powers = _Table(_POWER, 2 * INITIAL_RECEPTIONS if knows_power else 0)
        self.knows_power = knows_power
        self.chooses = False
        """True if a program has chosen a power or a bit rate."""
        self.tells_periods = False
        """True if a program has told the period of a reservation."""
        self.acknowledges = False
        """True if a program has sent a frame to a single vehicle."""
        self._altered: dict[int, int] = {}
        self._late_ns: dict[int, int] = {}

    def __len__(self) -> int:
        return self._receptions.count

    def append(
        self,
        frames: Mapping[str, ArrayLike],
        each: NDArray[np.intp],
        receiver: ArrayLike,
        outcome: NDArray[np.uint8],
        cause: ArrayLike,
        arrival_ns: ArrayLike,
        powers_db: Array | None = None,
    ) -> int:
        """Append the rows of K frames; return the number of the first.

        `frames` are the columns (K,) that all rows of a frame share; the other columns are (n,). `each` (K,) is the
        number of rows of each frame, in order. `cause` are numbers of faults named by `name_cause`; `arrival_ns` is
        used only where the outcome is pending. `powers_db` (2, n) are received powers in dBm and
        their ratios to noise and interference in dB, NaN where the frame was not on air.
        """
        first, first_frame = self._receptions.count, self._frames.count
        new = self._frames.add(len(each))
        for name, values in frames.items():
            new[name] = values
        if not self._knows_air:
            new["left_ns"] = new["sent_ns"]
        rows = self._receptions.add(len(outcome))
        rows["frame"] = np.repeat(np.arange(first_frame, first_frame + len(each)), each)
        rows["receiver"], rows["outcome"], rows["cause"] = receiver, outcome, np.subtract(cause, NO_CAUSE)
        arrives = (outcome == PENDING) | (outcome == Outcome.receiver_down.value)
        rows["arrival_ns"] = np.where(arrives, arrival_ns, NOT_ARRIVING)
        if powers_db is not None:
            powers = self._powers.add(len(outcome))
            for name, power_db in zip(POWERS, powers_db, strict=True):
                steps = np.clip(np.rint(power_db * POWER_STEPS_DB), UNKNOWN_POWER + 1, -UNKNOWN_POWER - 1)
                steps[np.isnan(steps)] = UNKNOWN_POWER
                powers[name] = steps
        return first

    def begin_choices(self, bitrate_mbps: float) -> None:
        """Have columns for the powers and bit rates of frames; those so far had none but this bit rate."""
        if not self.chooses:
            self.chooses = True
            self._frames.records["bitrate_mbps"] = bitrate_mbps

    def acknowledge(self, row: int, ack_on_air_ns: int, acked: bool) -> None:
        """Set when the acknowledgement of the frame of a row began, and whether its sender received it."""
        frame = self._receptions.records["frame"][row]
        self._frames.records["ack_on_air_ns"][frame], self._frames.records["acked"][frame] = ack_on_air_ns, acked

    def powers(self, rows: IntArray) -> tuple[list[float], list[float]]:
        """Return received powers in dBm, and their ratios to noise and interference in dB, of rows (n,)."""
        powers = self._powers.records.view(np.int16).reshape(-1, 2).take(rows, axis=0) / POWER_STEPS_DB
        rssi_dbm, snr_db = powers.T.tolist()
        return rssi_dbm, snr_db

    def alter(self, row: int, payload_digest: int) -> None:
        """Set the digest of the altered payload that arrives in this row."""
        self._receptions.records["altered"][row] = True
        self._altered[row] = payload_digest

    def column(self, name: str) -> NDArray[Any]:
        """Return a column of the trace so far, as numbers."""
        return np.asarray(self.rows(slice(None))[name])

    def sizes(self) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Return the senders' numbers (K,) and payload sizes in bytes (K,) of all frames sent, copies left out."""
        frames = self._frames.records[self._frames.records["copy"] == 0]
        return frames["sender"], frames["size_bytes"]

    def name_cause(self, number: int, name: str) -> None:
        """Set the name of fault `number`."""
        missing = number + 2 - len(self._causes)
        self._causes += [""] * missing
        self._causes[number - NO_CAUSE] = name

    def decide(self, rows: Sequence[int] | NDArray[np.intp], outcome: Outcome) -> None:
        """Set the outcome of rows."""
        self._receptions.records["outcome"][rows] = outcome.value

    def miss(self, row: int, arrival_ns: int) -> None:
        """Set the outcome of a row to `receiver_down`, and when it would have arrived."""
        self._receptions.records["arrival_ns"][row] = arrival_ns
        self.decide([row], Outcome.receiver_down)

    def delay(self, row: int, arrival_ns: int) -> None:
        """Set the true arrival of a row that the machine delivered late."""
        self._late_ns[row] = arrival_ns - int(self._receptions.records["arrival_ns"][row])
        self._receptions.records["arrival_ns"][row] = arrival_ns

    def rows(self, index: NDArray[np.intp] | slice) -> NDArray[np.void]:
        """Return the rows at `index` as records of type `ROW`."""
        receptions = self._receptions.records[index]
        frames = self._frames.records[receptions["frame"]]
        rows = np.zeros(len(receptions), ROW)
        for name in ROW.fields or ():
            rows[name] = receptions[name] if name in (_RECEPTION.fields or ()) else frames[name]
        number = range(self._receptions.count)[index] if isinstance(index, slice) else index
        for i in np.flatnonzero(receptions["altered"]).tolist():
            rows["payload_digest"][i] = self._altered[int(number[i])]
        return rows

    def frames_of(self, rows: IntArray) -> list[NDArray[Any]]:
        """Return the senders' numbers, the numbers of the frames and of the copies of rows (n,), an array each."""
        frames = self._frames.records[self._receptions.records["frame"][rows]]
        return [frames[name] for name in ("sender", "seq", "copy")]

    def to_table(self) -> pa.Table:
        """Return the trace as a table in canonical order: (sent_ns, sender number, seq, receiver number, copy).

        With `[radio.mac]` there are two more columns: `on_air_ns`, the start of a frame's transmission (null if it
        never started), and `left_ns`, the time at which it ended or the frame was dropped. With a path loss there
        are `rssi_dbm` and `snr_db`, null for a frame that was never on air. Where programs have chosen a power or a
        bit rate, there are `gain_db`, the frame's power above the scenario's, and `bitrate_mbps`; where they have
        told the period of a reservation, `period_ms`, 0 for other frames. Where they have sent frames to single
        vehicles, there are `attempt` (0 for a broadcast), `ack_on_air_ns`, the start of the acknowledgement (null
        without one), and `acked`, whether the sender received that. Where the machine delivered late, in real time,
        there is `late_ns`, its part of the latency.
        """
        receptions, frames, powers = self._receptions.records, self._frames.records, self._powers.records
        order = self._canonical_order()
        of_row = receptions["frame"][order]

        def values_of(column: str) -> NDArray[Any]:
            return receptions[column][order] if column in (_RECEPTION.fields or ()) else frames[column][of_row]

        digest = values_of("payload_digest")
        for i in np.flatnonzero(receptions["altered"][order]).tolist():
            digest[i] = self._altered[int(order[i])]

        def named(column: str, names: Sequence[str]) -> pa.DictionaryArray:
            codes = pa.array(values_of(column).astype(np.int32))
            return pa.DictionaryArray.from_arrays(codes, pa.array(list(names), pa.string()))

        def plain(column: str) -> pa.Array:
            return pa.array(values_of(column))

        def optional(column: str) -> pa.Array:
            values = values_of(column)
            return pa.array(values, mask=values == NOT_ARRIVING)

        return pa.table(
            {
                "sent_ns": plain("sent_ns"),
                "sender": named("sender", self._node_ids),
                "seq": plain("seq"),
                "receiver": named("receiver", self._node_ids),
                "size_bytes": plain("size_bytes"),
                "payload_digest": pa.array(digest),
                "outcome": named("outcome", [outcome.name for outcome in Outcome]),
                "cause": named("cause", self._causes).cast(pa.string()),
                "arrival_ns": optional("arrival_ns"),
                "copy": plain("copy"),
                **({"on_air_ns": optional("on_air_ns"), "left_ns": plain("left_ns")} if self._knows_air else {}),
                **({name: plain(name) for name in CHOSEN} if self.chooses else {}),
                **({PERIOD: plain(PERIOD)} if self.tells_periods else {}),
                **(_exchanges(frames[of_row]) if self.acknowledges else {}),
                **({LATE: pa.array(self._late(order))} if self._late_ns else {}),
                **({name: _in_db(powers[name][order]) for name in POWERS} if self.knows_power else {}),
            }
        )

    def _canonical_order(self) -> NDArray[np.intp]:
        """Return the rows in canonical order. Their frames are put in order first, which are far fewer."""
        frames, of_row = self._frames.records, self._receptions.records["frame"]
        by_name = np.lexsort((frames["seq"], frames["sender"], frames["sent_ns"]))
        is_new = np.zeros(len(frames), np.int64)
        for name in ("seq", "sender", "sent_ns"):
            is_new[1:] |= frames[name][by_name[1:]] != frames[name][by_name[:-1]]
        place = np.empty(len(frames), np.int64)
        place[by_name] = np.cumsum(is_new)  # copies have the place of their original
        key = place[of_row] * len(self._node_ids) + self._receptions.records["receiver"]
        return np.lexsort((frames["copy"][of_row], key))

    def _late(self, order: NDArray[np.intp]) -> IntArray:
        """Return how late the machine delivered each row, in the order of the table."""
        late_ns = np.zeros(len(self), np.int64)
        late_ns[list(self._late_ns)] = list(self._late_ns.values())
        return late_ns[order]

    def sha256(self) -> str:
        """Return the hash of the content; see `sha256_of_table`."""
        return sha256_of_table(self.to_table())


def _exchanges(frames: NDArray[np.void]) -> dict[str, pa.Array]:
    """Return the columns `ACKNOWLEDGED` of rows, from their frames (n,)."""
    began_ns = frames["ack_on_air_ns"]
    columns = pa.array(frames["attempt"]), pa.array(began_ns, mask=began_ns == 0), pa.array(frames["acked"])
    return dict(zip(ACKNOWLEDGED, columns, strict=True))


def _in_db(power: NDArray[np.int16]) -> pa.Array:
    return pa.array(power / POWER_STEPS_DB, mask=power == UNKNOWN_POWER)


def sha256_of_table(table: pa.Table) -> str:
    """SHA-256 of a trace's content in the order of its rows, independent of how it was stored."""
    digest = hashlib.sha256()
    for column in (name for name in table.column_names if name not in UNHASHED):
        array = table.column(column).combine_chunks()
        if column in _NAMED:
            codes, names = _canonical_codes(array)
            digest.update(json.dumps([column, names]).encode())
        else:
            filled = pc.fill_null(array, NOT_ARRIVING) if column in _NULLABLE else array
            codes = filled.to_numpy(zero_copy_only=False)
            digest.update(json.dumps([column]).encode())
        digest.update(np.ascontiguousarray(codes, dtype=codes.dtype.newbyteorder("<")).tobytes())
    return digest.hexdigest()


def _canonical_codes(array: pa.Array) -> tuple[NDArray[np.int32], list[str]]:
    """Return an array of names as codes (n,) into the sorted list of the names that occur, and this list."""
    if not pa.types.is_dictionary(array.type):
        array = array.dictionary_encode()
    values = array.dictionary.to_pylist()
    indices = array.indices.to_numpy(zero_copy_only=False)
    used = np.flatnonzero(np.bincount(indices, minlength=len(values)))
    names = sorted(values[i] for i in used)
    code = np.full(len(values), -1, dtype=np.int32)
    for number in used:
        code[number] = names.index(values[number])
    return code[indices], names


def payload_digest(payload: bytes) -> int:
    """Return the digest of a payload: BLAKE2b of 8 bytes, little-endian."""
    return int.from_bytes(hashlib.blake2b(payload, digest_size=8).digest(), "little")
