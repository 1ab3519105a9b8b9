"""Writing trips as files that `[network] kind = "trips"` reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq

from emulator.world.trips.motion import Motion
from vnet.errors import ScenarioError

ENDINGS = (".csv", ".parquet")


def check_trips_name(path: Path) -> None:
    """Raise ScenarioError unless trips can be written in the format of this name."""
    if path.suffix.lower() not in ENDINGS:
        raise ScenarioError(f"{path}: trips are written as {' or '.join('*' + ending for ending in ENDINGS)}")


def write_trips(motion: Motion, path: Path, rate_hz: float) -> int:
    """Write the positions of each vehicle while it is present, in metres, by vehicle; return the number of samples.

    Raise ScenarioError if the file cannot be written.
    """
    vehicle, period = np.nonzero(np.isfinite(motion.position_m[..., 0]).T)
    position_m = motion.position_m[period, vehicle]
    table = pa.table(
        {
            "id": pa.array(motion.node_ids).take(pa.array(vehicle)),
            "time_s": period / rate_hz,
            "x_m": np.round(position_m[:, 0], 3),
            "y_m": np.round(position_m[:, 1], 3),
            "heading_rad": np.round(motion.heading_rad[period, vehicle], 5),
        }
    )
    try:
        if path.suffix.lower() == ".csv":
            pyarrow.csv.write_csv(table, path)
        else:
            pq.write_table(table, path.absolute())  # a colon would make it an address
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be written: {error.strerror or error}") from None
    return len(table)
