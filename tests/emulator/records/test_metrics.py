"""Odd reports of programs: each is measured or left out; it never stops a run or its recording."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emulator.records.metrics import Metrics, summarize
from emulator.records.period_figures import program_figures
from emulator.scenario.program import Program
from emulator.stream import beliefs_of, pack
from emulator.world.world import Instant
from vnet.reports import Report, Value

Values = dict[str, Value]
COOPERATIVE = Program(entry="agents.cooperative:main")
"""A program that declares figures of its own."""
POSITION_M = np.array([[0.0, 0.0], [10.0, 0.0]])
INSTANT = Instant(0, 0, POSITION_M, np.zeros(2), np.zeros(2), POSITION_M, np.zeros(2))


def metrics() -> Metrics:
    return Metrics(["a", "b"], np.array([0, 0]), 100_000_000, COOPERATIVE)


def figures_of_one(*reports: Report) -> Any:
    """Return the figures of the only period of a run."""
    kept = metrics()
    kept.record(INSTANT, reports)
    return kept.rows[-1]


@pytest.mark.parametrize("covariance", [(-1.0, 0.0, 0.0, -1.0), (0.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0, -1.0)])
def test_a_covariance_that_is_not_positive_definite_takes_no_part_in_the_anees(
    covariance: tuple[float, float, float, float],
) -> None:
    honest = Report(0, "a", (1.0, 0.0), (1.0, 0.0, 0.0, 1.0))
    broken = Report(0, "b", (0.0, 0.0), covariance)
    assert figures_of_one(broken).position_anees is None
    assert figures_of_one(honest, broken).position_anees == pytest.approx(0.5)


def test_a_number_is_no_list_of_a_column_that_the_program_declares() -> None:
    reports = [Report(0, "a", None, None, {"cloud_m": 1.0}), Report(0, "b", None, None, {"cloud_m": [1.0, 2.0]})]
    beliefs = beliefs_of({"a": 0, "b": 1}, reports, program_figures(COOPERATIVE))
    assert beliefs.lists == {"cloud_m": {"b": [1.0, 2.0]}}


def test_the_hash_is_of_the_content() -> None:
    def record(x_m: float) -> str:
        kept = metrics()
        kept.record(INSTANT, [Report(0, "a", (x_m, 0.0), None)])
        return kept.sha256()

    assert record(1.0) == record(1.0)
    assert record(1.0) != record(float(np.nextafter(1.0, 2.0)))


def test_arrays_cross_as_little_endian_float32() -> None:
    assert pack([[1.0, 2.0]]) == np.array([1, 2], "<f4").tobytes()


def instant(position_m: np.ndarray, common_m: np.ndarray, fix_m: np.ndarray, period: int = 0) -> Instant:
    nothing = np.zeros(len(position_m))
    return Instant(period, period * 100_000_000, position_m, nothing, common_m, fix_m, nothing)


def rms(vectors: np.ndarray) -> float:
    return math.sqrt(sum(x**2 + y**2 for x, y in vectors) / len(vectors))


def anees(errors: np.ndarray, matrices: np.ndarray) -> float:
    squares = [e @ np.linalg.solve(m, e) for e, m in zip(errors, matrices, strict=True)]
    return sum(squares) / len(squares) / 2


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 6))
def test_every_figure_is_the_one_that_its_definition_gives(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    position, fix, estimate, common, stacked, mean = rng.normal(0, 5, (6, count, 2))
    truth = rng.normal(0, 3, 2)
    factor = rng.normal(0, 1, (2, count, 2, 2))
    covariance, common_covariance = factor @ factor.transpose(0, 1, 3, 2) + np.eye(2)
    # The last vehicle is a component of its own wherever there are two of them.
    component = np.array([int(n == count - 1 and count > 1) for n in range(count)])
    reports = [
        Report(0, f"v{n}", tuple(estimate[n]), tuple(covariance[n].ravel()), {
            "common_error_m": common[n].tolist(),
            "common_error_covariance_m2": common_covariance[n].ravel().tolist(),
            "stacked_common_error_m": stacked[n].tolist(),
            "mean_m": mean[n].tolist(),
        })
        for n in rng.permutation(count)
    ]  # fmt: skip
    kept = Metrics([f"v{n}" for n in range(count)], component, 100_000_000, COOPERATIVE)
    kept.record(instant(position, truth, fix), reports)
    found = kept.rows[-1]
    groups = [common[component == label] for label in sorted(set(component))]
    means = [group.mean(axis=0) for group in groups]
    expected = {
        "reporting": count,
        "common_error_rmse_m": rms(common - truth),
        "deviation_m": rms(common - common.mean(axis=0)),
        "bias_m": rms(np.array([common.mean(axis=0) - truth])),
        "stacked_rmse_m": rms(stacked - truth),
        "stacked_deviation_m": rms(stacked - stacked.mean(axis=0)),
        "component_rmse_m": [rms(group - truth) for group in groups],
        "component_deviation_m": [rms(group - group.mean(axis=0)) for group in groups],
        "position_rmse_m": rms(estimate - position),
        "fix_rmse_m": rms(fix - position),
        "consensus_error_m": rms(np.array([mean[n] - means[component[n]] for n in range(count)])),
        "common_error_anees": anees(common - truth, common_covariance),
        "position_anees": anees(estimate - position, covariance),
        "not_finite": 0,
    }
    for name, value in expected.items():
        assert getattr(found, name) == pytest.approx(value, rel=1e-9, abs=1e-12), name


@pytest.mark.slow
@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.integers(1, 30), st.sampled_from([0.0, 0.02, 0.6, 1.0]))
def test_the_figures_of_many_periods_are_those_of_each_bit_by_bit(
    seed: int, vehicles: int, periods: int, missing: float
) -> None:
    rng = np.random.default_rng(seed)
    nodes = [f"v{n}" for n in range(vehicles)]
    together, asked = (Metrics(nodes, np.zeros(vehicles, np.intp), 100_000_000, COOPERATIVE) for _ in range(2))
    component = np.zeros(vehicles, np.intp)
    for period in range(periods):
        if rng.random() < 0.3:
            component = rng.integers(-1, 3, vehicles)
        position, fix = rng.normal(0, 100, (2, vehicles, 2))
        absent = rng.random(vehicles) < missing / 2
        position[absent], fix[absent] = np.nan, np.nan
        reports = [_random_report(rng, node, missing) for node in nodes]
        now = instant(position, rng.normal(0, 3, 2), fix, period)
        for kept in (together, asked):
            kept.record(now, reports, component)
        assert asked.rows[-1].period == period
    assert repr(together.rows) == repr(asked.rows)


def _random_report(rng: np.random.Generator, node: str, missing: float) -> Report:
    """Return a report in which each figure is left out with the probability `missing`."""
    matrix = rng.normal(0, 1, (2, 2))
    covariance = (matrix @ matrix.T).ravel().tolist() if rng.random() < 0.9 else [0.0] * 4
    sizes = {"common_error_m": 2, "stacked_common_error_m": 2, "mean_m": 2}
    values: Values = {name: rng.normal(0, 1, n).tolist() for name, n in sizes.items() if rng.random() >= missing}
    if rng.random() >= missing:
        values["common_error_covariance_m2"] = covariance
    x_m, y_m = rng.normal(0, 1, 2).tolist()
    a, b, c, d = covariance
    return Report(0, node, (x_m, y_m) if rng.random() >= missing else None, (a, b, c, d), values)


def test_who_says_nothing_leaves_nulls_in_both_tables() -> None:
    kept = metrics()
    kept.record(INSTANT, [Report(0, "a", (1.0, 2.0), None)])
    states = kept.states_table().to_pydict()
    assert states["estimate_m"] == [[1.0, 2.0], None]
    for name in ("covariance_m2", "common_error_estimate_m", "common_error_covariance_m2", "mean_m", "cloud_m"):
        assert states[name] == [None, None], name
    row = kept.metrics_table().to_pylist()[0]
    said = {"period", "time_ns", "reporting", "position_rmse_m", "fix_rmse_m", "not_finite"}
    assert {name for name, value in row.items() if value not in (None, [None])} == said
    assert row["reporting"] == 1
    assert row["position_rmse_m"] == pytest.approx(math.sqrt(5))


def test_figures_are_of_those_who_reported() -> None:
    one = Report(0, "a", None, None, {"common_error_m": [3.0, 4.0]})
    figures = figures_of_one(one)
    assert figures.common_error_rmse_m == pytest.approx(5.0)
    assert figures.deviation_m == 0.0
    assert figures.reporting == 1


def test_the_last_report_of_a_period_counts_and_earlier_ones_are_still_looked_at() -> None:
    reports = [Report(0, "a", (float("nan"), 0.0), None), Report(1, "a", (2.0, 0.0), None)]
    figures = figures_of_one(*reports)
    assert figures.position_rmse_m == pytest.approx(2.0)
    assert (figures.reporting, figures.not_finite) == (1, 1)


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("place", ["estimate", "covariance", "value", "list", "common_error_m"])
def test_a_number_that_is_none_is_counted_wherever_it_stands_and_spoils_no_other(number: float, place: str) -> None:
    estimate = (number, 0.0) if place == "estimate" else (10.0, 0.0)
    covariance = (1.0, 0.0, 0.0, number) if place == "covariance" else None
    wrong: dict[str, Values] = {
        "value": {"x": number},
        "list": {"x": [0.0, number]},
        "common_error_m": {"common_error_m": [0.0, number]},
    }
    values = wrong.get(place, {})
    honest = Report(0, "a", (0.0, 3.0), (1.0, 0.0, 0.0, 1.0), {"common_error_m": [0.0, 2.0]})
    kept = metrics()
    kept.record(INSTANT, [honest, Report(0, "b", estimate, covariance, values)])
    figures = kept.rows[-1]
    assert figures.not_finite == 1
    assert figures.common_error_rmse_m == pytest.approx(2.0)
    assert figures.position_rmse_m == pytest.approx(3.0 if place == "estimate" else 3.0 / math.sqrt(2))
    assert figures.position_anees == pytest.approx(4.5)
    assert kept.metrics_table()["not_finite"].to_pylist() == [1]


def test_a_value_of_the_wrong_size_is_left_out() -> None:
    odd: Values = {
        "common_error_m": [1.0, 2.0, 3.0],
        "mean_m": 4.0,
        "cloud_m": 5.0,
        "heard": 6.0,
        "weights": [0.5, 0.5],
    }
    kept = metrics()
    kept.record(INSTANT, [Report(0, "b", None, None, odd)])
    figures = kept.rows[-1]
    assert figures.common_error_rmse_m is figures.consensus_error_m is None
    row = kept.states_table().to_pylist()[1]
    assert row["common_error_estimate_m"] is row["mean_m"] is row["cloud_m"] is None
    assert dict(row["values"]) == {"weights": [0.5, 0.5]} and row["heard"] == 6.0


def test_the_tables_come_back_from_their_files(tmp_path: Path) -> None:
    kept = metrics()
    kept.record(INSTANT, [])
    values: Values = {"common_error_m": [1.0, 2.0], "cloud_m": [1.0, 2.0, 3.0, 4.0], "heard": 1.0}
    kept.record(instant(POSITION_M, np.ones(2), POSITION_M, 1), [Report(0, "b", (1.0, 1.0), None, values)])
    for name, table in (("states", kept.states_table()), ("metrics", kept.metrics_table())):
        pq.write_table(table, tmp_path / name)
        assert pq.read_table(tmp_path / name).to_pylist() == table.to_pylist()
    assert kept.states_table()["period"].to_pylist() == [0, 0, 1, 1]
    assert kept.states_table()["node"].to_pylist() == ["a", "b", "a", "b"]
    assert kept.metrics_table()["time_ns"].to_pylist() == [0, 100_000_000]


@pytest.mark.slow
@given(rows_a_piece=st.integers(1, 9), periods=st.integers(0, 8))
def test_states_do_not_depend_on_how_many_are_packed_at_a_time(rows_a_piece: int, periods: int) -> None:
    tables = []
    for rows in (rows_a_piece, 10_000):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("emulator.records.metrics.ROWS_A_PIECE", rows)
            kept = metrics()
            for period in range(periods):
                said = [Report(0, "a", (1.0, float(period)), None, {"cloud_m": [1.0] * period})]
                kept.record(instant(POSITION_M, np.ones(2), POSITION_M, period), said[: period % 3])
            tables.append(kept.states_table())
    assert tables[0].to_pylist() == tables[1].to_pylist()
    assert tables[0].schema == tables[1].schema


def test_a_summary_passes_over_the_first_fifth_and_what_was_not_reported() -> None:
    kept = metrics()
    for period, x_m in enumerate([1000.0, 1000.0, 1.0, 2.0, None, 3.0, 4.0, None, 5.0, 6.0]):
        estimate = None if x_m is None else (x_m, 0.0)
        kept.record(instant(POSITION_M, np.zeros(2), POSITION_M, period), [Report(0, "a", estimate, None)])
    summary = summarize(kept.rows)
    assert summary["position_rmse_m"] == pytest.approx(3.5)
    assert summary["common_error_rmse_m"] is summary["position_anees"] is None
    assert summarize([]) == {}
