"""Map evidence: only the change of the log-likelihood counts, and only as often as it is new."""

from __future__ import annotations

import numpy as np
import pytest

from agents.cooperative.cmm.common_error import CommonErrorParticles
from agents.cooperative.cmm.map_matching import (
    MAP_UPDATE_S,
    MIN_MAP_LOG_LIKELIHOOD,
    MapEvidence,
    log_on_lane,
    matcher,
)
from agents.cooperative.cmm.tracks import Tracks
from vnet.roads.lanes import LaneMap

K = 5
TAU_S = 20.0
EAST = LaneMap(np.zeros((1, 2)), np.zeros(1), 0.85)
NORTH_M = np.linspace(-2.0, 2.0, K)
"""Distance north of the lane at which each particle puts the first vehicle."""


def scene(vehicles: int = 1, least: float = -np.inf) -> tuple[MapEvidence, Tracks, CommonErrorParticles]:
    """Vehicles on a lane to the east, each 1 m further north than the one before."""
    evidence = MapEvidence(matcher(EAST, False, least, 0.1), TAU_S, 500.0)
    tracks = Tracks(K)
    for number in range(vehicles):
        mean = np.zeros((4, K))
        mean[1] = NORTH_M + number
        lanes = evidence.first_lanes(np.array([0.0, float(number)]), 0.0, 5.0)
        tracks.add(
            f"v{number}",
            mean=mean,
            covariance=np.eye(4) * 0.04,
            acceleration_m2_s4=np.eye(2),
            age_s=0.0,
            heading_rad=0.0,
            lanes=lanes,
        )
    return evidence, tracks, CommonErrorParticles(np.zeros((2, K)))


def log_likelihood(north_m: np.ndarray) -> np.ndarray:
    return log_on_lane(north_m[None], np.array([[0.2]]), 0.85)[0]


def test_the_first_update_counts_in_full() -> None:
    evidence, tracks, particles = scene()
    evidence.update(tracks, particles, np.array([0]))
    assert particles.log_weight == pytest.approx(log_likelihood(NORTH_M))
    assert tracks.map_log_likelihood[0] == pytest.approx(log_likelihood(NORTH_M))


@pytest.mark.parametrize(("elapsed_s", "share"), [(2.0, 2.0 / TAU_S), (3 * TAU_S, 1)])
def test_the_same_again_counts_by_the_share_that_is_new(elapsed_s: float, share: float) -> None:
    evidence, tracks, particles = scene()
    evidence.update(tracks, particles, np.array([0]))
    tracks.advance(elapsed_s)
    evidence.update(tracks, particles, np.array([0]))
    assert particles.log_weight == pytest.approx((1 + share) * log_likelihood(NORTH_M))


def test_a_vehicle_that_has_moved_in_its_lane_replaces_what_it_said() -> None:
    evidence, tracks, particles = scene()
    evidence.update(tracks, particles, np.array([0]))
    tracks.advance(MAP_UPDATE_S)
    tracks.mean[0, 1] += 0.5
    evidence.update(tracks, particles, np.array([0]))
    old = (1 - (1 - MAP_UPDATE_S / TAU_S)) * log_likelihood(NORTH_M)
    assert particles.log_weight == pytest.approx(old + log_likelihood(NORTH_M + 0.5))


def test_after_the_start_half_the_vehicles_are_evaluated_in_each_step() -> None:
    evidence, tracks, particles = scene(vehicles=4)
    rows = np.arange(4)
    evaluated = []
    for _ in range(5):
        tracks.advance(MAP_UPDATE_S / 2)
        before = tracks.map_log_likelihood.copy()
        tracks.mean[:, 1] += 0.01
        evidence.update(tracks, particles, rows)
        evaluated.append(np.flatnonzero((tracks.map_log_likelihood != before).any(axis=1)).tolist())
    assert evaluated == [[0, 1, 2, 3], [1, 3], [0, 2], [1, 3], [0, 2]]


def test_only_the_vehicles_asked_for_are_evaluated() -> None:
    evidence, tracks, particles = scene(vehicles=3)
    evidence.update(tracks, particles, np.array([1]))
    assert particles.log_weight == pytest.approx(log_likelihood(NORTH_M + 1))
    evidence.update(tracks, particles, np.array([], dtype=np.intp))
    assert particles.log_weight == pytest.approx(log_likelihood(NORTH_M + 1))


def test_the_update_in_full_counts_all_vehicles_each_time() -> None:
    evidence, tracks, particles = scene(vehicles=2)
    for _ in range(2):
        evidence.update_in_full(tracks, particles)
    both = log_likelihood(NORTH_M) + log_likelihood(NORTH_M + 1)
    assert particles.log_weight == pytest.approx(2 * both)


def test_a_truncated_likelihood_says_the_same_of_all_hypotheses_that_are_far_off() -> None:
    evidence, tracks, particles = scene(least=MIN_MAP_LOG_LIKELIHOOD)
    tracks.mean[0, 1] += 10.0
    evidence.update(tracks, particles, np.array([0]))
    assert particles.log_weight.tolist() == [MIN_MAP_LOG_LIKELIHOOD] * K
