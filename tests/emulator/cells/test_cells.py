"""Cells: run once, kept by what they depend on, selected by label; and the scenarios of the tables."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from emulator.cells import cells as cells_module
from emulator.cells.cells import Cell, CellResult, compute, read_series, run_cells
from emulator.cli.commands import app
from emulator.experiments import paper, reports
from emulator.experiments.paper_values import PAPER_RANGE_M
from emulator.scenario.scenario import Scenario
from emulator.world.world import build_world
from vnet.errors import VnetError

pytestmark = pytest.mark.slow

TINY = {"kind": "generated", "vehicles": 4}


def tiny_cell(seed: int, **options: object) -> Cell:
    data = {
        "run": {"name": "cell", "seed": seed, "duration_s": 2.0},
        "network": TINY,
        "program": {"entry": "agents.cooperative:main", "options": {"particles": 20, **options}},
    }
    return Cell({"seed": seed}, Scenario.model_validate(data), 1.0)


def test_a_finished_cell_is_not_run_again_and_a_changed_one_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = run_cells([tiny_cell(1), tiny_cell(2)], tmp_path)
    assert [row["seed"] for row in first] == [1, 2]
    assert first[0]["metrics_sha256"] != first[1]["metrics_sha256"]
    assert read_series(tiny_cell(1), tmp_path).num_rows == 20
    asked: list[Cell] = []

    def ask(missing: list[Cell], *_: object) -> list[tuple[Cell, CellResult]]:
        asked.extend(missing)
        return []

    monkeypatch.setattr(cells_module, "each_done", ask)
    assert run_cells([tiny_cell(1), tiny_cell(2)], tmp_path) == first
    assert asked == [], "nothing was missing"
    with pytest.raises(VnetError, match="not the result of a cell"):
        run_cells([tiny_cell(1), tiny_cell(1, fusion="none")], tmp_path)
    assert asked == [tiny_cell(1, fusion="none")]


def test_a_cell_comes_out_the_same_whichever_process_runs_it(tmp_path: Path) -> None:
    in_pool = run_cells([tiny_cell(3)], tmp_path)[0]
    assert in_pool == {"seed": 3} | compute(tiny_cell(3)).figures


def test_a_live_cell_whose_program_cannot_be_imported_is_refused_before_it_starts() -> None:
    scenario = tiny_cell(1).scenario.model_copy(deep=True)
    program = scenario.program.model_copy(update={"entry": "nothing:main"})
    cell = Cell({"seed": 1}, scenario.model_copy(update={"program": program}), 1.0)
    with pytest.raises(VnetError, match=r"cell .*\}: program.entry = 'nothing:main': cannot import"):
        compute(cell, live=True)


def test_a_program_that_raises_ends_the_experiment_and_names_the_cell(tmp_path: Path) -> None:
    with pytest.raises(VnetError, match=r"cell \{'seed': 1\}.*program.options.fusion = 'magic'"):
        run_cells([tiny_cell(1, fusion="magic")], tmp_path)


def test_divergence_is_ten_metres_for_five_seconds_on_end(tmp_path: Path) -> None:
    """Filters that may not move from a wrong start: all vehicles; one second too short: none."""
    stuck = {"start_m": [50.0, 0.0], "start_sigma_m": 0.01, "common_sigma_m": 0.0, "fusion": "none", "relay": False}

    def lasting(duration_s: float) -> Cell:
        cell = tiny_cell(1, **stuck)
        run = cell.scenario.run.model_copy(update={"duration_s": duration_s})
        return Cell(cell.labels, cell.scenario.model_copy(update={"run": run}))

    assert run_cells([lasting(5.0), lasting(4.9)], tmp_path)[0]["divergent"] == 4
    assert run_cells([lasting(4.9)], tmp_path)[0]["divergent"] == 0


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


def test_the_limit_has_one_filter_a_component_and_the_bound_one_over_all() -> None:
    network = {"kind": "generated", "vehicles": 24}
    by_component = np.array(paper.bound_scenario(network, 1, True).radio.links)
    assert np.array_equal(by_component, by_component.T)
    assert 0 < by_component.mean() < 1
    assert np.array(paper.bound_scenario(network, 1, False).radio.links).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["table2", "--networks", "nowhere"], "--networks nowhere: no file network_n1.csv in it"),
        (["table1", "--only", "alpha=3"], "--only alpha=3: write it as label=value with one of seed, weights"),
        (["table1", "--only", "weights=3"], "--only weights=3: no such cell; weights is one of 0.05"),
    ],
)
def test_what_is_mistyped_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], message: str
) -> None:
    monkeypatch.setenv("PYTHONHASHSEED", "0")
    result = CliRunner().invoke(app, ["experiment", *arguments, "--out", str(tmp_path / "out")])
    assert result.exit_code == 2
    assert message in result.output


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
    assert [(each["mechanism"], each["seed"], each["rmse_m"]) for each in added] == [
        ("bound", 2, 0.2),
        ("none", 2, 0.3),
        ("none", 3, 0.3),
    ]
    options = next(c for c in cells if c.labels["mechanism"] == "optimized, one hop").scenario.program.options
    assert options["relay"] is False and options["exchange"] == "particles"
