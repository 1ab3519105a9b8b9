"""Messages of the backbone among roadside units: a table, and their number by outcome."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import pyarrow as pa
import pyarrow.compute as pc

from emulator.records.tables import BACKBONE


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
