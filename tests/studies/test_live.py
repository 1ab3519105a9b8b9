"""A cell of the paper's tables, live: four processes over Zenoh give the numbers of the simulation."""

from dataclasses import replace
from pathlib import Path

import pytest

from emulator.cells.cells import run_cells
from studies import paper

pytestmark = pytest.mark.slow


def test_a_cell_run_over_zenoh_has_the_numbers_of_its_simulation(tmp_path: Path) -> None:
    paper.write_crossing(tmp_path / "crossing.csv")
    whole = paper.table1_cells([1], tmp_path / "crossing.csv")[0]
    run = whole.scenario.run.model_copy(update={"duration_s": 3.0})
    cell = replace(whole, scenario=whole.scenario.model_copy(update={"run": run}), from_s=1.0)
    simulated = run_cells([cell], tmp_path)[0]
    live = run_cells([cell], tmp_path, live=True)[0]
    assert live == simulated
    assert live["metrics_sha256"]
