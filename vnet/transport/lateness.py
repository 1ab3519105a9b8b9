"""Lateness of deliveries in real time, counted in bins: four for each factor of two, from 10 µs to 10 s."""

from __future__ import annotations

import math

LATENESS_LIMIT_NS = 20_000_000
"""Deliveries later than this count against a real-time run."""
LATENESS_BINS = 80
"""Number of bins."""
_LATENESS_LIMIT_BIN = 44
"""Bin whose lower edge is `LATENESS_LIMIT_NS`."""


def lateness_bin(late_ns: int) -> int:
    """Return the bin of a delay: four bins for each factor of two; bin 44 begins at the bound of 20 ms."""
    if late_ns <= 0:
        return 0
    position = _LATENESS_LIMIT_BIN + math.floor(4 * math.log2(late_ns / LATENESS_LIMIT_NS))
    return min(max(position, 0), LATENESS_BINS - 1)


def lateness_edge_ms(index: int) -> float:
    """Return the upper edge of a lateness bin in milliseconds."""
    return LATENESS_LIMIT_NS / 1e6 * float(2 ** ((index + 1 - _LATENESS_LIMIT_BIN) / 4))
