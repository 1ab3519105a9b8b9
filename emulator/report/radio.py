"""The radio's part of a report: what it comes to in all, by vehicle, and on the worst links."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import pyarrow as pa

from emulator.pages.page import escape, table
from emulator.report.source import Source
from vnet.errors import VnetError

MOST_ROWS = 50
TOTALS = {
    "delivered": ("delivery_ratio", "%"),
    "latency": ("latency_mean_ms", "ms"),
    "between two receptions": ("inter_reception_mean_ms", "ms"),
    "age of information": ("age_mean_ms", "ms"),
    "busy ratio": ("busy_ratio_mean", "%"),
}
VEHICLES = {
    "vehicle": "node",
    "frames": "frames",
    "sent: delivered (%)": "sent_delivery_ratio",
    "heard: delivered (%)": "heard_delivery_ratio",
    "hears (vehicles)": "heard_vehicles",
    "latency (ms)": "latency_mean_ms",
    "between receptions (ms)": "inter_reception_mean_ms",
    "age (ms)": "age_mean_ms",
    "busy ratio (%)": "busy_ratio_mean",
}
LINKS = {
    "sender": "sender",
    "receiver": "receiver",
    "pairs": "pairs",
    "delivered (%)": "delivery_ratio",
    "apart (m)": "distance_mean_m",
    "latency (ms)": "latency_mean_ms",
    "between receptions (ms)": "inter_reception_mean_ms",
    "95 % (ms)": "inter_reception_p95_ms",
    "age (ms)": "age_mean_ms",
    "oldest (ms)": "age_peak_ms",
}


def radio_section(source: Source) -> Iterator[str]:
    """The section; where there is nothing to show, why."""
    yield '<section id="radio"><h2>Radio</h2>'
    try:
        metrics = source.radio
        if not metrics.totals["pairs"]:
            raise VnetError("nobody sent anything to anybody in range")
    except VnetError as error:
        yield f"<p>{escape(error)}</p></section>"
        return
    yield '<dl class="tiles">'
    for title, (name, unit) in TOTALS.items():
        if (value := metrics.totals[name]) is not None:
            yield f"<div><dt>{title}</dt><dd>{100 * value if unit == '%' else value:.1f} {unit}</dd></div>"
    yield '</dl><p class="quiet">Means over all links; delivered and latency over all frames.</p>'
    vehicles = metrics.vehicles.sort_by([("heard_delivery_ratio", "ascending"), ("node", "ascending")])
    yield from _listed("By vehicle, from the one that hears least", vehicles, VEHICLES)
    yield from _listed("The worst links", metrics.worst_links(MOST_ROWS), LINKS)
    yield "</section>"


def _listed(title: str, rows: pa.Table, columns: Mapping[str, str]) -> Iterator[str]:
    shown = rows.slice(0, MOST_ROWS)
    if not len(shown):
        return
    more = f": {len(shown)} of {len(rows):,}" if len(shown) < len(rows) else ""
    listed = [
        {head: _cell(name, row[name]) for head, name in columns.items()}
        for row in shown.select(list(columns.values())).to_pylist()
    ]
    yield f"<details><summary>{title}{more}</summary>{table(listed, decimals=1)}</details>"


def _cell(name: str, value: Any) -> Any:
    """Ratios in percent, and all else as it is."""
    return 100 * value if "ratio" in name and value is not None else value
