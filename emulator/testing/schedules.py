"""Random schedules of faults that fit a scenario, whoever makes the choices: a random generator, or hypothesis.

What is drawn stays plausible: half of the vehicles at most are hit by one fault, and parameters lie within bounds
that a network of vehicles may meet. The first choice everywhere is the simplest, so that hypothesis shrinks to it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from emulator.drivers.join import split_into_processes
from emulator.scenario.faults import KINDS, Fault, parse_fault
from emulator.scenario.scenario import Scenario
from emulator.world.world import build_world
from vnet.errors import ScenarioError, did_you_mean

T = TypeVar("T")

NOT_SIMULATED = ("emulator_restart", "router_restart")
SIMULATED_KINDS = tuple(sorted(set(KINDS) - set(NOT_SIMULATED), key=lambda kind: (kind[0].isupper(), kind)))
"""Misbehaviour, whose names are capital, last."""
OF_PROCESSES = ("kill", "restart", "pause")
WEIGHTS: Mapping[str, int] = {"partition": 4, "kill": 3, "pause": 3, "burst_loss": 2, "corrupt": 2, "block": 2}
"""How often a campaign draws a kind; 1 where nothing is said."""
AT_STEPS, DURATION_STEPS = 100, 10
"""Faults start on hundredths of a second and last tenths."""


class Chooser(Protocol):
    """Whoever makes the choices."""

    def integer(self, low: int, high: int) -> int:
        """A whole number, low ≤ n ≤ high."""

    def choice(self, items: Sequence[T]) -> T:
        """One of these."""

    def subset(self, items: Sequence[T], most: int) -> list[T]:
        """At least one of these, and so many at most."""


@dataclass(frozen=True)
class ScheduleConstraints:
    """What schedules must fit: the vehicles by process, and when all faults must have healed."""

    processes: tuple[tuple[str, ...], ...]
    healed_s: float

    @classmethod
    def of(cls, scenario: Scenario) -> ScheduleConstraints:
        """The ground of a scenario. Raises ScenarioError if there is no time for faults."""
        if scenario.healed_s * DURATION_STEPS < 1:
            raise ScenarioError(
                f"run.duration_s - run.settle_s = {scenario.healed_s:g}: leaves no time for faults of 0.1 s"
            )
        node_ids = build_world(scenario).node_ids
        groups = split_into_processes(node_ids, scenario.run.nodes_per_process)
        return cls(tuple(map(tuple, groups)), scenario.healed_s)

    @property
    def ids(self) -> list[str]:
        """All vehicles."""
        return [node for process in self.processes for node in process]


def known_kinds(kinds: Sequence[str] | None) -> tuple[str, ...]:
    """These kinds, or all that can be simulated. Raises ScenarioError for others."""
    for kind in kinds or ():
        if kind not in SIMULATED_KINDS:
            meant = did_you_mean(kind, SIMULATED_KINDS)
            raise ScenarioError(f"fault {kind!r}{meant}: must be one of {', '.join(SIMULATED_KINDS)}")
    return tuple(kinds) if kinds else SIMULATED_KINDS


def draw_fault(choose: Chooser, ground: ScheduleConstraints, kinds: Sequence[str]) -> Fault:
    """A fault of one of these kinds."""
    kind = choose.choice(kinds)
    last = round(ground.healed_s * AT_STEPS) - AT_STEPS // DURATION_STEPS
    at_s = choose.integer(0, last) / AT_STEPS
    duration_s = choose.integer(1, int((ground.healed_s - at_s) * DURATION_STEPS + 1e-6)) / DURATION_STEPS
    what = {"kind": kind, "at_s": at_s, "duration_s": duration_s}
    return parse_fault(what | _where(choose, ground, kind) | _parameters(choose, kind))


def _half(count: int) -> int:
    return max(1, count // 2)


def _where(choose: Chooser, ground: ScheduleConstraints, kind: str) -> dict[str, Any]:
    if kind == "partition":
        shape = choose.choice(("named", "halves", "one", "ring"))
        ids = ground.ids
        return {"groups": [choose.subset(ids, _half(len(ids)))] if shape == "named" else shape}
    if kind in OF_PROCESSES:
        chosen = choose.subset(ground.processes, _half(len(ground.processes)))
        return {"nodes": {"ids": [node for process in chosen for node in process]}}
    ids = choose.subset(ground.ids, _half(len(ground.ids)))
    ends = ("nodes", "senders", "receivers") if kind in OF_LINKS else ("nodes",)
    return {choose.choice(ends): {"ids": ids}}


OF_LINKS = ("block", "loss", "burst_loss", "delay", "jitter", "reorder", "duplicate", "corrupt")


def _parameters(choose: Chooser, kind: str) -> dict[str, Any]:
    def point(most: int) -> tuple[float, float]:
        return float(choose.integer(-most, most)), float(choose.integer(-most, most))

    def share(most_tenths: int) -> float:
        return choose.integer(1, most_tenths) / 10

    match kind:
        case "loss":
            return {"probability": share(10)}
        case "burst_loss":
            return {"enter": choose.integer(1, 30) / 100, "leave": share(10)}
        case "delay":
            return {"delay_ms": choose.integer(1, 500)}
        case "jitter":
            return {"jitter_ms": choose.integer(1, 300)}
        case "reorder":
            return {"probability": share(5), "delay_ms": choose.integer(1, 400)}
        case "duplicate":
            return {"probability": share(5), "copies": choose.integer(1, 3), "delay_ms": choose.integer(1, 100)}
        case "corrupt":
            return {"probability": share(5), "flips": choose.integer(1, 8)}
        case "throttle":
            return {"bitrate_mbps": choose.integer(1, 40) / 20}
        case "range":
            return {"range_m": 100 * choose.integer(1, 20)}
        case "gnss_jump" | "ConstPosOffset":
            return {"offset_m": point(50)}
        case "gnss_ramp":
            return {"rate_m_s": point(3)}
        case "RandomPos":
            return {"radius_m": choose.integer(1, 300)}
        case "skew":
            return {"offset_ms": choose.integer(-1000, 1000)}
        case "drift":
            return {"rate_ppm": 100 * choose.integer(-500, 500)}
        case "DataReplay" | "StaleMessages":
            return {"age_s": choose.integer(1, 30) / 10}
        case "DoS":
            return {"factor": choose.integer(2, 10)}
        case "Sybil":
            return {"ghosts": choose.integer(1, 3)}
        case _:
            return {}
