"""Overlap of rectangles: against points drawn in one of them."""

import numpy as np

from emulator.world.driven.vehicles import rectangles_overlap


def test_rectangles_overlap_as_their_points_do() -> None:
    rng = np.random.default_rng(1)
    offset_m, turns = rng.uniform(-5, 5, (400, 2)), rng.uniform(0, 2 * np.pi, (2, 400))
    found = rectangles_overlap(offset_m, turns[0], turns[1], 4.5, 1.8)
    # Points of a fine grid on the first rectangle, in the frame of the second.
    along, across = (axis.ravel() for axis in np.meshgrid(np.linspace(-2.25, 2.25, 91), np.linspace(-0.9, 0.9, 37)))
    (cos, sin), (other_cos, other_sin) = ((np.cos(turn)[:, None], np.sin(turn)[:, None]) for turn in turns)
    east = cos * along - sin * across - offset_m[:, :1]
    north = sin * along + cos * across - offset_m[:, 1:]
    x, y = np.abs(other_cos * east + other_sin * north), np.abs(other_cos * north - other_sin * east)
    inside = ((x < 2.25) & (y < 0.9)).any(axis=1)
    nearly = ((x < 2.31) & (y < 0.96)).any(axis=1)
    assert found[inside].all()
    assert not found[~nearly].any()
    assert 50 < inside.sum() < 250


def test_rectangles_that_touch_do_not_overlap() -> None:
    offset_m = np.array([[4.5, 0.0], [0.0, 1.8], [3.15, 0.0], [3.14, 0.0]])
    other_rad = np.array([0.0, 0.0, np.pi / 2, np.pi / 2])
    assert rectangles_overlap(offset_m, np.zeros(4), other_rad, 4.5, 1.8).tolist() == [False, False, False, True]
