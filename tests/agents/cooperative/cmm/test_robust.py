"""A vehicle that contradicts all others moves no estimate."""

import numpy as np
import pytest

from agents.cooperative.cmm.rbpf import Observation, Rbpf, RbpfConfig
from agents.cooperative.estimator import median, near_the_median
from vnet.roads.lanes import LaneMap

HONEST = np.array([[0.0, 0.1], [0.1, 0.0], [-0.1, 0.0], [0.0, -0.1]])


def test_the_median_of_two_is_the_middle_and_of_many_what_most_say() -> None:
    assert median(np.array([[0.0, 2.0], [4.0, 4.0]])).tolist() == [2.0, 3.0]
    assert median(np.vstack([HONEST, [1e9, -1e9]])).tolist() == [0.0, 0.0]


@pytest.mark.parametrize("variance", [1e-6, 0.01, 1e4])
def test_neither_a_small_nor_a_large_covariance_opens_the_gate_for_a_lie(variance: float) -> None:
    covariances = np.array([np.eye(2) * 0.01] * 4 + [np.eye(2) * variance])
    assert near_the_median(np.vstack([HONEST, [50.0, 0.0]]), covariances, 3.0).tolist() == [True] * 4 + [False]


@pytest.mark.parametrize(("stretched", "near"), [(1 - 1e-9, True), (1 + 1e-9, False)])
def test_the_gate_is_five_deviations_of_all_of_the_one_and_of_the_floor(stretched: float, near: bool) -> None:
    edge_m = 5 * np.sqrt(0.01 + 0.04 + 0.25**2) * stretched
    covariances = np.array([np.eye(2) * 0.01] * 4 + [np.eye(2) * 0.04])
    assert near_the_median(np.array([[0.0, 0.0]] * 4 + [[edge_m, 0.0]]), covariances, 3.0)[-1] == near


def test_who_knows_little_and_says_so_is_inside() -> None:
    estimates = np.vstack([HONEST, [4.0, -3.0]])
    sure, unsure = np.eye(2) * 0.01, np.eye(2) * 9.0
    assert near_the_median(estimates, np.array([sure] * 4 + [unsure]), 3.0).all()
    assert not near_the_median(estimates, np.array([sure] * 5), 3.0)[-1]


def error_with_one_off_its_road(by_m: float, min_map_log_likelihood: float) -> float:
    """Error of the common error's estimate when one of eight vehicles has a receiver that is off by `by_m`."""
    rng = np.random.default_rng(3)
    point, heading = rng.uniform(0, 3000, (8, 2)), np.linspace(0, np.pi, 8, endpoint=False)
    lanes = LaneMap(point, heading, 0.85)
    common = np.array([1.0, -2.0])
    rbpf = Rbpf(RbpfConfig(min_map_log_likelihood=min_map_log_likelihood), lanes, rng)
    for _ in range(30):
        fix = point + common + rng.normal(size=point.shape)
        fix[0] += by_m * lanes.normal[0]
        seen = {f"v{i}": Observation(fix[i], np.eye(2), float(heading[i])) for i in range(8)}
        rbpf.step(0.1, seen)
    return float(np.linalg.norm(rbpf.estimate_m - common))


@pytest.mark.parametrize("by_m", [10.0, 25.0])
def test_a_vehicle_off_its_road_is_out_of_the_reckoning(by_m: float) -> None:
    assert error_with_one_off_its_road(by_m, -6.0) < 0.7
    assert error_with_one_off_its_road(by_m, -np.inf) > 1.0


def test_without_any_such_vehicle_it_makes_no_difference() -> None:
    assert error_with_one_off_its_road(0.0, -6.0) == pytest.approx(
        error_with_one_off_its_road(0.0, -np.inf), abs=0.2
    )
