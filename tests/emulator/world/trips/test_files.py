"""Files of trips: the readers, and refusals in one line that names the row or line."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.scenario.scenario import Scenario
from emulator.world.trips import motion as samples_module
from emulator.world.trips.drive import READERS, write_trips
from emulator.world.trips.motion import Motion, Samples, Trip
from emulator.world.world import World, build_world
from tests.support.files import write
from vnet.errors import ScenarioError

TWO = "id,time_s,x_m,y_m\na,0,0,0\na,2,20,0\nb,1,0,50\nb,3,0,90\n"
FCD = """<?xml version="1.0" encoding="UTF-8"?>
<fcd-export xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance">
    <timestep time="0.00">
        <vehicle id="a" x="0.0" y="0.0" angle="90.00" type="car" speed="10.00" pos="5" lane="e_0" slope="0.0"/>
    </timestep>
    <timestep time="1.00">
        <vehicle id="a" x="10.0" y="0.0" angle="0.00" speed="0.00"/>
        <vehicle id="b" x="0.0" y="50.0" angle="180.00" speed="20.00"/>
        <person id="p" x="1" y="1" angle="0" speed="1"/>
    </timestep>
    <timestep time="2.00">
        <vehicle id="b" x="0.0" y="30.0" angle="180.00" speed="20.00"/>
    </timestep>
</fcd-export>
"""


def read(path: Path, origin_deg: tuple[float, float] | None = None, **options: Any) -> dict[str, Trip]:
    trips = READERS[path.suffix](path, options.get("window_s")).trips(origin_deg)
    return {trip.node_id: trip for trip in trips}


def world_of(path: Path, duration_s: float = 2.0, rate_hz: float = 10.0, **network: Any) -> World:
    trips = {"kind": "trips", "path": str(path), **network}
    data = {"run": {"duration_s": duration_s}, "network": trips, "world": {"gnss": {"rate_hz": rate_hz}}}
    return build_world(Scenario.model_validate(data))


def refusal(path: Path, **network: Any) -> str:
    """Return the error of a bad file without its name, with which it must begin."""
    with pytest.raises(ScenarioError) as caught:
        world_of(path, **network)
    text = str(caught.value)
    assert text.startswith(f"{path}: ") and "\n" not in text
    return text.removeprefix(f"{path}: ")


# What is read.


def test_a_csv_file_may_be_sorted_by_vehicle_or_by_time_and_have_other_columns(tmp_path: Path) -> None:
    header, *rows = TWO.split()
    by_time = sorted(rows, key=lambda row: float(row.split(",")[1]))
    mixed = "\n".join([f"note,{header}", *(f"x,{row}" for row in by_time)]) + "\n"
    for name, text in (("by_vehicle.csv", TWO), ("by_time.csv", mixed), ("mark.csv", "\ufeff" + TWO)):
        trips = read(write(tmp_path, name, text))
        assert list(trips) == ["a", "b"]
        assert trips["b"].time_s.tolist() == [1, 3]
        assert trips["b"].position_m.tolist() == [[0, 50], [0, 90]]


def test_speeds_and_headings_may_be_missing_here_and_there(tmp_path: Path) -> None:
    header, *rows = TWO.split()
    some = [f"{row},{'' if number else '10.0'}," for number, row in enumerate(rows)]
    text = "\n".join([f"{header},speed_mps,heading_rad", *some]) + "\n"
    trips, plain = read(write(tmp_path, "some.csv", text)), read(write(tmp_path, "t.csv", TWO))
    for name in ("a", "b"):
        assert np.array_equal(trips[name].position_m, plain[name].position_m)
    hollow = text.replace(rows[0], ",".join([*rows[0].split(",")[:2], "", ""]))
    assert "x_m" in refusal(write(tmp_path, "hollow.csv", hollow))


def test_parquet_says_what_csv_says_and_ids_may_be_numbers(tmp_path: Path) -> None:
    path = tmp_path / "trips.parquet"
    columns = {"id": [7, 7, 8, 8], "time_s": [0, 2, 1, 3], "x_m": [0, 20, 0, 0], "y_m": [0.0, 0.0, 50.0, 90.0]}
    pq.write_table(pa.table(columns), path)
    trips, same = read(path), read(write(tmp_path, "t.csv", TWO.replace("\na", "\n7").replace("\nb", "\n8")))
    for name in ("7", "8"):
        assert np.array_equal(trips[name].position_m, same[name].position_m)
        assert np.array_equal(trips[name].time_s, same[name].time_s)


@pytest.mark.parametrize("name", ["t.csv", "t.parquet"])
def test_what_is_written_is_read_again_though_a_vehicle_never_moves(tmp_path: Path, name: str) -> None:
    position_m = np.array([[[0.0, 0.0], [9.0, 9.0]], [[3.0, 4.0], [9.0, 9.0]]])
    heading_rad = np.array([[0.5, math.nan], [0.5, math.nan]])
    write_trips(Motion(("a", "b"), position_m, heading_rad), tmp_path / name, 2.0)
    trips = read(tmp_path / name)
    assert trips["a"].position_m.tolist() == [[0, 0], [3, 4]] and trips["a"].time_s.tolist() == [0, 0.5]
    assert trips["a"].heading_rad is not None and trips["a"].heading_rad.tolist() == [0.5, 0.5]
    assert trips["b"].position_m.tolist() == [[9, 9], [9, 9]] and trips["b"].heading_rad is None


def test_the_same_sample_twice_counts_once(tmp_path: Path) -> None:
    twice = "".join(f"{row}\n{row}\n" for row in TWO.split()[1:])
    trips = read(write(tmp_path, "t.csv", TWO.split()[0] + "\n" + twice))
    assert trips["a"].time_s.tolist() == [0, 2]


def test_in_a_matrix_nan_is_not_there_and_ids_are_made_up_or_given(tmp_path: Path) -> None:
    path = tmp_path / "m.npz"
    x = np.array([[0.0, 1, 2, 3], [math.nan, math.nan, 5, 6]])
    np.savez(path, x_m=x, y_m=x + 100, rate_hz=2.0)
    trips = read(path)
    assert list(trips) == ["v1", "v2"]
    assert trips["v2"].time_s.tolist() == [1.0, 1.5]
    assert trips["v2"].position_m.tolist() == [[5, 105], [6, 106]]
    np.savez(path, x_m=x, y_m=x, rate_hz=2, id=np.array(["car", "bus"]))
    assert list(read(path)) == ["car", "bus"]


def test_sumos_angles_are_clockwise_from_north_and_ours_the_other_way_from_east(tmp_path: Path) -> None:
    trips = read(write(tmp_path, "fcd.xml", FCD))
    assert trips["a"].heading_rad == pytest.approx([0, math.pi / 2])
    assert trips["b"].heading_rad == pytest.approx([-math.pi / 2] * 2)
    assert trips["a"].speed_mps is not None and trips["a"].speed_mps.tolist() == [10, 0]
    assert trips["b"].position_m.tolist() == [[0, 50], [0, 30]]


def test_sumos_header_tells_degrees_from_metres(tmp_path: Path) -> None:
    header = '<!-- generated\n<output><fcd-output.geo value="true"/></output>\n-->\n'
    body = FCD.split("\n", 1)[1].replace('"10.0" y="0.0"', '"0.001" y="0.0"')
    body = body.replace('y="50.0"', 'y="0.0005"').replace('y="30.0"', 'y="0.0003"')
    trips = read(write(tmp_path, "fcd.xml", header + body), origin_deg=(0.0, 0.0))
    assert trips["a"].position_m[1] == pytest.approx([111.32, 0], abs=0.01), "a thousandth of a degree of longitude"


def test_degrees_become_metres_from_the_origin_or_from_their_middle(tmp_path: Path) -> None:
    text = "id,time_s,lat_deg,lon_deg\na,0,42.28,-83.74\na,9,42.28,-83.74\nb,0,42.30,-83.70\nb,9,42.30,-83.70\n"
    path = write(tmp_path, "t.csv", text)
    a, b = (trip.position_m[0] for trip in read(path).values())
    # Ellipsoidal: a degree of latitude is 111 080 m there, one of longitude 82 460 m.
    assert b - a == pytest.approx([0.04 * 82_460, 0.02 * 111_080], rel=1e-3)
    assert a + b == pytest.approx([0, 0], abs=1.0), "the middle of both is zero"
    assert read(path, origin_deg=(42.28, -83.74))["a"].position_m[0] == pytest.approx([0, 0], abs=1e-6)


def test_the_middle_of_trips_across_the_antimeridian_is_between_them(tmp_path: Path) -> None:
    text = "id,time_s,lat_deg,lon_deg\na,0,10,179.998\na,9,10,179.998\nb,0,10,-179.998\nb,9,10,-179.998\n"
    a, b = (trip.position_m[0] for trip in read(write(tmp_path, "t.csv", text)).values())
    # 0.004 degrees, of 109 640 m each there; the eastern one is b.
    assert b - a == pytest.approx([438.6, 0], abs=1.0)
    assert a + b == pytest.approx([0, 0], abs=1.0)


def test_headings_in_degrees_are_noted(tmp_path: Path) -> None:
    header = HEADER.replace("\n", ",heading_rad\n")
    for heading, notes in (("90", 1), ("6.3", 0)):
        samples = READERS[".csv"](write(tmp_path, "t.csv", f"{header}a,0,0,0,{heading}\na,9,9,0,0\n"), None)
        samples.trips(None)
        assert len(samples.notes) == notes


def test_ids_of_sumo_are_escaped_so_that_they_can_be_told_apart(tmp_path: Path) -> None:
    ids = ("flow#1:0/2", ":J1_0", "plain-1.0", "a-b c", "-7", "flow-23-1")
    rows = "".join(f"{name},{time_s},{9 * number},0\n" for number, name in enumerate(ids) for time_s in (0, 2))
    samples = READERS[".csv"](write(tmp_path, "t.csv", HEADER + rows), None)
    assert [trip.node_id for trip in samples.trips(None)] == [
        "flow-23-1-3a-0-2f-2", "x-3a-J1_0", "plain-1.0", "a-2d-b-20-c", "x-2d-7", "flow-23-1",
    ]  # fmt: skip
    (note,) = samples.notes
    assert "'flow#1:0/2' is flow-23-1-3a-0-2f-2" in note and note.endswith(", … (4)")


def test_ids_that_would_be_the_same_are_refused(tmp_path: Path) -> None:
    rows = "".join(f"{name},{time_s},{9 * time_s},0\n" for name in ("a#b", "a-23-b") for time_s in (0, 2))
    path = write(tmp_path, "t.csv", HEADER + rows)
    assert refusal(path) == "ids 'a#b' and 'a-23-b' are both a-23-b"


# What is refused.

HEADER = "id,time_s,x_m,y_m\n"


@pytest.mark.parametrize(
    ("text", "named"),
    [
        (HEADER + "a,0,1,2\na\x07b,1,1,2\n", "row 3: id = 'a\\x07b'"),
        (HEADER + "a,0," + "1" * 5_000_000 + ",2\n", "not a CSV file of trips"),
        (b"\xff\xfe" * 50, "not a CSV file"),
        (b"\0" * 5000, "no column 'id'"),
    ],
)
def test_a_csv_file_of_other_bytes_is_refused(tmp_path: Path, text: str | bytes, named: str) -> None:
    assert named in refusal(write(tmp_path, "t.csv", text))


def test_a_matrix_of_objects_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "m.npz"
    pickled = np.array([[{"a": 1}]], dtype=object)
    np.savez(path, x_m=pickled, y_m=pickled, rate_hz=1)
    assert "not an NPZ file" in refusal(path)
    assert "not an NPZ file" in refusal(write(tmp_path, "other.npz", b"PK\3\4 nothing"))


def test_a_wrong_parquet_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "t.parquet"
    assert "not a Parquet file" in refusal(write(tmp_path, "t.parquet", b"PAR1 nothing PAR1"))
    columns: dict[str, Any] = {"id": ["a", None], "time_s": [0.0, 1.0], "x_m": [0.0, 1.0], "y_m": [0.0, 1.0]}
    pq.write_table(pa.table(columns), path)
    assert "row 2: id is missing" in refusal(path)
    pq.write_table(pa.table({**columns, "id": ["a", "a"], "x_m": [0.0, None]}), path)
    assert "row 2: x_m = nan" in refusal(path)
    pq.write_table(pa.table({**columns, "id": ["a", "a"], "x_m": ["one", "two"]}), path)
    assert "x_m holds string: Failed to parse string: 'two'" in refusal(path)


def test_other_files_are_refused_by_their_name(tmp_path: Path) -> None:
    assert "trips are read from .csv, .parquet, .npz, .xml" in refusal(write(tmp_path, "trips.json", "{}"))


def test_a_file_without_end_in_sight_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(samples_module, "MOST_SAMPLES", 5)
    path = write(tmp_path, "t.csv", HEADER + "".join(f"a,{time},{time},0\n" for time in range(9)))
    assert "more than 5 samples; set network.start_s" in refusal(path)
    assert world_of(path, duration_s=1.0, start_s=0.0, longest_gap_s=2.0).node_ids == ("a",)


@pytest.mark.slow
@given(
    rows=st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 8), st.integers(0, 1)), min_size=1, max_size=30),
    batch=st.integers(1, 7),
)
def test_batches_do_not_matter(rows: list[tuple[str, int, int]], batch: int) -> None:
    """Whatever a file holds, it is taken or refused a batch at a time or at once, as a plain reader would."""

    def outcome(size: int) -> object:
        samples = Samples(Path("f"), "row")
        try:
            for start in range(0, len(rows), size):
                ids, time, x = zip(*rows[start : start + size], strict=True)
                place = np.arange(start, start + len(ids)) + 1
                columns = {"time_s": np.array(time, float), "x_m": np.array(x, float) * 5, "y_m": np.zeros(len(x))}
                samples.add(pa.array(ids), place, columns)
            return [(trip.node_id, trip.time_s.tolist(), trip.position_m.tolist()) for trip in samples.trips(None)]
        except ScenarioError as error:
            return str(error)

    last: dict[str, tuple[int, int]] = {}
    wrong = None
    for number, (name, time, x) in enumerate(rows, start=1):
        if name in last and (time < last[name][0] or (time == last[name][0] and x != last[name][1])):
            wrong = number
            break
        last[name] = (time, x)
    at_once = outcome(len(rows))
    if wrong is not None:
        assert isinstance(at_once, str) and f"row {wrong}:" in at_once
    assert outcome(batch) == at_once or isinstance(at_once, str)
    assert isinstance(outcome(batch), str) == isinstance(at_once, str)
