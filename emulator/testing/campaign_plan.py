"""The runs of a campaign: which scenario, how many, and which faults each of them meets."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from emulator.checks.own import load_checks
from emulator.drivers.session import with_order_steps
from emulator.radio.own_rules import load_rules
from emulator.scenario.faults import KINDS, OwnRule
from emulator.scenario.scenario import Scenario
from emulator.testing.scenarios import make_scenario
from emulator.testing.schedules import LEAST_TIME_S, Ranges, ScheduleConstraints, draw_fault, known_kinds
from vnet.errors import ScenarioError
from vnet.runtime.program_path import search_programs_in
from vnet.runtime.programs import load_program

LONGEST_S = 20.0
MOST_FAULTS = 4
SEEDS = 2**63
RANDOM, NONE = "random", "none"
"""Faults of all kinds, and none drawn: then the runs differ by their seeds."""
SHRINK_STEPS = 250
"""Runs that shrink a failure: of its order, then of its faults, then of its vehicles and seconds."""


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
        own = [fault for fault in scenario.fault if isinstance(fault, OwnRule)]
        plain, note = make_scenario(scenario, {"run.pacing": "lockstep", "faults": own}), ""
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
        """Run `number`: a network, a seed and one to four faults, if there are to be any."""
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
