"""Number of processes of a simulation, and the vehicles of each."""

from __future__ import annotations

import os
from collections.abc import Sequence
from itertools import pairwise
from operator import index
from typing import Literal

from vnet.errors import VnetError, shown

Processes = int | Literal["auto"]
"""Number of processes that run programs, or "auto": as many as this process may use cores."""
VEHICLES_A_PROCESS = 10
"""Least number of vehicles for each process of "auto": with fewer the exchanges cost more than is gained."""


def process_count(asked: Processes | str, vehicles: int) -> int:
    """Return the number of processes for so many vehicles. Raises VnetError for what is neither N nor "auto"."""
    if asked == "auto":
        return max(1, min(_usable_cores(), vehicles // VEHICLES_A_PROCESS))
    try:
        count = int(asked) if isinstance(asked, str) else index(asked)
    except (TypeError, ValueError):
        count = 0
    if count < 1 or isinstance(asked, bool):
        raise VnetError(f"processes = {shown(asked)}: a whole number from 1, or auto, is expected")
    return min(count, vehicles)


def _usable_cores() -> int:
    """Return the number of cores that this process may use; elsewhere than on Linux all there are."""
    usable = getattr(os, "sched_getaffinity", None)
    return len(usable(0)) if usable else os.cpu_count() or 1


def split_evenly(node_ids: Sequence[str], processes: int) -> list[list[str]]:
    """Split nodes into consecutive parts of nearly equal size, one for each process, and none of them empty."""
    processes = min(processes, len(node_ids))
    ends = [len(node_ids) * part // processes for part in range(processes + 1)]
    return [list(node_ids[start:end]) for start, end in pairwise(ends)]
