"""The hunt for divergence: its cells, its table, and that it goes on."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from emulator.cells import cells as cells_module
from emulator.records.metrics import anees_band
from studies import divergence, paper
from studies.paper import PAPER_VEHICLES
from tests.support.command_line import app

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
