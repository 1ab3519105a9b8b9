"""Draw the figure of docs/how-to/worked-example.md from the table of its sweep.

python docs/examples/cbf/figure.py runs/sweep-cbf/sweep.parquet cbf.png
"""

from __future__ import annotations

import sys

import pyarrow.compute as pc
import pyarrow.parquet as pq
from matplotlib.figure import Figure
from scipy import stats

from vnet.types import Array

FIGURES = {
    "last.informed": "warnings received\n(share)",
    "last.delay_ms": "delay of a warning\n(ms)",
    "last.frames": "frames sent a vehicle\nand warning",
    "last.duplicates": "duplicates received a vehicle\nand warning",
}
"""The columns that are drawn, and their axes."""
COLOURS = {"cbf": "#0072b2", "flooding": "#d55e00"}
MARKERS = {"cbf": "o", "flooding": "s"}


def half_width(values: Array) -> float:
    """Return the half-width of the 95 % confidence interval of the mean of independent values (n,), n > 1."""
    return float(stats.t.ppf(0.975, len(values) - 1) * stats.sem(values))


def main(table_path: str, picture_path: str) -> None:
    """Draw mean and confidence interval of each figure against the number of vehicles."""
    table = pq.read_table(table_path)
    figure = Figure(figsize=(8.0, 6.0), layout="constrained")
    panels = figure.subplots(2, 2, sharex=True).ravel()
    for axes, (column, label) in zip(panels, FIGURES.items(), strict=True):
        for forwarding, colour in COLOURS.items():
            own = table.filter(pc.equal(table["program.options.forwarding"], forwarding))
            vehicles = sorted(set(own["network.vehicles"].to_pylist()))
            samples = [
                own.filter(pc.equal(own["network.vehicles"], n))[column].drop_null().to_numpy() for n in vehicles
            ]
            axes.errorbar(
                vehicles,
                [values.mean() for values in samples],
                [half_width(values) for values in samples],
                color=colour,
                marker=MARKERS[forwarding],
                capsize=3,
                label=forwarding,
            )
        axes.set_ylabel(label)
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
    for axes in panels[2:]:
        axes.set_xlabel("vehicles in 4.2 km by 4.2 km")
    panels[0].legend()
    figure.savefig(picture_path, dpi=110, metadata={"Software": None})


if __name__ == "__main__":
    main(*sys.argv[1:])
