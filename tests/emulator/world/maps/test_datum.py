"""Calibration of a map against trips: a shift that is known is found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from emulator.world.maps.city import city_roads
from emulator.world.maps.problems import calibrate, residuals
from emulator.world.trips.generate import RIGHT, generate_motion
from emulator.world.trips.motion import Motion
from vnet.errors import ScenarioError
from vnet.roads.road_map import RoadMap
from vnet.types import Array

pytestmark = pytest.mark.slow

NS = 1_000_000_000


def moved(lanes: RoadMap, east_north_m: tuple[float, float] | Array) -> RoadMap:
    return replace(lanes, point_m=lanes.point_m + np.asarray(east_north_m))


@pytest.fixture(scope="module")
def drive() -> tuple[RoadMap, Motion]:
    roads = city_roads(1, 2000)
    return roads.lane_map(), generate_motion("city", roads, 20, 1, 121, NS, RIGHT)


def test_a_shift_is_found_and_how_sure_it_is(drive: tuple[RoadMap, Motion]) -> None:
    lanes, motion = drive
    found = calibrate(residuals(moved(lanes, (1.2, -0.7)), motion))
    assert found.datum_m == pytest.approx([-1.2, 0.7], abs=0.25)
    assert (np.abs(found.datum_m - [-1.2, 0.7]) < 4 * found.error_m + 0.05).all()
    again = calibrate(residuals(moved(moved(lanes, (1.2, -0.7)), found.datum_m), motion))
    assert np.abs(again.datum_m).max() < 0.15, "moved by it, nothing is left"


def test_a_third_of_the_vehicles_on_roads_of_their_own_do_not_count(drive: tuple[RoadMap, Motion]) -> None:
    lanes, motion = drive
    position_m = motion.position_m.copy()
    position_m[:, ::3] += 12.0
    wrong = Motion(motion.node_ids, position_m, motion.heading_rad)
    found = calibrate(residuals(moved(lanes, (1.2, -0.7)), wrong))
    assert found.datum_m == pytest.approx([-1.2, 0.7], abs=0.6)


def test_whoever_strays_all_along_makes_the_shift_less_sure(drive: tuple[RoadMap, Motion]) -> None:
    lanes, motion = drive
    rng, squares = np.random.default_rng(1), []
    for _ in range(5):
        off_m = rng.normal(0, 1.0, (len(motion.node_ids), 2))
        strayed = Motion(motion.node_ids, motion.position_m + off_m, motion.heading_rad)
        found = calibrate(residuals(lanes, strayed))
        squares.append((found.datum_m / found.error_m) ** 2)
    assert 0.3 < np.mean(squares) < 4


def test_too_few_places_are_refused(drive: tuple[RoadMap, Motion]) -> None:
    lanes, motion = drive
    found = residuals(lanes, motion)
    with pytest.raises(ScenarioError, match="squares of 500 m: at least 10 are needed"):
        calibrate(found.of(np.arange(20) == 3))
