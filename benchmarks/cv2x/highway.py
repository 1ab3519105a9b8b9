"""A highway of evenly spaced vehicles that send beacons, and what becomes of their receptions by distance."""

from __future__ import annotations

import asyncio
import csv
import json
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import emulator
from emulator.radio.engine import Engine
from emulator.radio.frames import Receptions, Transmission
from emulator.radio.outcomes import Outcome
from emulator.scenario.scenario import Radio
from vnet import Node
from vnet.radio import SentFrame
from vnet.types import Array

STEP_M = 25
"""Distance between two points of a published curve."""
POINTS = 21
"""Points of a published curve, from 0 to 500 m."""
MARGIN_M = 900.0
"""Road on both sides of the senders that are counted, so that these have neighbours and interferers."""
COUNTED_M = 700.0
"""Length of the road whose senders are counted."""
WARM_UP_S = 1.5
"""Time before frames are counted: longer than a sensing window."""
KINDS = {
    "HD": (Outcome.half_duplex,),
    "SEN": (Outcome.below_sensing, Outcome.out_of_range),
    "PRO": (Outcome.faded,),
    "COL": (Outcome.collided,),
}
"""The published kinds of errors of mode 4, and our outcomes."""
Curves = dict[str, Array]


@dataclass(frozen=True)
class Setting:
    """One setting of the published curves."""

    density_per_m: float
    rate_hz: int
    power_dbm: float
    subchannels: int = 0
    bitrate_mbps: float = 0.0
    size_bytes: int = 190

    @property
    def name(self) -> str:
        """The setting in words."""
        text = f"{self.density_per_m * 1000:g}/km, {self.rate_hz} Hz, {self.power_dbm:g} dBm"
        if self.subchannels:
            return f"{text}, {self.subchannels} subchannels"
        return f"{text}, {self.bitrate_mbps:g} Mbit/s, {self.size_bytes} B"


QPSK_05: dict[str, Any] = {
    "bler_sinr_db": [-2, 0, 2, 4, 6, 8, 10, 12, 20, 20.001],
    "bler": [1, 0.9, 0.7, 0.3, 0.09, 0.02, 0.002, 1e-3, 1e-3, 1e-4],
    "data_blocks": 12,
}
"""Two subchannels: QPSK 0.5 in 12 resource blocks; block error rates of 3GPP R1-160284."""


def mode4_radio(setting: Setting) -> Radio:
    """Return the radio of a setting of mode 4: noise figure 9 dB, shadowing of 3 dB, no in-band emission.

    As in the published model, the shadowing of each link is independent.
    """
    return Radio.model_validate(
        {
            "max_peers": 1_000_000,
            "access_jitter_ms": 0.0,
            "path_loss": {
                "kind": "winner_b1",
                "frequency_ghz": 5.91,
                "tx_power_dbm": setting.power_dbm,
                "floor_dbm": -115.0,
            },
            "shadowing": {"sigma_db": 3.0, "decorrelation_m": 0.5},
            "receiver": {"noise_figure_db": 9.0},
            "mac": {
                "kind": "lte-mode4",
                "subchannels": setting.subchannels,
                "reservation_ms": 1000 // setting.rate_hz,
                "in_band_emission_db": 300.0,
                **(QPSK_05 if setting.subchannels == 2 else {}),
            },
        }
    )


@dataclass
class Measured:
    """Receptions (points, outcomes) by distance, channel busy ratios of counted vehicles, and the CPU time."""

    count: Array
    busy: Array
    cpu_s: float

    def curves(self, kinds: Mapping[str, Sequence[Outcome]] = KINDS) -> Curves:
        """Return the packet delivery ratio and the probabilities of all kinds of errors by distance."""
        share = self.count / np.maximum(self.count.sum(axis=1), 1)[:, None]
        found = {kind: share[:, list(outcomes)].sum(axis=1) for kind, outcomes in kinds.items()}
        return {"PDR": share[:, Outcome.delivered] + share[:, Outcome.pending], **found}


def drive(radio: Radio, setting: Setting, seconds: float, seed: int = 1) -> Measured:
    """Let the engine carry the beacons of a highway, and count the receptions of the frames of its middle."""
    count = round((2 * MARGIN_M + COUNTED_M) * setting.density_per_m)
    east_m = np.arange(count) / setting.density_per_m
    counted = np.abs(east_m - east_m.mean()) <= COUNTED_M / 2
    point = np.rint(np.abs(east_m[:, None] - east_m) / STEP_M).astype(int)
    point[np.abs(east_m[:, None] - east_m) > STEP_M * (POINTS - 1)] = POINTS
    np.fill_diagonal(point, POINTS)
    engine = Engine([f"v{n}" for n in range(count)], radio, seed, np.column_stack([east_m, np.zeros(count)]))
    seen = np.zeros((POINTS + 1, len(Outcome)))
    engine.deciding.append(partial(_count, seen, point, counted))
    period_ns = 1_000_000_000 // setting.rate_hz
    phase_ns = np.random.default_rng(seed).integers(0, period_ns, count)
    order = np.argsort(phase_ns, kind="stable").tolist()
    frames = [
        [SentFrame(f"v{n}", bytes(setting.size_bytes), period_ms=1000 / setting.rate_hz)] for n in range(count)
    ]
    began_s = time.process_time()
    for period in range(round(seconds * setting.rate_hz)):
        for node in order:
            engine.transmit(period * period_ns + int(phase_ns[node]), node, frames[node])
        engine.advance((period + 1) * period_ns)
    engine.drain()
    busy = np.array(engine.busy_ratios(round(seconds * 1e9)))[round(WARM_UP_S * 10) :, counted]
    return Measured(seen[:POINTS], busy, time.process_time() - began_s)


def _count(
    seen: Array, point: Array, counted: Array, transmissions: Sequence[Transmission], receptions: Receptions
) -> None:
    """Count receptions by distance and outcome, and leave nothing for the trace: it would not fit the memory."""
    for index, sent in enumerate(transmissions):
        node = sent.frame.sender
        if counted[node] and sent.frame.sent_ns >= WARM_UP_S * 1e9:
            np.add.at(seen, (point[node], receptions.outcome[index]), 1)
    receptions.outcome[:] = Outcome.out_of_range


def together(runs: Sequence[Measured]) -> Measured:
    """Return the sum of several runs."""
    busy = np.concatenate([run.busy for run in runs])
    return Measured(np.sum([run.count for run in runs], axis=0), busy, sum(run.cpu_s for run in runs))


def published(path: Path) -> dict[Setting, Curves]:
    """Return the simulated curves of a file: of mode 4 (`lte_mode4.csv`) or 802.11p (`80211p.csv`)."""
    points: dict[Setting, dict[str, list[float]]] = {}
    with path.open() as file:
        for row in csv.DictReader(file):
            curve = row["curve"]
            if "Analytical" in curve:
                continue
            setting = Setting(
                float(row["density_per_m"]),
                int(row["rate_hz"]),
                float(row["power_dbm"]),
                int(row.get("subchannels") or 0),
                float(row.get("bitrate_mbps") or 0),
                int(row.get("size_bytes") or 190),
            )
            name = next(each for each in ("PDR", "HD", "SEN", "PRO", "SNR", "COL", "RXB") if each in curve)
            points.setdefault(setting, {}).setdefault(name, []).append(float(row["value"]))
    return {setting: {name: np.array(each) for name, each in some.items()} for setting, some in points.items()}


def deviations(ours: Curves, theirs: Curves) -> dict[str, float]:
    """Return the mean absolute deviations of curves in percentage points; no vehicle is at distance 0."""
    return {name: float(100 * np.abs(ours[name] - theirs[name])[1:].mean()) for name in theirs if name in ours}


SPEED_LENGTH_M = 2000.0
"""Length of the highway on which the speed of simulations is measured."""
SPEED_S = 5.0
"""Emulated time of such a run."""


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
        east_m = np.arange(vehicles) * SPEED_LENGTH_M / vehicles
        lines = [f"v{n},{place:.3f},0,0" for n, place in enumerate(east_m.tolist())]
        positions.write_text("\n".join(["id,x_m,y_m,heading_rad", *lines]) + "\n")
        scenario = {
            "run": {"duration_s": SPEED_S, "settle_s": 0.0},
            "network": {"kind": "file", "path": str(positions)},
            "radio": {
                "access_jitter_ms": 0.0,
                "path_loss": {"kind": "winner_b1"},
                "shadowing": {},
                "mac": mac,
            },
            "program": {"entry": "benchmarks.cv2x.highway:beacon"},
        }
        emulator.simulate(scenario, out=Path(folder) / "run")
        verdict = json.loads((Path(folder) / "run" / "verdict.json").read_text())
    return float(verdict["real_time_factor"])
