"""Driven vehicles on a map: the same motion as on a straight road; turns, crossings, lanes that end."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from emulator.scenario.scenario import Scenario
from emulator.world.driven.map_driving import MapRoads
from emulator.world.driven.stepped import DrivenWorld
from emulator.world.driven.vehicles import COLLISION, LANE_ENDED, LIMITED, DrivenVehicles, Happening
from emulator.world.world import build_world
from tests.support.map_files import CROSS, Point, write_map
from vnet.errors import ScenarioError
from vnet.node import Action
from vnet.roads.road_map import RoadMap

EAST, NORTH = ("edge 0", "edge 1"), ("edge 2", "edge 3")


def world_on(
    path: Path | None, vehicles: int, keys: dict[str, Any], drive_on: str = "right", size_m: float = 3000.0
) -> DrivenWorld:
    network = {"kind": "driven", "vehicles": vehicles, "size_m": size_m, "driven": {"road": "map"} | keys}
    data: dict[str, Any] = {"run": {"duration_s": 30.0}, "network": network, "world": {"ranging": {}}}
    if path is not None:
        data["map"] = {"path": str(path), "drive_on": drive_on}
    world = build_world(Scenario.model_validate(data))
    assert isinstance(world, DrivenWorld)
    return world


def drive(world: DrivenWorld, steps: int) -> list[Happening]:
    return [each for _ in range(steps) for each in world.advance()]


def restless(vehicles: DrivenVehicles, rng: np.random.Generator) -> None:
    for number in np.flatnonzero(rng.random(len(vehicles.lane)) < 0.3).tolist():
        action = Action("v", float(rng.uniform(-6, 4)), int(rng.integers(-1, 2)))
        vehicles.take(vehicles.now_ns, number, action)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_a_map_with_one_straight_road_is_the_straight_road(tmp_path: Path, seed: int) -> None:
    """Positions, gaps and events to 1e-9, with lane changes, pile-ups and vehicles that leave."""
    path = write_map(tmp_path, ([(0.0, 3.5), (150.0, 3.5), (400.0, 3.5)], (3, 0)))
    keys = {"gap_m": 6.0, "speed_mps": (15.0, 20.0, 18.0) * 4}
    on_map = world_on(path, 12, {"routes": [["edge 0"]], "start_lanes": [0, 1, 2] * 4} | keys)
    straight = world_on(None, 12, {"road": "straight", "length_m": 400.0, "lanes": 3} | keys)
    rngs = [np.random.default_rng(seed) for _ in range(2)]
    kinds = set()
    for _ in range(200):
        happened = []
        for world, rng in zip((on_map, straight), rngs, strict=True):
            restless(world.vehicles, rng)
            happened.append(world.advance())
        assert [each[:3] for each in happened[0]] == [each[:3] for each in happened[1]]
        kinds |= {each.kind for each in happened[0]}
        one, other = (world.at(world.last_known_period) for world in (on_map, straight))
        assert_allclose(one.fix_m, other.fix_m, atol=1e-9, rtol=0)
        assert_allclose(one.heading_rad, other.heading_rad, atol=1e-9, rtol=0)
        assert_allclose(on_map.vehicles.gaps(100.0), straight.vehicles.gaps(100.0), atol=1e-9, rtol=0)
    assert kinds == {COLLISION, LIMITED}
    assert on_map.vehicles.present.tolist() == straight.vehicles.present.tolist()
    assert on_map.may_leave


@pytest.mark.slow
def test_vehicles_of_two_roads_collide_where_they_cross(tmp_path: Path) -> None:
    world = world_on(write_map(tmp_path, *CROSS), 2, {"routes": [EAST, NORTH], "start_m": [60, 58], "lag_s": 0.0})
    (collision,) = drive(world, 100)
    assert (collision.kind, collision.number) == (COLLISION, 1), "the one that comes later has the other before it"
    assert collision.details["with"] == "v01"
    assert collision.details["closing_m_s"] == pytest.approx(20 * np.sqrt(2))
    assert collision.time_ns / 1e9 == pytest.approx((142 - (4.5 + 1.8) / 2) / 20, abs=0.15)
    assert not world.vehicles.speed.any()
    position_m, _ = world.vehicles.place()
    assert_allclose(position_m[0], [-140 + 20 * 6.9 + 10**2 / 16, 0], atol=2.5)


@pytest.mark.slow
def test_vehicles_that_cross_one_after_the_other_do_not_collide(tmp_path: Path) -> None:
    world = world_on(write_map(tmp_path, *CROSS), 2, {"routes": [EAST, NORTH], "start_m": [60, 50]})
    assert drive(world, 100) == []
    assert world.vehicles.along_m.tolist() == [260, 250]


@pytest.mark.slow
def test_vehicles_leave_where_their_route_ends(tmp_path: Path) -> None:
    world = world_on(write_map(tmp_path, *CROSS), 2, {"routes": [EAST, NORTH], "start_m": [360, 200]})
    drive(world, 50)
    assert world.vehicles.present.tolist() == [False, True]
    assert np.isnan(world.position_m(50)[0]).all()
    assert world.next_change_ns(0) == 2_100_000_000


def turn_of(tmp_path: Path, route: list[str], **keys: Any) -> DrivenWorld:
    """Three vehicles on a road with two lanes each way that another of one lane each way meets from the south."""
    roads = ([(-300.0, 0.0), (0.0, 0.0), (300.0, 0.0)], (2, 2)), ([(0.0, -300.0), (0.0, 0.0)], (1, 1))
    return world_on(write_map(tmp_path, *roads), 3, {"routes": [route, EAST], "speed_mps": 8.0} | keys)


@pytest.mark.slow
def test_a_turn_is_driven_on_an_arc_from_lane_to_lane(tmp_path: Path) -> None:
    world = turn_of(tmp_path, ["edge 0", "edge 2"], start_m=[250, 50, 200], start_lanes=[0, 0, 0])
    course = []
    for _ in range(150):
        drive(world, 1)
        course.append(world.vehicles.place())
    position_m = np.array([place[0][0] for place in course])
    heading_rad = np.array([place[1][0] for place in course])
    assert_allclose(position_m[0], [-300 + 250.8, -5.25], err_msg="the right lane of two")
    assert_allclose(position_m[-1, 0], -1.75, atol=1e-9, err_msg="the lane to the south")
    step_m = np.hypot(*np.diff(position_m, axis=0).T)
    assert_allclose(step_m, 0.8, atol=0.01)
    turn = np.mod(np.diff(heading_rad) + np.pi, 2 * np.pi) - np.pi
    assert turn.max() < 1e-9
    assert turn.min() > -0.2
    assert turn.sum() == pytest.approx(-np.pi / 2)


@pytest.mark.slow
def test_who_turns_off_is_ahead_until_it_has_left_the_road(tmp_path: Path) -> None:
    keys = {"start_m": [275, 245, 30], "start_lanes": [0, 0, 1], "speed_mps": (8.0, 8.0, 8.0)}
    world = turn_of(tmp_path, ["edge 0", "edge 2"], **keys)
    seen = []
    for _ in range(60):
        gap_m, rate = world.vehicles.gaps(100.0)
        seen.append(bool(np.isfinite(gap_m[1])))
        if seen[-1]:
            assert gap_m[1] == pytest.approx(25.5)
            assert rate[1] == 0
        assert np.isnan(gap_m[[0, 2]]).all(), "nobody is ahead of the first, nor in the other lane"
        drive(world, 1)
    lost = seen.index(False)
    assert not any(seen[lost:])
    assert world.vehicles.along_m[0] > 290


def test_a_vehicle_ahead_is_seen_across_a_junction(tmp_path: Path) -> None:
    world = turn_of(tmp_path, ["edge 0", "edge 2"], start_m=[340, 250, 280], start_lanes=[0, 0, 0])
    gap_m, _ = world.vehicles.gaps(100.0)
    assert gap_m[2] == pytest.approx(340 - 280 - 4.5), "the third turns after the first"
    assert np.isfinite(gap_m[1]), "the third is ahead of the second, which does not turn"


@pytest.mark.slow
def test_a_lane_that_ends_is_left_within_the_taper(tmp_path: Path) -> None:
    roads = ([(0.0, 0.0), (200.0, 0.0)], (2, 0)), ([(200.0, 0.0), (500.0, 0.0)], (1, 0))
    world = world_on(
        write_map(tmp_path, *roads),
        2,
        {"routes": [["edge 0", "edge 1"]], "start_m": [150, 150], "speed_mps": (20.0, 10.0), "start_lanes": [0, 1]},
    )
    assert world.vehicles.place()[0][:, 1].tolist() == [-1.75, 1.75]
    happened, across_m = [], []
    for _ in range(120):
        happened += drive(world, 1)
        across_m.append(world.vehicles.place()[0][1, 1])
    assert [(each.kind, each.number, each.details) for each in happened] == [(LANE_ENDED, 1, {"lane": 0})]
    assert happened[0].time_ns / 1e9 == pytest.approx(6.5, abs=0.2), "15 m behind the place where it ends"
    assert np.diff(across_m).max() < 0.01
    assert np.diff(across_m).min() > -0.2
    assert across_m[-1] == pytest.approx(0.0, abs=1e-9)
    world.vehicles.take(world.vehicles.now_ns, 1, Action("v", None, 1))
    assert [each.details["reason"] for each in drive(world, 1)] == ["there is no lane"]


@pytest.mark.slow
def test_two_side_by_side_collide_where_one_lane_ends(tmp_path: Path) -> None:
    roads = ([(0.0, 0.0), (200.0, 0.0)], (2, 0)), ([(200.0, 0.0), (500.0, 0.0)], (1, 0))
    keys = {"routes": [["edge 0", "edge 1"]], "start_m": [150, 149], "start_lanes": [0, 1]}
    kinds = [each.kind for each in drive(world_on(write_map(tmp_path, *roads), 2, keys), 100)]
    assert kinds[0] == COLLISION


def test_people_may_drive_on_the_left(tmp_path: Path) -> None:
    path = write_map(tmp_path, ([(0.0, 0.0), (300.0, 0.0)], (2, 1)))
    keys = {"routes": [["edge 0"], ["-edge 0"]], "start_m": [50, 50, 100], "start_lanes": [0, 0, 1]}
    world = world_on(path, 3, keys, drive_on="left")
    position_m, heading_rad = world.vehicles.place()
    assert_allclose(position_m, [[50.0, 0.0], [250.0, -3.5], [100.0, 3.5]], atol=1e-9)
    assert_allclose(heading_rad, [0.0, np.pi, 0.0])
    assert isinstance(world.lane_map, RoadMap)
    _, _, distance_m = world.lane_map.near(position_m, heading_rad, np.full(3, 1.0))
    assert_allclose(distance_m, 0, atol=1e-9, err_msg="vehicles are on the lanes that programs know")


@pytest.mark.slow
def test_a_closed_road_goes_on(tmp_path: Path) -> None:
    angle = np.linspace(0, 2 * np.pi, 41)[:-1]
    corners: list[Point] = [(50 * float(np.cos(a)), 50 * float(np.sin(a))) for a in angle]
    path = write_map(tmp_path, ([*corners, corners[0]], (1, 0)))
    world = world_on(path, 1, {"routes": [["edge 0"]], "start_m": [0.0]})
    assert not world.may_leave
    drive(world, 200)
    assert np.hypot(*world.vehicles.place()[0][0]) == pytest.approx(50, abs=0.3)
    assert world.vehicles.along_m[0] == 400
    assert np.isnan(world.vehicles.gaps(1000.0)[0]).all(), "nobody is ahead of itself"


@pytest.mark.slow
def test_drawn_routes_lead_through_a_city_without_jumps() -> None:
    keys = {"speed_mps": 12.0, "max_speed_mps": 15.0}
    world = world_on(None, 40, keys)
    places = [world.vehicles.place()]
    while world.next_control_ns() is not None:
        world.advance()
        places.append(world.vehicles.place())
    position_m, heading_rad = (np.array(values) for values in zip(*places, strict=True))
    step_m = np.diff(position_m, axis=0)
    length_m = np.hypot(step_m[..., 0], step_m[..., 1])
    assert np.isfinite(length_m).all(), "nobody takes a dead end"
    assert length_m.max() < 1.2 * 1.6, "outer lanes of turns are longer"
    course_rad = np.arctan2(step_m[..., 1], step_m[..., 0])
    turned = np.mod(np.diff(heading_rad, axis=0) + np.pi, 2 * np.pi) - np.pi
    off = np.abs(np.mod(course_rad - heading_rad[:-1] - turned / 2 + np.pi, 2 * np.pi) - np.pi)[length_m > 0.5]
    assert np.quantile(off, 0.99) < 0.03, "vehicles head where they drive"
    assert isinstance(world.lane_map, RoadMap)
    position_m = position_m.reshape(-1, 2)
    row, _, _ = world.lane_map.near(position_m, np.full(len(position_m), np.nan), np.full(len(position_m), 0.5))
    assert len(np.unique(row)) / len(position_m) > 0.85, "on the lanes that programs know, but in turns"
    fewer = world_on(None, 20, keys)
    assert_allclose(fewer.position_m(0), world.position_m(0)[:20], err_msg="more change nothing for the others")
    low_m, high_m = world.area_m
    assert (position_m >= low_m).all()
    assert (position_m <= high_m).all()


NET = """<net>
<edge id=":n_0" function="internal"><lane id=":n_0_0" shape="95,0 105,0"/></edge>
<edge id=":n_1" function="internal"><lane id=":n_1_0" shape="95,0 99,-1 100,-5"/></edge>
<edge id="in" from="w" to="n"><lane id="in_0" shape="0,0 95,0"/></edge>
<edge id="out" from="n" to="e"><lane id="out_0" shape="105,0 200,0"/></edge>
<edge id="south" from="n" to="s"><lane id="south_0" shape="100,-5 100,-100"/></edge>
</net>"""


@pytest.mark.slow
def test_routes_in_a_network_of_sumo_need_not_name_the_inside_of_intersections(tmp_path: Path) -> None:
    path = tmp_path / "cross.net.xml"
    path.write_text(NET)
    keys = {"routes": [["lane in_0", "lane out_0"], ["lane in_0", "lane south_0"]], "gap_m": 5.0}
    world = world_on(path, 2, keys)
    assert_allclose(world.vehicles.road.end_m, [200, 198], atol=1.0)
    assert world.vehicles.gaps(100.0)[0][1] == pytest.approx(5.0), "both begin on the same road"
    drive(world, 70)
    assert_allclose(world.vehicles.place()[0], [[151.75, 0], [100, -43.5]], atol=1.0)


@pytest.mark.slow
def test_the_vehicle_ahead_is_the_nearest_on_the_way_by_brute_force() -> None:
    world = world_on(None, 60, {"gap_m": 2.0}, size_m=1000.0)
    rng = np.random.default_rng(1)
    found = 0
    for _ in range(12):
        for _ in range(10):
            restless(world.vehicles, rng)
            world.advance()
        road, along_m, left_m = world.vehicles.road, world.vehicles.along_m, world.vehicles.left_m
        assert isinstance(road, MapRoads)
        ahead, way_m = road.ahead(along_m, left_m, 1.8, 150.0)
        for number in range(60):
            expected = brute_force_way_m(road, along_m, left_m, number, 150.0)
            assert way_m[number] == pytest.approx(expected, nan_ok=True, abs=1e-6)
            found += int(ahead[number] >= 0)
    assert found > 100


def brute_force_way_m(road: MapRoads, along_m: Any, left_m: Any, number: int, range_m: float) -> float:
    """Return the way to the nearest vehicle whose centre, or whose tail, is on the way of another."""
    routes = [road._path[first : last + 1] for first, last in zip(road._first_entry, road._last_entry, strict=True)]
    starts = [
        road._start_m[first : last + 1] for first, last in zip(road._first_entry, road._last_entry, strict=True)
    ]

    def spots(n: int) -> list[tuple[int, float]]:
        """Return paths on which a vehicle is, with its position from their beginnings."""
        k = int(np.flatnonzero(starts[n] <= along_m[n])[-1])
        own = [(int(routes[n][k]), along_m[n] - starts[n][k])]
        while k > 0 and along_m[n] - starts[n][k] < 4.5:
            k -= 1
            own.append((int(routes[n][k]), along_m[n] - starts[n][k]))
        return own

    if not np.isfinite(along_m[number]):
        return np.nan
    here = int(np.flatnonzero(starts[number] <= along_m[number])[-1])
    best = np.inf
    for other in range(len(along_m)):
        if other == number or not np.isfinite(along_m[other]) or abs(left_m[other] - left_m[number]) >= 1.8:
            continue
        for path, at_m in spots(other):
            for k in range(here, len(routes[number])):
                if routes[number][k] == path:
                    way_m = starts[number][k] + at_m - along_m[number]
                    if way_m > 0 or (way_m == 0 and other > number):
                        best = min(best, way_m)
    return float(best) if best <= range_m else np.nan


@pytest.mark.parametrize(
    ("count", "keys", "message"),
    [
        (
            1,
            {"routes": [["edge 9"]]},
            r"network.driven.routes: 'edge 9': no such road in .*npz \(did you mean edge",
        ),
        (1, {"routes": [["Main"]]}, "'Main': no such road in .*npz; it has edge 0, edge 1, edge 2, edge 3"),
        (1, {"routes": [["-edge 0"]]}, "routes: '-edge 0': no lane in this direction is as wide as a vehicle"),
        (1, {"routes": [["edge 0", "edge 2"]]}, "'edge 2' does not begin or go on where 'edge 0' leads to"),
        (9, {"routes": [EAST], "gap_m": 50.0}, "9 vehicles a lane with gap_m = 50 take 490.5 m: route"),
        (1, {"routes": [EAST], "start_m": [500]}, r"start_m: 500: route \['edge 0', 'edge 1'\] has 400 m"),
        (2, {"routes": [EAST], "start_m": [50]}, "start_m: 1 value for 2 vehicles"),
        (1, {"routes": [EAST], "start_m": [50], "start_lanes": [1]}, "start_lanes: 1 for vehicle 1: its road"),
        (2, {"routes": [EAST, NORTH], "start_m": [199, 199]}, "v0[12] and v0[12] overlap at the start"),
        (40, {}, "no room for vehicle .* with gap_m = 30"),
    ],
)
def test_a_start_that_cannot_be_is_one_line(tmp_path: Path, count: int, keys: dict[str, Any], message: str) -> None:
    with pytest.raises(ScenarioError, match=message) as error:
        world_on(write_map(tmp_path, *CROSS), count, keys)
    assert "\n" not in str(error.value)
