"""Reports of one period as arrays: the same for a run that is on, and for one that is read from its folder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from numpy.typing import ArrayLike

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
