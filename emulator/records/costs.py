"""Costs of a run: CPU time, wake-ups and payload bytes of each vehicle. No hash and no comparison has them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from emulator.scenario.sections import validated

SLOWEST = 10
"""Vehicles in a table of what a run cost."""
MOST_VEHICLES = 100
"""Vehicles that are listed, those that took most CPU time first: verdict.json stays small."""


@dataclass
class Costs:
    """CPU time in ns and wake-ups by node, as the driver measures them while a run goes on.

    Simulated, they are those of each node's program; live, those of its process, under its first node. `processes`
    have run the programs of a simulation; None for a live run.
    """

    measured: Literal["program", "process"] = "process"
    cpu_ns: Mapping[str, int] = field(default_factory=dict)
    wake_ups: Counter[str] = field(default_factory=Counter)
    processes: int | None = None


@dataclass(frozen=True)
class PayloadSizes:
    """Number of frames sent, and mean, 95 % and maximum of their payloads in bytes; None without any frame."""

    frames: int
    mean_bytes: float | None = None
    p95_bytes: float | None = None
    max_bytes: int | None = None

    @classmethod
    def of(cls, size_bytes: NDArray[Any]) -> PayloadSizes:
        """Sum up the payloads of frames (K,)."""
        if not len(size_bytes):
            return cls(0)
        p95 = float(np.percentile(size_bytes, 95))
        return cls(len(size_bytes), round(float(size_bytes.mean()), 1), round(p95, 1), int(size_bytes.max()))

    def words(self) -> list[str]:
        """Return the four figures as tables show them; "" for what there is not."""
        sizes = (self.mean_bytes, self.p95_bytes, self.max_bytes)
        return [f"{self.frames:,}", *("" if size is None else f"{size:,.0f}" for size in sizes)]


@dataclass(frozen=True)
class VehicleCost:
    """Costs of one vehicle. `cpu_s` and `wake_ups` are None where they were not measured."""

    node: str
    cpu_s: float | None
    wake_ups: int | None
    payload: PayloadSizes

    def words(self) -> list[str]:
        """Return a row under `HEADS`; "" for what was not measured."""
        cpu = "" if self.cpu_s is None else f"{self.cpu_s:.3f}"
        return [self.node, cpu, "" if self.wake_ups is None else f"{self.wake_ups:,}", *self.payload.words()]


HEADS = ("vehicle", "CPU time (s)", "wake-ups", "frames", "payload: mean (bytes)", "95 %", "most")
"""Heads of a table of vehicles."""


@dataclass(frozen=True)
class RunCost:
    """Costs of a run; `vehicles` are those that took most CPU time, the slowest first.

    `measured` says of what: of each vehicle's `program`, or of its `process`, which stands at its first node.
    `processes` have run the programs of a simulation; None for a live run.
    """

    measured: Literal["program", "process"]
    cpu_s: float | None
    wake_ups: int | None
    payload: PayloadSizes
    vehicles: list[VehicleCost] = field(default_factory=list)
    processes: int | None = None

    def line(self) -> str:
        """Return the costs in one line; "" if nothing is known."""
        parts = []
        slowest = self.vehicles[0] if self.vehicles else None
        if self.cpu_s is not None and slowest is not None:
            of = {"program": "programs", "process": "processes"}[self.measured]
            of += f" in {self.processes} processes" if (self.processes or 1) > 1 else ""
            parts.append(f"{of} {self.cpu_s:.2f} s of CPU time, most by {slowest.node}: {slowest.cpu_s or 0:.2f} s")
        if self.wake_ups is not None:
            parts.append(f"wake-ups {self.wake_ups:,}")
        if self.payload.frames:
            _, mean, p95, most = self.payload.words()
            parts.append(f"payloads {mean} bytes (95 %: {p95}, most: {most})")
        return "; ".join(parts)


def read_cost(value: object) -> RunCost:
    """Return the costs that verdict.json holds under `cost`."""
    return validated(RunCost, value)


def run_cost(
    costs: Costs, node_ids: Sequence[str], sender: NDArray[Any], size_bytes: NDArray[Any], most: int = MOST_VEHICLES
) -> RunCost:
    """Sum up a run. `sender` (K,) are numbers of nodes and `size_bytes` (K,) the payloads of the frames sent."""
    order = np.argsort(sender, kind="stable")
    ends = np.searchsorted(sender[order], np.arange(len(node_ids) + 1))
    sizes = size_bytes[order]
    knows_cpu, knows_wake_ups = bool(costs.cpu_ns), bool(costs.wake_ups)

    def of(number: int) -> VehicleCost:
        node = node_ids[number]
        cpu_ns = costs.cpu_ns.get(node) if knows_cpu else None
        return VehicleCost(
            node=node,
            cpu_s=None if cpu_ns is None else round(cpu_ns / 1e9, 6),
            wake_ups=costs.wake_ups.get(node) if knows_wake_ups else None,
            payload=PayloadSizes.of(sizes[ends[number] : ends[number + 1]]),
        )

    slowest = sorted(range(len(node_ids)), key=lambda number: -costs.cpu_ns.get(node_ids[number], 0))
    nodes = set(node_ids)
    return RunCost(
        measured=costs.measured,
        cpu_s=round(sum(ns for node, ns in costs.cpu_ns.items() if node in nodes) / 1e9, 6) if knows_cpu else None,
        wake_ups=sum(costs.wake_ups.values()) if knows_wake_ups else None,
        payload=PayloadSizes.of(size_bytes),
        vehicles=[of(number) for number in slowest[:most]],
        processes=costs.processes,
    )
