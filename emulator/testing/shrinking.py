"""Shrinking of what fails, as long as it fails in the same way: a schedule of faults, or an order of events."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from typing import Any, TypeVar

from emulator.records.tape import TapeEntry, described, parse_tape, tape_lines
from emulator.scenario.faults import Fault, Partition, Selector
from emulator.scenario.scenario import Scenario
from emulator.testing.scenarios import make_scenario
from vnet.errors import VnetError

Schedule = tuple[Fault, ...]
SHORTEST_S = 0.1
MOST_STEPS = 50
MOST_ORDER_STEPS = 150
"""Runs that shrink an order."""
SHORTEST_RUN_S = 0.2
MOST_SHOWN = 5
"""Deviations that a phrase tells."""
T = TypeVar("T")
Fails = Callable[[Scenario], bool]


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


def with_faults(scenario: Scenario, schedule: Schedule) -> Scenario:
    """Return the scenario with these faults."""
    return make_scenario(scenario, {"faults": schedule})


def with_tape(scenario: Scenario, tape: Sequence[TapeEntry]) -> Scenario:
    """Return the scenario in FIFO order but for these deviations."""
    fifo = make_scenario(scenario, {"run.order": "fifo"})
    lines = tuple(tape_lines(tape)) or None
    return fifo.model_copy(update={"run": fifo.run.model_copy(update={"tape": lines})})


def order_text(lines: Sequence[str]) -> str:
    """Return a tape as a phrase: "FIFO, except v03: timer of tell before packet from v01, at 4.2 s"."""
    entries = parse_tape(lines, "run.tape")
    told = "; ".join(described(entry) for entry in entries[:MOST_SHOWN])
    more = f"; and {len(entries) - MOST_SHOWN} more" if len(entries) > MOST_SHOWN else ""
    return f"FIFO, except {told}{more}"


def shrink_order(
    scenario: Scenario, tape: Sequence[TapeEntry], still_fails: Fails, most: int = MOST_ORDER_STEPS
) -> tuple[Scenario, int]:
    """Return the scenario with the fewest deviations of its tape that still fail, and how many runs that took.

    FIFO itself is tried first. Where the tape does not fail either, the scenario comes back as it was; so it does
    if `most` runs are too few to try both.
    """
    if most < 2:
        return scenario, 0
    if still_fails(fifo := with_tape(scenario, ())):
        return fifo, 1
    if not tape or not still_fails(with_tape(scenario, tape)):
        return scenario, 2
    least, steps = fewest(tape, lambda some: still_fails(with_tape(scenario, some)), most - 2)
    return with_tape(scenario, least), steps + 2


def fewest(items: Sequence[T], still_fails: Callable[[Sequence[T]], bool], most: int) -> tuple[Sequence[T], int]:
    """Return items none of which can be left out, and how many choices were tried, at most `most`.

    Zeller and Hildebrandt, "Simplifying and isolating failure-inducing input", IEEE TSE 28 (2002): parts are left
    out, then halved, until each is one item.
    """
    parts, tried = 2, 0
    while len(items) > 1 and tried < most:
        for kept in _with_and_without_parts(items, parts):
            tried += 1
            if still_fails(kept):
                parts = 2 if len(kept) * 2 <= len(items) else max(parts - 1, 2)
                items = kept
                break
            if tried >= most:
                break
        else:
            if parts >= len(items):
                break
            parts = min(parts * 2, len(items))
    return items, tried


def _with_and_without_parts(items: Sequence[T], parts: int) -> Iterator[Sequence[T]]:
    """Yield each of so many parts alone, then all but each."""
    ends = [len(items) * number // parts for number in range(parts + 1)]
    pairs = list(pairwise(ends))
    for first, end in pairs:
        yield items[first:end]
    for first, end in pairs if parts > 2 else ():
        yield [*items[:first], *items[end:]]


def shrink_run(scenario: Scenario, still_fails: Fails, most: int) -> tuple[Scenario, int]:
    """Return the run with half the vehicles and time, as often as that fails, and how many runs it took.

    There are `most` of them at most.
    """
    steps = 0
    for smaller in (_fewer_vehicles, _less_time):
        while steps < most and (candidate := smaller(scenario)) is not None:
            steps += 1
            if not still_fails(candidate):
                break
            scenario = candidate
    return scenario, steps


def _fewer_vehicles(scenario: Scenario) -> Scenario | None:
    """Return the run with half of the vehicles; None if they are not drawn, or faults may be of those that go."""
    network = scenario.network
    if network.kind != "generated" or network.vehicles < 2 or scenario.fault:
        return None
    return _changed(scenario, "vehicles", (network.vehicles + 1) // 2 if network.vehicles > 2 else 1)


def _less_time(scenario: Scenario) -> Scenario | None:
    """Return the run of half the time; None if it would be too short, or end before a fault."""
    half_s = round(scenario.run.duration_s / 2, 1)
    if half_s < SHORTEST_RUN_S:
        return None
    return _changed(scenario, "duration", half_s)


def _changed(scenario: Scenario, name: str, value: float) -> Scenario | None:
    try:
        return make_scenario(scenario, {name: value})
    except VnetError:
        return None
