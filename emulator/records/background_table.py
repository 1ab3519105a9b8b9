"""Vehicles without programs in a run whose traffic SUMO moves: a table of where they were."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from emulator.world.driven.background import Background
from vnet.types import Array

BACKGROUND = pa.schema(
    [
        ("time_ns", pa.int64()),
        ("vehicle", pa.dictionary(pa.int32(), pa.string())),
        ("x_m", pa.float64()),
        ("y_m", pa.float64()),
    ]
)


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
    return pa.table(columns, BACKGROUND)


def last_positions(table: pa.Table) -> Array:
    """Return the positions (k, 2) of the vehicles that were there last."""
    last = table.filter(pc.equal(table["time_ns"], pc.max(table["time_ns"]))) if len(table) else table
    return np.column_stack([last["x_m"].to_numpy(), last["y_m"].to_numpy()])
