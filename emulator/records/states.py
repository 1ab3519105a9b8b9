"""Names of reported values that the states know, and those that no program may take."""

from __future__ import annotations

from emulator.records.tables import STATES

COMMON_VALUES = {
    "common_error_m": "common_error_estimate_m",
    "common_error_covariance_m2": "common_error_covariance_m2",
    "mean_m": "mean_m",
    "stacked_common_error_m": "stacked_common_error_m",
    "cloud_m": "cloud_m",
}
"""Reported values that vnet knows, and their columns."""
TAKEN = frozenset([*STATES.columns, *COMMON_VALUES])
"""Names that no column of a program's own can have."""
