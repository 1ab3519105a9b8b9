"""Tempering of the map's evidence: the filters' consistency against `lateral_tau_s` (MODEL 2, `cmm/rbpf.py`).

A filter that takes its vehicles to change their offsets in the lane sooner than they do counts old evidence as new
and is too sure of itself (ANEES over 1); one that takes them to keep them longer is less sure than it could be. So
ANEES chooses τ: for the bound, whose filter has so many particles that nothing else is wrong with it, and for
cooperation.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from emulator.cells.cells import Cell
from emulator.records.metrics import anees_band
from studies.measure import study_cell
from studies.paper import DEFAULT_S, Labels, bound_scenario, counted_from, default_scenario
from studies.reports import Result, column, select, unique
from studies.style import BLACK, BLUE, GREEN, ORANGE, PURPLE, RED, save, styled
from studies.tables import in_seeds, markdown_table, mean_and_error, mean_and_standard_error

TAUS_S = (2.5, 5.0, 10.0, 20.0, 40.0, 80.0)
WORLD_TAU_S = 20.0
"""Over how long the offsets of the default world change."""
COOPERATIVE_ON = "n3"
"""The network on which the cooperative default is swept too: it takes as long as all of the bound."""
COMMON, POSITION = "common_error_anees", "position_anees"
_NAMES = {COMMON: "common error", POSITION: "position"}
_LOOKS: tuple[tuple[str, str, Any], ...] = (
    (BLUE, "o", "-"),
    (RED, "^", (0, (5, 2))),
    (GREEN, "v", (0, (4, 1.5, 1, 1.5))),
    (PURPLE, "P", (0, (1, 1.5))),
    (ORANGE, "X", (0, (7, 2, 1, 2, 1, 2))),
)
"""A colour, marker and line for each filter and network."""
TICKS = (0.25, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0)


def tempering_cells(
    networks: dict[str, dict[str, Any]],
    seeds: Sequence[int],
    taus_s: Sequence[float] = TAUS_S,
    duration_s: float = DEFAULT_S,
) -> list[Cell]:
    """Each τ in the default world: for the bound on all networks, for the cooperative default on one of them."""
    cells = []
    for network, section in networks.items():
        for mechanism in ("bound", "optimized") if network == COOPERATIVE_ON else ("bound",):
            for tau_s in taus_s:
                for seed in seeds:
                    labels: Labels = {"network": network, "mechanism": mechanism, "tau_s": tau_s, "seed": seed}
                    options = {"lateral_tau_s": tau_s}
                    if mechanism == "bound":
                        scenario = bound_scenario(section, seed, True, options, duration_s)
                    else:
                        scenario = default_scenario(section, seed, options, duration_s)
                    cells.append(study_cell(labels, scenario, counted_from(duration_s)))
    return cells


def chosen_tau_s(results: Sequence[Result], name: str = COMMON) -> float | None:
    """The τ at which `name` is nearest to 1 over the networks: least mean (ln ANEES)². None where nobody has it."""
    distance = {}
    for tau_s in unique(results, "tau_s"):
        rows = select(results, tau_s=tau_s)
        means = [mean_and_standard_error(column(select(rows, network=n), name))[0] for n in unique(rows, "network")]
        found = [mean for mean in means if mean > 0]
        if found:
            distance[tau_s] = float(np.mean(np.log(found) ** 2))
    return min(distance, key=lambda tau_s: distance[tau_s]) if distance else None


def report(results: Sequence[Result]) -> str:
    """The sweep in Markdown: a table for each filter and network, and which τ ANEES chooses."""
    runs = len(unique(results, "seed"))
    low, high = anees_band(runs)
    parts = ["# The tempering of the road evidence", *_choices(results)]
    for mechanism, network, rows in _groups(results):
        parts += [f"## {mechanism} on {network.upper()}", _table(rows)]
    parts.append(
        f"{in_seeds(runs)}. τ is `lateral_tau_s` of the filter; the world's offsets change over "
        f"{WORLD_TAU_S:g} s. ANEES is 1 for a consistent filter, more for one that is too sure; the 95 % band of "
        f"{runs} independent samples of two degrees of freedom is {low:.2f} to {high:.2f} (*: out of it). The "
        "samples within a run are not independent, but there are more than one: the standard error says how well "
        "the mean is known. The bound reports no covariance of positions."
    )
    return "\n\n".join(parts) + "\n"


def _groups(results: Sequence[Result]) -> Iterator[tuple[str, str, list[Result]]]:
    """The runs of each filter and network."""
    for mechanism in unique(results, "mechanism"):
        for network in unique(results, "network"):
            if rows := select(results, mechanism=mechanism, network=network):
                yield mechanism, network, rows


def _table(results: Sequence[Result]) -> str:
    header = ["τ [s]", "RMSE of the common error [m]", "its ANEES", "RMSE of the position [m]", "its ANEES"]
    rows = []
    for tau_s in unique(results, "tau_s"):
        found = select(results, tau_s=tau_s)
        row = [f"{tau_s:g}"]
        for error, consistency in (("rmse_m", COMMON), ("position_rmse_m", POSITION)):
            row += [mean_and_error(column(found, error)), _consistency(column(found, consistency))]
        rows.append(row)
    return markdown_table(header, sorted(rows, key=lambda row: float(row[0])))


def _consistency(values: Sequence[float]) -> str:
    low, high = anees_band(len(values))
    mean = mean_and_standard_error(values)[0]
    return mean_and_error(values, 2) + ("*" if mean < low or mean > high else "")


def _choices(results: Sequence[Result]) -> Iterator[str]:
    """A sentence for each filter and figure: the τ that is best over the networks, and on each of them."""
    for mechanism in unique(results, "mechanism"):
        rows = select(results, mechanism=mechanism)
        for name, what in _NAMES.items():
            over_all = chosen_tau_s(rows, name)
            if over_all is not None:
                each = "; ".join(_choice(select(rows, network=n), n, name) for n in unique(rows, "network"))
                yield f"ANEES of the {what}, {mechanism}: nearest to 1 at **τ = {over_all:g} s** ({each})."


def _choice(results: Sequence[Result], network: str, name: str) -> str:
    tau_s = chosen_tau_s(results, name)
    if tau_s is None:
        return f"{network.upper()} –"
    return f"{network.upper()} {tau_s:g} s: {mean_and_error(column(select(results, tau_s=tau_s), name), 2)}"


def tempering_curve(results: Sequence[Result], out: Path) -> Path:
    """ANEES, with its band, and RMSE against τ, each ± 1 standard error; PNG and SVG."""
    return save(draw_tempering_curve(results), out)


@styled
def draw_tempering_curve(results: Sequence[Result]) -> Figure:
    figure = Figure(figsize=(10, 4.8), layout="constrained")
    consistency, error = figure.subplots(1, 2)
    groups = list(_groups(results))
    for number, (mechanism, network, rows) in enumerate(groups):
        label = f"{mechanism} on {network.upper()}"
        _draw_curve(consistency, rows, COMMON, number, f"{label}, common error")
        _draw_curve(error, rows, "rmse_m", number, None)
        if any(row[POSITION] is not None for row in rows):
            _draw_curve(consistency, rows, POSITION, len(groups), f"{label}, position")
    low, high = anees_band(len(unique(results, "seed")))
    consistency.axhspan(low, high, color="0.902", zorder=0, label="95 % band, one sample a run")
    consistency.axhline(1.0, color=BLACK, linewidth=1, zorder=1)
    consistency.set_yscale("log")
    _dress(
        consistency, unique(results, "tau_s"), "ANEES (no unit; 1 is consistent)", (0.25, 0.5, 0.7, 1, 1.5, 2, 3, 5)
    )
    _dress(error, unique(results, "tau_s"), "RMSE of the common error (m)", ())
    error.set_ylim(0, None)
    figure.suptitle("Tempering of the roads: consistency and error, ± 1 standard error")
    figure.legend(*consistency.get_legend_handles_labels(), loc="outside lower center", ncols=3, handlelength=3.5)
    return figure


def _draw_curve(axes: Axes, results: Sequence[Result], name: str, number: int, label: str | None) -> None:
    colour, marker, line = _LOOKS[number % len(_LOOKS)]
    taus_s = sorted(unique(results, "tau_s"))
    pairs = [mean_and_standard_error(column(select(results, tau_s=tau_s), name)) for tau_s in taus_s]
    mean, error = np.array(pairs).T
    axes.errorbar(
        taus_s, mean, np.nan_to_num(error), color=colour, marker=marker, linestyle=line, linewidth=1.6, capsize=3,
        label=label,
    )  # fmt: skip


def _dress(axes: Axes, taus_s: Sequence[float], label: str, ticks: Sequence[float]) -> None:
    axes.set_xscale("log")
    axes.axvline(WORLD_TAU_S, color=BLACK, linewidth=1, linestyle=(0, (1, 2)), zorder=1)
    axes.xaxis.set_major_locator(FixedLocator(list(taus_s)))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_xlabel("lateral_tau_s of the filter (s); dotted: the world's")
    axes.set_ylabel(label)
    if ticks:
        axes.yaxis.set_major_locator(FixedLocator(list(ticks)))
        axes.yaxis.set_minor_locator(NullLocator())
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
