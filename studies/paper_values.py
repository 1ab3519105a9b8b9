"""The paper's values, from the program that the paper is about."""

from __future__ import annotations

from collections.abc import Callable

from emulator.scenario.own_functions import load_entry

_VALUES = "agents.cooperative.declared"
PAPER_RMSE_M: dict[str, dict[str, float]] = load_entry(f"{_VALUES}:PAPER_RMSE_M")
PAPER_VEHICLES: dict[str, int] = load_entry(f"{_VALUES}:PAPER_VEHICLES")
PAPER_RANGE_M: float = load_entry(f"{_VALUES}:PAPER_RANGE_M")
network_file: Callable[[str], str] = load_entry(f"{_VALUES}:network_file")
