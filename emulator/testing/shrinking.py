"""Shrinking a schedule that fails: fewer faults, fewer vehicles, shorter, as long as it fails in the same way."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from emulator.scenario.faults import Fault, Partition, Selector

Schedule = tuple[Fault, ...]
SHORTEST_S = 0.1
MOST_STEPS = 50


def shrink(
    schedule: Schedule, still_fails: Callable[[Schedule], bool], most: int = MOST_STEPS
) -> tuple[Schedule, int]:
    """The smallest schedule found that still fails, and how many were tried; `most` at most."""
    tried = {schedule}
    progress = True
    while progress:
        progress = False
        for candidate in _smaller(schedule):
            if candidate in tried:
                continue
            if len(tried) > most:
                break
            tried.add(candidate)
            if still_fails(candidate):
                schedule, progress = candidate, True
                break
    return schedule, len(tried) - 1


def _smaller(schedule: Schedule) -> Iterator[Schedule]:
    """Schedules a little smaller than this one; what makes it smallest comes first."""
    for number in range(len(schedule)):
        yield schedule[:number] + schedule[number + 1 :]
    for simpler in (_fewer, _shorter):
        for number, fault in enumerate(schedule):
            for changed in simpler(fault):
                yield (*schedule[:number], changed, *schedule[number + 1 :])


def _halves(items: tuple[Any, ...]) -> Iterator[tuple[Any, ...]]:
    if len(items) > 1:
        middle = len(items) // 2
        yield items[:middle]
        yield items[middle:]


def _fewer(fault: Fault) -> Iterator[Fault]:
    """Propose schedules with fewer vehicles."""
    for name in type(fault).model_fields:
        value = getattr(fault, name)
        if isinstance(value, Selector):
            for ids in _halves(value.ids or ()):
                yield fault.model_copy(update={name: Selector(ids=ids)})
    if isinstance(fault, Partition) and isinstance(fault.groups, tuple) and len(fault.groups) == 1:
        for ids in _halves(fault.groups[0]):
            yield fault.model_copy(update={"groups": (ids,)})


def _shorter(fault: Fault) -> Iterator[Fault]:
    half_s = max(SHORTEST_S, round(fault.duration_s / 2, 1))
    if half_s < fault.duration_s:
        yield fault.model_copy(update={"duration_s": half_s})
