"""Draw the figure of docs/how-to/zenoh-recovery.md from the table of its sweep.

python docs/examples/zenoh_recovery/figure.py runs/sweep-recovery/sweep.parquet zenoh-recovery.png
"""

from __future__ import annotations

import sys
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy import stats

from vnet.types import Array

OTHERS = 4
"""Vehicles that each one hears."""


class Curve(NamedTuple):
    """A curve of a panel: its words, a column, whether that counts numbers that were heard, and its looks."""

    words: str
    column: str
    query_s: float
    colour: str
    marker: str


LOST = (
    Curve("plain subscriber", "last.heard_plain", 1.0, "#555555", "o"),
    Curve("advanced, query of 1 s", "last.heard_kept", 1.0, "#d55e00", "s"),
    Curve("advanced, query of 0.1 s", "last.heard_kept", 0.1, "#0072b2", "^"),
)
TIMES = (
    Curve("median, query of 1 s", "last.recovery_p50_s", 1.0, "#d55e00", "s"),
    Curve("95 %, query of 1 s", "last.recovery_p95_s", 1.0, "#d55e00", "v"),
    Curve("median, query of 0.1 s", "last.recovery_p50_s", 0.1, "#0072b2", "^"),
    Curve("95 %, query of 0.1 s", "last.recovery_p95_s", 0.1, "#0072b2", "x"),
)
CALLS = (
    Curve("called once", "last.answered_once", 1.0, "#d55e00", "s"),
    Curve("called up to three times", "last.answered_thrice", 1.0, "#0072b2", "^"),
)


def half_width(values: Array) -> float:
    """Return the half-width of the 95 % confidence interval of the mean of independent values (n,), n > 1."""
    return float(stats.t.ppf(0.975, len(values) - 1) * stats.sem(values)) if np.ptp(values) else 0.0


def draw(axes: Axes, table: pa.Table, curves: tuple[Curve, ...], label: str) -> None:
    """Draw means and confidence intervals of some columns against the loss."""
    for curve in curves:
        own = table.filter(pc.equal(table["program.zenoh.query_s"], curve.query_s))
        losses = sorted(set(own["radio.loss"].to_pylist()))
        samples = []
        for loss in losses:
            rows = own.filter(pc.equal(own["radio.loss"], loss))
            values = rows[curve.column].to_numpy()
            if "heard" in curve.column:
                values = 100 * (1 - values / (OTHERS * rows["last.published"].to_numpy()))
            elif "answered" in curve.column:
                values = 100 * (1 - values)
            elif not values.any():  # nothing was lost, so nothing was recovered
                values = np.full(len(values), np.nan)
            samples.append(values)
        means, widths = [each.mean() for each in samples], [half_width(each) for each in samples]
        percent = [100 * loss for loss in losses]
        axes.errorbar(percent, means, widths, color=curve.colour, marker=curve.marker, capsize=3, label=curve.words)
    axes.set_ylabel(label)
    axes.set_xlabel("loss of frames (%)")
    axes.set_ylim(0, 1.3 * axes.get_ylim()[1])  # room for the legend
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small", loc="upper left")


def main(table_path: str, picture_path: str) -> None:
    """Draw the three panels."""
    table = pq.read_table(table_path)
    figure = Figure(figsize=(11.0, 3.8), layout="constrained")
    first, second, third = figure.subplots(1, 3)
    draw(first, table, LOST, "samples lost for good (%)")
    draw(second, table, TIMES, "delay of recovered samples (s)")
    draw(third, table, CALLS, "calls without an answer (%)")
    figure.savefig(picture_path, dpi=110, metadata={"Software": None})


if __name__ == "__main__":
    main(*sys.argv[1:])
