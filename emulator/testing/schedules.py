"""Random schedules of faults that fit a scenario; a random generator or hypothesis makes the choices.

Drawn faults stay plausible: one fault acts on half of the vehicles at most, and its parameters lie within bounds
that a network of vehicles may meet. The fault's class says how it is drawn (`emulator.scenario.faults`).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

from emulator.drivers.join import split_into_processes
from emulator.scenario.faults import KINDS, Chooser, Drawn, Fault, parse_fault
from emulator.scenario.scenario import Scenario
from emulator.world.world import build_world
from vnet.errors import ScenarioError, did_you_mean, printable

T = TypeVar("T")
AT_STEPS, DURATION_STEPS = 100, 10
"""Faults start on hundredths of a second and last tenths."""
LEAST_TIME_S = 1 / DURATION_STEPS
"""Least time that a run must leave for faults."""


@dataclass(frozen=True)
class ScheduleConstraints:
    """The bounds of a schedule: the vehicles by process, and when all faults must have healed."""

    processes: tuple[tuple[str, ...], ...]
    healed_s: float

    @classmethod
    def of(cls, scenario: Scenario) -> ScheduleConstraints:
        """Return the constraints of a scenario. Raises ScenarioError if there is no time for faults."""
        if scenario.healed_s < LEAST_TIME_S:
            raise ScenarioError(
                f"run.duration_s - run.settle_s = {scenario.healed_s:g}: leaves no time for faults of 0.1 s"
            )
        node_ids = build_world(scenario).node_ids
        groups = split_into_processes(node_ids, scenario.run.nodes_per_process)
        return cls(tuple(map(tuple, groups)), scenario.healed_s)


def simulated_kinds() -> tuple[str, ...]:
    """Return the kinds that can be drawn and simulated; misbehaviour, whose names are capital, last."""
    kinds = [name for name, kind in KINDS.items() if kind.campaign_weight and not kind.live_only]
    return tuple(sorted(kinds, key=lambda kind: (kind[0].isupper(), kind)))


def known_kinds(kinds: Sequence[str] | None) -> tuple[str, ...]:
    """Return these kinds, or all that can be simulated. Raises ScenarioError for others."""
    known = simulated_kinds()
    for kind in kinds or ():
        if kind not in known:
            raise ScenarioError(f"fault {kind!r}{did_you_mean(kind, known)}: must be one of {', '.join(known)}")
    return tuple(kinds) if kinds else known


Ranges = Mapping[str, Mapping[str, Drawn]]
"""Ranges of parameters by kind and key, in place of those of the kinds."""


def parse_ranges(texts: Sequence[str]) -> Ranges:
    """Return the ranges of texts such as `delay.delay_ms=1..2000`. Raises ScenarioError if none can be drawn."""
    found: dict[str, dict[str, Drawn]] = {}
    for text in texts:
        match = re.fullmatch(r"(\w+)\.(\w+)=(-?[\d.]+?)\.\.(-?[\d.]+)", text)
        if match is None:
            raise ScenarioError(f"--draw {printable(text)}: write KIND.KEY=LOW..HIGH, as delay.delay_ms=1..2000")
        kind, key, *bounds = match.groups()
        known_kinds([kind])
        if (law := KINDS[kind].drawn_ranges().get(key)) is None:
            drawn = ", ".join(KINDS[kind].drawn_ranges()) or "no parameter"
            raise ScenarioError(f"--draw {text}: of {kind} a campaign draws {drawn}")
        try:
            wider = law.between(float(bounds[0]), float(bounds[1]))
        except ValueError as error:
            raise ScenarioError(f"--draw {text}: {error}") from None
        for chooser in (_Ends(least=True), _Ends(least=False)):
            data = {"kind": kind, "duration_s": 1.0} | KINDS[kind].draw_parameters(chooser, {key: wider})
            parse_fault(data)
        found.setdefault(kind, {})[key] = wider
    return found


class _Ends:
    """A Chooser of the least or the greatest of all."""

    def __init__(self, least: bool) -> None:
        self._end = 0 if least else -1

    def integer(self, low: int, high: int) -> int:
        return (low, high)[self._end]

    def choice(self, items: Sequence[T]) -> T:
        return items[self._end]

    def subset(self, items: Sequence[T], most: int) -> list[T]:
        return list(items[:most])


def draw_fault(
    choose: Chooser, constraints: ScheduleConstraints, kinds: Sequence[str], ranges: Ranges | None = None
) -> Fault:
    """Draw a fault of one of these kinds; `ranges` are those of parameters that differ from the kinds' own."""
    kind = choose.choice(kinds)
    last = round(constraints.healed_s * AT_STEPS) - AT_STEPS // DURATION_STEPS
    at_s = choose.integer(0, last) / AT_STEPS
    longest = int((constraints.healed_s - at_s) * DURATION_STEPS + 1e-6)
    times = {"kind": kind, "at_s": at_s, "duration_s": choose.integer(1, longest) / DURATION_STEPS}
    target = KINDS[kind].draw_target(choose, constraints.processes)
    return parse_fault(times | target | KINDS[kind].draw_parameters(choose, (ranges or {}).get(kind)))
