"""The paper's RMSE of the common error on its three networks (its Table II): a reference beside runs of them."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

PAPER_RMSE_M = {
    "centralized": {"network_n1.csv": 0.67, "network_n2.csv": 0.64, "network_n3.csv": 0.64},
    "optimized": {"network_n1.csv": 0.76, "network_n2.csv": 0.72, "network_n3.csv": 1.04},
    "random": {"network_n1.csv": 0.72, "network_n2.csv": 1.60, "network_n3.csv": 4.30},
}
PAPER_VEHICLES = {"network_n1.csv": 50, "network_n2.csv": 38, "network_n3.csv": 24}
PAPER_RANGE_M = 3000.0


def paper_rmse(scene: Mapping[str, Any]) -> tuple[str, float] | None:
    """What the paper found for the network and mechanism of this run: a label and metres; None for any other run.

    The network is known by its file's name and its number of vehicles, the mechanism by program and `fusion`.
    """
    scenario = tomllib.loads(scene["scenario"])
    name = Path(scenario["network"].get("path", "")).name
    if PAPER_VEHICLES.get(name) != len(scene["node_ids"]) or scene["range_m"] != PAPER_RANGE_M:
        return None
    program = scenario["program"]
    mechanism = {
        "agents.centralized:main": "centralized",
        "agents.cooperative:main": program["options"].get("fusion", "optimized"),
    }.get(program["entry"])
    if mechanism not in PAPER_RMSE_M:
        return None
    network = name.removeprefix("network_").removesuffix(".csv").upper()
    return f"the paper's RMSE: {mechanism}, {network}", PAPER_RMSE_M[mechanism][name]
