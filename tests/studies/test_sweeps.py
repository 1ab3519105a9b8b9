"""The sweep of the tempering and the hunt for divergence: their cells, their tables, and that they go on."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from emulator.cells import cells as cells_module
from emulator.cli.commands import app
from emulator.records.metrics import anees_band
from studies import divergence, paper, tempering
from studies.paper_values import PAPER_VEHICLES

pytestmark = pytest.mark.slow

TINY: dict[str, Any] = {"n3": {"kind": "generated", "vehicles": 4}}


def run_small(monkeypatch: pytest.MonkeyPatch, out: Path, name: str) -> str:
    """`vnet experiment NAME` with two seeds of a network of four, two seconds each; returns its table."""
    monkeypatch.setenv("PYTHONHASHSEED", "0")
    monkeypatch.setattr(paper, "network_sections", lambda _: TINY)
    result = CliRunner().invoke(app, ["experiment", name, "--seeds", "2", "--out", str(out)])
    assert result.exit_code == 0, result.output
    return (out / f"{name}.md").read_text()


def refuse_to_run(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(missing: list[object], *_: object) -> list[object]:
        assert not missing, "this has been run already"
        return []

    monkeypatch.setattr(cells_module, "each_done", refuse)


def test_the_tempering_is_swept_once_and_leaves_a_table_its_numbers_and_a_picture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = partial(tempering.tempering_cells, taus_s=(5.0, 20.0), duration_s=2.0)
    monkeypatch.setattr(tempering, "tempering_cells", small)
    text = run_small(monkeypatch, tmp_path, "tempering")
    assert "## bound on N3" in text and "## optimized on N3" in text
    assert "0.12 to 2.79" in text, "the band of two runs"
    rows = pq.read_table(tmp_path / "tempering.parquet").to_pylist()
    assert {(row["mechanism"], row["tau_s"], row["seed"]) for row in rows} == {
        (mechanism, tau_s, seed) for mechanism in ("bound", "optimized") for tau_s in (5.0, 20.0) for seed in (1, 2)
    }
    by_tau = {row["tau_s"]: row["common_error_anees"] for row in rows if row["seed"] == 1}
    assert by_tau[5.0] != by_tau[20.0], "τ has reached the filters"
    assert (tmp_path / "tempering.png").read_bytes().startswith(b"\x89PNG")
    assert "lateral_tau_s of the filter (s)" in (tmp_path / "tempering.svg").read_text()
    refuse_to_run(monkeypatch)
    assert run_small(monkeypatch, tmp_path, "tempering") == text


def test_divergence_is_counted_over_the_seeds_and_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small = partial(divergence.divergence_cells, duration_s=2.0)
    monkeypatch.setattr(divergence, "divergence_cells", lambda networks, seeds, _: small(networks, seeds))
    text = run_small(monkeypatch, tmp_path, "divergence")
    assert "0 of 2 runs had a vehicle that diverged: with 95 % confidence, less than 78 %" in text
    rows = pq.read_table(tmp_path / "divergence.parquet").to_pylist()
    assert [row["seed"] for row in rows] == [1, 2]
    worst = max(rows, key=lambda row: row["rmse_m"])
    assert f"{worst['rmse_m']:.3f} (seed {worst['seed']})" in text
    refuse_to_run(monkeypatch)
    assert run_small(monkeypatch, tmp_path, "divergence") == text


def test_all_networks_run_equally_long() -> None:
    networks = dict.fromkeys(PAPER_VEHICLES, TINY["n3"])
    cells = divergence.divergence_cells(networks, [1, 2], 30.0)
    assert len({cell.digest for cell in cells}) == 2, "all three networks are the same here"
    found = {cell.labels["network"]: (cell.scenario.run.duration_s, cell.from_s) for cell in cells}
    assert found == {"n1": (30.0, 20.0), "n2": (30.0, 20.0), "n3": (30.0, 20.0)}


def test_cooperation_is_swept_on_one_network_and_the_bound_on_all() -> None:
    networks = dict.fromkeys(PAPER_VEHICLES, TINY["n3"])
    cells = tempering.tempering_cells(networks, [1])
    filters = {(cell.labels["network"], cell.labels["mechanism"]) for cell in cells}
    assert filters == {("n1", "bound"), ("n2", "bound"), ("n3", "bound"), ("n3", "optimized")}
    for cell in cells:
        options = cell.scenario.program.options
        assert options["lateral_tau_s"] == cell.labels["tau_s"]
        assert cell.scenario.world.lateral.tau_s == tempering.WORLD_TAU_S, "the world stays as it is"
        assert ("particles" in options) == (cell.labels["mechanism"] == "bound")


def made_up(anees: dict[tuple[str, float], float]) -> list[dict[str, Any]]:
    return [
        {
            "network": network,
            "mechanism": "bound",
            "tau_s": tau_s,
            "seed": seed,
            "rmse_m": 0.2,
            "position_rmse_m": 0.4,
            "common_error_anees": value + spread,
            "position_anees": None,
        }
        for (network, tau_s), value in anees.items()
        for seed, spread in ((1, -0.1), (2, 0.1))
    ]


def test_anees_chooses_what_is_nearest_to_one_over_the_networks() -> None:
    """0.5 is as far from 1 as 2 is."""
    rows = made_up({("n1", 5.0): 1.0, ("n2", 5.0): 3.0, ("n1", 20.0): 1.5, ("n2", 20.0): 0.8})
    assert tempering.chosen_tau_s(rows) == 20.0
    assert tempering.chosen_tau_s(rows, "position_anees") is None
    text = tempering.report(rows)
    assert "nearest to 1 at **τ = 20 s** (N1 5 s: 1.00 ± 0.10; N2 20 s: 0.80 ± 0.10)" in text
    assert "3.00 ± 0.10* |" in text and "1.50 ± 0.10 " in text, "the first is out of the band"


def test_the_band_holds_95_percent_of_the_means_of_consistent_filters() -> None:
    low, high = anees_band(10)
    anees = np.random.default_rng(0).chisquare(2, size=(20_000, 10)).mean(axis=1) / 2
    assert np.mean(anees < low) == pytest.approx(0.025, abs=0.004)
    assert np.mean(anees > high) == pytest.approx(0.025, abs=0.004)


def test_a_run_that_diverged_is_named_and_bounds_nothing() -> None:
    labels = {"network": "n1", "mechanism": "optimized", "duration_s": 30.0, "not_finite": 0, "divergent_sigmas": 2}
    rows = [labels | {"seed": seed, "rmse_m": 0.1 * seed, "divergent": int(seed == 3)} for seed in (1, 2, 3)]
    rows.append(labels | {"seed": 4, "rmse_m": None, "divergent": 0})
    text = divergence.report(rows)
    assert "1 of 4 runs had a vehicle that diverged." in text and "confidence" not in text
    assert "0.200" in text and "0.300 (seed 3)" in text
    assert "8" in text.splitlines()[4].split("|")[7], "vehicles beyond what they state, of four runs"
