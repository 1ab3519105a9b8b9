"""The cells of the paper's tables, the report of the default profile, and cells selected by label."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from emulator.cells.cells import run_cells
from emulator.world.world import build_world
from studies import paper, reports
from studies.paper import PAPER_RANGE_M

pytestmark = pytest.mark.slow

TINY = {"kind": "generated", "vehicles": 4}


def test_the_paper_profile_starts_at_the_truth_and_hears_whom_it_should() -> None:
    scenario = paper.paper_scenario({"kind": "generated", "vehicles": 24}, 1, "optimized")
    world = build_world(scenario)
    options = scenario.program.options
    assert options["start_m"] == world.at(0).common_error_m.tolist()
    assert np.allclose(world.at(0).common_error_m, world.at(99).common_error_m, atol=0.01), "constant over the run"
    position = {node: world.at(0).position_m[i] for i, node in enumerate(world.node_ids)}
    for node, heard in options["hears"].items():
        near = {o for o in position if o != node and np.hypot(*(position[o] - position[node])) <= PAPER_RANGE_M}
        assert abs(len(near) - len(heard)) <= 1 and len(near ^ set(heard)) <= 1  # offsets of centimetres


def made_up(rmse: dict[str, float]) -> list[dict[str, object]]:
    return [
        {
            "network": "n1",
            "mechanism": mechanism,
            "seed": seed,
            "rmse_m": value * seed,
            "deviation_m": 0.1,
            "position_rmse_m": 0.5,
            "component_rmse_m": [value * seed],
            "common_error_anees": 1.0,
            "position_anees": None if mechanism == "bound" else 1.0,
            "bytes": None if mechanism == "bound" else 900.0,
            "divergent": 0,
        }
        for mechanism, value in rmse.items()
        for seed in (1, 2)
    ]


def test_the_default_report_divides_by_the_limit_of_the_same_seeds() -> None:
    text = reports.default_profile(made_up({"bound": 0.2, "optimized": 0.3, "random": 0.4, "none": 0.4}))
    assert "1.50 ± 0.00" in text
    assert "-0.150 ± 0.050 (2 seeds)" in text
    assert "900 B; 0 in 2 runs" in text


def wanted(**rmse: float) -> dict[str, str]:
    """Return the report's table of requirements, on the one network there is."""
    section = reports.default_profile(made_up(rmse)).split("## ")[1]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in section.splitlines() if "|" in line]
    return {row[0]: row[1] for row in rows[2:]}


def test_the_default_report_says_what_is_as_wanted_and_what_is_not() -> None:
    good = wanted(bound=0.2, optimized=0.22, random=0.4, none=0.4)
    assert good["at most 1.35 × the bound"] == "yes: 1.10 ± 0.00"
    assert good["in each component"] == "yes: 1.10"
    assert good["no vehicle diverged"] == "yes: 0 in 2 runs"
    assert good["optimized not worse than random"] == "yes: better"
    assert good["random not worse than none"] == "yes: no difference seen"
    bad = wanted(bound=0.2, optimized=0.3, random=0.2)
    assert bad["at most 1.35 × the bound"] == "**no**: 1.50 ± 0.00"
    assert bad["in each component"] == "**no**: 1.50"
    assert bad["optimized not worse than random"] == "**no**: worse by 0.150 m"
    assert bad["random not worse than none"] == "–"


def test_the_default_experiment_has_one_row_of_one_hop() -> None:
    cells = paper.default_cells({"n1": TINY}, [1, 2])
    mechanisms = [cell.labels["mechanism"] for cell in cells if cell.labels["seed"] == 2]
    assert mechanisms == ["optimized", "random", "none", "optimized, one hop"]
    errors_m = {"common_error_rmse_m": 0.2, "component_rmse_m": [0.2], "position_rmse_m": 0.4}
    bound = {f"reference_{name}": error_m for name, error_m in errors_m.items()}
    row = {
        "network": "n1",
        "mechanism": "none",
        "seed": 2,
        "rmse_m": 0.3,
        "fix_rmse_m": 3.0,
        "reference_common_error_anees": 1.0,
    }
    added = paper.with_bound([{**row, **bound}, {**row, "seed": 3}])
    found = [(each["mechanism"], each["seed"], each["rmse_m"]) for each in added]
    assert found == [("bound", 2, 0.2), ("none", 2, 0.3), ("none", 3, 0.3)]
    options = next(c for c in cells if c.labels["mechanism"] == "optimized, one hop").scenario.program.options
    assert options["relay"] is False and options["exchange"] == "particles"


def test_a_cell_run_over_zenoh_has_the_numbers_of_its_simulation(tmp_path: Path) -> None:
    paper.write_crossing(tmp_path / "crossing.csv")
    whole = paper.table1_cells([1], tmp_path / "crossing.csv")[0]
    run = whole.scenario.run.model_copy(update={"duration_s": 3.0})
    cell = replace(whole, scenario=whole.scenario.model_copy(update={"run": run}), from_s=1.0)
    simulated = run_cells([cell], tmp_path)[0]
    live = run_cells([cell], tmp_path, live=True)[0]
    assert live == simulated
    assert live["metrics_sha256"]
