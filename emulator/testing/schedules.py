"""Random schedules of faults that fit a scenario; a random generator or hypothesis makes the choices.

Drawn faults stay plausible: one fault acts on half of the vehicles at most, and its parameters lie within bounds
that a network of vehicles may meet. The fault's class says how it is drawn (`emulator.scenario.faults`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from emulator.drivers.join import split_into_processes
from emulator.scenario.fault_draws import Chooser
from emulator.scenario.fault_families import Fault
from emulator.scenario.faults import KINDS, parse_fault
from emulator.scenario.scenario import Scenario
from emulator.world.world import build_world
from vnet.errors import ScenarioError, did_you_mean

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


def draw_fault(choose: Chooser, constraints: ScheduleConstraints, kinds: Sequence[str]) -> Fault:
    """Draw a fault of one of these kinds."""
    kind = choose.choice(kinds)
    last = round(constraints.healed_s * AT_STEPS) - AT_STEPS // DURATION_STEPS
    at_s = choose.integer(0, last) / AT_STEPS
    longest = int((constraints.healed_s - at_s) * DURATION_STEPS + 1e-6)
    times = {"kind": kind, "at_s": at_s, "duration_s": choose.integer(1, longest) / DURATION_STEPS}
    target = KINDS[kind].draw_target(choose, constraints.processes)
    return parse_fault(times | target | KINDS[kind].draw_parameters(choose))
