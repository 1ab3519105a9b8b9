"""Map matching against the closed form in the log domain, near and far from the road."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import log_ndtr, ndtr

from agents.cooperative.cmm.map_matching import FAR_SIGMAS, REACH, STEPS, candidate_lanes, log_on_lane, normal_cdf
from vnet.roads.lanes import LaneMap

HALF_WIDTH_M = 0.85


def reference(offset_m: float, sigma_m: float) -> float:
    """log(Φ(a) − Φ(b)) in the tail where both are small, by the symmetry of Φ."""
    upper = (HALF_WIDTH_M - abs(offset_m)) / sigma_m
    lower = (-HALF_WIDTH_M - abs(offset_m)) / sigma_m
    log_upper, log_lower = log_ndtr(upper), log_ndtr(lower)
    return float(log_upper + np.log1p(-np.exp(log_lower - log_upper)))


@pytest.mark.slow
@settings(max_examples=100, deadline=None)
@given(st.floats(-500, 500), st.floats(0.01, 10))
def test_it_is_the_closed_form_near_and_far(offset_m: float, sigma_m: float) -> None:
    value = log_on_lane(np.array([[offset_m]]), np.array([[sigma_m]]), HALF_WIDTH_M)[0, 0]
    assert np.isfinite(value)
    far = (HALF_WIDTH_M - abs(offset_m)) / sigma_m <= -FAR_SIGMAS
    assert value == pytest.approx(reference(offset_m, sigma_m), rel=1e-12 if far else 0.0, abs=0.0 if far else 2e-6)


@pytest.mark.slow
@settings(max_examples=100, deadline=None)
@given(st.floats(-60, 60), st.integers(-REACH * STEPS, REACH * STEPS))
def test_the_table_is_the_normal_distribution(anywhere: float, node: int) -> None:
    """Also at the seams of the table's steps, and right before and after them."""
    seam = node / STEPS
    x = np.array([anywhere, np.nextafter(seam, -100), seam, np.nextafter(seam, 100)])
    value, exact = normal_cdf(x), ndtr(x)
    assert np.all(np.abs(value - exact) < 2e-9)
    assert np.all(np.abs(value - exact)[x >= -FAR_SIGMAS] < 5e-7 * exact[x >= -FAR_SIGMAS])


def test_beyond_the_table_the_normal_distribution_is_constant() -> None:
    assert normal_cdf(np.array([-1e9, -REACH - 1e-9])).max() < 1e-18
    assert np.array_equal(normal_cdf(np.array([REACH, REACH + 1e-9, 1e9])), [1.0, 1.0, 1.0])


def test_near_and_far_particles_in_one_call_agree_with_single_ones() -> None:
    offsets = np.array([[0.0, 0.8, 3.0, 40.0, -700.0]])
    together = log_on_lane(offsets, np.array([[0.2]]), HALF_WIDTH_M)
    alone = [log_on_lane(offsets[:, [i]], np.array([[0.2]]), HALF_WIDTH_M)[0, 0] for i in range(5)]
    assert np.array_equal(together[0], alone)
    assert np.all(np.diff(together[0]) < 0), "further away is less likely, however far"


LANES = LaneMap(
    np.array([[0.0, 0.0], [0.0, 3.5], [0.0, 0.0], [100.0, 0.0]]),
    np.array([0.0, np.pi, np.pi / 2, np.pi / 2]),
    HALF_WIDTH_M,
)


def test_a_heading_leaves_the_lanes_that_fit_it() -> None:
    position = np.array([1.0, 1.0])
    assert candidate_lanes(LANES, position, 0.05, gate_m=5.0).tolist() == [0]
    assert candidate_lanes(LANES, position, 2 * np.pi - 0.05, gate_m=5.0).tolist() == [0]
    assert candidate_lanes(LANES, position, np.pi, gate_m=5.0).tolist() == [1]


def test_without_a_heading_all_within_the_gate_compete() -> None:
    assert candidate_lanes(LANES, np.array([1.0, 1.0]), None, gate_m=5.0).tolist() == [0, 1, 2]


def test_with_none_in_the_gate_the_nearest_that_fits_is_taken() -> None:
    assert candidate_lanes(LANES, np.array([80.0, 0.0]), np.pi / 2, gate_m=5.0).tolist() == [3]
    assert candidate_lanes(LANES, np.array([60.0, 0.0]), np.pi / 4, gate_m=5.0).tolist() == []


def test_a_vehicle_far_off_the_map_has_no_lane() -> None:
    """One absurd fix, forced onto the nearest lane, would outweigh all other roads."""
    assert candidate_lanes(LANES, np.array([60.0, 0.0]), np.pi / 2, gate_m=5.0).tolist() == []
    assert candidate_lanes(LANES, np.array([60.0, 0.0]), np.pi / 2, gate_m=50.0).tolist() == [3]


def test_signed_offsets_are_positive_to_the_right_of_travel() -> None:
    assert LANES.signed_offset_m(np.array([5.0, -2.0]), 0) == pytest.approx(2.0)
    assert LANES.signed_offset_m(np.array([5.0, 2.0]), 1) == pytest.approx(-1.5)
    assert LANES.signed_offset_m(np.array([1.5, 9.0]), 2) == pytest.approx(1.5)


def test_a_map_survives_the_wire() -> None:
    again = LaneMap.from_wire(LANES.to_wire())
    assert np.array_equal(again.point_m, LANES.point_m)
    assert np.array_equal(again.heading_rad, LANES.heading_rad)
    assert again.half_width_m == LANES.half_width_m
