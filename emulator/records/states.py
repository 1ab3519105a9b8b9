"""The columns that the states of every run have."""

from __future__ import annotations

import pyarrow as pa

POINT = pa.list_(pa.float64(), 2)
MATRIX = pa.list_(pa.float64(), 4)

STATES = pa.schema(
    {
        "period": pa.int32(),
        "time_ns": pa.int64(),
        "node": pa.dictionary(pa.int32(), pa.string()),
        "position_m": POINT,
        "heading_rad": pa.float64(),
        "fix_m": POINT,
        "common_error_m": POINT,
        "estimate_m": POINT,
        "covariance_m2": MATRIX,
        "common_error_estimate_m": POINT,
        "common_error_covariance_m2": MATRIX,
        "mean_m": POINT,
        "stacked_common_error_m": POINT,
        "cloud_m": pa.list_(pa.float64()),
        "values": pa.map_(pa.string(), pa.list_(pa.float64())),
    }
)
"""The columns of every run; a column for each value that programs report follows (`emulator.records.reported`)."""
COMMON_VALUES = {
    "common_error_m": "common_error_estimate_m",
    "common_error_covariance_m2": "common_error_covariance_m2",
    "mean_m": "mean_m",
    "stacked_common_error_m": "stacked_common_error_m",
    "cloud_m": "cloud_m",
}
"""Reported values that vnet knows, and their columns."""
TAKEN = frozenset([*STATES.names, *COMMON_VALUES])
"""Names that no column of a program's own can have."""
