"""Bounds of a sender's queue, worked out of what was sent alone."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from emulator.checks.channel import NO_EPISODE, _plain_course, _throttled_course

batches = st.lists(
    st.tuples(st.integers(0, 10**9), st.integers(0, 10**7), st.integers(0, 10**7)), min_size=1, max_size=30
)


@given(batches=batches, delay_ns=st.integers(0, 10**7))
def test_a_queue_that_nothing_throttles_has_the_plain_course(
    batches: list[tuple[int, int, int]], delay_ns: int
) -> None:
    """The course of a sender without episodes is the one that goes from batch to batch."""
    gap_ns, least_ns, more_ns = np.array(batches, dtype=float).T
    sent_ns, alike = np.cumsum(gap_ns), np.repeat(least_ns[:, None], 5, axis=1)
    alike[:, 4] += more_ns
    step_by_step = _throttled_course(sent_ns, alike, delay_ns, np.full(len(batches), NO_EPISODE))
    at_once = _plain_course(sent_ns, alike, delay_ns)
    for one, other in zip(at_once, step_by_step, strict=True):
        np.testing.assert_array_equal(one, other)
