"""Print the table of docs/how-to/three-radios.md from the tables of its sweeps, and draw its figure.

python docs/examples/three_radios/figure.py runs/three/sweep.parquet [MORE.parquet ...] three-radios.png
"""

from __future__ import annotations

import json
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from matplotlib.figure import Figure
from scipy import stats

RADIOS = {"80211p": "802.11p", "lte-mode4": "LTE-V2X mode 4", "nr-mode2": "NR-V2X mode 2"}
COLOURS = {"80211p": "#0072b2", "lte-mode4": "#d55e00", "nr-mode2": "#009e73"}
MARKERS = {"80211p": "o", "lte-mode4": "s", "nr-mode2": "^"}
FIGURES = {
    "delivery_ratio": ("packet delivery ratio (%)", 100.0),
    "inter_reception_mean_ms": ("inter-packet gap (ms)", 1.0),
    "age_mean_ms": ("age of information (ms)", 1.0),
}
"""Figures with their titles and factors."""
Point = tuple[str, str, int]
"""A radio, a traffic, and vehicles a kilometre."""


def samples(*table_paths: str) -> dict[Point, dict[str, list[float]]]:
    """Return the values of all seeds of each figure, by point, of the runs that have them."""
    found: dict[Point, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for row in (row for path in table_paths for row in pq.read_table(path).to_pylist()):
        options = json.loads(row["program.options"])
        traffic = f"{options['rate_hz']} Hz, {options['size_bytes']} bytes"
        point = json.loads(row["radio.mac"])["kind"], traffic, int(Path(row["network.path"]).stem)
        for name, (_, factor) in FIGURES.items():
            if (value := row[f"own:near.{name}"]) is not None:
                found[point][name].append(factor * value)
    return found


def half_width(values: list[float]) -> float:
    """Return the half-width of the 95 % confidence interval of the mean of independent values."""
    if len(values) < 2 or not np.ptp(values):
        return 0.0
    return float(stats.t.ppf(0.975, len(values) - 1) * stats.sem(values))


def print_table(found: dict[Point, dict[str, list[float]]]) -> None:
    """Print means with their confidence intervals, a row for each traffic and density."""
    for name, (title, _) in FIGURES.items():
        print(f"| {title} | {' | '.join(RADIOS.values())} |", "|---|---|---|---|", sep="\n")
        for traffic, density in dict.fromkeys(point[1:] for point in found):
            of_radios = [found[radio, traffic, density][name] for radio in RADIOS]
            cells = [f"{np.mean(each):.1f} ± {half_width(each):.1f}" if each else "–" for each in of_radios]
            print(f"| {traffic}, {density}/km | {' | '.join(cells)} |")
        print()


def draw(found: dict[Point, dict[str, list[float]]], picture_path: str) -> None:
    """Draw each figure against the density, a column for each traffic."""
    traffics = list(dict.fromkeys(traffic for _, traffic, _ in found))
    figure = Figure(figsize=(11.0, 8.0), layout="constrained")
    panels = figure.subplots(len(FIGURES), len(traffics), squeeze=False)
    for row, (name, (title, _)) in enumerate(FIGURES.items()):
        for column, traffic in enumerate(traffics):
            axes: Any = panels[row][column]
            for radio, label in RADIOS.items():
                known = {point: each[name] for point, each in found.items() if each[name]}
                points = {density: values for (*of, density), values in known.items() if of == [radio, traffic]}
                means = [np.mean(values) for values in points.values()]
                halves = [half_width(values) for values in points.values()]
                style: Any = {"color": COLOURS[radio], "marker": MARKERS[radio], "capsize": 3, "label": label}
                axes.errorbar(list(points), means, halves, **style)
            axes.set_ylim(0, 104 if name == "delivery_ratio" else None)
            axes.grid(alpha=0.3)
            if row == 0:
                axes.set_title(traffic)
            if row == len(FIGURES) - 1:
                axes.set_xlabel("vehicles a kilometre")
            if column == 0:
                axes.set_ylabel(title)
    panels[0][0].legend(loc="lower left")
    figure.savefig(picture_path, dpi=110, metadata={"Software": None})


def main(*paths: str) -> None:
    """Print and draw; the last path is that of the picture."""
    *table_paths, picture_path = paths
    found = samples(*table_paths)
    print_table(found)
    draw(found, picture_path)


if __name__ == "__main__":
    main(*sys.argv[1:])
