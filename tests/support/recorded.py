"""Simulated runs, from the sections of a scenario to a run folder."""

from pathlib import Path
from typing import Any

from emulator.drivers.conclude import conclude
from emulator.drivers.emulation import Emulation
from emulator.drivers.simulate import simulate
from emulator.records.run_folder import RunFolder
from emulator.scenario.scenario import Scenario
from emulator.world.world import build_world


def prepared(scenario: Scenario | dict[str, Any], folder: Path) -> Emulation:
    """Return the emulation of a scenario, which has not begun, with a run folder."""
    scenario = Scenario.model_validate(scenario)
    return Emulation(scenario, build_world(scenario), RunFolder.create(folder, scenario))


def recorded(scenario: Scenario | dict[str, Any], folder: Path) -> Path:
    """Simulate a scenario and judge the run; returns its folder."""
    emulation = prepared(scenario, folder)
    conclude(emulation, simulate(emulation)[0], "simulate")
    return folder
