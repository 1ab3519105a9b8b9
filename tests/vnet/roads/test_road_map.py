"""The map that vehicles have of a city: which lanes are near, cutting out a part, and its way through messages."""

import contextlib
from dataclasses import fields
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from vnet.roads.road_map import HEADING_TOLERANCE_RAD, INDEX_STEP_M, RoadMap, touch_box

COLUMNS = [field.name for field in fields(RoadMap) if field.name not in ("classes", "sigma_m", "datum_sigma_m")]


def road_map(point_m: Any, heading_rad: Any, length_m: Any, sigma_m: float = 0.0) -> RoadMap:
    """A map of segments, each a lane of its own."""
    count = len(heading_rad)
    number = np.arange(count, dtype=np.int32)
    return RoadMap(
        np.asarray(point_m, dtype=float).reshape(count, 2),
        np.asarray(heading_rad, dtype=float),
        np.asarray(length_m, dtype=float),
        np.full(count, 0.85),
        (number % 2).astype(np.uint8),
        number % 3 == 0,
        number,
        number[::-1].copy(),
        ("primary", "residential"),
        sigma_m,
    )


def scattered(seed: int, count: int) -> RoadMap:
    """Segments here and there, some of them much longer than the index's step."""
    rng = np.random.default_rng(seed)
    length_m = rng.choice([0.01, 3.0, 30.0, 400.0], count) * rng.uniform(0.5, 1.5, count)
    return road_map(rng.uniform(-300, 300, (count, 2)), rng.uniform(0, 2 * np.pi, count), length_m, 3.5)


def by_hand(roads: RoadMap, position_m: Any, heading_rad: float, reach_m: float) -> dict[int, float]:
    """The segments near a position and their distances, looked at one by one as any schoolbook does."""
    found = {}
    for segment in range(len(roads)):
        turn = (heading_rad - roads.heading_rad[segment]) % (2 * np.pi)
        if min(turn, 2 * np.pi - turn) > HEADING_TOLERANCE_RAD:
            continue
        start = complex(*roads.point_m[segment])
        step = roads.length_m[segment] * np.exp(1j * roads.heading_rad[segment])
        share = ((complex(*position_m) - start) * step.conjugate()).real / abs(step) ** 2
        distance_m = abs(complex(*position_m) - start - min(1.0, max(0.0, share)) * step)
        if distance_m <= reach_m:
            found[segment] = distance_m
    return found


@pytest.mark.slow
@given(
    seed=st.integers(0, 2**32),
    count=st.integers(0, 40),
    vehicles=st.integers(0, 5),
    longest_m=st.sampled_from([1.0, 40.0, 300.0, 2000.0]),
)
@example(seed=1, count=40, vehicles=5, longest_m=2000.0)
def test_near_finds_what_looking_at_each_segment_finds(
    seed: int, count: int, vehicles: int, longest_m: float
) -> None:
    roads = scattered(seed, count)
    rng = np.random.default_rng(seed)
    position_m = rng.uniform(-400, 400, (vehicles, 2))
    heading_rad = np.where(rng.random(vehicles) < 0.3, np.nan, rng.uniform(-7, 7, vehicles))
    reach_m = rng.uniform(0, longest_m, vehicles)
    row, segment, distance_m = roads.near(position_m, heading_rad, reach_m)
    assert sorted(zip(row, distance_m, strict=True)) == list(zip(row, distance_m, strict=True))
    assert len(set(zip(row.tolist(), segment.tolist(), strict=True))) == len(row)
    for vehicle in range(vehicles):
        expected = by_hand(roads, position_m[vehicle], heading_rad[vehicle], reach_m[vehicle])
        assert set(segment[row == vehicle].tolist()) == set(expected)
        for one, metres in zip(segment[row == vehicle].tolist(), distance_m[row == vehicle], strict=True):
            assert metres == pytest.approx(expected[one], abs=1e-9)


def test_a_long_segment_is_found_once_and_from_anywhere_along_it() -> None:
    roads = road_map([[0.0, 0.0]], [0.0], [50 * INDEX_STEP_M])
    along_m = np.linspace(-1.0, 50 * INDEX_STEP_M + 1.0, 500)
    position_m = np.column_stack([along_m, np.full(500, 2.0)])
    row, segment, distance_m = roads.near(position_m, np.zeros(500), np.full(500, 3.0))
    assert row.tolist() == list(range(500)) and not segment.any()
    assert distance_m[1:-1] == pytest.approx(2.0) and distance_m[0] == pytest.approx(np.hypot(1, 2))


def test_only_lanes_of_the_heading_fit_also_across_north_and_east() -> None:
    roads = road_map(np.zeros((4, 2)), [0.1, 6.2, np.pi, 1.5], np.full(4, 10.0))
    row, segment, _ = roads.near(np.zeros((2, 2)), np.array([6.25, np.nan]), np.full(2, 1.0))
    assert segment[row == 0].tolist() == [0, 1]
    assert segment[row == 1].tolist() == [0, 1, 2, 3]  # who does not know its heading fits all


@pytest.mark.slow
def test_a_map_whose_lanes_are_endless_does_not_fill_the_memory() -> None:
    roads = road_map([[0.0, 0.0], [0.0, 5.0]], [0.0, 0.0], [1e8, 10.0])
    _, segment, _ = roads.near(np.array([[1e6, 1.0]]), np.zeros(1), np.full(1, 3.0))
    assert segment.tolist() == [0]


def test_who_is_nowhere_has_no_lane_near() -> None:
    roads = scattered(3, 40)
    position_m = np.array([[np.nan, np.nan], [0.0, 0.0], [1e9, -1e9], [np.inf, 0.0]])
    row, _, _ = roads.near(position_m, np.full(4, np.nan), np.full(4, 500.0))
    assert set(row.tolist()) == {1}


# Parts.


@pytest.mark.slow
@given(seed=st.integers(0, 2**32), side_m=st.floats(0.1, 300), east_m=st.floats(-300, 300))
def test_a_part_holds_what_touches_the_box(seed: int, side_m: float, east_m: float) -> None:
    roads = scattered(seed, 30)
    low, high = np.array([east_m, -side_m / 2]), np.array([east_m + side_m, side_m / 2])
    part = roads.within(low, high)
    share = np.linspace(0, 1, 2001)[:, None, None]
    reached = roads.point_m + share * (roads.length_m[:, None] * roads.direction)
    certain = ((reached >= low) & (reached <= high)).all(axis=2).any(axis=0)
    grown = ((reached >= low - 0.4) & (reached <= high + 0.4)).all(axis=2).any(axis=0)  # steps are 0.3 m at most
    assert set(roads.road[certain].tolist()) <= set(part.road.tolist()) <= set(roads.road[grown].tolist())
    assert part.classes == roads.classes and part.sigma_m == roads.sigma_m
    for name in COLUMNS:
        assert getattr(part, name).tobytes() == getattr(roads, name)[part.road].tobytes()


def test_a_segment_that_passes_a_corner_does_not_touch_the_box() -> None:
    start, end = np.array([[0.0, 1.9], [0.0, 2.1], [-5.0, 0.5]]), np.array([[1.9, 0.0], [2.1, 0.0], [5.0, 0.5]])
    assert touch_box(start, end, np.array([0.0, 0.0]), np.array([1.0, 1.0])).tolist() == [True, False, True]


# Messages.


def assert_same(one: RoadMap, other: RoadMap) -> None:
    assert one.classes == other.classes and one.sigma_m == other.sigma_m
    for name in COLUMNS:
        a, b = getattr(one, name), getattr(other, name)
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())


@pytest.mark.slow
@given(seed=st.integers(0, 2**32), count=st.integers(0, 20))
def test_a_map_comes_through_a_message_bit_by_bit(seed: int, count: int) -> None:
    roads = scattered(seed, count)
    assert_same(RoadMap.from_wire(msgspec.msgpack.decode(msgspec.msgpack.encode(roads.to_wire()))), roads)
    assert_same(RoadMap.from_wire(roads.to_wire()), roads)


def changed(**changes: object) -> dict[str, Any]:
    return {**scattered(1, 3).to_wire(), **changes}


THREE = np.array([1.0, 2.0, 3.0])
WRONG = {
    "no dictionary": [1, 2],
    "nothing": {},
    "no tag": {name: value for name, value in changed().items() if name != "tag"},
    "another tag": changed(tag="lanes"),
    "a column more": changed(width=b""),
    "a column less": {name: value for name, value in changed().items() if name != "lane"},
    "a column that is a list": changed(heading_rad=[1.0, 2.0, 3.0]),
    "half a number": changed(heading_rad=THREE.tobytes()[:-4]),
    "columns that differ in length": changed(heading_rad=np.append(THREE, 4.0).tobytes()),
    "a point of one number": changed(point_m=THREE.tobytes()),
    "a point that is not finite": changed(point_m=np.array([0, 0, 0, 0, 0, np.inf]).tobytes()),
    "a heading beyond a turn": changed(heading_rad=(2 * THREE + 1).tobytes()),
    "a heading that is no number": changed(heading_rad=(THREE * np.nan).tobytes()),
    "no length": changed(length_m=(THREE - 1).tobytes()),
    "an endless length": changed(length_m=(THREE * np.inf).tobytes()),
    "a length around the earth": changed(length_m=(THREE * 1e8).tobytes()),
    "a point beyond the earth": changed(point_m=np.array([0, 0, 0, 0, 0, 2e8]).tobytes()),
    "a negative width": changed(half_width_m=(-THREE).tobytes()),
    "a class that is not there": changed(kind=bytes([0, 1, 2])),
    "a truth value that is none": changed(one_way=bytes([0, 1, 2])),
    "a negative road": changed(road=np.array([0, -1, 2], dtype="<i4").tobytes()),
    "a negative lane": changed(lane=np.array([0, -1, 2], dtype="<i4").tobytes()),
    "classes that are no list": changed(classes="ab"),
    "classes that are no names": changed(classes=[1, 2]),
    "too many classes": changed(classes=["a"] * 256),
    "a class with a long name": changed(classes=["a" * 65, "b"]),
    "a deviation that is text": changed(sigma_m="1"),
    "a negative deviation": changed(sigma_m=-1.0),
    "a negative deviation of the datum": changed(datum_sigma_m=-1.0),
    "a deviation that is no number": changed(sigma_m=float("nan")),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_no_map_is_refused(name: str) -> None:
    with pytest.raises(ValueError):
        RoadMap.from_wire(WRONG[name])


@pytest.mark.slow
@given(
    st.recursive(
        st.none() | st.integers() | st.floats() | st.text(max_size=5) | st.binary(max_size=40),
        lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from([*COLUMNS, "tag"]), inner),
        max_leaves=10,
    ),
    st.sampled_from(["tag", "classes", "sigma_m", "datum_sigma_m", *COLUMNS]),
)
def test_whatever_stands_in_a_message_is_a_map_or_refused(value: object, name: str) -> None:
    for data in (value, changed(**{name: value})):
        with contextlib.suppress(ValueError):
            assert isinstance(RoadMap.from_wire(data), RoadMap)
