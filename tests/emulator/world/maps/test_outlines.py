"""Outlines of buildings in files, and what is wrong with them."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emulator.scenario.scenario import Scenario
from emulator.world.buildings import Buildings
from emulator.world.maps import files
from emulator.world.maps.files import read_buildings
from emulator.world.world import build_world
from tests.support.maps import FRAME, ORIGIN, WAYS, collection, osm_xml
from tests.support.motion import along, still, write_trips
from vnet.errors import ScenarioError

HOUSE = [(20.0, 10.0), (50.0, 10.0), (50.0, 40.0), (20.0, 40.0)]
COURT = [(30.0, 20.0), (40.0, 20.0), (40.0, 30.0), (30.0, 30.0)]
CSV = "building,x_m,y_m\nhouse,20,10\nhouse,50,10\nhouse,50,40\nhouse,20,40\n"


def degrees(corners: list[tuple[float, float]]) -> list[list[float]]:
    latitude, longitude = FRAME.to_wgs84(np.array(corners))
    return np.column_stack([longitude, latitude]).tolist()


def write_osm(path: Path, roads: bool = True) -> Path:
    """A house with a court as a multipolygon, a hut as a way, and what is no building."""
    corners = enumerate(degrees([*HOUSE, *COURT, (60, 10), (70, 10), (70, 20)]), 100)
    nodes = [f'<node id="{node}" lat="{lat:.9f}" lon="{lon:.9f}" version="1"/>' for node, (lon, lat) in corners]
    ways = {
        50: ([100, 101, 102, 103, 100], {}),
        51: ([104, 105, 106, 107, 104], {}),
        52: ([108, 109, 110, 108], {"building": "hut"}),
        53: ([108, 109, 110, 108], {"building": "no"}),
        54: ([108, 109, 110, 108], {"landuse": "grass"}),
        55: ([108, 109, 110], {"building": "yes"}),
        56: ([108, 109, 999, 108], {"building": "yes"}),
        57: ([108, 109, 110, 108], {"building": "yes"}),
    }
    text = osm_xml({**(WAYS if roads else {}), **ways}).replace('<way id="57"', '<way id="57" visible="false"')
    head, brace, rest = text.partition("<way ")
    relation = '<relation id="9" version="1"><member type="way" ref="50" role="outer"/>'
    relation += '<member type="way" ref="51" role="inner"/>'
    relation += '<tag k="type" v="multipolygon"/><tag k="building" v="yes"/>'
    text = head + "\n".join(nodes) + brace + rest.replace("</osm>", f"{relation}</relation></osm>")
    path.write_text(text)
    return path


def rings(buildings: Buildings) -> list[list[list[float]]]:
    """The rings, each from its lower left corner on, counter-clockwise; in decimetres."""
    found = []
    for first, end in zip(buildings.first, buildings.first[1:], strict=False):
        ring = np.round(buildings.corner_m[first:end], 1)
        x, y = ring.T
        if np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) < 0:
            ring = ring[::-1]
        found.append(np.roll(ring, -int(np.lexsort(ring.T[::-1])[0]), axis=0).tolist())
    return found


def test_openstreetmap_has_closed_ways_and_multipolygons(tmp_path: Path) -> None:
    found = read_buildings(write_osm(tmp_path / "town.osm"), lambda: FRAME)
    hut = [[60.0, 10.0], [70.0, 10.0], [70.0, 20.0]]
    by_building = dict(zip(found.building.tolist(), rings(found), strict=False))
    assert len(found) == 2 and hut in by_building.values() and found.moved((1.0, 0.0)).clipped == 1
    all_rings: list[list[list[float]]] = [[list(p) for p in HOUSE], [list(p) for p in COURT], hut]
    assert sorted(rings(found)) == sorted(all_rings)
    assert sorted(np.bincount(found.building)) == [1, 2], "the court belongs to the block"


def test_buildings_whose_nodes_come_late_are_counted_and_told(tmp_path: Path) -> None:
    path = write_osm(tmp_path / "town.osm", roads=False)
    nodes = re.findall("<node .*/>", text := path.read_text())
    for node in nodes:
        text = text.replace(node, "")
    path.write_text(text.replace("</osm>", "\n".join(nodes) + "</osm>"))
    with pytest.raises(ScenarioError, match="lacks the nodes of its 3 buildings; nodes come before ways"):
        read_buildings(path, lambda: FRAME)


def test_geojson_has_polygons_that_are_buildings(tmp_path: Path) -> None:
    def area(kind: str, coordinates: Any, **properties: object) -> dict[str, Any]:
        return {"type": "Feature", "properties": properties, "geometry": {"type": kind, "coordinates": coordinates}}

    house, court = degrees([*HOUSE, HOUSE[0]]), degrees([*COURT, COURT[0]])
    path = tmp_path / "town.geojson"
    path.write_text(
        collection(
            area("Polygon", [house, court], building="yes"),
            area("MultiPolygon", [[court], [house]], building="school"),
            area("Polygon", [house], landuse="park"),
            area("Polygon", [house], building="no"),
            area("LineString", house, building="yes"),
        )
    )
    found = read_buildings(path, lambda: FRAME)
    assert found.building.tolist() == [0, 0, 1, 2]
    house_m, court_m = [list(p) for p in HOUSE], [list(p) for p in COURT]
    assert rings(found) == [house_m, court_m, court_m, house_m]


def test_sumo_has_polygons_in_metres(tmp_path: Path) -> None:
    path = tmp_path / "town.poly.xml"
    house = '<poly id="1" type="building.school" color="1,0,0" shape="20,10 50.0,10 50,40,3.5 20,40 20,10"/>'
    lawn = '<poly id="2" type="landuse" shape="0,0 1,1 2,0"/>'
    ruin = '<poly id="3" type="building.no" fill="1" shape="0,0 1,1 2,0 0,0"/>'
    half = '<poly id="4" type="building" fill="0" shape="0,0 1,1 2,0"/>'  # of an outline of two ways
    path.write_text(f'<?xml version="1.0"?>\n<additional>\n{house}\n{lawn}\n{ruin}\n{half}\n</additional>\n')
    found = read_buildings(path, lambda: pytest.fail("no degrees"))
    assert rings(found) == [[list(p) for p in HOUSE]] and len(found.corner_m) == 4
    path.write_text('<additional>\n<poly id="5" type="building" fill="0" shape=""/>\n</additional>')
    with pytest.raises(ScenarioError, match="line 2: poly 5: shape: three corners or more are needed"):
        read_buildings(path, lambda: pytest.fail("no degrees"))


def test_a_table_has_corners_in_metres(tmp_path: Path) -> None:
    path = tmp_path / "b.csv"
    path.write_text(CSV + "hut,60,10\nhut,70,10\nhut,70,20\nhut,60,10\n")

    found = read_buildings(path, lambda: pytest.fail("no degrees"))
    assert rings(found) == [[list(p) for p in HOUSE], [[60, 10], [70, 10], [70, 20]]]


def test_the_corners_of_all_parts_of_a_multipolygon_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "MAX_POINTS", 10)
    house = degrees([*HOUSE, HOUSE[0]])
    geometry = {"type": "MultiPolygon", "coordinates": [[house]] * 3}
    path = tmp_path / "town.geojson"
    path.write_text(collection({"type": "Feature", "properties": {"building": "yes"}, "geometry": geometry}))
    with pytest.raises(ScenarioError, match="more than 10 corners"):
        read_buildings(path, lambda: FRAME)


# Where the metres of degrees begin.


def scenario(folder: Path, **sections: dict[str, Any]) -> Scenario:
    trips = {"a": [(0.0, 3.0, along(10, 5))], "b": [(0.0, 3.0, still(65, 30))]}
    network = {"kind": "trips", "path": str(write_trips(folder / "trips.csv", trips)), "start_s": 0.0}
    radio = {"path_loss": {"kind": "free_space"}, "buildings": {}}
    data: dict[str, Any] = {"run": {"duration_s": 2.0, "settle_s": 0.5}, "network": network, "radio": radio}
    for name, section in sections.items():
        data[name] = {**data.get(name, {}), **section}
    return Scenario.model_validate(data)


def test_buildings_of_the_map_are_in_its_metres_and_move_with_it(tmp_path: Path) -> None:
    path = str(write_osm(tmp_path / "town.osm"))
    for datum_m in ((0.0, 0.0), (2.0, -1.0)):
        world = build_world(scenario(tmp_path, map={"path": path, "origin_deg": ORIGIN, "datum_m": datum_m}))
        found = world.radio_inputs.buildings
        assert found is not None and len(found) == 2
        assert found.corner_m.min(axis=0) == pytest.approx(np.array([20, 10]) + datum_m, abs=0.02)


def test_a_file_of_its_own_has_the_origin_that_its_section_or_the_trips_say(tmp_path: Path) -> None:
    path = str(write_osm(tmp_path / "town.osm", roads=False))
    for section, network in (({"origin_deg": ORIGIN}, {}), ({}, {"origin_deg": ORIGIN})):
        said = scenario(tmp_path, network=network, radio={"buildings": {"path": path, **section}})
        if network:
            with pytest.raises(ScenarioError, match="in degrees, but nothing says where x = y = 0 m is"):
                build_world(said)  # trips in metres have no origin
        else:
            found = build_world(said).radio_inputs.buildings
            assert found is not None and found.corner_m.min(axis=0) == pytest.approx([20, 10], abs=0.02)


def test_without_a_path_loss_or_a_file_buildings_are_refused_in_one_line(tmp_path: Path) -> None:
    for radio, message in (
        ({"path_loss": None, "buildings": {"path": "b.csv"}}, "buildings needs path_loss: without it no signal"),
        ({}, r"radio.buildings.path is missing: without \[map\] there is no other file"),
        ({"buildings": {"path": "b.csv", "wall_db": -1}}, "greater than or equal to 0"),
    ):
        with pytest.raises(ValueError, match=message):
            scenario(tmp_path, radio=radio)
