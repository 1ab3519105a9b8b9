"""Motion of driven vehicles, from control instant to control instant: a table, and figures of the whole run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from emulator.records.events import Event, EventKind
from emulator.records.tables import DRIVEN
from emulator.world.driven.vehicles import Log
from vnet.types import Array

_TIME, _NODE, *QUANTITIES = DRIVEN.columns
"""The columns besides time and vehicle are in the order of the log's rows."""


def driven_table(log: Log, node_ids: Sequence[str]) -> pa.Table:
    """Return a row for each control instant and vehicle; NaN for a vehicle that has left."""
    count, instants = len(node_ids), len(log.time_ns)
    node = pa.array(np.tile(np.arange(count, dtype=np.int32), instants))
    rows = np.array(log.rows).reshape(instants, len(QUANTITIES), count)
    columns = {name: pa.array(rows[:, index].ravel()) for index, name in enumerate(QUANTITIES)}
    return pa.table(
        {
            "time_ns": pa.array(np.repeat(np.array(log.time_ns, dtype=np.int64), count)),
            "node": pa.DictionaryArray.from_arrays(node, pa.array(list(node_ids), pa.string())),
            **columns,
        },
        DRIVEN.schema,
    )


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
