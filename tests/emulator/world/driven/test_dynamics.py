"""Longitudinal dynamics: closed forms, limits, and independence of how time is divided."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.linalg import expm

from emulator.world.driven.vehicles import Limits, Longitudinal, advance_limited

LIMITS = Limits(lag_s=0.3, acceleration=3.0, braking=8.0, speed=40.0)
LAGS = st.sampled_from([0.0, 0.05, 0.3, 2.0])
STEPS = st.sampled_from([0.01, 0.1, 1.0])
SPEEDS = st.floats(0, 40)
ACCELERATIONS = st.floats(-8, 3)


def limits_of(lag_s: float) -> Limits:
    return Limits(lag_s, LIMITS.acceleration, LIMITS.braking, LIMITS.speed)


@pytest.mark.parametrize("step_s", [0.01, 0.1, 0.5])
def test_motion_within_the_limits_is_the_matrix_exponential(step_s: float) -> None:
    lag_s, command = LIMITS.lag_s, -0.7
    rates = np.array([[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, -1 / lag_s, 1 / lag_s], [0, 0, 0, 0]])
    state = np.array([3.0, 20.0, 1.1])
    exact = expm(rates * step_s) @ [*state, command]
    later = Longitudinal(LIMITS, step_s).advance(state[:, None], np.array([command]))
    assert_allclose(later[:, 0], exact[:3], rtol=1e-13)


@pytest.mark.slow
@given(lag_s=LAGS, step_s=STEPS, speed=SPEEDS, acceleration=ACCELERATIONS, command=ACCELERATIONS)
def test_speeds_and_accelerations_stay_within_their_limits(
    lag_s: float, step_s: float, speed: float, acceleration: float, command: float
) -> None:
    motion, state = Longitudinal(limits_of(lag_s), step_s), np.array([[0.0], [speed], [acceleration]])
    for _ in range(5):
        later = motion.advance(state, np.array([command]))
        assert 0 <= later[1, 0] <= LIMITS.speed
        assert -LIMITS.braking <= later[2, 0] <= LIMITS.acceleration
        assert -1e-9 <= later[0, 0] - state[0, 0] <= LIMITS.speed * step_s + 1e-9
        state = later


@pytest.mark.slow
@given(lag_s=LAGS, step_s=STEPS, speed=SPEEDS, acceleration=ACCELERATIONS, command=ACCELERATIONS)
def test_two_halves_of_an_interval_are_the_whole(
    lag_s: float, step_s: float, speed: float, acceleration: float, command: float
) -> None:
    state, told = np.array([[5.0], [speed], [acceleration]]), np.array([command])
    half = Longitudinal(limits_of(lag_s), step_s / 2)
    halves = half.advance(half.advance(state, told), told)
    whole = Longitudinal(limits_of(lag_s), step_s).advance(state, told)
    assert_allclose(halves[:2], whole[:2], atol=1e-6)


def test_a_braking_vehicle_stops_after_its_braking_distance_and_stays() -> None:
    state, motion = np.array([[0.0], [20.0], [0.0]]), Longitudinal(limits_of(0.0), 0.1)
    for _ in range(40):
        state = motion.advance(state, np.array([-8.0]))
    assert state[:, 0].tolist() == [pytest.approx(20.0**2 / 16), 0.0, 0.0]
    state = motion.advance(state, np.array([1.0]))
    assert_allclose(state[:, 0], [25.005, 0.1, 1.0])


def test_a_speed_that_dips_below_zero_within_an_interval_is_cut_there() -> None:
    """The vehicle brakes hard, and is told to accelerate just before it stands."""
    start = (0.0, 0.3, -8.0)
    ends = [advance_limited(LIMITS, start, 3.0, step_s / 100)[1] for step_s in range(1, 60)]
    assert 0 <= min(ends) < 0.001, "it has stood"
    assert ends[-1] > 0.1, "and goes again"
    position = [advance_limited(LIMITS, start, 3.0, step_s / 100)[0] for step_s in range(1, 60)]
    assert (np.diff(position) >= 0).all(), "and never backwards"


def test_vehicles_do_not_depend_on_one_another() -> None:
    rng = np.random.default_rng(1)
    state = np.array([rng.uniform(0, 100, 50), rng.uniform(0, 3, 50), rng.uniform(-8, 3, 50)])
    command, motion = rng.uniform(-8, 3, 50), Longitudinal(LIMITS, 0.1)
    together = motion.advance(state, command)
    alone = [motion.advance(state[:, [n]], command[[n]])[:, 0] for n in range(50)]
    assert np.array_equal(together, np.array(alone).T)
