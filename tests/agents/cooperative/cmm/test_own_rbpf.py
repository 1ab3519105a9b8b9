"""The filter of a vehicle that tracks itself alone, and the bound, against textbook filters."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from agents.cooperative.cmm.information import Information
from agents.cooperative.cmm.kalman_bound import KalmanBound, LaneModel, MultipathLaneModel
from agents.cooperative.cmm.own_kalman import LEAST_VARIANCE_M2, OwnKalman
from agents.cooperative.cmm.own_rbpf import OwnRbpf
from vnet.types import Array

NOISE_M2 = np.eye(2)
UNKNOWN = np.zeros(2), 9 * np.eye(2)
"""Belief about the common error at the start."""


def _on_a_lane(heading_rad: float = 0.0, model: LaneModel | None = None) -> OwnKalman:
    return OwnKalman.start(np.zeros(2), heading_rad, model or LaneModel(), UNKNOWN)


def _fixes(count: int, heading_rad: float, common_m: Array, seed: int) -> Array:
    """Draw fixes (count, 2) of a vehicle that stands 0.3 m to the right of the lane's centre line."""
    rng = np.random.default_rng(seed)
    right = np.array([np.sin(heading_rad), -np.cos(heading_rad)])
    return np.asarray(0.3 * right + common_m + rng.standard_normal((count, 2)))


def test_the_bound_is_the_textbook_filter() -> None:
    """Two vehicles on crossing lanes, written out as one filter on (c, l, s, v, l, s, v)."""
    model, heading_rad = LaneModel(), np.array([0.0, np.pi / 2])
    bound = KalmanBound(np.zeros((2, 2)), heading_rad, model)
    mean, covariance = np.zeros(8), np.zeros((8, 8))
    covariance[:2, :2] = 9 * np.eye(2)
    covariance[2:5, 2:5] = covariance[5:, 5:] = model.own_covariance()
    observe = np.zeros((4, 8))
    for vehicle, heading in enumerate(heading_rad):
        right, along = [np.sin(heading), -np.cos(heading)], [np.cos(heading), np.sin(heading)]
        observe[2 * vehicle : 2 * vehicle + 2, :2] = np.eye(2)
        observe[2 * vehicle : 2 * vehicle + 2, 2 + 3 * vehicle : 4 + 3 * vehicle] = np.column_stack([right, along])
    common_m = np.array([2.0, -1.0])
    fixes = np.stack([_fixes(60, heading, common_m, 3 + k) for k, heading in enumerate(heading_rad)], axis=1)
    for k, fix in enumerate(fixes):
        dt_s = 0.1 if k else 0.0
        keep, variance = model.common_step(dt_s)
        step, noise = np.eye(8), np.zeros((8, 8))
        step[:2, :2], noise[:2, :2] = keep * np.eye(2), variance * np.eye(2)
        for rows in (slice(2, 5), slice(5, 8)):
            step[rows, rows], noise[rows, rows] = model.transition(dt_s), model.process_noise(dt_s)
        mean, covariance = step @ mean, step @ covariance @ step.T + noise
        innovation = observe @ covariance @ observe.T + np.eye(4)
        gain = covariance @ observe.T @ np.linalg.inv(innovation)
        mean = mean + gain @ (fix.ravel() - observe @ mean)
        covariance = covariance - gain @ observe @ covariance
        bound.step(dt_s, fix, NOISE_M2)
    assert_allclose(bound.common_m, mean[:2], atol=1e-6)
    assert_allclose(bound.common_covariance_m2, covariance[:2, :2], atol=1e-6)
    assert_allclose(bound.position_m[0], [mean[3], -mean[2]], atol=1e-5)
    assert np.linalg.norm(bound.common_m - common_m) < 1.0


def test_multipath_is_told_from_c_by_the_bound_that_knows_of_it() -> None:
    """Ten vehicles on lanes in all directions, each with an error of its own that stays."""
    rng, heading_rad = np.random.default_rng(5), np.linspace(0, np.pi, 10, endpoint=False)
    multipath_m, common_m = 2.0 * rng.standard_normal((10, 2)), np.array([1.0, -2.0])
    bounds = [
        KalmanBound(np.zeros((10, 2)), heading_rad, model)
        for model in (LaneModel(), MultipathLaneModel(multipath_sigma_m=2.0, multipath_tau_s=60.0))
    ]
    for k in range(100):
        fix_m = common_m + multipath_m + rng.standard_normal((10, 2))
        for bound in bounds:
            bound.step(0.1 if k else 0.0, fix_m, NOISE_M2)
    deceived, told = (
        float((off := bound.common_m - common_m) @ np.linalg.solve(bound.common_covariance_m2, off)) / 2
        for bound in bounds
    )
    assert deceived > 10, "it believes what it cannot know"
    assert told < 3


def test_along_a_lane_a_fix_never_says_less_than_nothing() -> None:
    vehicle = _on_a_lane(0.0, LaneModel(common_tau_s=1e6))
    for fix_m in _fixes(300, 0.0, np.array([2.0, -1.0]), 4):
        vehicle.predict(0.1)
        increment = vehicle.take(fix_m, NOISE_M2)
        assert increment is not None and min(increment.numbers[0], increment.numbers[2]) >= 0


def test_a_vehicle_without_a_fix_is_predicted() -> None:
    bound = KalmanBound(np.zeros((2, 2)), np.array([0.0, 1.0]))
    bound.step(0.0, np.array([[1.0, 1.0], [np.nan, np.nan]]), NOISE_M2)
    before = bound.common_covariance_m2.copy()
    bound.step(0.1, np.full((2, 2), np.nan), NOISE_M2)
    assert np.trace(bound.common_covariance_m2) >= np.trace(before) - 1e-9


@pytest.mark.parametrize("heading_rad", [0.0, 1.1, 4.0])
def test_alone_it_is_the_kalman_filter(heading_rad: float) -> None:
    own, noise_m2 = _on_a_lane(heading_rad), np.array([[1.2, 0.3], [0.3, 0.8]])
    bound = KalmanBound(np.zeros((1, 2)), np.array([heading_rad]))
    for k, fix in enumerate(_fixes(100, heading_rad, np.array([2.0, -1.0]), 7)):
        own.predict(0.1 if k else 0.0)
        bound.step(0.1 if k else 0.0, fix[None], noise_m2)
        before, increment = own.belief, own.take(fix, noise_m2)
        assert increment is not None
        expected = before.plus(increment).moments()
        assert_allclose(own.estimate_m, expected[0], atol=1e-9)
        assert_allclose(own.estimate_covariance_m2, expected[1], atol=1e-9)
    assert_allclose(own.estimate_m, bound.common_m, atol=1e-9)
    assert_allclose(own.estimate_covariance_m2, bound.common_covariance_m2, atol=1e-9)
    position_m, covariance_m2 = own.position_m()
    assert_allclose(position_m, bound.position_m[0], atol=1e-9)
    assert_allclose(covariance_m2, bound.position_covariance_m2()[0], atol=1e-9)


def test_nothing_counts_twice() -> None:
    """A vehicle that has long known its offset says little more: the lane is evidence once."""
    own, said = _on_a_lane(model=LaneModel(common_tau_s=1e9, lateral_tau_s=1e9)), []
    for fix in _fixes(300, 0.0, np.zeros(2), 9):
        own.predict(0.1)
        increment = own.take(fix, NOISE_M2)
        assert increment is not None
        said.append(np.trace(increment.matrix))
    assert sum(said) < 1.2 / 0.38**2  # no more than what an offset of 0.38 m can tell
    assert said[-1] < said[0] / 50


def test_pooled_information_is_taken_exactly() -> None:
    own = _on_a_lane()
    own.predict(0.0)
    own.take(np.array([1.0, 1.0]), NOISE_M2)
    pooled = Information.of(np.array([0.5, -0.5]), np.array([[0.3, 0.1], [0.1, 0.2]]))
    place_m, _ = own.position_m()
    moved = own.estimate_m - pooled.moments()[0]
    own.absorb(pooled)
    assert_allclose(own.estimate_m, [0.5, -0.5], atol=1e-12)
    assert_allclose(own.estimate_covariance_m2, [[0.3, 0.1], [0.1, 0.2]], atol=1e-12)
    # Along the lane nothing but the fix tells where it is: it moves against c.
    assert_allclose((own.position_m()[0] - place_m)[0], moved[0], atol=1e-6)


def test_what_others_say_counts_as_a_measurement_of_c() -> None:
    """The order in which things are measured at one instant does not matter."""
    measured = Information.of(np.array([1.0, 2.0]), np.array([[0.5, 0.2], [0.2, 0.4]]))
    first, last = _on_a_lane(0.7), _on_a_lane(0.7)
    first.absorb(first.belief.plus(measured))
    for fix in _fixes(10, 0.7, np.array([1.0, 1.0]), 3):
        first.take(fix, NOISE_M2)
        last.take(fix, NOISE_M2)
    last.absorb(last.belief.plus(measured))
    assert_allclose(first.plain_moments, last.plain_moments, atol=1e-7)
    for one, other in zip(first.position_m(), last.position_m(), strict=True):
        assert_allclose(one, other, atol=1e-6)


def test_nothing_is_known_to_a_centimetre() -> None:
    """A common error that is none can be written as information all the same."""
    own = OwnKalman.start(np.zeros(2), 0.3, LaneModel(common_sigma_m=0.0), (np.zeros(2), np.zeros((2, 2))))
    for fix in _fixes(50, 0.3, np.zeros(2), 2):
        own.predict(0.1)
        increment = own.take(fix, 1e-8 * NOISE_M2)
        assert increment is not None
        assert np.linalg.eigvalsh(increment.matrix)[0] > -1e-6
        assert np.linalg.eigvalsh(own.estimate_covariance_m2)[1] < 4 * LEAST_VARIANCE_M2


@pytest.mark.parametrize("lane", [0, 1, 2])
def test_of_competing_lanes_the_one_that_fits_c_is_found(lane: int) -> None:
    """Three lanes 3.5 m apart; the fixes alone cannot tell which, what others know of c can."""
    points = np.array([[0.0, 3.5], [0.0, 0.0], [0.0, -3.5]])
    own: OwnRbpf | OwnKalman = OwnRbpf((points, np.zeros(3)), LaneModel(), 250, np.random.default_rng(5))
    rng = np.random.default_rng(6)
    common_m = np.array([1.0, 2.0])
    for k in range(60):
        own.predict(0.1)
        fix = points[lane] + common_m + rng.standard_normal(2)
        assert own.take(fix, NOISE_M2) is not None
        if k == 5:
            assert isinstance(own, OwnRbpf), "several lanes compete"
        if k >= 10:
            own.absorb(own.belief.plus(Information.of(common_m + 0.5 * rng.standard_normal(2), np.eye(2))))
        if isinstance(own, OwnRbpf) and (decided := own.decided()):
            assert_allclose(decided.estimate_m, own.estimate_m, atol=1e-9)
            assert_allclose(decided.estimate_covariance_m2, own.estimate_covariance_m2, atol=2 * LEAST_VARIANCE_M2)
            assert_allclose(decided.position_m()[0], own.position_m()[0], atol=1e-9)
            assert_allclose(decided.position_m()[1], own.position_m()[1], atol=1e-3)
            own = decided
    assert isinstance(own, OwnKalman), "one lane is left"
    assert_allclose(own.position_m()[0], points[lane], atol=0.8)
    assert_allclose(own.estimate_m, common_m, atol=0.6)


def _beside_each_other() -> OwnRbpf:
    return OwnRbpf((np.array([[0.0, 3.5], [0.0, 0.0]]), np.zeros(2)), LaneModel(), 100, np.random.default_rng(8))


@pytest.mark.parametrize("new", [_on_a_lane, _beside_each_other])
def test_a_fix_that_is_far_off_is_not_taken(new: Callable[[], OwnKalman | OwnRbpf]) -> None:
    own = new()
    for fix in _fixes(20, 0.0, np.zeros(2), 4):
        own.predict(0.1)
        assert own.take(fix, NOISE_M2, 25.0) is not None
    before = own.plain_moments
    assert own.take(np.array([30.0, 0.0]), NOISE_M2, 25.0) is None
    assert own.plain_moments == before
    assert own.take(np.array([0.3, 0.2]), NOISE_M2, 9.0) is not None


def test_the_sample_is_of_what_is_known() -> None:
    rng = np.random.default_rng(1)
    own = _beside_each_other()
    assert own.sample(50, rng).shape == (50, 2)
    assert set(map(tuple, own.sample(50, rng).tolist())) <= set(map(tuple, own.common_m.T.tolist()))
    alone = _on_a_lane(0.5)
    alone.take(np.array([1.0, 2.0]), NOISE_M2)
    points = alone.sample(20_000, rng)
    assert_allclose(points.mean(axis=0), alone.estimate_m, atol=0.1)
    assert_allclose(np.cov(points.T), alone.estimate_covariance_m2, atol=0.3)


@pytest.mark.parametrize("noise_m2", [NOISE_M2, 0.01 * NOISE_M2])
def test_others_who_know_less_take_nothing_away_while_lanes_compete(noise_m2: Array) -> None:
    """They would drive particles outward: to deviations of 8 m, where 3 m were known before the first fix."""
    lanes = np.array([[0.0, 0.0], [6.0, 6.0]]), np.array([0.0, 1.2])

    def known(factor: float) -> OwnRbpf:
        own, rng = OwnRbpf(lanes, LaneModel(), 500, np.random.default_rng(3)), np.random.default_rng(3)
        for _ in range(8):
            own.predict(0.1)
            said = own.belief
            increment = own.take(np.ones(2) + 0.1 * rng.standard_normal(2), noise_m2)
            assert increment is not None
            mean_m, covariance_m2 = said.plus(increment).moments()
            own.absorb(Information.of(mean_m + 0.5, factor * covariance_m2), is_of_lanes=True)
        return own

    assert_allclose(known(2.0).estimate_covariance_m2, known(1.01).estimate_covariance_m2)
    assert np.linalg.eigvalsh(known(2.0).estimate_covariance_m2)[1] < 30


@given(
    beside_m=st.floats(8.0, 30.0),
    across_m=st.floats(-3.0, 3.0),
    sigma_m=st.sampled_from([0.1, 0.3, 1.0]),
    is_of_lanes=st.booleans(),
)
@example(14.7, 2.5, 0.1, True)
def test_others_who_know_less_make_no_far_lane_likely(
    beside_m: float, across_m: float, sigma_m: float, is_of_lanes: bool
) -> None:
    """Others who know less exclude no lane, and a lane that is out of question stays so."""
    lanes = np.array([[0.0, 0.0], [0.0, beside_m]]), np.zeros(2)
    own = OwnRbpf(lanes, LaneModel(), 1000, np.random.default_rng(3))
    before = own.belief
    own.predict(0.1)
    assert own.take(np.array([1.0, across_m]), sigma_m**2 * np.eye(2)) is not None
    unlikely = own.lane_probability.min() if len(own.lane_probability) > 1 else 0.0
    own.absorb(before, is_of_lanes)
    remaining = own.decided() or own
    assert remaining.position_m()[0][1] < beside_m / 2
    if remaining is own:
        assert own.lane_probability.min() < 30 * unlikely
