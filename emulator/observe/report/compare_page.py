"""The page of `vnet compare`: two runs in the same axes, and the tables that the terminal shows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from emulator.observe.checks.verdicts import CheckResult
from emulator.observe.report.canvas import BLUE, RED, styled, to_svg
from emulator.observe.report.comparison import Comparison, Row
from emulator.observe.report.figures import DASHES, Chart, Line, time_figure
from emulator.observe.report.page import badge, escape, page, put_page, table
from emulator.observe.report.source import Source
from emulator.observe.report.write import STYLE, figures_section
from emulator.observe.summary import FIGURES
from vnet.errors import VnetError


def write_comparison(comparison: Comparison, path: Path) -> Path:
    """Write the page to `path`; returns it. Raises VnetError where the disk does not play along."""
    sources = comparison.first, comparison.second
    charts, missing = draw(sources)
    body = [
        f"<header><h1>{' and '.join(escape(source.folder.resolve().name) for source in sources)}</h1>",
        f"<p>{' '.join(badge(source.record.verdict) for source in sources)}</p></header>",
        *_section("Scenario, where it differs", sources, comparison.scenario_rows()),
        *_section("Verdicts, where they differ", sources, comparison.check_rows()),
        *_section("Figures (means after the first fifth of each run)", sources, comparison.figure_rows()),
        *_first_difference(comparison),
        *figures_section(charts, missing),
    ]
    return put_page(path, page("vnet: two runs", body, STYLE))


@styled
def draw(sources: Sequence[Source]) -> tuple[list[Chart], dict[str, str]]:
    """Each error against time, of both runs; and why those are missing that neither has."""
    charts, missing = [], {}
    for name, title in FIGURES.items():
        try:
            charts.append(_chart(sources, name, title))
        except VnetError as error:
            missing[title] = str(error)
    return charts, missing


def _chart(sources: Sequence[Source], name: str, title: str) -> Chart:
    lines = []
    problem = VnetError("")
    for source, colour, dash in zip(sources, (BLUE, RED), DASHES, strict=False):
        try:
            label = source.folder.resolve().name
            lines.append(Line(label, source.time_s, source.metric(name), colour, dash))
        except VnetError as error:
            problem = error
    if not lines:
        raise problem
    made = time_figure(lines, f"{title.partition(',')[0]} (m)", max(source.end_s for source in sources))
    means = ", ".join(f"{line.label} {np.nanmean(line.value):.3f} m" for line in lines)
    return Chart(name, title, to_svg(made.figure, name, title), f"Means over the whole run: {means}.")


def _section(title: str, sources: Sequence[Source], rows: Sequence[Row]) -> Iterator[str]:
    if not rows:
        return
    first, second = (str(source.folder) for source in sources)
    shown = [{"what": what, first: a, f"{second} ": b, "change": change} for what, a, b, change in rows]
    yield f"<section><h2>{escape(title)}</h2>{table(shown)}</section>"


def _first_difference(comparison: Comparison) -> Iterator[str]:
    difference = comparison.first_difference
    assert isinstance(difference, CheckResult), difference
    yield f"<section><h2>Where they first differ</h2><p>{escape(difference.text)}</p>"
    if rows := difference.figures.get("rows"):
        yield table(rows)
    yield "</section>"
