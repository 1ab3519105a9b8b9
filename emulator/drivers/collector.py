"""Python's garbage collector during a simulation."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager

OBJECTS_A_VEHICLE = 100
"""Allocations a vehicle, less what is freed, between two collections: more than a vehicle keeps of a period."""


@contextmanager
def rare_collections(vehicles: int) -> Iterator[None]:
    """Let the collector run once in some periods, and not several times within each, while a simulation runs.

    What a period allocates grows with the number of vehicles, and so does what each collection looks at: with a
    fixed threshold their product takes a quarter of the time of a run of 1000 vehicles. A collector that is
    switched off stays so.
    """
    before = gc.get_threshold()
    if before[0]:
        gc.set_threshold(max(before[0], OBJECTS_A_VEHICLE * vehicles), *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)
