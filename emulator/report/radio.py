"""The radio's part of a report: figures over all links, by vehicle, and of the worst links."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import pyarrow as pa

from emulator.pages.page import Table, table
from emulator.records.unicast_figures import unicast_figures
from emulator.report.source import Source
from vnet.errors import VnetError

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
    unicast = unicast_figures(source.recorded)
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
