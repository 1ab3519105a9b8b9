"""Types of arrays; docstrings give their shapes, as (K, N)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Real numbers, such as metres, seconds or probabilities."""
IntArray = NDArray[np.int64]
"""Integers, such as times in nanoseconds or numbers of frames."""
Mask = NDArray[np.bool_]
"""A subset as a mask."""
