"""The trace of a run: one row per frame and receiver in range, and its hash.

Rows are appended as frames are sent and completed when they arrive. The hash is over the content in canonical
order, so that neither the order of appending nor the file format can change it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import ArrayLike, NDArray

from emulator.radio.frames import NO_CAUSE
from emulator.radio.outcomes import PENDING, Outcome

NOT_ARRIVING = -1
FIRST_PAIRS, FIRST_FRAMES = 1 << 22, 1 << 17
"""Room from the start: the system hands out zeroed pages only as they are written, and growing means copying."""

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
    ]
)
_PAIR = np.dtype(
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
_NAMED = ("sender", "receiver", "outcome", "cause")


def decided_ns(rows: NDArray[np.void]) -> NDArray[np.int64]:
    """When each of these records of type `ROW` is decided: as it arrives, or else as it leaves its sender."""
    return np.asarray(np.where(rows["arrival_ns"] == NOT_ARRIVING, rows["left_ns"], rows["arrival_ns"]))


class _Table:
    """Records of one type, as many as are added."""

    def __init__(self, kind: np.dtype[np.void], room: int) -> None:
        self._records = np.zeros(room, kind)
        self.count = 0

    @property
    def records(self) -> NDArray[np.void]:
        """Those that were added."""
        return self._records[: self.count]

    def add(self, count: int) -> NDArray[np.void]:
        """So many more, to be written."""
        first, end = self.count, self.count + count
        if end > len(self._records):
            grown = np.zeros(max(2 * len(self._records), end), self._records.dtype)
            grown[:first] = self._records[:first]
            self._records = grown
        self.count = end
        return self._records[first:end]


class Trace:
    """The growing trace of a run. `node_ids` are indexed by the numbers in `sender` and `receiver`.

    What the rows of a frame have in common is kept once. `knows_air` says that frames have times at which they went
    on air and left it; else they leave as they are sent.
    """

    def __init__(self, node_ids: Sequence[str], knows_air: bool = False) -> None:
        self._node_ids = list(node_ids)
        self._knows_air = knows_air
        self._causes = [""]
        self._pairs = _Table(_PAIR, FIRST_PAIRS)
        self._frames = _Table(_FRAME, FIRST_FRAMES)
        self._altered: dict[int, int] = {}

    def __len__(self) -> int:
        return self._pairs.count

    def append(
        self,
        frames: Mapping[str, ArrayLike],
        each: NDArray[np.intp],
        receiver: ArrayLike,
        outcome: NDArray[np.uint8],
        cause: ArrayLike,
        arrival_ns: ArrayLike,
    ) -> int:
        """Add the rows of frames: of `each` (K,) of them so many, one after the other; returns the first's number.

        `frames` are the columns (K,) that are the same for all rows of a frame; the others are of the rows (n,).
        `cause` are numbers of faults, whose names `name_cause` has told; `arrival_ns` counts only where the outcome
        is pending.
        """
        first, first_frame = self._pairs.count, self._frames.count
        new = self._frames.add(len(each))
        for name, values in frames.items():
            new[name] = values
        if not self._knows_air:
            new["left_ns"] = new["sent_ns"]
        rows = self._pairs.add(len(outcome))
        rows["frame"] = np.repeat(np.arange(first_frame, first_frame + len(each)), each)
        rows["receiver"], rows["outcome"], rows["cause"] = receiver, outcome, cause
        rows["cause"] -= NO_CAUSE
        rows["arrival_ns"] = np.where(outcome == PENDING, arrival_ns, NOT_ARRIVING)
        return first

    def alter(self, row: int, payload_digest: int) -> None:
        """What arrives by this row has other bytes than its frame."""
        self._pairs.records["altered"][row] = True
        self._altered[row] = payload_digest

    def column(self, name: str) -> NDArray[Any]:
        """A column of the trace so far, as numbers."""
        return np.asarray(self.rows(slice(None))[name])

    def name_cause(self, number: int, name: str) -> None:
        """Say what fault `number` is called."""
        missing = number + 2 - len(self._causes)
        self._causes += [""] * missing
        self._causes[number - NO_CAUSE] = name

    def decide(self, rows: Sequence[int] | NDArray[np.intp], outcome: Outcome) -> None:
        """Give rows their outcome."""
        self._pairs.records["outcome"][rows] = outcome.value

    def rows(self, which: NDArray[np.intp] | slice) -> NDArray[np.void]:
        """These rows as records of type `ROW`."""
        receptions = self._pairs.records[which]
        frames = self._frames.records[receptions["frame"]]
        rows = np.zeros(len(receptions), ROW)
        for name in ROW.fields or ():
            rows[name] = receptions[name] if name in (_PAIR.fields or ()) else frames[name]
        number = range(self._pairs.count)[which] if isinstance(which, slice) else which
        for place in np.flatnonzero(receptions["altered"]).tolist():
            rows["payload_digest"][place] = self._altered[int(number[place])]
        return rows

    def to_table(self) -> pa.Table:
        """The trace as a table in canonical order: (sent_ns, sender number, seq, receiver number, copy).

        Where senders share the air there are two columns more: `on_air_ns`, when a frame's transmission began (null
        if it never did), and `left_ns`, when it ended, or the frame was given up.
        """
        rows = self.rows(slice(None))
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
