"""The filter of a vehicle that drives on the map of a city: what lanes say of the common error, and when."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest
from numpy.testing import assert_allclose

from agents.cooperative.cmm.information import NOTHING, Information
from agents.cooperative.cmm.own_vehicle_on_map import OFF_ROAD, OwnVehicleOnMap
from agents.cooperative.cmm.rbpf import Observation, RbpfConfig
from tests.agents.cooperative.cmm.test_city_roads import EAST, NORTH, road_map
from vnet.roads.road_map import RoadMap
from vnet.types import Array

COMMON_M = np.array([2.0, -1.5])
STEADY = RbpfConfig(common_tau_s=1e9, off_road=0.001)
"""Constants of a common error that stays, and of vehicles that are on the road."""


def roads(*lanes: tuple[float, float, float], sigma_m: float = 1.0) -> RoadMap:
    """A map of lanes of 2 km that begin at (x, y) in metres, with a heading."""
    return road_map([(*lane, 2000.0) for lane in lanes], sigma_m)


def fixes(position_m: Iterable[Array], heading_rad: float, seed: int = 1) -> list[Observation]:
    rng = np.random.default_rng(seed)
    return [Observation(p + COMMON_M + rng.standard_normal(2), np.eye(2), heading_rad) for p in position_m]


def standing(seconds: float, at_m: tuple[float, float] = (500.0, 0.0)) -> list[Array]:
    return [np.array(at_m)] * round(10 * seconds)


def driving(seconds: float, at_m: tuple[float, float], heading_rad: float) -> list[Array]:
    ahead = np.array([np.cos(heading_rad), np.sin(heading_rad)])
    return [np.array(at_m) + 1.2 * k * ahead for k in range(round(10 * seconds))]


def run(vehicle: OwnVehicleOnMap, seen: Iterable[Observation]) -> Information:
    """Take all fixes; returns the sum of the increments."""
    total = NOTHING
    for fix in seen:
        total = total.plus(vehicle.step(0.1, fix))
    return total


def vehicle_on(lanes: RoadMap, config: RbpfConfig = STEADY) -> OwnVehicleOnMap:
    return OwnVehicleOnMap(config, lanes, np.random.default_rng(3))


@pytest.mark.slow
@pytest.mark.parametrize("rate_hz", [1, 2, 10])
def test_outliers_along_the_road_are_none_of_its_places_where_fixes_tell_a_speed(rate_hz: int) -> None:
    """It drives with 8 to 16 m/s; one fix in five is 30 m behind or ahead, often two in succession."""
    rng, vehicle = np.random.default_rng(4), vehicle_on(roads((0, 0, EAST)))
    time_s = np.arange(0, 90, 1 / rate_hz)
    speed_m_s, east_m = 12 + 4 * np.sin(time_s / 5), 12 * time_s + 20 - 20 * np.cos(time_s / 5)
    off_m = 30.0 * rng.choice([-1, 0, 1], len(time_s), p=[0.1, 0.8, 0.1])
    off_m[: 2 * rate_hz] = 0
    for true_m, wrong_m, speed in zip(east_m, off_m, speed_m_s.tolist(), strict=True):
        seen_m = np.array([true_m + wrong_m, 0.0]) + COMMON_M + rng.normal(0, 0.5, 2)
        vehicle.step(1 / rate_hz, Observation(seen_m, 0.25 * np.eye(2), EAST, speed_m_s=speed))
        position = vehicle.position_m()
        assert position is not None
        assert abs(position[0][0] + vehicle.estimate_m[0] - COMMON_M[0] - true_m) < 8


def test_who_turns_at_full_speed_is_found_again_at_once_and_a_receiver_that_jumps_is_not() -> None:
    """It drives north from a crossing with 20 m/s, having come from the west; fixes are of 5 Hz."""
    rng, vehicle = np.random.default_rng(4), vehicle_on(roads((0, 0, EAST), (600, 0, NORTH)))
    off_m: list[float] = []
    for period in range(300):
        way_m, jump_m = 4.0 * period, 40.0 if 260 <= period < 268 else 0.0
        true_m = np.array([min(way_m, 600.0), max(way_m - 600.0, 0.0)])
        seen_m = true_m + COMMON_M + (jump_m, jump_m) + rng.normal(0, 1.0, 2)
        heading_rad = NORTH if way_m > 600 else EAST
        speed_m_s = None if period == 259 else 20.0  # the jump is not where nothing leads
        vehicle.step(0.2, Observation(seen_m, np.eye(2), heading_rad, speed_m_s=speed_m_s))
        if (position := vehicle.position_m()) is not None:
            off_m.append(float(np.hypot(*(position[0] + vehicle.estimate_m - COMMON_M - true_m))))
    assert max(off_m[50:156]) < 15 and max(off_m[156:]) < 6


@pytest.mark.slow
def test_a_lane_counts_once_for_a_vehicle_that_stands() -> None:
    """However long it stands, it knows of c across the lane what one lane with its deviation says."""
    sigma_m2 = 1.0**2 + 0.85**2 / 3
    vehicle = vehicle_on(roads((0, 0, EAST)))
    run(vehicle, fixes(standing(3), EAST))
    early = vehicle.estimate_covariance_m2[1, 1]
    run(vehicle, fixes(standing(60), EAST, seed=2))
    late = vehicle.estimate_covariance_m2[1, 1]
    expected = 1 / (1 / 9 + 1 / sigma_m2)
    assert early > late, "its fixes tell where the receiver sees it"
    assert late == pytest.approx(expected, rel=0.2)
    assert vehicle.estimate_covariance_m2[0, 0] == pytest.approx(9, rel=0.1), "along the lane nothing is known"


@pytest.mark.slow
def test_a_way_renews_the_offset() -> None:
    """A long way along one lane says more of c than a short one."""
    variance_m2 = []
    for lateral_m in (1e9, 100.0):
        vehicle = vehicle_on(roads((0, 0, EAST)), RbpfConfig(common_tau_s=1e9, lateral_m=lateral_m))
        run(vehicle, fixes(driving(40, (100, 0), EAST), EAST))
        variance_m2.append(vehicle.estimate_covariance_m2[1, 1])
    assert variance_m2[1] < 0.7 * variance_m2[0]


@pytest.mark.slow
def test_a_vehicle_that_has_turned_knows_both_components_of_c() -> None:
    vehicle = vehicle_on(roads((0, 0, EAST), (300, 0, NORTH), sigma_m=0.3))
    run(vehicle, fixes(driving(15, (120, 0), EAST), EAST))
    assert vehicle.estimate_covariance_m2[0, 0] > 5
    run(vehicle, fixes(driving(15, (300, 5), NORTH), NORTH, seed=2))
    assert np.diag(vehicle.estimate_covariance_m2).max() < 1
    assert np.linalg.norm(vehicle.estimate_m - COMMON_M) < 1.5


@pytest.mark.slow
def test_increments_add_up_to_what_is_known() -> None:
    """Also where lanes compete and less is known than before: that is owed, and taken from what is said later."""
    vehicle = vehicle_on(roads((0, 0, EAST), (0, 7, EAST), (300, 0, NORTH), (310, 0, NORTH)))
    before = vehicle.prior
    total = run(vehicle, fixes(driving(15, (120, 0), EAST), EAST))
    total = total.plus(run(vehicle, fixes(driving(20, (300, 5), NORTH), NORTH, seed=2)))
    known = Information.of(*vehicle.belief)
    sum_of_all = before.plus(total).plus(vehicle.owed)
    assert_allclose(sum_of_all.matrix, known.matrix, atol=1e-6)
    assert_allclose(sum_of_all.vector, known.vector, atol=1e-6)
    assert np.linalg.eigvalsh(vehicle.owed.matrix).max() < 1e-9, "more has been said than is known, and not less"


def test_lanes_compete_until_others_tell_the_common_error() -> None:
    """A vehicle alone cannot tell which of three lanes it is on; what others know of c decides."""
    vehicle = vehicle_on(roads((0, -6, EAST), (0, 0, EAST), (0, 6, EAST), sigma_m=0.5))
    run(vehicle, fixes(driving(10, (100, 0), EAST), EAST))
    assert len(vehicle.lanes) >= 3
    vehicle.absorb(Information.of(COMMON_M, 0.25 * np.eye(2)))
    lanes = vehicle.lanes
    assert max(lanes, key=lambda lane: lanes[lane]) == 1 and lanes[1] > 0.95
    assert_allclose(vehicle.estimate_m, COMMON_M, atol=0.5)


def test_a_vehicle_far_from_all_roads_says_nothing_of_c() -> None:
    vehicle = vehicle_on(roads((0, 0, EAST)))
    total = run(vehicle, fixes(driving(10, (100, 300), EAST), EAST))
    assert_allclose(total.matrix, 0, atol=1e-6)
    assert vehicle.lanes == {OFF_ROAD: 1.0}
    position = vehicle.position_m()
    assert position is not None
    assert_allclose(vehicle.estimate_covariance_m2, 9 * np.eye(2), rtol=0.01)


def test_a_vehicle_that_is_lost_begins_again_where_its_fixes_are() -> None:
    vehicle = vehicle_on(roads((0, 0, EAST)))
    run(vehicle, fixes(standing(3), EAST))
    far = fixes(standing(4, (1500.0, 0.0)), EAST)
    assert not vehicle.step(0.1, far[0]).matrix.any(), "an outlier says nothing"
    run(vehicle, far[1:])
    position = vehicle.position_m()
    assert position is not None and abs(position[0][0] - 1500.0) < 10


def test_a_vehicle_begins_again_only_where_fixes_follow_each_other() -> None:
    vehicle, rng = vehicle_on(roads((0, 0, EAST))), np.random.default_rng(2)

    def drive(east_m: Array, off_m: Array | float = 0.0) -> float:
        for at_m in east_m + off_m:
            seen_m = np.array([at_m, 0.0]) + COMMON_M + rng.normal(0, 0.5, 2)
            vehicle.step(0.5, Observation(seen_m, 0.25 * np.eye(2), EAST, speed_m_s=10.0))
        position = vehicle.position_m()
        assert position is not None
        return float(position[0][0] + vehicle.estimate_m[0] - COMMON_M[0] - east_m[-1])

    assert abs(drive(np.arange(0, 200, 5.0))) < 3
    assert abs(drive(np.arange(200, 240, 5.0), 300.0 * np.tile([1, -1, 2, -2], 2))) < 30
    assert abs(drive(np.arange(1000, 1050, 5.0))) < 3


def test_a_belief_from_outside_replaces_its_own() -> None:
    vehicle = vehicle_on(roads((0, 0, EAST)))
    run(vehicle, fixes(standing(3), EAST))
    vehicle.restart(Information.of(np.array([50.0, 0.0]), np.eye(2)))
    assert_allclose(vehicle.estimate_m, [50.0, 0.0])
    assert vehicle.position_m() is None
    vehicle.absorb(Information.of(COMMON_M, 0.1 * np.eye(2)))
    assert_allclose(vehicle.sample(2000).mean(axis=0), COMMON_M, atol=0.05)
    assert vehicle.step(0.1, None).matrix.any() == np.False_


@pytest.mark.parametrize("sigma_m", [0.0, 0.1])
def test_many_precise_receivers_do_not_drive_c_away(sigma_m: float) -> None:
    """All see the same movement of c between fixes, and each corrects it: added up, that is many times too much."""
    rng, noise_m2 = np.random.default_rng(7), sigma_m**2 * np.eye(2)
    vehicles = [vehicle_on(roads((0, 0, EAST), (0, -200, NORTH), sigma_m=0.5), RbpfConfig()) for _ in range(20)]
    common_m, aside_m = COMMON_M.copy(), rng.normal(0, 0.5, 20)
    for step in range(120):
        common_m += 0.055 * rng.standard_normal(2)
        way_m = np.full(20, 50 + 1.2 * step)
        place_m = np.stack([way_m, aside_m], axis=1)
        place_m[1::2] = place_m[1::2, ::-1]  # every other drives north
        fix_m = place_m + common_m + sigma_m * rng.standard_normal((20, 2))
        said = [
            vehicle.step(0.1, Observation(fix_m[k], noise_m2, (EAST, NORTH)[k % 2]))
            for k, vehicle in enumerate(vehicles)
        ]
        pooled = vehicles[0].prior
        for increment in said:
            pooled = pooled.plus(increment)
        for vehicle in vehicles:
            vehicle.absorb(pooled)
    off_m, covariance_m2 = pooled.moments()[0] - common_m, pooled.moments()[1]
    assert off_m @ np.linalg.solve(covariance_m2, off_m) < 18.4  # of 10⁴ honest ones one is further off
    for k, vehicle in enumerate(vehicles):
        found = vehicle.position_m()
        assert found is not None
        off_m = found[0] - place_m[k]
        assert off_m @ np.linalg.solve(found[1], off_m) < 18.4


@pytest.mark.slow
def test_multipath_that_is_told_is_one_thing_on_all_roads() -> None:
    """Given c, a vehicle that has driven in two directions has seen it whole, and takes it off its position."""
    multipath_m, vehicle = np.array([2.0, -1.0]), vehicle_on(roads((0, 0, EAST), (300, 0, NORTH), sigma_m=0.3))
    vehicle.absorb(Information.of(COMMON_M, 0.01 * np.eye(2)))
    rng = np.random.default_rng(2)
    for at_m, heading_rad in (((120.0, 0.0), EAST), ((300.0, 5.0), NORTH)):
        for place_m in driving(15, at_m, heading_rad):
            fix_m = place_m + COMMON_M + multipath_m + rng.standard_normal(2)
            told = Observation(fix_m, (1 + 2.0**2) * np.eye(2), heading_rad, multipath=(2.0, 1e4))
            vehicle.step(0.1, told)
    found = vehicle.position_m()
    assert found is not None
    off_m, covariance_m2 = found[0] - place_m, found[1]
    assert np.trace(covariance_m2) < 2 and np.linalg.norm(off_m) < 1.5
    assert off_m @ np.linalg.solve(covariance_m2, off_m) < 9.2  # of a hundred honest ones one is further off


@pytest.mark.slow
@pytest.mark.parametrize("common_m", [(6.0, -7.5), (-4.0, 8.0), (1.0, 6.5)])
def test_what_a_vehicle_hears_again_of_itself_changes_nothing(common_m: tuple[float, float]) -> None:
    """Also where it may be on a road or on none, and each fix makes one less likely: that cannot be said."""
    rng = np.random.default_rng(4)
    alone, vehicle = (vehicle_on(roads((0, 0, EAST)), RbpfConfig(common_tau_s=1e9)) for _ in range(2))
    for place_m in driving(40, (50, 0), EAST):
        fix = Observation(place_m + np.array(common_m) + rng.standard_normal(2), np.eye(2), EAST)
        alone.step(0.1, fix)
        said = vehicle.step(0.1, fix)
        vehicle.absorb(vehicle.prior.plus(said))
    assert_allclose(vehicle.estimate_m, alone.estimate_m, atol=0.5)
    assert vehicle.lanes[0] == pytest.approx(alone.lanes[0], abs=0.1)


def test_multipath_that_is_told_now_and_then_leaves_all_finite() -> None:
    """Also where the map has no road at all."""
    for lanes in (roads((0, 0, EAST)), roads()):
        vehicle, said = vehicle_on(lanes), []
        for k, place_m in enumerate(driving(10, (50, 0), EAST)):
            told = (1.0 + k % 3, 60.0) if k % 5 else (0.0, 0.0)
            fix = Observation(place_m + COMMON_M, (1 + told[0] ** 2) * np.eye(2), EAST, multipath=told)
            said.append(vehicle.step(0.1, fix))
        found = vehicle.position_m()
        assert found is not None and np.isfinite([increment.numbers for increment in said]).all()
        assert 0 < np.trace(found[1]) < 2 * (3.0**2 + 3.0**2 + 1 + 1)


def test_a_vehicle_that_begins_again_has_forgotten_its_multipath() -> None:
    vehicle, fresh = vehicle_on(roads((0, 0, EAST))), vehicle_on(roads((0, 0, EAST)))
    vehicle.step(0.1, Observation(np.zeros(2), 5 * np.eye(2), EAST, multipath=(2.0, 60.0)))
    for each in (vehicle, fresh):
        each.restart(Information.of(COMMON_M, np.eye(2)))
    seen = fixes(driving(3, (50, 0), EAST), EAST)
    assert run(vehicle, seen).numbers == run(fresh, seen).numbers
