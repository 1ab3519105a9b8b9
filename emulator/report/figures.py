"""The figures of a run's report, each from the run's own files."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from emulator.pages.canvas import BLUE, GREEN, GREY, ORANGE, PURPLE, QUIET, RED, SKY
from emulator.records.driven_table import of_vehicles
from emulator.records.events import EventKind
from emulator.records.metrics import anees_band
from emulator.records.tables import DRIVEN
from emulator.report.drawing import DASHES, Chart, Drawing, Line, draw_charts, faults_note, time_figure
from emulator.report.map_figures import map_charts
from emulator.report.network_figures import degrees, links, peers
from emulator.report.program_figures import Drawers, program_charts
from emulator.report.radio_figures import ages, busy, latency, outcomes, totals
from emulator.report.source import NothingToShow, Source, maybe
from vnet.errors import VnetError
from vnet.units import title_of


def _lines(source: Source, names: dict[str, str]) -> list[Line]:
    """Return columns of the metrics by label; those that no program reported are dropped.

    Raises VnetError if none is left.
    """
    found: list[Line] = []
    problem: VnetError = NothingToShow("")
    for (label, name), colour, dash in zip(names.items(), (BLUE, RED, GREEN), DASHES, strict=False):
        try:
            found.append(Line(label, source.time_s, source.metric(name), colour, dash))
        except VnetError as error:
            problem = error
    if not found:
        raise problem
    return found


def declared_chart(chart: Mapping[str, Any], source: Source) -> Drawing:
    """Draw figures that the program declares to belong together."""
    names = chart["lines"]
    lines = _lines(source, names)
    text = chart["text"] + _add_reference(source, next(iter(names.values())), lines)
    made = time_figure(lines, chart["axis"], source.end_s, source.spans)
    return Drawing(made, text + faults_note(made, source))


def _add_reference(source: Source, name: str, lines: list[Line]) -> str:
    """Add a line of the reference's figure of this name, if there is one; returns the caption's sentence on it.

    It compares the means after the first fifth of the run with those of the first line.
    """
    series = maybe(lambda: source.reference_series) or {}
    if name not in series:
        return ""
    label, value = source.reference.NAME, series[name][: len(source.time_s)]
    settled = slice(len(value) // 5, len(value))
    mean_m, least_m = (float(np.sqrt(np.nanmean(each[settled] ** 2))) for each in (lines[0].value, value))
    ratio = f": {mean_m / least_m:.2f} times the {label} after the first fifth of the run" if least_m > 0 else ""
    lines.append(Line(label, source.time_s, value, GREEN, DASHES[2]))
    return f" {label.capitalize()}: {source.reference.TEXT}{ratio}."


def position(source: Source) -> Drawing:
    """Draw the errors of the estimated positions and of the raw fixes."""
    if not source.estimates_positions:
        raise NothingToShow("no program estimated its position")
    lines = _lines(source, {"estimates": "position_rmse_m", "raw fixes": "fix_rmse_m"})
    text = "Distance of the vehicles' estimates, and of their receivers' raw fixes, from the true positions."
    text += _add_reference(source, "position_rmse_m", lines)
    made = time_figure(lines, "RMSE of position (m)", source.end_s, source.spans)
    return Drawing(made, text + faults_note(made, source))


def consistency(source: Source) -> Drawing:
    """Draw the normalized squared errors of the filters."""
    names = [name for name in source.metrics.column_names if name.endswith("_anees")]
    if not source.estimates_positions:
        names.remove("position_anees")
    names.sort(key="position_anees".__eq__)
    lines = _lines(source, {title_of(name.removesuffix("_anees")): name for name in names})
    made = time_figure(lines, "ANEES (1 = consistent)", source.end_s, source.spans)
    count = int(np.median(source.metrics["reporting"].to_numpy())) or 1
    low, high = anees_band(count)
    made.axes.axhspan(low, high, color=GREY, alpha=0.25, linewidth=0, zorder=0.6)
    made.axes.axhline(1, color=QUIET, linewidth=1, zorder=0.7)
    bottom, top = made.axes.get_ylim()
    made.axes.set_ylim(min(bottom, low / 1.1), max(top, high * 1.1))
    text = (
        f"Normalized estimation error squared, averaged. Above 1 a filter is overconfident. Grey: 95 % band of "
        f"{count} independent estimates, {low:.2f} to {high:.2f}; dependent ones spread further."
    )
    return Drawing(made, text + faults_note(made, source))


MOST_LINES = 12
"""Vehicles that have a line each; of more, every so many has one."""
_COLOURS = (BLUE, RED, GREEN, ORANGE, PURPLE, SKY)


def speeds(source: Source) -> Drawing:
    """Draw the true speeds of driven vehicles against time, with the instants of collisions."""
    table, units = source.table(DRIVEN), source.scenario.roadside
    nodes = source.node_ids[: len(source.node_ids) - len(units)]
    if table is None or not len(table) or not nodes:
        raise NothingToShow("no program drives")
    time_s, speed = of_vehicles(table, "speed_m_s", len(nodes))
    shown = np.unique(np.linspace(0, len(nodes) - 1, min(len(nodes), MOST_LINES)).round().astype(int)).tolist()
    styles = [(_COLOURS[i % len(_COLOURS)], DASHES[i // len(_COLOURS) % len(DASHES)]) for i in range(len(shown))]
    lines = [Line(nodes[n], time_s, speed[:, n], *style) for n, style in zip(shown, styles, strict=True)]
    made = time_figure(lines, "speed (m/s)", source.end_s, source.spans, linear=True)
    collisions = source.event(EventKind.collision)
    for event in collisions:
        made.axes.axvline(event.time_ns / 1e9, color=GREY, linewidth=0.8, zorder=0.8)
    some = f"{len(shown)} of {len(nodes)} vehicles" if len(shown) < len(nodes) else "All vehicles"
    crashed = f" Grey lines: collisions ({len(collisions)})." if collisions else " No collision."
    return Drawing(made, f"{some}; true speeds.{crashed}{faults_note(made, source)}")


FIGURES: dict[str, tuple[str, Callable[[Source], Drawing]]] = {
    "position": ("Position", position),
    "speeds": ("Speed of driven vehicles", speeds),
    "outcomes": ("Outcomes over time", outcomes),
    "totals": ("Outcomes in total", totals),
    "busy": ("Channel busy ratio", busy),
    "links": ("Packet delivery ratio against distance", links),
    "latency": ("Latency", latency),
    "ages": ("Inter-packet gap and age of information", ages),
    "consistency": ("Consistency of the filters", consistency),
    "degrees": ("Node degrees", degrees),
}
"""Title and drawing by id, in the order of the page. A figure without data raises NothingToShow."""


def figures_of(source: Source) -> Drawers:
    """Return title and drawing of the figures of a run, by id: those that its program declares around vnet's."""
    declared = source.declared
    first = {each["id"]: (each["title"], partial(declared_chart, each)) for each in declared.charts}
    last = {
        f"peers-{name}": (f"{title_of(name).capitalize()} by vehicle", partial(peers, name))
        for name in declared.peers
    }
    of_run: dict[str, tuple[str, Callable[[Source], Drawing]]] = {**first, **FIGURES, **last}
    return {key: (title, partial(figure, source)) for key, (title, figure) in of_run.items()}


@dataclass(frozen=True)
class Charts:
    """The charts of a run, and the titles of those that cannot be drawn, by reason."""

    map: list[Chart]
    program: list[Chart]
    figures: list[Chart]
    missing: dict[str, list[str]]


def draw(source: Source) -> Charts:
    """Draw all figures of a run."""
    network, program, figures = (
        draw_charts(each) for each in (map_charts(source), program_charts(source), figures_of(source))
    )
    missing: dict[str, list[str]] = {}
    for _, problems in (network, program, figures):
        for reason, titles in problems.items():
            missing.setdefault(reason, []).extend(titles)
    return Charts(network[0], program[0], figures[0], missing)
