"""Figures of the radio: outcomes, latency, age of information and the channel busy ratio."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from emulator.pages.canvas import (
    BLUE,
    GREEN,
    GREY,
    QUIET,
    RED,
    SKY,
    canvas,
    from_zero,
    legend,
    logarithmic,
    whole_numbers,
)
from emulator.pages.page import Table, table
from emulator.pages.palette import PALETTE
from emulator.radio.medium import WINDOW_NS
from emulator.radio.outcomes import DRAWN, Outcome
from emulator.records.radio_metrics import busy_ratios, rows_of_pairs, unicast_figures
from emulator.report.drawing import DASHES, TIME, WIDE_RANGE, Drawing, Line, faults_note, time_figure
from emulator.report.program_figures import row_means
from emulator.report.source import NothingToShow, Source
from vnet.errors import VnetError, printable
from vnet.types import Array, IntArray
from vnet.units import NS_PER_S

OUTCOME_COLOURS = {outcome.name: PALETTE[outcome.colour].light for outcome in DRAWN}
MOST_BINS = 80
MOST_BARS = 10


def in_range(source: Source) -> pa.Table:
    """Return the rows of the trace but those of frames to a vehicle out of range. Raises VnetError without any."""
    trace = source.trace
    trace = trace.filter(pc.not_equal(trace["outcome"].cast(pa.string()), Outcome.out_of_range.name))
    if not len(trace):
        raise VnetError("no frame was sent to anybody in range")
    return trace


def broadcasts(source: Source) -> pa.Table:
    """Return the rows of the trace that the packet delivery ratio counts. Raises VnetError without any."""
    rows = rows_of_pairs(source)
    if not len(rows):
        raise VnetError("no broadcast was sent to anybody in range")
    return source.trace.take(rows)


def outcomes_in_bins(source: Source, trace: pa.Table, width_ns: int) -> tuple[list[str], IntArray]:
    """Return the names of outcomes and how many rows of a trace have each (bins, names), in bins of the run's time.

    A frame's receptions are all in one bin: by when its transmission ended, with `[radio.mac]`, else by when it was
    sent. So the delivered have the share of their frames also where a fault delays them.
    """
    column = trace["outcome"].combine_chunks()
    names = column.dictionary.to_pylist()
    of_frame = (
        pc.coalesce(trace["left_ns"], trace["sent_ns"]) if "left_ns" in trace.column_names else trace["sent_ns"]
    )
    bins = max(1, int(np.ceil(source.end_s * NS_PER_S / width_ns - 1e-9)))
    index = np.minimum(of_frame.to_numpy() // width_ns, bins - 1)  # of whole numbers: an edge stays on its side
    counts = np.bincount(index * len(names) + column.indices.to_numpy(), minlength=bins * len(names))
    return names, counts.reshape(bins, len(names))


def bin_width_ns(source: Source) -> int:
    """Return the width of the bins of figures against time: whole periods, so that each bin has frames."""
    period_ns = source.scenario.period_ns
    periods = max(1, int(np.ceil(source.end_s * NS_PER_S / period_ns - 1e-9)))
    return int(np.ceil(periods / MOST_BINS)) * period_ns


def outcomes(source: Source) -> Drawing:
    """Draw the shares of the outcomes against time, stacked."""
    width_ns = bin_width_ns(source)
    width_s = width_ns / NS_PER_S
    names, counts = outcomes_in_bins(source, in_range(source), width_ns)
    bins = len(counts)
    share = 100 * counts / np.maximum(1, counts.sum(axis=1, keepdims=True))
    shown = [number for number, name in enumerate(names) if counts[:, number].any() and name in OUTCOME_COLOURS]
    made = canvas(TIME, "share of receptions (%)", source.spans, source.end_s)
    edges = np.minimum(np.arange(bins + 1) * width_s, source.end_s)
    below = np.zeros(bins)
    for number in shown:
        above = below + share[:, number]
        low, high = (np.append(some, some[-1]) for some in (below, above))
        drawn: dict[str, Any] = {"color": OUTCOME_COLOURS[names[number]], "linewidth": 0, "label": names[number]}
        made.axes.fill_between(edges, low, high, step="post", zorder=0.6, **drawn)
        below = above
    made.axes.set_ylim(0, 100)
    legend(made)
    rate = counts.sum(axis=1) / np.maximum(np.diff(edges), 1e-9)
    text = (
        f"Outcomes of the {counts.sum():,} attempted receptions (a frame at a receiver in range), in bins of "
        f"{width_s:g} s: {rate.min():,.0f} to {rate.max():,.0f} a second."
    )
    return Drawing(made, text + faults_note(made, source))


def busy(source: Source) -> Drawing:
    """Draw the channel busy ratio of the vehicles."""
    if source.scenario.radio.mac is None:
        raise NothingToShow("no MAC configured ([radio.mac])")
    percent = 100 * busy_ratios(source)
    if not len(percent):
        raise VnetError("the run was over within the first window")
    end_s = np.arange(1, len(percent) + 1) * WINDOW_NS / 1e9
    lines = [
        Line("mean", end_s, row_means(percent), BLUE),
        Line("busiest", end_s, np.fmax.reduce(percent, axis=1), RED, DASHES[1]),
    ]
    made = time_figure(lines, "channel busy ratio (%)", source.end_s, source.spans, linear=True)
    text = "Share of the time in which vehicles sensed the medium busy, in windows of 100 ms."
    return Drawing(made, text + faults_note(made, source))


def totals(source: Source) -> Drawing:
    """Draw the numbers and shares of the outcomes of the whole run."""
    trace = in_range(source)
    bars = _bars(trace)
    made = canvas("share of receptions (%)", "", plot_px=31 * len(bars) + 6)
    axes = made.axes
    for row, (label, outcome, count) in enumerate(bars):
        share = 100 * count / len(trace)
        axes.barh(row + 0.7, 100, height=0.26, color=GREY, alpha=0.18)
        axes.barh(row + 0.7, share, height=0.26, color=OUTCOME_COLOURS.get(outcome, GREY))
        axes.text(0, row + 0.45, printable(label, 32))
        axes.text(100, row + 0.45, f"{count:,}  ·  {share:.2f} %", ha="right", color=QUIET)
    axes.set(xlim=(0, 100), ylim=(len(bars) + 0.1, 0))
    axes.yaxis.set_ticks([])
    text = f"Outcomes of all {len(trace):,} attempted receptions (a frame at a receiver in range)."
    return Drawing(made, text + (" Faults stand by their names." if any(o == "fault" for _, o, _ in bars) else ""))


def _bars(trace: pa.Table) -> list[tuple[str, str, int]]:
    """Label, outcome and count of each bar; receptions lost by faults under the fault's name."""
    counts = trace.select(["outcome", "cause"]).group_by(["outcome", "cause"]).aggregate([([], "count_all")])
    found: dict[tuple[str, str], int] = {}
    for row in counts.to_pylist():
        label = row["cause"] if row["outcome"] == "fault" else row["outcome"]
        key = (str(label), str(row["outcome"]))
        found[key] = found.get(key, 0) + row["count_all"]
    order = {outcome.name: number for number, outcome in enumerate(DRAWN)}
    bars = [(label, outcome, count) for (label, outcome), count in found.items()]
    bars.sort(key=lambda bar: (order.get(bar[1], len(order)), -bar[2]))
    shown, others = bars[:MOST_BARS], bars[MOST_BARS:]
    return shown + ([("others", "", sum(count for _, _, count in others))] if others else [])


def latencies_ms(source: Source) -> Array:
    """Return the latency (k,) of each delivery in ms. Raises VnetError if there is none."""
    delivered = source.outcome_is("delivered")
    if not delivered.any():
        raise VnetError("nothing was delivered")
    return np.asarray((source.arrival_ns[delivered] - source.sent_ns[delivered]) / 1e6)


def latency(source: Source) -> Drawing:
    """Draw the distribution of the latency."""
    latency_ms = latencies_ms(source)
    median, late, latest = np.percentile(latency_ms, [50, 99, 100])
    shown_ms = min(latest, 2.5 * np.percentile(latency_ms, 99.5))
    counts, edges = np.histogram(latency_ms, bins=50, range=(0, max(shown_ms * 1.02, 1e-3)))
    made = canvas("latency (ms)", "deliveries")
    made.axes.stairs(counts, edges, fill=True, color=BLUE, alpha=0.8)
    made.axes.axvline(median, color=RED, linestyle=DASHES[1], label=f"median {median:.2f} ms")
    made.axes.axvline(late, color=GREEN, linestyle=DASHES[2], label=f"99 % within {late:.2f} ms")
    made.axes.set_xlim(0, edges[-1])
    whole_numbers(made.axes)
    legend(made)
    beyond = int((latency_ms > edges[-1]).sum())
    further = f" {beyond:,} more took longer, up to {latest:,.1f} ms." if beyond else ""
    return Drawing(made, f"Time from a frame's enqueueing to its arrival, {len(latency_ms):,} deliveries.{further}")


def ages(source: Source) -> Drawing:
    """Draw the inter-packet gap and the age of information of the links, sorted."""
    links, share = source.radio.links, np.linspace(0, 1, 101)
    lines = {
        "IPG: mean": ("inter_reception_mean_ms", BLUE),
        "IPG: 95 %": ("inter_reception_p95_ms", SKY),
        "age: mean": ("age_mean_ms", RED),
    }
    made = canvas("links, sorted (%)", "time (ms)")
    drawn = []
    for (label, (name, colour)), dash in zip(lines.items(), (DASHES[0], DASHES[2], DASHES[1]), strict=True):
        values_ms = links[name].drop_null().to_numpy()
        if len(values_ms):
            drawn.append(np.quantile(values_ms, share, method="inverted_cdf"))
            made.axes.plot(100 * share, drawn[-1], color=colour, linestyle=dash, label=label)
    if not drawn:
        raise VnetError("no link received two frames")
    made.axes.set_xlim(0, 100)
    least, most = np.min(drawn), np.max(drawn)
    if 0 < WIDE_RANGE * least < most:
        logarithmic(made.axes)
    else:
        from_zero(made.axes)
    legend(made)
    return Drawing(
        made,
        "IPG: inter-packet gap, from one reception on a link to the next. Age: time since the newest received "
        f"frame was sent. Each line sorts the {len(links):,} links by its own figure.",
    )


MOST_ROWS = 50
TOTALS = {
    "packet delivery ratio": ("delivery_ratio", "%"),
    "latency": ("latency_mean_ms", "ms"),
    "inter-packet gap": ("inter_reception_mean_ms", "ms"),
    "age of information": ("age_mean_ms", "ms"),
    "channel busy ratio": ("busy_ratio_mean", "%"),
}
VEHICLES = {
    "vehicle": "node",
    "frames": "frames",
    "sent: PDR (%)": "sent_delivery_ratio",
    "received: PDR (%)": "heard_delivery_ratio",
    "hears (vehicles)": "heard_vehicles",
    "latency (ms)": "latency_mean_ms",
    "IPG (ms)": "inter_reception_mean_ms",
    "age (ms)": "age_mean_ms",
    "CBR (%)": "busy_ratio_mean",
}
LINKS = {
    "sender": "sender",
    "receiver": "receiver",
    "attempted": "pairs",
    "PDR (%)": "delivery_ratio",
    "distance (m)": "distance_mean_m",
    "latency (ms)": "latency_mean_ms",
    "IPG (ms)": "inter_reception_mean_ms",
    "IPG 95 % (ms)": "inter_reception_p95_ms",
    "age (ms)": "age_mean_ms",
    "peak age (ms)": "age_peak_ms",
}


@dataclass(frozen=True)
class RadioSection:
    """The section's key figures, and its tables by title."""

    totals: dict[str, str]
    tables: dict[str, Table]


def radio_section(source: Source) -> RadioSection | str:
    """Return the section, or the reason for which there is nothing to show."""
    try:
        metrics = source.radio
    except VnetError as error:
        return str(error)
    unicast = unicast_figures(source)
    if not metrics.totals["pairs"] and unicast is None:
        return "No frame was sent to anybody in range."
    totals = {
        title: f"{100 * value if unit == '%' else value:.1f} {unit}"
        for title, (name, unit) in TOTALS.items()
        if (value := metrics.totals[name]) is not None
    }
    if unicast is not None:
        totals["frames to one vehicle"] = str(unicast)
    vehicles = metrics.vehicles.sort_by([("heard_delivery_ratio", "ascending"), ("node", "ascending")])
    tables = _listed("By vehicle, the lowest packet delivery ratio (PDR) first", vehicles, VEHICLES)
    return RadioSection(totals, tables | _listed("The worst links", metrics.worst_links(MOST_ROWS), LINKS))


def _listed(title: str, rows: pa.Table, columns: Mapping[str, str]) -> dict[str, Table]:
    """The first rows as a table by its title; nothing without rows."""
    shown = rows.slice(0, MOST_ROWS)
    if not len(shown):
        return {}
    more = f": {len(shown)} of {len(rows):,}" if len(shown) < len(rows) else ""
    listed = [
        {head: _percent(name, row[name]) for head, name in columns.items()}
        for row in shown.select(list(columns.values())).to_pylist()
    ]
    return {f"{title}{more}": table(listed, decimals=1)}


def _percent(name: str, value: Any) -> Any:
    """Ratios in percent, and all else as it is."""
    return 100 * value if "ratio" in name and value is not None else value
