"""Files of maps: what each reader makes of a town, and that maps come back from files as they went."""

from dataclasses import fields
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.world.maps.files import read_roads, write_roads
from emulator.world.maps.roads import NAMES, Roads
from emulator.world.projection import CoordinateFrame
from tests.support import maps
from tests.support.files import write
from tests.support.maps import NODES, ORIGIN


def write_npz(folder: Path, **changes: Any) -> Path:
    path = folder / "town.npz"
    np.savez(path, **maps.arrays(**changes))
    return path


def write_town(folder: Path, kind: str) -> Path:
    """The town in a file of a kind."""
    if kind.endswith("pbf"):
        return maps.write_pbf(folder / f"town.{kind}")
    if kind == "npz":
        return write_npz(folder)
    return write(folder, f"town.{kind}", maps.osm_xml() if kind == "osm" else maps.geojson())


def directed(roads: Roads) -> dict[tuple[tuple[int, ...], tuple[int, ...]], int]:
    """Return the number of lanes between points, which are rounded to decimetres."""
    found = {}
    for road in range(len(roads)):
        places = roads.node_m[roads.node[roads.first[road] : roads.first[road + 1]]]
        for start, end in pairwise(map(tuple, (10 * places).round().astype(int).tolist())):
            if roads.forward[road]:
                found[start, end] = int(roads.forward[road])
            if roads.backward[road]:
                found[end, start] = int(roads.backward[road])
    return found


TOWN = {
    ((0, 0), (2000, 0)): 1,
    ((2000, 0), (4000, 0)): 1,
    ((4000, 0), (2000, 0)): 1,
    ((2000, 0), (0, 0)): 1,
    ((2000, 0), (2000, 1500)): 1,
}


@pytest.mark.parametrize("kind", ["osm", "pbf", "osm.pbf", "geojson", "json", "npz"])
def test_every_kind_of_file_gives_the_town(tmp_path: Path, kind: str) -> None:
    roads = read_roads(write_town(tmp_path, kind), ORIGIN)
    assert directed(roads) == TOWN
    assert roads.frame == CoordinateFrame.around(*ORIGIN)
    assert roads.length_m.sum() == pytest.approx(550.0, abs=0.05)  # OpenStreetMap's degrees have 7 decimals
    assert roads.one_way.tolist() == [False, True] or kind == "npz"
    if kind != "npz":
        assert [NAMES[kind] for kind in roads.kind] == ["primary", "residential"]
        assert roads.lane_width_m.tolist() == [3.5, 3.0]


@pytest.mark.parametrize("kind", ["osm", "geojson", "npz"])
def test_metres_start_in_the_middle_unless_an_origin_is_given(tmp_path: Path, kind: str) -> None:
    roads = read_roads(write_town(tmp_path, kind))
    low, high = roads.node_m.min(axis=0), roads.node_m.max(axis=0)
    assert low + high == pytest.approx(np.zeros(2), abs=0.1) and high - low == pytest.approx([400, 150], abs=0.1)
    assert roads.frame is not None
    lat, lon = roads.frame.to_wgs84(roads.node_m)
    assert CoordinateFrame.around(*ORIGIN).to_local(lat, lon).round(1).tolist() == [
        list(NODES[n]) for n in (1, 2, 4, 3)
    ] or (kind == "npz")


# OpenStreetMap.


def one_way_road(folder: Path, **tags: str) -> Roads:
    """Return the road of a way from west to east with these tags."""
    return read_roads(write(folder, "one.osm", maps.osm_xml({10: ((1, 2), tags)})), ORIGIN)


@pytest.mark.parametrize(
    ("tags", "lanes"),
    [
        ({"highway": "primary"}, (1, 1)),
        ({"highway": "motorway"}, (2, 0)),
        ({"highway": "motorway", "oneway": "no"}, (2, 2)),
        ({"highway": "primary", "junction": "roundabout"}, (1, 0)),
        ({"highway": "primary", "lanes": "5"}, (3, 2)),
        ({"highway": "primary", "lanes": "1"}, (1, 1)),
        ({"highway": "primary", "lanes": "3", "lanes:backward": "2"}, (1, 2)),
        ({"highway": "primary", "lanes:forward": "3"}, (3, 1)),
        ({"highway": "primary", "lanes": "3", "oneway": "yes"}, (3, 0)),
        ({"highway": "primary", "lanes": "3", "lanes:both_ways": "1"}, (1, 1)),
        ({"highway": "primary", "lanes": "5", "lanes:forward": "2", "lanes:both_ways": "1"}, (2, 2)),
        ({"highway": "primary", "lanes": "1", "lanes:both_ways": "1"}, (1, 1)),
        ({"highway": "primary", "lanes": "many", "oneway": "true"}, (1, 0)),
        ({"highway": "primary", "lanes:forward": "2", "oneway": "yes"}, (2, 0)),
        ({"highway": "primary", "lanes:forward": "3", "lanes:backward": "2", "oneway": "-1"}, (2, 0)),
        ({"highway": "primary", "lanes": "99999999999999999999"}, (1, 1)),
        ({"highway": "service", "access": "private"}, (1, 1)),
        ({"highway": "primary", "access": "no", "motorcar": "yes"}, (1, 1)),
    ],
)
def test_lanes_of_a_way(tmp_path: Path, tags: dict[str, str], lanes: tuple[int, int]) -> None:
    roads = one_way_road(tmp_path, **tags)
    assert (roads.forward.tolist(), roads.backward.tolist()) == ([lanes[0]], [lanes[1]])
    assert roads.one_way.tolist() == [lanes[1] == 0]


def test_a_way_against_its_direction_is_turned_round(tmp_path: Path) -> None:
    roads = one_way_road(tmp_path, highway="primary", oneway="-1", lanes="2")
    assert directed(roads) == {((2000, 0), (0, 0)): 2}


@pytest.mark.parametrize(
    ("tags", "width_m"),
    [
        ({"width": "8"}, 4.0),
        ({"width": "6.5 m"}, 3.25),
        ({"width": "narrow"}, 3.5),
        ({"width": "900"}, 3.5),
        ({"width": "26'"}, 3.9624),
        ({"width": "16'3\""}, 2.4765),
        ({"width": "20 ft"}, 3.048),
        ({"width": "19' 6\""}, 2.9718),
    ],
)
def test_a_width_is_that_of_all_lanes(tmp_path: Path, tags: dict[str, str], width_m: float) -> None:
    assert one_way_road(tmp_path, highway="primary", **tags).lane_width_m.tolist() == [width_m]


def test_ways_that_are_not_for_cars_are_counted(tmp_path: Path) -> None:
    tags = [
        {"highway": "footway"},
        {"highway": "crossing"},
        {"highway": "service", "area": "yes"},
        {"highway": "service", "motor_vehicle": "no"},
        {"building": "yes"},
    ]
    ways = {**maps.WAYS, **{20 + n: ((1, 3), each) for n, each in enumerate(tags)}}
    roads = read_roads(write(tmp_path, "town.osm", maps.osm_xml(ways)), ORIGIN)
    assert roads.notes == {"ways not for cars": 4} and directed(roads) == TOWN


# GeoJSON.


def test_properties_of_lines_of_our_own(tmp_path: Path) -> None:
    here, there = [-83.74, 42.28], [-83.73, 42.28, 250.0]
    text = maps.collection(
        maps.line([here, there], **{"class": "service"}, lanes_forward=2, lanes_backward=0, lane_width_m=2.5),
        maps.line([here, there], oneway=1.0),
        {"type": "Feature", "properties": None, "geometry": {"type": "Point", "coordinates": here}},
        {"type": "Feature", "properties": {}, "geometry": None},
        {"type": "Feature", "geometry": {"type": "MultiLineString", "coordinates": [[here, there], [there, here]]}},
        maps.line([here, there], highway="primary", oneway=-1, lanes=2),
        maps.line([here, there], highway="footway"),
        maps.line([here, there], **{"class": "primary"}, oneway="Reverse", lanes_forward=2),
        maps.line([here, there], **{"class": "motorway"}),
        maps.line([here, there], **{"class": "motorway"}, lanes_backward=3),
    )
    roads = read_roads(write(tmp_path, "lines.geojson", text))
    kinds = ["service", *["road"] * 3, *["primary"] * 2, *["motorway"] * 2]
    assert [NAMES[kind] for kind in roads.kind] == kinds
    assert roads.forward.tolist() == [2, 1, 1, 1, 2, 2, 2, 2]
    assert roads.backward.tolist() == [0, 0, 1, 1, 0, 0, 0, 3]
    assert roads.lane_width_m[:2].tolist() == [2.5, 3.5] and len(roads.node_m) == 2
    assert roads.node[-8:-4].tolist() == [1, 0, 1, 0]
    assert roads.notes == {"features that are not lines": 2, "ways not for cars": 1}


def test_lines_meet_where_their_points_agree_to_a_centimetre(tmp_path: Path) -> None:
    text = maps.collection(
        maps.line([[-83.74, 42.28], [-83.73, 42.28]]), maps.line([[-83.7300000001, 42.28], [-83.73, 42.29]])
    )
    assert len(read_roads(write(tmp_path, "lines.geojson", text)).node_m) == 3


# SUMO.


def test_lanes_of_sumo_keep_their_place(tmp_path: Path) -> None:
    roads = read_roads(write(tmp_path, "town.net.xml", maps.sumo_net()))
    assert roads.name == ("lane :2_0_0", "lane west_1", "lane -west_0", "lane east_0")
    assert [NAMES[kind] for kind in roads.kind] == ["crossing", "primary", "primary", "primary"]
    assert roads.lane_width_m.tolist() == [3.2, 3.2, 3.2, 3.5]
    assert roads.one_way.tolist() == [True, False, False, True]
    assert roads.notes == {"lanes not for cars": 2} and roads.frame is None
    lanes = roads.lane_map()
    assert lanes.point_m.tolist() == [[196, -1.6], [0, -1.6], [196, 1.6], [204, -1.6]]
    assert len(roads.node_m) == 6  # lanes inside the crossing begin where others end


LOCATION = '<location netOffset="-270000.00,-4684000.00" projParameter="{}"/>'


@pytest.mark.parametrize("projection", [maps.UTM, "EPSG:32617"])
def test_a_network_of_sumo_says_where_it_is(tmp_path: Path, projection: str) -> None:
    path = write(tmp_path, "town.net.xml", maps.sumo_net(LOCATION.format(projection)))
    roads = read_roads(path)
    assert roads.node_m[0].tolist() == [196, -1.6] and roads.frame is not None
    lat, lon = roads.frame.to_wgs84(roads.node_m)
    assert (lat[0], lon[0]) == pytest.approx(ORIGIN, abs=0.1)
    moved = read_roads(path, ORIGIN)
    assert moved.frame == CoordinateFrame.around(*ORIGIN)
    assert moved.node_m == pytest.approx(CoordinateFrame.around(*ORIGIN).to_local(lat, lon), abs=1e-6)
    assert moved.length_m == pytest.approx(roads.length_m, rel=1e-3)  # UTM is not true to scale


@pytest.mark.parametrize("projection", ["!", "-", "."])
def test_a_network_of_sumo_need_not_say_where_it_is(tmp_path: Path, projection: str) -> None:
    path = write(tmp_path, "town.net.xml", maps.sumo_net(LOCATION.format(projection)))
    assert read_roads(path).frame is None


# Nodes and edges.


def test_edges_that_just_go_on_become_one_road(tmp_path: Path) -> None:
    lon = -83.74 + np.arange(6) * 1e-3
    edges = [(0, 1), (1, 0), (2, 1), (1, 2), (2, 3), (3, 2), (3, 4), (4, 5)]  # the last two are one way
    changes = {"node_lon_deg": lon, "node_lat_deg": np.full(6, 42.28), "edges": np.array(edges)}
    roads = read_roads(write_npz(tmp_path, **changes))
    assert np.diff(roads.first).tolist() == [4, 3]
    assert roads.one_way.tolist() == [False, True] and roads.name == ("edge 0", "edge 6")


def test_what_is_odd_about_edges_is_put_right_and_counted(tmp_path: Path) -> None:
    edges = [(0, 1), (0, 1), (1, 1), (1, 0)]
    roads = read_roads(write_npz(tmp_path, edges=np.array(edges, dtype=np.uint8)))
    assert roads.notes == {"edges without length": 1, "edges given twice": 1, "nodes without an edge": 2}
    assert len(roads) == 1 and roads.backward.tolist() == [1]


def test_what_edges_say_of_themselves(tmp_path: Path) -> None:
    changes = {
        "edges": np.array([(0, 1), (1, 0), (1, 3)]),
        "edge_class": np.array(["primary", "primary", "service"]),
        "edge_lanes": np.array([3, 2, 1]),
        "edge_lane_width_m": np.array([3.1, 3.1, 2.6]),
    }
    roads = read_roads(write_npz(tmp_path, **changes))
    assert [NAMES[kind] for kind in roads.kind] == ["primary", "service"]
    assert roads.forward.tolist() == [3, 1] and roads.backward.tolist() == [2, 0]
    assert roads.lane_width_m.tolist() == [3.1, 2.6]


@pytest.mark.slow
@given(edges=st.lists(st.tuples(st.integers(0, 7), st.integers(0, 7)), min_size=1, max_size=30))
def test_no_edge_is_lost_and_none_is_added(tmp_path_factory: Any, edges: list[tuple[int, int]]) -> None:
    folder = tmp_path_factory.mktemp("maps")
    edges += [(0, 1)]
    rng = np.random.default_rng(len(edges))
    place = rng.permutation(64)[:8]
    x, y = place % 8 * 100.0, place // 8 * 100.0
    np.savez(folder / "town.npz", node_x_m=x, node_y_m=y, edges=np.array(edges))
    roads = read_roads(folder / "town.npz")
    wanted = {((int(10 * x[a]), int(10 * y[a])), (int(10 * x[b]), int(10 * y[b]))): 1 for a, b in edges if a != b}
    assert directed(roads) == wanted
    write_roads(roads, folder / "again.npz")
    assert directed(read_roads(folder / "again.npz")) == wanted


# There and back.


@pytest.mark.parametrize("kind", ["geojson", "npz"])
def test_a_map_comes_back_from_a_file_as_it_went(tmp_path: Path, kind: str) -> None:
    ways = {**maps.WAYS, 12: ((3, 4), {"highway": "trunk", "lanes": "5", "width": "20"})}
    roads = read_roads(write(tmp_path, "town.osm", maps.osm_xml(ways)), ORIGIN)
    write_roads(roads, tmp_path / f"again.{kind}")
    again = read_roads(tmp_path / f"again.{kind}", ORIGIN)
    assert directed(again) == directed(roads)
    assert again.length_m.sum() == pytest.approx(roads.length_m.sum(), abs=1e-3)
    assert described(again) == described(roads) and again.name == roads.name


def described(roads: Roads) -> list[tuple[Any, ...]]:
    """Return the first points and the attributes of a map's lanes."""
    lanes = roads.lane_map()
    place = lanes.point_m.round(2).tolist()
    width, kind = lanes.half_width_m.round(6).tolist(), lanes.kind.tolist()
    return sorted(zip(map(tuple, place), width, kind, lanes.one_way.tolist(), strict=True))


def test_an_archive_of_roads_is_exact(tmp_path: Path) -> None:
    once_more = {number: ((2, 3), {"highway": "service", "oneway": "yes"}) for number in (14, 15)}
    roads = read_roads(write(tmp_path, "town.osm", maps.osm_xml({**maps.WAYS, **once_more})))
    write_roads(roads, tmp_path / "again.npz")
    again = read_roads(tmp_path / "again.npz")
    assert again.frame == roads.frame and again.name == roads.name
    for column in fields(Roads):
        if isinstance(values := getattr(roads, column.name), np.ndarray):
            assert getattr(again, column.name).tobytes() == values.tobytes(), column.name


def test_a_map_and_trips_of_one_origin_fall_on_each_other(tmp_path: Path) -> None:
    from emulator.world.trips.drive import read_csv

    lines = [f"car,{node},{maps.degrees(node)[1]!r},{maps.degrees(node)[0]!r}" for node in (1, 2, 4)]
    trips = read_csv(write(tmp_path, "trips.csv", "\n".join(["id,time_s,lat_deg,lon_deg", *lines])), None)
    driven = trips.trips(ORIGIN)[0].position_m
    for kind in ("geojson", "npz"):
        roads = read_roads(write_town(tmp_path, kind), ORIGIN)
        distance = np.hypot(*(driven[:, None] - roads.node_m).transpose(2, 0, 1))
        assert distance.min(axis=1).max() < 1e-3
    assert driven == pytest.approx(np.array([NODES[node] for node in (1, 2, 4)]), abs=1e-3)
