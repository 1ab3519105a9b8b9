"""Fusion: mixing a neighbour's particles in, and moving a cloud along the regression on the common error."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.cooperative.cmm.fusion import Cloud, condition_on, fuse, regression_on_common_error
from agents.cooperative.cmm.rbpf import Observation, Rbpf, RbpfConfig
from vnet.roads.lanes import LaneMap

LANES = LaneMap(np.array([[0.0, 0.0], [0.0, 0.0]]), np.array([0.0, np.pi / 2]), 0.85)


def settled(seed: int = 0) -> Rbpf:
    """A filter that has seen two crossing roads for two seconds; the common error is (2, −1)."""
    rbpf = Rbpf(RbpfConfig(particles=100), LANES, np.random.default_rng(seed))
    rng = np.random.default_rng(seed + 1)
    for _ in range(20):
        noisy = np.array([2.0, -1.0]) + rng.normal(0, 0.5, (2, 2))
        noise = 0.25 * np.eye(2)
        rbpf.step(0.1, {"a": Observation(noisy[0], noise, 0.0), "b": Observation(noisy[1], noise, np.pi / 2)})
    return rbpf


ALL = frozenset({"a", "b"})


def test_all_weight_on_oneself_keeps_ones_own_hypotheses() -> None:
    rbpf = settled()
    before = rbpf.estimate_m
    far = Cloud(np.full((10, 2), 99.0), ALL)
    fused, imported = fuse(rbpf, [far], np.array([1.0, 0.0]), np.random.default_rng(2))
    assert fused == pytest.approx(before)
    assert imported == 0
    assert np.abs(rbpf.common_m).max() < 20


def test_the_fused_estimate_is_the_weighted_mean_of_the_clouds() -> None:
    rbpf = settled()
    rbpf.resample()
    own = rbpf.estimate_m
    cloud = Cloud(np.tile([1.0, 1.0], (50, 1)), ALL)
    fused, imported = fuse(rbpf, [cloud], np.array([0.5, 0.5]), np.random.default_rng(2))
    assert fused == pytest.approx((own + 1.0) / 2, abs=0.05)
    assert imported == 50
    assert rbpf.common_m.shape == (2, 100)
    assert rbpf.tracks.mean.shape == (2, 4, 100)


def test_roads_that_a_neighbour_does_not_know_weight_its_hypotheses() -> None:
    wrong = np.tile([-8.0, 9.0], (50, 1))  # puts both vehicles far off their roads
    knowing, ignorant = settled(), settled()
    fuse(knowing, [Cloud(wrong, ALL)], np.array([0.5, 0.5]), np.random.default_rng(2))
    fuse(ignorant, [Cloud(wrong, frozenset())], np.array([0.5, 0.5]), np.random.default_rng(2))
    assert np.sum(knowing.common_m[0] == -8.0) == 50
    assert np.sum(ignorant.common_m[0] == -8.0) == 0
    assert ignorant.estimate_m == pytest.approx([2.0, -1.0], abs=1.0)


def test_imported_hypotheses_get_this_filters_own_vehicles() -> None:
    rbpf = settled()
    position, _ = rbpf.position_m("a")
    fix = position + rbpf.estimate_m
    fuse(rbpf, [Cloud(np.tile([3.0, -1.0], (50, 1)), ALL)], np.array([0.0, 1.0]), np.random.default_rng(2))
    assert rbpf.position_m("a")[0] == pytest.approx(fix - [3.0, -1.0], abs=0.3)


NOWHERE = LaneMap(np.empty((0, 2)), np.empty(0), 0.85)


def one_vehicle(common_sigma_m: float = 3.0) -> Rbpf:
    """A filter without roads that has one fix of one vehicle, at (3, 4); c is around 0."""
    config = RbpfConfig(particles=200, common_sigma_m=common_sigma_m, common_tau_s=1e12)
    rbpf = Rbpf(config, NOWHERE, np.random.default_rng(5))
    rbpf.step(0.1, {"v": Observation(np.array([3.0, 4.0]), np.eye(2), 0.3)})
    return rbpf


@pytest.mark.parametrize("common_sigma_m", [0.0, 3.0])
def test_given_c_a_new_vehicle_is_where_its_fix_says_less_c(common_sigma_m: float) -> None:
    """Also where the cloud has collapsed, and no regression is to be had from it."""
    rbpf = one_vehicle(common_sigma_m)
    assert regression_on_common_error(rbpf).mean[0, :2] == pytest.approx(-np.eye(2), abs=1e-9)
    conditioned = condition_on(rbpf, np.array([[1.0, 1.0]] * 5), np.random.default_rng(0))
    assert pytest.approx(np.array([[2.0, 3.0]] * 5)) == conditioned.mean[0, :2].T
    assert pytest.approx(np.array([[1.0, 1.0]] * 5)) == conditioned.past_m[0].T


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(0, 20), min_size=1, max_size=4), st.integers(0, 2**32))
def test_fusion_keeps_the_number_of_particles_and_counts_what_it_imports(sizes: list[int], seed: int) -> None:
    """Whatever clouds come, empty ones included; every hypothesis is one's own or from a cloud."""
    rbpf, rng = settled(), np.random.default_rng(seed)
    rbpf.resample()
    own = {tuple(c) for c in rbpf.common_m.T.tolist()}
    clouds = [Cloud(rng.normal(2.0, 1.0, (size, 2)), ALL) for size in sizes]
    weights = rng.dirichlet(np.ones(1 + len(clouds)))
    _, imported = fuse(rbpf, clouds, weights, rng)
    assert rbpf.common_m.shape == (2, 100) and rbpf.tracks.mean.shape == (2, 4, 100)
    assert rbpf.particles.past_m.shape[1:] == (2, 100) and rbpf.tracks.map_log_likelihood.shape == (2, 100)
    outside = {tuple(c) for cloud in clouds for c in cloud.common_m.tolist()}
    now = [tuple(c) for c in rbpf.common_m.T.tolist()]
    assert set(now) <= own | outside
    assert sum(c in outside for c in now) == imported
