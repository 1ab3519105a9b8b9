"""Matching vehicles that drive to the map of a city: candidates, hypotheses, and what counts as new evidence."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ndtr

from agents.cooperative.cmm.fusion import condition_on
from agents.cooperative.cmm.map_matching import MAX_LANES, OFF_ROAD_WITHIN_M, CityRoads
from agents.cooperative.cmm.rbpf import Observation, Rbpf, RbpfConfig
from vnet.roads.road_map import RoadMap
from vnet.types import Array

EAST, NORTH = 0.0, np.pi / 2


def road_map(lanes: Sequence[tuple[float, float, float, float]], sigma_m: float = 0.0) -> RoadMap:
    """Lanes of one segment each: x, y where it begins, heading, length."""
    count = len(lanes)
    x, y, heading, length = np.reshape(np.array(lanes, dtype=float), (count, 4)).T
    ones, number = np.ones(count), np.arange(count, dtype=np.int32)
    kind, one_way = np.zeros(count, dtype=np.uint8), np.ones(count, dtype=np.bool_)
    place = np.column_stack([x, y])
    return RoadMap(place, heading, length, 0.85 * ones, kind, one_way, number, number, ("road",), sigma_m)


CROSSING = road_map([(-500, 0, EAST, 1000), (0, -500, NORTH, 1000)])
PARALLEL = road_map([(-500, 3.5 * k, EAST, 1000) for k in range(6)])


def test_lanes_that_do_not_fit_the_heading_are_no_candidates() -> None:
    matcher = CityRoads(CROSSING, 0.05)
    position = np.array([[1.0, 1.0]] * 3)
    row, lane = matcher.seek(position, np.array([EAST, NORTH, np.nan]), np.full(3, 5.0))
    assert row.tolist() == [0, 1, 2, 2]
    assert lane.tolist()[:2] == [0, 1]
    assert sorted(lane.tolist()[2:]) == [0, 1]


def test_of_parallel_lanes_the_nearest_are_candidates() -> None:
    row, lane = CityRoads(PARALLEL, 0.05).seek(np.array([[0.0, 3.0]]), np.array([EAST]), np.array([25.0]))
    assert row.tolist() == [0] * MAX_LANES
    assert lane.tolist() == [1, 0, 2, 3]


def test_of_a_winding_lane_only_the_nearest_piece_is_a_candidate() -> None:
    """Two pieces would count the same lane twice."""
    pieces = road_map([(0, 0, EAST, 20), (20, 0, 0.1, 20), (40, 2, 0.2, 20)])
    pieces.lane[:] = 0
    _, lane = CityRoads(pieces, 0.05).seek(np.array([[19.0, 0.2]]), np.array([0.05]), np.array([25.0]))
    assert lane.tolist() == [0]


@pytest.mark.slow
@settings(max_examples=100, deadline=None)
@given(
    st.lists(st.floats(-60, 60), min_size=1, max_size=6), st.floats(0.05, 5), st.floats(0, 4), st.floats(0.001, 0.9)
)
def test_hypotheses_add_up(offsets: list[float], sigma_m: float, map_sigma_m: float, off_road: float) -> None:
    roads = road_map([(-500, 3.5 * k, EAST, 1000) for k in range(3)], sigma_m=map_sigma_m)
    y = np.array(offsets)
    position = np.stack([np.zeros_like(y), y])[None].repeat(3, axis=0)
    covariance = np.tile(np.eye(2) * sigma_m**2, (3, 1, 1))
    found = CityRoads(roads, off_road).log_likelihood(position, covariance, np.zeros(3, np.intp), np.arange(3), 1)
    s = np.hypot(sigma_m, map_sigma_m)
    on = sum(ndtr((0.85 - (y - 3.5 * k)) / s) - ndtr((-0.85 - (y - 3.5 * k)) / s) for k in range(3))
    off = off_road / (1 - off_road) * 3 * 0.85 / OFF_ROAD_WITHIN_M
    assert found[0] == pytest.approx(np.log(on + off), abs=1e-5)


def test_who_has_no_candidate_scores_nothing() -> None:
    matcher = CityRoads(CROSSING, 0.05)
    position = np.zeros((1, 2, 4))
    found = matcher.log_likelihood(position, np.eye(2)[None], np.array([1]), np.array([0]), 3)
    assert found.shape == (3, 4)
    assert np.array_equal(found[[0, 2]], np.zeros((2, 4)))
    assert (found[1] < 0).all()


def drive(
    roads: RoadMap,
    courses: list[tuple[Array, Array]],
    common_m: Array,
    seed: int = 1,
    config: RbpfConfig | None = None,
) -> Rbpf:
    """A filter that has heard the fixes of vehicles with courses (K, 2) and headings (K,)."""
    rng = np.random.default_rng(seed)
    rbpf = Rbpf(config or RbpfConfig(400, 3.0), roads, np.random.default_rng(seed + 1))
    for k in range(len(courses[0][0])):
        fixes = {
            f"v{number}": Observation(
                course[k] + common_m + rng.standard_normal(2),
                np.eye(2),
                None if np.isnan(heading[k]) else float(heading[k]),
            )
            for number, (course, heading) in enumerate(courses)
        }
        rbpf.step(0.1, fixes)
    return rbpf


def straight(x: float, y: float, heading: float, speed_m_s: float, seconds: float) -> tuple[Array, Array]:
    """A course (K, 2) at constant speed, and its headings."""
    time_s = np.arange(0, seconds, 0.1)
    along = np.array([np.cos(heading), np.sin(heading)])
    return np.array([x, y]) + speed_m_s * time_s[:, None] * along, np.full(len(time_s), heading)


COMMON_M = np.array([2.0, -3.0])


def test_two_who_drive_across_each_other_find_the_common_error() -> None:
    courses = [straight(-200, 0.3, EAST, 12.0, 20), straight(-0.3, -200, NORTH, 12.0, 20)]
    rbpf = drive(CROSSING, courses, COMMON_M)
    assert rbpf.estimate_m == pytest.approx(COMMON_M, abs=0.8)
    assert np.sqrt(np.diag(rbpf.estimate_covariance_m2)) == pytest.approx([0.6, 0.6], abs=0.35)


@pytest.mark.slow
def test_a_turn_is_evidence_across_the_new_road_and_the_old_is_kept() -> None:
    """One vehicle that has driven both roads knows both parts of the error."""
    first, then = straight(-200, 0.0, EAST, 12.0, 16), straight(0.0, 0.0, NORTH, 12.0, 16)
    course = np.concatenate([first[0], then[0]]), np.concatenate([first[1], then[1]])
    both = drive(CROSSING, [course], COMMON_M)
    assert both.estimate_m == pytest.approx(COMMON_M, abs=1.2)
    assert np.sqrt(np.diag(both.estimate_covariance_m2)).max() < 1.0
    one = drive(CROSSING, [first], COMMON_M)
    assert np.sqrt(np.diag(one.estimate_covariance_m2))[0] > 2.0, "along its road nothing is known"


@pytest.mark.slow
def test_who_stands_says_the_same_again_and_no_more() -> None:
    """Its offset is what it was: a minute of standing must not make the filter any surer than a second does."""
    config = RbpfConfig(2000, 3.0, common_tau_s=1e9)
    brief, long = (drive(CROSSING, [straight(-200, 0.5, EAST, 0.0, s)], COMMON_M, config=config) for s in (4, 60))
    deviation = [float(np.sqrt(rbpf.estimate_covariance_m2[1, 1])) for rbpf in (brief, long)]
    assert deviation[1] > 0.7 * deviation[0]
    assert deviation[1] > 0.4, "the lane leaves ± 0.85 m"


@pytest.mark.slow
def test_parallel_lanes_stay_hypotheses_until_somebody_else_decides() -> None:
    alone = drive(PARALLEL, [straight(-200, 7.0, EAST, 12.0, 10)], COMMON_M)
    across = alone.common_m[1] @ alone.weight, np.sqrt(alone.estimate_covariance_m2[1, 1])
    assert across[1] > 1.5, "it may be on several lanes"


@pytest.mark.slow
def test_one_on_a_parking_lot_does_not_outvote_those_on_roads() -> None:
    on_roads = [straight(-200, 0.0, EAST, 12.0, 20), straight(0.0, -200, NORTH, 12.0, 20)]
    on_roads += [straight(-150, 0.3, EAST, 11.0, 20), straight(0.4, -150, NORTH, 10.0, 20)]
    parked = straight(-60, 9.0, EAST, 0.0, 20)
    rbpf = drive(CROSSING, [*on_roads, parked], COMMON_M)
    assert rbpf.estimate_m == pytest.approx(COMMON_M, abs=0.9)


@pytest.mark.slow
def test_far_from_every_road_roads_say_nothing() -> None:
    rbpf = drive(CROSSING, [straight(5000, 5000, EAST, 12.0, 5)], COMMON_M)
    assert np.isfinite(rbpf.estimate_m).all()
    assert np.sqrt(np.diag(rbpf.estimate_covariance_m2)) == pytest.approx([3.0, 3.0], abs=0.7)


@pytest.mark.slow
def test_vehicles_that_brake_and_turn_stay_inside_the_gate() -> None:
    """A full stop from 15 m/s at 3 m/s², and a turn at 3 m/s² across: their fixes are no outliers."""
    time_s = np.arange(0, 12, 0.1)
    speed = np.clip(15 - 3 * np.clip(time_s - 4, 0, None), 0, None)
    stop = np.column_stack([-100 + np.cumsum(speed) * 0.1, np.zeros_like(time_s)])
    turning = np.clip((time_s - 4) * 10 / 30, 0, np.pi / 2)
    curve = np.cumsum(10 * 0.1 * np.column_stack([np.cos(turning), np.sin(turning)]), axis=0) - [40, 0]
    rbpf = drive(CROSSING, [(stop, np.zeros_like(time_s)), (curve, turning)], COMMON_M)
    assert rbpf.vehicles == ["v0", "v1"]
    for name, course in (("v0", stop), ("v1", curve)):
        error = rbpf.position_m(name)[0] - course[-1] - (COMMON_M - rbpf.estimate_m)
        assert np.hypot(*error) < 1.5


@pytest.mark.slow
def test_who_stands_between_two_directions_says_the_same_again_and_no_more() -> None:
    """Without a heading either lane may be the nearer one: which of them is has nothing to do with a turn."""
    street = road_map([(-500, -1.75, EAST, 1000), (500, 1.75, np.pi, 1000)])
    course, _ = straight(-200, 0.0, EAST, 0.0, 60)
    deviations = []
    for seconds in (4, 60):
        place = course[: 10 * seconds]
        config = RbpfConfig(2000, 3.0, common_tau_s=1e9)
        rbpf = drive(street, [(place, np.full(len(place), np.nan))], COMMON_M, config=config)
        deviations.append(float(np.sqrt(rbpf.estimate_covariance_m2[1, 1])))
    assert deviations[1] > 0.7 * deviations[0]


def test_lanes_may_have_any_numbers() -> None:
    """A part of a map keeps the numbers of the whole."""
    roads = road_map([(-500, 3.5 * k, EAST, 1000) for k in range(4)])
    roads.lane[:] = [0, 1, 4, 5]
    row, lane = CityRoads(roads, 0.05).seek(np.full((2, 2), 5.0), np.full(2, EAST), np.full(2, 25.0))
    assert row.tolist() == [0] * 4 + [1] * 4
    assert sorted(lane.tolist()) == [0, 0, 1, 1, 2, 2, 3, 3]


@pytest.mark.slow
def test_hypotheses_of_others_pay_for_a_road_that_was_left_as_ones_own_do() -> None:
    """Else, while a vehicle turns and is on no lane, every neighbour's cloud would outweigh one's own."""
    course, heading = straight(-200, 0.0, EAST, 12.0, 10)
    rbpf = drive(CROSSING, [(course, heading)], COMMON_M)
    turning = Observation(course[-1] + [1.2, 0.0] + COMMON_M, np.eye(2), float(np.pi / 4))
    for _ in range(4):
        rbpf.step(0.1, {"v0": turning})
    assert not len(rbpf.tracks.candidate_lane), "no lane points north-east"
    own = rbpf.tracks.map_log_likelihood[0]
    assert own @ rbpf.weight < -0.05
    log_road = condition_on(rbpf, rbpf.sample(200), np.random.default_rng(0)).map_log_likelihood
    assert log_road[0].mean() == pytest.approx(own @ rbpf.weight, abs=0.3)
