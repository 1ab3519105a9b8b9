"""Emulation: one run's engine, world and records, without any transport.

The drivers (live over Zenoh, or simulated in one process) bring what nodes hand over and take what is due;
everything that must be the same in both happens here.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from emulator.channel.reach import distances_m, reach_of
from emulator.engine import Deliveries, Engine
from emulator.faults.plan import FaultPlan, PlannedFault
from emulator.faults.selectors import Nodes
from emulator.faults.sensors import BentGnss, clock_of
from emulator.observe.metrics import Metrics, PeriodFigures
from emulator.observe.observation import period_message
from emulator.observe.run_folder import RunFolder, write_text
from emulator.world.world import Instant, World, components
from vnet.faults import Fault, Infrastructure
from vnet.link import wire
from vnet.link.node import Report
from vnet.scenario import NS_PER_S, Scenario, dump_scenario


@dataclass(frozen=True)
class PeriodView:
    """What happened up to the end of a period, for progress lines and observers."""

    instant: Instant
    reports: list[Report]
    figures: PeriodFigures
    counts: dict[str, int]
    deliveries: list[Deliveries]

    def message(self, node_ids: Sequence[str]) -> dict[str, Any]:
        """The period as observers are told it."""
        return period_message(node_ids, self.instant, self.reports, self.figures, self.counts, self.deliveries)


@dataclass(frozen=True)
class ProcessActions:
    """What processes suffer from an instant on.

    `stop`: nodes whose programs end now, and whether they are killed; `start`: those that start anew; `paused`: all
    that stand still; `clocks`: how all clocks go; `restarts`: of the emulator or its router.
    """

    stop: dict[str, bool]
    start: list[str]
    paused: set[str]
    clocks: list[wire.ClockBend]
    restarts: list[Infrastructure]


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
        radio = scenario.radio
        reach = reach_of(radio, scenario.run.seed, world.links)
        in_range = reach.in_range(start.position_m, distances_m(start.position_m))
        self.faults = FaultPlan(scenario, Nodes(world.node_ids, start.position_m, in_range.sum(axis=0)))
        self.gnss = BentGnss(world, self.faults.faults, scenario.run.seed)
        self.incarnation = dict.fromkeys(world.node_ids, 0)
        self._down_by_fault: set[str] = set()
        self._starting: set[str] = set()
        self._ended: set[str] = set()
        self._acting: set[str] = set()
        self._acted_ns = -1
        self._next_fault_ns = self.faults.next_change_ns(self._acted_ns)
        self.engine = Engine(world.node_ids, scenario.radio, scenario.run.seed, start.position_m, world.links)
        component = components(start.position_m, radio.range_m, in_range)
        self.metrics = Metrics(world.node_ids, component, world.period_ns)
        self.number = {node: number for number, node in enumerate(world.node_ids)}
        self.up = dict.fromkeys(world.node_ids, True)
        self._watchers: list[Callable[[PeriodView], None]] = []
        self._period = 0
        self._finished = False
        self._reports: list[Report] = []
        self._delivered: list[Deliveries] = []

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

    def welcome(self, node: str, nonce: bytes) -> wire.Welcome:
        """All that `node` is told; nothing in it says anything about the truth."""
        scenario = self.scenario
        incarnation = self.incarnation[node]
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
            node not in self._ended,
        )

    def take(self, time_ns: int, traffic: Iterable[wire.Traffic]) -> None:
        """What nodes hand over at `time_ns`: frames to the engine in node order, reports, endings."""
        frames: dict[str, list[bytes]] = {}
        endings: list[wire.Ending] = []
        for part in traffic:
            for frame in part.frames:
                frames.setdefault(frame.node, []).append(frame.payload)
            self._reports.extend(report for report in part.reports if self.up[report.node])
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
        self._ended.add(ending.node)
        self._take_down(ending.node)

    def died(self, time_ns: int, node: str, **details: Any) -> None:
        """A node's process ended without being told to."""
        if self.up[node]:
            self.folder.event(time_ns, "died", node, **details)
            self._ended.add(node)
            self._take_down(node)

    def _take_down(self, node: str) -> None:
        self.up[node] = False
        self.engine.set_up(self.number[node], False)

    # Faults.

    def next_fault_ns(self) -> int | None:
        """When next a fault starts or ends."""
        return self._next_fault_ns

    def act(self, time_ns: int, starts_at_once: bool = True) -> ProcessActions:
        """Let the faults of `time_ns` act on links and senders; returns what processes are to suffer.

        The caller has taken all that arrived before `time_ns`. Without `starts_at_once` nodes that start anew are
        up only when it says that they `come_back`.
        """
        self._acted_ns = time_ns
        self._next_fault_ns = self.faults.next_change_ns(time_ns)
        active = self.faults.active(time_ns)
        self.engine.set_faults(active, time_ns)
        self._log_changes(time_ns, active)
        down = self._nodes_under(active, "kill", "restart")
        paused = self._nodes_under(active, "pause")
        killed = self._nodes_under(active, "kill")
        living = [node for node in self.world.node_ids if self.up[node] or node in self._starting]
        stop = {node: node in killed for node in living if node in down}
        start = [n for n in self.world.node_ids if n in self._down_by_fault and n not in down]
        for node in stop:
            self._take_down(node)
        for node in start:
            self.incarnation[node] += 1
        self._starting = (self._starting - stop.keys()) | set(start)
        if starts_at_once:
            self.come_back(start, time_ns)
        self._down_by_fault = (self._down_by_fault | stop.keys()) - set(start)
        clocks = [clock_of(active, node, number, time_ns) for node, number in self.number.items()]
        restarts = [p.fault for p in active if isinstance(p.fault, Infrastructure) and p.start_ns == time_ns]
        return ProcessActions(stop, start, paused, clocks, restarts)

    def come_back(self, nodes: Sequence[str], time_ns: int) -> None:
        """Nodes that were down are up again, but for those whose programs have ended by themselves."""
        self._starting.difference_update(nodes)
        for node in [node for node in nodes if node not in self._ended]:
            self.up[node] = True
            self.engine.set_up(self.number[node], True)
            self.folder.event(time_ns, "restarted", node, incarnation=self.incarnation[node])

    def _nodes_under(self, active: Sequence[PlannedFault], *kinds: str) -> set[str]:
        chosen = [planned.nodes for planned in active if planned.fault.kind in kinds]
        return {node for node, number in self.number.items() if any(mask[number] for mask in chosen)}

    def _log_changes(self, time_ns: int, active: Sequence[PlannedFault]) -> None:
        acting = {planned.label for planned in active}
        for planned in active:
            if planned.label not in self._acting:
                nodes = [node for node, number in self.number.items() if planned.nodes[number]]
                self.folder.event(time_ns, "fault_started", None, fault=planned.label, nodes=nodes)
        for label in sorted(self._acting - acting):
            self.folder.event(time_ns, "fault_ended", None, fault=label)
        self._acting = acting

    def inject(self, fault: Fault, now_ns: int) -> PlannedFault:
        """Plan one more fault while the run is on, and write it into the run's scenario so that it replays.

        It acts after `now_ns` at the earliest. Raises ScenarioError if it does not fit.
        """
        at_s = max(fault.at_s, (now_ns + 1) / NS_PER_S)
        planned = self.faults.add(fault.model_copy(update={"at_s": at_s}))
        self._change_plan()
        return planned

    def heal(self, label: str, now_ns: int) -> PlannedFault:
        """End a fault right after `now_ns`, and write that down. Raises ScenarioError if none is called so."""
        planned = self.faults.heal(label, now_ns + 1)
        self._change_plan()
        return planned

    def end_at(self, time_ns: int) -> None:
        """Let the run end at `time_ns`, by when all faults have healed, and write that down so that it replays."""
        healed_ns = self.faults.last_end_ns
        assert healed_ns <= time_ns <= self.duration_ns, (healed_ns, time_ns, self.duration_ns)
        run = self.scenario.run
        settle_s = min(run.settle_s, (time_ns - healed_ns) / NS_PER_S)
        shorter = run.model_copy(update={"duration_s": time_ns / NS_PER_S, "settle_s": settle_s})
        self._rewrite(self.scenario.model_copy(update={"run": shorter}))

    def _change_plan(self) -> None:
        self._next_fault_ns = self.faults.next_change_ns(self._acted_ns)
        self._rewrite(self.scenario.model_copy(update={"fault": self.faults.as_written()}))

    def _rewrite(self, scenario: Scenario) -> None:
        self.scenario = scenario
        text = dump_scenario(scenario)
        self.folder.put("scenario.toml", lambda path: write_text(path, text))

    def advance(self, time_ns: int) -> Deliveries:
        """Everything that arrives up to `time_ns`, having closed the periods that end by then."""
        self.close_periods(time_ns)
        deliveries = self.engine.advance(time_ns)
        self._delivered.append(deliveries)
        return deliveries

    def look_ahead(self, time_ns: int, nodes: Iterable[str]) -> None:
        """Let the radio come as far as anybody can act: `time_ns`, or an arrival at one of these nodes before."""
        self.engine.look_ahead(time_ns, [self.number[node] for node in nodes])

    def fix_time_ns(self, period: int) -> int | None:
        """When the fix of a period is due; None after the end of the run."""
        time_ns = period * self.world.period_ns
        return time_ns if time_ns < self.duration_ns else None

    def finish(self, time_ns: int) -> None:
        """End of the run at `time_ns`: close the periods and decide what is still in flight. Only once."""
        if not self._finished:
            self._finished = True
            self.close_periods(time_ns)
            self.engine.drain()

    def close_periods(self, time_ns: int) -> None:
        """Record the periods that end by then; nobody has anything more to report of them."""
        while (self._period + 1) * self.world.period_ns <= time_ns:
            instant = self.gnss.at(self._period)
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
