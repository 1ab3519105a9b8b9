"""Charts and maps of what programs report, from a run's folder."""

import numpy as np
import pytest

from emulator.report.drawing import draw_charts
from emulator.report.map_figures import classes
from emulator.report.program_figures import points, program_charts, text_shares, usual_periods
from emulator.report.source import Source
from tests.support.recorded import recorded
from vnet import Node


async def talkative(node: Node) -> None:
    """Report a value of each kind, some of them only now and then."""
    number = int(node.id.removeprefix("v"))
    async for fix in node.gnss:
        await node.radio.broadcast(b"here")
        seconds = fix.time_ns / 1e9
        figures = {"load_percent": 10.0 * number, "debt": -seconds, "same": 1}
        if number > 1:
            figures["late"] = seconds
        if round(10 * seconds) % 3 == 0:
            figures["seldom"] = seconds
        if seconds == 0.5:
            figures["once"] = number
        figures["endless"] = float("inf") if seconds == 0.5 else seconds
        node.report(**figures, warned=seconds > 0.5, state="busy" if seconds > 0.5 else "idle")


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Source:
    """A run of one second."""
    run, network = {"duration_s": 1.0, "settle_s": 0.1}, {"vehicles": 4, "layout": "dense"}
    scenario = {"run": run, "network": network, "program": {"entry": f"{__name__}:talkative"}}
    return Source(recorded(scenario, tmp_path_factory.mktemp("run") / "run"))


@pytest.mark.slow
def test_each_value_has_a_chart(source: Source) -> None:
    charts, missing = draw_charts(program_charts(source))
    found = {chart.title: chart for chart in charts}
    assert missing == {}
    assert set(found) == {"load", "debt", "same", "late", "seldom", "endless", "warned", "state"}, (
        "one point is no curve"
    )
    assert "load (%)" in found["load"].svg and "5 to 95 %" in found["load"].caption
    assert "warned (%)" in found["warned"].svg and "say true" in found["warned"].caption
    assert "busy" in found["state"].svg and "idle" in found["state"].svg
    assert "v02" in found["late"].svg, "v01 never reports it"


def test_a_curve_joins_what_is_reported_now_and_then_and_shows_where_nothing_was() -> None:
    time_s = np.arange(12.0)
    value = np.full(12, np.nan)
    value[[0, 2, 4, 9, 11]] = 1.0, 2.0, 3.0, 4.0, 5.0
    at_s, joined = points(time_s, value, usual_periods(value[:, None]))
    assert np.array_equal(at_s, [0, 2, 4, np.nan, 9, 11], equal_nan=True)
    assert np.array_equal(joined, [1, 2, 3, np.nan, 4, 5], equal_nan=True)
    assert [len(each) for each in points(time_s, np.full(12, np.nan), 1.0)] == [0, 0]


def test_vehicles_that_report_in_turns_have_one_curve() -> None:
    value = np.full((12, 3), np.nan)
    for node in range(3):
        value[node::4, node] = 1.0
    assert usual_periods(value) == 4.0
    at_s, _ = points(np.arange(12.0), value.max(axis=1, initial=-1.0, where=np.isfinite(value)), 4.0)
    assert np.isfinite(at_s).all()
    assert usual_periods(value[:4]) == 1.0, "nobody reports twice"


@pytest.mark.parametrize(
    ("values", "is_boolean", "index", "labels"),
    [
        ([1, 2, 3, 3], False, [0, 1, 2, 2], ["1", "2", "3"]),
        ([0, 11, np.nan], False, [0, 4, -1], ["0 – 1", "2 – 3", "4 – 6", "7 – 8", "9 – 11"]),
        ([-1, 5], False, [0, 4], ["-1", "0", "1 – 2", "3", "4 – 5"]),
        ([0, 0.5, 1], False, [0, 2, 4], ["0 – 0.2", "0.2 – 0.4", "0.4 – 0.6", "0.6 – 0.8", "0.8 – 1"]),
        ([0, 1], True, [0, 1], ["false", "true"]),
        ([0, 1e300], False, [0, 4], ["0 – 2e+299", "2e+299 – 4e+299", "4e+299 – 6e+299", "6e+299 – 8e+299"]),
    ],
)
def test_values_are_classes_that_the_legend_explains(
    values: list[float], is_boolean: bool, index: list[int], labels: list[str]
) -> None:
    found, names = classes(np.array(values, dtype=float), is_boolean)
    assert found.tolist() == index
    assert names[: len(labels)] == labels


def test_shares_of_texts_are_those_of_the_vehicles_that_report(source: Source) -> None:
    shares, texts = text_shares(source, "state")
    assert texts == ["idle", "busy"]
    assert shares.tolist() == [[1.0, 0.0]] * 6 + [[0.0, 1.0]] * 4
