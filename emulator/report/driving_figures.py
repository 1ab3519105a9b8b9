"""Figure of driven vehicles: their speeds against time."""

from __future__ import annotations

import numpy as np

from emulator.pages.canvas import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, SKY
from emulator.records.driven_table import of_vehicles
from emulator.records.events import EventKind
from emulator.records.tables import DRIVEN
from emulator.report.drawing import DASHES, Drawing, Line, faults_note, time_figure
from emulator.report.source import NothingToShow, Source

MOST_LINES = 12
"""Vehicles that have a line each; of more, every so many has one."""
_COLOURS = (BLUE, RED, GREEN, ORANGE, PURPLE, SKY)


def speeds(source: Source) -> Drawing:
    """Draw the true speeds of driven vehicles against time, with the instants of collisions."""
    table, units = source.recorded.table(DRIVEN), source.recorded.scenario.roadside
    nodes = source.recorded.node_ids[: len(source.recorded.node_ids) - len(units)]
    if table is None or not len(table) or not nodes:
        raise NothingToShow("no program drives")
    time_s, speed = of_vehicles(table, "speed_m_s", len(nodes))
    shown = np.unique(np.linspace(0, len(nodes) - 1, min(len(nodes), MOST_LINES)).round().astype(int)).tolist()
    styles = [(_COLOURS[i % len(_COLOURS)], DASHES[i // len(_COLOURS) % len(DASHES)]) for i in range(len(shown))]
    lines = [Line(nodes[n], time_s, speed[:, n], *style) for n, style in zip(shown, styles, strict=True)]
    made = time_figure(lines, "speed (m/s)", source.end_s, source.spans, linear=True)
    collisions = source.recorded.event(EventKind.collision)
    for event in collisions:
        made.axes.axvline(event.time_ns / 1e9, color=GREY, linewidth=0.8, zorder=0.8)
    some = f"{len(shown)} of {len(nodes)} vehicles" if len(shown) < len(nodes) else "All vehicles"
    crashed = f" Grey lines: collisions ({len(collisions)})." if collisions else " No collision."
    return Drawing(made, f"{some}; true speeds.{crashed}{faults_note(made, source)}")
