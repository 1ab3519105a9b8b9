"""The figures of a run's report, each from the run's own files."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from emulator.report.drawing import Chart, Drawing, draw_charts
from emulator.report.error_figures import common_error, consensus, consistency, position
from emulator.report.network_figures import degrees, links, weights
from emulator.report.radio_figures import ages, busy, latency, outcomes, totals
from emulator.report.source import Source

FIGURES: dict[str, tuple[str, Callable[[Source], Drawing]]] = {
    "common-error": ("Common error", common_error),
    "position": ("Position", position),
    "outcomes": ("Outcomes over time", outcomes),
    "totals": ("Outcomes in total", totals),
    "busy": ("Channel busy ratio", busy),
    "links": ("Packet delivery ratio against distance", links),
    "latency": ("Latency", latency),
    "ages": ("Inter-packet gap and age of information", ages),
    "consensus": ("Consensus error", consensus),
    "consistency": ("Consistency of the filters", consistency),
    "degrees": ("Node degrees", degrees),
    "weights": ("Fusion weights", weights),
}
"""Title and drawing by id, in the order of the page. A figure with nothing to show raises VnetError."""


def draw(source: Source) -> tuple[list[Chart], dict[str, list[str]]]:
    """Draw all figures of a run; returns also the titles of those with nothing to show, by reason."""
    return draw_charts({key: (title, partial(figure, source)) for key, (title, figure) in FIGURES.items()})
