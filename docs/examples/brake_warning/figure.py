"""Run the study of docs/how-to/brake-warning.md, print its table and draw its figure.

python docs/examples/brake_warning/figure.py brake-warning.png --shares 1 --seeds 1
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy import stats

import emulator

SCENARIO = Path(__file__).parent / "warning.toml"


def collisions(equipped: float, seed: int) -> tuple[int, float]:
    """Return the number of collisions of a run, and the sum of their closing speeds in m/s."""
    with tempfile.TemporaryDirectory() as folder:
        changes = {"program.options.equipped": equipped}
        run = emulator.simulate(SCENARIO, seed=seed, set=changes, out=Path(folder) / "run")
        closing = [float(event.details["closing_m_s"]) for event in run.events if event.kind == "collision"]
        return len(closing), sum(closing)


def main() -> None:
    """Simulate, print and draw."""
    parser = argparse.ArgumentParser()
    parser.add_argument("picture")
    parser.add_argument("--shares", default="0,0.2,0.4,0.6,0.8,1")
    parser.add_argument("--seeds", type=int, default=10)
    options = parser.parse_args()
    shares = [float(text) for text in options.shares.split(",")]
    seeds = range(1, options.seeds + 1)
    counts = np.array([[collisions(share, seed) for seed in seeds] for share in shares], dtype=float)
    mean = counts.mean(axis=1)
    width = np.zeros_like(mean)
    if options.seeds > 1:
        width = stats.t.ppf(0.975, options.seeds - 1) * stats.sem(counts, axis=1)
    for share, (number, closing), (spread, _) in zip(shares, mean, width, strict=True):
        interval = f" ± {spread:.1f}" if options.seeds > 1 else ""
        print(f"equipped {share:4.0%}: {number:.1f}{interval} collisions, closing speeds {closing:.0f} m/s in sum")
    figure = Figure(figsize=(8.0, 3.4), layout="constrained")
    labels = ("collisions", "closing speeds of all\ncollisions (m/s)")
    for index, (axes, label) in enumerate(zip(figure.subplots(1, 2), labels, strict=True)):
        axes.errorbar(
            np.array(shares) * 100, mean[:, index], width[:, index], color="#0072b2", marker="o", capsize=3
        )
        axes.set_xlabel("vehicles with a radio (%)")
        axes.set_ylabel(label)
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
    figure.savefig(options.picture, dpi=110, metadata={"Software": None})


if __name__ == "__main__":
    main()
