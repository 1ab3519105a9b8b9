"""Figures of networks and of results: graphs, errors against time, the paper's Table I, ratios to the bound.

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
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator
from numpy.typing import NDArray

from emulator.world.networks import REFERENCE_RANGE_M
from emulator.world.world import components
from studies.style import (
    BLACK,
    BLUE,
    COMPONENT_LOOKS,
    GREY,
    RED,
    Look,
    counted,
    label_levels,
    looks_of,
    save,
    shown,
    styled,
)
from studies.tables import mean_and_standard_error, paired_ratio
from vnet.types import Array

Networks = Mapping[str, tuple[Array, Array]]
"""Name → positions (N, 2) in metres, east and north, and headings (N,) in radians from east to north."""

SECTORS = 24
SHOWN_COMPONENTS = 5


def degree_histogram(networks: Networks, out: Path, range_m: float = REFERENCE_RANGE_M) -> Path:
    """Histogram of the degrees; a panel a network."""
    return save(draw_degree_histogram(networks, range_m), out)


@styled
def draw_degree_histogram(networks: Networks, range_m: float) -> Figure:
    figure = Figure(figsize=(10, 3.6), layout="constrained")
    panels = figure.subplots(1, len(networks), sharex=True, sharey=True, squeeze=False)[0]
    degrees = {name: _links(position_m, range_m).sum(axis=0) for name, (position_m, _) in networks.items()}
    largest = max(int(degree.max()) for degree in degrees.values())
    for axes, (name, degree) in zip(panels, degrees.items(), strict=True):
        axes.bar(range(largest + 1), np.bincount(degree, minlength=largest + 1), width=0.85, color=BLUE)
        axes.axvline(degree.mean(), color=RED, linestyle=(0, (5, 2)), label=f"mean {degree.mean():.1f}")
        axes.set(title=f"{shown(name)}: {counted(len(degree), 'vehicle')}", xlabel="vehicles in range (degree)")
        axes.set_xlim(-0.7, max(largest, 4) + 0.7)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.yaxis.set_major_locator(MaxNLocator(integer=True))
        axes.grid(axis="x", visible=False)
        axes.legend(loc="upper right")
    panels[0].set_ylabel("number of vehicles")
    figure.suptitle(f"How many others each vehicle has within {range_m / 1000:g} km")
    return figure


def road_angle_histogram(networks: Networks, out: Path) -> Path:
    """Directions of the roads: vehicles a sector of 15°, east at the right, north at the top."""
    return save(draw_road_angle_histogram(networks), out)


@styled
def draw_road_angle_histogram(networks: Networks) -> Figure:
    figure = Figure(figsize=(10, 4.3), layout="constrained")
    grid: dict[str, Any] = {"subplot_kw": {"projection": "polar"}, "squeeze": False}
    panels = figure.subplots(1, len(networks), sharey=True, **grid)[0]
    width = 2 * np.pi / SECTORS
    counts = {name: _sector_counts(heading_rad) for name, (_, heading_rad) in networks.items()}
    largest = max(int(count.max()) for count in counts.values())
    for axes, (name, count) in zip(panels, counts.items(), strict=True):
        axes.bar(np.arange(SECTORS) * width, count, width=0.9 * width, color=BLUE)
        axes.set_title(f"{shown(name)}: {counted(int(count.sum()), 'vehicle')}", pad=12)
        axes.set_thetagrids(range(0, 360, 45), ["east", "45°", "north", "135°", "west", "225°", "south", "315°"])
        axes.set_ylim(0, largest * 1.05)
        axes.yaxis.set_major_locator(MaxNLocator(4, integer=True, prune="lower"))
        axes.set_rlabel_position(67.5)
        axes.tick_params(axis="y", labelsize=9)
    figure.suptitle(f"Which way the roads lead: number of vehicles in each sector of {360 // SECTORS}°")
    return figure


def graphs(networks: Networks, out: Path, range_m: float = REFERENCE_RANGE_M) -> Path:
    """The networks as maps at one scale: vehicles, their headings, links in range, connected components."""
    return save(draw_graphs(networks, range_m), out)


@styled
def draw_graphs(networks: Networks, range_m: float) -> Figure:
    middles, sizes = zip(*(_extent_km(position_m, range_m) for position_m, _ in networks.values()), strict=True)
    height_km = max(size[1] for size in sizes)
    widths_km = [max(size[0], 0.55 * height_km) for size in sizes]
    scale = 12 / sum(widths_km)
    figure = Figure(figsize=(13.5, min(scale * height_km + 2.2, 14)), layout="constrained")
    panels = figure.subplots(1, len(networks), width_ratios=widths_km, squeeze=False)[0]
    for axes, (name, (position_m, heading_rad)), middle, width_km in zip(
        panels, networks.items(), middles, widths_km, strict=True
    ):
        _draw_graph(axes, shown(name), position_m, heading_rad, range_m)
        axes.set_xlim(middle[0] - width_km / 2, middle[0] + width_km / 2)
        axes.set_ylim(middle[1] - height_km / 2, middle[1] + height_km / 2)
        axes.set_aspect("equal")
    panels[0].set_ylabel("north (km)")
    figure.suptitle(f"Who is within {range_m / 1000:g} km of whom; arrows show headings")
    return figure


def _draw_graph(axes: Axes, name: str, position_m: Array, heading_rad: Array, range_m: float) -> None:
    position_km = position_m / 1000
    linked = _links(position_m, range_m)
    ends = np.argwhere(np.triu(linked))
    axes.add_collection(LineCollection(list(position_km[ends]), colors="0.69", linewidths=0.6, zorder=1))
    groups = _by_component(position_m, range_m)
    for (colour, marker), (label, members) in zip((*COMPONENT_LOOKS, (GREY, "x")), groups, strict=False):
        at, heading = position_km[members], heading_rad[members]
        axes.scatter(at[:, 0], at[:, 1], s=26, color=colour, marker=marker, linewidths=0.9, label=label, zorder=3)
        arrow: dict[str, Any] = {
            "angles": "xy",
            "scale": 28,
            "width": 0.005,
            "headwidth": 4.5,
            "headlength": 5,
            "zorder": 4,
        }
        axes.quiver(at[:, 0], at[:, 1], np.cos(heading), np.sin(heading), color=colour, **arrow)
    found = len(np.unique(components(position_m, range_m)))
    sizes = f"{counted(len(position_m), 'vehicle')}, {counted(len(ends), 'link')},\n{counted(found, 'component')}"
    axes.set(title=f"{name}: {sizes}", xlabel="east (km)")
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    axes.yaxis.set_major_locator(MaxNLocator(6, integer=True))
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=1, handletextpad=0.2)


def _links(position_m: Array, range_m: float) -> NDArray[np.bool_]:
    """(N, N): who has whom in range; nobody themselves."""
    offset = position_m[:, None] - position_m[None]
    linked: NDArray[np.bool_] = np.hypot(offset[..., 0], offset[..., 1]) <= range_m
    np.fill_diagonal(linked, False)
    return linked


def _by_component(position_m: Array, range_m: float) -> list[tuple[str, NDArray[np.intp]]]:
    """Labels and vehicles of the largest components, and of all others together."""
    label = components(position_m, range_m)
    members = sorted((np.flatnonzero(label == one) for one in np.unique(label)), key=len, reverse=True)
    groups = [(f"component of {counted(len(some), 'vehicle')}", some) for some in members[:SHOWN_COMPONENTS]]
    if rest := members[SHOWN_COMPONENTS:]:
        groups.append((f"{counted(len(rest), 'smaller component')}", np.concatenate(rest)))
    return groups


def _extent_km(position_m: Array, range_m: float) -> tuple[Array, Array]:
    """Middle (2,) and size (2,) of the map in kilometres, with room at the edges."""
    low, high = position_m.min(axis=0) / 1000, position_m.max(axis=0) / 1000
    return (low + high) / 2, np.maximum(high - low, range_m / 2000) * 1.12 + 0.3


def _sector_counts(heading_rad: Array) -> NDArray[np.intp]:
    """(SECTORS,): vehicles by the nearest sector; sectors are centred, so that a road due east is in one."""
    sector = np.round(np.mod(heading_rad, 2 * np.pi) / (2 * np.pi / SECTORS)).astype(np.intp) % SECTORS
    return np.bincount(sector, minlength=SECTORS)


RATIO_LINES = {1.0: "the bound", 1.05: "1.05", 1.35: "1.35"}
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


def ratio_bars(
    rows: Sequence[Mapping[str, Any]],
    out: Path,
    column: str = "rmse_m",
    bound: str = "bound",
    lines: Mapping[float, str] | None = None,
) -> Path:
    """The default profile: RMSE relative to the bound's, by network and mechanism, with ± 1 standard error.

    `rows` are results with `network`, `mechanism`, `seed` and `column`; seeds are paired. `lines` are levels to
    mark, and what to write there.
    """
    return save(draw_ratio_bars(rows, column, bound, RATIO_LINES if lines is None else lines), out)


@styled
def draw_ratio_bars(
    rows: Sequence[Mapping[str, Any]], column: str, bound: str, lines: Mapping[float, str]
) -> Figure:
    ratios = _ratios(rows, column, bound)
    networks = list(dict.fromkeys(str(row["network"]) for row in rows))
    mechanisms = [name for name in dict.fromkeys(str(row["mechanism"]) for row in rows) if name != bound]
    figure = Figure(figsize=(11, 5.2), layout="constrained")
    axes = figure.subplots()
    axes.set_yscale("log")
    width = 0.86 / max(1, len(mechanisms))
    looks = looks_of(mechanisms)
    for number, mechanism in enumerate(mechanisms):
        place: Array = np.arange(len(networks), dtype=np.float64) + (number - (len(mechanisms) - 1) / 2) * width
        pairs = [ratios.get((network, mechanism), (np.nan, np.nan)) for network in networks]
        _draw_bars(axes, place, 0.88 * width, np.array(pairs, dtype=np.float64), looks[mechanism], mechanism)
    for level in lines:
        axes.axhline(level, color=BLACK, linewidth=1, linestyle="-" if level == 1 else (0, (4, 3)), zorder=2.5)
    found = [mean + s * np.nan_to_num(error) for mean, error in ratios.values() for s in (-1, 1)]
    _scale_ratios(axes, [value for value in (*found, *lines) if value > 0])
    label_levels(axes, list(lines), list(lines.values()))
    axes.set_xticks(range(len(networks)), [shown(network) for network in networks])
    axes.set_xlim(-0.5, len(networks) - 0.5)
    axes.grid(axis="x", visible=False)
    axes.set_ylabel("RMSE of the common error,\nratio to the bound (log scale)")
    axes.set_title("How near each mechanism comes to the bound of its network, ± 1 standard error", pad=10)
    figure.legend(loc="outside lower center", ncols=4, handlelength=2.6, handleheight=1.3)
    return figure


def _ratios(
    rows: Sequence[Mapping[str, Any]], column: str, bound: str
) -> dict[tuple[str, str], tuple[float, float]]:
    """Ratio to the bound and its standard error by network and mechanism; without those that have none."""
    values: dict[tuple[str, str], dict[Any, float | None]] = {}
    for row in rows:
        values.setdefault((str(row["network"]), str(row["mechanism"])), {})[row["seed"]] = row[column]
    ratios = {}
    for (network, mechanism), by_seed in values.items():
        reference = values.get((network, bound), {})
        pair = paired_ratio([*by_seed.values()], [reference.get(seed) for seed in by_seed])
        if mechanism != bound and not np.isnan(pair[0]):
            ratios[network, mechanism] = pair
    return ratios


def _draw_bars(axes: Axes, place: Array, width: float, pairs: Array, look: Look, label: str) -> None:
    """Bars that rise or fall from 1, with error bars and the ratio written beyond them; none where it is NaN."""
    ratio, error = pairs.T
    axes.bar(
        place, ratio - 1, width, bottom=1, facecolor=_pale(look), edgecolor=look.colour, hatch=look.hatch,
        linewidth=1, label=label,
    )  # fmt: skip
    down = np.minimum(error, 0.99 * ratio)
    axes.errorbar(place, ratio, [down, error], fmt="none", ecolor=BLACK, capsize=2.5, linewidth=1.1, zorder=3)
    for x, mean, bar in zip(place, ratio, np.nan_to_num(error), strict=True):
        if np.isnan(mean):
            axes.annotate("none", (x, 1), (0, 4), textcoords="offset points", ha="center", fontsize=8, rotation=90)
            continue
        end, offset, edge = (mean + bar, 3, "bottom") if mean >= 1 else (max(mean - bar, 0.01 * mean), -3, "top")
        place_of: dict[str, Any] = {
            "textcoords": "offset points",
            "ha": "center",
            "va": edge,
            "fontsize": 8,
            "zorder": 4,
        }
        axes.annotate(f"{mean:.2f}", (x, end), (0, offset), **place_of)


def _pale(look: Look) -> tuple[float, float, float]:
    """The colour, two thirds white: a hatch stays visible on it."""
    r, g, b = to_rgb(look.colour)
    return (2 + r) / 3, (2 + g) / 3, (2 + b) / 3


def _scale_ratios(axes: Axes, values: Sequence[float]) -> None:
    """A log axis from a little below the smallest to a little above the largest value, ticks written plainly."""
    low, high = min(values), max(values)
    room = (high / low) ** 0.08
    axes.set_ylim(low / room, high * room)
    marks = np.array([m * 10.0**e for e in range(-2, 4) for m in (1, 1.2, 1.5, 2, 3, 5, 7)])
    if high / low < 2.5:
        marks = np.round(np.arange(0.1, 10, 0.1), 1)
    axes.yaxis.set_major_locator(FixedLocator(marks.tolist()))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
