"""Vehicles that drive on a map: what programs are given of it, and that they make something of it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emulator.drivers.simulate import simulate
from emulator.records.recorded_world import RecordedWorld
from emulator.scenario.loading import dump_scenario, load_scenario
from emulator.scenario.scenario import Scenario
from emulator.stream import scene_message, unpack
from emulator.world.world import build_world
from tests.support.motion import Course, along, scenario_of_trips, write_trips
from tests.support.recorded import prepared
from vnet.errors import ScenarioError
from vnet.roads.road_map import RoadMap

ORIGIN_DEG = (42.28, -83.74)
M_A_DEGREE = 111_000.0
RIGHT_M = 1.75
"""A road without a class has lanes of 3.5 m, side by side about its line."""


def north(y_m: float, speed_mps: float, x_m: float) -> Course:
    return lambda time_s: (x_m, y_m + speed_mps * time_s)


def write_cross(path: Path) -> Path:
    """Two roads of 4 km that cross at the origin, one due east and one due north, as GeoJSON in degrees."""
    lat, lon = ORIGIN_DEG
    half = 2000 / M_A_DEGREE
    lines = [
        [[lon - half / np.cos(np.deg2rad(lat)), lat], [lon, lat], [lon + half / np.cos(np.deg2rad(lat)), lat]],
        [[lon, lat - half], [lon, lat], [lon, lat + half]],
    ]
    features = [
        {"type": "Feature", "properties": {}, "geometry": {"type": "LineString", "coordinates": line}}
        for line in lines
    ]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return path


COURSES = {
    "east": along(-150, 12, -RIGHT_M),
    "west": along(150, -11, RIGHT_M),
    "north": north(-150, 12, RIGHT_M),
    "south": north(150, -13, -RIGHT_M),
}


def driving(
    folder: Path,
    program: str = "agents.cooperative:main",
    seconds: float = 8.0,
    stays: dict[str, tuple[float, float]] | None = None,
    loss: float = 0.1,
    **map_: Any,
) -> Scenario:
    """Four vehicles on the right-hand lanes of the cross; some may come later and leave earlier."""
    times = dict.fromkeys(COURSES, (0, seconds)) | (stays or {})
    trips = write_trips(folder / "trips.csv", {name: [(*times[name], course)] for name, course in COURSES.items()})
    section = {"path": str(write_cross(folder / "cross.geojson")), "origin_deg": list(ORIGIN_DEG), **map_}
    scenario = scenario_of_trips(trips, seconds - 0.2, program, radio={"loss": loss})
    return Scenario.model_validate(scenario.model_dump(mode="json", exclude_none=True) | {"map": section})


def test_programs_get_the_lanes_around_where_vehicles_drive(tmp_path: Path) -> None:
    whole, near = (build_world(driving(tmp_path, margin_m=margin_m)).lane_map for margin_m in (1e5, 50.0))
    assert isinstance(whole, RoadMap) and isinstance(near, RoadMap)
    assert len(whole) == 8, "two roads of two pieces, both ways"
    assert sorted(set(np.round(whole.heading_rad, 2) % 6.28)) == pytest.approx([0, 1.57, 3.14, 4.71], abs=0.01)
    scene = scene_message(RecordedWorld.of(build_world(driving(tmp_path))), driving(tmp_path), "")
    assert unpack(scene["lane_length_m"])[:, 0] == pytest.approx(whole.length_m, rel=1e-5)


def test_lanes_may_lie_aside(tmp_path: Path) -> None:
    plain, aside = (build_world(driving(tmp_path, aside_m=metres)).lane_map for metres in (0.0, 1.5))
    assert isinstance(plain, RoadMap) and isinstance(aside, RoadMap)
    moved = np.einsum("ij,ij->i", aside.point_m - plain.point_m, plain.normal)
    assert moved == pytest.approx(1.5)


def test_a_map_may_be_shifted(tmp_path: Path) -> None:
    plain, shifted = (build_world(driving(tmp_path, datum_m=metres)).lane_map for metres in ([0, 0], [-0.6, 0.4]))
    assert isinstance(plain, RoadMap) and isinstance(shifted, RoadMap)
    assert shifted.point_m - plain.point_m == pytest.approx(np.tile([-0.6, 0.4], (len(plain), 1)))


@pytest.mark.slow
@pytest.mark.parametrize("exchange", ["information", "particles"])
def test_what_the_map_may_be_shifted_by_is_stated_and_not_exchanged(tmp_path: Path, exchange: str) -> None:
    """The same packets and estimates, with larger covariances."""
    anees, traces, errors = [], [], []
    for sigma_m in (0.0, 2.0):
        scenario = driving(tmp_path, seconds=4.0, sigma_m=1.0, datum_sigma_m=sigma_m)
        options = {"exchange": exchange, "particles": 100}
        scenario = scenario.model_copy(update={"program": scenario.program.model_copy(update={"options": options})})
        emulation = prepared(scenario, tmp_path / f"{sigma_m}")
        simulate(emulation)
        last = emulation.metrics.rows[-1]
        anees.append((last.common_error_anees, last.position_anees))
        errors.append((last.common_error_rmse_m, last.position_rmse_m))
        traces.append(emulation.engine.trace.to_table())
    assert errors[0] == errors[1]
    assert traces[0] == traces[1]
    for without, with_shift in zip(*anees, strict=True):
        assert without is not None and with_shift is not None and with_shift < 0.8 * without


@pytest.mark.slow
def test_vehicles_that_know_the_map_find_the_error_that_they_share(tmp_path: Path) -> None:
    """And without it they cannot."""
    figures = {}
    for name in ("with", "without"):
        (tmp_path / name).mkdir()
        scenario = driving(tmp_path / name, seconds=12.0)
        if name == "without":
            scenario = scenario.model_copy(update={"map": None})
        emulation = prepared(scenario, tmp_path / name / "run")
        simulate(emulation)
        figures[name] = emulation.metrics.rows[-1]
        assert figures[name].not_finite == 0
    found, lost = figures["with"].common_error_rmse_m, figures["without"].common_error_rmse_m
    assert found is not None and lost is not None
    assert found < 1.0
    assert lost > 2 * found


@pytest.mark.slow
def test_the_filter_of_all_outlives_the_vehicle_that_runs_it(tmp_path: Path) -> None:
    """The next process has run a filter too, and continues; one that starts later does not take over."""
    stays = {"east": (3.0, 12.0), "west": (0.0, 8.0)}
    scenario = driving(tmp_path, "agents.centralized:main", 12.0, stays, loss=0.0)
    emulation = prepared(scenario, tmp_path / "run")
    simulate(emulation)
    error = [row.common_error_rmse_m for row in emulation.metrics.rows]
    left = 41  # the period after the one in which one leaves
    before = error[left - 3]
    assert before is not None and before < 1.5
    after = [value for value in error[left : left + 10] if value is not None]
    assert len(after) == 10 and max(after) < 1.5, "it does not start again at three metres"


def test_a_map_of_somewhere_else_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r"cross\.geojson: most positions of vehicles are over 100 m") as error:
        build_world(driving(tmp_path, origin_deg=[42.9, -83.0]))
    assert "\n" not in str(error.value)


def test_a_map_is_for_those_who_drive(tmp_path: Path) -> None:
    path = tmp_path / "s.toml"
    path.write_text(f'[map]\npath = "{write_cross(tmp_path / "cross.geojson")}"\n')
    with pytest.raises(
        ScenarioError, match=r'map goes with vehicles that drive on it, not with network.kind = "generated"'
    ):
        load_scenario(path)


def test_a_map_that_has_changed_is_not_the_recorded_one(tmp_path: Path) -> None:
    scenario = driving(tmp_path)
    path = tmp_path / "recorded.toml"
    path.write_text(dump_scenario(scenario))
    assert load_scenario(path) == scenario
    (tmp_path / "cross.geojson").write_text((tmp_path / "cross.geojson").read_text() + " ")
    with pytest.raises(ScenarioError, match=r"cross\.geojson has changed since this run was recorded"):
        load_scenario(path)


def test_a_map_is_found_beside_the_scenario(tmp_path: Path) -> None:
    driving(tmp_path)
    path = tmp_path / "s.toml"
    path.write_text('[network]\nkind = "trips"\npath = "trips.csv"\n[map]\npath = "cross.geojson"\n')
    scenario = load_scenario(path)
    assert scenario.map is not None and scenario.map.path == tmp_path / "cross.geojson"
    with pytest.raises(ScenarioError, match=r"map\.path = 'nowhere\.osm': no such file"):
        load_scenario(path, ["map.path=nowhere.osm"])
