"""The key figures of a run: the means in `verdict.json` that summaries, reports and comparisons show."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class KeyFigure:
    """A figure of the periods, in metres, whose mean after the first fifth of a run is shown by `title`."""

    name: str
    title: str
    chart: tuple[str, str, str] | None = None
    """Id, title and axis of its chart in a comparison."""
    column: str = ""
    """Title of its column in the list of runs."""
    is_less: bool = False
    """True if narrow screens go without that column."""
    of_positions: bool = False
    """True for an error of positions, shown only where programs estimate them."""


KEY_FIGURES: list[KeyFigure] = [
    KeyFigure(
        "common_error_rmse_m",
        "common error, RMSE",
        ("common-error", "Common error", "RMSE of the common error (m)"),
        "RMSE (m)",
    ),
    KeyFigure(
        "deviation_m",
        "deviation between vehicles",
        ("deviation", "Deviation", "deviation (m)"),
        "deviation (m)",
        is_less=True,
    ),
    KeyFigure(
        "position_rmse_m",
        "position, RMSE of the estimates",
        ("position", "Position", "RMSE of position (m)"),
        of_positions=True,
    ),
    KeyFigure("fix_rmse_m", "position, RMSE of the raw fixes", of_positions=True),
    KeyFigure("consensus_error_m", "consensus error", ("consensus", "Consensus error", "consensus error (m)")),
]
"""All of them, in their order: summary, report, comparison, sweep and list of runs draw from this list."""
SAME = 1e-9
"""Relative difference of two errors up to which they are those of the same positions."""


def estimates_differ(estimate_m: float | None, fix_m: float | None) -> bool:
    """Return whether these errors (in metres) are those of estimates that are more than the raw fixes again."""
    return estimate_m is not None and (fix_m is None or not math.isclose(estimate_m, fix_m, rel_tol=SAME))


def shown_figures(figures: Mapping[str, float | None]) -> dict[str, float]:
    """Return the key figures that a run has, by title: errors of positions only where programs estimate them."""
    own = estimates_differ(figures.get("position_rmse_m"), figures.get("fix_rmse_m"))
    values = {each.title: figures.get(each.name) for each in KEY_FIGURES if own or not each.of_positions}
    return {title: value for title, value in values.items() if value is not None}


def title_of_figure(name: str) -> str | None:
    """Return the title of a key figure; None for another figure."""
    return next((each.title for each in KEY_FIGURES if each.name == name), None)
