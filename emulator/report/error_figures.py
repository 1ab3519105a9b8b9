"""Figures of the estimates: their errors against time, what the program declares, and their consistency."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from emulator.pages.canvas import BLUE, GREEN, GREY, QUIET, RED
from emulator.records.metrics import anees_band
from emulator.report.drawing import DASHES, Drawing, Line, faults_note, time_figure
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
