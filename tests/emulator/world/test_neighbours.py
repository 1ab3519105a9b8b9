"""The grid finds the pairs in range that comparing all pairs finds, with the same distances."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from emulator.radio.topology import distances_m
from emulator.world.neighbours import Links, _candidates, links_within
from vnet.types import Array

lattice = st.integers(-4, 4).map(float)
anywhere = st.floats(-1e4, 1e4, allow_nan=False)
far_apart = st.floats(-2e7, 2e7, allow_nan=False)
absent = st.just((np.nan, np.nan))


def places(coordinate: st.SearchStrategy[float]) -> st.SearchStrategy[list[tuple[float, float]]]:
    return st.lists(st.tuples(coordinate, coordinate) | absent, max_size=40)


def assert_brute_force_finds_the_same(position_m: Array, range_m: float) -> None:
    found, distance_m = links_within(position_m, range_m), distances_m(position_m)
    near = (distance_m <= range_m) & ~np.eye(len(position_m), dtype=bool)
    assert found.count == len(position_m)
    assert np.array_equal([found.sender, found.receiver], np.nonzero(near))
    assert found.distance_m.tolist() == distance_m[near].tolist()


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(
    st.one_of(places(lattice), places(anywhere), places(far_apart)),
    st.sampled_from([1.0, 2.0, 5.0, 1e-3, 300.0, 1e5, 5e7]),
)
@example([(0.0, 0.0), (3.0, 4.0), (-3.0, -4.0), (5.0, np.nextafter(0.0, 1.0))], 5.0)  # exactly at range
@example([(0.0, 0.0)] * 5 + [(np.nan, np.nan)], 1e-3)  # coincident
@example([], 1.0)
@example([(np.nan, np.nan)] * 3, 1.0)
@example([(-2e7, 0.0), (2e7, 0.0), (2e7, 1e-3), (-2e7, -1e-3)], 1e-3)  # cells narrower than coordinates are precise
def test_the_grid_finds_what_brute_force_finds(vehicles: list[tuple[float, float]], range_m: float) -> None:
    assert_brute_force_finds_the_same(np.array(vehicles, float).reshape(-1, 2), range_m)


@pytest.mark.slow
@settings(max_examples=100, deadline=None)
@given(places(lattice), st.floats(0, 360), st.sampled_from([1.0, 2.0, 5.0]))
def test_the_distance_of_a_neighbour_may_be_the_range_itself(
    vehicles: list[tuple[float, float]], heading_deg: float, range_m: float
) -> None:
    """Rotated lattices have many pairs at the range but for rounding, on either side of it."""
    turn = np.deg2rad(heading_deg)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    assert_brute_force_finds_the_same(np.array(vehicles, float).reshape(-1, 2) @ rotation, range_m)


def test_what_is_compared_follows_the_pairs_in_range() -> None:
    """Eight times as many vehicles at one density have eight times as many candidates, and not 64 times."""
    candidates = []
    for count in (1000, 8000):
        side_m = np.sqrt(count) * 100.0
        position_m = np.random.default_rng(1).uniform(0, side_m, (count, 2))
        candidates.append(len(_candidates(position_m, 200.0)[0]))
    assert candidates[1] < 10 * candidates[0]


@pytest.mark.slow
@given(places(lattice), st.sampled_from([1.0, 2.0, 5.0]))
def test_pairs_are_found_by_number_and_in_the_matrix(vehicles: list[tuple[float, float]], range_m: float) -> None:
    position_m = np.array(vehicles, float).reshape(-1, 2)
    pairs, count = links_within(position_m, range_m), len(vehicles)
    matrix = pairs.matrix()
    sender, receiver = np.divmod(np.arange(count * count), max(count, 1))
    assert pairs.contain(sender, receiver).tolist() == matrix.ravel().tolist()
    assert pairs.out_degrees().tolist() == matrix.sum(axis=1).tolist()
    assert pairs.in_degrees().tolist() == matrix.sum(axis=0).tolist()
    again = Links.of_matrix(matrix, position_m)
    assert (again.sender.tolist(), again.receiver.tolist()) == (pairs.sender.tolist(), pairs.receiver.tolist())
    assert again.distance_m.tolist() == pairs.distance_m.tolist()
