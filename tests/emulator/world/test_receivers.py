"""GNSS receivers: multipath, outliers, headings by speed, and common errors from a file or with a gradient."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from emulator.records.recorded_world import RecordedWorld
from emulator.scenario.loading import input_digests, load_scenario
from emulator.scenario.scenario import Scenario
from emulator.world.world import World, build_world
from vnet.errors import ScenarioError
from vnet.types import Array

TWO_RECEIVERS = "time_s,a_east_m,a_north_m,b_east_m,b_north_m,satellites\n0,1,2,3,0,7\n30,3,2,1,4,7\n60,0,0,0,0,8\n"


def world_of(gnss: dict[str, Any], duration_s: float = 200.0, **sections: dict[str, Any]) -> World:
    data: dict[str, Any] = {"run": {"duration_s": duration_s}, "network": {"vehicles": 10}, "world": {"gnss": gnss}}
    data["world"] |= sections.pop("world", {})
    return build_world(Scenario.model_validate(data | sections))


def errors_m(world: World) -> Array:
    """Return what fixes have beyond truth and common error (K, N, 2)."""
    instants = [world.at(period) for period in range(world.periods)]
    return np.array([each.fix_m - each.position_m - each.common_error_m for each in instants])


@pytest.mark.slow
def test_multipath_is_each_vehicles_own_and_stays_for_its_time() -> None:
    quiet = {"sigma_m": 0.0, "multipath_sigma_m": 1.5, "multipath_tau_s": 2.0}
    error_m = errors_m(world_of(quiet, 1000.0)).reshape(-1, 20)
    assert error_m.std(axis=0) == pytest.approx(np.full(20, 1.5), rel=0.15)
    later = np.mean(error_m[20:] * error_m[:-20]) / np.mean(error_m**2)
    assert later == pytest.approx(math.exp(-1), abs=0.05)
    assert np.abs(np.corrcoef(error_m.T) - np.eye(20)).max() < 0.2, "vehicles and axes are independent"


@pytest.mark.slow
def test_multipath_leaves_the_noise_as_it_is() -> None:
    plain, with_multipath = errors_m(world_of({})), errors_m(world_of({"multipath_sigma_m": 1.0}))
    added = with_multipath - plain
    assert_allclose(added, errors_m(world_of({"sigma_m": 0.0, "multipath_sigma_m": 1.0})), atol=1e-9)


def test_outliers_come_as_often_and_are_as_far_off_as_configured() -> None:
    error_m = errors_m(world_of({"sigma_m": 0.0, "outlier_probability": 0.05, "outlier_m": 40.0}))
    away_m = np.linalg.norm(error_m, axis=2)
    is_outlier = away_m > 1
    assert is_outlier.mean() == pytest.approx(0.05, abs=0.005)
    assert away_m[is_outlier] == pytest.approx(40.0)
    assert np.linalg.norm(error_m[is_outlier].mean(axis=0)) < 3, "in any direction"


@pytest.mark.parametrize(("covariance", "variance_m2"), [("noise", 1.0), ("total", 5.0)])
def test_fixes_state_their_multipath_if_they_are_to(covariance: str, variance_m2: float) -> None:
    world = world_of({"multipath_sigma_m": 2.0, "covariance": covariance}, 1.0)
    assert_allclose(world.fix(0, 0).covariance_m2, variance_m2 * np.eye(2))


def _accelerating(folder: Path) -> dict[str, Any]:
    """Return a network of one vehicle that stands for 10 s and then drives east, faster by 1 m/s in each second."""
    rows = [(t, 0.0 if t < 10 else 0.5 * (t - 10) ** 2) for t in range(41)]
    path = folder / "trip.csv"
    path.write_text("id,time_s,x_m,y_m,heading_rad\n" + "".join(f"a,{t},{x},0,0.5\n" for t, x in rows))
    return {"kind": "trips", "path": str(path)}


@pytest.mark.slow
def test_headings_are_the_noisier_the_slower_a_vehicle_drives(tmp_path: Path) -> None:
    gnss = {"heading_sigma_rad": 0.0, "heading_speed_sigma_mps": 0.2}
    errors = []
    for seed in range(15):
        world = world_of(gnss, 40.0, network=_accelerating(tmp_path), run={"duration_s": 40.0, "seed": seed})
        heading = np.array([world.at(period).fix_heading_rad[0] for period in range(world.periods)])
        errors.append(np.mod(heading - 0.5 + np.pi, 2 * np.pi) - np.pi)
    deviation = np.std(errors, axis=0)
    assert deviation[145:155].mean() == pytest.approx(0.2 / 4.5, rel=0.2)
    assert deviation[345:355].mean() == pytest.approx(0.2 / 24.5, rel=0.2)
    assert deviation[:95].mean() > 1.5, "of a vehicle that stands it says nothing"


def test_a_vehicle_that_is_too_slow_has_no_heading(tmp_path: Path) -> None:
    world = world_of({"heading_min_speed_mps": 5.0}, 40.0, network=_accelerating(tmp_path))
    known = [world.fix(period, 0).heading_rad is not None for period in range(world.periods)]
    assert not any(known[:140])
    assert all(known[160:-1])
    for period in (0, 200):
        assert np.isfinite(world.at(period).fix_heading_rad[0]) == known[period]


def test_vehicles_on_straight_lanes_stand() -> None:
    assert world_of({"heading_min_speed_mps": 0.1}, 1.0).fix(5, 3).heading_rad is None


# The common error.


def recorded(folder: Path, text: str, **common: Any) -> dict[str, Any]:
    path = folder / "errors.csv"
    path.write_text(text)
    return {"common_error": {"kind": "file", "path": str(path), **common}}


def test_a_recorded_error_is_common_and_linear_between_its_rows(tmp_path: Path) -> None:
    common = recorded(tmp_path, "time_s,east_m,north_m\n100,1,-1\n110,3,-2\n200,0,0\n")
    world = world_of({"sigma_m": 0.0}, 20.0, world=common)
    assert_allclose(world.at(50).common_error_m, [2.0, -1.5])
    assert_allclose(errors_m(world), 0, atol=1e-9)
    later = world_of({}, 20.0, world=recorded(tmp_path, "time_s,east_m,north_m\n0,1,1\n100,5,1\n", start_s=50.0))
    assert_allclose(later.at(0).common_error_m, [3.0, 1.0])


def test_of_several_receivers_the_mean_is_common_and_the_rest_each_ones_own(tmp_path: Path) -> None:
    world = world_of({"sigma_m": 0.0}, 40.0, world=recorded(tmp_path, TWO_RECEIVERS))
    assert_allclose(world.at(0).common_error_m, [2.0, 1.0])
    assert_allclose(world.at(300).common_error_m, [2.0, 3.0])
    own_m = errors_m(world)[150]
    assert_allclose(own_m[::2], np.tile([0.0, 0.0], (5, 1)), atol=1e-9)
    assert_allclose(errors_m(world)[0, :2], [[-1.0, 1.0], [1.0, -1.0]], atol=1e-9)
    path = tmp_path / "world.npz"
    RecordedWorld.of(world).write(path)
    kept_m = RecordedWorld.read(path).receiver_m
    assert kept_m is not None
    assert np.array_equal(kept_m, np.asarray(world.receiver_m))


def test_the_file_is_found_beside_the_scenario_and_digested(tmp_path: Path) -> None:
    (tmp_path / "errors.csv").write_text(TWO_RECEIVERS)
    path = tmp_path / "a.toml"
    path.write_text('[world.common_error]\nkind = "file"\npath = "errors.csv"\n')
    assert list(input_digests(load_scenario(path))) == [str(tmp_path / "errors.csv")]
    path.write_text('[world.common_error]\nkind = "file"\npath = "other.csv"\n')
    with pytest.raises(ScenarioError, match=r"world.common_error.path = 'other.csv': no such file"):
        load_scenario(path)


def test_a_gradient_is_zero_in_the_middle_and_grows_with_the_distance() -> None:
    world = world_of({"sigma_m": 0.0}, 50.0, world={"common_error": {"gradient_m_per_km": 0.2}})
    away_m, error_m = world.position_m(100) - world.area_m.mean(axis=0), errors_m(world)[100]
    matrix, *_ = np.linalg.lstsq(away_m, error_m, rcond=None)
    assert_allclose(error_m, away_m @ matrix, atol=1e-6)
    assert 0.02 < 1000 * np.abs(matrix).max() < 1


@pytest.mark.slow
def test_without_them_fixes_are_as_before() -> None:
    assert np.array_equal(errors_m(world_of({})), errors_m(world_of({"multipath_tau_s": 5.0, "outlier_m": 9.0})))


def test_fixes_tell_the_speed_with_its_noise(tmp_path: Path) -> None:
    rows = [f"{time_s},v1,{20.0 * time_s},0" for time_s in range(101)]
    trips = tmp_path / "trips.csv"
    trips.write_text("\n".join(["time_s,id,x_m,y_m", *rows]))

    def speeds(**gnss: float) -> Array:
        network = {"kind": "trips", "path": trips}
        world = world_of({"sigma_m": 0.0, **gnss}, 100.0, network=network)
        told = [world.fix(period, 0).speed_m_s for period in range(world.periods - 1)]
        return np.array(told, dtype=float)

    assert_allclose(speeds(speed_sigma_mps=0.0), 20.0, rtol=1e-9)
    error = speeds() - 20.0
    assert error.std() == pytest.approx(0.1, rel=0.1)
    assert abs(error.mean()) < 0.02
    assert_allclose(speeds(speed_sigma_mps=0.2) - 20.0, 2 * error, atol=1e-9)


def test_standing_vehicles_have_a_speed_without_sign_and_other_draws_stay() -> None:
    world, other = world_of({}), world_of({"speed_sigma_mps": 5.0})
    speed = np.array([world.fix(period, 3).speed_m_s for period in range(100)], dtype=float)
    assert 0 <= speed.min() < speed.max() < 0.6
    fix, same = world.fix(7, 3), other.fix(7, 3)
    assert np.array_equal(fix.position_m, same.position_m)
    assert fix.heading_rad == same.heading_rad
