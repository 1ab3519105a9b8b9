"""The runs of a campaign: which scenario, how many, and which random faults each of them meets.

Drawn faults stay plausible: one fault acts on half of the vehicles at most, and its parameters lie within bounds
that a network of vehicles may meet. The fault's class says how it is drawn (`emulator.scenario.faults`).
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from emulator.checks.own import load_checks
from emulator.drivers.join import split_into_processes
from emulator.drivers.session import with_order_steps
from emulator.radio.own_rules import load_rules
from emulator.scenario.faults import KINDS, Chooser, Drawn, Fault, parse_fault
from emulator.scenario.scenario import Scenario
from emulator.testing.scenarios import make_scenario
from emulator.world.world import build_world
from vnet.errors import ScenarioError, did_you_mean, printable
from vnet.runtime.programs import load_program, search_programs_in

T = TypeVar("T")
AT_STEPS, DURATION_STEPS = 100, 10
"""Faults start on hundredths of a second and last tenths."""
LEAST_TIME_S = 1 / DURATION_STEPS
"""Least time that a run must leave for faults."""
Ranges = Mapping[str, Mapping[str, Drawn]]
"""Ranges of parameters by kind and key, in place of those of the kinds."""
LONGEST_S = 20.0
MOST_FAULTS = 4
SEEDS = 2**63
RANDOM, NONE = "random", "none"
"""Faults of all kinds, and none drawn: then the runs differ by their seeds."""
SHRINK_STEPS = 250
"""Runs that shrink a failure: of its order, then of its faults, then of its vehicles and seconds."""


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


@dataclass(frozen=True)
class Plan:
    """The runs of a campaign. `shrink_steps` bounds the runs that shrink a failure, `limit_s` each run's time."""

    scenario: Scenario
    runs: int
    seed: int
    kinds: tuple[str, ...]
    limit_s: float = 300.0
    shrink_steps: int = SHRINK_STEPS
    jobs: int = field(default_factory=lambda: os.cpu_count() or 1)
    ranges: Ranges = field(default_factory=dict)
    """Ranges of drawn parameters that differ from those of the kinds."""
    check_determinism: bool = False
    """True if each run is made again in another way, and fails by `replay` where that differs."""
    note: str = ""
    """Change of the scenario that the campaign has made by itself, in one line; "" if none."""
    constraints: ScheduleConstraints | None = None
    """Those of every run's schedule: vehicles have the same names whatever the seed. None without faults."""

    @property
    def drawn_from(self) -> str:
        """A digest of what decides, beside the program and the seed, which runs can be drawn."""
        left_out: dict[str, Any] = {"program": True, "run": {"name", "seed", "order_seed", "order_steps"}}
        scenario = self.scenario.model_dump(mode="json", exclude=left_out)
        ranges = {kind: {name: each.bounds for name, each in of.items()} for kind, of in self.ranges.items()}
        text = json.dumps([scenario, self.kinds, ranges], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @classmethod
    def of(cls, scenario: Scenario, faults: str, runs: int, seed: int, **options: Any) -> Plan:
        """A plan; `faults` is "random", "none", or the kinds to draw from with commas between. Raises VnetError."""
        run = scenario.run
        if run.duration_s > LONGEST_S:
            raise ScenarioError(
                f"run.duration_s = {run.duration_s:g}: a campaign's runs take {LONGEST_S:g} s at most"
            )
        kept = [fault for fault in scenario.fault if not fault.live_only]
        plain, note = make_scenario(scenario, {"run.pacing": "lockstep", "faults": kept}), ""
        kinds = () if faults == NONE else known_kinds(None if faults == RANDOM else faults.split(","))
        constraints = None
        if kinds:
            plain, note = _with_time_for_faults(plain)
            constraints = ScheduleConstraints.of(plain)
        search_programs_in(plain.program.folders)
        load_program(plain.program.entry)
        load_checks(plain.program)
        load_rules(plain.fault, plain.program)
        plain = with_order_steps(plain)
        return cls(plain, runs, seed, kinds, note=note, constraints=constraints, **options)

    def draw(self, number: int) -> Scenario:
        """Run `number`: a network, a seed, and beside the scenario's faults one to four, if any are to be drawn."""
        seed = (self.seed + number) % SEEDS
        scenario = with_seed(self.scenario, seed)
        if self.constraints is None:
            return scenario
        choose, constraints = _Random(seed), self.constraints
        weighted = [kind for kind in self.kinds for _ in range(KINDS[kind].campaign_weight)]
        faults = [
            draw_fault(choose, constraints, weighted, self.ranges) for _ in range(choose.integer(1, MOST_FAULTS))
        ]
        return make_scenario(scenario, {"faults": [*scenario.fault, *faults]})


def with_seed(scenario: Scenario, seed: int) -> Scenario:
    """Return the scenario with another seed, which also draws the network, if it is generated, and the order."""
    changes: dict[str, Any] = {"seed": seed}
    if scenario.network.kind == "generated":
        changes["network.seed"] = seed
    if scenario.run.order != "fifo":
        changes["run.order_seed"] = seed
    return make_scenario(scenario, changes)


def _with_time_for_faults(scenario: Scenario) -> tuple[Scenario, str]:
    """Return a scenario that leaves time for faults, half of its duration if it left none, and what was changed."""
    run = scenario.run
    if scenario.healed_s >= LEAST_TIME_S:
        return scenario, ""
    settle_s = run.duration_s / 2
    note = (
        f"run.settle_s = {run.settle_s:g} leaves no time for faults in {run.duration_s:g} s: this campaign takes "
        f"{settle_s:g}"
    )
    return make_scenario(scenario, {"settle": settle_s}), note


class _Random:
    """A Chooser with a random generator."""

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)

    def integer(self, low: int, high: int) -> int:
        return int(self._rng.integers(low, high, endpoint=True))

    def choice(self, items: Sequence[T]) -> T:
        return items[self.integer(0, len(items) - 1)]

    def subset(self, items: Sequence[T], most: int) -> list[T]:
        chosen = self._rng.permutation(len(items))[: self.integer(1, most)]
        return [items[number] for number in sorted(chosen.tolist())]
