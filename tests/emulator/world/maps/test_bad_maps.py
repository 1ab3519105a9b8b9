"""Maps that cannot be used: each is refused in one line that names the file, and the line or the feature."""

import io
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
from tests.support.files import write
from vnet.errors import ScenarioError


def refusal(path: Path, origin_deg: tuple[float, float] | None = None) -> str:
    """Return the error of a file without its name, with which it must begin."""
    with pytest.raises(ScenarioError) as refused:
        read_roads(path, origin_deg)
    text = str(refused.value)
    assert text.startswith(f"{path}: ") and text.isprintable()
    return text.removeprefix(f"{path}: ")


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


def test_a_deleted_way_is_no_road(tmp_path: Path) -> None:
    text = maps.osm_xml({7: ((1, 2), {"highway": "primary"}), 8: ((2, 3), {"highway": "primary"})})
    roads = read_roads(write(tmp_path, "town.osm", text.replace('<way id="8"', '<way id="8" visible="false"')))
    assert roads.name == ("way 7",) and roads.notes["deleted ways"] == 1
    joined = text.replace('<way id="8"', "<way id='8' action='delete'")
    assert "deleted in JOSM" in refusal(write(tmp_path, "josm.osm", joined))
    history = text.replace('<way id="8" version="1"', '<way id="7" version="2"')
    assert refusal(write(tmp_path, "history.osm", history)) == "way 7 is there in two versions: no map of one day"
    deleted = text.replace('<way id="8"', '<way id="7" version="2" visible="false"/><way id="8"')
    assert refusal(write(tmp_path, "deleted.osm", deleted)) == "way 7 is there in two versions: no map of one day"


def test_without_pyosmium_it_is_said_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "osmium", None)
    assert "pip install 'vnet-emulator[maps]'" in refusal(write(tmp_path, "town.osm", maps.osm_xml()))


# SUMO.


def test_an_origin_for_a_network_that_does_not_say_where_it_is(tmp_path: Path) -> None:
    said = refusal(write(tmp_path, "town.net.xml", maps.sumo_net()), maps.ORIGIN)
    assert said == "states no projection of its metres; leave out the origin"


# Nodes, and edges or roads.


@pytest.mark.parametrize(
    ("array", "values", "said"),
    [
        ("road_node", [0, 1, 9, 2], "road_node[2] = 9: 0 to 3 allowed"),
        ("road_node", [0, 1.5, 1, 2], "road_node[1] = 1.5: a whole number is needed"),
        ("road_first", [0, 1, 4], "road_first: 0 to 4 in steps of 2 or more are needed"),
        ("road_first", [], "road_first: 0 to 4 in steps of 2 or more are needed"),
        ("road_first", [0, 2], "road_first: 0 to 4 in steps of 2 or more are needed"),
        ("road_backward", [0, 0], "road_forward[1]: a road without lanes"),
        ("road_class", ["primary", "path"], "road_class[1] = 'path': allowed are "),
        ("road_name", [1, 2], "road_name: texts of shape (2,) are needed"),
        ("road_name", ["a", "\udc80"], "road_name: '\\udc80': a text with a lone surrogate"),
        ("road_one_way", None, "no array 'road_one_way'"),
    ],
)
def test_roads_that_cannot_be(tmp_path: Path, array: str, values: list[object] | None, said: str) -> None:
    arrays: dict[str, Any] = {
        "node_x_m": [0.0, 100.0, 100.0, 50.0],
        "node_y_m": [0.0, 0.0, 90.0, 50.0],
        "road_node": [0, 1, 1, 2],
        "road_first": [0, 2, 4],
        "road_forward": [1, 0],
        "road_backward": [0, 1],
        "road_lane_width_m": [3.5, 3.5],
        "road_one_way": [False, True],
    }
    np.savez(tmp_path / "town.npz", **arrays)
    assert read_roads(tmp_path / "town.npz").name == ("road 0", "road 1")
    changed = {name: rows for name, rows in {**arrays, array: values}.items() if rows is not None}
    np.savez(tmp_path / "town.npz", **changed)
    assert refusal(tmp_path / "town.npz").startswith(said)


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
