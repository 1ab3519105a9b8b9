"""A vehicle whose receiver is wrong for seconds never states a position that may be anywhere."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from agents.cooperative.cmm.information import Information
from agents.cooperative.cmm.own_vehicle import OwnConfig, OwnVehicle
from agents.cooperative.cmm.rbpf import Observation, RbpfConfig
from vnet.roads.lanes import LaneMap

COMMON_M = np.array([2.0, 1.5])
FAULT_M = np.array([33.0, 60.0])
NOISE_M2 = np.eye(2)
LARGEST_M2 = 1000.0
NOWHERE = LaneMap(np.zeros((0, 2)), np.zeros(0), 0.85)


def vehicle() -> OwnVehicle:
    """Return a vehicle on one of two lanes that cross at the origin."""
    lanes = LaneMap(np.zeros((2, 2)), np.array([0.0, np.pi / 2]), 0.85)
    return OwnVehicle(OwnConfig(RbpfConfig(particles=300)), lanes, np.random.default_rng(1))


def fix(rng: np.random.Generator, fault_m: np.ndarray) -> Observation:
    return Observation(COMMON_M + fault_m + rng.normal(0, 1, 2), NOISE_M2, 0.0)


@pytest.mark.parametrize("wrong_periods", [10, 25, 60])
def test_a_wrong_receiver_leaves_bounded_positions(wrong_periods: int) -> None:
    own, rng = vehicle(), np.random.default_rng(2)
    own.restart(Information.of(COMMON_M, 0.05 * np.eye(2)))  # as others know it
    error_m = np.inf
    for period in range(140):
        wrong = 30 <= period < 30 + wrong_periods
        own.step(0.1, fix(rng, FAULT_M if wrong else np.zeros(2)))
        position = own.position_m()
        if period < 2:
            continue  # two fixes do not tell a place
        assert position is not None
        assert np.abs(position[1]).max() < LARGEST_M2, period
        error_m = float(np.linalg.norm(position[0]))
    assert error_m < 3.0


def test_a_vehicle_that_begins_again_knows_no_position_before_three_fixes_agree() -> None:
    own, rng = vehicle(), np.random.default_rng(3)
    own.restart(Information.of(COMMON_M, 0.01 * np.eye(2)))
    for fault_m in (np.zeros(2), FAULT_M, np.zeros(2), np.zeros(2)):
        assert own.position_m() is None
        own.step(0.1, fix(rng, fault_m))
        assert not own.took_fix
    own.step(0.1, fix(rng, np.zeros(2)))
    position = own.position_m()
    assert position is not None and np.abs(position[1]).max() < LARGEST_M2


def test_two_consecutive_outliers_of_rare_fixes_are_not_believed() -> None:
    own, rng = vehicle(), np.random.default_rng(4)
    own.restart(Information.of(COMMON_M, 0.05 * np.eye(2)))
    for period in range(30):
        own.step(1.0, fix(rng, FAULT_M if period in (20, 21) else np.zeros(2)))
        assert own.took_fix == (period not in (0, 1, 20, 21))


def test_a_vehicle_that_drives_is_placed_by_fixes_that_come_rarely() -> None:
    """It has moved by 8 m from fix to fix; most steps are without one."""
    own, rng = vehicle(), np.random.default_rng(5)
    for period in range(41):
        own.step(0.1, fix(rng, np.array([0.4 * period, 0.0])) if period % 20 == 0 else None)
    assert own.position_m() is not None


@pytest.mark.parametrize("rate_hz", [1, 2, 5, 10])
def test_two_outliers_on_opposite_sides_place_no_vehicle_that_tells_its_speed(rate_hz: int) -> None:
    rng = np.random.default_rng(5)
    for speed_m_s in (None, 0.1):
        own = OwnVehicle(OwnConfig(RbpfConfig()), NOWHERE, rng)
        for off_m in ([0.0, 30.0], [0.0, 0.0], [0.0, -30.0]):
            own.step(1 / rate_hz, replace(fix(rng, np.array(off_m)), speed_m_s=speed_m_s))
        assert (own.position_m() is None) == (speed_m_s is not None)


def test_fixes_follow_each_other_as_their_noise_and_multipath_allow() -> None:
    """Multipath of 5 m and 5 s, which fixes state, moves them by 3 m in a second; a speed of NaN says nothing."""
    rng, place_m, off_m = np.random.default_rng(6), np.zeros(2), 5.0 * np.random.default_rng(7).normal(size=2)
    told: list[Observation] = []
    for _ in range(400):
        place_m = place_m + np.array([12.0, 0.0])
        off_m = off_m * np.exp(-0.2) + 5 * np.sqrt(-np.expm1(-0.4)) * rng.normal(size=2)
        seen_m = place_m + off_m + rng.normal(0, 0.5, 2)
        told.append(Observation(seen_m, 25.25 * np.eye(2), 0.0, multipath=(5.0, 5.0), speed_m_s=12.0))
    assert all(fix.follows(before, 1.0, 0.0) for before, fix in pairwise(told))
    assert not told[1].follows(replace(told[0], speed_m_s=60.0), 1.0, 0.0)
    assert told[1].follows(replace(told[0], speed_m_s=np.nan), 1.0, 0.0)
    east, north = (Observation(np.array(at), np.eye(2), 0.0, speed_m_s=50.0) for at in ((50.0, 0.0), (0.0, 50.0)))
    start = replace(east, position_m=np.zeros(2))
    assert east.follows(start, 1.0, 0.0) and not north.follows(start, 1.0, 0.0)
    assert replace(north, heading_rad=None).follows(start, 1.0, 0.0), "it is as far away"


@pytest.mark.parametrize("rate_hz", [1, 2, 5, 10])
@pytest.mark.parametrize("speed_m_s", [0.0, 5.0, 15.0, 30.0])
@pytest.mark.parametrize("tells_speed", [False, True])
def test_a_vehicle_without_a_map_is_placed_as_well_as_its_fixes(
    rate_hz: int, speed_m_s: float, tells_speed: bool
) -> None:
    """It drives around, in circles of at least 150 m, and brakes and accelerates by 3 m/s² in every 20 s."""
    rng, step_s = np.random.default_rng(7), 0.02
    time_s = np.arange(0, 60, step_s)
    brakes_m_s = np.interp(time_s % 20, [8, 12, 16], [0, min(12.0, speed_m_s), 0])
    turned_rad = np.cumsum((speed_m_s - brakes_m_s) / 150) * step_s
    way_m = np.stack([np.cos(turned_rad), np.sin(turned_rad)], 1) * (speed_m_s - brakes_m_s)[:, None] * step_s
    each = round(1 / (rate_hz * step_s))
    place_m, told_m_s = np.cumsum(way_m, axis=0)[::each], (speed_m_s - brakes_m_s)[::each]
    for sigma_m in (0.1, 1.0, 3.0):
        own = OwnVehicle(OwnConfig(RbpfConfig()), NOWHERE, rng)
        noise_m = sigma_m * rng.standard_normal(place_m.shape)
        off_m = []
        for true_m, seen_m, told in zip(place_m, place_m + COMMON_M + noise_m, told_m_s.tolist(), strict=True):
            speed = told if tells_speed else None
            own.step(1 / rate_hz, Observation(seen_m, sigma_m**2 * np.eye(2), None, speed_m_s=speed))
            position = own.position_m()
            off_m.append((position[0] if position else seen_m) + own.estimate_m - COMMON_M - true_m)
        assert position is not None
        assert np.mean(np.square(off_m)) < 1.05 * np.mean(np.square(noise_m))


@pytest.mark.parametrize("speed_m_s", [0.0, 30.0])
def test_a_vehicle_that_drives_along_its_lane_is_placed(speed_m_s: float) -> None:
    rng, lanes = np.random.default_rng(8), LaneMap(np.zeros((1, 2)), np.zeros(1), 0.85)
    own = OwnVehicle(OwnConfig(RbpfConfig()), lanes, rng)
    for period in range(30):
        own.step(1.0, fix(rng, np.array([speed_m_s * period, 0.0])))
        assert own.took_fix == (period > 1)


def test_a_vehicle_that_begins_again_forgets_the_fixes_of_before() -> None:
    own, rng = vehicle(), np.random.default_rng(6)
    for _ in range(3):
        own.step(0.1, fix(rng, np.zeros(2)))
    own.restart(Information.of(COMMON_M, 0.01 * np.eye(2)))
    own.step(0.1, fix(rng, np.zeros(2)))
    assert own.position_m() is None


def test_fixes_without_time_between_them_place_no_vehicle() -> None:
    """A clock that is set back has the program read such."""
    own, rng = vehicle(), np.random.default_rng(5)
    for _ in range(4):
        own.step(0.0, fix(rng, np.zeros(2)))
    assert own.position_m() is None


@pytest.mark.parametrize("speed_m_s", [0.0, 15.0])
def test_outliers_off_the_map_are_no_turns(speed_m_s: float) -> None:
    """One fix in ten is 4 m off, as is a vehicle that turns at once; RMS of the fixes is 1.3 m."""
    rng, own = np.random.default_rng(5), OwnVehicle(OwnConfig(RbpfConfig()), NOWHERE, np.random.default_rng(6))
    squares_m2 = []
    for period in range(600):
        truth_m = np.array([0.1 * speed_m_s * period, 0.0])
        off_m = rng.normal(0.0, 4.0 if rng.random() < 0.1 and period > 5 else 0.1, 2)
        own.step(0.1, Observation(truth_m + off_m, 0.01 * np.eye(2), None))
        if (position := own.position_m()) is not None:
            squares_m2.append(float(np.sum((position[0] + own.estimate_m - truth_m) ** 2)) / 2)
    assert np.sqrt(np.mean(squares_m2)) < 0.5


def test_headings_that_disagree_hide_no_lane() -> None:
    """The heading of a vehicle that stands may be any."""
    own, rng = vehicle(), np.random.default_rng(5)
    own.restart(Information.of(COMMON_M, 0.05 * np.eye(2)))
    for heading_rad in [3.0, -1.0, np.pi / 2] + [0.5] * 200:  # the lane leads east
        own.step(0.1, replace(fix(rng, np.array([20.0, 0.0])), heading_rad=heading_rad))
    assert own.lane is not None
