"""The figures of the experiments: their style, errors against time, and the paper's Table I.

Each function writes a PNG and an SVG next to each other and returns the PNG's path. Colours are those of Okabe and
Ito, and nothing is told by colour alone. A mechanism has one colour and line in all figures; its variants ("random,
one hop") keep the colour. No pyplot: no window, no state that lasts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pyarrow as pa
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from emulator.cells.cells import Cell, has_result, read_series
from emulator.pages.palette import PALETTE
from studies.reports import mean_and_standard_error
from vnet.types import Array

DPI = 150
BLACK, GREY = "0", "0.4"
ORANGE, SKY, GREEN, YELLOW, BLUE, RED, PURPLE = (
    PALETTE[name].light for name in ("orange", "sky", "green", "yellow", "blue", "red", "purple")
)

styled = matplotlib.rc_context(
    {
        "font.family": "DejaVu Sans",
        "font.size": 10,
        "axes.titlesize": 11,
        "figure.titlesize": 13,
        "legend.fontsize": 9,
        "legend.frameon": False,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.axisbelow": True,
        "axes.grid": True,
        "grid.color": "0.867",
        "grid.linewidth": 0.6,
        "svg.hashsalt": "vnet",
    }
)
TIME_COLUMNS = {
    "common_error_rmse_m": "RMSE of the\ncommon error (m)",
    "deviation_m": "deviation across\nthe network (m)",
}
"""Columns of the metrics that are drawn by default, and their titles."""
ERROR_COLUMNS = {
    "common_error_rmse_m": "RMSE of the\ncommon error (m)",
    "position_rmse_m": "RMSE of the\nposition (m)",
}
"""Those of studies in which positions count as well."""
NO_REFERENCES: Mapping[str, float] = {}


@dataclass(frozen=True)
class Look:
    """Colour, line and marker of a mechanism."""

    colour: str
    line: Any
    marker: str


LOOKS = {
    "centralized": Look(BLACK, "-", "s"),
    "bound": Look(GREY, (0, (1, 1)), "D"),
    "optimized": Look(BLUE, "-", "o"),
    "random": Look(RED, (0, (5, 2)), "^"),
    "none": Look(GREEN, (0, (4, 1.5, 1, 1.5)), "v"),
}
OTHER_LOOKS = (
    Look(PURPLE, (0, (1, 1.5)), "P"),
    Look(ORANGE, (0, (7, 2, 1, 2, 1, 2)), "X"),
    Look(SKY, (0, (9, 3)), "<"),
    Look(YELLOW, (0, (3, 1)), ">"),
)
VARIANT_LINES = ((0, (2, 1)), (0, (1, 3)), (0, (6, 1, 1, 1)))


@styled
def save(figure: Figure, out: Path) -> Path:
    """`out`.png and `out`.svg; the same figure gives the same bytes."""
    out.parent.mkdir(parents=True, exist_ok=True)
    png = out.with_name(out.name + ".png")
    figure.savefig(png, dpi=DPI)
    figure.savefig(out.with_name(out.name + ".svg"), metadata={"Date": None})
    return png


def label_levels(axes: Axes, levels: Sequence[float], labels: Sequence[str]) -> None:
    """Write labels right of the axes at their levels, moved apart where they would overlap."""
    if not levels:
        return
    data_to_axes = axes.transData + axes.transAxes.inverted()
    true = [float(data_to_axes.transform((axes.get_xlim()[0], level))[1]) for level in levels]
    line: dict[str, Any] = {"arrowstyle": "-", "color": GREY, "linewidth": 0.7, "shrinkA": 0, "shrinkB": 0}
    for label, level, place in zip(labels, true, spread(true, 0.065), strict=True):
        axes.annotate(
            label, (1, level), (1.03, place), xycoords="axes fraction", textcoords="axes fraction", va="center",
            fontsize=9, arrowprops=line, annotation_clip=False,
        )  # fmt: skip


def spread(places: Sequence[float], gap: float) -> list[float]:
    """Places at least `gap` apart, in the same order, each near where it was."""
    order = np.argsort(places, kind="stable")
    moved = np.array(places, dtype=float)[order]
    for _ in range(200):
        overlap = np.maximum(0, gap - np.diff(moved)) / 2
        moved[:-1] -= overlap
        moved[1:] += overlap
    result = np.empty_like(moved)
    result[order] = moved
    return [float(place) for place in result]


def looks_of(names: Sequence[str]) -> dict[str, Look]:
    """A look for each mechanism: its own, a variant of the one it is called after, or the next that is free."""
    looks: dict[str, Look] = {}
    others, variants = 0, 0
    for name in names:
        base = name.split(",")[0]
        if name in LOOKS:
            looks[name] = LOOKS[name]
        elif base in LOOKS:
            line = VARIANT_LINES[variants % len(VARIANT_LINES)]
            variants += 1
            looks[name] = Look(LOOKS[base].colour, line, f"${'abcdefgh'[variants % 8]}$")
        else:
            looks[name] = OTHER_LOOKS[others % len(OTHER_LOOKS)]
            others += 1
    return looks


def series_of(cells: Sequence[Cell], folder: Path, **labels: object) -> dict[str, list[pa.Table]]:
    """The metrics of each seed for each mechanism, of those cells with these labels that have been simulated."""
    series: dict[str, list[pa.Table]] = {}
    for cell in cells:
        if labels.items() <= cell.labels.items() and has_result(cell, folder):
            series.setdefault(str(cell.labels["mechanism"]), []).append(read_series(cell, folder))
    return series


@styled
def against_time(
    series: Mapping[str, Sequence[pa.Table]],
    out: Path,
    title: str,
    references: Mapping[str, float] = NO_REFERENCES,
    columns: Mapping[str, str] = TIME_COLUMNS,
) -> Path:
    """RMSE of the common error and network deviation (m) against time (s): means over seeds ± 1 standard error.

    `series` has the metrics of each seed for each mechanism. `references` are levels of the RMSE (m) by label, as
    the paper's; one whose label ends with a mechanism's name has its colour. `columns` are those of the metrics
    that are drawn, a panel each, with its title.
    """
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
        axes.set_ylim(0, None)
    labels = [f"{label} {value:.2f} m" for label, value in references.items()]
    label_levels(panels[0], list(references.values()), labels)
    panels[-1].set_xlabel("time (s)")
    figure.suptitle(f"{title}\n{_seeds_note(series)}")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, handlelength=3.5)
    return save(figure, out)


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


@styled
def alpha_curve(
    rows: Sequence[Mapping[str, Any]], paper: Mapping[float | str, tuple[float, float]], out: Path
) -> Path:
    """Table I: √variance and √MSE (m) against constant α, and with optimized weights.

    `rows` are results with `weights` ("optimized" or a number), `seed`, `stacked_deviation_m` and `stacked_rmse_m`;
    `paper` has the paper's √variance and √MSE (m) by α, and by "optimized" if wanted.
    """
    figure = Figure(figsize=(8.5, 5.2), layout="constrained")
    axes = figure.subplots()
    names = (("√variance", BLUE, "o", (0, (5, 2))), ("√MSE", RED, "s", (0, (1, 1.5))))
    for column, (name, colour, marker, line) in zip(("stacked_deviation_m", "stacked_rmse_m"), names, strict=True):
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
    return save(figure, out)


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
