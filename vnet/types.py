"""Types of arrays that the whole code shares; shapes are given where they are used, as (K, N)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Numbers: metres, seconds, probabilities."""
IntArray = NDArray[np.int64]
"""Whole numbers: times in nanoseconds, numbers of frames and faults."""
Mask = NDArray[np.bool_]
"""A subset, by index."""
