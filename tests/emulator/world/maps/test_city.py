"""A generated city, and trips along it and along other maps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from emulator.drivers.simulate import simulate
from emulator.scenario.loading import load_scenario
from emulator.scenario.scenario import Scenario
from emulator.world.maps.city import city_roads
from emulator.world.maps.files import read_roads
from emulator.world.maps.roads import Roads
from emulator.world.trips.generate import LATERAL_MPS2, LEFT, Side, StreetNetwork, generate_motion
from emulator.world.trips.motion import Motion
from emulator.world.world import build_world
from tests.support.command_line import app
from tests.support.paths import ROOT
from tests.support.recorded import prepared
from vnet.errors import ScenarioError
from vnet.roads.road_map import RoadMap

pytestmark = pytest.mark.slow

PERIOD_NS = 100_000_000
FASTEST_M_S = 29.0 * 1.05


@pytest.fixture(scope="module")
def city() -> Roads:
    return city_roads(1, 2000.0)


def drives(roads: Roads, vehicles: int = 12, seed: int = 1, periods: int = 601) -> Motion:
    return generate_motion("the city", roads, vehicles, seed, periods, PERIOD_NS)


def test_a_seed_is_a_city(city: Roads) -> None:
    again, other = city_roads(1, 2000.0), city_roads(2, 2000.0)
    assert np.array_equal(city.node_m, again.node_m) and np.array_equal(city.node, again.node)
    assert len(other.node_m) != len(city.node_m) or not np.array_equal(other.node_m, city.node_m)


def test_its_streets_hang_together_and_point_everywhere(city: Roads) -> None:
    """A common error is seen across roads only: where all of them point the same two ways, less is seen."""
    network = StreetNetwork("the city", city)
    assert len(network.streets.start) > 500
    lanes = city.lane_map()
    axis = np.mod(lanes.heading_rad, np.pi)
    share, _ = np.histogram(axis, bins=6, range=(0, np.pi), weights=lanes.length_m)
    assert (share / share.sum()).min() > 0.03
    kinds = {lanes.classes[kind] for kind in lanes.kind.tolist()}
    assert {"motorway", "motorway_link", "primary", "secondary", "tertiary", "residential", "service"} <= kinds
    assert city.one_way.any()


@pytest.mark.parametrize("size_m", [999.0, 10_001.0, float("nan")])
def test_a_city_has_a_size(size_m: float) -> None:
    with pytest.raises(ScenarioError, match=r"size_m = .*: 1000 to 10000 allowed"):
        city_roads(1, size_m)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**31))
def test_vehicles_drive_as_vehicles_do(seed: int) -> None:
    """No jump, no speed beyond what roads allow, no bend faster than tyres do, headings along the way."""
    motion = drives(city_roads(1, 2000.0), vehicles=6, seed=seed)
    step_m = np.diff(motion.position_m, axis=0)
    speed = np.hypot(step_m[..., 0], step_m[..., 1]) / 0.1
    assert np.nanmax(speed) < 1.2 * FASTEST_M_S
    turn = np.abs(np.mod(np.diff(motion.heading_rad, axis=0) + np.pi, 2 * np.pi) - np.pi) / 0.1
    lateral = turn[:-1] * np.minimum(speed[:-1], speed[1:])
    assert np.nanquantile(lateral, 0.99) < 1.6 * LATERAL_MPS2
    way = np.arctan2(step_m[..., 1], step_m[..., 0])
    fast = speed > 5
    off = np.abs(np.mod(way - motion.heading_rad[:-1] + np.pi, 2 * np.pi) - np.pi)
    assert np.quantile(off[fast], 0.99) < 0.2


def test_vehicles_keep_to_their_lanes(city: Roads) -> None:
    motion, lanes = drives(city, vehicles=30), city.lane_map()
    there = np.isfinite(motion.position_m[..., 0])
    place, heading = motion.position_m[there], motion.heading_rad[there]
    row, segment, distance = lanes.near(place, heading, np.full(len(place), 20.0))
    first = np.flatnonzero(np.diff(row, prepend=-1))
    assert len(first) > 0.9 * len(place), "the others turn, or are on parking lots"
    assert np.mean(distance[first] <= lanes.half_width_m[segment[first]] + 0.1) > 0.9


def test_one_more_vehicle_changes_nothing_for_the_others(city: Roads) -> None:
    few, more = drives(city, vehicles=8), drives(city, vehicles=9)
    assert more.node_ids[:8] == few.node_ids
    assert np.array_equal(more.position_m[:, :8], few.position_m, equal_nan=True)


def test_some_enter_late_and_some_leave_early_and_some_stand(city: Roads) -> None:
    motion = drives(city, vehicles=60)
    there = np.isfinite(motion.position_m[..., 0])
    assert (~there[0]).any() and (there[0] & ~there[-1]).any()
    step_m = np.hypot(*np.diff(motion.position_m, axis=0).transpose(2, 0, 1))
    assert np.nanmean(step_m < 0.01) > 0.05
    assert ((there[1:] & ~there[:-1]).sum(axis=0) + there[0] == 1).all(), "each is there once, without a gap"


@pytest.mark.parametrize(("side", "right_m"), [(Side(1.0, 1.5), 3.25), (LEFT, -1.75)])
def test_people_drive_on_their_side_of_the_road_and_park_there(tmp_path: Path, side: Side, right_m: float) -> None:
    """Also aside, if the map says so: programs are told of lanes that lie there."""
    roads = write_graph(tmp_path / "r.npz", [(0, 0), (3000, 0)], [(0, 1), (1, 0)])
    motion = generate_motion("a road", roads, 40, 1, 300, PERIOD_NS, side)
    step_m = np.diff(motion.position_m, axis=0)
    drives = np.hypot(step_m[..., 0], step_m[..., 1]) > 0.5
    right = np.where(step_m[..., 0] > 0, -1, 1) * motion.position_m[:-1, :, 1]
    assert np.median(right[drives]) == pytest.approx(right_m, abs=0.3)
    heading = motion.heading_rad
    beside = -motion.position_m[..., 1] * np.sign(np.cos(heading))
    parked = np.abs(motion.position_m[..., 1]) > 6
    assert parked.any(), "some come from a parking lot"
    assert (np.abs(beside[parked]) > 6).all()


def test_no_vehicle_is_present(city: Roads) -> None:
    with pytest.raises(ScenarioError, match="the city: no vehicle is present within 0 s"):
        drives(city, vehicles=3, periods=1)


def write_graph(path: Path, node_m: Sequence[tuple[float, float]], edges: list[tuple[int, int]]) -> Roads:
    x, y = np.array(node_m).T
    np.savez(path, node_x_m=x, node_y_m=y, edges=np.array(edges))
    return read_roads(path)


def test_one_road_is_driven_once(tmp_path: Path) -> None:
    """A street whose end can be left only by a U-turn."""
    roads = write_graph(tmp_path / "r.npz", [(0, 0), (800, 0)], [(0, 1), (1, 0)])
    motion = drives(roads, vehicles=5)
    assert (np.abs(motion.position_m[..., 1]) < 25)[np.isfinite(motion.position_m[..., 1])].all()


def test_roads_without_a_way_back_are_refused(tmp_path: Path) -> None:
    roads = write_graph(tmp_path / "r.npz", [(0, 0), (500, 0), (900, 50)], [(0, 1), (1, 2)])
    with pytest.raises(ScenarioError, match="the city: no two points of its roads can be reached from each other"):
        drives(roads)


def test_of_a_map_in_pieces_the_largest_is_driven(tmp_path: Path) -> None:
    ring = [(0, 0), (300, 0), (300, 300), (0, 300)]
    nodes = [*ring, (9000, 0), (9500, 0)]
    edges = [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 4)]
    motion = drives(write_graph(tmp_path / "r.npz", nodes, edges), vehicles=6)
    assert np.nanmax(motion.position_m[..., 0]) < 400


def test_more_than_memory_holds_is_refused(city: Roads) -> None:
    with pytest.raises(ScenarioError, match=r"10000 vehicles for 864001 periods: at most 50,000,000 states"):
        drives(city, vehicles=10_000, periods=864_001)


def test_a_run_through_the_city(tmp_path: Path) -> None:
    """Its programs have the map, and find the error that they share."""
    scenario = load_scenario(ROOT / "scenarios" / "city.toml", ["run.duration_s=8", "network.vehicles=10"])
    emulation = prepared(scenario, tmp_path / "run")
    assert isinstance(emulation.world.lane_map, RoadMap)
    simulate(emulation)
    first, last = emulation.metrics.rows[2], emulation.metrics.rows[-1]
    assert first.common_error_rmse_m is not None and last.common_error_rmse_m is not None
    assert last.not_finite == 0
    assert last.common_error_rmse_m < 1.5


def test_a_city_of_ones_own(tmp_path: Path) -> None:
    path = tmp_path / "ring.npz"
    nodes = [(300.0 * x, 300.0 * y) for x in range(4) for y in range(4)]
    edges = [(4 * x + y, 4 * u + v) for x in range(4) for y in range(4) for u in range(4) for v in range(4)
             if abs(x - u) + abs(y - v) == 1]  # fmt: skip
    write_graph(path, nodes, edges)
    data = {"network": {"kind": "city", "vehicles": 4}, "map": {"path": str(path)}, "run": {"duration_s": 10}}
    world = build_world(Scenario.model_validate(data))
    assert world.moves and isinstance(world.lane_map, RoadMap)
    assert np.nanmin(world.course_m) > -30 and np.nanmax(world.course_m) < 930


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_what_the_commands_write_can_be_driven(tmp_path: Path, ending: str) -> None:
    town, trips = tmp_path / "town.npz", tmp_path / f"trips.{ending}"
    run = CliRunner()
    made = run.invoke(app, ["map", "city", str(town), "--size-m", "1500", "--seed", "3"])
    assert made.exit_code == 0 and "km of road" in made.output, made.output
    made = run.invoke(app, ["map", "trips", str(town), str(trips), "--vehicles", "5", "--duration", "20"])
    assert made.exit_code == 0 and "5 vehicles" in made.output, made.output
    data = {"network": {"kind": "trips", "path": str(trips)}, "map": {"path": str(town)}, "run": {"duration_s": 18}}
    world = build_world(Scenario.model_validate(data))
    assert len(world.node_ids) >= 4
    assert isinstance(world.lane_map, RoadMap)


def test_names_that_cannot_be_written_are_said_at_once(tmp_path: Path) -> None:
    run = CliRunner()
    for command in (["map", "city", "town.png"], ["map", "trips", "nowhere.npz", "trips.txt"]):
        done = run.invoke(app, command)
        assert done.exit_code == 2
        assert command[-1] in done.output
