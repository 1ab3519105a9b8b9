"""Comparisons: what their cells are, and what their report says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from studies.comparisons import STUDIES, comparison_cells, full_ablation, recorded_common, report
from vnet.errors import VnetError

TINY = {"n1": {"kind": "generated", "vehicles": 5}}


@pytest.mark.parametrize("study", STUDIES)
def test_each_study_has_a_cell_for_each_variant_and_seed(study: str) -> None:
    cells = comparison_cells(study, TINY, [1, 2], 100.0)
    variants = STUDIES[study]()
    assert [(cell.labels["mechanism"], cell.labels["seed"]) for cell in cells] == [
        (name, seed) for name in variants for seed in (1, 2)
    ]
    assert len({cell.digest for cell in cells}) == len(cells), "no two are the same run"
    assert all(cell.from_s == 20.0 for cell in cells)


def test_the_full_ablation_has_every_combination() -> None:
    variants = full_ablation()
    assert len(variants) == 2**5
    assert next(iter(variants)) == "information, 200"
    last = variants["particles, no relay, 1000, no heading, no defence"]
    assert last.options["relay"] is False and last.keys == {"world.gnss.heading": False}


def test_churn_takes_vehicles_away_until_the_end() -> None:
    (cell, _) = comparison_cells("churn", TINY, [1], 900.0)
    faults = cell.scenario.fault
    assert {fault.kind for fault in faults} == {"kill"}
    assert [fault.at_s for fault in faults] == [30.0 * k for k in range(1, 30)]


def test_a_recorded_common_error_is_in_all_cells(tmp_path: Path) -> None:
    path = tmp_path / "errors.csv"
    path.write_text("time_s,east_m,north_m\n0,1,1\n100,2,2\n")
    for cell in comparison_cells("baselines", TINY, [1, 2], 50.0, recorded_common(path)):
        common = cell.scenario.world.common_error
        assert (common.path, common.start_s) == (path, 300.0 * (cell.labels["seed"] - 1))
    with pytest.raises(VnetError, match="no such file"):
        recorded_common(tmp_path / "other.csv")


def row(mechanism: str, seed: int, rmse_m: float, **more: Any) -> dict[str, Any]:
    return {
        "network": "n1",
        "mechanism": mechanism,
        "seed": seed,
        "rmse_m": rmse_m,
        "position_rmse_m": 2 * rmse_m,
        "anees_batches": [0.9, 1.1],
        "coverage_95": 0.94,
        "position_coverage_95": None,
        "within_05_m": 0.8,
        "within_15_m": 1.0,
        "converged_s": 3.0,
        "bytes": 120.0,
        "divergent": 0,
        "divergent_sigmas": 1,
        "reference_common_error_rmse_m": 0.2,
        "reference_position_rmse_m": 0.4,
        "reference_common_error_anees": 1.0,
        **more,
    }


def test_a_report_has_ratios_tests_and_their_number() -> None:
    rows = [row("reference", seed, 0.24 + 0.01 * seed) for seed in (1, 2, 3)]
    rows += [row("worse", seed, 0.34 + 0.012 * seed) for seed in (1, 2, 3)]
    text = report("ablation", rows, 100.0)
    assert "| bound     | 0.200 ± 0.000 |" in text
    assert "1.30" in text and "94.0 % / –" in text and "80.0 % / 100.0 %" in text and "0 / 3" in text
    assert "+0.1040 ± 0.0050" in text and "< 0.001" in text
    assert "1 comparisons" not in text
    assert "3 seeds" in text
