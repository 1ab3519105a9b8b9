"""The figures of a run's report, each from the run's own files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from emulator.report.drawing import Chart, Drawing, draw_charts
from emulator.report.driving_figures import speeds
from emulator.report.error_figures import consistency, declared_chart, position
from emulator.report.map_figures import map_charts
from emulator.report.network_figures import degrees, links, peers
from emulator.report.program_figures import program_charts
from emulator.report.radio_figures import ages, busy, latency, outcomes, totals
from emulator.report.source import Source
from vnet.units import title_of

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


def _figures(source: Source) -> dict[str, tuple[str, Callable[[Source], Drawing]]]:
    """Return the figures of a run: those that its program declares around vnet's."""
    declared = source.declared
    first = {each["id"]: (each["title"], partial(declared_chart, each)) for each in declared.charts}
    last = {
        f"peers-{name}": (f"{title_of(name).capitalize()} by vehicle", partial(peers, name))
        for name in declared.peers
    }
    return {**first, **FIGURES, **last}


@dataclass(frozen=True)
class Charts:
    """The charts of a run, and the titles of those that cannot be drawn, by reason."""

    map: list[Chart]
    program: list[Chart]
    figures: list[Chart]
    missing: dict[str, list[str]]


def draw(source: Source) -> Charts:
    """Draw all figures of a run."""
    drawers = {key: (title, partial(figure, source)) for key, (title, figure) in _figures(source).items()}
    network, program, figures = (
        draw_charts(each) for each in (map_charts(source), program_charts(source), drawers)
    )
    missing: dict[str, list[str]] = {}
    for _, problems in (network, program, figures):
        for reason, titles in problems.items():
            missing.setdefault(reason, []).extend(titles)
    return Charts(network[0], program[0], figures[0], missing)
