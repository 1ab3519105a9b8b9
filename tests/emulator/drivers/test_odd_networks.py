"""Odd but allowed networks: nobody in range, one vehicle, a network in parts, a single particle."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emulator.drivers.simulate import simulate
from emulator.scenario.scenario import Scenario
from tests.support.recorded import prepared

pytestmark = pytest.mark.slow

ODD: dict[str, dict[str, Any]] = {
    "nobody in range": {"radio": {"range_m": 0.001}},
    "one vehicle": {"network": {"vehicles": 1}},
    "in two parts": {"radio": {"links": [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1], [0, 0, 1, 0]]}},
    "one hears, nobody answers": {"radio": {"links": [[0, 1, 1, 1], [0] * 4, [0] * 4, [0] * 4]}},
}


def run(folder: Path, data: dict[str, Any]) -> list[Any]:
    scenario = Scenario.model_validate({"run": {"duration_s": 2.0}, "network": {"vehicles": 4}, **data})
    emulation = prepared(scenario, folder)
    simulate(emulation)
    assert [event for event in emulation.folder.events if event.kind == "crashed"] == []
    assert all(emulation.up.values())
    return emulation.metrics.rows


@pytest.mark.parametrize("odd", ODD)
@pytest.mark.parametrize(
    ("program", "options"),
    [
        ("centralized", {}),
        ("cooperative", {}),
        ("cooperative", {"relay": False, "exchange": "particles"}),
        ("cooperative", {"particles": 1}),
    ],
)
def test_odd_networks_are_run(tmp_path: Path, odd: str, program: str, options: dict[str, Any]) -> None:
    entry = {"entry": f"agents.{program}:main", "options": options}
    rows = run(tmp_path / "run", {**ODD[odd], "program": entry})
    assert len(rows) == 20
    assert all(row.reporting > 0 for row in rows)
    assert all(row.not_finite == 0 for row in rows)
    error = rows[-1].common_error_rmse_m
    assert error is not None and np.isfinite(error)


def test_a_vehicle_by_itself_learns_what_its_road_says(tmp_path: Path) -> None:
    """Across its road it comes to know the error, along it nothing: it must say so."""
    rows = run(tmp_path / "run", {**ODD["one vehicle"], "program": {"entry": "agents.cooperative:main"}})
    assert rows[-1].deviation_m == 0.0
    anees = rows[-1].common_error_anees
    assert anees is not None and anees < 5.0
