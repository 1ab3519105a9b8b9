"""Keys of scenarios that have been renamed: what a run has recorded is read under today's names."""

from __future__ import annotations

from typing import Any

RENAMED_SELECTORS = {"random": "count"}
"""Keys of selectors: the old name, and today's."""


def with_new_names(data: dict[str, Any]) -> dict[str, Any]:
    """Return the data of a scenario that a run has recorded, with today's names."""
    faults = data.get("fault")
    if not isinstance(faults, list):
        return data
    return {**data, "fault": [_with_new_selectors(fault) for fault in faults]}


def _with_new_selectors(fault: Any) -> Any:
    if not isinstance(fault, dict):
        return fault
    return {
        name: {RENAMED_SELECTORS.get(key, key): each for key, each in value.items()}
        if isinstance(value, dict)
        else value
        for name, value in fault.items()
    }
