"""One comparison: both simulators on the same ground, and its picture, delivery against distance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchmarks.ns3.ground import BIN_M, Curve, ScheduleConstraints
from benchmarks.ns3.simulators import ns3, ours
from studies.figures import BLUE, DPI, ORANGE, styled

LEAST_PAIRS = 1000
FARTHEST_M = 500.0
CURVE_LIMIT, BUSY_LIMIT, TIME_AIM = 0.03, 0.15, 10.0


@dataclass(frozen=True)
class Comparison:
    """The curves of both, mean busy ratios (ns-3, vnet), and seconds (ns-3, vnet) of CPU and on the wall clock."""

    vehicles: int
    fading: bool
    theirs: Curve
    ours: Curve
    busy: tuple[float, float]
    cpu_s: tuple[float, float]
    wall_s: tuple[float, float]

    @property
    def judged(self) -> NDArray[np.bool_]:
        """Bins with enough pairs."""
        return self.theirs.pairs >= LEAST_PAIRS

    @property
    def largest(self) -> float:
        """The largest difference between the curves, of bins with enough pairs up to FARTHEST_M."""
        near = self.judged & (np.arange(len(self.judged)) * BIN_M < FARTHEST_M)
        return float(np.abs(self.ours.share - self.theirs.share)[near].max())

    @property
    def busier(self) -> float:
        """By how much our busy ratio is greater, as a share."""
        return self.busy[1] / self.busy[0] - 1

    @property
    def ratio(self) -> float:
        """CPU time of ns-3 divided by that of the engine."""
        return self.cpu_s[0] / self.cpu_s[1]

    @property
    def holds(self) -> bool:
        """True if the curves and the channel busy ratios agree."""
        return self.largest <= CURVE_LIMIT and abs(self.busier) <= BUSY_LIMIT

    def figures(self) -> dict[str, Any]:
        """For a JSON file."""
        return {
            "vehicles": self.vehicles,
            "fading": self.fading,
            "bins_m": (np.arange(len(self.theirs.pairs)) * BIN_M).tolist(),
            "pairs": self.theirs.pairs.tolist(),
            "delivered_ns3": self.theirs.share.tolist(),
            "delivered_vnet": self.ours.share.tolist(),
            "largest_difference": self.largest,
            "busy_ns3": self.busy[0],
            "busy_vnet": self.busy[1],
            "cpu_s_ns3": self.cpu_s[0],
            "cpu_s_vnet": self.cpu_s[1],
            "wall_s_ns3": self.wall_s[0],
            "wall_s_vnet": self.wall_s[1],
            "ratio": self.ratio,
            "holds": self.holds,
        }


def compare(program: Path, vehicles: int, fading: bool, seconds: float) -> Comparison:
    """Both on the same ground, one after the other."""
    ground = ScheduleConstraints.of(vehicles, seconds)
    theirs, mine = ns3(program, ground, fading), ours(ground, fading)
    return Comparison(
        vehicles,
        fading,
        Curve.of(ground, theirs),
        Curve.of(ground, mine),
        (float(theirs.busy.mean()), float(mine.busy.mean())),
        (theirs.cpu_s, mine.cpu_s),
        (theirs.wall_s, mine.wall_s),
    )


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
