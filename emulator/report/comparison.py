"""Two runs side by side: the keys of their scenarios that differ, their figures, and the first row that differs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from emulator.checks.replay import compare_runs
from emulator.pages.canvas import BLUE, RED, Canvas, FaultSpan, canvas, legend
from emulator.pages.page import SIGNS, render, table
from emulator.pages.text import cell
from emulator.records.parting import Parting, before, partings
from emulator.records.recorded_run import OpenedRun, RecordedRun
from emulator.records.reported import ReportedFigure, figure_text
from emulator.records.run_folder import check_is_run
from emulator.records.verdicts import CheckResult, Record, Verdict
from emulator.report.drawing import DASHES, Chart, Drawing, Line, draw_charts, time_figure
from emulator.report.program_figures import MOST_CHARTS, is_number, mean_over_time
from emulator.report.radio_figures import bin_width_ns, broadcasts, latencies_ms, outcomes_in_bins
from emulator.report.source import NothingToShow, Source
from emulator.scenario.loading import parse_toml
from vnet.errors import VnetError, printable
from vnet.units import NS_PER_S, label_of, title_of

A, B = "A", "B"
NOT_APPLICABLE = "not applicable"
LONGEST_VALUE = 200
LONGEST_ENTRY = 300
"""Characters of what a run has at a parting."""
Row = dict[str, Any]


@dataclass(frozen=True)
class Comparison:
    """Two finished runs, and the first difference between their tables: valid where there is none."""

    sources: tuple[Source, Source]
    runs: tuple[OpenedRun, OpenedRun]
    """The runs with all columns, of which pages need some."""
    finding: CheckResult

    @classmethod
    def of(cls, first: Path, second: Path) -> Comparison:
        """Read two runs' folders. Raises VnetError if one is not that of a finished run of this vnet."""
        for folder in (first, second):
            check_is_run(folder)
        sources = Source(first), Source(second)
        for source in sources:
            _ = source.record, source.scenario
        runs = RecordedRun.open(first), RecordedRun.open(second)
        return cls(sources, runs, compare_runs(*runs))

    @property
    def records(self) -> tuple[Record, Record]:
        """The verdict files of the two runs."""
        first, second = self.sources
        return first.record, second.record

    @property
    def same_trace(self) -> bool:
        """True if the traces are the same; states and metrics may still differ."""
        return self.finding.figures.get("table") != "trace"

    @cached_property
    def partings(self) -> list[Row]:
        """The first difference of each kind, the earliest first."""
        return [
            {
                "time (s)": f"{each.time_ns / NS_PER_S:.6f}",
                "first": each.kind,
                "vehicle": each.node,
                A: printable(each.first, LONGEST_ENTRY) or "–",
                B: printable(each.second, LONGEST_ENTRY) or "–",
            }
            for each in self._partings
        ]

    @cached_property
    def before(self) -> list[str]:
        """Lines on what the vehicle had done and heard before the first parting."""
        first, run = self._partings[0], self.runs[0]
        return before(run.trace, run.events, first.node, first.time_ns)

    @cached_property
    def _partings(self) -> list[Parting]:
        return partings(*self.runs)

    @cached_property
    def scenario(self) -> list[Row]:
        """The keys of the scenarios that differ, with both values; None where a run has no such key."""
        ours, theirs = (dict(_flat(parse_toml(source.scenario_text))) for source in self.sources)
        keys = [key for key in ours | theirs if ours.get(key) != theirs.get(key)]
        return [{"key": key, A: _short(ours.get(key)), B: _short(theirs.get(key))} for key in keys]

    @cached_property
    def checks(self) -> list[Row]:
        """The verdicts of the runs, and of each check that at least one of them exercised."""
        judged = [
            {check.name: check.verdict.value for check in record.checks}
            | {left.name: NOT_APPLICABLE for left in record.not_exercised}
            for record in self.records
        ]
        rows = [{"check": "the run", A: self.records[0].verdict.value, B: self.records[1].verdict.value}]
        for name in judged[0] | judged[1]:
            verdicts = [each.get(name, NOT_APPLICABLE) for each in judged]
            if verdicts != [NOT_APPLICABLE] * 2:
                rows.append({"check": name, A: verdicts[0], B: verdicts[1]})
        return rows

    @cached_property
    def figures(self) -> list[Row]:
        """Key figures with B − A; ratios in percent."""
        ours, theirs = ({each.heading: value for each, value in record.shown_figures} for record in self.records)
        headings = dict.fromkeys([*ours, *theirs])
        rows = [_difference(heading, ours.get(heading), theirs.get(heading), ".3f") for heading in headings]
        ratios = [record.packet_delivery_ratio for record in self.records]
        if any(ratio is not None for ratio in ratios):
            percent = [None if ratio is None else 100 * ratio for ratio in ratios]
            rows.append(_difference("packet delivery ratio (%)", percent[0], percent[1], ".2f"))
        times = [(record.emulated_s, record.wall_s) for record in self.records]
        rows.append(_difference("emulated time (s)", times[0][0], times[1][0], ".1f"))
        return [*rows, _difference("wall-clock time (s)", times[0][1], times[1][1], ".1f")]

    @cached_property
    def reported(self) -> list[Row]:
        """Values that programs report: mean and 5 to 95 % of both runs, and B − A of the means."""
        ours, theirs = (record.reported for record in self.records)
        return [_reported(name, ours.get(name), theirs.get(name)) for name in ours | theirs]

    @cached_property
    def outcomes(self) -> list[Row]:
        """Shares of the attempted receptions by outcome, in percent, with B − A in percentage points."""
        ours, theirs = self.records
        rows = []
        for name in ours.frames_by_outcome | theirs.frames_by_outcome:
            shares = [record.share_of(name) for record in self.records]
            if name != "out_of_range" and any(shares):
                percent = [None if share is None else 100 * share for share in shares]
                rows.append(_difference(f"{name} (%)", percent[0], percent[1], ".2f"))
        return rows


def _flat(data: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Each value of nested tables and lists of tables by its dotted key."""
    if isinstance(data, dict):
        for name, value in data.items():
            yield from _flat(value, f"{key}.{name}" if key else name)
    elif isinstance(data, list) and data and all(isinstance(item, dict) for item in data):
        for number, item in enumerate(data):
            yield from _flat(item, f"{key}.{number}")
    else:
        yield key, data


def _short(value: Any) -> str | None:
    """A value as one short text."""
    text = "" if value is None else str(value)
    return text if len(text) <= LONGEST_VALUE else f"{text[: LONGEST_VALUE - 1]}…"


def _difference(name: str, ours: float | None, theirs: float | None, form: str) -> Row:
    values = ["–" if value is None else format(value, form) for value in (ours, theirs)]
    change = "" if ours is None or theirs is None else format(theirs - ours, f"+{form}")
    return {"figure": name, A: values[0], B: values[1], "B − A": change}


def _reported(name: str, ours: ReportedFigure | None, theirs: ReportedFigure | None) -> Row:
    """The row of a reported value, which only one of the runs may have."""
    row: Row = {"figure": (ours or theirs or ReportedFigure(0)).words(name)[0]}
    for letter, figure in ((A, ours), (B, theirs)):
        _, mean, spread, _ = ("", "–", "", "") if figure is None else figure.words(name)
        row |= {letter: mean, f"{letter}: 5 – 95 %": spread}
    return row | {"B − A": _change(ours, theirs)}


def _change(ours: ReportedFigure | None, theirs: ReportedFigure | None) -> str:
    """The difference of two means; of shares in percentage points."""
    if ours is None or theirs is None or ours.mean is None or theirs.mean is None:
        return ""
    change = theirs.mean - ours.mean
    if ours.is_share and theirs.is_share:
        return f"{100 * change:+.1f} %"
    return figure_text(change) if change <= 0 else f"+{figure_text(change)}"


def print_comparison(comparison: Comparison, console: Console) -> None:
    """The whole comparison, for a terminal."""
    for letter, source in zip((A, B), comparison.sources, strict=True):
        console.print(f"{letter}  {source.folder}", highlight=False, soft_wrap=True)
    if comparison.scenario:
        console.print(_table("scenario, where they differ", comparison.scenario))
    else:
        console.print("scenario: the same")
    console.print(_table("figures (errors: means after the first fifth)", comparison.figures))
    if comparison.reported:
        console.print(_table("reported by the programs: means", comparison.reported))
    if comparison.outcomes:
        console.print(_table("outcomes, as shares of the attempted receptions", comparison.outcomes))
    console.print(_table("verdicts", comparison.checks, _verdict_style))
    finding = comparison.finding
    console.print(Text(finding.text, style="green" if finding.verdict is Verdict.VALID else "bold red"))
    if not comparison.partings:
        return
    first, *_ = comparison.partings
    console.print(f"the runs part at {first['time (s)']} s: a {first['first']} of {first['vehicle']}")
    console.print(_table("", comparison.partings))
    if comparison.before:
        console.print(f"{first['vehicle']} until then:", highlight=False)
    for line in comparison.before:
        console.print(Text(f"  {line}"))


def _table(title: str, rows: Sequence[Mapping[str, Any]], style: Any = lambda text: "") -> Table:
    table = Table(title=title, title_justify="left")
    for column in rows[0]:
        numeric = "figure" in rows[0] and column != "figure"
        table.add_column(column, overflow="fold", justify="right" if numeric else "left")
    for row in rows:
        table.add_row(*(Text(cell(value), style=style(value)) for value in row.values()))
    return table


def _verdict_style(value: object) -> str:
    return {"valid": "green", "invalid": "bold red", "unknown": "yellow"}.get(str(value), "")


LOOKS: tuple[tuple[str, str, Any], ...] = ((A, BLUE, DASHES[0]), (B, RED, DASHES[1]))
REPORTED = "reported by the programs: means and 5 to 95 % of all reports of all vehicles"


def comparison_page(comparison: Comparison) -> str:
    """Return the whole page."""
    charts, missing = _draw(comparison)
    finding = comparison.finding
    outcomes = "outcomes, as shares of the attempted receptions; B − A in percentage points"
    return render(
        "comparison.html.j2",
        runs=list(_runs(comparison)),
        difference=finding.text if finding.verdict is Verdict.VALID else f"{SIGNS[Verdict.INVALID]} {finding.text}",
        partings=table(comparison.partings) if comparison.partings else None,
        scenario=table(comparison.scenario, "keys that differ") if comparison.scenario else None,
        key_figures=table(comparison.figures, "errors are means after the first fifth of the run"),
        reported=table(comparison.reported, REPORTED) if comparison.reported else None,
        outcomes=table(comparison.outcomes, outcomes) if comparison.outcomes else None,
        checks=table(comparison.checks),
        charts=charts,
        missing=missing,
    )


def _runs(comparison: Comparison) -> Iterator[dict[str, Any]]:
    for letter, source, record in zip((A, B), comparison.sources, comparison.records, strict=True):
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
    for look, source in zip(LOOKS, comparison.sources, strict=True):
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
    made = time_figure(lines, y_label, max(source.end_s for source in comparison.sources), spans, linear)
    return Drawing(made, f"{caption}{said}{note}".strip())


def _spans(comparison: Comparison) -> tuple[list[FaultSpan], str]:
    """The spans of faults if both runs had the same, and the caption's sentence on them."""
    ours, theirs = (source.spans for source in comparison.sources)
    if ours == theirs:
        return ours, " Shaded: active faults." if ours else ""
    return [], " Faults differ, and are not shaded."


def _own_names(comparison: Comparison) -> list[str]:
    """The names of numbers that programs of either run report."""
    names = dict.fromkeys(name for source in comparison.sources for name in source.drawn_names)
    return [name for name in names if any(is_number(each, name) for each in comparison.sources)][:MOST_CHARTS]


def _own(comparison: Comparison, name: str) -> Drawing:
    """Draw what the programs report under a name: its mean over the vehicles."""

    def read(source: Source) -> Any:
        if not is_number(source, name):
            raise NothingToShow(f"its programs do not report {title_of(name)}")
        return mean_over_time(source, name)

    is_share = any(is_number(each, name) and each.is_boolean(name) for each in comparison.sources)
    label = f"{title_of(name)} (%)" if is_share else label_of(name)
    text = "Share of the vehicles that say true." if is_share else "Mean of the vehicles."
    return _over_time(comparison, read, label, text, linear=True)


def _metric(comparison: Comparison, name: str, y_label: str) -> Drawing:
    return _over_time(comparison, lambda source: (source.time_s, source.metric(name)), y_label, "")


def _delivered(comparison: Comparison) -> Drawing:
    width_ns = max(map(bin_width_ns, comparison.sources))
    width_s = width_ns / NS_PER_S

    def ratio(source: Source) -> Any:
        names, counts = outcomes_in_bins(source, broadcasts(source), width_ns)
        good = counts[:, [name == "delivered" for name in names]].sum(axis=1)
        with np.errstate(invalid="ignore"):
            return (np.arange(len(counts)) + 0.5) * width_s, 100 * good / counts.sum(axis=1)

    caption = f"Share of the broadcasts' attempted receptions that was delivered, in bins of {width_s:.3g} s."
    drawing = _over_time(comparison, ratio, "packet delivery ratio (%)", caption)
    drawing.canvas.axes.set_yscale("linear")
    drawing.canvas.axes.set_ylim(0, 100)
    return drawing


def _latency(comparison: Comparison) -> Drawing:
    found, note = _of_both(comparison, latencies_ms)
    end_ms = max(float(np.percentile(values, 99.5)) for _, values in found) * 1.1
    made: Canvas = canvas("latency (ms)", "deliveries (%)")
    for (name, colour, dash), values in found:
        counts, edges = np.histogram(values, bins=50, range=(0, max(end_ms, 1e-3)))
        label = f"{name}: median {np.median(values):.2f} ms"
        made.axes.stairs(
            100 * counts / len(values), edges, color=colour, linestyle=dash, linewidth=1.6, label=label
        )
    made.axes.set_xlim(0, max(end_ms, 1e-3))
    legend(made)
    return Drawing(made, f"Time from a frame's enqueueing to its arrival; the latest 0.5 % may be cut off.{note}")
