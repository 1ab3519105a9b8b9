"""Runs whose receivers have multipath, outliers, no headings and a recorded common error: judged, and survived."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emulator.api import simulate_into
from emulator.checks.judge import check_run
from emulator.records.recorded_run import RecordedRun
from emulator.scenario.scenario import Scenario

pytestmark = pytest.mark.slow

ALL_ERRORS = {
    "multipath_sigma_m": 1.0,
    "outlier_probability": 0.02,
    "outlier_m": 60.0,
    "heading_speed_sigma_mps": 0.1,
    "heading_min_speed_mps": 1.0,
}


def simulated(folder: Path, **sections: Any) -> Path:
    data = {"run": {"duration_s": 3.0, "settle_s": 0.0}, "network": {"vehicles": 6}, **sections}
    return simulate_into(Scenario.model_validate(data), folder / "run")


def found(folder: Path, name: str) -> tuple[str, str]:
    (check,) = [each for each in check_run(folder).checks if each.name == name]
    return check.verdict.value, check.text


def test_the_errors_of_the_world_are_told_from_noise_in_the_runs_folder_alone(tmp_path: Path) -> None:
    path = tmp_path / "errors.csv"
    path.write_text("time_s,a_east_m,a_north_m,b_east_m,b_north_m\n0,1,2,2,1\n60,2,2,1,3\n")
    common = {"kind": "file", "path": str(path), "gradient_m_per_km": 0.5}
    fault = {"kind": "gnss_jump", "at_s": 1.0, "duration_s": 1.0, "offset_m": [20.0, 0.0], "nodes": {"count": 1}}
    folder = simulated(tmp_path, world={"gnss": ALL_ERRORS, "common_error": common}, fault=[fault])
    path.unlink()
    assert found(folder, "gnss")[0] == "valid"
    assert found(folder, "effect:gnss_jump-0")[0] == "valid"


def test_errors_that_the_world_does_not_have_are_invalid(tmp_path: Path) -> None:
    folder = simulated(tmp_path, world={"gnss": {"multipath_sigma_m": 1.0}})
    text = (folder / "scenario.toml").read_text()
    (folder / "scenario.toml").write_text(text.replace("multipath_sigma_m = 1.0", "multipath_sigma_m = 0.5"))
    assert found(folder, "gnss")[0] == "invalid"


@pytest.mark.parametrize("exchange", ["information", "particles"])
@pytest.mark.parametrize("network", [{"vehicles": 6}, {"kind": "city", "vehicles": 6, "size_m": 1000.0}])
def test_cooperating_vehicles_cope(tmp_path: Path, exchange: str, network: dict[str, Any]) -> None:
    program = {"entry": "agents.cooperative:main", "options": {"exchange": exchange}}
    folder = simulated(tmp_path, network=network, world={"gnss": ALL_ERRORS}, program=program)
    recorded = RecordedRun.open(folder)
    assert not recorded.event("crashed", "exception", "died")
    error_m = recorded.metrics["position_rmse_m"].to_numpy()[10:]
    assert np.isfinite(error_m).all()
    assert error_m.mean() < 15, "outliers of 60 m are gated"
