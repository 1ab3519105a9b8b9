"""One comparison: both simulators on the same ground."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.ns3.ground import BIN_M, Curve, ScheduleConstraints
from benchmarks.ns3.simulators import ns3, ours

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
