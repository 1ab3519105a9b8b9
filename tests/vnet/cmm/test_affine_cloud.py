"""The cloud that is moved by composed maps, against one whose points are moved one step after the other."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from vnet.cmm.affine_cloud import LEAST_VARIANCE_M2, AffineCloud
from vnet.cmm.common_error import systematic
from vnet.types import Array

MEASURE = np.array([[0.6, -0.8, 1.0, 0.0, 0.0], [0.8, 0.6, 0.0, 1.0, 0.0]])


class PlainCloud:
    """The same cloud without composed maps: each step moves all points."""

    def __init__(self, points: Array) -> None:
        self.points = points
        self.weight = np.full(points.shape[1], 1 / points.shape[1])

    def move(self, matrix: Array, by: Array) -> None:
        """Map each point."""
        self.points = matrix @ self.points + by[:, None]

    def diffuse(self, sigma: float, rng: np.random.Generator) -> None:
        """Add noise to the first two coordinates."""
        self.points[:2] += sigma * rng.standard_normal((2, self.points.shape[1]))

    def weigh(self, value: Array, root: Array, gain: Array) -> None:
        """Weigh each point, and move it."""
        off = value[:, None] - MEASURE @ self.points
        self.weight = self.weight * np.exp(-0.5 * np.square(root @ off).sum(axis=0))
        self.points = self.points + gain @ off

    def settle(self, count: int, rng: np.random.Generator) -> None:
        """Normalize, and resample if it is due."""
        self.weight = self.weight / self.weight.sum()
        if count != len(self.weight) or 1 / np.square(self.weight).sum() < count / 2:
            self.points = self.points[:, systematic(self.weight, count, rng)]
            self.weight = np.full(count, 1 / count)


def _clouds(rng: np.random.Generator) -> tuple[AffineCloud, PlainCloud]:
    points = rng.standard_normal((5, 40)) + 10 * rng.standard_normal((5, 1))
    return AffineCloud(points, np.zeros(40)), PlainCloud(points)


@given(st.integers(0, 10_000), st.lists(st.sampled_from(["move", "diffuse", "weigh", "fewer"]), max_size=12))
def test_composed_maps_move_points_as_single_steps_do(seed: int, steps: list[str]) -> None:
    rng = np.random.default_rng(seed)
    cloud, plain = _clouds(rng)
    noise, same_noise = np.random.default_rng(seed), np.random.default_rng(seed)
    count = 40
    for step in steps:
        if step == "move":
            matrix, by = np.eye(5) + 0.2 * rng.standard_normal((5, 5)), rng.standard_normal(5)
            cloud.move(matrix, by)
            plain.move(matrix, by)
        elif step == "diffuse":
            cloud.diffuse(0.3, noise)
            plain.diffuse(0.3, same_noise)
        else:
            count = max(10, count - 5) if step == "fewer" else count
            value, root = MEASURE @ cloud.mean + rng.standard_normal(2), 0.1 * rng.standard_normal((2, 2))
            gain = 0.1 * rng.standard_normal((5, 2))
            cloud.weigh(MEASURE, value, root, gain)
            plain.weigh(value, root, gain)
            cloud.settle(count, noise)
            plain.settle(count, same_noise)
            mean = plain.points @ plain.weight
            spread = plain.points - mean[:, None]
            assert_allclose(cloud.mean, mean, rtol=1e-9, atol=1e-9)
            covariance = (spread * plain.weight) @ spread.T
            covariance[[0, 1], [0, 1]] += LEAST_VARIANCE_M2
            assert_allclose(cloud.covariance, covariance, rtol=1e-9, atol=1e-8)
        assert_allclose(cloud.points, plain.points, rtol=1e-9, atol=1e-9)
        assert_allclose(cloud.weight, plain.weight, rtol=1e-9, atol=1e-12)


def test_moments_between_weighings_are_the_expected_ones() -> None:
    """Moves and noise change the moments as they are expected to, whatever the noise that was drawn."""
    rng = np.random.default_rng(1)
    cloud, _ = _clouds(rng)
    mean, covariance = cloud.mean.copy(), cloud.covariance.copy()
    matrix, by = rng.standard_normal((5, 5)), rng.standard_normal(5)
    cloud.move(matrix, by)
    cloud.diffuse(0.5, rng)
    assert_allclose(cloud.mean, matrix @ mean + by, atol=1e-12)
    assert_allclose(cloud.covariance, matrix @ covariance @ matrix.T + 0.25 * np.diag([1, 1, 0, 0, 0]), atol=1e-12)


@pytest.mark.parametrize("value_m", [0.0, 1e3])
def test_weights_of_points_that_are_all_far_off_are_still_weights(value_m: float) -> None:
    rng = np.random.default_rng(2)
    cloud, _ = _clouds(rng)
    cloud.weigh(MEASURE, MEASURE @ cloud.mean + value_m, np.eye(2), np.zeros((5, 2)))
    cloud.settle(40, rng)
    assert cloud.weight.sum() == pytest.approx(1.0)
    assert np.isfinite(cloud.covariance).all()
