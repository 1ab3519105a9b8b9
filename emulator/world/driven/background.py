"""Vehicles that another simulator moves beside those with programs: where they were at the start of each period."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vnet.types import Array


class Background:
    """Positions of vehicles that have no program and no radio, in columns: there may be many."""

    def __init__(self) -> None:
        self.names: dict[str, int] = {}
        """Number of each vehicle by its id, in the order in which they have come."""
        self.time_ns: list[int] = []
        self.numbers: list[NDArray[np.int32]] = []
        """Numbers (k,) of those that were there, at each of the times."""
        self.position_m: list[Array] = []
        """Their positions (k, 2)."""

    def add(self, time_ns: int, ids: Sequence[str], position_m: Array) -> None:
        """Add the vehicles that are there at a time."""
        self.time_ns.append(time_ns)
        self.numbers.append(np.array([self.names.setdefault(each, len(self.names)) for each in ids], np.int32))
        self.position_m.append(position_m)
