"""Cells: run once, and kept by what they depend on."""

from pathlib import Path

import pytest

from emulator.cells import cells as cells_module
from emulator.cells.cells import Cell, CellResult, compute, read_series, run_cells
from emulator.scenario.scenario import Scenario
from studies.measure import study_cell
from vnet.errors import VnetError

pytestmark = pytest.mark.slow

TINY = {"kind": "generated", "vehicles": 4}


def tiny_cell(seed: int, **options: object) -> Cell:
    data = {
        "run": {"name": "cell", "seed": seed, "duration_s": 2.0},
        "network": TINY,
        "program": {"entry": "agents.cooperative:main", "options": {"particles": 20, **options}},
    }
    return study_cell({"seed": seed}, Scenario.model_validate(data), 1.0)


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


def test_the_folder_of_a_run_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "verdict.json").touch()
    with pytest.raises(VnetError, match="this is a run's folder"):
        run_cells([tiny_cell(1)], tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["verdict.json"]


def test_a_live_cell_whose_program_cannot_be_imported_is_refused_before_it_starts() -> None:
    scenario = tiny_cell(1).scenario.model_copy(deep=True)
    program = scenario.program.model_copy(update={"entry": "nothing:main"})
    cell = study_cell({"seed": 1}, scenario.model_copy(update={"program": program}), 1.0)
    with pytest.raises(VnetError, match=r"cell .*\}: program.entry = 'nothing:main': cannot import"):
        compute(cell, live=True)


def test_a_program_that_ends_its_process_is_a_row(tmp_path: Path) -> None:
    run, entry = {"name": "cell", "duration_s": 2.0, "settle_s": 0.5}, "tests.emulator.testing.programs:faulty"
    data = {"run": run, "network": TINY, "program": {"entry": entry}}
    (row,) = run_cells([Cell({"seed": 1}, Scenario.model_validate(data))], tmp_path)
    assert (row["verdict"], row["failed"]) == ("invalid", "agents_alive")
    assert "SIGSEGV" in row["failure"]


def test_a_program_that_raises_ends_the_experiment_and_names_the_cell(tmp_path: Path) -> None:
    with pytest.raises(VnetError, match=r"cell \{'seed': 1\}.*program.options.fusion = 'magic'"):
        run_cells([tiny_cell(1, fusion="magic")], tmp_path)


def test_divergence_is_ten_metres_for_five_seconds_on_end(tmp_path: Path) -> None:
    """Filters that may not move from a wrong start: all vehicles; one second too short: none."""
    stuck = {"start_m": [50.0, 0.0], "start_sigma_m": 0.01, "common_sigma_m": 0.0, "fusion": "none", "relay": False}

    def lasting(duration_s: float) -> Cell:
        cell = tiny_cell(1, **stuck)
        run = cell.scenario.run.model_copy(update={"duration_s": duration_s})
        return study_cell(cell.labels, cell.scenario.model_copy(update={"run": run}))

    assert run_cells([lasting(5.0), lasting(4.9)], tmp_path)[0]["divergent"] == 4
    assert run_cells([lasting(4.9)], tmp_path)[0]["divergent"] == 0
