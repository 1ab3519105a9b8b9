"""Figures of results: errors against time, and the paper's Table I.

Each function writes a PNG and an SVG next to each other and returns the PNG's path; its `draw_…` only makes the
figure.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from studies.style import (
    BLUE,
    GREY,
    RED,
    Look,
    label_levels,
    looks_of,
    save,
    styled,
)
from studies.tables import mean_and_standard_error
from vnet.types import Array

TIME_COLUMNS = {
    "common_error_rmse_m": "RMSE of the\ncommon error (m)",
    "deviation_m": "deviation across\nthe network (m)",
}


def against_time(
    series: Mapping[str, Sequence[pa.Table]],
    out: Path,
    title: str,
    references: Mapping[str, float] | None = None,
    log: bool = False,
    columns: Mapping[str, str] = TIME_COLUMNS,
) -> Path:
    """RMSE of the common error and network deviation (m) against time (s): means over seeds ± 1 standard error.

    `series` has the metrics of each seed for each mechanism. `references` are levels of the RMSE (m) by label, as
    the paper's; one whose label ends with a mechanism's name has its colour. `columns` are those of the metrics
    that are drawn, a panel each, with its title.
    """
    return save(draw_against_time(series, title, references or {}, log, columns), out)


@styled
def draw_against_time(
    series: Mapping[str, Sequence[pa.Table]],
    title: str,
    references: Mapping[str, float],
    log: bool,
    columns: Mapping[str, str] = TIME_COLUMNS,
) -> Figure:
    figure = Figure(figsize=(9, 6.4), layout="constrained")
    panels = figure.subplots(len(columns), 1, sharex=True)
    looks = looks_of(list(series))
    for axes, (column, label) in zip(panels, columns.items(), strict=True):
        for number, (mechanism, tables) in enumerate(series.items()):
            _draw_band(axes, tables, column, looks[mechanism], mechanism, number / len(series))
        axes.set_ylabel(label)
        axes.margins(x=0.01)
    for label, value in references.items():
        named = [looks[mechanism].colour for mechanism in series if label.endswith(mechanism)]
        panels[0].axhline(value, color=(named or [GREY])[-1], linewidth=1, linestyle=(0, (1, 2)), zorder=1.5)
    for axes in panels:
        if log:
            axes.set_yscale("log")
            axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        else:
            axes.set_ylim(0, None)
    labels = {value: f"{label} {value:.2f} m" for label, value in references.items()}
    label_levels(panels[0], list(references.values()), [labels[value] for value in references.values()])
    panels[-1].set_xlabel("time (s)")
    figure.suptitle(f"{title}\n{_seeds_note(series)}")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, handlelength=3.5)
    return figure


def _draw_band(axes: Axes, tables: Sequence[pa.Table], column: str, look: Look, label: str, shift: float) -> None:
    """Mean over seeds as a line, and ± 1 standard error where there are two seeds or more."""
    time_s, values = _by_time(tables, column)
    pairs = [mean_and_standard_error(row.tolist()) for row in values]
    mean, error = np.array(pairs).reshape(-1, 2).T
    every = (0.1 * shift, 0.1)
    axes.plot(
        time_s, mean, color=look.colour, linestyle=look.line, marker=look.marker, markersize=5, markevery=every,
        linewidth=1.6, label=label,
    )  # fmt: skip
    axes.fill_between(time_s, mean - error, mean + error, color=look.colour, alpha=0.2, linewidth=0)


def _by_time(tables: Sequence[pa.Table], column: str) -> tuple[Array, Array]:
    """Times (K,) in seconds of any seed, and values (K, seeds), NaN where a seed has none."""
    columns = [
        (table["time_ns"].to_numpy(), table[column].cast(pa.float64()).to_numpy(zero_copy_only=False))
        for table in tables
    ]
    time_ns = np.unique(np.concatenate([times for times, _ in columns])) if columns else np.zeros(0)
    values = np.full((len(time_ns), len(columns)), np.nan)
    for number, (times, found) in enumerate(columns):
        values[np.searchsorted(time_ns, times), number] = found
    return time_ns / 1e9, values


def _seeds_note(series: Mapping[str, Sequence[pa.Table]]) -> str:
    counts = sorted({len(tables) for tables in series.values()})
    if not counts or counts[-1] < 2:
        return "one seed"
    return f"mean of {' to '.join(map(str, dict.fromkeys((counts[0], counts[-1]))))} seeds, band ± 1 standard error"


def alpha_curve(
    rows: Sequence[Mapping[str, Any]],
    paper: Mapping[float | str, tuple[float, float]],
    out: Path,
    columns: tuple[str, str] = ("stacked_deviation_m", "stacked_rmse_m"),
) -> Path:
    """Table I: √variance and √MSE (m) against constant α, and with optimized weights.

    `rows` are results with `weights` ("optimized" or a number), `seed` and the two `columns`; `paper` has the
    paper's √variance and √MSE (m) by α, and by "optimized" if wanted.
    """
    return save(draw_alpha_curve(rows, paper, columns), out)


@styled
def draw_alpha_curve(
    rows: Sequence[Mapping[str, Any]], paper: Mapping[float | str, tuple[float, float]], columns: tuple[str, str]
) -> Figure:
    figure = Figure(figsize=(8.5, 5.2), layout="constrained")
    axes = figure.subplots()
    names = (("√variance", BLUE, "o", (0, (5, 2))), ("√MSE", RED, "s", (0, (1, 1.5))))
    for column, (name, colour, marker, line) in zip(columns, names, strict=True):
        found = _by_weights(rows, column)
        constant = {weights: pair for weights, pair in found.items() if weights != OPTIMIZED_AT}
        solid: dict[str, Any] = {"color": colour, "marker": marker, "capsize": 3, "linewidth": 1.6}
        if constant:
            mean, error = np.array([*constant.values()]).T
            axes.errorbar([*constant], mean, error, label=f"{name}, constant α", **solid)
        if OPTIMIZED_AT in found:
            mean, error = found[OPTIMIZED_AT]
            axes.errorbar([OPTIMIZED_AT], [mean], [error], **solid)
            axes.axhline(mean, color=colour, linewidth=1.2, linestyle=line, label=f"{name}, optimized weights")
    for number, (name, colour, marker, _) in enumerate(names):
        points = {_alpha(weights): pair[number] for weights, pair in paper.items()}
        open_marker: dict[str, Any] = {
            "marker": marker,
            "markersize": 9,
            "markerfacecolor": "none",
            "linestyle": "none",
        }
        if points:
            axes.plot([*points], [*points.values()], color=colour, label=f"{name}, the paper's", **open_marker)
    _dress_alpha_axis(axes)
    axes.set_ylim(0, None)
    axes.set_ylabel("√variance and √MSE (m)")
    axes.set_title("Fusion weights on the ring of four vehicles: spread and error, ± 1 standard error", pad=10)
    figure.legend(loc="outside lower center", ncols=2, handlelength=3)
    return figure


OPTIMIZED_AT = 1.12
"""Position of the optimized weights on the axis of α."""


def _dress_alpha_axis(axes: Axes) -> None:
    ticks = {0.05: "0.05", 0.2: "0.2", 0.4: "0.4", 0.5: "0.5", 0.6: "0.6", 0.8: "0.8", 0.95: "0.95"}
    axes.set_xticks([*ticks, OPTIMIZED_AT], [*ticks.values(), "optimized"])
    axes.set_xlim(0, 1.2)
    axes.axvline(1.035, color="0.6", linewidth=0.8)
    axes.set_xlabel("α, the weight of a vehicle's own estimate")


def _alpha(weights: float | str) -> float:
    return OPTIMIZED_AT if weights == "optimized" else float(weights)


def _by_weights(rows: Sequence[Mapping[str, Any]], column: str) -> dict[float, tuple[float, float]]:
    """Mean and standard error over seeds by place on the axis, sorted; without those that have no value."""
    values: dict[float, list[float | None]] = {}
    for row in rows:
        values.setdefault(_alpha(row["weights"]), []).append(row[column])
    pairs = {place: mean_and_standard_error(values[place]) for place in sorted(values)}
    return {place: pair for place, pair in pairs.items() if not np.isnan(pair[0])}
