"""Run the study of docs/how-to/standard-messages.md, print its table and draw its figure.

python docs/examples/its2/figure.py perception.png --losses 0,0.9 --seeds 1 --duration-s 3
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy import stats

import emulator

SCENARIO = Path(__file__).parent / "perception.toml"
BETWEEN_BUILDINGS: Mapping[str, Any] = {
    "radio.path_loss": {"kind": "dual_slope"},
    "radio.buildings": {"path": "blocks.csv"},
}
RADIOS: Mapping[str, Mapping[str, Any]] = {
    "disc of 400 m": {},
    "802.11p": {**BETWEEN_BUILDINGS, "radio.mac": {}},
    "LTE-V2X mode 4": {**BETWEEN_BUILDINGS, "radio.mac": {"kind": "lte-mode4"}},
    "NR-V2X mode 2": {**BETWEEN_BUILDINGS, "radio.mac": {"kind": "nr-mode2"}},
}
"""The disc, and three radios between buildings."""
COLOURS = ("#0072b2", "#d55e00", "#cc79a7", "#e69f00")
SETTLES_S = 1.0
"""Time until everybody has heard of everybody, which is left out."""


def share_seen(changes: Mapping[str, Any], seed: int, duration_s: float) -> tuple[float, float]:
    """Return the mean share of the crossing that vehicles there know of, and the mean number of ghosts."""
    with tempfile.TemporaryDirectory() as folder:
        run = emulator.simulate(SCENARIO, seed=seed, duration_s=duration_s, set=changes, out=Path(folder) / "run")
        settled = run.metrics["time_ns"].to_numpy() >= SETTLES_S * 1e9
        both = [run.metrics[name].to_numpy()[settled] for name in ("seen_share", "ghosts")]
        crashed = [event.node for event in run.events if event.kind == "crashed"]
    if crashed:
        raise RuntimeError(f"seed {seed}: programs of {crashed} crashed")
    return float(both[0].mean()), float(both[1].mean())


def main() -> None:
    """Simulate, print and draw."""
    parser = argparse.ArgumentParser()
    parser.add_argument("picture")
    parser.add_argument("--losses", default="0,0.5,0.8")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--duration-s", type=float, default=6.0)
    options = parser.parse_args()
    losses = [float(text) for text in options.losses.split(",")]
    figure = Figure(figsize=(5.5, 3.6), layout="constrained")
    axes = figure.subplots()
    curves = {name: [{**radio, "radio.loss": loss} for loss in losses] for name, radio in RADIOS.items()}
    curves["own sensors alone"] = [{"program.options.shares": False}]
    for name, colour in zip(curves, (*COLOURS, "#009e73"), strict=True):
        means, wides = [], []
        for changes in curves[name]:
            runs = [share_seen(changes, seed, options.duration_s) for seed in range(1, options.seeds + 1)]
            shares, ghosts = np.array(runs).T
            wide = stats.t.ppf(0.975, len(shares) - 1) * stats.sem(shares) if len(shares) > 1 else 0.0
            of_loss = f", loss {changes['radio.loss']:.0%}" if "radio.loss" in changes else ""
            shown = f"{shares.mean():.1%}" + (f" ± {100 * wide:.1f}" if len(shares) > 1 else "")
            print(f"{name}{of_loss}: {shown} seen, {ghosts.mean():.2f} ghosts", flush=True)
            means.append(shares.mean())
            wides.append(wide)
        if len(means) == len(losses):
            axes.errorbar(np.array(losses) * 100, means, wides, color=colour, marker="o", capsize=3, label=name)
        else:  # nobody sends, so that losses do not matter
            axes.axhline(means[0], color=colour, label=name)
    axes.set_xlabel("further packet loss (%)")
    axes.set_ylabel("share of the crossing that is seen")
    axes.set_ylim(0, 1.05)
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(options.picture, dpi=110, metadata={"Software": None})


if __name__ == "__main__":
    main()
