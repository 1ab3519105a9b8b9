"""Driven vehicles on their road: start, gaps, lanes, collisions, limits, the end of the road."""

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from emulator.scenario.network import Driven
from emulator.world.driven.road import start_on_single_road
from emulator.world.driven.vehicles import COLLISION, LIMITED, DrivenVehicles, Happening, rectangles_overlap
from vnet.errors import ScenarioError
from vnet.node import Action

STEP_NS = 100_000_000


def vehicles_of(count: int, **keys: Any) -> DrivenVehicles:
    node_ids = [f"v{number:02d}" for number in range(1, count + 1)]
    driven = Driven(**keys)
    return DrivenVehicles(driven, node_ids, STEP_NS, start_on_single_road(driven, count))


def drive(vehicles: DrivenVehicles, steps: int) -> list[Happening]:
    return [each for _ in range(steps) for each in vehicles.advance()]


def ask(vehicles: DrivenVehicles, number: int, acceleration: float | None = None, lane: int = 0) -> list[Happening]:
    return vehicles.take(vehicles.now_ns, number, Action("v", acceleration, lane))


def test_vehicles_stand_one_behind_the_other_the_first_in_front() -> None:
    vehicles = vehicles_of(4, gap_m=20.0)
    assert vehicles.along_m.tolist() == [75.75, 51.25, 26.75, 2.25]
    gap_m, rate = vehicles.gaps(100.0)
    assert_allclose(gap_m, [np.nan, 20.0, 20.0, 20.0])
    assert_allclose(rate, [np.nan, 0.0, 0.0, 0.0])


def test_vehicles_are_put_into_the_lanes_in_turn() -> None:
    vehicles = vehicles_of(5, lanes=2, gap_m=10.0)
    assert vehicles.lane.tolist() == [0, 1, 0, 1, 0]
    assert vehicles.left_m.tolist() == [0.0, 3.5, 0.0, 3.5, 0.0]
    assert_allclose(vehicles.gaps(100.0)[0], [np.nan, np.nan, 10.0, 10.0, 10.0])


def test_on_a_ring_the_first_follows_the_last() -> None:
    vehicles = vehicles_of(4, road="ring", length_m=200.0, gap_m=20.0)
    assert_allclose(vehicles.gaps(150.0)[0], [200 - 3 * 24.5 - 4.5, 20.0, 20.0, 20.0])
    assert_allclose(vehicles.gaps(100.0)[0], [np.nan, 20.0, 20.0, 20.0], err_msg="beyond the sensor's range")
    position_m, heading_rad = vehicles.place()
    assert_allclose(np.hypot(*position_m.T), 200 / (2 * np.pi))
    assert_allclose(np.mod(np.arctan2(*position_m.T[::-1]) + np.pi / 2, 2 * np.pi), heading_rad)


def test_an_action_holds_from_the_next_control_instant_until_another() -> None:
    vehicles = vehicles_of(1, lag_s=0.0, speed_mps=10.0)
    ask(vehicles, 0, 1.0)
    drive(vehicles, 1)
    assert vehicles.speed[0] == pytest.approx(10.1), "at the instant itself"
    vehicles.take(vehicles.now_ns + 1, 0, Action("v", -1.0))
    drive(vehicles, 1)
    assert vehicles.speed[0] == pytest.approx(10.2), "an action after the instant waits for the next"
    drive(vehicles, 2)
    assert vehicles.speed[0] == pytest.approx(10.0)
    assert [row[4, 0] for row in vehicles.log.rows] == [1.0, 1.0, -1.0, -1.0]


def test_what_a_vehicle_cannot_do_is_limited_and_told_once_in_a_row() -> None:
    vehicles = vehicles_of(1, lag_s=0.0)
    (told,) = ask(vehicles, 0, -20.0)
    assert (told.kind, told.details) == (LIMITED, {"acceleration_m_s2": -20.0, "limit_m_s2": -8.0})
    assert ask(vehicles, 0, -21.0) == []
    drive(vehicles, 1)
    assert vehicles.speed[0] == pytest.approx(20 - 0.8)
    assert ask(vehicles, 0, -8.0) == []
    assert [each.kind for each in ask(vehicles, 0, 3.1)] == [LIMITED]


def test_a_lane_change_takes_its_time_and_ends_in_the_lane() -> None:
    vehicles = vehicles_of(1, lanes=2, lane_change_s=2.0)
    ask(vehicles, 0, lane=1)
    across = []
    for _ in range(25):
        drive(vehicles, 1)
        across.append(float(vehicles.left_m[0]))
    assert across[9] == pytest.approx(1.75)
    assert across[18] < across[19] == across[24] == 3.5
    assert (np.diff(across) >= 0).all()


@pytest.mark.parametrize(("lane", "reason"), [(-1, "there is no lane"), (1, "changing already")])
def test_a_lane_change_that_cannot_be_is_told(lane: int, reason: str) -> None:
    vehicles = vehicles_of(1, lanes=3)
    if lane == 1:
        ask(vehicles, 0, lane=1)
        drive(vehicles, 1)
    ask(vehicles, 0, lane=lane)
    (told,) = drive(vehicles, 1)
    assert (told.kind, told.details) == (LIMITED, {"lane": lane, "reason": reason})


def test_whoever_runs_into_another_is_told_once_and_both_brake() -> None:
    vehicles = vehicles_of(2, gap_m=10.0, speed_mps=(10.0, 20.0), lag_s=0.0)
    happened = drive(vehicles, 40)
    (collision,) = [each for each in happened if each.kind == COLLISION]
    assert collision.number == 1
    assert collision.details == {"with": "v01", "closing_m_s": 10.0}
    assert collision.time_ns == 11 * STEP_NS, "10 m at 10 m/s, and a step for the overlap"
    assert vehicles.speed.tolist() == [0.0, 0.0]
    assert vehicles.along_m[0] - vehicles.along_m[1] >= 4.5 - 1e-9, "bumper to bumper"
    ask(vehicles, 1, 3.0)
    drive(vehicles, 5)
    assert vehicles.speed.tolist() == [0.0, 0.0], "wrecks do not drive"


def test_in_a_pile_up_each_pair_collides_once_and_nobody_gets_through() -> None:
    vehicles = vehicles_of(5, gap_m=6.0, speed_mps=(0.0, 20.0, 20.0, 20.0, 20.0), lag_s=0.0)
    pairs = {(each.number, each.details["with"]) for each in drive(vehicles, 80) if each.kind == COLLISION}
    assert pairs == {(1, "v01"), (2, "v02"), (3, "v03"), (4, "v04")}
    assert not vehicles.speed.any()
    assert (-np.diff(vehicles.along_m) > 3.5).all()


def test_lanes_pass_each_other_and_a_change_into_somebody_is_a_collision() -> None:
    keys: dict[str, Any] = {"lanes": 2, "start_m": (50.0, 20.0), "speed_mps": (10.0, 20.0), "start_lanes": (0, 1)}
    passing = vehicles_of(2, **keys)
    assert drive(passing, 80) == []
    assert passing.along_m[1] > passing.along_m[0] + 20
    beside = vehicles_of(2, **keys | {"start_m": (50.0, 49.0), "speed_mps": 10.0})
    ask(beside, 1, lane=-1)
    (collision,) = drive(beside, 40)
    assert collision.kind == COLLISION
    assert beside.left_m[1] == pytest.approx(1.8, abs=0.25), "as soon as they overlap"


def test_vehicles_leave_at_the_end_of_a_straight_road() -> None:
    vehicles = vehicles_of(2, length_m=100.0, gap_m=20.0, speed_mps=20.0)
    gone = []
    for step in range(60):
        drive(vehicles, 1)
        before = vehicles.present.sum()
        vehicles.remove_arrived()
        if vehicles.present.sum() < before:
            gone.append(step)
    assert len(gone) == 2
    assert not vehicles.present.any()
    assert np.isnan(vehicles.place()[0]).all()


@pytest.mark.parametrize(
    ("count", "keys", "message"),
    [
        (3, {"start_m": (10.0, 20.0)}, "start_m: 2 values for 3 vehicles"),
        (2, {"start_m": (10.0, 12.0)}, "v02 and v01 overlap|v01 and v02 overlap"),
        (9, {"road": "ring", "length_m": 200.0}, "take 310.5 m: the road has length_m = 200"),
        (2, {"speed_mps": (1.0,)}, "speed_mps: 1 value for 2 vehicles"),
    ],
)
def test_a_start_that_cannot_be_is_one_line(count: int, keys: dict[str, Any], message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        vehicles_of(count, **keys)


def test_rectangles_overlap_as_their_points_do() -> None:
    rng = np.random.default_rng(1)
    offset_m, turns = rng.uniform(-5, 5, (400, 2)), rng.uniform(0, 2 * np.pi, (2, 400))
    found = rectangles_overlap(offset_m, turns[0], turns[1], 4.5, 1.8)
    # Points of a fine grid on the first rectangle, in the frame of the second.
    along, across = (axis.ravel() for axis in np.meshgrid(np.linspace(-2.25, 2.25, 91), np.linspace(-0.9, 0.9, 37)))
    (cos, sin), (other_cos, other_sin) = ((np.cos(turn)[:, None], np.sin(turn)[:, None]) for turn in turns)
    east = cos * along - sin * across - offset_m[:, :1]
    north = sin * along + cos * across - offset_m[:, 1:]
    x, y = np.abs(other_cos * east + other_sin * north), np.abs(other_cos * north - other_sin * east)
    inside = ((x < 2.25) & (y < 0.9)).any(axis=1)
    nearly = ((x < 2.31) & (y < 0.96)).any(axis=1)
    assert found[inside].all()
    assert not found[~nearly].any()
    assert 50 < inside.sum() < 250


def test_rectangles_that_touch_do_not_overlap() -> None:
    offset_m = np.array([[4.5, 0.0], [0.0, 1.8], [3.15, 0.0], [3.14, 0.0]])
    other_rad = np.array([0.0, 0.0, np.pi / 2, np.pi / 2])
    assert rectangles_overlap(offset_m, np.zeros(4), other_rad, 4.5, 1.8).tolist() == [False, False, False, True]
