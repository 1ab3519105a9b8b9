"""Charts of what programs report by names of their own: each value against time."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa

from emulator.pages.canvas import BLUE, CURVES, GREY, RED, canvas, legend
from emulator.records.reported import is_text
from emulator.report.drawing import DASHES, TIME, Drawing, Line, faults_note, time_figure
from emulator.report.source import NothingToShow, Source
from vnet.types import Array
from vnet.units import label_of, title_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_TEXTS = 6
"""Texts of one name that have a line; the others are counted together."""
MOST_CHARTS = 24
"""Values that have a chart."""

Drawers = dict[str, tuple[str, Callable[[], Drawing]]]


def program_charts(source: Source) -> Drawers:
    """Return title and drawing of each value's chart, by id."""
    drawers: Drawers = {}
    for number, name in enumerate(source.drawn_names[:MOST_CHARTS]):
        kind = source.states.schema.field(name).type
        draw = partial(_texts if is_text(kind) else _numbers, source, name)
        drawers[f"own-{number}"] = (title_of(name), draw)
    return drawers


def _numbers(source: Source, name: str) -> Drawing:
    """Draw mean and 5 to 95 % over the vehicles, and one vehicle; of a boolean the share that is true."""
    value = source.value(name)
    time_s = source.times_s
    if np.isfinite(value).any(axis=1).sum() < 2:
        raise NothingToShow("reported in one period only")
    curve = partial(points, time_s, usual=usual_periods(value))
    if source.is_boolean(name):
        share = Line("", *curve(100 * row_means(value)), BLUE)
        made = time_figure([share], f"{title_of(name)} (%)", source.end_s, source.spans, True)
        made.axes.set_ylim(0, 105)
        text = "Share of the vehicles that report it that say true."
        return Drawing(made, text + faults_note(made, source))
    node = int(np.isfinite(value).sum(axis=0).argmax())
    who = source.node_ids[node]
    several = value.shape[1] > 1
    lines = [Line("mean of the vehicles" if several else who, *curve(row_means(value)), BLUE)]
    if several:
        lines.append(Line(who, *curve(value[:, node]), RED, DASHES[1]))
    made = time_figure(lines, label_of(name), source.end_s, source.spans, linear=True)
    if several:
        low, high = _band(value)
        (band_s, low), (_, high) = curve(low), curve(high)
        made.axes.fill_between(band_s, low, high, color=GREY, alpha=0.3, linewidth=0, zorder=0.7)
    _fit(made.axes, value)
    text = "Grey: 5 to 95 % of the vehicles." if several else ""
    return Drawing(made, f"{text}{faults_note(made, source)}".strip())


def usual_periods(value: Array) -> float:
    """Return the usual number of periods from one report of a vehicle to its next, of values (periods, N)."""
    node, period = np.nonzero(np.isfinite(value).T)
    apart = np.diff(period)[np.diff(node) == 0]
    return float(np.median(apart)) if len(apart) else 1.0


def points(time_s: Array, value: Array, usual: float) -> tuple[Array, Array]:
    """Return times and values of a curve: the finite ones, with a gap where none came for twice `usual` periods.

    A program need not report in each period, and a curve through NaN would not be drawn.
    """
    known = np.flatnonzero(np.isfinite(value))
    gaps = np.flatnonzero(np.diff(known) > 2 * usual) + 1
    return np.insert(time_s[known], gaps, np.nan), np.insert(value[known], gaps, np.nan)


def _fit(axes: Axes, value: Array) -> None:
    """Let the axis of values begin at zero, or below where values are negative."""
    finite = value[np.isfinite(value)]
    least, most = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 0.0)
    margin = 0.05 * (most - min(least, 0.0)) or 1.0
    axes.set_ylim(least - margin if least < 0 else 0, most + margin)


def _texts(source: Source, name: str) -> Drawing:
    """Draw the share of the vehicles that report each text."""
    shares, texts = text_shares(source, name)
    if not texts:
        raise NothingToShow("nothing was reported")
    time_s = source.times_s
    drawn = texts[:MOST_TEXTS]
    made = canvas(TIME, f"{title_of(name)} (% of vehicles)", source.spans, source.end_s)
    for index, text in enumerate(drawn):
        made.axes.plot(time_s, 100 * shares[:, index], color=CURVES[index], label=text)
    made.axes.set_ylim(0, 105)
    legend(made)
    more = f" {len(texts) - MOST_TEXTS} rarer ones are not shown." if len(texts) > MOST_TEXTS else ""
    return Drawing(made, f"Share of the vehicles that report each text.{more}{faults_note(made, source)}")


def text_shares(source: Source, name: str) -> tuple[Array, list[str]]:
    """Return the shares (periods, texts) of the reporting vehicles that say each text, and the texts.

    The most frequent text comes first.
    """
    column = source.states[name].cast(pa.string()).combine_chunks().dictionary_encode()
    texts = column.dictionary.to_pylist()
    code = column.indices.fill_null(-1).to_numpy(zero_copy_only=False)
    period = source.states["period"].to_numpy()
    said = np.zeros((int(period.max(initial=-1)) + 1, len(texts)))
    np.add.at(said, (period[code >= 0], code[code >= 0]), 1)
    order = np.argsort(-said.sum(axis=0), kind="stable")
    total = said.sum(axis=1, keepdims=True)
    shares = np.where(total > 0, said / np.maximum(total, 1), np.nan)[:, order]
    return shares, [texts[index] for index in order.tolist()]


def mean_over_time(source: Source, name: str) -> tuple[Array, Array]:
    """Return times (n,) in seconds and the mean over the vehicles, of a boolean in per cent, as `points` does."""
    value = source.value(name)
    mean = row_means(value) * (100 if source.is_boolean(name) else 1)
    return points(source.times_s, mean, usual_periods(value))


def is_number(source: Source, name: str) -> bool:
    """Return whether a run has numbers or booleans under this name."""
    return name in source.drawn_names and not is_text(source.states.schema.field(name).type)


def row_means(value: Array) -> Array:
    """Return the mean (periods,) of what is finite in each period; NaN where nothing is."""
    known = np.isfinite(value)
    count = known.sum(axis=1)
    total = np.where(known, value, 0.0).sum(axis=1)
    return np.asarray(np.where(count, total / np.maximum(count, 1), np.nan))


def _band(value: Array) -> tuple[Array, Array]:
    """Return the 5th and the 95th percentile (periods,) of what is finite in each period."""
    low, high = np.full(len(value), np.nan), np.full(len(value), np.nan)
    finite = np.where(np.isfinite(value), value, np.nan)
    some = np.flatnonzero(np.isfinite(finite).any(axis=1))
    if len(some):
        low[some], high[some] = np.nanpercentile(finite[some], [5, 95], axis=1)
    return low, high
