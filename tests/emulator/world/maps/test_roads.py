"""Conversion of roads to lanes: sides, widths, curves, and parts of a lane that are dropped."""

from typing import Any

import numpy as np
import pytest

from emulator.world.maps.roads import CLASSES, NAMES, NUMBER, Roads, RoadsBuilder

EAST = [(0.0, 0.0), (100.0, 0.0)]


def roads(*lines: Any) -> Roads:
    """Roads of a builder: (points, lanes) each, 3 m a lane; equal points are one."""
    builder = RoadsBuilder("town")
    for number, (points, lanes) in enumerate(lines):
        builder.add(f"road {number}", [(point, point) for point in points], NUMBER["primary"], lanes, 3.0)
    return builder.build(builder.coordinates(), None)


def ends(found: Any, lane: int) -> list[tuple[float, ...]]:
    """Return the first points of a lane's segments, and the end of the last."""
    of_lane = np.flatnonzero(found.lane == lane)
    end = found.point_m[of_lane[-1:]] + found.length_m[of_lane[-1:], None] * found.direction[of_lane[-1:]]
    return [tuple(point) for point in np.vstack([found.point_m[of_lane], end]).round(6).tolist()]


def test_people_drive_on_the_right_or_on_the_left() -> None:
    right, left = roads((EAST, (2, 1))).lane_map(), roads((EAST, (2, 1))).lane_map("left")
    assert [ends(right, lane) for lane in range(3)] == [
        [(0.0, 0.0), (100.0, 0.0)],
        [(0.0, -3.0), (100.0, -3.0)],
        [(100.0, 3.0), (0.0, 3.0)],
    ]
    assert [ends(left, lane)[0][1] for lane in range(3)] == [0.0, 3.0, -3.0]
    assert right.heading_rad.tolist() == pytest.approx([0, 0, np.pi])
    assert right.half_width_m == pytest.approx(np.full(3, (3.0 - 1.8) / 2))
    assert not right.one_way.any() and right.road.tolist() == [0, 0, 0]
    assert {right.classes[kind] for kind in right.kind} == {"primary"}


@pytest.mark.parametrize("lanes", [(2, 0), (0, 2)])
def test_lanes_of_a_one_way_road_lie_about_its_centre_line(lanes: tuple[int, int]) -> None:
    found = roads((EAST, lanes)).lane_map()
    assert sorted(ends(found, lane)[0][1] for lane in range(2)) == [-1.5, 1.5]
    assert found.one_way.all()
    assert found.heading_rad == pytest.approx(0.0 if lanes[0] else np.pi)


def test_a_lane_follows_a_bend_at_its_distance() -> None:
    found = roads(([(0.0, 0.0), (100.0, 0.0), (100.0, 100.0)], (1, 1))).lane_map()
    assert ends(found, 0) == [(0.0, -1.5), (101.5, -1.5), (101.5, 100.0)]
    assert ends(found, 1) == [(98.5, 100.0), (98.5, 1.5), (0.0, 1.5)]
    assert found.length_m == pytest.approx([101.5, 101.5, 98.5, 98.5])


def test_a_hairpin_leaves_no_segment_that_runs_backwards() -> None:
    angle = np.linspace(-np.pi / 2, np.pi / 2, 30)
    bend = [(100 + 2 * float(np.cos(a)), 2 + 2 * float(np.sin(a))) for a in angle]
    road = [(0.0, 0.0), *bend, (0.0, 4.0)]
    found = roads((road, (1, 3))).lane_map()
    inner = found.lane == 3  # 7.5 m to the left of a bend of 2 m
    assert (found.length_m > 0).all() and inner.sum() == 2
    assert (found.heading_rad < 2 * np.pi).all()


def test_equal_points_make_no_segment() -> None:
    builder = RoadsBuilder("town")
    points = [(1, (0.0, 0.0)), (2, (50.0, 0.0)), (3, (50.0, 0.0)), (4, (100.0, 0.0))]
    builder.add("road", points, 0, (1, 0), 3.0)
    found = builder.build(builder.coordinates(), None).lane_map()
    assert found.point_m.tolist() == [[0, 0], [50, 0]] and found.length_m.tolist() == [50, 50]


def test_the_smallest_turn_below_east_is_no_whole_turn() -> None:
    found = roads(([(0.0, 0.0), (100.0, -1e-18)], (1, 0))).lane_map()
    assert found.heading_rad.tolist() == [0.0]


def test_every_class_is_narrower_than_its_strip_allows() -> None:
    assert all(2.0 <= CLASSES[name].lane_width_m <= 4.0 and CLASSES[name].lanes >= 1 for name in NAMES)


# Parts.


def test_a_part_is_what_touches_the_box_in_whole_segments() -> None:
    town = roads(
        ([(float(x), 0.0) for x in range(0, 1000, 100)], (1, 1)),
        ([(50.0, -500.0), (50.0, 500.0)], (2, 0)),  # passes through: none of its points is inside
        ([(0.0, 90.0), (90.0, 90.0)], (1, 0)),
    )
    part = town.within(np.array([20.0, -50.0]), np.array([230.0, 50.0]))
    assert part.name == ("road 0", "road 1")
    assert part.length_m.tolist() == [300.0, 1000.0] and part.forward.tolist() == [1, 2]
    assert len(part.node_m) == 6
    assert len(town.within(np.array([0.0, 1000.0]), np.array([1.0, 1001.0]))) == 0


def test_a_road_that_leaves_a_part_and_comes_back_is_two() -> None:
    road = [(0.0, 0.0), (10.0, 0.0), (20.0, 0.0), (20.0, 900.0), (0.0, 900.0), (0.0, 10.0), (5.0, 10.0)]
    part = roads((road, (1, 1))).within(np.array([-5.0, -5.0]), np.array([15.0, 15.0]))
    assert part.name == ("road 0", "road 0")
    assert [part.node_m[part.node[a:b]].tolist() for a, b in zip(part.first, part.first[1:], strict=False)] == [
        [[0, 0], [10, 0], [20, 0]],
        [[0, 900], [0, 10], [5, 10]],
    ]
