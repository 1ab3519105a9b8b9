"""Run the study of docs/how-to/platoon.md, print its table and draw its figure.

python docs/examples/platoon/figure.py platoon.png --losses 0,0.6 --headways 0.3 --seeds 1 --duration-s 25
"""

from __future__ import annotations

import argparse
import tempfile
from functools import cache
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy import stats

import emulator
from vnet.types import Array

SCENARIO = Path(__file__).parent / "platoon.toml"
VEHICLES = 8
CRUISE_M_S, STANDSTILL_M = 20.0, 5.0
LOSSES = "0,0.15,0.3,0.45,0.6"
HEADWAYS = "0.3,0.5,0.8"
NO_PACKETS = 1.0
COLOURS = ("#0072b2", "#d55e00", "#009e73")


@cache
def speeds(loss: float, headway_s: float, seed: int, duration_s: float) -> tuple[Array, Array]:
    """Return times (K,) in s and true speeds (K, N) in m/s of one run."""
    changes = {
        "radio.loss": loss,
        "program.options.headway_s": headway_s,
        "network.driven.gap_m": STANDSTILL_M + headway_s * CRUISE_M_S,
    }
    with tempfile.TemporaryDirectory() as folder:
        run = emulator.simulate(SCENARIO, seed=seed, duration_s=duration_s, set=changes, out=Path(folder) / "run")
        assert run.driven is not None
        time_s = np.array(run.driven["time_ns"])[::VEHICLES] / 1e9
        return time_s, np.array(run.driven["speed_m_s"]).reshape(-1, VEHICLES)


def amplification(speed: Array) -> float:
    """Return the L2 norm of the last vehicle's deviation from the cruising speed, by that of the first's."""
    deviation = np.linalg.norm(speed - CRUISE_M_S, axis=0)
    return float(deviation[-1] / deviation[0])


def half_width(values: Array) -> float:
    """Return the half-width of the 95 % confidence interval of the mean of independent values (n,)."""
    return float(stats.t.ppf(0.975, len(values) - 1) * stats.sem(values)) if len(values) > 1 else 0.0


def main() -> None:
    """Simulate, print and draw."""
    parser = argparse.ArgumentParser()
    parser.add_argument("picture")
    parser.add_argument("--losses", default=LOSSES)
    parser.add_argument("--headways", default=HEADWAYS)
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--duration-s", type=float, default=50.0)
    options = parser.parse_args()
    losses = [float(text) for text in options.losses.split(",")]
    headways = [float(text) for text in options.headways.split(",")]
    figure = Figure(figsize=(9.0, 3.8), layout="constrained")
    lasting = options.duration_s
    left, right = figure.subplots(1, 2)
    for headway_s, colour in zip(headways, COLOURS, strict=False):
        samples = [
            np.array(
                [amplification(speeds(loss, headway_s, seed, lasting)[1]) for seed in range(1, options.seeds + 1)]
            )
            for loss in losses
        ]
        means, widths = [values.mean() for values in samples], [half_width(values) for values in samples]
        left.errorbar(
            np.array(losses) * 100, means, widths, color=colour, marker="o", capsize=3, label=f"{headway_s:g} s"
        )
        for loss, mean, width in zip(losses, means, widths, strict=True):
            interval = f" ± {width:.3f}" if options.seeds > 1 else ""
            print(f"headway {headway_s:g} s, loss {loss:4.0%}: amplification {mean:.3f}{interval}")
        alone = amplification(speeds(NO_PACKETS, headway_s, 1, lasting)[1])
        print(f"headway {headway_s:g} s, no packets: amplification {alone:.3f}")
    left.axhline(1.0, color="0.4", linestyle="--", linewidth=1)
    left.set_xlabel("packet loss (%)")
    left.set_ylabel("amplification from the first vehicle\nto the eighth (speed, L2)")
    left.legend(title="headway")
    for loss, colour in zip((0.0, 0.6, NO_PACKETS), COLOURS, strict=True):
        time_s, speed = speeds(loss, headways[0], 1, lasting)
        label = "no packets" if loss == NO_PACKETS else f"loss {loss:.0%}"
        right.plot(time_s, speed[:, -1], color=colour, label=f"eighth, {label}")
    right.plot(time_s, speed[:, 0], color="0.2", linestyle="--", label="first")
    right.set_xlim(8, 40)
    right.set_xlabel("time (s)")
    right.set_ylabel(f"speed (m/s), headway {headways[0]:g} s")
    right.legend()
    for axes in (left, right):
        axes.grid(alpha=0.3)
    figure.savefig(options.picture, dpi=110, metadata={"Software": None})


if __name__ == "__main__":
    main()
