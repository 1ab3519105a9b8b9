"""The declarations of the cooperative positioning programs; docs/how-to/results.md describes such a module."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

CHECKS = (
    "agents.cooperative.checks:check_consensus_mean",
    "agents.cooperative.checks:check_convergence",
    "agents.cooperative.checks:check_bounded_error",
)
REFERENCE = "agents.cooperative.hears_all:HearsAll"
PUBLISHED = "agents.cooperative.declared:paper_rmse"
FIGURES = "agents.cooperative.figures:Figures"


PAPER_RMSE_M = {
    "centralized": {"n1": 0.67, "n2": 0.64, "n3": 0.64},
    "optimized": {"n1": 0.76, "n2": 0.72, "n3": 1.04},
    "random": {"n1": 0.72, "n2": 1.60, "n3": 4.30},
}
"""RMSE in metres by mechanism and network: Table II of Shen, Sun and Zhao, "Semi-Interpenetrating Cooperative
Localization in Connected Vehicle Networks"."""
PAPER_VEHICLES = {"n1": 50, "n2": 38, "n3": 24}
"""Number of vehicles of each network."""
PAPER_RANGE_M = 3000.0
"""Radio range in metres."""


def network_file(network: str) -> str:
    """Return the name of the file with the positions of a network."""
    return f"network_{network}.csv"


def paper_rmse(scene: Mapping[str, Any]) -> dict[str, tuple[str, float]]:
    """Return the paper's result for the network and mechanism of this run, a label and metres, by figure.

    Other runs have none. `scene` is the message of a run's constants (docs/messages.md).
    The network is known by its file's name and its number of vehicles, the mechanism by program and `fusion`.
    """
    scenario = tomllib.loads(scene["scenario"])
    name = Path(scenario["network"].get("path", "")).name
    network = next((each for each in PAPER_VEHICLES if network_file(each) == name), None)
    if network is None or PAPER_VEHICLES[network] != len(scene["node_ids"]) or scene["range_m"] != PAPER_RANGE_M:
        return {}
    program = scenario["program"]
    mechanism = {
        "agents.centralized:main": "centralized",
        "agents.cooperative:main": program["options"].get("fusion", "optimized"),
    }.get(program["entry"])
    if mechanism not in PAPER_RMSE_M:
        return {}
    label = f"the paper's RMSE: {mechanism}, {network.upper()}"
    return {"common_error_rmse_m": (label, PAPER_RMSE_M[mechanism][network])}
