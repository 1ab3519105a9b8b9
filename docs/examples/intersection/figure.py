"""Run the study of docs/how-to/intersection.md, print its table and draw its figure.

python docs/examples/intersection/figure.py intersection.png --losses 0,0.9 --seeds 1 --vehicles 16 --duration-s 60
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from scipy import special

import emulator
from vnet.types import Array

SCENARIO = Path(__file__).parent / "crossing.toml"
BEHIND_M, CRUISE_M_S = 50.0, 14.0


class Crossing(NamedTuple):
    """Result of a run: mean delay in s, collisions, vehicles not past."""

    delay_s: float
    collisions: int
    not_past: int


def starts(seed: int, vehicles: int) -> list[float]:
    """Return positions along their roads at the start in m, of the two roads in turn, 65 m apart in the mean."""
    gaps_m = 15 + np.random.default_rng(seed).exponential(50, (vehicles // 2, 2))
    return np.round(1400 - np.cumsum(gaps_m, axis=0), 1).ravel().tolist()


def cross(changes: Mapping[str, object], seed: int, places: list[float]) -> Crossing:
    """Return the result of a run in which vehicles start at `places` in m along their roads."""
    changes = {**changes, "network.vehicles": len(places), "network.driven.start_m": places}
    with tempfile.TemporaryDirectory() as folder:
        run = emulator.simulate(SCENARIO, seed=seed, set=changes, out=Path(folder) / "run")
        time_ns, position = run.states["time_ns"].to_numpy(), run.states["position_m"].combine_chunks()
        crashed = [event.node for event in run.events if event.kind == "crashed"]
        collisions = len([event for event in run.events if event.kind == "collision"])
    if crashed:  # a crashed program's vehicle goes on, and would count as any other
        raise RuntimeError(f"seed {seed}: programs of {crashed} crashed")
    count = len(places) + 1  # the unit is the last node
    position_m = position.flatten().to_numpy().reshape(-1, count, 2)[:, :-1]
    at_m = position_m[:, np.arange(len(places)), np.arange(len(places)) % 2]
    return measured(time_ns[::count] / 1e9, at_m, collisions)


def measured(time_s: Array, at_m: Array, collisions: int) -> Crossing:
    """Return the delays of vehicles (N,) from their positions behind the crossing (K, N) in m."""
    is_past = at_m >= BEHIND_M
    past_s = np.where(is_past.any(axis=0), time_s[is_past.argmax(axis=0)], time_s[-1])
    free_s = (BEHIND_M - at_m[0]) / CRUISE_M_S
    return Crossing(float((past_s - free_s).mean()), collisions, int((~is_past.any(axis=0)).sum()))


def main() -> None:
    """Simulate, print and draw."""
    parser = argparse.ArgumentParser()
    parser.add_argument("picture")
    parser.add_argument("--losses", default="0,0.5,0.8,0.9,0.95")
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--vehicles", type=int, default=20)
    parser.add_argument("--duration-s", type=float, default=100.0)
    options = parser.parse_args()
    losses = [float(text) for text in options.losses.split(",")]
    seeds = range(1, options.seeds + 1)
    figure = Figure(figsize=(8.0, 3.4), layout="constrained")
    both = figure.subplots(1, 2)
    for waits, colour, name in ((True, "#0072b2", "waits for a grant"), (False, "#d55e00", "without the unit")):
        settings = [
            {"run.duration_s": options.duration_s, "radio.loss": loss, "program.options.waits": waits}
            for loss in (losses if waits else losses[:1])
        ]
        figures = np.array(
            [[cross(changes, seed, starts(seed, options.vehicles)) for seed in seeds] for changes in settings],
            float,
        )
        mean, width = figures.mean(axis=1), np.zeros((len(settings), 3))
        if options.seeds > 1:
            width = special.stdtrit(options.seeds - 1, 0.975) * figures.std(axis=1, ddof=1) / options.seeds**0.5
        for changes, row, spread in zip(settings, mean, width, strict=True):
            shown = [
                f"{value:.1f}" + (f" ± {wide:.1f}" if options.seeds > 1 else "")
                for value, wide in zip(row, spread, strict=True)
            ]
            label = f"loss {changes['radio.loss']:4.0%}" if waits else name
            print(f"{label}: delay {shown[0]} s, collisions {shown[1]}, not past {shown[2]}")
        for column, axes in enumerate(both):
            middle, wide = mean[:, column], width[:, column]
            if waits:
                axes.errorbar(np.array(losses) * 100, middle, wide, color=colour, marker="o", capsize=3, label=name)
            else:  # nobody asks, so that losses do not matter
                axes.axhline(middle[0], color=colour, label=name)
                axes.axhspan(middle[0] - wide[0], middle[0] + wide[0], color=colour, alpha=0.2, linewidth=0)
    for axes, label in zip(both, ("mean delay (s)", "collisions"), strict=True):
        axes.set_xlabel("packet loss (%)")
        axes.set_ylabel(label)
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
    figure.legend(*both[0].get_legend_handles_labels(), loc="outside upper center", ncols=2)  # no point is below it
    figure.savefig(options.picture, dpi=110, metadata={"Software": None})


if __name__ == "__main__":
    main()
