"""The hears-all bound of recorded runs: computed where it exists, below every program, and consistent."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from agents.cooperative.hears_all import lanes_of, reflected_deviation_m, why_no_bound
from emulator.api import simulate_into
from emulator.cells.cells import compute
from emulator.records.metrics import reference_series
from emulator.records.recorded_run import OpenedRun, RecordedRun
from emulator.report.source import Source
from emulator.report.write import report_page
from emulator.scenario.scenario import Scenario
from emulator.world.trips.motion import lateral_offsets_m
from studies.measure import after, study_cell
from vnet.errors import VnetError
from vnet.node import Node

DECLARES = "agents.cooperative.declared"


async def say_fix(node: Node) -> None:
    """Report the fix, and nought for the common error."""
    async for fix in node.gnss:
        node.report(fix.position_m, fix.covariance_m2, common_error_m=[0.0, 0.0])


async def say_nothing(node: Node) -> None:
    """Report only the fix."""
    async for fix in node.gnss:
        node.report(fix.position_m, fix.covariance_m2)


def scenario(**sections: Any) -> Scenario:
    run, program = {"duration_s": 15.0, "settle_s": 0.0}, {"entry": f"{__name__}:say_fix"}
    data: dict[str, Any] = {"run": run, "network": {"vehicles": 12}, "program": program}
    return Scenario.model_validate({**data, **sections})


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> OpenedRun:
    return RecordedRun.open(simulate_into(scenario(), tmp_path_factory.mktemp("bound") / "run"))


def settled_m(recorded: RecordedRun) -> Any:
    return after(reference_series(recorded), 50)["common_error_rmse_m"]


@pytest.mark.slow
def test_the_bound_knows_the_common_error_and_its_own_error(recorded: RecordedRun) -> None:
    bound = reference_series(recorded)
    figures: dict[str, Any] = after(bound, 50)
    assert 0.05 < figures["common_error_rmse_m"] < 1.0
    assert 0.2 < figures["position_rmse_m"] < 1.0
    assert 0.05 < figures["common_error_anees"] < 4, "of one error that hardly changes"
    common_m = bound["common_error_rmse_m"]
    assert common_m[0] > common_m[-1]
    assert bound["component_rmse_m"].shape == (150, 1)
    assert bound["component_rmse_m"][:, 0] == pytest.approx(common_m)


@pytest.mark.slow
def test_a_report_has_the_bound_as_a_line(recorded: OpenedRun) -> None:
    page = report_page(Source(recorded.folder))
    assert "Bound: a Kalman filter that hears every fix of its component" in page
    assert "times the bound" in page


@pytest.mark.slow
def test_a_cell_has_the_figures_of_the_bound(recorded: RecordedRun) -> None:
    figures = compute(study_cell({"seed": 1}, scenario(), 5.0)).figures
    assert figures["reference_common_error_rmse_m"] == pytest.approx(settled_m(recorded))
    assert figures["reference_common_error_rmse_m"] < figures["rmse_m"]


@pytest.mark.slow
def test_a_cell_without_the_bound_has_no_such_figures() -> None:
    city = scenario(network={"kind": "city", "vehicles": 3, "size_m": 1000.0}, run={"duration_s": 1.0})
    assert not [name for name in compute(study_cell({"seed": 1}, city)).figures if name.startswith("reference")]


@pytest.mark.slow
def test_outliers_are_told_to_the_bound(recorded: RecordedRun) -> None:
    plain_m, fix_m = settled_m(recorded), recorded.vectors("fix_m")
    fix_m[40:, 3] += 50.0
    index = recorded.states.schema.get_field_index("fix_m")
    field = recorded.states.schema.field(index)
    states = recorded.states.set_column(index, field, pa.array(fix_m.reshape(-1, 2).tolist(), field.type))
    tables = recorded.trace, states, recorded.metrics
    deceived = RecordedRun(recorded.scenario, *tables, recorded.events, world=recorded.world)
    assert settled_m(deceived) == pytest.approx(plain_m, rel=0.5)


@pytest.mark.parametrize(
    ("sections", "vehicles", "words"),
    [
        ({"network": {"kind": "city", "vehicles": 5}}, 5, "vehicles that drive"),
        ({}, 101, "100 vehicles at most"),
        ({"world": {"common_error": {"gradient_m_per_km": 0.1}}}, 12, "gradient"),
        ({}, 100, ""),
    ],
)
def test_where_there_is_no_bound_the_reason_is_said(sections: dict[str, Any], vehicles: int, words: str) -> None:
    why = why_no_bound(scenario(**sections), vehicles)
    assert (words in why) if words else why == ""


@pytest.mark.slow
def test_a_program_that_says_nothing_of_a_common_error_has_no_bound(tmp_path: Path) -> None:
    silent = scenario(program={"entry": f"{__name__}:say_nothing"}, run={"duration_s": 1.0, "settle_s": 0.0})
    with pytest.raises(VnetError, match="no program reported what the bound is compared with"):
        reference_series(RecordedRun.open(simulate_into(silent, tmp_path / "run")))


def test_each_vehicle_is_put_on_the_nearest_lane_along_its_heading() -> None:
    point_m, heading_rad = np.array([[0.0, 0.0], [0.0, 3.5], [0.0, 0.0]]), np.array([0.0, 0.0, 1.0])
    position_m = np.array([[900.0, 0.5], [-900.0, 3.0], [5.0, 9.0]])
    assert lanes_of(position_m, np.array([0.0, 2 * np.pi, 1.0]), point_m, heading_rad).tolist() == [0, 1, 2]
    with pytest.raises(VnetError, match="no lane"):
        lanes_of(position_m, np.array([0.0, 0.0, 2.0]), point_m, heading_rad)


@pytest.mark.parametrize(("sigma_m", "half_width_m"), [(0.4, 0.85), (5.0, 0.5), (0.1, 2.0)])
def test_the_deviation_of_a_reflected_offset_is_known(sigma_m: float, half_width_m: float) -> None:
    normal = np.random.default_rng(1).standard_normal((4000, 50))
    drawn_m = lateral_offsets_m(normal, sigma_m, 0.9, half_width_m)
    assert reflected_deviation_m(sigma_m, half_width_m) == pytest.approx(drawn_m.std(), rel=0.06)
    assert reflected_deviation_m(0.0, half_width_m) == 0
