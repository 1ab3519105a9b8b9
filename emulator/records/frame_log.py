"""The frames of a recorded run one by one: who sent what to whom, and what became of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pyarrow as pa

from emulator.records.recorded_run import OpenedRun


@dataclass(frozen=True)
class FrameEntry:
    """A frame: its sender, its payload if the run has kept it, and its receivers by outcome."""

    sent_ns: int
    sender: str
    seq: int
    copy: int
    size_bytes: int
    digest: int
    payload: bytes | None
    outcomes: dict[str, list[str]]


def frame_log(recorded: OpenedRun, node: str | None, start_ns: int, end_ns: int | None) -> Iterator[FrameEntry]:
    """Yield the frames that were sent in [start, end) in the order of time.

    With `node` only those that it sent, with all receivers, and those that it could hear, with it alone. A frame
    that arrived altered at some receivers is listed with its first receiver's digest.
    """
    chosen = recorded.sent_ns >= start_ns
    if end_ns is not None:
        chosen &= recorded.sent_ns < end_ns
    if node is not None:
        number = recorded.number[node]
        chosen &= (recorded.sender == number) | (recorded.receiver == number)
    rows = np.flatnonzero(chosen)
    rows = rows[np.lexsort((recorded.receiver[rows], recorded.emission[rows], recorded.sent_ns[rows]))]
    outcome = recorded.trace["outcome"].cast(pa.string()).take(pa.array(rows)).to_pylist()
    edges = np.flatnonzero(np.diff(recorded.emission[rows])) + 1
    sizes, names, kept = recorded.column("size_bytes"), recorded.node_ids, recorded.payloads
    bounds = [0, *edges.tolist(), len(rows)] if len(rows) else []
    for first, end in pairwise(bounds):
        row = int(rows[first])
        outcomes: dict[str, list[str]] = {}
        for index in range(first, end):
            outcomes.setdefault(outcome[index], []).append(names[int(recorded.receiver[rows[index]])])
        sender, seq, digest = names[int(recorded.sender[row])], int(recorded.seq[row]), int(recorded.digest[row])
        yield FrameEntry(
            sent_ns=int(recorded.sent_ns[row]),
            sender=sender,
            seq=seq,
            copy=int(recorded.copy[row]),
            size_bytes=int(sizes[row]),
            digest=digest,
            payload=None if kept is None else kept.of(sender, seq, recorded.digest[rows[first:end]].tolist()),
            outcomes=outcomes,
        )
