"""Caches of what frames hold, for the vehicles of one process: each vehicle adds to their size.

A process of one vehicle decodes each frame once, so a large cache would only take memory there. In a process of
many vehicles all that hear a frame share what it holds.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Generic, ParamSpec, TypeVar
from weakref import WeakSet

P = ParamSpec("P")
R = TypeVar("R")

LEAST_ENTRIES = 64
"""Entries for one vehicle: what is heard in a period, by twice the default peer cap."""
ENTRIES_PER_VEHICLE = 4
"""Entries for each further vehicle: what it sends in two periods with two frames a period."""

_vehicles: WeakSet[object] = WeakSet()
_caches: list[VehicleCache[..., object]] = []
_entries = LEAST_ENTRIES


class VehicleCache(Generic[P, R]):
    """A function whose latest results are kept, as many as the vehicles of the process need.

    cached: the function with the present cache, for loops: a call of it is a tenth of one of this object.
    """

    def __init__(self, function: Callable[P, R]) -> None:
        self._function = function
        self.__wrapped__ = function
        self.__doc__ = function.__doc__
        self.resize()
        _caches.append(self)  # type: ignore[arg-type]  # invariant in P

    def resize(self) -> None:
        """Begin a cache of the present size; what was kept is forgotten."""
        self.cached = lru_cache(maxsize=_entries)(self._function)

    @property
    def entries(self) -> int:
        """Most results that are kept."""
        return int(self.cached.cache_parameters()["maxsize"])

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """Return the function's result, from the cache if it is there."""
        return self.cached(*args, **kwargs)  # type: ignore[arg-type]  # all arguments are hashable


def add_vehicle(vehicle: object) -> None:
    """Count `vehicle` among those of the process for as long as it exists.

    Sizes double, so that vehicles that enter one by one do not empty the caches each time.
    """
    global _entries
    _vehicles.add(vehicle)
    needed = LEAST_ENTRIES + ENTRIES_PER_VEHICLE * (len(_vehicles) - 1)
    if needed > _entries:
        _entries = max(needed, 2 * _entries)
        for cache in _caches:
            cache.resize()
