"""Maps that cannot be used: each is refused in one line that names the file, and the line or the feature."""

import io
import json
import zipfile
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emulator.world.maps import roads as roads_module
from emulator.world.maps.files import CLIPPED, READERS, read_roads, write_roads
from tests.support import maps
from vnet.errors import ScenarioError


def refusal(path: Path, origin_deg: tuple[float, float] | None = None) -> str:
    """Return the error of a file without its name, with which it must begin."""
    with pytest.raises(ScenarioError) as refused:
        read_roads(path, origin_deg)
    text = str(refused.value)
    assert text.startswith(f"{path}: ") and text.isprintable()
    return text.removeprefix(f"{path}: ")


def write(folder: Path, name: str, content: str | bytes) -> Path:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


# All kinds.


@pytest.mark.parametrize("ending", READERS)
@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "empty"),
        (b"\0" * 5000, ""),
        (b"\x89PNG\r\n\x1a\n" + b"x" * 100, ""),
        (b"PK\x03\x04" + b"x" * 100, ""),
        (b"<html></html>", ""),
        (b"{}", ""),
    ],
    ids=["empty", "zeros", "a picture", "an archive", "a page", "an object"],
)
def test_what_is_no_map_is_refused(tmp_path: Path, ending: str, content: bytes, said: str) -> None:
    assert said in refusal(write(tmp_path, f"town{ending}", content))


@pytest.mark.parametrize("ending", READERS)
def test_a_file_that_is_not_there(tmp_path: Path, ending: str) -> None:
    assert refusal(tmp_path / f"town{ending}") == "cannot be read: No such file or directory"
    (tmp_path / f"folder{ending}").mkdir()
    assert refusal(tmp_path / f"folder{ending}") == "not a file"


def test_an_unknown_format(tmp_path: Path) -> None:
    assert "allowed are *.osm, " in refusal(write(tmp_path, "town.shp", "x"))
    with pytest.raises(ScenarioError, match=r"allowed are \*.geojson"):
        write_roads(read_roads(write(tmp_path, "t.geojson", maps.geojson())), tmp_path / "town.osm")


@pytest.mark.parametrize("kind", ["osm", "osm.pbf", "net.xml", "geojson", "npz"])
def test_a_file_that_is_cut_off_is_not_half_read(tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"town.{kind}"
    if kind == "npz":
        np.savez_compressed(path, **maps.arrays())
    elif kind == "osm.pbf":
        maps.write_pbf(path)
    else:
        path.write_text({"osm": maps.osm_xml(), "net.xml": maps.sumo_net(), "geojson": maps.geojson()}[kind])
    whole = path.read_bytes()
    for share in (0.3, 0.6, 0.9, 0.99):
        refusal(write(tmp_path, f"cut.{kind}", whole[: int(share * len(whole))]))


@pytest.mark.parametrize("kind", ["osm", "geojson", "npz"])
def test_an_origin_that_is_far_away(tmp_path: Path, kind: str) -> None:
    if kind == "npz":
        np.savez(tmp_path / "town.npz", **maps.arrays())
    else:
        write(tmp_path, f"town.{kind}", maps.osm_xml() if kind == "osm" else maps.geojson())
    said = refusal(tmp_path / f"town.{kind}", (-83.74, 42.28))  # swapped
    assert "km from the origin -83.7400, 42.2800: at most 200 km" in said


def test_a_map_of_more_points_than_are_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(roads_module, "MAX_POINTS", 4)
    said = refusal(write(tmp_path, "town.osm", maps.osm_xml()))
    assert said == "way 11: more than 4 points; cut out a part first"


# OpenStreetMap.


def node(coordinates: str) -> str:
    """The town, whose first node has these `coordinates`."""
    first, rest = maps.osm_xml().split('<node id="1" ')
    return f'{first}<node id="1" {coordinates} version="1"/>{rest.partition("/>")[2]}'


BOMB = '<!DOCTYPE a [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;">]>'
BAD_OSM = {
    "no node at all": (maps.osm_xml(nodes=()), "it lacks the nodes of its"),
    "a way of one node": (maps.osm_xml({5: ((1,), {"highway": "primary"})}), "way 5: 1 nodes; a road needs two"),
    "no road": (maps.osm_xml({5: ((1, 2), {"highway": "footway"})}), "no roads that vehicles may use"),
    "a latitude that is none": (node('lat="north" lon="-83.7"'), "line 3: wrong format for coordinate: 'north'"),
    "a latitude beyond the pole": (node('lat="95" lon="-83.7"'), "way 10: node 1 is not on the earth"),
    "metres": (node('lat="4682000" lon="271000"'), "line 3: wrong format for coordinate: '4682000'"),
    "a node at 0°, 0°": (node('lat="0" lon="0"'), "way 10: 5,146 km from the origin"),
    "entities": (maps.osm_xml().replace("<osm ", BOMB + "<osm "), "XML entities are not"),
    "a network of SUMO": (maps.sumo_net(), ""),
}


@pytest.mark.parametrize("name", BAD_OSM)
def test_a_wrong_openstreetmap_file(tmp_path: Path, name: str) -> None:
    text, said = BAD_OSM[name]
    assert said in refusal(write(tmp_path, "town.osm", text))


def test_a_line_that_is_no_xml_is_named(tmp_path: Path) -> None:
    text = maps.osm_xml().replace('<nd ref="2"/>', "<nd ref=2/>", 1)
    line = text[: text.index("<nd ref=2/>")].count("\n") + 1
    assert f"line {line}" in refusal(write(tmp_path, "town.osm", text))


@pytest.mark.parametrize("reverse", [False, True])
def test_a_way_of_a_cut_file_is_clipped_where_nodes_are_missing(tmp_path: Path, reverse: bool) -> None:
    tags = {"highway": "primary", "oneway": "-1" if reverse else "yes"}
    ways = {7: ((1, 2, 99, 3, 98, 97, 4, 3), tags), 8: ((98, 2), tags), 9: ((1, 2), tags)}
    roads = read_roads(maps.write_pbf(tmp_path / "town.osm.pbf", ways))
    assert [len(roads.node[a:b]) for a, b in pairwise(roads.first)] == [2, 2, 2]
    assert roads.name == ("way 7", "way 7", "way 9")
    assert roads.notes[CLIPPED] == 2
    whole = read_roads(maps.write_pbf(tmp_path / "whole.osm.pbf", {9: ways[9]}), origin_deg=maps.degrees(1)[::-1])
    same = read_roads(maps.write_pbf(tmp_path / "again.osm.pbf", ways), origin_deg=maps.degrees(1)[::-1])
    assert same.node_m[same.node[-2:]] == pytest.approx(whole.node_m[whole.node]), "the direction is kept"


def test_a_node_without_coordinates_is_as_one_that_is_missing(tmp_path: Path) -> None:
    roads = read_roads(write(tmp_path, "town.osm", node("")))
    assert roads.notes[CLIPPED] >= 1


def test_without_pyosmium_it_is_said_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "osmium", None)
    assert "pip install 'vnet-emulator[maps]'" in refusal(write(tmp_path, "town.osm", maps.osm_xml()))


# GeoJSON.

HERE, THERE = [-83.74, 42.28], [-83.73, 42.28]


def lines(*features: Any) -> str:
    """A line that is right, and then these features."""
    return maps.collection(maps.line([HERE, THERE]), *features)


BAD_GEOJSON = {
    "no JSON": ("{", "not a GeoJSON feature collection: "),
    "a feature alone": (json.dumps(maps.line([HERE, THERE])), "not a GeoJSON feature collection: "),
    "no feature": (maps.collection(), "no roads"),
    "no line": (maps.collection({"type": "Feature", "geometry": None}), "no roads"),
    "nested without end": ('{"type": "FeatureCollection", "features": ' + "[" * 100_000, ""),
    "metres": (lines(maps.line([[271000.0, 4682000.0], HERE])), "feature 1: longitude = 271000: not within ±180"),
    "swapped": (lines(maps.line([[42.28, -93.74], HERE])), "feature 1: latitude = -93.74: not within ±90"),
    "swapped, though on the earth": (
        lines(maps.line([HERE, [-83.72, 42.28]]), maps.line([HERE[::-1], THERE[::-1]])),
        "feature 2: 9,341 km",
    ),
    "one point": (lines(maps.line([HERE])), "feature 1: its coordinates are not a line"),
    "a point of one number": (lines(maps.line([HERE, [1.0]])), "feature 1: its coordinates are not a line"),
    "a number without end": (lines(maps.line([HERE, [10**400, 42]])), "feature 1: its coordinates are not a line"),
    "no length": (maps.collection(maps.line([HERE, HERE])), "no roads"),
    "a class": (
        lines(maps.line([HERE, THERE], **{"class": "path"})),
        "feature 1: class = 'path': allowed are motorway",
    ),
    "lanes": (lines(maps.line([HERE, THERE], lanes_forward=17)), "feature 1: lanes_forward = 17: 0 to 16 allowed"),
    "half a lane": (lines(maps.line([HERE, THERE], lanes_forward=0.5)), "feature 1: lanes_forward, lanes_backward"),
    "a width": (lines(maps.line([HERE, THERE], lane_width_m=1)), "feature 1: lane_width_m = 1: 2 to 20 allowed"),
    "another projection": (
        json.dumps({"type": "FeatureCollection", "features": [], "crs": {"properties": {"name": "EPSG:3857"}}}),
        "convert it to WGS-84 first",
    ),
}


@pytest.mark.parametrize("name", BAD_GEOJSON)
def test_a_wrong_geojson_file(tmp_path: Path, name: str) -> None:
    text, said = BAD_GEOJSON[name]
    assert said in refusal(write(tmp_path, "town.geojson", text))


# SUMO.

LOCATION = '<location netOffset="{}" projParameter="{}"/>'
BAD_LANE = '<edge id="e" from="1" to="2"><lane id="e_0" index="0" {}/></edge>'
BAD_SUMO = {
    "not XML": (maps.sumo_net(more="<edge>"), "line 22: not XML: mismatched tag"),
    "an unknown encoding": ('<?xml version="1.0" encoding="klingon"?><net/>', "not XML: "),
    "entities": (maps.sumo_net().replace("<net ", BOMB + "\n<net "), "line 2: a document type"),
    "no lane": ("<net/>", "no roads that vehicles may use"),
    "a lane outside of an edge": ("<net>\n<lane id='a'/></net>", "line 2: <lane> outside of an <edge>"),
    "no shape": (maps.sumo_net(more=BAD_LANE.format("")), "line 21: lane e_0: a shape of two points or more"),
    "a shape of text": (maps.sumo_net(more=BAD_LANE.format('shape="1,2 a,b"')), "line 21: lane e_0: shape: 'a,b'"),
    "a width": (maps.sumo_net(more=BAD_LANE.format('shape="1,2 3,4" width="-1"')), "line 21: width = '-1'"),
    "no length": (
        '<net><edge id="e"><lane id="e_0" shape="1,2 1,2"/></edge></net>',
        "no roads that vehicles may use",
    ),
    "mixed projections": (
        maps.sumo_net(more=BAD_LANE.format('shape="1,2 4682000,3"')),
        "lane e_0: the map spans 4682 km",
    ),
    "an offset": (maps.sumo_net(LOCATION.format("a", maps.UTM)), "line 3: netOffset: 'a'"),
    "a projection": (maps.sumo_net(LOCATION.format("0,0", "+proj=flat")), "line 3: projection +proj=flat: not one"),
    "a projection from a file": (
        maps.sumo_net(LOCATION.format("0,0", "+init=/etc/passwd:a")),
        "line 3: projection",
    ),
}


@pytest.mark.parametrize("name", BAD_SUMO)
def test_a_wrong_network_of_sumo(tmp_path: Path, name: str) -> None:
    text, said = BAD_SUMO[name]
    assert said in refusal(write(tmp_path, "town.net.xml", text))


def test_an_origin_for_a_network_that_does_not_say_where_it_is(tmp_path: Path) -> None:
    said = refusal(write(tmp_path, "town.net.xml", maps.sumo_net()), maps.ORIGIN)
    assert said == "states no projection of its metres; leave out the origin"


# Nodes and edges.

LON = maps.arrays()["node_lon_deg"]
METRES = {"node_lon_deg": None, "node_lat_deg": None, "node_x_m": np.arange(4.0) * 100, "node_y_m": np.zeros(4)}
BAD_NPZ: dict[str, tuple[dict[str, Any], str]] = {
    "no nodes": ({"node_lon_deg": None}, "neither 'node_lon_deg' nor 'node_x_m' is among its arrays"),
    "no node": ({"node_lon_deg": np.zeros(0), "node_lat_deg": np.zeros(0)}, "no nodes"),
    "no edge": ({"edges": np.zeros((0, 2), dtype=int)}, "no roads that vehicles may use"),
    "one node": (
        {"node_lon_deg": LON[:1], "node_lat_deg": np.array([42.0]), "edges": np.array([[0, 0]])},
        "no roads that vehicles may use",
    ),
    "fewer latitudes": ({"node_lat_deg": np.zeros(3)}, "node_lat_deg: numbers of shape (4,) are needed"),
    "longitudes as text": ({"node_lon_deg": np.array(["a"] * 4)}, "node_lon_deg: numbers"),
    "not a number": (
        {"node_lon_deg": np.where(np.arange(4) == 2, np.nan, LON)},
        "node_lon_deg[2]: a finite number",
    ),
    "metres as degrees": ({"node_lon_deg": LON * 1000}, "node_lon_deg[0] = -83740: -180 to 180 allowed"),
    "swapped": (
        {"node_lon_deg": np.full(4, 42.3), "node_lat_deg": LON - 10},
        "node_lat_deg[0] = -93.74: -90 to 90",
    ),
    "mixed hemispheres": ({"node_lon_deg": np.where(np.arange(4) == 1, -LON, LON)}, "node 1: 6,003 km from"),
    "an edge to nowhere": (
        {"edges": np.array([(0, 1), (1, 4)])},
        "edges[1]: node 4 does not exist; nodes are 0 to 3",
    ),
    "edges of three": ({"edges": np.zeros((4, 3), dtype=int)}, "edges: pairs of integers"),
    "loops only": ({"edges": np.array([(1, 1), (2, 2)])}, "no roads that vehicles may use"),
    "classes that are numbers": ({"edge_class": np.zeros(5)}, "edge_class: texts of shape (5,)"),
    "a class": ({"edge_class": np.array(["road"] * 4 + ["path"])}, "edge_class[4] = 'path': allowed are motorway"),
    "lanes": ({"edge_lanes": np.array([1, 1, 0, 1, 1])}, "edge_lanes[2] = 0: 1 to 16 allowed"),
    "a width": ({"edge_lane_width_m": np.array([3, 3, 3, 99, 3])}, "edge_lane_width_m[3] = 99: 2 to 20 allowed"),
    "objects": ({"edges": np.array([{}, {}])}, "not an NPZ file: "),
    "metres without north": ({**METRES, "node_y_m": None}, "no array 'node_y_m'"),
    "metres far away": ({**METRES, "node_x_m": np.full(4, 1e9)}, "node_x_m[0] = 1e+09: -2e+07 to 2e+07 allowed"),
    "metres far from each other": (
        {**METRES, "node_x_m": np.arange(4) * 1e6},
        "node 0: the map spans 3000 km, and at most 400",
    ),
    "a projection": (
        {**METRES, "frame_proj": np.array("+proj=flat"), "frame_offset_m": np.zeros(2)},
        "frame_proj: projection +proj=flat: not one that PROJ knows",
    ),
    "a projection that is a number": ({**METRES, "frame_proj": np.array(3.0)}, "frame_proj: one text is needed"),
    "a projection without offset": ({**METRES, "frame_proj": np.array(maps.UTM)}, "no array 'frame_offset_m'"),
}


@pytest.mark.parametrize("name", BAD_NPZ)
def test_wrong_arrays(tmp_path: Path, name: str) -> None:
    changes, said = BAD_NPZ[name]
    np.savez(tmp_path / "town.npz", **maps.arrays(**changes))
    assert said in refusal(tmp_path / "town.npz")


def claims_much(file: zipfile.ZipFile) -> None:
    """An array that says it is larger than it is."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)})
    file.writestr("node_lon_deg.npy", header.getvalue())


def is_much(file: zipfile.ZipFile) -> None:
    """An array of zeros that is small in the file, and too large to take."""
    with file.open("node_lon_deg.npy", "w", force_zip64=True) as member:
        np.lib.format.write_array_header_1_0(member, {"descr": "<f8", "fortran_order": False, "shape": (10**8,)})
        for _ in range(100):
            member.write(bytes(8 * 10**6))


def is_no_array(file: zipfile.ZipFile) -> None:
    """Something else by the name of an array."""
    file.writestr("node_lon_deg.npy", b"hello")


@pytest.mark.slow
@pytest.mark.parametrize("write_member", [claims_much, is_much, is_no_array])
def test_arrays_that_are_not_what_they_say(tmp_path: Path, write_member: Callable[[zipfile.ZipFile], None]) -> None:
    np.savez(tmp_path / "town.npz", **maps.arrays(node_lon_deg=None))
    with zipfile.ZipFile(tmp_path / "town.npz", "a", zipfile.ZIP_DEFLATED, compresslevel=1) as file:
        write_member(file)
    assert refusal(tmp_path / "town.npz").startswith("not an NPZ file: ")


def test_geojson_of_a_map_without_projection(tmp_path: Path) -> None:
    roads = read_roads(write(tmp_path, "town.net.xml", maps.sumo_net()))
    with pytest.raises(ScenarioError, match="the projection of this map is unknown"):
        write_roads(roads, tmp_path / "town.geojson")
    assert not (tmp_path / "town.geojson").exists()
