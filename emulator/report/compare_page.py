"""A page that shows two runs side by side, their curves in the same axes: A is blue, B is dashed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from emulator.pages.canvas import BLUE, RED, Canvas, Span, canvas, legend
from emulator.pages.page import SIGNS, put_page, render, table
from emulator.records.verdicts import Verdict
from emulator.report.comparison import A, B, Comparison, turned
from emulator.report.drawing import DASHES, Chart, Drawing, Line, draw_charts, time_figure
from emulator.report.program_figures import MOST_CHARTS, is_number, label_of, mean_over_time
from emulator.report.radio_figures import bin_width_ns, broadcasts, decided, latencies_ms
from emulator.report.source import NothingToShow, Source
from vnet.errors import VnetError
from vnet.units import NS_PER_S, title_of

LOOKS: tuple[tuple[str, str, Any], ...] = ((A, BLUE, DASHES[0]), (B, RED, DASHES[1]))
REPORTED = "reported by the programs: means and 5 to 95 % of all reports of all vehicles"


def write_comparison(comparison: Comparison, path: Path) -> Path:
    """Write the page. Raises VnetError if it cannot be written."""
    return put_page(path, comparison_page(comparison))


def comparison_page(comparison: Comparison) -> str:
    """Return the whole page."""
    charts, missing = _draw(comparison)
    finding = comparison.finding
    rows = finding.figures.get("rows")
    outcomes = "outcomes, as shares of the attempted receptions; B − A in percentage points"
    return render(
        "comparison.html.j2",
        runs=list(_runs(comparison)),
        difference=finding.text if finding.verdict is Verdict.VALID else f"{SIGNS[Verdict.INVALID]} {finding.text}",
        difference_rows=table(turned(rows)) if rows else None,
        scenario=table(comparison.scenario, "keys that differ") if comparison.scenario else None,
        key_figures=table(comparison.figures, "errors are means after the first fifth of the run"),
        reported=table(comparison.reported, REPORTED) if comparison.reported else None,
        outcomes=table(comparison.outcomes, outcomes) if comparison.outcomes else None,
        checks=table(comparison.checks),
        charts=charts,
        missing=missing,
    )


def _runs(comparison: Comparison) -> Iterator[dict[str, Any]]:
    sources = comparison.first, comparison.second
    for letter, source, record in zip((A, B), sources, comparison.records, strict=True):
        name = source.folder.resolve().name
        yield {"letter": letter, "name": name, "folder": source.folder, "verdict": record.verdict}


# Curves.


def _draw(comparison: Comparison) -> tuple[list[Chart], dict[str, list[str]]]:
    drawers: dict[str, tuple[str, Callable[[], Drawing]]] = {
        f"own-{number}": (title_of(name), partial(_own, comparison, name))
        for number, name in enumerate(_own_names(comparison))
    }
    drawers |= {
        key: (title, partial(_metric, comparison, each.name, axis))
        for each in {each.name: each for record in comparison.records for each in record.key_figures}.values()
        if each.chart
        for key, title, axis in [each.chart]
    }
    drawers["delivered"] = ("Packet delivery ratio", partial(_delivered, comparison))
    drawers["latency"] = ("Latency", partial(_latency, comparison))
    return draw_charts(drawers)


def _of_both(comparison: Comparison, read: Callable[[Source], Any]) -> tuple[list[tuple[Any, Any]], str]:
    """Return (look, value) for each run that has one, and a note on one that has not.

    Raises VnetError if neither has.
    """
    found, note = [], ""
    for look, source in zip(LOOKS, (comparison.first, comparison.second), strict=True):
        try:
            found.append((look, read(source)))
        except VnetError as error:
            if note:
                raise
            note = f" {look[0]} is not shown: {error}."
    return found, note


def _over_time(
    comparison: Comparison, read: Callable[[Source], Any], y_label: str, caption: str, linear: bool = False
) -> Drawing:
    """Draw values of both runs; `read` returns times (n,) in seconds and values (n,) of a run."""
    found, note = _of_both(comparison, read)
    spans, said = _spans(comparison)
    lines = [Line(name, times, values, colour, dash) for (name, colour, dash), (times, values) in found]
    made = time_figure(lines, y_label, max(comparison.first.end_s, comparison.second.end_s), spans, linear)
    return Drawing(made, f"{caption}{said}{note}".strip())


def _spans(comparison: Comparison) -> tuple[list[Span], str]:
    """The spans of faults if both runs had the same, and the caption's sentence on them."""
    if comparison.first.spans == comparison.second.spans:
        return comparison.first.spans, " Shaded: active faults." if comparison.first.spans else ""
    return [], " Faults differ, and are not shaded."


def _own_names(comparison: Comparison) -> list[str]:
    """The names of numbers that programs of either run report."""
    names = dict.fromkeys(name for source in (comparison.first, comparison.second) for name in source.value_names)
    both = comparison.first, comparison.second
    return [name for name in names if any(is_number(source, name) for source in both)][:MOST_CHARTS]


def _own(comparison: Comparison, name: str) -> Drawing:
    """Draw what the programs report under a name: its mean over the vehicles."""

    def read(source: Source) -> Any:
        if not is_number(source, name):
            raise NothingToShow(f"its programs do not report {title_of(name)}")
        return mean_over_time(source, name)

    is_share = any(
        is_number(each, name) and each.is_boolean(name) for each in (comparison.first, comparison.second)
    )
    label = f"{title_of(name)} (%)" if is_share else label_of(name)
    text = "Share of the vehicles that say true." if is_share else "Mean of the vehicles."
    return _over_time(comparison, read, label, text, linear=True)


def _metric(comparison: Comparison, name: str, y_label: str) -> Drawing:
    return _over_time(comparison, lambda source: (source.time_s, source.metric(name)), y_label, "")


def _delivered(comparison: Comparison) -> Drawing:
    width_ns = max(bin_width_ns(comparison.first), bin_width_ns(comparison.second))
    width_s = width_ns / NS_PER_S

    def ratio(source: Source) -> Any:
        names, code, decided_ns = decided(broadcasts(source))
        index = decided_ns // width_ns
        total = np.bincount(index)
        good = np.bincount(index, weights=np.array([name == "delivered" for name in names])[code])
        with np.errstate(invalid="ignore"):
            return (np.arange(len(total)) + 0.5) * width_s, 100 * good / total

    caption = f"Share of the broadcasts' attempted receptions that was delivered, in bins of {width_s:.3g} s."
    drawing = _over_time(comparison, ratio, "packet delivery ratio (%)", caption)
    drawing.canvas.axes.set_yscale("linear")
    drawing.canvas.axes.set_ylim(0, 100)
    return drawing


def _latency(comparison: Comparison) -> Drawing:
    found, note = _of_both(comparison, latencies_ms)
    end_ms = max(float(np.percentile(values, 99.5)) for _, values in found) * 1.1
    made: Canvas = canvas("latency (ms)", "deliveries (%)", legend_rows=1)
    for (name, colour, dash), values in found:
        counts, edges = np.histogram(values, bins=50, range=(0, max(end_ms, 1e-3)))
        label = f"{name}: median {np.median(values):.2f} ms"
        made.axes.stairs(
            100 * counts / len(values), edges, color=colour, linestyle=dash, linewidth=1.6, label=label
        )
    made.axes.set_xlim(0, max(end_ms, 1e-3))
    legend(made)
    return Drawing(made, f"Time from a frame's enqueueing to its arrival; the latest 0.5 % may be cut off.{note}")
