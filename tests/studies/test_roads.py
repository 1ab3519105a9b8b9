"""The experiment of roads that nobody tuned on, and its filter that hears all."""

from __future__ import annotations

import numpy as np
import pytest

from agents.cooperative.options import Options
from emulator.cells.cells import compute
from emulator.world.world import build_world
from studies.roads import OneFilter, cities, report, roads_cells

pytestmark = pytest.mark.slow


def small() -> dict[str, dict[str, object]]:
    return {name: {"network": {**place["network"], "vehicles": 6}} for name, place in cities([7]).items()}


def test_one_filter_knows_c_as_well_as_it_says() -> None:
    (cell,) = roads_cells(small(), [1], 10.0, 2.0)
    world = build_world(cell.scenario)
    one = OneFilter(world, Options.parse({}))
    for period in range(world.periods - 1):
        common_m, covariance_m2, position_m = one.step(0.5, world.at(period))
    off_m = common_m - world.at(world.periods - 2).common_error_m
    assert off_m @ np.linalg.solve(covariance_m2, off_m) < 18
    assert np.trace(covariance_m2) < 3.0
    away_m = np.linalg.norm(position_m - world.at(world.periods - 2).position_m, axis=1)
    assert np.nanmedian(away_m) < 3.0


def test_places_are_compared_with_one_filter() -> None:
    cells = roads_cells(small(), [1], 4.0, 2.0)
    rows = [{**cell.labels, **compute(cell).figures} for cell in cells]
    assert all(row["one_filter_rmse_m"] > 0 and row["rmse_m"] > 0 for row in rows)
    assert "city 7" in report(rows, 4.0, 2.0)
