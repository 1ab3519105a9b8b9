"""The key figures of a run: the means in `verdict.json` that summaries, reports and comparisons show."""

from __future__ import annotations

import math
from collections.abc import Mapping

KEY_FIGURES = {
    "common_error_rmse_m": "common error, RMSE",
    "deviation_m": "deviation between vehicles",
    "position_rmse_m": "position, RMSE of the estimates",
    "fix_rmse_m": "position, RMSE of the raw fixes",
    "consensus_error_m": "consensus error",
}
"""Titles by name; all are in metres, and means after the first fifth of the run."""
_OF_POSITIONS = ("position_rmse_m", "fix_rmse_m")
SAME = 1e-9
"""Relative difference of two errors up to which they are those of the same positions."""


def estimates_differ(estimate_m: float | None, fix_m: float | None) -> bool:
    """Return whether these errors (in metres) are those of estimates that are more than the raw fixes again."""
    return estimate_m is not None and (fix_m is None or not math.isclose(estimate_m, fix_m, rel_tol=SAME))


def shown_figures(figures: Mapping[str, float | None]) -> dict[str, float]:
    """Return the key figures that a run has, by title: errors of positions only where programs estimate them."""
    own = estimates_differ(*(figures.get(name) for name in _OF_POSITIONS))
    values = {title: figures.get(name) for name, title in KEY_FIGURES.items() if own or name not in _OF_POSITIONS}
    return {title: value for title, value in values.items() if value is not None}
