"""Particles of the common error: weights, memory and resampling."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.cooperative.cmm.common_error import CommonErrorParticles, systematic


def particles(count: int = 4) -> CommonErrorParticles:
    return CommonErrorParticles(np.arange(2.0 * count).reshape(2, count))


@pytest.mark.slow
@settings(max_examples=100, deadline=None)
@given(st.lists(st.floats(-900, 900), min_size=4, max_size=4), st.floats(-500, 500))
def test_weights_are_normalized_and_do_not_depend_on_the_constant(log_weight: list[float], constant: float) -> None:
    one, other = particles(), particles()
    one.log_weight = np.array(log_weight)
    other.log_weight = np.array(log_weight) + constant
    assert one.weight.sum() == pytest.approx(1.0)
    assert other.weight == pytest.approx(one.weight, rel=1e-9, abs=1e-12)
    assert 1 - 1e-9 <= one.effective_sample_size <= 4 + 1e-9


def test_a_change_of_the_log_weights_changes_the_weights() -> None:
    subject = particles(2)
    assert subject.weight.tolist() == [0.5, 0.5]
    subject.log_weight += np.log([1.0, 3.0])
    assert subject.weight == pytest.approx([0.25, 0.75])
    assert subject.estimate_m == pytest.approx([0.75, 2.75])
    assert subject.covariance_m2 == pytest.approx(np.full((2, 2), 0.1875))


@pytest.mark.slow
@given(st.lists(st.floats(0.05, 0.5), min_size=1, max_size=40), st.floats(0.0, 1.2))
def test_c_of_the_past_is_remembered_as_long_as_it_should_be(steps_s: list[float], age_s: float) -> None:
    """c is the time itself, so that each remembered one says of which time it is."""
    subject = CommonErrorParticles(np.zeros((2, 1)))
    now_s, times_s = 0.0, [0.0]
    for dt_s in steps_s:
        now_s += dt_s
        subject.common_m[:] = now_s
        subject.remember(dt_s, 1.2)
        times_s.append(now_s)
    kept_s = sorted(t for t in times_s if now_s - t <= 1.2 + 1e-9)
    found_s = sorted(subject.past_m[:, 0, 0].tolist())
    assert len(found_s) in (len(kept_s), len(kept_s) - 1), "the oldest may be on the edge"
    assert found_s == kept_s[len(kept_s) - len(found_s) :]
    assert subject.oldest_s == pytest.approx(now_s - found_s[0])
    nearest_s = min(abs(now_s - t - age_s) for t in found_s)
    at = subject.at(np.array([age_s]))
    assert abs(now_s - float(at.reshape(-1)[0]) - age_s) == pytest.approx(nearest_s, abs=1e-9)


def test_resampling_takes_the_past_along() -> None:
    subject = particles()
    subject.remember(0.1, 1.0)
    subject.log_weight += np.arange(4.0)
    subject.take(np.array([3, 3, 0]))
    assert subject.common_m.tolist() == [[3, 3, 0], [7, 7, 4]]
    assert subject.past_m.tolist() == [[[3, 3, 0], [7, 7, 4]]] * 2
    assert subject.weight == pytest.approx(np.full(3, 1 / 3))
    assert len(subject) == 3


def test_prediction_contracts_and_spreads() -> None:
    subject = CommonErrorParticles(np.full((2, 20_000), 2.0))
    subject.predict(0.5, 0.3, np.random.default_rng(0))
    assert subject.estimate_m == pytest.approx([1.0, 1.0], abs=0.01)
    assert subject.covariance_m2 == pytest.approx(0.09 * np.eye(2), abs=0.004)


def test_systematic_resampling_is_within_one_of_what_is_expected() -> None:
    rng = np.random.default_rng(4)
    for _ in range(50):
        weight = rng.dirichlet(np.ones(20))
        counts = np.bincount(systematic(weight, 100, rng), minlength=20)
        assert np.all(np.abs(counts - 100 * weight) <= 1 + 1e-9)
        assert counts.sum() == 100
