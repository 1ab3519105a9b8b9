"""Steady growth of memory: told apart from memory that is taken once, and from noise."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.checks.run import FLOOR_KIB, is_long_enough, steady_growth_kib_per_s
from emulator.drivers.usage import SAMPLES

BASE_KB = 60_000
durations = st.sampled_from([30.0, 60.0, 600.0])


def times(duration_s: float) -> list[float]:
    """The instants at which a run of this duration is sampled, with a period of 0.1 s."""
    return [max(0.1, duration_s * n / SAMPLES) for n in range(SAMPLES)]


@pytest.mark.parametrize("duration_s", [30.0, 60.0])
def test_a_leak_and_memory_taken_once_are_told_apart(duration_s: float) -> None:
    time_s = times(duration_s)
    leak_kb = [BASE_KB + 150 * t for t in time_s]
    once_kb = [BASE_KB + (5_000 if t >= 20 else 0) for t in time_s]
    assert steady_growth_kib_per_s(time_s, leak_kb) == pytest.approx(150, rel=0.01)
    assert steady_growth_kib_per_s(time_s, once_kb) == 0


@pytest.mark.slow
@given(durations, st.floats(60, 5_000), st.floats(0, 1e6))
def test_every_leak_is_found_with_its_rate(duration_s: float, kb_per_s: float, base_kb: float) -> None:
    time_s = times(duration_s)
    size_kb = [base_kb + kb_per_s * t for t in time_s]
    assert steady_growth_kib_per_s(time_s, size_kb) == pytest.approx(kb_per_s, rel=0.01)


@pytest.mark.slow
@given(
    durations, st.lists(st.tuples(st.floats(0, 1), st.floats(0, 1e6)), max_size=2), st.floats(0, FLOOR_KIB / 1.1)
)
def test_two_steps_and_slow_growth_are_no_growth_whatever_their_size(
    duration_s: float, steps: list[tuple[float, float]], slow_kb: float
) -> None:
    time_s = times(duration_s)
    slow_kb_per_s = slow_kb / (duration_s / 2)
    size_kb = [
        BASE_KB + slow_kb_per_s * t + sum(kb for share, kb in steps if t >= share * duration_s) for t in time_s
    ]
    assert steady_growth_kib_per_s(time_s, size_kb) == 0


@pytest.mark.slow
@given(durations, st.integers(0, 2**32 - 1), st.floats(0, FLOOR_KIB / 2.1))
def test_noise_below_the_floor_is_no_growth(duration_s: float, seed: int, half_width_kb: float) -> None:
    time_s = times(duration_s)
    noise_kb = np.random.default_rng(seed).uniform(-half_width_kb, half_width_kb, len(time_s))
    assert steady_growth_kib_per_s(time_s, (BASE_KB + noise_kb).tolist()) == 0


@pytest.mark.slow
@given(durations, st.floats(0.1, 0.5), st.floats(100, 20_000))
def test_what_grows_in_the_first_half_alone_is_no_growth(duration_s: float, share: float, kb_per_s: float) -> None:
    time_s = times(duration_s)
    size_kb = [BASE_KB + kb_per_s * min(t, share * duration_s) for t in time_s]
    assert steady_growth_kib_per_s(time_s, size_kb) == 0


@pytest.mark.slow
@given(st.integers(0, 2**32 - 1), st.floats(-1e5, 1e5))
def test_the_base_does_not_matter(seed: int, base_kb: float) -> None:
    time_s = times(60.0)
    size_kb = np.cumsum(np.random.default_rng(seed).integers(-200, 600, len(time_s))).astype(float)
    moved = steady_growth_kib_per_s(time_s, (size_kb + round(base_kb)).tolist())
    assert moved == pytest.approx(steady_growth_kib_per_s(time_s, size_kb.tolist()))


@pytest.mark.parametrize(("duration_s", "expected"), [(28.0, False), (30.0, True), (3600.0, True)])
def test_a_run_is_judged_from_thirty_seconds_on(duration_s: float, expected: bool) -> None:
    assert is_long_enough(times(duration_s)) is expected
