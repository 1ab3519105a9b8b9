"""Runs of standing vehicles whose links are given over time: components, the bound and selectors follow them."""

from __future__ import annotations

from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emulator.api import simulate_into
from emulator.records.metrics import reference_series
from emulator.records.recorded_run import RecordedRun
from emulator.report.figures import degrees, links
from emulator.report.source import Source
from emulator.scenario.scenario import Scenario
from emulator.stream import scene_message
from vnet.node import Node

NAMES = ["v01", "v02", "v03"]
FAULT = {"kind": "loss", "at_s": 0.5, "duration_s": 0.4, "probability": 1.0, "senders": {"degree": [2, 2]}}


DECLARES = "agents.cooperative.declared"


async def disagree(node: Node) -> None:
    """Report a common error that is another one in each vehicle."""
    number = int(node.id[1:])
    async for fix in node.gnss:
        await node.radio.broadcast(b"here")
        node.report(fix.position_m, fix.covariance_m2, common_error_m=[float(number), 0.0])


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of three vehicles that are linked from 0.2 s on, and in which v03 is not any more from 0.7 s on."""
    folder = tmp_path_factory.mktemp("links")
    rows = [f"0.2,{one},{other},0" for one, other in permutations(NAMES, 2)]
    rows += [f"0.7,{one},{other}," for one, other in permutations(NAMES, 2) if "v03" in (one, other)]
    (folder / "links.csv").write_text("time_s,sender,receiver,loss\n" + "\n".join(rows) + "\n")
    data: dict[str, Any] = {
        "run": {"duration_s": 1.5, "settle_s": 0.2},
        "network": {"vehicles": 3},
        "program": {"entry": f"{__name__}:disagree"},
        "radio": {"links": str(folder / "links.csv"), "access_jitter_ms": 0.0},
        "fault": [FAULT],
    }
    return simulate_into(Scenario.model_validate(data), folder / "run")


@pytest.mark.slow
def test_figures_by_component_are_those_of_the_period_s_links(run: Path) -> None:
    deviation_m = RecordedRun.open(run).metrics["component_deviation_m"].to_pylist()
    assert deviation_m[:2] == [[0.0, 0.0, 0.0]] * 2, "everybody is alone"
    assert np.array(deviation_m[2:7]) == pytest.approx(np.full((5, 1), np.sqrt(2 / 3)))
    assert deviation_m[7:] == [[0.5, 0.0]] * 8


@pytest.mark.slow
def test_the_bound_and_the_scene_have_those_in_one_component_that_ever_are_linked(run: Path) -> None:
    recorded = RecordedRun.open(run)
    assert reference_series(recorded)["component_rmse_m"].shape == (15, 1)
    scene = scene_message(recorded.world, recorded.scenario, recorded.scenario_text)
    assert np.frombuffer(scene["component"], "<i2").tolist() == [0, 0, 0]
    assert "one component" in degrees(Source(run)).caption
    _, labels = links(Source(run)).canvas.axes.get_legend_handles_labels()
    assert labels == ["a link"], "links that lose as a table says have no one ratio to expect"


def test_selectors_by_degree_follow_the_links(run: Path) -> None:
    recorded = RecordedRun.open(run)
    lost = recorded.trace.filter(recorded.outcome_is("fault"))
    sent_s = {round(time_ns / 1e9, 1) for time_ns in lost["sent_ns"].to_pylist()}
    assert sent_s == {0.5, 0.6} and set(lost["sender"].to_pylist()) == set(NAMES)
    wrong = [check for check in recorded.record.checks if check.verdict == "invalid"]
    assert not wrong, wrong
