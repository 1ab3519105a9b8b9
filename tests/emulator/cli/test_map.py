"""`vnet map`: what it says of a map, its picture, and what it writes."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from emulator.world.maps.files import read_roads
from emulator.world.maps.problems import examine
from emulator.world.maps.roads import RoadsBuilder
from tests.support import maps
from tests.support.command_line import app


@pytest.fixture
def town(tmp_path: Path) -> Path:
    path = tmp_path / "town.geojson"
    path.write_text(maps.geojson(), encoding="utf-8-sig")  # with a byte-order mark, as on Windows
    return path


def vnet_map(*arguments: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["map", *map(str, arguments)], env={"COLUMNS": "100"})
    return result.exit_code, result.output


@pytest.mark.slow
def test_show_says_how_long_roads_are_and_what_is_odd(town: Path) -> None:
    status, text = vnet_map("show", town, "--origin", "42.28,-83.74")
    assert status == 0
    assert "town.geojson: 0.4 × 0.2 km, 2 roads, 4 points" in text
    assert "0.6 km of road, 0.1 km one way; 0.9 km of lane" in text or "0.5 km of road" in text
    assert "its metres start at 42.280000, -83.740000" in text
    assert "dead ends: 3" in text
    status, text = vnet_map("show", town, "--out", town.parent / "no/such/folder/town.png")
    assert status == 2 and "no/such/folder/town.png: cannot be written" in text.replace("\n", "")


@pytest.mark.slow
def test_convert_writes_what_show_reads(town: Path, tmp_path: Path) -> None:
    assert vnet_map("convert", town, tmp_path / "town.npz") == (0, f"wrote {tmp_path / 'town.npz'}\n")
    assert read_roads(tmp_path / "town.npz").length_m.sum() == pytest.approx(550, abs=0.01)


@pytest.fixture
def driven(tmp_path: Path) -> tuple[Path, Path]:
    """A city, and trips through it."""
    city, trips = tmp_path / "city.npz", tmp_path / "trips.csv"
    assert vnet_map("city", city, "--size-m", "4000")[0] == 0
    assert vnet_map("trips", city, trips, "--vehicles", "12", "--duration", "90", "--rate-hz", "5")[0] == 0
    return city, trips


@pytest.mark.slow
def test_datum_says_keys_for_the_map_and_keeps_trips_to_evaluate_with(driven: tuple[Path, Path]) -> None:
    rest = driven[0].with_name("rest.csv")
    status, text = vnet_map("datum", *driven, "--others", rest)
    assert status == 0, text
    keys = tomllib.loads(text.split("# the other")[0])
    assert np.abs(keys["datum_m"]).max() < 0.5 and 0 < keys["datum_sigma_m"] < 0.5
    assert abs(keys["aside_m"]) < 0.5 and 0 < keys["sigma_m"] < 1.5
    first, second = ({row.split(",")[0] for row in path.read_text().splitlines()[1:]} for path in (driven[1], rest))
    assert len(second) == 6 and second < first


@pytest.mark.slow
def test_datum_without_enough_trips_is_refused(driven: tuple[Path, Path]) -> None:
    lines = driven[1].read_text().splitlines()
    only = driven[1].with_name("one.csv")
    only.write_text("\n".join([lines[0], *(line for line in lines if line.startswith(lines[1].split(",")[0]))]))
    status, text = vnet_map("datum", driven[0], only)
    assert status == 2 and "at least 10 are needed" in text and text.count("\n") <= 3
    assert "none.csv: cannot be read: No such file" in vnet_map("datum", driven[0], "none.csv")[1]
    assert "*.csv or *.parquet" in vnet_map("datum", *driven, "--others", "rest.txt")[1]
    before = driven[1].read_bytes()
    assert "is read by this command" in vnet_map("datum", *driven, "--others", driven[1])[1]
    assert driven[1].read_bytes() == before


def test_problems_of_a_map_are_found() -> None:
    builder = RoadsBuilder("town")
    lines = [
        [(0.0, 0.0), (100.0, 0.0)],
        [(0.0, 0.0), (100.0, 0.0)],  # once more
        [(100.5, 0.0), (200.0, 0.0)],  # begins half a metre after the first ends
        [(0.0, 500.0), (3000.0, 500.0)],  # far from all
    ]
    for line in lines:
        builder.add("road", [(point, point) for point in line], 0, (1, 1), 3.0)
    builder.add("road", [(1, (0.0, 0.0)), (2, (0.0, 0.0))], 0, (1, 1), 3.0)  # two points at one place
    found = examine(builder.build(builder.coordinates(), None)).problems
    assert found["duplicate segments"] == "1"
    assert found["segments without length"] == "1"
    assert found["isolated pieces"].startswith("3, 0.3 km") or found["isolated pieces"].startswith("3, ")
    assert any(what.startswith("ends within 1 m") for what in found)
