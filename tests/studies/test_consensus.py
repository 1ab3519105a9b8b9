"""The consensus study: its cells, its figures, and the one that ratio consensus has to keep."""

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from emulator.analyze import FASTEST, convergence_factor, is_connected, mutual
from emulator.cells.cells import Cell, compute, keep
from studies import consensus as subject
from studies.consensus import (
    LATENCIES_MS,
    LOSSES,
    RULES,
    Study,
    consensus_cells,
    draw,
    graph,
    measured_factor,
    model_error,
    model_matrices,
    one_way_links,
    rounds_to_percent,
    silent_vehicles,
    study_network,
)
from tests.support.cells import compute_here
from vnet.errors import VnetError

pytestmark = pytest.mark.slow

SMALL = {"kind": "generated", "vehicles": 10}


def cell(rule: str, loss: float, rounds: int) -> Cell:
    cells = consensus_cells(SMALL, [1], rounds)
    wanted = {"study": "loss", "rule": rule, "loss": loss}
    return next(c for c in cells if wanted.items() <= c.labels.items())


def relative_error(one: Cell, folder: Path) -> np.ndarray:
    """Run a cell here, without a process of its own."""
    (folder / "cells").mkdir(exist_ok=True)
    keep(one, compute(one), folder / "cells")
    return subject._relative_error(one, folder)


def town() -> np.ndarray:
    """The links of fifty places on a square, connected."""
    place = np.random.default_rng(4).uniform(size=(50, 2))
    linked = np.linalg.norm(place[:, None] - place[None], axis=2) <= 0.3
    np.fill_diagonal(linked, False)
    assert is_connected(linked)
    return linked


def test_ratio_is_within_a_thousandth_of_the_spread_after_150_rounds_of_30_percent_loss(tmp_path: Path) -> None:
    error = relative_error(cell("ratio", 0.3, 150), tmp_path)
    assert len(error) == 151
    assert error[150] < 1e-3


def test_averaging_is_not_because_loss_moves_its_mean(tmp_path: Path) -> None:
    error = relative_error(cell("metropolis", 0.3, 150), tmp_path)
    assert error[150] > 1e-3
    assert error[150] == pytest.approx(error[120], rel=0.01), "it has settled on another mean"


@pytest.mark.parametrize("rule", RULES)
def test_without_loss_it_falls_as_fast_as_the_linear_model(tmp_path: Path, rule: str) -> None:
    error = relative_error(cell(rule, 0.0, 120), tmp_path)
    expected = convergence_factor(model_matrices(graph(SMALL)[1])[rule])
    assert measured_factor(error) == pytest.approx(expected, abs=0.005)


def test_the_cells_are_every_rule_under_every_condition_once() -> None:
    cells = consensus_cells(SMALL, [1, 2])
    assert len(cells) == len({c.digest for c in cells}) == 3 * 2 * (len(LOSSES) + len(LATENCIES_MS) + 2)
    options = [c.scenario.program.options for c in cells if c.labels["study"] == "churn"]
    assert all(len(o["silent"]) == 1 for o in options)
    assert all(c.scenario.period_ns == 100_000_000 for c in cells)


def test_a_tenth_of_the_links_becomes_one_way_and_all_stay_connected() -> None:
    linked = town()
    hears = one_way_links(linked, 1)
    assert (hears & ~hears.T).sum() == round(0.1 * linked.sum() / 2)
    assert not (hears & ~linked).any(), "no link is new"
    assert is_connected(mutual(hears))
    assert (hears != one_way_links(linked, 2)).any()
    assert (hears == one_way_links(linked, 1)).all()


def test_a_chain_has_no_link_to_spare() -> None:
    chain = np.eye(30, k=1, dtype=bool) | np.eye(30, k=-1, dtype=bool)
    assert (one_way_links(chain, 1) == chain).all()


def test_those_who_stay_are_connected() -> None:
    linked = town()
    names = [f"v{number:02d}" for number in range(1, 51)]
    silent = silent_vehicles(names, linked, 3)
    stay = [name not in silent for name in names]
    assert len(silent) == 5
    assert is_connected(linked[np.ix_(stay, stay)])


def test_the_factor_is_the_slope_above_rounding() -> None:
    rounds = np.arange(300)
    error = 0.9**rounds + 0.5**rounds + 1e-13
    assert measured_factor(error) == pytest.approx(0.9, abs=1e-4)
    late = np.where(rounds < 40, np.nan, 0.9**rounds)
    assert measured_factor(late) == pytest.approx(0.9, abs=1e-6)


def test_no_factor_where_nothing_can_be_measured() -> None:
    assert measured_factor(np.full(100, np.nan)) is None
    assert measured_factor(np.full(100, 1e-12)) is None
    assert measured_factor(np.full(100, 0.5)) is None
    assert measured_factor(0.1 ** np.arange(100.0)) is None, "five rounds are too few"


def test_the_linear_model_is_what_random_inputs_come_to() -> None:
    linked = graph(SMALL)[1]
    inputs = np.random.default_rng(0).normal(size=(10, 4000))
    apart = inputs - inputs.mean(axis=0)
    for matrix in model_matrices(linked).values():
        power = np.linalg.matrix_power(matrix, 7)
        mean = power @ inputs / power.sum(axis=1)[:, None]
        expected = np.sqrt(np.mean((mean - inputs.mean(axis=0)) ** 2) / np.mean(apart**2))
        assert model_error(matrix, 7)[7] == pytest.approx(expected, rel=0.05)
        assert model_error(matrix, 7)[0] == pytest.approx(1.0)


def test_rounds_to_a_level_count_to_where_it_stays_below() -> None:
    assert rounds_to_percent(np.array([1.0, 0.005, 0.02, 0.009, 0.001])) == 3
    assert rounds_to_percent(np.array([np.nan, np.nan, 0.001])) == 2
    assert rounds_to_percent(np.array([1.0, 0.5])) is None


def test_a_study_leaves_a_table_its_numbers_and_a_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compute_here(monkeypatch)
    monkeypatch.setattr(subject, "has_cvxpy", lambda: False)
    monkeypatch.setattr(subject, "LOSSES", (0.0, 0.3))
    monkeypatch.setattr(subject, "LATENCIES_MS", (150.0,))
    places = [(0, 0), (2000, 0), (4000, 0), (2000, 2000), (0, 2000)]
    rows = [f"v{number},{x},{y},0" for number, (x, y) in enumerate(places)]
    (tmp_path / "five.csv").write_text("\n".join(["id,x_m,y_m,heading_rad", *rows]))
    network = {"kind": "file", "path": str(tmp_path / "five.csv")}
    text = study_network(network, [1], tmp_path, rounds=55)
    results = pq.read_table(tmp_path / "consensus.parquet").to_pylist()
    assert len(results) == 3 * (2 + 1 + 2)
    assert {"study", "rule", "loss", "latency_ms", "seed", "convergence_factor"} <= set(results[0])
    assert {"error_50", "error_55"} <= set(results[0])
    assert "| loss 30% | ratio | " in text and "| delay 150 ms | metropolis | " in text
    assert "| one-way links | max-degree | " in text and "| churn | ratio | " in text
    assert text.count("needs cvxpy") == 1
    assert (tmp_path / "consensus.png").read_bytes().startswith(b"\x89PNG")
    svg = (tmp_path / "consensus.svg").read_text()
    assert "rounds, one every 0.1 s" in svg and "ratio, measured" in svg
    store = {file: file.stat().st_mtime_ns for file in (tmp_path / "cells").iterdir()}
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda *_, **__: None)  # nobody looks at it again
    assert study_network(network, [1], tmp_path, rounds=55) == text
    assert {file: file.stat().st_mtime_ns for file in (tmp_path / "cells").iterdir()} == store, "no run twice"


def test_the_reference_is_drawn_where_there_is_one(tmp_path: Path) -> None:
    linked = graph(SMALL)[1]
    models = model_matrices(linked) | {FASTEST: np.full((10, 10), 0.1)}
    labels = [{"study": "loss", "rule": rule, "loss": loss, "seed": 1} for rule in RULES for loss in LOSSES]
    errors = [model_error(models["metropolis"], 160)] * len(labels)
    draw(Study(linked, labels, errors), models, tmp_path / "figure")
    assert f"{FASTEST} weights, linear model" in (tmp_path / "figure.svg").read_text()


def test_a_network_in_parts_has_no_one_mean(tmp_path: Path) -> None:
    with pytest.raises(VnetError, match="needs a network that is connected"):
        study_network({"kind": "generated", "vehicles": 24}, [1], tmp_path)
