"""Buildings between vehicles: geometries worked out by hand, and against exact arithmetic."""

from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from emulator.radio.engine import Engine
from emulator.radio.propagation import Obstacles
from emulator.radio.topology import connectivity_of, distances_m
from emulator.scenario.radio import Buildings as Section
from emulator.scenario.scenario import Radio
from emulator.world.buildings import Buildings
from emulator.world.radio_inputs import RadioInputs
from tests.support.radio import drained

pytestmark = pytest.mark.slow

SQUARE: list[tuple[float, float]] = [(0, 0), (10, 0), (10, 10), (0, 10)]
COURT: list[tuple[float, float]] = [(4, 4), (6, 4), (6, 6), (4, 6)]
U_SHAPE: list[tuple[float, float]] = [(0, 0), (30, 0), (30, 20), (20, 20), (20, 10), (10, 10), (10, 20), (0, 20)]
Point = tuple[float, float]
Ring = list[Point]


def obstacles(*buildings: list[Ring], wall_db: float = 9.0, inside_db_per_m: float = 0.4) -> Obstacles:
    section = Section(path=Path("b.csv"), wall_db=wall_db, inside_db_per_m=inside_db_per_m)
    return Obstacles(Buildings.of([[np.array(ring) for ring in rings] for rings in buildings]), section)


def loss_db(subject: Obstacles, *ray: Point, margin_db: float = 1e9) -> float:
    """Return the loss between two points."""
    found_db = subject.loss_db(np.array(ray, dtype=float), np.full((2, 2), margin_db))
    assert found_db[0, 1] == found_db[1, 0]
    return float(found_db[0, 1])


@pytest.mark.parametrize(
    ("rings", "ray", "walls", "inside_m"),
    [
        ([SQUARE], ((-5, 5), (15, 5)), 2, 10),
        ([SQUARE], ((5, -1), (5, 11)), 2, 10),
        ([SQUARE], ((-5, 4), (5, 14)), 2, 2**0.5),
        ([SQUARE], ((-5, 5), (5, 5)), 1, 5),
        ([SQUARE], ((2, 5), (8, 5)), 0, 6),
        ([SQUARE], ((-5, 11), (15, 11)), 0, 0),
        ([SQUARE], ((-5, 5), (-1, 5)), 0, 0),
        ([SQUARE, COURT], ((-5, 5), (15, 5)), 4, 8),
        ([SQUARE, COURT], ((5, 5), (15, 5)), 2, 4),
        ([U_SHAPE], ((-5, 15), (35, 15)), 4, 20),
        ([U_SHAPE], ((15, 15), (15, -5)), 2, 10),
        # Along the southern wall, and along the northern one: a little to the north it is inside, or outside.
        ([SQUARE], ((-5, 0), (15, 0)), 2, 10),
        ([SQUARE], ((-5, 10), (15, 10)), 0, 0),
        # By a corner, through two corners, and from a wall, where a little to the west it is outside.
        ([SQUARE], ((-5, 5), (5, -5)), 2, 0),
        ([SQUARE], ((5, 15), (15, 5)), 0, 0),
        ([SQUARE], ((-5, -5), (15, 15)), 2, 10 * 2**0.5),
        ([SQUARE], ((0, 5), (15, 5)), 2, 10),
        ([SQUARE], ((5, 5), (5, 5)), 0, 0),
    ],
)
def test_the_loss_is_that_of_the_walls_and_of_the_way_inside(
    rings: list[Ring], ray: tuple[Point, Point], walls: int, inside_m: float
) -> None:
    assert loss_db(obstacles(rings), *ray) == pytest.approx(9 * walls + 0.4 * inside_m)
    assert loss_db(obstacles(rings, wall_db=1, inside_db_per_m=0), *ray) == walls


def test_the_losses_of_several_buildings_add_up() -> None:
    other: Ring = [(x + 20, y) for x, y in SQUARE]
    beside: Ring = [(x + 10, y) for x, y in SQUARE]
    assert loss_db(obstacles([SQUARE], [other]), (-5, 5), (35, 5)) == pytest.approx(4 * 9 + 0.4 * 20)
    assert loss_db(obstacles([SQUARE], [beside]), (-5, 5), (35, 5)) == pytest.approx(4 * 9 + 0.4 * 20)
    assert loss_db(obstacles([SQUARE], [other]), (5, 5), (25, 5)) == pytest.approx(2 * 9 + 0.4 * 10)


def test_no_building_costs_nothing() -> None:
    assert loss_db(obstacles(), (-5, 5), (35, 5)) == 0


def test_what_exceeds_the_margin_is_infinite_and_what_does_not_is_exact() -> None:
    assert loss_db(obstacles([SQUARE]), (-5, 5), (15, 5), margin_db=22.0) == pytest.approx(22.0)
    assert loss_db(obstacles([SQUARE]), (-5, 5), (15, 5), margin_db=21.9) == np.inf
    assert loss_db(obstacles([SQUARE]), (-5, 5), (15, 5), margin_db=-1.0) == np.inf


def inside(point: tuple[Any, Any], rings: list[Ring]) -> bool:
    """Return whether a point, at no corner's height, is inside an odd number of rings: by a ray to the west."""
    x, y = point
    odd = False
    for ring in rings:
        for (x1, y1), (x2, y2) in pairwise([*ring, ring[0]]):
            if (y1 < y) != (y2 < y):
                odd ^= Fraction(x1) + (y - Fraction(y1)) * Fraction(x2 - x1) / Fraction(y2 - y1) < x
    return odd


def exactly(ray: tuple[Point, Point], rings: list[Ring]) -> tuple[int, Fraction]:
    """Return walls, and the share of the ray inside, in rational numbers; no corner may be on the ray's line."""
    (ax, ay), (bx, by) = ray
    shares = []
    for ring in rings:
        for (px, py), (qx, qy) in pairwise([*ring, ring[0]]):
            cross = Fraction((bx - ax) * (qy - py) - (by - ay) * (qx - px))
            if cross:
                t = Fraction((px - ax) * (qy - py) - (py - ay) * (qx - px)) / cross
                u = Fraction((px - ax) * (by - ay) - (py - ay) * (bx - ax)) / cross
                shares += [t] if 0 < t < 1 and 0 < u < 1 else []
    within = Fraction(0)
    for one, two in pairwise([Fraction(0), *sorted(shares), Fraction(1)]):
        middle = (one + two) / 2 + (two - one) / 1_000_003  # at no corner's height
        if inside((ax + middle * Fraction(bx - ax), ay + middle * Fraction(by - ay)), rings):
            within += two - one
    return len(shares), within


coordinates = st.integers(-200, 200)
points = st.tuples(coordinates, coordinates)
rings_of_points = st.lists(points, min_size=3, max_size=7, unique=True)


@settings(max_examples=80, deadline=None)
@given(st.lists(st.lists(rings_of_points, min_size=1, max_size=2), min_size=1, max_size=4), points, points)
def test_losses_are_those_of_exact_arithmetic(buildings: list[list[Ring]], start: Point, end: Point) -> None:
    assume(start != end)
    for ring in (ring for rings in buildings for ring in rings):
        for (px, py), (qx, qy) in pairwise([*ring, ring[0]]):
            assume((end[0] - start[0]) * (py - start[1]) != (end[1] - start[1]) * (px - start[0]))
            for x, y in (start, end):  # no end of the ray on the line of a wall
                assume((qx - px) * (y - py) != (qy - py) * (x - px))
    found = [exactly((start, end), rings) for rings in buildings]
    length_m = np.hypot(end[0] - start[0], end[1] - start[1])
    expected_db = sum(9 * walls + 0.4 * float(share) * length_m for walls, share in found)
    assert loss_db(obstacles(*buildings), start, end) == pytest.approx(expected_db, abs=1e-6)


small = st.integers(-3, 3)
lattice_points = st.tuples(small, small)


@settings(max_examples=80, deadline=None)
@given(
    st.lists(st.lists(lattice_points, min_size=3, max_size=6, unique=True), min_size=1, max_size=3),
    lattice_points,
    lattice_points,
    st.data(),
)
def test_orientation_and_first_corner_change_nothing_even_on_walls_and_corners(
    rings: list[Ring], start: Point, end: Point, data: st.DataObject
) -> None:
    found_db = loss_db(obstacles(rings), start, end)
    length_m = float(np.hypot(end[0] - start[0], end[1] - start[1]))
    assert 0 <= found_db <= 9 * sum(map(len, rings)) + 0.4 * length_m + 1e-9
    assert found_db == loss_db(obstacles(rings), end, start)
    turned = []
    for ring in rings:
        first = data.draw(st.integers(0, len(ring) - 1))
        turned.append((ring[first:] + ring[:first])[:: data.draw(st.sampled_from([1, -1]))])
    assert loss_db(obstacles(data.draw(st.permutations(turned))), start, end) == pytest.approx(found_db, abs=1e-9)


def city(seed: int, count: int) -> Buildings:
    """Houses of several sizes, some of them enormous or far away."""
    rng = np.random.default_rng(seed)
    rings = []
    for _ in range(count):
        corner, extent = rng.uniform(0, 600, 2), rng.uniform(3, 30, 2) * rng.choice([1, 1, 1, 20])
        rings.append([corner + np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * extent])
    return Buildings.of(rings)


def test_many_rays_at_once_are_as_many_single_ones_and_those_that_stand_are_remembered() -> None:
    buildings, section = city(1, 60), Section(path=Path("b.csv"))
    rng = np.random.default_rng(2)
    position_m = rng.uniform(-50, 700, (12, 2))
    position_m[3] = np.nan
    margin_db = np.where(distances_m(position_m) < 400, 90.0, -1.0)
    together = Obstacles(buildings, section)
    first_db = together.loss_db(position_m, margin_db)
    moved_m = position_m.copy()
    moved_m[::3] += 17.0
    moved_db = together.loss_db(moved_m, margin_db)
    for points_m, all_db in ((position_m, first_db), (moved_m, moved_db)):
        for i, j in np.argwhere(margin_db >= 0).tolist():
            if i != j:
                alone = Obstacles(buildings, section).loss_db(points_m[[i, j]], np.full((2, 2), 90.0))
                assert all_db[i, j] == alone[0, 1]
    assert np.isfinite(first_db[margin_db >= 0]).any() and (first_db != moved_db).any()


# On the radio.

CORNER: Ring = [(-90, 10), (-10, 10), (-10, 90), (-90, 90)]
AROUND_IT = np.array([(-100.0, 0.0), (0.0, 60.0), (0.0, 0.0)])


def engine(position_m: np.ndarray, **radio: Any) -> Engine:
    section = {
        "path_loss": {"kind": "log_distance"},
        "buildings": {"path": "b.csv"},
        "access_jitter_ms": 0,
        **radio,
    }
    inputs = RadioInputs(buildings=Buildings.of([[np.array(CORNER)]]))
    ids = [f"v{number}" for number in range(len(position_m))]
    return Engine(ids, Radio.model_validate(section), 1, position_m, inputs)


def test_around_a_corner_a_frame_is_weaker_by_the_walls_and_the_way_inside() -> None:
    """The ray from (-100, 0) to (0, 60) enters at (-83.33, 10) and leaves at (-10, 54): 85.52 m, and two walls."""
    loss = 18 + 0.4 * np.hypot(-10 + 250 / 3, 44)
    for floor_dbm, expected in ((-150.0, [20 - 47.86 - 20 * np.log10(np.hypot(100, 60)) - loss]), (-94.0, [])):
        subject = engine(AROUND_IT, path_loss={"kind": "log_distance", "floor_dbm": floor_dbm})
        subject.transmit(0, 0, [b"x"])
        rows = {row["receiver"]: row for row in drained(subject)}
        assert rows["v2"]["outcome"] == "delivered" and rows["v2"]["rssi_dbm"] == pytest.approx(-67.86, abs=0.006)
        assert [rows["v1"]["rssi_dbm"] for _ in expected] == [pytest.approx(each, abs=0.006) for each in expected]
        assert ("v1" in rows) == bool(expected), "below the floor it is out of range"


def test_who_is_hidden_behind_a_building_counts_neither_for_the_peer_cap_nor_for_carrier_sensing() -> None:
    """v1 is nearer to v0 than v3, but behind the corner."""
    position_m = np.vstack([AROUND_IT, [(50.0, 0.0)]])
    for buildings, heard in ((True, {"v2", "v3"}), (False, {"v2", "v1"})):
        radio = {} if buildings else {"buildings": None}
        subject = engine(position_m, max_peers=2, mac={}, **radio)
        for sender in (1, 2, 3):
            subject.transmit(sender * 10_000_000, sender, [b"x"])
        rows = drained(subject)
        assert {r["sender"] for r in rows if r["receiver"] == "v0" and r["outcome"] == "delivered"} == heard
    together = engine(AROUND_IT[:2], mac={})
    for sender in (0, 1):
        together.transmit(sender * 10_000, sender, [bytes(300)])
    together.drain()
    assert len(together.trace) == 0, "neither hears the other"
    assert all((ratio > 0).all() for ratio in together.busy_ratios(100_000_000)), "both sent at once"


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000))
def test_links_are_symmetric_and_buildings_only_take_some_away(seed: int) -> None:
    position_m = np.random.default_rng(seed).uniform(0, 700, (15, 2))
    radio = Radio.model_validate(
        {"path_loss": {"kind": "log_distance"}, "shadowing": {}, "buildings": {"path": "b"}}
    )
    free = connectivity_of(radio, seed).power_mw(position_m, distances_m(position_m))
    behind = connectivity_of(radio, seed, RadioInputs(buildings=city(seed, 20)))
    power_mw = behind.power_mw(position_m, distances_m(position_m))
    assert (power_mw == power_mw.T).all() and (power_mw <= free).all() and (power_mw < free).any()
    assert ((power_mw > 0) == behind.in_range(position_m, distances_m(position_m)) | np.eye(15, dtype=bool)).all()
