"""Parts of the figures of reports and comparisons: lines against time, captions, and charts for a page."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from emulator.pages.canvas import (
    Canvas,
    FaultSpan,
    canvas,
    from_zero,
    legend,
    logarithmic,
    styled,
    thin,
    to_svg,
)
from emulator.report.source import NothingToShow, Source
from vnet.errors import VnetError
from vnet.types import Array

DASHES: tuple[Any, ...] = ("-", (0, (4, 1.8)), (0, (1.2, 1.4)))
WIDE_RANGE = 8.0
"""Ratio of the largest to the least value from which on an axis is logarithmic."""
TIME = "emulated time (s)"


@dataclass(frozen=True)
class Line:
    """A line against time: its label, times (n,) in seconds, values (n,) with NaN as gaps, colour and dashes."""

    label: str
    time_s: Array
    value: Array
    colour: str
    dash: Any = "-"


@dataclass(frozen=True)
class Drawing:
    """A figure and its caption."""

    canvas: Canvas
    caption: str


@dataclass(frozen=True)
class Chart:
    """A figure as it stands in a page: its id, title, picture and caption."""

    key: str
    title: str
    svg: Markup
    caption: str


def time_figure(
    lines: Sequence[Line], y_label: str, end_s: float, spans: Sequence[FaultSpan] = (), linear: bool = False
) -> Canvas:
    """Draw lines against time, spans of faults behind them; logarithmic if they spread far, unless `linear`."""
    everything = np.concatenate([line.value[np.isfinite(line.value)] for line in lines])
    positive = everything[everything > 0]
    is_log = not linear and len(positive) > 0 and positive.max() > WIDE_RANGE * positive.min()
    made = canvas(TIME, y_label, spans, end_s)
    for line in lines:
        marker = "o" if np.isfinite(line.value).sum() < 3 else None
        shown: dict[str, Any] = {
            "color": line.colour,
            "linestyle": line.dash,
            "marker": marker,
            "label": line.label,
        }
        value = np.where(line.value > 0, line.value, np.nan) if is_log else line.value  # zero is a gap
        made.axes.plot(*thin(line.time_s, value), **shown)
    if is_log:
        logarithmic(made.axes)
    else:
        from_zero(made.axes)
    if len(lines) > 1:
        legend(made)
    return made


def faults_note(made: Canvas, source: Source) -> str:
    """Return the caption's sentence on the shaded spans; "" without faults."""
    if not source.spans:
        return ""
    unnamed = f"; {made.unnamed} more have no room for their names" if made.unnamed else ""
    return f" Shaded: active faults, named above{unnamed}."


@styled()
def draw_charts(
    drawers: Mapping[str, tuple[str, Callable[[], Drawing]]],
) -> tuple[list[Chart], dict[str, list[str]]]:
    """Draw figures, given as (title, drawer) by id; returns them and the titles of the others, by reason.

    A drawer raises NothingToShow where the run has no such data, and VnetError with the reason if it cannot be had.
    """
    charts: list[Chart] = []
    missing: dict[str, list[str]] = {}
    for key, (title, draw) in drawers.items():
        try:
            drawing = draw()
        except NothingToShow:
            continue
        except VnetError as error:
            missing.setdefault(str(error), []).append(title)
            continue
        charts.append(Chart(key, title, to_svg(drawing.canvas.figure, key, title), drawing.caption))
    return charts, missing
