"""A small engine with a fault plan."""

import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from emulator.fault_plan import FaultPlan, Nodes
from emulator.radio.engine import Delivery, Engine
from emulator.radio.own_rules import OwnRules, RuleFailure
from emulator.scenario.scenario import Scenario
from vnet.radio import SentFrame

S = 1_000_000_000
PERIOD_NS = S // 10
Row = dict[str, Any]


class FaultyEngine:
    """An engine with a fault plan, nodes on a line 100 m apart, and the packets delivered so far."""

    def __init__(self, faults: Sequence[dict[str, Any]] = (), count: int = 5, seed: int = 1, **radio: Any) -> None:
        data = {"run": {"seed": seed, "duration_s": 1000.0}, "radio": radio, "fault": list(faults)}
        scenario = Scenario.model_validate(data)
        position_m = np.column_stack([100.0 * np.arange(count), np.zeros(count)])
        self.ids = [f"v{n}" for n in range(count)]
        self.plan = FaultPlan(scenario, Nodes(self.ids, position_m, np.full(count, count - 1)))
        rules = OwnRules(seed, self.ids)
        rules.load(scenario.fault, scenario.program)
        self.failures: list[RuleFailure] = []
        rules.on_failure = self.failures.append
        self.engine = Engine(self.ids, scenario.radio, seed, position_m, None, rules)
        self.delivered: list[Delivery] = []
        self.now_ns = -1

    def go(self, time_ns: int) -> None:
        """Advance to `time_ns`, with the faults of the plan at their times."""
        while (change_ns := self.plan.next_change_ns(self.now_ns)) is not None and change_ns <= time_ns:
            self.delivered += self.engine.advance(change_ns - 1)
            self.engine.set_faults(self.plan.active(change_ns), change_ns)
            self.now_ns = change_ns
        self.delivered += self.engine.advance(time_ns)
        self.now_ns = time_ns

    def send(self, time_ns: int, node: int, *frames: SentFrame | bytes) -> None:
        """Advance to `time_ns`, and let a node send frames."""
        self.go(time_ns)
        self.engine.transmit(time_ns, node, frames)

    def chat(self, periods: int, first: int = 0, size: int = 20) -> None:
        """Let every node send a different frame in each of `periods`."""
        for period in range(first, first + periods):
            for node in range(len(self.ids)):
                self.send(period * PERIOD_NS, node, bytes([node]) + period.to_bytes(4, "big") + bytes(size - 5))

    def rows(self, since_ns: int = 0) -> list[Row]:
        """End the run, and return the rows of the trace sent since `since_ns`."""
        self.engine.drain()
        return [row for row in self.engine.trace.to_table().to_pylist() if row["sent_ns"] >= since_ns]


def fault(kind: str, at_s: float = 0.0, duration_s: float = 100.0, **more: Any) -> dict[str, Any]:
    """Return a fault as a scenario has it."""
    return {"kind": kind, "at_s": at_s, "duration_s": duration_s, **more}


def link(row: Row) -> tuple[str, str]:
    """Return sender and receiver of a row of the trace."""
    return row["sender"], row["receiver"]


def digest(payload: bytes) -> int:
    """Return the digest of a payload as the trace has it."""
    return int.from_bytes(hashlib.blake2b(payload, digest_size=8).digest(), "little")
