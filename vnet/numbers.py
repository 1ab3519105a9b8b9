"""Numbers that programs give: what counts as one."""

from __future__ import annotations

import math
from typing import Any


def number_or_nan(value: Any) -> float:
    """Return a number, numpy's included, as a float; NaN for what is none: texts, booleans, and beyond floats."""
    if isinstance(value, (str, bytes, bytearray, bool)):
        return math.nan
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return math.nan
