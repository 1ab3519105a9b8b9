"""Small charts as inline SVG: matplotlib draws them, the page's CSS variables colour them.

A figure is drawn with the colours of light paper; `to_svg` puts the page's variables in their place, so that one
picture serves light and dark. Text stays text, coordinates are rounded to a tenth of a pixel, and lines are thinned
to what a screen can show.
"""

from __future__ import annotations

import io
import logging
import math
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np
from markupsafe import Markup

from emulator.pages.palette import PALETTE
from emulator.pages.text import as_text
from vnet.extras import is_installed, require
from vnet.types import Array

if TYPE_CHECKING:  # an extra, and slow to import: those who draw nothing do without
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, QUIET, LINE, GRID, PAPER, BLUE, ORANGE, GREEN, RED, PURPLE, SKY, YELLOW, GREY, SAND, RUST, NAVY, *_ = (
    colour.light for colour in PALETTE.values()
)
CURVES = (BLUE, RED, GREEN, ORANGE, PURPLE, SKY)
"""Colours of curves, in their order."""
for _library in map(logging.getLogger, ("matplotlib", "PIL")):
    if _library.level == logging.NOTSET:  # a program may have asked for all that anybody logs
        _library.setLevel(logging.WARNING)
    _library.addHandler(logging.NullHandler())  # else Python prints warnings of it, as of a home without a cache
_VARIABLE = {colour.light: f"var(--{name})" for name, colour in PALETTE.items()}

WIDTH_PX, PLOT_PX = 400, 190
"""A figure's width, and the height of what is inside its axes, at the size that it is drawn for."""
_LEFT_PX, _RIGHT_PX, _TOP_PX, _BOTTOM_PX = 54, 12, 8, 42
_LEGEND_ROW_PX, _LANE_PX = 18, 15
_MOST_LANES = 6
LEGEND_COLUMNS = 3
_LETTER_PX = 5.6
"""The width of a letter of a fault's label, on average."""
MOST_POINTS = 2 * (WIDTH_PX - _LEFT_PX - _RIGHT_PX)

STYLED: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "vnet",
    "text.parse_math": False,
    "font.size": 11,
    "axes.labelsize": 12,
    "legend.fontsize": 11,
    "legend.frameon": False,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": QUIET,
    "xtick.color": QUIET,
    "ytick.color": QUIET,
    "axes.facecolor": "none",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.spines.left": False,
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.grid.axis": "y",
    "grid.color": GRID,
    "grid.linewidth": 1.0,
    "ytick.major.size": 0,
    "ytick.minor.size": 0,
    "xtick.major.size": 3.5,
    "lines.linewidth": 1.6,
    "lines.solid_capstyle": "round",
    "path.simplify": False,
}


@dataclass(frozen=True)
class FaultSpan:
    """A time [start, end) in seconds in which a fault acted."""

    label: str
    start_s: float
    end_s: float


@dataclass(frozen=True)
class Canvas:
    """A figure with one pair of axes, all of the same size and at the same place."""

    figure: Figure
    axes: Axes
    unnamed: int = 0
    """Faults that are shaded, but have no room for their name."""


@contextmanager
def styled() -> Iterator[None]:
    """Draw in the style of the pages within the block; without matplotlib, with which nothing is drawn, in none."""
    if not is_installed("matplotlib"):
        yield
        return
    from matplotlib import rc_context

    with rc_context(STYLED), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph ")  # fonts of a page show what matplotlib's lack
        yield


def canvas(
    x_label: str,
    y_label: str,
    spans: Sequence[FaultSpan] = (),
    end_s: float = 0.0,
    plot_px: float = PLOT_PX,
) -> Canvas:
    """Make empty axes; with `spans`, faults are shaded on an axis of time until `end_s`, and named above it.

    Raises VnetError if matplotlib is not installed.
    """
    require("a figure", "matplotlib")
    from matplotlib.figure import Figure

    lanes = _in_lanes(spans, end_s)
    height_px = _TOP_PX + len(lanes) * _LANE_PX + plot_px + _BOTTOM_PX
    figure = Figure(figsize=(WIDTH_PX / 72, height_px / 72), dpi=72)
    figure.patch.set_visible(False)
    width = (WIDTH_PX - _LEFT_PX - _RIGHT_PX) / WIDTH_PX
    axes = figure.add_axes((_LEFT_PX / WIDTH_PX, _BOTTOM_PX / height_px, width, plot_px / height_px))
    axes.set(xlabel=x_label, ylabel=y_label)
    axes.yaxis.set_label_coords(-40 / (WIDTH_PX * width), 0.5)
    if end_s:
        axes.set_xlim(0, end_s)
    for span in spans:
        axes.axvspan(span.start_s, span.end_s, color=PURPLE, alpha=0.16, linewidth=0, zorder=0.5)
    if lanes:
        bottom = (_BOTTOM_PX + plot_px) / height_px
        strip = figure.add_axes((_LEFT_PX / WIDTH_PX, bottom, width, len(lanes) * _LANE_PX / height_px))
        _draw_lanes(strip, lanes, end_s)
    return Canvas(figure, axes, len(spans) - sum(map(len, lanes)))


def _reach(span: FaultSpan, end_s: float) -> tuple[float, float]:
    """Return the start and end in seconds of a span with its label; a label stays left of the right edge."""
    label_s = (_LETTER_PX * len(span.label) + 8) * end_s / (WIDTH_PX - _LEFT_PX - _RIGHT_PX)
    start_s = min(span.start_s, end_s - label_s)
    return start_s, max(span.end_s, start_s + label_s)


def _in_lanes(spans: Sequence[FaultSpan], end_s: float) -> list[list[FaultSpan]]:
    """Arrange spans in as few rows as hold them and their labels; those beyond the last row are dropped."""
    lanes: list[list[FaultSpan]] = []
    for span in sorted(spans, key=lambda span: (span.start_s, span.end_s)):
        start_s, _ = _reach(span, end_s)
        free = (lane for lane in lanes if _reach(lane[-1], end_s)[1] <= start_s)
        lane = next(free, None)
        if lane is not None:
            lane.append(span)
        elif len(lanes) < _MOST_LANES:
            lanes.append([span])
    return lanes


def _draw_lanes(strip: Axes, lanes: Sequence[Sequence[FaultSpan]], end_s: float) -> None:
    strip.set(xlim=(0, end_s), ylim=(len(lanes), 0))
    strip.set_axis_off()
    for row, lane in enumerate(lanes):
        for span in lane:
            strip.plot(
                [span.start_s, span.end_s], [row + 0.86] * 2, color=PURPLE, linewidth=2.5, solid_capstyle="butt"
            )
            strip.text(_reach(span, end_s)[0], row + 0.68, span.label, fontsize=10, color=QUIET, va="baseline")


def legend(of: Canvas, handles: Sequence[Artist] | None = None) -> None:
    """Put a legend of these handles, or of all that have labels, above the figure, which grows by its rows.

    It has as many columns, at most `LEGEND_COLUMNS`, as fit beside each other.
    """
    shown = of.axes.get_legend_handles_labels()[0] if handles is None else list(handles)
    if not shown:
        return
    for columns in range(min(LEGEND_COLUMNS, len(shown)), 0, -1):
        drawn = of.figure.legend(
            handles=shown,
            loc="upper left",
            bbox_to_anchor=(_LEFT_PX / WIDTH_PX, 1),
            ncols=columns,
            handlelength=1.8,
            handletextpad=0.5,
            columnspacing=1.2,
            labelspacing=0.35,
            borderpad=0.1,
            borderaxespad=0.1,
        )
        if columns == 1 or drawn.get_window_extent().x1 <= of.figure.bbox.x1:
            break
        drawn.remove()
    width, height = of.figure.get_size_inches()
    taller = height + math.ceil(len(shown) / columns) * _LEGEND_ROW_PX / 72
    of.figure.set_size_inches(width, taller)
    for axes in of.figure.axes:
        place = axes.get_position()
        axes.set_position((place.x0, place.y0 * height / taller, place.width, place.height * height / taller))


def from_zero(axes: Axes) -> None:
    """Make the y axis linear from zero, with few ticks."""
    from matplotlib.ticker import MaxNLocator

    top = axes.get_ylim()[1]
    axes.set_ylim(0, top if top > 0 else 1)
    axes.yaxis.set_major_locator(MaxNLocator(5))


def logarithmic(axes: Axes) -> None:
    """Make the y axis logarithmic, with plain numbers; over few powers of ten with 2 and 5 between them."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    axes.set_yscale("log")
    low, high = axes.get_ylim()
    between = (1, 2, 5) if high < 200 * low else (1,)
    axes.yaxis.set_major_locator(LogLocator(subs=between))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def whole_numbers(axes: Axes) -> None:
    """Put the y axis' ticks at integers, with commas at the thousands."""
    from matplotlib.ticker import FuncFormatter, MaxNLocator

    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))


def thin(time_s: Array, value: Array) -> tuple[Array, Array]:
    """Thin a line to `MOST_POINTS` points: minimum and maximum of each stretch. NaN are gaps, and stay."""
    if len(time_s) <= MOST_POINTS:
        return time_s, value
    kept: list[int] = []
    for stretch in np.array_split(np.arange(len(value)), MOST_POINTS // 2):
        if np.isnan(value[stretch]).all():
            kept.append(int(stretch[0]))
        else:
            extremes = int(np.nanargmin(value[stretch])), int(np.nanargmax(value[stretch]))
            kept += sorted(stretch[list(extremes)].tolist())
    return time_s[kept], value[kept]


_NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML 1.0 has not: a program may report them in texts."""


def to_svg(figure: Figure, key: str, label: str) -> Markup:
    """Return the figure as an `<svg>` element; `key` makes its ids unique on a page, `label` describes it."""
    file = io.BytesIO()
    figure.savefig(file, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    root = ElementTree.fromstring(_NOT_XML.sub("\ufffd", file.getvalue().decode()))
    numbers = count()
    names = {name: f"{key}-{next(numbers)}" for element in root.iter() for name in _references(element)}
    for parent in root.iter():
        for child in [child for child in parent if child.tag.endswith(("}metadata", "}style"))]:
            parent.remove(child)
        _make_plain(parent, names)
    view_box = root.attrib["viewBox"]
    body = "".join(ElementTree.tostring(child, encoding="unicode") for child in root)
    start = Markup('<svg class="chart" viewBox="{}" role="img" aria-label="{}">').format(view_box, as_text(label))
    return start + Markup(body) + Markup("</svg>")


_REFERENCE = re.compile(r"url\(#(.+?)\)")
_HREF = "{http://www.w3.org/1999/xlink}href"


def _references(element: ElementTree.Element) -> list[str]:
    """Return the ids that an element refers to."""
    href = element.get(_HREF)
    return [href[1:]] if href else _REFERENCE.findall(element.get("clip-path", ""))


def _make_plain(element: ElementTree.Element, names: dict[str, str]) -> None:
    """Remove what a page does not need, and put the page's variables in place of colours."""
    element.tag = element.tag.partition("}")[2] or element.tag
    if element.tag != "text":
        element.text = None
    element.tail = None
    styles = {child.get("style") for child in element}
    if len(element) > 1 and len(styles) == 1 and all(child.tag.endswith("use") for child in element):
        element.set("style", styles.pop() or "")
        for child in element:
            child.attrib.pop("style", None)
    name = element.attrib.pop("id", None)
    if name in names:
        element.set("id", names[name])
    if href := element.attrib.pop(_HREF, None):
        element.set("href", f"#{names[href[1:]]}")
    if "clip-path" in element.attrib:
        element.set(
            "clip-path", _REFERENCE.sub(lambda match: f"url(#{names[match[1]]})", element.get("clip-path", ""))
        )
    if "d" in element.attrib:
        element.set("d", _round(" ".join(element.get("d", "").split())))
    for attribute in ("x", "y"):
        if attribute in element.attrib:
            element.set(attribute, _round(element.get(attribute, "")))
    if "transform" in element.attrib:
        transform = element.attrib.pop("transform")
        if not transform.startswith("rotate(-0 "):
            element.set("transform", _round(transform))
    if "style" in element.attrib:
        style = re.sub(r" ?font-family:[^;]*;", "", element.get("style", ""))
        element.set("style", re.sub("#[0-9a-f]{6}", lambda match: _VARIABLE[match[0]], style))


def _round(numbers: str) -> str:
    return re.sub(r"-?\d+\.\d+", lambda match: f"{float(match[0]):.1f}".removesuffix(".0"), numbers)
