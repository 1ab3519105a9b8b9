"""Vehicles that each estimate the middle of all, and the figure of how far off they are.

The middle is the mean of the latest positions that a vehicle has heard, and its own. No vehicle can tell how wrong
that is: the emulator, which has all true positions, computes it period by period as `Figures` says.

    vnet simulate scenarios/beacon.toml --program docs.examples.middle:main
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from vnet import Node

DECLARES = "docs.examples.middle"
FIGURES = "docs.examples.middle:Figures"


@dataclass(frozen=True)
class Figures:
    """The program's figures of a period, beside vnet's own."""

    COLUMNS: ClassVar = {"middle_m": ("middle_m", 2, "what it takes for the middle of all vehicles")}
    KEY_FIGURES: ClassVar = (
        {
            "name": "middle_rmse_m",
            "title": "middle, RMSE",
            "column": "middle (m)",
            "chart": ("middle", "Middle", "RMSE of the middle (m)"),
            "live": ("middle", "RMSE"),
        },
    )
    CHARTS: ClassVar = (
        {
            "id": "middle",
            "title": "Middle of all vehicles",
            "axis": "RMSE of the middle (m)",
            "lines": {"RMSE": "middle_rmse_m"},
            "text": "Distance of the vehicles' estimates from the mean of all true positions.",
        },
    )

    middle_rmse_m: float | None
    """RMSE of what the vehicles take for the middle."""

    @staticmethod
    def compute(periods: Any) -> dict[str, list[float | None]]:
        """Return the figures of each of K periods."""
        off_m = periods["middle_m"] - periods.mean(periods["position_m"])
        return {"middle_rmse_m": periods.rms(off_m)}


async def main(node: Node) -> None:
    """Send each fix, and report the mean of the latest of everybody."""
    latest: dict[str, tuple[float, ...]] = {}
    async for fix in node.gnss:
        for packet in node.radio.drain():
            if len(packet.payload) == 16:
                latest[packet.sender] = struct.unpack("<2d", packet.payload)
        latest[node.id] = tuple(fix.position_m.tolist())
        await node.radio.broadcast(struct.pack("<2d", *latest[node.id]))
        node.report(fix.position_m, fix.covariance_m2, middle_m=np.mean(list(latest.values()), axis=0))
