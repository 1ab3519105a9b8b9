"""Start of a SUMO that is stepped with a run: options, the way to the run's beginning, and who has a program."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from emulator.scenario.network import Network, node_id, read_begin_s
from emulator.scenario.scenario import Scenario
from emulator.world.driven.sumo_client import SumoProcess
from emulator.world.driven.sumo_messages import Begin, Begun, Find, Found, State, Step, StepTo
from vnet.errors import ScenarioError, first_names, shown
from vnet.units import NS_PER_S

STEPS = 100
"""Steps that SUMO makes for one answer before the run, so that this comes well within the time for it."""


def start_sumo(scenario: Scenario, path: Path, step_ns: int) -> tuple[SumoProcess, Begun, list[str]]:
    """Start SUMO and let it come to the run's beginning; returns also the vehicles that have a program.

    They are in the order in which SUMO inserts them by itself. Where not all are there from the beginning, SUMO
    goes on without programs until they are, and is then started again. Raise ScenarioError if none is inserted in
    the run's time, or one that is named is not.
    """
    process, begun = _begin(scenario, path, step_ns)
    search = _Search(scenario.network)
    if not search.take(process.ask(Find(0), Found).vehicles):
        left = (scenario.duration_ns - 1) // step_ns
        while left > 0 and not search.take(process.ask(Find(min(left, STEPS)), Found).vehicles):
            left -= STEPS
        process.kill()
        process, begun = _begin(scenario, path, step_ns)
    search.check(path, scenario.run.duration_s)
    process.timeout_s = scenario.run.stall_timeout_s
    return process, begun, search.found


class _Search:
    """Vehicles that have a program, as they are found: those that are named, or the first."""

    def __init__(self, network: Network) -> None:
        self._named = None if network.sumo is None else network.sumo.nodes
        self._most = network.max_vehicles if self._named is None else len(set(self._named))
        self.found: list[str] = []
        self._inserted: list[str] = []

    def take(self, inserted: Sequence[str]) -> bool:
        """Take vehicles that SUMO has inserted; returns whether all are found."""
        self._inserted += inserted
        wanted = [each for each in inserted if self._named is None or each in self._named]
        self.found = [*dict.fromkeys([*self.found, *wanted])][: self._most]
        return len(self.found) == self._most

    def check(self, path: Path, duration_s: float) -> None:
        """Raise ScenarioError unless all that are named are found, at least one, and nodes can have their ids."""
        for name in self._named or ():
            if name not in self.found:
                raise ScenarioError(
                    f"network.sumo.nodes = {shown(name)}: SUMO inserts no such vehicle in the run's "
                    f"{duration_s:g} s ({path}), but {first_names(self._inserted) or 'none'}"
                )
        if not self.found:
            raise ScenarioError(f"{path}: SUMO inserts no vehicle in the run's {duration_s:g} s")
        by_id: dict[str, str] = {}
        for name in self.found:
            if (other := by_id.setdefault(node_id(name), name)) != name:
                raise ScenarioError(f"{path}: ids {shown(other)} and {shown(name)} are both {node_id(name)}")


def _begin(scenario: Scenario, path: Path, step_ns: int) -> tuple[SumoProcess, Begun]:
    """Start SUMO and have it make all steps up to that of the run's beginning, as it writes floating car data."""
    network, begin_s = scenario.network, read_begin_s(path)
    start_s = begin_s if network.start_s is None else network.start_s
    if start_s < begin_s:
        raise ScenarioError(f"network.start_s = {start_s:g}: SUMO begins at {begin_s:g} s ({path})")
    process = SumoProcess(path, scenario.run.join_timeout_s)
    begun = process.ask(Begin(_options(path, network.seed, step_ns)), Begun)
    while begin_s < start_s:
        begin_s = min(start_s, begin_s + STEPS * step_ns / NS_PER_S)
        process.ask(StepTo(begin_s), Found)
    process.ask(Step([]), State)
    return process, begun


def _options(path: Path, seed: int, step_ns: int) -> list[str]:
    """Return SUMO's options, which come before those of the configuration.

    One thread and the scenario's seed make a run reproducible. Vehicles that collide are told, and not removed.
    """
    options = {
        "configuration-file": path,
        "seed": seed,
        "random": "false",
        "step-length": f"{step_ns / NS_PER_S:g}",
        "threads": 1,
        "device.rerouting.threads": 1,
        "collision.action": "warn",
        "collision.check-junctions": "true",
        "collision.mingap-factor": 0,
        "no-step-log": "true",
        "no-warnings": "true",
        "duration-log.disable": "true",
    }
    return [part for name, value in options.items() for part in (f"--{name}", str(value))]
