"""Vehicles that drive through a city: every mechanism on the same trips and roads, and where it goes wrong.

The world has the default common error, 10 % of the frames are lost, and programs know the map. Raw fixes stand
beside. One run of the optimized weights is kept whole, with a picture of its errors on the map.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from emulator.experiments.cells import Cell
from emulator.experiments.figures import save, styled
from emulator.experiments.paper import SETTLED_S, _everybody
from emulator.experiments.reports import Result, column, select, unique
from emulator.experiments.tables import MISSING, markdown_table, mean_and_error
from emulator.world.world import build_world
from vnet.roads.lanes import Array
from vnet.scenario import Scenario

LOSS = 0.1
CENTRALIZED_PARTICLES = 2000
MECHANISMS: dict[str, dict[str, Any]] = {
    "optimized": {"fusion": "optimized"},
    "random": {"fusion": "random"},
    "max-degree": {"fusion": "max-degree"},
    "metropolis": {"fusion": "metropolis"},
    "constant 0.5": {"fusion": "constant", "alpha": 0.5},
    "none": {"fusion": "none"},
}
"""Options of each mechanism that is not centralized."""
PLACE_M = 50.0
"""The map of errors has squares of this side."""


def city_cells(place: Mapping[str, Any], seeds: Sequence[int], duration_s: float, range_m: float) -> list[Cell]:
    """One filter that hears all, and each mechanism; `place` are the sections `network` and, if any, `map`."""
    cells = []
    for seed in seeds:
        for mechanism in ("centralized", *MECHANISMS):
            scenario = city_scenario(place, seed, mechanism, duration_s, range_m)
            settled_s = min(SETTLED_S, duration_s / 2)
            cells.append(Cell({"mechanism": mechanism, "seed": seed}, scenario, settled_s))
    return cells


def city_scenario(
    place: Mapping[str, Any], seed: int, mechanism: str, duration_s: float, range_m: float
) -> Scenario:
    """One run. Raises ScenarioError if there is no such place."""
    data: dict[str, Any] = {
        "run": {"name": "cell", "seed": seed, "duration_s": duration_s},
        **place,
        "radio": {"range_m": range_m, "loss": LOSS},
        "program": {"entry": "agents.cooperative:main", "options": MECHANISMS.get(mechanism, {})},
    }
    if mechanism == "centralized":
        count = len(build_world(Scenario.model_validate(data)).node_ids)
        data["radio"] = _everybody(np.ones((count, count)))
        data["program"] = {
            "entry": "agents.centralized:main",
            "options": {"particles": CENTRALIZED_PARTICLES},
        }
    return Scenario.model_validate(data)


def report(results: Sequence[Result], duration_s: float) -> str:
    """Errors, consistency and cost of each mechanism, in Markdown, and of the raw fixes."""
    header = ["mechanism", "common error [m]", "deviation [m]", "position [m]"]
    header += ["ANEES common error", "ANEES position", "bytes a period", "diverged"]
    rows = []
    for mechanism in unique(results, "mechanism"):
        found = select(results, mechanism=mechanism)
        size = [row["bytes"] for row in found if row["bytes"] is not None]
        rows.append(
            [
                mechanism,
                mean_and_error(column(found, "rmse_m")),
                mean_and_error(column(found, "deviation_m")),
                mean_and_error(column(found, "position_rmse_m")),
                mean_and_error(column(found, "common_error_anees"), 2),
                mean_and_error(column(found, "position_anees"), 2),
                f"{np.mean(size):.0f}" if size else MISSING,
                str(sum(column(found, "divergent"))),
            ]
        )
    fixes = mean_and_error(column(select(results, mechanism=results[0]["mechanism"]), "fix_rmse_m"))
    rows.append(["raw fixes", MISSING, MISSING, fixes, MISSING, MISSING, MISSING, MISSING])
    return (
        "# Driving through a city\n\n"
        f"{markdown_table(header, rows)}\n\n"
        f"RMSE from {min(SETTLED_S, duration_s / 2):g} s on, of {duration_s:g} s; "
        f"{len(unique(results, 'seed'))} seeds, ± standard error; {100 * LOSS:g} % loss. `centralized` is one "
        "filter that hears every fix.\n"
    )


def errors_by_place(states: pa.Table) -> tuple[Array, Array, Array]:
    """Squares of the map (n, 2), by their corners in metres; RMSE (n,) of positions in them, and how many (n,)."""
    states = states.filter(pc.and_(pc.is_valid(states["estimate_m"]), pc.is_valid(states["position_m"])))
    position_m, estimate_m = (_points(states, name) for name in ("position_m", "estimate_m"))
    square, which, count = np.unique(
        np.floor(position_m / PLACE_M), axis=0, return_inverse=True, return_counts=True
    )
    squares = np.bincount(which.ravel(), np.sum((estimate_m - position_m) ** 2, axis=1))
    return square * PLACE_M, np.sqrt(squares / count), count


@styled
def draw_errors_by_place(states: pa.Table, lanes: Array, title: str) -> Figure:
    """Position errors on the map; `lanes` (s, 2, 2) are pieces of the roads in metres."""
    corner_m, error_m, _ = errors_by_place(states)
    figure = Figure(figsize=(9, 8), layout="constrained")
    axes = figure.add_subplot()
    axes.add_collection(LineCollection(list(lanes / 1000), colors="#bbbbbb", linewidths=0.4))
    middle_km = (corner_m + PLACE_M / 2) / 1000
    order = np.argsort(error_m)  # the worst on top
    top_m = max(2.0, np.percentile(error_m, 98))
    dots = axes.scatter(*middle_km[order].T, c=error_m[order], s=9, cmap="viridis", vmin=0, vmax=top_m)
    figure.colorbar(dots, ax=axes, label="RMSE of the position (m)", extend="max", shrink=0.7)
    axes.set(xlabel="east (km)", ylabel="north (km)", aspect="equal", title=title)
    low, high = middle_km.min(axis=0) - 0.2, middle_km.max(axis=0) + 0.2
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    return figure


def errors_picture(states: pa.Table, lanes: Array, out: Path, title: str) -> Path:
    """Write the map of errors; returns the PNG."""
    return save(draw_errors_by_place(states, lanes, title), out)


def _points(states: pa.Table, name: str) -> Array:
    return np.asarray(states[name].combine_chunks().flatten().to_numpy(zero_copy_only=False)).reshape(-1, 2)
