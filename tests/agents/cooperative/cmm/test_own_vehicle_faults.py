"""A vehicle whose receiver is wrong for seconds never states a position that may be anywhere."""

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
        if period == 0:
            continue  # one fix does not tell a place
        assert position is not None
        assert np.abs(position[1]).max() < LARGEST_M2, period
        error_m = float(np.linalg.norm(position[0]))
    assert error_m < 3.0


def test_a_vehicle_that_begins_again_knows_no_position_before_two_fixes_agree() -> None:
    own, rng = vehicle(), np.random.default_rng(3)
    own.restart(Information.of(COMMON_M, 0.01 * np.eye(2)))
    for fault_m in (np.zeros(2), FAULT_M, np.zeros(2)):
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
        assert own.took_fix == (period not in (0, 20, 21))


def test_a_vehicle_that_drives_is_placed_by_fixes_that_come_rarely() -> None:
    """It has moved by 8 m from fix to fix; most steps are without one."""
    own, rng = vehicle(), np.random.default_rng(5)
    for period in range(41):
        own.step(0.1, fix(rng, np.array([0.4 * period, 0.0])) if period % 20 == 0 else None)
    assert own.position_m() is not None


def test_a_vehicle_that_begins_again_forgets_the_fixes_of_before() -> None:
    own, rng = vehicle(), np.random.default_rng(6)
    for _ in range(3):
        own.step(0.1, fix(rng, np.zeros(2)))
    own.restart(Information.of(COMMON_M, 0.01 * np.eye(2)))
    own.step(0.1, fix(rng, np.zeros(2)))
    assert own.position_m() is None
