"""Reports of one period as arrays: the same for a run that is on, and for one that is read from its folder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vnet.reports import Report
from vnet.types import Array

WEIGHT = "weight."
"""Prefix of the reported values that are weights of a fusion; a node's id follows."""


@dataclass(frozen=True)
class Beliefs:
    """Reports of one period: arrays (n, 2) and (n, 4), NaN where a node reported nothing.

    By node, also the numbers of its cloud, point by point, and the weights (n,) of its fusion. By name, the figures
    (n,) of programs' own, true as 1, and texts (n) with "" where a node reported none.
    """

    estimate_m: Array
    covariance_m2: Array
    common_error_m: Array
    common_error_covariance_m2: Array
    clouds: Mapping[str, ArrayLike]
    weights: Mapping[str, Array]
    values: Mapping[str, Array]
    texts: Mapping[str, list[str]]


def is_cloud(count: int) -> bool:
    """Return whether so many numbers can be points."""
    return count % 2 == 0


def collect(number: Mapping[str, int], last: Mapping[str, Report], get: Any, size: int) -> Array:
    """(N, size) of what `get` finds in each node's report; NaN where it finds nothing of that size."""
    array = np.full((len(number), size), np.nan)
    found = [(number[node], value) for node, report in last.items() if (value := get(report)) is not None]
    fitting = [(i, value) for i, value in found if isinstance(value, (list, tuple)) and len(value) == size]
    if fitting:
        at, values = zip(*fitting, strict=True)
        array[[*at]] = values
    return array
