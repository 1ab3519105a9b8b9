"""Runs among buildings: they count in the radio and its checks, and the run's folder is enough to judge them."""

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emulator.checks.judge import judge
from emulator.records.recorded_run import OpenedRun, RecordedRun
from emulator.records.recorded_world import RecordedWorld
from emulator.report.map_figures import map_charts
from emulator.report.source import Source
from emulator.scenario.radio import Buildings as BuildingsSection
from emulator.scenario.scenario import Scenario
from emulator.stream import scene_message, unpack
from emulator.world.buildings import Buildings
from emulator.world.projection import CoordinateFrame
from emulator.world.radio_inputs import RadioInputs, load_buildings
from emulator.world.world import build_world
from tests.emulator.checks.test_judge import run_scenario
from tests.support.motion import along, scenario_of_trips, still, write_trips
from vnet.errors import ScenarioError, VnetError

HOUSE = "house,10,5\nhouse,60,5\nhouse,60,45\nhouse,10,45\n"
FAR_AWAY = "barn,9000,0\nbarn,9010,0\nbarn,9010,10\n"
VEHICLES = {"car": [(0, 4, along(0, 30))], "hidden": [(0, 4, still(0, 50))], "seen": [(0, 4, still(0, -5))]}
"""A car drives behind the block, and another vehicle stands beside it."""


def among_buildings(folder: Path, outlines: str = HOUSE + FAR_AWAY, **radio: Any) -> Scenario:
    path = folder / "buildings.csv"
    path.write_text("building,x_m,y_m\n" + outlines)
    section = {"path_loss": {"kind": "log_distance"}, "buildings": {"path": str(path)}, "mac": {}, "fading": {}}
    trips = write_trips(folder / "trips.csv", VEHICLES)
    return scenario_of_trips(trips, 3.0, radio={**section, "loss": 0.0, "access_jitter_ms": 20.0, **radio})


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run whose inputs are gone."""
    inputs = tmp_path_factory.mktemp("buildings")
    run_scenario(inputs / "run", among_buildings(inputs))
    for path in inputs.glob("*.csv"):
        path.unlink()
    return inputs / "run"


@pytest.fixture(scope="module")
def recorded(folder: Path) -> OpenedRun:
    return RecordedRun.open(folder)


@pytest.mark.slow
def test_the_house_takes_the_car_out_of_reach_while_it_is_behind_it(recorded: OpenedRun) -> None:
    rows = [row for row in recorded.trace.to_pylist() if {row["sender"], row["receiver"]} == {"car", "hidden"}]
    times_s = {round(row["sent_ns"] / 1e9, 1) for row in rows}
    # From (30 t, 0) to (0, 50): through the block from where the line passes (10, 45), 100 m, to (60, 5), 67 m.
    assert times_s and max(times_s) < 3.0 * 100 / 90
    assert {"seen", "hidden", "car"} == {row["sender"] for row in recorded.trace.to_pylist()}


@pytest.mark.slow
def test_all_checks_agree_from_the_folder_alone(recorded: OpenedRun) -> None:
    verdicts = {check.name: check.verdict.value for check in judge(recorded).checks}
    assert {verdicts[name] for name in ("conservation", "range", "fading", "medium")} == {"valid"}, verdicts


@pytest.mark.slow
def test_the_checks_find_a_run_that_took_no_buildings_into_account(folder: Path, tmp_path: Path) -> None:
    free = run_scenario(tmp_path / "free", among_buildings(tmp_path, FAR_AWAY))
    with_house = RecordedRun.open(folder)
    tables = free.trace, free.states, free.metrics, free.events
    claimed = RecordedRun(with_house.scenario, *tables, world=with_house.world)
    broken = {check.name: check.verdict.value for check in judge(claimed).checks}
    assert broken["range"] == broken["conservation"] == "invalid"


def test_only_the_buildings_near_vehicles_are_recorded_and_drawn(recorded: OpenedRun, folder: Path) -> None:
    buildings = recorded.world.buildings
    assert buildings is not None and len(buildings) == 1
    assert buildings.corner_m.tolist() == [[10, 5], [60, 5], [60, 45], [10, 45]]
    scene = scene_message(recorded.world, recorded.scenario, "")
    edges = unpack(scene["building_edge_m"], 2).reshape(-1, 2, 2)
    assert edges.tolist() == [[[10, 5], [60, 5]], [[60, 5], [60, 45]], [[60, 45], [10, 45]], [[10, 45], [10, 5]]]
    drawing = map_charts(Source(folder))["map"][1]()
    assert drawing.caption.startswith("Grey lines: roads; grey areas: buildings.")
    areas = [patch for patch in drawing.canvas.axes.patches if patch.get_fill()]
    assert Counter(map(tuple, np.array(areas[0].get_path().vertices).tolist())) == Counter(
        [(10, 5), (10, 5), (60, 5), (60, 45), (10, 45)]
    )


def test_a_run_without_its_buildings_or_with_damaged_ones_is_refused_in_one_line(
    recorded: OpenedRun, tmp_path: Path
) -> None:
    world = recorded.world
    tables = recorded.trace, recorded.states, recorded.metrics, ()
    nothing = replace(world, radio_inputs=RadioInputs())
    with pytest.raises(VnetError, match=r"^\[radio\.buildings\]: no buildings were recorded$"):
        assert RecordedRun(recorded.scenario, *tables, world=nothing).places
    for damage, problem in (
        ({"building_first": None}, "of the arrays of buildings only building_corner_m, building_number"),
        ({"building_first": np.array([0, 3])}, "not the rings of buildings"),
        ({"building_first": np.array([0, 2, 4]), "building_number": np.array([0, 1])}, "not the rings"),
        ({"building_number": np.array([7])}, "not the rings"),
        ({"building_number": np.array([-1])}, "not the rings"),
    ):
        arrays = {name: array for name, array in (world.arrays() | damage).items() if array is not None}
        np.savez(tmp_path / "world.npz", allow_pickle=False, **arrays)
        with pytest.raises(VnetError, match=problem) as caught:
            RecordedWorld.read(tmp_path / "world.npz")
        assert "\n" not in str(caught.value)


def test_the_largest_buildings_are_drawn_where_there_are_many() -> None:
    unit = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], dtype=float)
    buildings = Buildings.of([[unit], [unit * 5, unit + 1], [unit * 3], [unit * 2]])
    assert len(buildings.largest(12)) == 2 and len(buildings.largest(11)) == 1
    assert buildings.largest(12).corner_m.max(axis=0).tolist() == [5, 5]
    assert buildings.largest(12).building.tolist() == [0, 0, 1]
    assert len(buildings.largest(3)) == 0


def test_buildings_far_from_all_vehicles_are_told(tmp_path: Path) -> None:
    world = build_world(among_buildings(tmp_path, FAR_AWAY))
    assert world.notes == ("radio.buildings: none is between vehicles; check the coordinates of its corners",)


def test_an_origin_of_buildings_beside_that_of_a_map_is_the_same_or_refused(tmp_path: Path) -> None:
    corners = [[9.18, 48.77], [9.181, 48.77], [9.181, 48.771]]
    path = tmp_path / "houses.geojson"
    house = {"type": "Polygon", "coordinates": [corners]}
    feature = {"type": "Feature", "properties": {"building": "yes"}, "geometry": house}
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    scenario, frame = among_buildings(tmp_path), CoordinateFrame.around(48.77, 9.18)
    area_m = np.array([[-100.0, -100.0], [100.0, 100.0]])

    def loaded(origin_deg: tuple[float, float] | None, frame: CoordinateFrame | None) -> Buildings | None:
        section = BuildingsSection(path=path, origin_deg=origin_deg)
        radio = scenario.radio.model_copy(update={"buildings": section})
        return load_buildings(scenario.model_copy(update={"radio": radio}), frame, area_m)

    found = [loaded((48.77, 9.18), None), loaded(None, frame), loaded((48.770001, 9.180001), frame)]
    assert all(each is not None and each.corner_m[0] == pytest.approx([0.0, 0.0], abs=1e-6) for each in found)
    with pytest.raises(
        ScenarioError, match=r"origin_deg = \[48.78, 9.18\]: 1,112 m from the x = y = 0 m of the map"
    ):
        loaded((48.78, 9.18), frame)
