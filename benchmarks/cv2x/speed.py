"""Speed of whole simulations of beacons on a highway of 2 km."""

from __future__ import annotations

import asyncio
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import emulator
from vnet import Node

LENGTH_M = 2000.0
"""Length of the highway."""
SECONDS = 5.0
"""Emulated time of a run."""


async def beacon(node: Node) -> None:
    """Broadcast 190 bytes ten times a second, from an instant of one's own on, and take what arrives."""
    await asyncio.sleep(float(node.rng.uniform(0.0, 0.1)))
    while True:
        await node.radio.broadcast(bytes(190), period_ms=100)
        await asyncio.sleep(0.1)
        node.radio.drain()


def real_time_factor(vehicles: int, mac: dict[str, Any]) -> float:
    """Return the real-time factor of `vnet simulate` in one process: 10 beacons a second from each vehicle."""
    with tempfile.TemporaryDirectory(prefix="vnet-cv2x-") as folder:
        positions = Path(folder) / "positions.csv"
        east_m = np.arange(vehicles) * LENGTH_M / vehicles
        lines = [f"v{n},{place:.3f},0,0" for n, place in enumerate(east_m.tolist())]
        positions.write_text("\n".join(["id,x_m,y_m,heading_rad", *lines]) + "\n")
        scenario = {
            "run": {"duration_s": SECONDS, "settle_s": 0.0},
            "network": {"kind": "file", "path": str(positions)},
            "radio": {
                "access_jitter_ms": 0.0,
                "path_loss": {"kind": "winner_b1"},
                "shadowing": {},
                "mac": mac,
            },
            "program": {"entry": "benchmarks.cv2x.speed:beacon"},
        }
        emulator.simulate(scenario, out=Path(folder) / "run")
        verdict = json.loads((Path(folder) / "run" / "verdict.json").read_text())
    return float(verdict["real_time_factor"])
