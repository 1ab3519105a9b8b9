"""A run as one picture: heading, map, events and reported values on the left, curves on the right.

The figures are those of the report. matplotlib draws them, as Rerun's viewer needs a display or a graphics driver.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

from emulator.pages.canvas import INK, PAPER, QUIET, WIDTH_PX, styled
from emulator.pages.text import as_text
from emulator.records.disk import atomically
from emulator.records.events import SAID, SAMPLES, Event
from emulator.records.run_folder import check_is_run
from emulator.report.figures import figures_of
from emulator.report.map_figures import map_charts
from emulator.report.program_figures import Drawers, program_charts
from emulator.report.source import NothingToShow, Source, maybe
from emulator.report.write import key_figures
from vnet.errors import VnetError, counted
from vnet.extras import require

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

_Drawn: TypeAlias = "tuple[str, NDArray[Any]]"
DPI = 72
"""Pixels an inch: a point is a pixel."""
MAP_PX, CURVE_PX = 760, 480
"""Width of the map, and of each curve."""
MARGIN_PX, HEADING_PX, TITLE_PX, LINE_PX = 20, 84, 22, 17
COLUMNS, ROWS = 2, 4
"""Curves beside the map: the first ones of the report that have data."""
MOST_EVENTS, MOST_SAID = 12, 6
LONGEST_LINE, LONGEST_HEADING = 104, 230
"""Letters of a line of an event, and of the figures below the name."""


class _Packed(NamedTuple):
    """A figure in a column, and where it begins and ends there."""

    column: int
    begin_px: int
    end_px: int
    drawn: _Drawn


def write_picture(folder: Path, path: Path) -> None:
    """Write a picture (PNG) of a finished run. Raise VnetError if it is none, or the file cannot be written."""
    require("a picture", "matplotlib")
    if path.suffix.lower() != ".png":
        raise VnetError(f"--png {path}: a name that ends with .png is needed")
    check_is_run(folder)
    source = Source(folder)
    with styled():
        picture = _picture(source)
        with atomically(path) as part:
            picture.savefig(part, format="png", dpi=DPI, facecolor=PAPER)


def _picture(source: Source) -> Figure:
    """Return the picture of a run."""
    from matplotlib.figure import Figure

    problems: list[str] = []
    chart = next(_drawn({"map": map_charts(source)["map"]}, MAP_PX, problems), None)
    curves = list(islice(_drawn(figures_of(source), CURVE_PX, problems), COLUMNS * ROWS))
    right = list(_packed(curves))
    right_px = max((one.end_px for one in right), default=0)
    charts = list(_packed(_drawn(program_charts(source), MAP_PX // COLUMNS, problems)))
    events = [line[:LONGEST_LINE] for line in (*_events(source), *problems)]
    left_px = (TITLE_PX + chart[1].shape[0] if chart else 0) + (TITLE_PX + LINE_PX * len(events))
    room_px = right_px - left_px - 2 * LINE_PX
    own = [one for one in charts if not one.begin_px or one.end_px <= room_px]  # the first ones in any case
    if more := len(charts) - len(own):
        events.append(f"and {counted(more, 'chart')} more of the program: see report.html")
        left_px += LINE_PX
    own_px = max((LINE_PX + one.end_px for one in own), default=0)
    height_px = HEADING_PX + max(left_px + own_px, right_px) + MARGIN_PX
    width_px = 3 * MARGIN_PX + MAP_PX + COLUMNS * CURVE_PX
    figure = Figure(figsize=(width_px / DPI, height_px / DPI), dpi=DPI)

    def write(text: str, x: float, y: float, **look: Any) -> None:
        figure.text(x / width_px, 1 - y / height_px, as_text(text), va="top", **look)

    def place(title: str, pixels: NDArray[Any], x: int, y: int) -> None:
        write(title, x + 8, y + 4, fontsize=13, color=INK)
        figure.figimage(pixels, x, height_px - y - TITLE_PX - pixels.shape[0])

    def place_all(packed: list[_Packed], x: int, y: int, width_px: int) -> None:
        for column, begin_px, _, drawn in packed:
            place(*drawn, x + column * width_px, y + begin_px)

    name, facts = _heading(source)
    write(name, MARGIN_PX, 16, fontsize=20, color=INK)
    write(facts, MARGIN_PX, 50, fontsize=13, color=QUIET)
    y = HEADING_PX
    if chart:
        place(*chart, MARGIN_PX, y)
        y += TITLE_PX + chart[1].shape[0]
    write("Events", MARGIN_PX + 8, y + 4, fontsize=13, color=INK)
    for number, line in enumerate(events):
        write(line, MARGIN_PX + 8, y + TITLE_PX + 4 + LINE_PX * number, color=QUIET)
    place_all(own, MARGIN_PX, HEADING_PX + left_px + LINE_PX, MAP_PX // COLUMNS)
    place_all(right, 2 * MARGIN_PX + MAP_PX, HEADING_PX, CURVE_PX)
    return figure


def _packed(drawn: Iterable[_Drawn]) -> Iterator[_Packed]:
    """Yield where each title and its pixels are placed: in the column that is the shortest until then."""
    ends_px = [0] * COLUMNS
    for each in drawn:
        column = ends_px.index(min(ends_px))
        begin_px = ends_px[column]
        ends_px[column] += TITLE_PX + each[1].shape[0]
        yield _Packed(column, begin_px, ends_px[column], each)


def _drawn(drawers: Drawers, width_px: int, problems: list[str]) -> Iterator[_Drawn]:
    """Yield title and pixels of each figure for which the run has data; what cannot be drawn is added in words."""
    from matplotlib.image import imread

    for title, draw in drawers.values():
        try:
            made = draw().canvas
        except NothingToShow:
            continue
        except VnetError as error:
            problems.append(f"{title} not shown: {error}")
            continue
        if (
            made.unnamed
            and (note := f"{counted(made.unnamed, 'fault')} more in the curves than are named") not in problems
        ):
            problems.append(note)
        file = io.BytesIO()
        made.figure.savefig(file, format="png", dpi=DPI * width_px / WIDTH_PX, transparent=True)
        file.seek(0)
        yield title, imread(file)


def _heading(source: Source) -> tuple[str, str]:
    """Return the name of a run with its verdict, and its figures in a line."""
    record = maybe(lambda: source.record)
    name = source.folder.resolve().name
    if record is None:
        return name, "without a verdict"
    facts = [f"{title} {value}" for title, value in key_figures(record).items()]
    while len(" · ".join(facts)) > LONGEST_HEADING:
        facts[-2:] = ["…"]
    return f"{name}: {record.verdict.value}", " · ".join(facts)


def _events(source: Source) -> list[str]:
    """Return the last events, and the last that programs told, in a line each; samples are left out."""
    events = [event for event in maybe(lambda: source.events) or () if not event.has(SAMPLES)]
    said = [event for event in events if event.has(SAID)][-MOST_SAID:]
    shown = [event for event in events if not event.has(SAID)][-MOST_EVENTS:] + said
    lines = [_line(event) for event in sorted(shown, key=lambda event: event.time_ns)] or ["none"]
    left = len(events) - len(shown)
    return [*lines, *([f"and {counted(left, 'event')} more: see report.html"] if left else [])]


def _line(event: Event) -> str:
    who = event.node or event.details.get("fault", "")
    said = " ".join((event.what if event.has(SAID) else event.said).splitlines())
    return f"{event.time_ns / 1e9:8.2f} s   {event.kind}   {who}   {said}"
