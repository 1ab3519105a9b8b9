"""The paper's values, from the program that the paper is about."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from emulator.cells.cells import Cell
from emulator.scenario.own_functions import load_entry
from emulator.scenario.scenario import Scenario
from emulator.world.world import build_world
from studies.measure import REFERENCE, study_cell
from vnet.errors import VnetError

COOPERATIVE = "agents.cooperative:main"
_VALUES = "agents.cooperative.declared"
PAPER_RMSE_M: dict[str, dict[str, float]] = load_entry(f"{_VALUES}:PAPER_RMSE_M")
PAPER_VEHICLES: dict[str, int] = load_entry(f"{_VALUES}:PAPER_VEHICLES")
PAPER_RANGE_M: float = load_entry(f"{_VALUES}:PAPER_RANGE_M")
network_file: Callable[[str], str] = load_entry(f"{_VALUES}:network_file")

Labels = dict[str, str | int | float]
BOUND, BOUND_POSITION = f"{REFERENCE}common_error_rmse_m", f"{REFERENCE}position_rmse_m"
"""Columns of a cell's metrics with the hears-all bound's errors."""
PAPER_S = 10.0
DEFAULT_S, SETTLED_S = 100.0, 20.0
CENTRALIZED_PARTICLES = 2000
ALPHAS = (0.05, 0.1, 0.2, 0.4, 0.5, 0.6, 0.8, 0.9, 0.95)
RING = ((0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1), (1, 0, 0, 0))
"""Row i hears column j: vehicle 1 hears 2, 2 hears 3, …"""
DEFAULT_ROWS: dict[str, dict[str, Any]] = {
    "optimized": {"fusion": "optimized"},
    "random": {"fusion": "random"},
    "none": {"fusion": "none"},
}
ONE_HOP_ROWS: dict[str, dict[str, Any]] = {
    "optimized, one hop": {
        "fusion": "optimized",
        "relay": False,
        "exchange": "particles",
        "fusion_interval_s": 0.5,
    }
}


def network_sections(folder: Path | None) -> dict[str, dict[str, Any]]:
    """`[network]` of N1, N2 and N3: the files network_n1.csv … of `folder`, or generated ones."""
    if folder is None:
        return {name: {"kind": "generated", "vehicles": count} for name, count in PAPER_VEHICLES.items()}
    sections = {}
    for name in PAPER_VEHICLES:
        path = (folder / network_file(name)).resolve()
        if not path.is_file():
            raise VnetError(f"--networks {folder}: no file {path.name} in it")
        sections[name] = {"kind": "file", "path": str(path)}
    return sections


def table2_cells(
    networks: dict[str, dict[str, Any]], seeds: Sequence[int], sides: Sequence[int] = (1, 2)
) -> list[Cell]:
    """The paper's profile: centralized, optimized, random and none; lanes bounded on one side, and on two."""
    cells = []
    for network, section in networks.items():
        for side_count in sides:
            for mechanism in ("centralized", "optimized", "random", "none"):
                for seed in seeds:
                    labels: Labels = {"network": network, "sides": side_count, "mechanism": mechanism, "seed": seed}
                    scenario = paper_scenario(section, seed, mechanism, side_count)
                    cells.append(study_cell(labels, scenario))
    return cells


def default_cells(networks: dict[str, dict[str, Any]], seeds: Sequence[int]) -> list[Cell]:
    """vnet's own profile on the same networks; each run has the figures of its bound."""
    cells = []
    for network, section in networks.items():
        for seed in seeds:
            for mechanism, options in (DEFAULT_ROWS | ONE_HOP_ROWS).items():
                labels: Labels = {"network": network, "mechanism": mechanism, "seed": seed}
                cells.append(study_cell(labels, default_scenario(section, seed, options), SETTLED_S))
    return cells


def with_bound(results: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the results with a row of the bound for each network and seed, from a run of the same world."""
    bounds: dict[tuple[Any, Any], dict[str, Any]] = {}
    for row in results:
        if row.get("reference_common_error_rmse_m") is not None:
            bounds[row["network"], row["seed"]] = {
                **dict.fromkeys(row),
                **{name: row[name] for name in ("network", "seed", "fix_rmse_m")},
                "mechanism": "bound",
                "rmse_m": row["reference_common_error_rmse_m"],
                "component_rmse_m": row["reference_component_rmse_m"],
                "deviation_m": 0.0 if len(row["reference_component_rmse_m"]) == 1 else None,
                "position_rmse_m": row["reference_position_rmse_m"],
                "common_error_anees": row["reference_common_error_anees"],
                "divergent": 0,
            }
    return [*bounds.values(), *results]


def table1_cells(seeds: Sequence[int], network: Path) -> list[Cell]:
    """Constant α on the ring, and the optimized weights beside them. `network` is the crossing's file."""
    section = {"kind": "file", "path": str(network.resolve())}
    rules: list[tuple[str, dict[str, Any]]] = [("optimized", {"fusion": "optimized"})]
    rules += [(f"{alpha:g}", {"fusion": "constant", "alpha": alpha}) for alpha in ALPHAS]
    return [
        study_cell(
            {"weights": name, "seed": seed},
            _paper(section, seed, {"profile": "paper", **options}, np.array(RING)),
        )
        for name, options in rules
        for seed in seeds
    ]


def write_crossing(path: Path) -> None:
    """The four vehicles of Table I: two on a road from south to north, two on one from west to east."""
    rows = [(0.0, -60.0, 90), (0.0, 60.0, 270), (-60.0, 0.0, 0), (60.0, 0.0, 180)]
    lines = [f"{i + 1},{x},{y},{np.deg2rad(angle):.9f}" for i, (x, y, angle) in enumerate(rows)]
    path.write_text("\n".join(["id,x_m,y_m,heading_rad", *lines]) + "\n")


def counted_from(duration_s: float) -> float:
    """Return the time from which a run of the default profile counts: SETTLED_S, or two thirds of a short run."""
    return min(SETTLED_S, duration_s * 2 / 3)


def default_scenario(
    network: Mapping[str, Any],
    seed: int,
    options: Mapping[str, Any],
    duration_s: float = DEFAULT_S,
    faults: Sequence[Mapping[str, Any]] = (),
    **program: Any,
) -> Scenario:
    """A cooperative run in the default world, 10 % loss; `program` has other keys of its section."""
    return Scenario.model_validate(
        {
            "run": {"name": "cell", "seed": seed, "duration_s": duration_s, "settle_s": min(5.0, duration_s / 2)},
            "network": network,
            "radio": {"range_m": PAPER_RANGE_M, "loss": 0.1},
            "program": {"entry": COOPERATIVE, "options": options, **program},
            "fault": faults,
        }
    )


def paper_scenario(network: dict[str, Any], seed: int, mechanism: str, sides: int = 1) -> Scenario:
    """One cell of Table II: `mechanism` is centralized or a rule of fusion; lanes are bounded on so many sides."""
    options: dict[str, Any] = {"profile": "paper", "one_sided": sides == 1}
    if mechanism == "centralized":
        return _paper(network, seed, options | {"particles": CENTRALIZED_PARTICLES}, None)
    positions = build_world(Scenario.model_validate({"network": network})).at(0).position_m
    offset = positions[:, None] - positions[None]
    hears = np.hypot(offset[..., 0], offset[..., 1]) <= PAPER_RANGE_M
    np.fill_diagonal(hears, False)
    return _paper(network, seed, options | {"fusion": mechanism}, hears)


def _paper(network: dict[str, Any], seed: int, options: dict[str, Any], hears: Any) -> Scenario:
    """The paper's world: constant errors and offsets. Everybody hears everybody, and `hears` says who counts."""
    data: dict[str, Any] = {
        "run": {"name": "cell", "seed": seed, "duration_s": PAPER_S},
        "network": network,
        "world": {
            "common_error": {"sigma_m": 3.0, "tau_s": 1e9},
            "lateral": {"sigma_m": 0.5, "tau_s": 1e9},
        },
        "program": {"entry": f"agents.{'centralized' if hears is None else 'cooperative'}:main"},
    }
    world = build_world(Scenario.model_validate(data))
    options = options | {"start_m": world.at(0).common_error_m.tolist()}
    if hears is not None:
        options["hears"] = {
            node: [other for other, heard in zip(world.node_ids, row, strict=True) if heard]
            for node, row in zip(world.node_ids, hears, strict=True)
        }
    data["program"]["options"] = options
    data["radio"] = everybody(np.ones((len(world.node_ids),) * 2))
    return Scenario.model_validate(data)


def everybody(linked: Any) -> dict[str, Any]:
    """A radio without loss or cap on which `linked` (N, N) hear each other."""
    links = np.asarray(linked).astype(int).tolist()
    return {
        "links": links,
        "max_peers": len(links),
        "loss": 0.0,
        "max_payload_bytes": 65_000,
        "bitrate_mbps": 1000.0,
    }
