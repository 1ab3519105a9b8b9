"""Vehicles without programs in a run whose traffic SUMO moves: a table of where they were."""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from emulator.records.tables import BACKGROUND
from emulator.world.driven.stepped import Background
from vnet.types import Array


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
