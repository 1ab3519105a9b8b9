"""Emulation: one run's engine, world and records, without any transport.

The loops of both pacings bring what nodes enqueue and take what is due; everything that must be the same in both,
live and simulated, happens here. `Presence` is the state of each node, `Driving` passes actions to vehicles,
`BusyFeed` tells programs how busy the channel was, and `LogBook` writes down what programs say.

`Orders` is in which order simultaneous events come: what nodes are told of it, the medium's part, the tape. With
`run.order = "fifo"` and no tape there is nothing to do: nodes decide nothing, and frames of one instant come to the
medium in the order of the nodes.
"""

from __future__ import annotations

import hashlib
import math
import random
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from emulator.drivers.backbone import BackboneNetwork, NewsFeed
from emulator.fault_plan import FaultPlan, Nodes, PlannedFault
from emulator.radio.dot11p import abilities_of
from emulator.radio.engine import Deliveries, Delivery, Engine
from emulator.radio.medium import SLICE_NS
from emulator.radio.own_rules import OwnRules, RuleFailure
from emulator.radio.topology import connectivity_of
from emulator.records.costs import Costs
from emulator.records.events import KINDS, EventKind
from emulator.records.metrics import Metrics
from emulator.records.run_folder import RunFolder
from emulator.records.samples import SampleRecorder
from emulator.records.tables import PayloadRecorder, background_table, driven_table
from emulator.records.tape import MediumOrder, TapeEntry, first_left, parse_tape, read_tape
from emulator.scenario.faults import Fault, Infrastructure, OwnRule, ProcessFault
from emulator.scenario.program import Program
from emulator.scenario.scenario import Scenario, least_transit_ns
from emulator.world.driven.stepped import SteppedWorld
from emulator.world.driven.vehicles import Happening
from emulator.world.neighbours import Links
from emulator.world.own_sensors import SensorFailure
from emulator.world.truth import FaultyGnss, clock_of
from emulator.world.world import Instant, World, components
from vnet.errors import ScenarioError
from vnet.node import Action
from vnet.radio import SentFrame
from vnet.reports import Report
from vnet.transport import wire
from vnet.transport.wire import BusyRatios, Deviation, Order
from vnet.types import Array, IntArray
from vnet.units import NS_PER_S


class Orders:
    """The orders of a run; see the module's text. `made` has its deviations from FIFO so far, its tape."""

    def __init__(self, scenario: Scenario) -> None:
        run = scenario.run
        self._run = run
        self.tape: Sequence[TapeEntry] = _tape_of(run.tape)
        self.explores = run.order != "fifo" or run.tape is not None or run.order_slack_us > 0
        """True if another order than FIFO is possible, or compared with what is possible."""
        self._at_medium = {entry.time_ns: entry.medium for entry in self.tape if isinstance(entry, MediumOrder)}
        self.made: list[TapeEntry] = []
        self.steps: Mapping[str, int] = {}
        """Decisions of each node, once the run has been simulated."""

    def of_node(self, node: str, incarnation: int) -> Order | None:
        """Return what the welcome of a node says of orders."""
        run = self._run
        if not self.explores:
            return None
        slack_ns, phase_ns = run.order_grid
        if run.order == "fifo":
            tape = [each for each in self.tape if isinstance(each, Deviation)]
            tape = [each for each in tape if (each.node, each.incarnation) == (node, incarnation)]
            return Order("tape", tape=tape, slack_ns=slack_ns, phase_ns=phase_ns)
        seed = self._seed(f"{node}/{incarnation}")
        return Order(run.order, seed, run.order_depth, run.order_steps or 0, (), slack_ns, phase_ns)

    def _seed(self, of: str) -> int:
        """Return a seed that says nothing about the scenario's."""
        digest = hashlib.sha256(f"vnet order/{self._run.seed}/{self._run.order_seed}/{of}".encode()).digest()
        return int.from_bytes(digest[:7], "big")

    def to_medium(self, time_ns: int, nodes: Sequence[str]) -> Sequence[str]:
        """Return the order in which the frames of `nodes`, given in FIFO's order, come to the medium."""
        if not self.explores or len(nodes) < 2:
            return nodes
        ordered = self._ordered(time_ns, nodes)
        if ordered != list(nodes):
            self.made.append(MediumOrder(time_ns, tuple(ordered)))
        return ordered

    def _ordered(self, time_ns: int, nodes: Sequence[str]) -> list[str]:
        if self._run.order == "shuffle":
            ordered = list(nodes)
            random.Random(self._seed(f"medium/{time_ns}")).shuffle(ordered)
            return ordered
        if self._run.order == "pct":
            return sorted(nodes, key=lambda node: self._seed(f"medium/{node}"))
        place = {node: number for number, node in enumerate(self._at_medium.get(time_ns, ()))}
        return sorted(nodes, key=lambda node: place.get(node, len(place)))

    def take(self, deviations: Iterable[Deviation]) -> None:
        """Note what nodes have decided otherwise than FIFO."""
        if self.explores:
            self.made.extend(deviations)

    def in_order(self) -> list[TapeEntry]:
        """Return the tape of the run, in the order of time, which does not depend on processes."""
        return sorted(self.made, key=_sort_key)

    def left(self) -> TapeEntry | None:
        """Return the first entry of the given tape that the run could not follow."""
        return first_left(self.tape, self.made)


def _tape_of(tape: Path | Sequence[str] | None) -> Sequence[TapeEntry]:
    if tape is None:
        return ()
    return read_tape(tape) if isinstance(tape, Path) else parse_tape(tape, "run.tape")


def _sort_key(entry: TapeEntry) -> tuple[int, str, int]:
    if isinstance(entry, MediumOrder):
        return entry.time_ns, "", 0
    return entry.time_ns, entry.node, entry.decision


class NodeState(StrEnum):
    """State of a node, from before its vehicle enters to the end of its program."""

    NEW = "new"
    """Its vehicle has not entered the network yet, and its program has never been started."""
    OUTSIDE = "outside"
    """Its vehicle has left the network, or was stopped before it had entered."""
    ENTERING = "entering"
    """Its vehicle enters; its program has been started and is not up yet."""
    UP = "up"
    """Its program runs."""
    DOWN = "down"
    """A fault has stopped its program."""
    RESTARTING = "restarting"
    """The fault is over; its program has been started again and is not up yet."""
    ENDED = "ended"
    """Its program has returned, crashed or died: it is not started again."""
    ENDED_OUTSIDE = "ended outside"
    """As ENDED, and its vehicle has left the network since."""


_S = NodeState
_STOPPED = {_S.UP: _S.DOWN, _S.RESTARTING: _S.DOWN, _S.ENTERING: _S.OUTSIDE}
"""State of a node after it is stopped, by its state before; nodes in other states cannot be stopped."""
_LEFT = {_S.DOWN: _S.OUTSIDE, _S.ENDED: _S.ENDED_OUTSIDE}
"""State of a node after its vehicle has left, by its state before. Its program is stopped first."""
_STARTED = {_S.NEW: _S.ENTERING, _S.OUTSIDE: _S.ENTERING, _S.DOWN: _S.RESTARTING}
"""State of a node after it is started, by its state before."""
_STARTING = (_S.ENTERING, _S.RESTARTING)
_OUTSIDE = {_S.NEW, _S.OUTSIDE, _S.ENTERING, _S.ENDED_OUTSIDE}


@dataclass(frozen=True)
class Changes:
    """Nodes that are stopped, have left and are to be started, in the order of their numbers."""

    stopped: list[str]
    left: list[str]
    started: list[str]


class Presence:
    """The states of the nodes of a run. `up` and `incarnation` (starts before this one) are kept by node."""

    def __init__(self, node_ids: Sequence[str], absent: Collection[str] = ()) -> None:
        self._states = {node: _S.NEW if node in absent else _S.UP for node in node_ids}
        self.up = {node: node not in absent for node in node_ids}
        self.incarnation = dict.fromkeys(node_ids, 0)

    def state(self, node: str) -> NodeState:
        """State of a node."""
        return self._states[node]

    def is_outside(self, node: str) -> bool:
        """Return whether a vehicle is not in the network: it has not entered yet, or has left."""
        return self._states[node] in _OUTSIDE

    def _put(self, node: str, state: NodeState) -> None:
        self._states[node] = state
        self.up[node] = state is _S.UP

    def change(self, under_fault: Collection[str], absent: Collection[str]) -> Changes:
        """From now on faults stop the programs of these nodes, and these vehicles are not in the network."""
        down = {*under_fault, *absent}
        stopped = [node for node, state in self._states.items() if node in down and state in _STOPPED]
        for node in stopped:
            self._put(node, _STOPPED[self._states[node]])
        left = [node for node, state in self._states.items() if node in absent and state in _LEFT]
        for node in left:
            self._put(node, _LEFT[self._states[node]])
        started = [node for node, state in self._states.items() if node not in down and state in _STARTED]
        for node in started:
            self.incarnation[node] += self._states[node] is not _S.NEW
            self._put(node, _STARTED[self._states[node]])
        return Changes(stopped, left, started)

    def come_up(self, nodes: Iterable[str]) -> dict[str, bool]:
        """Those of the nodes that were started are up; returns them, and whether their vehicles enter with that."""
        entered = {node: self._states[node] is _S.ENTERING for node in nodes if self._states[node] in _STARTING}
        for node in entered:
            self._put(node, _S.UP)
        return entered

    def end(self, node: str) -> bool:
        """A program has ended by itself; returns False if it had before, or was stopped."""
        if self._states[node] not in (_S.UP, *_STARTING):
            return False
        self._put(node, _S.ENDED)
        return True

    def starting(self) -> list[str]:
        """Return the nodes whose programs were started and are not up."""
        return [node for node, state in self._states.items() if state in _STARTING]

    def has_ended(self, node: str) -> bool:
        """Return whether a program has ended by itself: it is not started again."""
        return self._states[node] in (_S.ENDED, _S.ENDED_OUTSIDE)


class Driving:
    """Vehicles of a run and their programs' actions; nothing in a world whose truth is known from the start."""

    def __init__(self, world: World, folder: RunFolder, number: Mapping[str, int]) -> None:
        self._world = world if isinstance(world, SteppedWorld) else None
        self._node_ids = () if self._world is None else self._world.driven
        self._drive = frozenset(self._node_ids)
        self._folder = folder
        self._number = number

    @property
    def next_ns(self) -> int | None:
        """The next control instant within the run; None if there is none."""
        return None if self._world is None else self._world.next_control_ns()

    def control_ns(self, node: str) -> int:
        """Return the time between two control instants; 0 for a node that its program does not drive."""
        return 0 if self._world is None or node not in self._drive else self._world.vehicles.step_ns

    @property
    def versions(self) -> Mapping[str, str]:
        """Versions of programs that move vehicles, by name."""
        return {} if self._world is None else self._world.versions

    def table(self) -> pa.Table | None:
        """Return what vehicles did at each control instant; None where programs do not drive."""
        return None if self._world is None else driven_table(self._world.vehicles.finished_log(), self._node_ids)

    def background(self) -> pa.Table | None:
        """Return where vehicles without programs were; None where there are none."""
        return None if self._world is None else background_table(self._world.background)

    def background_m(self, period: int) -> Array:
        """Return the positions (k, 2) of vehicles without programs at the start of a period."""
        background = None if self._world is None else self._world.background
        return np.zeros((0, 2)) if background is None else background.position_m[period]

    def take(self, time_ns: int, actions: Iterable[Action]) -> None:
        """Take what programs of vehicles that are up ask for at `time_ns`."""
        if self._world is not None:
            for action in actions:
                if action.node not in self._drive:  # a roadside unit
                    continue
                self._tell(self._world.vehicles.take(time_ns, self._number[action.node], action))

    def release(self, time_ns: int, node: str) -> None:
        """Leave the speed of a vehicle whose program has ended to the vehicle."""
        self.take(time_ns, [Action(node, release=True)])

    def advance_to(self, time_ns: int) -> bool:
        """Let vehicles drive to the last control instant until `time_ns`; returns whether they have moved."""
        moved = False
        while self._world is not None and (next_ns := self.next_ns) is not None and next_ns <= time_ns:
            self._tell(self._world.advance())
            moved = True
        return moved

    def end_at(self, time_ns: int) -> None:
        """Let nobody drive from this time on, with which the run ends."""
        if self._world is not None:
            self._world.ends_ns = time_ns

    def close(self) -> None:
        """Let go of what moves the vehicles; the run is over."""
        if self._world is not None:
            self._world.close()

    def detach(self) -> None:
        """Let go of it in a process forked from the emulator's, which goes on with it."""
        if self._world is not None:
            self._world.detach()

    def _tell(self, happened: Iterable[Happening]) -> None:
        for each in happened:
            self._folder.event(each.time_ns, KINDS[each.kind], self._node_ids[each.number], **each.details)


MOST_KNOWN = 64
"""Measurements that are kept: those of a window serve all processes that are granted it."""


class BusyFeed:
    """Measurements of the nodes `node_ids` of an engine, in its order, which are known `delay_ns` later."""

    def __init__(self, engine: Engine, node_ids: Sequence[str], delay_ns: int) -> None:
        self._engine = engine
        self._number = {node: number for number, node in enumerate(node_ids)}
        self._delay_ns = delay_ns
        self._numbers: dict[tuple[str, ...], IntArray] = {}
        self._known: dict[int, Array] = {}

    def of(self, nodes: tuple[str, ...], time_ns: int, end_ns: int) -> Sequence[BusyRatios]:
        """Return what `nodes` know from `time_ns` to just before `end_ns`; nothing if they share no medium.

        All events of the medium more than the delay before `end_ns` have been processed.
        """
        if not self._engine.shares_medium:
            return ()
        if nodes not in self._numbers:
            self._numbers[nodes] = np.array([self._number[node] for node in nodes])
        first_ns = max(0, (time_ns - self._delay_ns) // SLICE_NS * SLICE_NS)
        later_ns = range(first_ns + SLICE_NS, end_ns - self._delay_ns, SLICE_NS)
        return [self._measured(nodes, measured_ns) for measured_ns in (first_ns, *later_ns)]

    def _measured(self, nodes: tuple[str, ...], measured_ns: int) -> BusyRatios:
        if measured_ns not in self._known:
            if len(self._known) >= MOST_KNOWN:
                self._known.clear()
            self._known[measured_ns] = self._engine.busy_ratios_at(measured_ns)
        ratios = self._known[measured_ns][self._numbers[nodes]]
        return BusyRatios(measured_ns + self._delay_ns if measured_ns else 0, ratios.tolist())


MOST_EXCEPTIONS = 20
"""Unhandled exceptions of a node that are written down, with their tracebacks; further ones are counted."""
MOST_NOTES = 1000
"""Log lines of a node that are written down; further ones are counted."""
MOST_EVENTS = 10_000
"""Events of a node that are written down; further ones are counted."""
MOST = {"exception": MOST_EXCEPTIONS, "log": MOST_NOTES, "event": MOST_EVENTS}
LONGEST_TEXT = 4000
"""Characters of a text that are written down."""
MOST_DETAILS = 50
"""Details of an event that are written down."""


class LogBook:
    """Writes what programs tell into the run's folder. `number` has the nodes in their order."""

    def __init__(self, folder: RunFolder, number: Mapping[str, int]) -> None:
        self._folder = folder
        self._number = number
        self._counts: Counter[tuple[str, str]] = Counter()

    def tell(self, time_ns: int, notes: Iterable[wire.Note], unhandled: Iterable[wire.Unhandled]) -> None:
        """Write down what came at `time_ns`, each at its own instant."""
        for note in sorted(notes, key=lambda note: (note.time_ns, self._number[note.node])):
            if self._fits(note.node, note.kind):
                self._write(min(time_ns, note.time_ns), note)
        raised = [(time_ns if each.time_ns is None else min(time_ns, each.time_ns), each) for each in unhandled]
        for raised_ns, each in sorted(raised, key=lambda pair: (pair[0], self._number[pair[1].node])):
            if self._fits(each.node, EventKind.exception):
                details = {"error": each.error[:LONGEST_TEXT], "place": each.place, "where": each.details}
                self._folder.event(raised_ns, EventKind.exception, each.node, **details)

    def _fits(self, node: str, kind: str) -> bool:
        self._counts[node, kind] += 1
        return self._counts[node, kind] <= MOST[kind]

    def _write(self, time_ns: int, note: wire.Note) -> None:
        text = note.text[:LONGEST_TEXT]
        if note.kind == "log":
            self._folder.event(time_ns, EventKind.log, note.node, level=note.level, text=text)
            return
        details = {key: _plain(value) for key, value in list(note.details.items())[:MOST_DETAILS]}
        self._folder.event(time_ns, EventKind.event, note.node, name=text, details=details)

    def tell_left_out(self, time_ns: int) -> None:
        """Write down how much of each kind is missing of each node, because there was too much."""
        for (node, kind), count in sorted(self._counts.items(), key=lambda item: self._number[item[0][0]]):
            if count > MOST[kind]:
                self._folder.event(time_ns, EventKind.left_out, node, what=kind, count=count - MOST[kind])


def _plain(value: bool | int | float | str) -> bool | int | float | str:
    """A value that JSON has: bounded texts, finite numbers."""
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value[:LONGEST_TEXT] if isinstance(value, str) else value


@dataclass(frozen=True)
class PeriodView:
    """State of a run at the end of a period, for progress lines and observers."""

    instant: Instant
    reports: list[Report]
    metrics: Metrics
    counts: dict[str, int]

    @property
    def figures(self) -> Any:
        """Its figures."""
        return self.metrics.rows[self.instant.period]


@dataclass(frozen=True)
class ProcessActions:
    """Effects of faults and trips on processes from the instant `time_ns` on.

    `stop`: nodes whose programs end now, and whether they are killed; `start`: nodes that are started, for the
    first time or again; `paused`: all nodes that are paused; `clocks`: the errors of all clocks; `restarts`: of the
    emulator or its router.
    """

    time_ns: int
    stop: dict[str, bool]
    start: list[str]
    paused: set[str]
    clocks: list[wire.ClockError]
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
        self.duration_ns = scenario.duration_ns
        """Length of the run."""
        self.world = world
        self.folder = folder
        self._connectivity = connectivity_of(scenario.radio, scenario.run.seed, world.radio_inputs)
        self._rules = OwnRules(scenario.run.seed, world.node_ids)
        self._rules.load(scenario.fault, scenario.program)
        self._rules.on_failure = self._rule_failed
        world.own_sensors.on_failure = self._sensor_failed
        self.engine = Engine(
            world.node_ids,
            scenario.radio,
            scenario.run.seed,
            start.position_m,
            world.radio_inputs,
            self._rules,
            scenario.run.order_grid,
        )
        self.payloads = PayloadRecorder(world.node_ids) if scenario.run.keep_payloads else None
        self.samples = SampleRecorder(world.node_ids) if scenario.program.kind == "zenoh" else None
        self.engine.on_payload = [each.add for each in (self.payloads, self.samples) if each is not None]
        self._placed = 0  # the period in which vehicles are where the engine has them
        nodes_at = self._nodes_at if self._topology_changes else None
        self.faults = FaultPlan(scenario, self._nodes_at(0), nodes_at)
        self.gnss = FaultyGnss(world, self.faults.faults, scenario.run.seed)
        self.presence = Presence(world.node_ids, self._absent(0))
        self.up, self.incarnation = self.presence.up, self.presence.incarnation
        self._acting: set[str] = set()
        self._started_ns: dict[str, int] = {}
        """Instants at which programs were started again, or for the first time as their vehicles entered."""
        self._acted_ns = -1
        self._next_change_ns = self._find_next_change_ns()
        self.metrics = Metrics(world.node_ids, self._component(0), world.period_ns, scenario.program)
        self.metrics.on_failure = self._figures_failed
        self.number = {node: number for number, node in enumerate(world.node_ids)}
        self.driving = Driving(world, folder, self.number)
        for node, up in self.up.items():
            self.engine.set_up(self.number[node], up)
        self._lane_map, self._boot_id = world.lane_map.to_wire(), wire.boot_id()
        self._watchers: list[Callable[[PeriodView], None]] = []
        self._period = 0
        self.ended_ns: int | None = None
        """Emulated time at which the run was over; None until then."""
        self._reports: list[Report] = []
        self._arrived: list[Deliveries] = []
        self.costs = Costs()
        self.log_book = LogBook(folder, self.number)
        self.orders = Orders(scenario)
        self.backbone = BackboneNetwork(scenario, self.up)
        self.news = NewsFeed(self.engine, self.backbone, self.up)
        self.busy = BusyFeed(self.engine, world.node_ids, least_transit_ns(scenario.radio))

    def _nodes_at(self, period: int) -> Nodes:
        """Nodes as the selectors of faults see them in a period."""
        world = self.world
        degree = self._links(period).in_degrees()
        position_m = world.position_m(period if world.moves else 0)
        return Nodes(world.node_ids, position_m, np.where(world.present(period), degree, -1))

    def _links(self, period: int) -> Links:
        if period == self._placed and not len(self._connectivity.changes_ns):
            return self.engine.links
        self._connectivity = self._connectivity.at(period * self.world.period_ns)  # the next is often a later one
        return self._connectivity.links(self.world.position_m(period))

    @property
    def _topology_changes(self) -> bool:
        """True if vehicles move, or links are given over time."""
        return self.world.moves or len(self._connectivity.changes_ns) > 0

    def _component(self, period: int) -> NDArray[np.intp]:
        """Connected component of each vehicle."""
        return components(self.world.position_m(period), self._links(period))

    def _absent(self, period: int) -> set[str]:
        """Vehicles that are not in the network."""
        there = self.world.present(period).tolist()
        return {node for node, present in zip(self.world.node_ids, there, strict=True) if not present}

    def watch(self, watcher: Callable[[PeriodView], None]) -> None:
        """Call `watcher` at the end of every period from now on."""
        self._watchers.append(watcher)

    @property
    def emulated_ns(self) -> int:
        """Emulated time of all periods that are complete, in ns."""
        return min(self._period * self.world.period_ns, self.duration_ns)

    def welcome(self, node: str, nonce: bytes) -> wire.Welcome:
        """Welcome of `node`: all that it learns from the emulator; nothing in it says anything about the truth."""
        scenario = self.scenario
        incarnation = self.incarnation[node]
        program = scenario.program.of(node)
        unit = next((each for each in scenario.roadside if each.id == node), None)
        abilities = abilities_of(scenario.radio, unit)
        return wire.Welcome(
            node,
            nonce,
            incarnation,
            scenario.run.pacing,
            program.entry,
            scenario.options_of(node),
            self._lane_map,
            node_seed(scenario.run.seed, node, incarnation),
            self.world.period_ns,
            scenario.radio.max_payload_bytes,
            scenario.run.orphan_timeout_s,
            scenario.run.spin_limit,
            self._boot_id,
            not self.presence.has_ended(node),
            wire.VERSION,
            self.orders.of_node(node, incarnation),
            self.driving.control_ns(node),
            abilities.max_power_dbm,
            abilities.rates_mbps,
            abilities.acknowledges,
            self.backbone.abilities(node),
            abilities.periods_ms,
        )

    def take(self, time_ns: int, traffic: Iterable[wire.Traffic]) -> None:
        """Take what nodes enqueue at `time_ns`: frames to the engine in node order, reports, endings.

        What comes after the end of the run, as processes still speak when it is interrupted, is no part of it.
        """
        if self.ended_ns is not None:
            return
        self.drive_to(time_ns)
        frames: dict[str, list[SentFrame]] = {}
        endings: list[wire.Ending] = []
        unhandled: list[wire.Unhandled] = []
        notes: list[wire.Note] = []
        actions: list[Action] = []
        for part in traffic:
            for frame in part.frames:
                frames.setdefault(frame.node, []).append(frame)
            self._reports.extend(report for report in part.reports if self.up[report.node])
            endings.extend(part.endings)
            unhandled.extend(part.unhandled)
            notes.extend(part.notes)
            self.orders.take(part.deviations)
            if part.messages:
                self.backbone.send(time_ns, part.messages)
            actions.extend(action for action in part.actions if self.up[action.node])
        if actions:
            self.driving.take(time_ns, sorted(actions, key=lambda each: self.number[each.node]))
        if frames:
            self._place(time_ns // self.world.period_ns)
        senders = [node for node in sorted(frames, key=self.number.__getitem__) if self.up[node]]
        in_order = self.orders.to_medium(time_ns, senders)
        self.engine.transmit_all(time_ns, [(self.number[node], frames[node]) for node in in_order])
        if notes or unhandled:
            self.log_book.tell(time_ns, notes, unhandled)
        for ending in sorted(endings, key=lambda e: self.number[e.node]):
            self.take_end(time_ns, ending)

    def take_final(self, time_ns: int, traffic: Iterable[wire.Traffic], by_fault: bool = False) -> None:
        """Take what programs told as they were ended at `time_ns`; of frames, reports and endings nobody hears.

        Notes are those of the run's end: of what a fault ends, or a vehicle's leaving, nobody hears them either.
        """
        parts = list(traffic)
        notes = [note for part in parts for note in part.notes if not by_fault]
        self.log_book.tell(time_ns, notes, [each for part in parts for each in part.unhandled])

    def _place(self, period: int) -> None:
        """Frames are sent from where vehicles are at the start of the period."""
        if self.world.moves and period != self._placed:
            self.engine.set_positions(self.world.position_m(period))
            self._placed = period

    def take_end(self, time_ns: int, ending: wire.Ending) -> None:
        """Take the end of a program, of which the run hears at `time_ns`."""
        details: dict[str, Any] = {}
        if ending.error:
            details = {"how" if ending.kind == EventKind.died else "error": ending.error, "where": ending.details}
            details |= {"place": ending.place} if ending.place else {}
        self._program_over(time_ns, ending.node, KINDS[ending.kind], details)

    def died(self, time_ns: int, node: str, **details: Any) -> None:
        """Take a node down whose process has ended without being told to."""
        self._program_over(time_ns, node, EventKind.died, details)

    def give_up_starts(self, time_ns: int, held_ns: Callable[[int, int], int]) -> list[str]:
        """Take nodes for dead that are not up within `run.join_timeout_s` of their start; return those.

        `held_ns` tells how long restarts of the emulator have held back what happens in a span.
        """
        patience_s, given_up = self.scenario.run.join_timeout_s, []
        for node in self.presence.starting():
            started_ns = self._started_ns[node]
            until_ns = started_ns + round(patience_s * NS_PER_S) + held_ns(started_ns, time_ns)
            if until_ns <= time_ns and self.presence.end(node):
                how = f"not up within run.join_timeout_s = {patience_s:g}"
                self.folder.event(until_ns, EventKind.died, node, how=how)
                given_up.append(node)
        return given_up

    def _program_over(self, time_ns: int, node: str, kind: EventKind, details: dict[str, Any]) -> None:
        if self.presence.end(node):
            self.folder.event(time_ns, kind, node, **details)
            if self.ended_ns is None:
                self.engine.set_up(self.number[node], False)
                self.driving.release(time_ns, node)

    # Vehicles that programs drive.

    def next_control_ns(self) -> int | None:
        """Return the next control instant; None where programs do not drive, and after the last."""
        return self.driving.next_ns

    def drive_to(self, time_ns: int) -> None:
        """Have vehicles drive to the last control instant until `time_ns`; what they do before has been taken."""
        if self.driving.advance_to(time_ns):
            self._next_change_ns = self._find_next_change_ns()

    # Faults, and vehicles that enter and leave.

    def next_change_ns(self) -> int | None:
        """Return when next a fault starts or ends, or a vehicle enters or leaves."""
        return self._next_change_ns

    def _find_next_change_ns(self) -> int | None:
        changes = (self.faults.next_change_ns(self._acted_ns), self.world.next_change_ns(self._acted_ns))
        return min((time_ns for time_ns in changes if time_ns is not None), default=None)

    def act(self, time_ns: int, starts_at_once: bool = True) -> ProcessActions:
        """Let the faults of `time_ns` act on links and senders, and vehicles enter and leave.

        Returns what is to be done to processes. The caller has taken all that arrived before `time_ns`. Without
        `starts_at_once` nodes that start are up only when it says that they `come_back`.
        """
        self.drive_to(time_ns)
        self.close_periods(time_ns)
        self._acted_ns = time_ns
        self._next_change_ns = self._find_next_change_ns()
        active = self.faults.active(time_ns)
        self.engine.set_faults(active, time_ns)
        self._log_changes(time_ns, active)
        absent = self._absent(time_ns // self.world.period_ns)
        killed = self._nodes_under(active, lambda fault: fault.forced)
        # In real time SIGTERM ends a Zenoh program without its `finally` blocks; virtual time does the same.
        goes_hard = self.scenario.program.kind == "zenoh" and not self.scenario.has_gateways
        changes = self.presence.change(self._nodes_under(active, lambda fault: fault.ends), absent)
        self._started_ns |= dict.fromkeys(changes.started, time_ns)
        for node in changes.stopped:
            self.engine.set_up(self.number[node], False)
            self.driving.release(time_ns, node)
        for node in changes.left:
            self.folder.event(time_ns, EventKind.left, node)
        if starts_at_once:
            self.come_back(changes.started, time_ns)
        return ProcessActions(
            time_ns=time_ns,
            stop={node: goes_hard or node in killed for node in changes.stopped},
            start=changes.started,
            paused=self._nodes_under(active, lambda fault: not fault.ends),
            clocks=[clock_of(active, node, number, time_ns) for node, number in self.number.items()],
            restarts=[p.fault for p in active if isinstance(p.fault, Infrastructure) and p.start_ns == time_ns],
        )

    def come_back(self, nodes: Sequence[str], time_ns: int) -> None:
        """Nodes that have been started are up."""
        for node, entered in self.presence.come_up(nodes).items():
            self.engine.set_up(self.number[node], True)
            kind = EventKind.entered if entered else EventKind.restarted
            self.folder.event(time_ns, kind, node, incarnation=self.incarnation[node])

    def _nodes_under(self, active: Sequence[PlannedFault], is_meant: Callable[[ProcessFault], bool]) -> set[str]:
        """The nodes on whose processes faults act that `is_meant` accepts."""
        chosen = [p.nodes for p in active if isinstance(p.fault, ProcessFault) and is_meant(p.fault)]
        return {node for node, number in self.number.items() if any(mask[number] for mask in chosen)}

    def _log_changes(self, time_ns: int, active: Sequence[PlannedFault]) -> None:
        acting = {planned.label for planned in active}
        for planned in active:
            if planned.label not in self._acting:
                nodes = [node for node, number in self.number.items() if planned.nodes[number]]
                self.folder.event(time_ns, EventKind.fault_started, None, fault=planned.label, nodes=nodes)
        for label in sorted(self._acting - acting):
            self.folder.event(time_ns, EventKind.fault_ended, None, fault=label)
        self._acting = acting

    def inject(self, fault: Fault, now_ns: int) -> PlannedFault:
        """Plan one more fault while the run is on, and write it into the run's scenario so that it replays.

        It acts after `now_ns` at the earliest. Raises ScenarioError if it does not fit.
        """
        if why := self.scenario.refusal_of(fault):
            raise ScenarioError(f"{fault.kind} {why}")
        at_s = max(fault.at_s, (now_ns + 1) / NS_PER_S)
        planned = self.faults.add(fault.model_copy(update={"at_s": at_s}))
        self._change_plan()
        return planned

    def inject_rule(self, fault: OwnRule, program: Program, now_ns: int) -> PlannedFault:
        """Plan a rule of the user's own as `inject` does; `program` has the folders in which it is found.

        Raises ScenarioError, also for a rule that cannot be imported.
        """
        self._rules.load([fault], program)
        self.scenario = self.scenario.model_copy(update={"program": program})
        planned = self.inject(fault, now_ns)
        self.folder.add_rules(self.scenario)
        return planned

    def _rule_failed(self, failure: RuleFailure) -> None:
        details = {"fault": failure.fault, "rule": failure.rule, "sender": failure.sender, "error": failure.error}
        self.folder.event(failure.time_ns, EventKind.rule_failed, None, **details, where=failure.where)

    def _sensor_failed(self, failure: SensorFailure) -> None:
        details = {"fault": f"world.sensor.{failure.sensor}", "rule": failure.model, "error": failure.error}
        self.folder.foresee(failure.time_ns, EventKind.rule_failed, None, **details, where=failure.where)

    def _figures_failed(self, time_ns: int, entry: str, said: str, where: str) -> None:
        self.folder.event(
            time_ns, EventKind.rule_failed, None, fault="FIGURES", rule=entry, error=said, where=where
        )

    def heal(self, label: str, now_ns: int) -> PlannedFault:
        """End a fault right after `now_ns`, and write that down. Raises ScenarioError if there is no such fault."""
        planned = self.faults.heal(label, now_ns + 1)
        self._change_plan()
        return planned

    def end_at(self, time_ns: int) -> None:
        """Let the run end at `time_ns`, by when all faults have healed, and write that down so that it replays."""
        healed_ns = self.faults.last_end_ns
        assert healed_ns <= time_ns <= self.duration_ns, (healed_ns, time_ns, self.duration_ns)
        run = self.scenario.run
        settle_s = min(run.settle_s, (time_ns - healed_ns) / NS_PER_S)
        self.driving.end_at(time_ns)
        world_s = run.world_s if time_ns == self.duration_ns else self.scenario.world_ns / NS_PER_S
        shorter = run.model_copy(
            update={"duration_s": time_ns / NS_PER_S, "settle_s": settle_s, "world_s": world_s}
        )
        self._rewrite(self.scenario.model_copy(update={"run": shorter}))

    def _change_plan(self) -> None:
        self._next_change_ns = self._find_next_change_ns()
        self._rewrite(self.scenario.model_copy(update={"fault": self.faults.as_written()}))

    def _rewrite(self, scenario: Scenario) -> None:
        self.scenario, self.duration_ns = scenario, scenario.duration_ns
        self.folder.put_scenario(scenario)

    def advance(self, time_ns: int) -> list[Delivery]:
        """Everything that arrives up to `time_ns`, having closed the periods that end by then."""
        self.close_periods(time_ns)
        self.backbone.decide(time_ns)
        arrived = [*self._arrived, self.engine.advance(time_ns)]
        self._arrived = []
        return [delivery for deliveries in arrived for delivery in deliveries]

    def pass_to(self, time_ns: int) -> None:
        """As `advance`, where everything that arrives by then has been foreseen and handed out."""
        self.close_periods(time_ns)
        self.backbone.decide(time_ns)
        self.engine.advance(time_ns)
        self._arrived = []

    def fix_time_ns(self, period: int) -> int | None:
        """Time at which the fix of a period is due; None after the end of the run."""
        time_ns = period * self.world.period_ns
        return time_ns if time_ns < self.duration_ns else None

    def finish(self, time_ns: int) -> None:
        """End of the run at `time_ns`: close the periods and decide what is still in flight. Only once.

        Faults, entries and exits before it act, also those to which a run in real time comes too late.
        """
        if self.ended_ns is None:
            time_ns = min(time_ns, self.duration_ns)
            self.drive_to(time_ns)
            while (change_ns := self.next_change_ns()) is not None and change_ns < time_ns:
                self.advance(change_ns - 1)
                self.act(change_ns, starts_at_once=False)
            self.ended_ns = time_ns
            self.close_periods(time_ns)
            self.folder.reach(time_ns)
            self.engine.drain()
            self.driving.close()

    def memory_exceeded(self, time_ns: int, process_id: str, memory_mb: float, nodes: Sequence[str]) -> None:
        """Write the event of the process of these nodes that holds more than `run.memory_limit_mb`."""
        limits = {"memory_mb": memory_mb, "limit_mb": self.scenario.run.memory_limit_mb}
        self.folder.event(time_ns, EventKind.memory_exceeded, process_id, nodes=list(nodes), **limits)

    def close_periods(self, time_ns: int) -> None:
        """Record the periods that end by then; nobody has anything more to report of them.

        What arrives in them, whether or not anybody waits for it, has arrived by then: `advance` hands it out.
        """
        while (end_ns := (self._period + 1) * self.world.period_ns) <= time_ns:
            self.engine.look_ahead(end_ns, ())
            self._arrived.append(self.engine.advance(end_ns - 1))
            instant = self.gnss.at(self._period)
            reports = sorted(self._reports, key=lambda r: (r.time_ns, self.number[r.node]))
            component = self._component(self._period) if self._topology_changes else None
            self.metrics.record(instant, reports, component)
            self._period += 1
            self._reports = []
            if self._watchers:
                self._show_period(instant, reports)

    def _show_period(self, instant: Instant, reports: list[Report]) -> None:
        """Show those who watch the run the period that has ended."""
        counts = {outcome.name: count for outcome, count in self.engine.counts.items()}
        view = PeriodView(instant, reports, self.metrics, counts)
        for watcher in self._watchers:
            watcher(view)


def node_seed(seed: int, node: str, incarnation: int) -> int:
    """The seed of a node's own random numbers, from which the scenario's seed cannot be told."""
    digest = hashlib.sha256(f"vnet node seed/{seed}/{node}/{incarnation}".encode()).digest()
    return int.from_bytes(digest[:7], "big")
