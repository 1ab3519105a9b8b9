"""The analysis of a network against closed forms, and the cases that have no network worth the name."""

import json
import math
from dataclasses import asdict
from io import StringIO
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from rich.console import Console

from emulator import analyze as subject
from emulator.analyze import FASTEST, analysis_table, analyze, analyze_graph
from emulator.records.period_figures import KeyFigure
from emulator.records.run_folder import FORMAT
from emulator.records.verdicts import Record, Verdict
from emulator.scenario.scenario import Scenario
from vnet.errors import VnetError

RULES = ("constant", "metropolis", "max-degree")
needs_cvxpy = pytest.mark.skipif(not subject.has_cvxpy(), reason="cvxpy is not installed (extra sdp)")


def ring(count: int) -> np.ndarray:
    away = np.abs(np.arange(count)[:, None] - np.arange(count))
    return (away == 1) | (away == count - 1)


def star(leaves: int) -> np.ndarray:
    linked = np.zeros((leaves + 1, leaves + 1), dtype=bool)
    linked[0, 1:] = linked[1:, 0] = True
    return linked


def complete(count: int) -> np.ndarray:
    return ~np.eye(count, dtype=bool)


def apart(*graphs: np.ndarray) -> np.ndarray:
    """Several graphs beside each other, without a link between them."""
    count = sum(map(len, graphs))
    linked = np.zeros((count, count), dtype=bool)
    first = 0
    for graph in graphs:
        linked[first : first + len(graph), first : first + len(graph)] = graph
        first += len(graph)
    return linked


@pytest.fixture(autouse=True)
def without_cvxpy(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same tests whether cvxpy is installed or not; those that need it ask for it."""
    if request.node.get_closest_marker("skipif") is None:
        monkeypatch.setattr(subject, "has_cvxpy", lambda: False)


@pytest.mark.parametrize("count", [5, 8, 13])
def test_ring(count: int) -> None:
    """A circulant matrix: mode k has the eigenvalue (1 + 2 cos(2πk/N)) / 3."""
    found = analyze_graph(ring(count))
    modes = (1 + 2 * np.cos(2 * np.pi * np.arange(1, count) / count)) / 3
    assert found["components"] == [count]
    assert found["degree"] == {"min": 2, "median": 2.0, "max": 2}
    assert found["degree_histogram"] == {2: count}
    assert (found["links"], found["one_way_links"]) == (count, 0)
    assert found["diameter"] == count // 2
    assert found["algebraic_connectivity"] == pytest.approx(2 - 2 * math.cos(2 * math.pi / count))
    for rule in RULES:
        figures = found["rules"][rule]
        assert figures["convergence_factor"] == pytest.approx(np.abs(modes).max())
        assert figures["spectral_gap"] == pytest.approx(1 - np.abs(modes).max())
        assert figures["deviation_variance"] == pytest.approx(np.sum(1 / (1 - modes**2)) / count)


def test_complete_graph_agrees_in_one_round() -> None:
    found = analyze_graph(complete(7))
    assert (found["diameter"], found["links"]) == (1, 21)
    assert found["algebraic_connectivity"] == pytest.approx(7)
    for rule in RULES:
        assert found["rules"][rule]["convergence_factor"] == pytest.approx(0.0, abs=1e-7)
        assert found["rules"][rule]["deviation_variance"] == pytest.approx(6 / 7), "the last round's noise"


def test_star() -> None:
    """Laplacian 0, 1 (leaves against each other), n + 1: with weights 1/(n + 1) the factor is n/(n + 1)."""
    leaves = 6
    found = analyze_graph(star(leaves))
    factor = leaves / (leaves + 1)
    assert found["degree"] == {"min": 1, "median": 1.0, "max": leaves}
    assert found["degree_histogram"] == {1: leaves, leaves: 1}
    assert (found["diameter"], found["algebraic_connectivity"]) == (2, pytest.approx(1.0))
    for rule in RULES:
        figures = found["rules"][rule]
        assert figures["convergence_factor"] == pytest.approx(factor)
        expected = ((leaves - 1) / (1 - factor**2) + 1) / (leaves + 1)
        assert figures["deviation_variance"] == pytest.approx(expected)


def test_one_vehicle_agrees_with_itself() -> None:
    found = analyze_graph(np.zeros((1, 1), dtype=bool))
    assert (found["components"], found["diameter"], found["algebraic_connectivity"]) == ([1], 0, None)
    assert found["degree_histogram"] == {0: 1}
    for rule in RULES:
        figures = found["rules"][rule]
        assert (figures["convergence_factor"], figures["deviation_variance"]) == (0.0, pytest.approx(0.0))


def test_without_links_nobody_comes_together() -> None:
    found = analyze_graph(np.zeros((4, 4), dtype=bool))
    assert (found["components"], found["links"], found["diameter"]) == ([1, 1, 1, 1], 0, 0)
    assert found["algebraic_connectivity"] == 0.0
    for rule in RULES:
        figures = found["rules"][rule]
        assert (figures["convergence_factor"], figures["spectral_gap"]) == (1.0, 0.0)
        assert figures["deviation_variance"] is None, "it grows for ever"
        assert figures["component_convergence_factor"] == [0.0] * 4


def test_a_disconnected_graph_is_the_sum_of_its_parts() -> None:
    found = analyze_graph(apart(complete(3), ring(8), np.zeros((1, 1), dtype=bool)))
    alone = analyze_graph(ring(8))["rules"]
    assert found["components"] == [8, 3, 1], "largest first"
    assert found["diameter"] == 4, "of the ring"
    assert found["algebraic_connectivity"] == pytest.approx(0.0, abs=1e-12)
    for rule in RULES:
        figures = found["rules"][rule]
        assert (figures["convergence_factor"], figures["deviation_variance"]) == (1.0, None)
        parts = zip(figures["component_convergence_factor"], figures["component_deviation_variance"], strict=True)
        ring_alone = alone[rule]["convergence_factor"], alone[rule]["deviation_variance"]
        expected = [ring_alone, (0.0, 2 / 3), (0.0, 0.0)]
        assert list(map(list, parts)) == pytest.approx(np.array(expected), abs=1e-7)


def test_constant_looks_at_the_whole_network_and_max_degree_at_the_component() -> None:
    rules = analyze_graph(apart(star(9), complete(3)))["rules"]
    assert rules["constant"]["component_convergence_factor"][1] == pytest.approx(1 - 3 / 10)
    assert rules["max-degree"]["component_convergence_factor"][1] == pytest.approx(0.0, abs=1e-7)


def test_a_link_of_one_direction_is_none() -> None:
    hears = ring(5)
    hears[0, 1] = False
    found = analyze_graph(hears)
    assert (found["links"], found["one_way_links"], found["diameter"]) == (4, 1, 4), "a chain"


@needs_cvxpy
def test_fastest_mixing_weights_have_the_closed_form_of_edge_transitive_graphs() -> None:
    """One weight for all links is best there: factor (λ_N − λ_2) / (λ_N + λ_2) (Xiao and Boyd 2004, 4.1)."""
    assert analyze_graph(star(6))["rules"][FASTEST]["convergence_factor"] == pytest.approx(6 / 8, abs=1e-5)
    low, high = 2 - 2 * math.cos(2 * math.pi / 8), 4.0
    both = analyze_graph(apart(ring(8), complete(2), np.zeros((1, 1), dtype=bool)))["rules"][FASTEST]
    assert both["component_convergence_factor"][0] == pytest.approx((high - low) / (high + low), abs=1e-5)
    assert both["component_convergence_factor"][1:] == pytest.approx([0.0, 0.0], abs=1e-5)


@needs_cvxpy
def test_nothing_mixes_faster_than_fastest_mixing_weights() -> None:
    rng = np.random.default_rng(3)
    linked = np.triu(rng.random((12, 12)) < 0.3, 1)
    linked |= linked.T | ring(12)
    factors = {name: figures["convergence_factor"] for name, figures in analyze_graph(linked)["rules"].items()}
    assert factors[FASTEST] == min(factors.values())


def test_without_cvxpy_one_line_says_so() -> None:
    found = analyze_graph(ring(4))
    assert FASTEST not in found["rules"]
    assert len(found["left_out"]) == 1
    assert printed(found | {"weak_components": [4]}).count("pip install 'vnet-emulator[sdp]'") == 1
    with pytest.raises(VnetError, match="needs cvxpy"):
        subject.fastest_mixing_matrix(ring(4))


def printed(analysis: dict[str, object]) -> str:
    console = Console(width=160, file=StringIO(), record=True)
    console.print(analysis_table(analysis))
    return console.export_text()


def scenario(links: np.ndarray, **radio: object) -> Scenario:
    return Scenario.model_validate(
        {"network": {"vehicles": len(links)}, "radio": {"links": links.astype(int).tolist()} | radio}
    )


def test_a_scenario_is_seen_with_its_links_and_its_peer_cap() -> None:
    one_way = np.roll(np.eye(4, dtype=bool), 1, axis=1)
    found = analyze(scenario(one_way))
    assert (found["weak_components"], found["components"], found["one_way_links"]) == ([4], [1, 1, 1, 1], 4)
    assert found["lookahead_ms"] == 2.0, "the least latency of the radio"
    assert "lookahead (ms)" in printed(found)
    capped = analyze(scenario(complete(6), max_peers=2))
    assert capped["degree"]["max"] <= 2
    assert capped["one_way_links"] + 2 * capped["links"] == 12, "everybody hears two"


@pytest.mark.slow
def test_a_network_of_the_published_character() -> None:
    """MODEL 4: 260 rounds to 1 % with constant weights and 99 with Metropolis on N1, which this resembles."""
    found = analyze(Scenario.model_validate({"network": {"vehicles": 50}}))
    assert (found["components"], found["degree"]["max"], found["links"]) == ([50], 22, 316)
    factors = {rule: found["rules"][rule]["convergence_factor"] for rule in RULES}
    assert factors["metropolis"] < factors["constant"] == factors["max-degree"] < 1
    text = printed(found)
    assert "2 / 13 / 22" in text and f"{factors['metropolis']:.4f}" in text


def write_metrics(folder: Path, deviation_m: list[float | None]) -> Path:
    pq.write_table(pa.table({"deviation_m": pa.array(deviation_m, pa.float64())}), folder / "metrics.parquet")
    (folder / "scenario.toml").write_text('program.entry = "agents.cooperative:main"\n')
    shown = [KeyFigure("deviation_m", "deviation", of_agreement=True)]
    record = Record(FORMAT, Verdict.VALID, [], [], "", 1.0, 1.0, 1, 7, {}, {}, "", key_figures=shown)
    (folder / "verdict.json").write_text(json.dumps(asdict(record)))
    return folder


def test_a_run_stands_beside_its_analysis(tmp_path: Path) -> None:
    run = write_metrics(tmp_path, [9.0, None, 0.3, 0.4, None, 0.5, 0.3, 0.4, 0.3, 0.4])
    found = analyze(scenario(complete(7)), run)
    settled = np.sqrt(np.mean(np.square([0.3, 0.4, 0.5, 0.3, 0.4, 0.3, 0.4])))
    assert found["measured"]["deviation"] == pytest.approx(settled)
    # Two axes, and a variance of 6/7 of that of the noise.
    assert found["measured"]["noise_m"]["metropolis"] == pytest.approx(settled / np.sqrt(2 * 6 / 7))
    assert f"{settled:.4g} m" in printed(found)


def test_a_run_that_cannot_be_used_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(VnetError, match="not a run's folder"):
        analyze(scenario(ring(4)), tmp_path)
    with pytest.raises(VnetError, match="no deviation_m in it; its program reported nothing"):
        analyze(scenario(ring(4)), write_metrics(tmp_path, [None] * 5))
