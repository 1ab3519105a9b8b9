"""Payloads of frames as programs sent them, where a run keeps them (`run.keep_payloads`): `payloads.parquet`."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import pyarrow as pa

from emulator.radio.trace import payload_digest
from emulator.records.tables import PAYLOADS


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
