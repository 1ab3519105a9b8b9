"""The judging of a process's memory: whether it grows without end."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

SPAN_S = 27.0
"""Least time in s from the first sample to the last: in a run of 30 s both lie within 1.5 s of its ends."""
TENTHS = 10
"""Parts of the second half of a series."""
RISING_TENTHS = 8
"""Tenths in which steady growth shows; memory that is taken once, or in a few steps, rises in fewer."""
FLOOR_KIB = 512.0
"""Growth over the second half, in KiB, that is the allocator's and the collector's own; less is no growth."""


def is_long_enough(time_s: Sequence[float]) -> bool:
    """Return whether a series with these times can be judged."""
    return len(time_s) > TENTHS and time_s[-1] - time_s[0] >= SPAN_S


def steady_growth_kib_per_s(time_s: Sequence[float], size_kb: Sequence[float]) -> float:
    """Return the rate at which memory grew steadily in the second half of its series, in KiB a second; else 0."""
    if not is_long_enough(time_s):
        return 0.0
    from_s, to_s = (time_s[0] + time_s[-1]) / 2, time_s[-1]
    levels_kb = np.interp(np.linspace(from_s, to_s, TENTHS + 1), time_s, size_kb)
    grown_kb = float(levels_kb[-1] - levels_kb[0])
    is_steady = int((np.diff(levels_kb) > 0).sum()) >= RISING_TENTHS and grown_kb >= FLOOR_KIB
    return grown_kb / (to_s - from_s) if is_steady else 0.0
