"""The picture: delivery against distance in both simulators."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from benchmarks.ns3.compare import Comparison
from benchmarks.ns3.ground import BIN_M
from studies.style import BLUE, DPI, ORANGE, styled


@styled
def draw(comparisons: Sequence[Comparison], path: Path) -> None:
    """One panel for each comparison."""
    columns = 2 if len(comparisons) > 1 else 1
    rows = -(-len(comparisons) // columns)
    figure = Figure(figsize=(5.2 * columns, 3.4 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axes, one in zip(panels.flat, comparisons, strict=False):
        shown = one.judged
        middle_m = (np.flatnonzero(shown) + 0.5) * BIN_M
        axes.plot(middle_m, one.theirs.share[shown], "o", color=ORANGE, markersize=7, label="ns-3 3.37")
        axes.plot(middle_m, one.ours.share[shown], "-", color=BLUE, linewidth=1.8, label="vnet")
        axes.set_title(f"{one.vehicles} vehicles, {'Nakagami fading' if one.fading else 'no fading'}")
        note = f"largest difference {one.largest:.3f}\nbusy ratio {one.busy[1]:.3f}, ns-3 {one.busy[0]:.3f}"
        axes.text(0.97, 0.93, note, transform=axes.transAxes, ha="right", va="top", fontsize=9)
        axes.set_ylim(0, 1.03)
        axes.set_xlim(0, None)
    for axes in panels[-1]:
        axes.set_xlabel("distance (m)")
    for axes in panels[:, 0]:
        axes.set_ylabel("frames delivered")
    panels[0, 0].legend(loc="lower left")
    figure.savefig(path, dpi=DPI)
