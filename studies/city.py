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

from emulator.cells.cells import Cell, has_states, read_states
from emulator.scenario.loading import checked_scenario
from emulator.scenario.scenario import Scenario
from emulator.world.world import build_world
from studies.figures import ERROR_COLUMNS, against_time, save, series_of, styled
from studies.measure import study_cell
from studies.paper import PAPER_RANGE_M, SETTLED_S, everybody
from studies.reports import MISSING, Result, column, in_seeds, markdown_table, mean_and_error, select, unique
from vnet.errors import VnetError
from vnet.types import Array

LOSS = 0.1
CENTRALIZED_PARTICLES = 4000
"""Particles of the filter that hears all: fewer are sure of what they cannot know."""
MECHANISMS: dict[str, dict[str, Any]] = {
    "optimized": {"fusion": "optimized"},
    "random": {"fusion": "random"},
    "max-degree": {"fusion": "max-degree"},
    "metropolis": {"fusion": "metropolis"},
    "constant 0.5": {"fusion": "constant", "alpha": 0.5},
    "none": {"fusion": "none"},
}
"""Options of each mechanism that is not centralized."""
KEPT = "optimized"
"""Mechanism whose states of the first seed are kept for the map of errors."""
VEHICLES = 50
MAX_ACCELERATION_MPS2 = 10.0
"""Jumps of recorded trips that need more are cut, and never driven."""
PLACE_M = 50.0
"""The map of errors has squares of this side."""


def place(
    trips: Path | None, roads: Path | None, section: Mapping[str, Any], impossible_trips: str = "leave_out"
) -> dict[str, Any]:
    """The sections `network` and `map` of scenarios: of files, or of a generated city.

    `section` are the other keys of `map`.

    Raises VnetError unless both trips and roads are given, and from files that are there; and for options of theirs
    without them.
    """
    if trips is None and roads is None:
        if any(section.values()) or impossible_trips != "leave_out":
            raise VnetError("--map-sigma, --map-aside, --map-datum…, --refuse-impossible need --trips and --map")
        return {"network": {"kind": "city", "vehicles": VEHICLES}}
    for option, path in (("--trips", trips), ("--map", roads)):
        if path is None:
            raise VnetError(f"{option} is missing: trips and their map are needed together")
        if not path.is_file():
            raise VnetError(f"{option} {path}: no such file")
    return {
        "network": {
            "kind": "trips",
            "path": str(trips and trips.resolve()),
            "impossible_trips": impossible_trips,
            "max_acceleration_mps2": MAX_ACCELERATION_MPS2,
        },
        "map": {"path": str(roads and roads.resolve()), **section},
    }


def city_cells(place: Mapping[str, Any], seeds: Sequence[int], duration_s: float) -> list[Cell]:
    """One filter that hears all, and each mechanism; `place` are the sections `network` and, if any, `map`."""
    return [
        study_cell(
            {"mechanism": mechanism, "seed": seed},
            city_scenario(place, seed, mechanism, duration_s),
            min(SETTLED_S, duration_s / 2),
            mechanism == KEPT and seed == seeds[0],
        )
        for seed in seeds
        for mechanism in ("centralized", *MECHANISMS)
    ]


def notes(place: Mapping[str, Any], duration_s: float) -> tuple[str, ...]:
    """Lines for the user about the trips that are omitted, with the reason. Raises ScenarioError for a bad file."""
    data = {"run": {"duration_s": duration_s, "settle_s": 0.0}, **place}
    return build_world(checked_scenario(data)).notes


def city_scenario(place: Mapping[str, Any], seed: int, mechanism: str, duration_s: float) -> Scenario:
    """One run. Raises ScenarioError if there is no such place."""
    data: dict[str, Any] = {
        "run": {"name": "cell", "seed": seed, "duration_s": duration_s, "settle_s": 0.0},
        **place,
        "radio": {"range_m": PAPER_RANGE_M, "loss": LOSS},
        "program": {"entry": "agents.cooperative:main", "options": MECHANISMS.get(mechanism, {})},
    }
    if mechanism == "centralized":
        count = len(build_world(checked_scenario(data)).node_ids)
        data["radio"] = everybody(np.ones((count, count)))
        data["program"] = {"entry": "agents.centralized:main", "options": {"particles": CENTRALIZED_PARTICLES}}
    return checked_scenario(data)


def report(results: Sequence[Result], duration_s: float) -> str:
    """Errors, consistency and cost of each mechanism, in Markdown, and of the raw fixes."""
    header = ["mechanism", "common error [m]", "its median", "deviation [m]", "position [m]", "its median"]
    header += ["ANEES common error", "its median", "ANEES position", "bytes a period", "diverged"]
    rows = []
    for mechanism in unique(results, "mechanism"):
        found = select(results, mechanism=mechanism)
        size = [row["bytes"] for row in found if row["bytes"] is not None]
        rows.append(
            [
                mechanism,
                mean_and_error(column(found, "rmse_m")),
                _median(found, "median_error_m"),
                mean_and_error(column(found, "deviation_m")),
                mean_and_error(column(found, "position_rmse_m")),
                _median(found, "median_position_error_m"),
                mean_and_error(column(found, "common_error_anees"), 2),
                _median(found, "median_anees", 2),
                mean_and_error(column(found, "position_anees"), 2),
                f"{np.mean(size):.0f}" if size else MISSING,
                str(sum(column(found, "divergent"))),
            ]
        )
    fixes = mean_and_error(column(select(results, mechanism=results[0]["mechanism"]), "fix_rmse_m"))
    rows.append(["raw fixes", *[MISSING] * 3, fixes, *[MISSING] * (len(header) - 5)])
    return (
        "# Driving through a city\n\n"
        f"{markdown_table(header, rows)}\n\n"
        f"RMSE from {min(SETTLED_S, duration_s / 2):g} s on, of {duration_s:g} s; "
        f"{in_seeds(len(unique(results, 'seed')))}; {100 * LOSS:g} % loss. `centralized` is one "
        f"filter of {CENTRALIZED_PARTICLES} particles that hears every fix. Medians are those of all vehicles and "
        "periods: a few that are far off do not move them.\n"
    )


def _median(rows: Sequence[Result], name: str, digits: int = 3) -> str:
    """Return the mean over the seeds of a median within each run, with its standard error."""
    return mean_and_error([row.get(name) for row in rows], digits)


def errors_by_place(states: pa.Table) -> tuple[Array, Array]:
    """Squares of the map (n, 2), by their corners in metres, and RMSE (n,) of the positions in them."""
    states = states.filter(pc.and_(pc.is_valid(states["estimate_m"]), pc.is_valid(states["position_m"])))
    position_m, estimate_m = (_points(states, name) for name in ("position_m", "estimate_m"))
    square, which, count = np.unique(
        np.floor(position_m / PLACE_M), axis=0, return_inverse=True, return_counts=True
    )
    squares = np.bincount(which.ravel(), np.sum((estimate_m - position_m) ** 2, axis=1))
    return np.asarray(square * PLACE_M), np.asarray(np.sqrt(squares / count))


@styled
def draw_errors_by_place(states: pa.Table, lanes: Array, title: str) -> Figure:
    """Position errors on the map; `lanes` (s, 2, 2) are pieces of the roads in metres."""
    corner_m, error_m = errors_by_place(states)
    figure = Figure(figsize=(9, 8), layout="constrained")
    axes = figure.add_subplot()
    axes.add_collection(LineCollection(list(lanes / 1000), colors="0.733", linewidths=0.4))
    middle_km = (corner_m + PLACE_M / 2) / 1000
    order = np.argsort(error_m)  # the worst on top
    top_m = max(2.0, np.percentile(error_m, 98))
    east_km, north_km = middle_km[order].T
    dots = axes.scatter(east_km, north_km, c=error_m[order], s=9, cmap="viridis", vmin=0, vmax=top_m)
    figure.colorbar(dots, ax=axes, label="RMSE of the position (m)", extend="max", shrink=0.7)
    axes.set(xlabel="east (km)", ylabel="north (km)", aspect="equal", title=title)
    low, high = middle_km.min(axis=0) - 0.2, middle_km.max(axis=0) + 0.2
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    return figure


def draw_against_time(cells: Sequence[Cell], folder: Path) -> Path:
    """Errors of each mechanism against time; returns the PNG."""
    series = series_of(cells, folder)
    return against_time(series, folder / "city_against_time", "Driving through a city", columns=ERROR_COLUMNS)


def draw_errors(cells: Sequence[Cell], folder: Path) -> Path | None:
    """Draw the position errors of the kept run on the map; return the PNG's path, None without that run."""
    kept = next(cell for cell in cells if cell.keeps_states)
    if not has_states(kept, folder):
        return None
    lanes = build_world(kept.scenario).lane_map
    start_m, ahead = lanes.point_m, np.column_stack([np.cos(lanes.heading_rad), np.sin(lanes.heading_rad)])
    pieces = np.stack([start_m, start_m + lanes.length_m[:, None] * ahead], axis=1)
    figure = draw_errors_by_place(read_states(kept, folder), pieces, f"{KEPT}: where positions are wrong")
    return save(figure, folder / "city_errors")


def _points(states: pa.Table, name: str) -> Array:
    return np.asarray(states[name].combine_chunks().flatten().to_numpy(zero_copy_only=False)).reshape(-1, 2)
