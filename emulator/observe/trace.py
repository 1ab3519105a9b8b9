"""The trace of a run: one row per frame and receiver in range, and its hash.

Rows are appended as frames are sent and completed when they arrive. The hash is over the content in canonical
order, so that neither the order of appending nor the file format can change it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import ArrayLike, NDArray

from emulator.channel.frames import NO_CAUSE
from emulator.channel.outcomes import Outcome

NOT_ARRIVING = -1
FIRST_ROWS = 1 << 22
"""Room from the start: the system hands out zeroed pages only as they are written, and growing means copying."""

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
_NAMED = ("sender", "receiver", "outcome", "cause")


def decided_ns(rows: NDArray[np.void]) -> NDArray[np.int64]:
    """When each of these records of type `ROW` is decided: as it arrives, or else as it leaves its sender."""
    return np.asarray(np.where(rows["arrival_ns"] == NOT_ARRIVING, rows["left_ns"], rows["arrival_ns"]))


class Trace:
    """The growing trace of a run. `node_ids` are indexed by the numbers in `sender` and `receiver`.

    `knows_air` says that frames have times at which they went on air and left it; else they leave as they are sent.
    """

    def __init__(self, node_ids: Sequence[str], knows_air: bool = False) -> None:
        self._node_ids = list(node_ids)
        self._knows_air = knows_air
        self._causes = [""]
        self._rows = np.zeros(FIRST_ROWS, dtype=ROW)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def append(self, count: int, **columns: ArrayLike) -> int:
        """Add `count` rows, one for each frame and receiver; returns the number of the first.

        All columns are wanted, each a number or (count,). `payload_digest` is of what arrives; `cause` are numbers
        of faults, whose names `name_cause` has told; `arrival_ns` counts only where the outcome is pending.
        """
        first, end = self._count, self._count + count
        if end > len(self._rows):
            grown = np.zeros(max(2 * len(self._rows), end), dtype=ROW)
            grown[:first] = self._rows[:first]
            self._rows = grown
        rows = self._rows[first:end]
        for name, values in columns.items():
            rows[name] = values
        if not self._knows_air:
            rows["left_ns"] = rows["sent_ns"]
        rows["cause"] -= NO_CAUSE
        rows["arrival_ns"][rows["outcome"] != Outcome.pending] = NOT_ARRIVING
        self._count = end
        return first

    def column(self, name: str) -> NDArray[Any]:
        """A column of the trace so far, as numbers."""
        return np.asarray(self._rows[name][: self._count])

    def name_cause(self, number: int, name: str) -> None:
        """Say what fault `number` is called."""
        missing = number + 2 - len(self._causes)
        self._causes += [""] * missing
        self._causes[number - NO_CAUSE] = name

    def decide(self, rows: Sequence[int] | NDArray[np.intp], outcome: Outcome) -> None:
        """Give rows their outcome."""
        self._rows["outcome"][rows] = outcome

    def rows(self, which: NDArray[np.intp] | slice) -> NDArray[np.void]:
        """These rows as records of type `ROW`, which they are: to be read only."""
        return self._rows[which]

    def to_table(self) -> pa.Table:
        """The trace as a table in canonical order: (sent_ns, sender number, seq, receiver number, copy).

        Where senders share the air there are two columns more: `on_air_ns`, when a frame's transmission began (null
        if it never did), and `left_ns`, when it ended, or the frame was given up.
        """
        rows = self._rows[: self._count]
        order = np.lexsort((rows["copy"], rows["receiver"], rows["seq"], rows["sender"], rows["sent_ns"]))
        rows = rows[order]
        outcome_names = [outcome.name for outcome in Outcome]

        def named(column: str, names: Sequence[str]) -> pa.DictionaryArray:
            return pa.DictionaryArray.from_arrays(
                pa.array(rows[column].astype(np.int32)), pa.array(list(names), pa.string())
            )

        times = ("arrival_ns", "on_air_ns")
        arrival, on_air = (pa.array(rows[name], mask=rows[name] == NOT_ARRIVING) for name in times)
        return pa.table(
            {
                "sent_ns": pa.array(rows["sent_ns"]),
                "sender": named("sender", self._node_ids),
                "seq": pa.array(rows["seq"]),
                "receiver": named("receiver", self._node_ids),
                "size_bytes": pa.array(rows["size_bytes"]),
                "payload_digest": pa.array(rows["payload_digest"]),
                "outcome": named("outcome", outcome_names),
                "cause": named("cause", self._causes).cast(pa.string()),
                "arrival_ns": arrival,
                "copy": pa.array(rows["copy"]),
                **({"on_air_ns": on_air, "left_ns": pa.array(rows["left_ns"])} if self._knows_air else {}),
            }
        )

    def sha256(self) -> str:
        """The hash of the content; see `sha256_of_table`."""
        return sha256_of_table(self.to_table())

    def write(self, path: Path) -> None:
        """Write the trace as Parquet. Raises OSError."""
        pq.write_table(self.to_table(), path, compression="zstd")


def read_trace(path: Path) -> pa.Table:
    """A trace as `Trace.write` wrote it. Raises OSError."""
    return pq.read_table(path)


def sha256_of_table(table: pa.Table) -> str:
    """SHA-256 over a trace's content, in the order of its rows, independent of how it was stored."""
    digest = hashlib.sha256()
    for column in table.column_names:
        array = table.column(column).combine_chunks()
        if column in _NAMED:
            codes, names = _canonical_codes(array)
            digest.update(json.dumps([column, names]).encode())
        else:
            filled = pc.fill_null(array, NOT_ARRIVING) if column in ("arrival_ns", "on_air_ns") else array
            codes = filled.to_numpy(zero_copy_only=False)
            digest.update(json.dumps([column]).encode())
        digest.update(np.ascontiguousarray(codes, dtype=codes.dtype.newbyteorder("<")).tobytes())
    return digest.hexdigest()


def _canonical_codes(array: pa.Array) -> tuple[NDArray[np.int32], list[str]]:
    """Names as codes into the sorted list of those that occur."""
    if not pa.types.is_dictionary(array.type):
        array = array.dictionary_encode()
    values = array.dictionary.to_pylist()
    indices = array.indices.to_numpy(zero_copy_only=False)
    used = np.unique(indices)
    names = sorted(values[i] for i in used)
    code = np.full(len(values), -1, dtype=np.int32)
    for number in used:
        code[number] = names.index(values[number])
    return code[indices], names
