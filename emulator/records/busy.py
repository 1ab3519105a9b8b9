"""Channel busy ratio (CBR) of each vehicle: the share of each 100 ms in which it sensed the medium busy."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from emulator.radio.medium import WINDOW_NS
from emulator.records.tables import BUSY
from vnet.errors import VnetError
from vnet.types import Array


def busy_table(windows: Array, node_ids: Sequence[str]) -> pa.Table:
    """Busy ratios (windows, N) as a table, a row for each window and vehicle."""
    count = len(windows)
    node = pa.array(np.tile(np.arange(len(node_ids), dtype=np.int32), count))
    return pa.table(
        {
            "time_ns": pa.array(np.repeat(np.arange(count, dtype=np.int64) * WINDOW_NS, len(node_ids))),
            "node": pa.DictionaryArray.from_arrays(node, pa.array(list(node_ids), pa.string())),
            "busy_ratio": pa.array(windows.ravel()),
        },
        BUSY.schema,
    )


def busy_windows(table: pa.Table | None, node_ids: Sequence[str]) -> Array:
    """The ratios (windows, N) of such a table; no windows if it is None. Raises VnetError if it is another one."""
    count = len(node_ids)
    if table is None:
        return np.zeros((0, count))
    windows = len(table) // max(1, count)
    number = pc.index_in(table["node"].cast(pa.string()), value_set=pa.array(list(node_ids), pa.string()))
    if not np.array_equal(pc.fill_null(number, -1).to_numpy(), np.tile(np.arange(count), windows)):
        raise VnetError(f"{BUSY.file}: its rows are not those of {count} vehicles, one window after the other")
    return np.asarray(table["busy_ratio"].cast(pa.float64()).to_numpy()).reshape(windows, count)


def mean_busy(windows: Sequence[Array] | Array, count: int, start_ns: int, end_ns: int) -> Array:
    """The means (count,) of the windows (count,) that ended in (start, end], else the last before; NaN if none."""
    end = min(end_ns // WINDOW_NS, len(windows))
    some = windows[max(0, min(start_ns // WINDOW_NS, end - 1)) : end]
    return np.mean(some, axis=0) if len(some) else np.full(count, np.nan)
