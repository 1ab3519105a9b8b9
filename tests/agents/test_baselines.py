"""The baselines of cooperative positioning, simulated on a small network."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emulator.api import simulate_into
from emulator.records.recorded_run import RecordedRun
from emulator.scenario.scenario import Scenario


def simulated(folder: Path, method: str, **sections: Any) -> RecordedRun:
    data: dict[str, Any] = {
        "run": {"duration_s": 12.0, "settle_s": 0.0},
        "network": {"vehicles": 8},
        "radio": {"loss": 0.1, "range_m": 1e5},
        "program": {"entry": "agents.baselines:main", "options": {"method": method, "particles": 300}},
    }
    return RecordedRun.open(simulate_into(Scenario.model_validate({**data, **sections}), folder / method))


def values(recorded: RecordedRun, name: str) -> np.ndarray:
    return np.asarray(recorded.metrics[name].to_numpy()[60:], dtype=float)


def rms(recorded: RecordedRun, name: str) -> float:
    return float(np.sqrt(np.mean(values(recorded, name) ** 2)))


METHODS = ("alone", "diffusion", "intersection", "differential")


@pytest.mark.slow
def test_they_are_as_good_as_textbooks_say(tmp_path: Path) -> None:
    runs = {method: simulated(tmp_path, method) for method in METHODS}
    common = {method: rms(run, "common_error_rmse_m") for method, run in runs.items()}
    anees = {method: values(run, "common_error_anees").mean() for method, run in runs.items()}
    for run in runs.values():
        assert not run.event("crashed", "exception")
        assert rms(run, "position_rmse_m") < 0.9 * rms(run, "fix_rmse_m")
    for method in METHODS[1:]:
        assert common[method] < 0.5 * common["alone"]
    assert anees["diffusion"] > anees["intersection"], "averaged estimates are not independent"
    assert not runs["alone"].value("bytes").any()
