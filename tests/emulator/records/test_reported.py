"""Values that programs report by names of their own: columns of the states, and figures of the run."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from emulator.records.metrics import Metrics
from emulator.records.reported import (
    MOST_COLUMNS,
    MOST_DOTTED,
    ReportedFigure,
    ValueColumns,
    figure_text,
    reported_figures,
    value_columns,
)
from emulator.scenario.program import Program
from emulator.world.world import Instant
from vnet.reports import Report, Value

NODES = ["a", "b"]


def states(*periods: dict[str, dict[str, Value]], program: str = "agents.beacon:main") -> pa.Table:
    """States of two vehicles; each period has the values of those who report in it."""
    kept = Metrics(NODES, np.zeros(2, np.intp), 100, Program(entry=program))
    for period, values in enumerate(periods):
        nowhere = np.zeros((2, 2))
        instant = Instant(period, 100 * period, nowhere, np.zeros(2), np.zeros(2), nowhere, np.zeros(2))
        kept.record(instant, [Report(0, node, None, None, said) for node, said in values.items()])
    return kept.states_table()


def test_each_value_is_a_column_of_its_kind(tmp_path: Path) -> None:
    table = states(
        {"a": {"delay_ms": 4.0, "warned": True, "state": "idle"}},
        {"a": {"delay_ms": 5.0, "warned": False}, "b": {"state": "busy"}},
    )
    assert table["delay_ms"].to_pylist() == [4.0, None, 5.0, None]
    assert table["warned"].to_pylist() == [True, None, False, None]
    assert table["state"].to_pylist() == ["idle", None, None, "busy"]
    assert [str(table.schema.field(name).type) for name in ("delay_ms", "warned")] == ["double", "bool"]
    pq.write_table(table, tmp_path / "states.parquet")
    assert value_columns(pq.read_schema(tmp_path / "states.parquet")) == ["delay_ms", "state", "warned"]


def test_numbers_stay_numbers_whatever_else_vehicles_report_by_their_name() -> None:
    table = states({"a": {"x": True, "y": 1.5}, "b": {"x": 2.5, "y": "far"}}, {"a": {"y": True}})
    assert table["x"].to_pylist() == [1.0, 2.5, None, None]
    assert table["y"].to_pylist() == [1.5, None, 1.0, None]
    assert reported_figures(table)["y"].mean == 1.25


def test_lists_and_names_of_vnets_own_have_no_column() -> None:
    table = states(
        {"a": {"many": [1.0, 2.0], "period": 3.0, "mean_m": [4.0, 5.0]}}, program="agents.cooperative:main"
    )
    assert value_columns(table.schema) == []
    assert table["mean_m"].to_pylist() == [[4.0, 5.0], None], "the program declares a column"
    assert dict(table["values"][0].as_py()) == {"many": [1.0, 2.0], "period": [3.0]}


def test_names_with_a_dot_are_figures_like_others() -> None:
    table = states({"a": {"weight.b": 0.5, "state.flow.0/x": "idle"}})
    assert table["weight.b"].to_pylist() == [0.5, None]
    assert table["state.flow.0/x"].to_pylist() == ["idle", None]
    assert reported_figures(table)["weight.b"].mean == 0.5


def test_values_of_each_pair_have_no_column_where_the_program_declares_them() -> None:
    table = states({"a": {"weight.b": 0.5, "rejected.old": 3.0}}, program="agents.cooperative:main")
    assert value_columns(table.schema) == ["rejected.old"]
    assert dict(table["values"][0].as_py()) == {"weight.b": [0.5]}


def test_a_program_that_makes_up_names_has_only_so_many_columns() -> None:
    columns = ValueColumns()
    assert all(columns.put(0, f"x{i}", 1.0) for i in range(MOST_COLUMNS))
    assert not columns.put(0, "one_more", 1.0)
    assert columns.put(0, "x0", 1.0)


def test_figures_of_each_peer_leave_columns_to_others() -> None:
    columns = ValueColumns()
    assert [columns.put(0, f"delay_ms.v{i}", 1.0) for i in range(MOST_COLUMNS)].count(True) == MOST_DOTTED
    assert columns.put(0, "delay_ms.v0", 1.0)
    assert columns.put(0, "sent", 1.0)


def test_figures_count_all_reports_and_each_vehicles_last() -> None:
    periods: list[dict[str, dict[str, Value]]] = [
        {"a": {"n": float(i), "on": i > 5}, "b": {"n": 2.0 * i}} for i in range(11)
    ]
    figures = reported_figures(states(*periods, {"a": {"n": float("nan")}}))
    number = figures["n"]
    assert number.reports == 22 and number.last == pytest.approx(15.0)
    assert number.mean == pytest.approx(7.5)
    assert number.p05 == pytest.approx(np.percentile([*range(11), *range(0, 22, 2)], 5))
    on = figures["on"]
    assert on.is_share and on.mean == pytest.approx(5 / 11) and on.last == 1.0
    assert on.words("on") == ("on", "45.5%", "", "100.0%")


def test_the_figure_of_a_text_is_the_most_frequent_one() -> None:
    figures = reported_figures(states({"a": {"s": "go"}, "b": {"s": "stop"}}, {"a": {"s": "go"}}))
    assert figures["s"] == ReportedFigure(3, text="go", share=2 / 3)
    assert figures["s"].words("light_s")[:2] == ("light (s)", "go (67%)")


def test_nothing_reported_is_no_figure() -> None:
    assert reported_figures(states()) == {}
    assert reported_figures(states({"a": {"x": float("nan")}})) == {}


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.123456, "0.1235"),
        (12.0, "12"),
        (12345.6, "12,346"),
        (None, "–"),
        (float("inf"), "inf"),
        (1e300, "1e+300"),
    ],
)
def test_numbers_are_short(value: float | None, text: str) -> None:
    assert figure_text(value) == text
