"""Emulation: one run's engine, world and records, without any transport.

The drivers (live over Zenoh, or simulated in one process) bring what nodes hand over and take what is due;
everything that must be the same in both happens here.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from emulator.engine import Delivery, Engine
from emulator.observe.metrics import Metrics, PeriodFigures
from emulator.observe.observation import period_message
from emulator.observe.run_folder import RunFolder
from emulator.world.world import Instant, World, components
from vnet.link import wire
from vnet.link.node import Report
from vnet.scenario import Scenario


@dataclass(frozen=True)
class PeriodView:
    """What happened up to the end of a period, for progress lines and observers."""

    instant: Instant
    reports: list[Report]
    figures: PeriodFigures
    counts: dict[str, int]
    deliveries: list[Delivery]

    def message(self, node_ids: Sequence[str]) -> dict[str, Any]:
        """The period as observers are told it."""
        return period_message(node_ids, self.instant, self.reports, self.figures, self.counts, self.deliveries)


class Emulation:
    """The state of a run; see the module's text."""

    def __init__(
        self,
        scenario: Scenario,
        world: World,
        folder: RunFolder,
    ) -> None:
        start = world.at(0)
        self.scenario = scenario
        self.world = world
        self.folder = folder
        self.engine = Engine(world.node_ids, scenario.radio, scenario.run.seed, start.position_m, world.links)
        component = components(start.position_m, scenario.radio.range_m, world.links)
        self.metrics = Metrics(world.node_ids, component, world.period_ns)
        self.number = {node: number for number, node in enumerate(world.node_ids)}
        self.up = dict.fromkeys(world.node_ids, True)
        self._watchers: list[Callable[[PeriodView], None]] = []
        self._period = 0
        self._finished = False
        self._reports: list[Report] = []
        self._delivered: list[Delivery] = []

    def watch(self, watcher: Callable[[PeriodView], None]) -> None:
        """Call `watcher` at the end of every period from now on."""
        self._watchers.append(watcher)

    @property
    def duration_ns(self) -> int:
        """Length of the run."""
        return self.scenario.duration_ns

    @property
    def emulated_ns(self) -> int:
        """How far the run has come, in whole periods."""
        return min(self._period * self.world.period_ns, self.duration_ns)

    def welcome(self, node: str, nonce: bytes, incarnation: int = 0) -> wire.Welcome:
        """All that `node` is told; nothing in it says anything about the truth."""
        scenario = self.scenario
        program = scenario.program.of(node)
        return wire.Welcome(
            node,
            nonce,
            incarnation,
            scenario.run.pacing,
            program.entry,
            program.options,
            self.world.lane_map.to_wire(),
            node_seed(scenario.run.seed, node, incarnation),
            self.world.period_ns,
            scenario.radio.max_payload_bytes,
            scenario.run.orphan_timeout_s,
            scenario.run.spin_limit,
            wire.boot_id(),
        )

    def take(self, time_ns: int, traffic: Iterable[wire.Traffic]) -> None:
        """What nodes hand over at `time_ns`: frames to the engine in node order, reports, endings."""
        frames: dict[str, list[bytes]] = {}
        endings: list[wire.Ending] = []
        for part in traffic:
            for frame in part.frames:
                frames.setdefault(frame.node, []).append(frame.payload)
            self._reports.extend(part.reports)
            endings.extend(part.endings)
        for node in sorted(frames, key=self.number.__getitem__):
            if self.up[node]:
                self.engine.transmit(time_ns, self.number[node], frames[node])
        for ending in sorted(endings, key=lambda e: self.number[e.node]):
            self._end(time_ns, ending)

    def _end(self, time_ns: int, ending: wire.Ending) -> None:
        if not self.up[ending.node]:
            return
        details: dict[str, Any] = {}
        if ending.error:
            details = {"error": ending.error, "where": ending.details}
        self.folder.event(time_ns, ending.kind, ending.node, **details)
        self._take_down(ending.node)

    def died(self, time_ns: int, node: str, **details: Any) -> None:
        """A node's process ended without being told to."""
        if self.up[node]:
            self.folder.event(time_ns, "died", node, **details)
            self._take_down(node)

    def _take_down(self, node: str) -> None:
        self.up[node] = False
        self.engine.set_up(self.number[node], False)

    def advance(self, time_ns: int) -> list[Delivery]:
        """Everything that arrives up to `time_ns`, having closed the periods that end by then."""
        self._close_periods(time_ns)
        deliveries = self.engine.advance(time_ns)
        self._delivered.extend(deliveries)
        return deliveries

    def fix_time_ns(self, period: int) -> int | None:
        """When the fix of a period is due; None after the end of the run."""
        time_ns = period * self.world.period_ns
        return time_ns if time_ns < self.duration_ns else None

    def finish(self, time_ns: int) -> None:
        """End of the run at `time_ns`: close the periods and decide what is still in flight. Only once."""
        if not self._finished:
            self._finished = True
            self._close_periods(time_ns)
            self.engine.drain()

    def _close_periods(self, time_ns: int) -> None:
        while (self._period + 1) * self.world.period_ns <= time_ns:
            instant = self.world.at(self._period)
            reports = sorted(self._reports, key=lambda r: (r.time_ns, self.number[r.node]))
            figures = self.metrics.record(instant, reports)
            self._period += 1
            counts = {outcome.name: count for outcome, count in self.engine.counts.items()}
            view = PeriodView(instant, reports, figures, counts, self._delivered)
            for watcher in self._watchers:
                watcher(view)
            self._reports, self._delivered = [], []


def node_seed(seed: int, node: str, incarnation: int) -> int:
    """The seed of a node's own random numbers, from which the scenario's seed cannot be told."""
    digest = hashlib.sha256(f"vnet node seed/{seed}/{node}/{incarnation}".encode()).digest()
    return int.from_bytes(digest[:7], "big")
