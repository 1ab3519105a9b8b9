"""The barrier of a run in lockstep, without any transport.

Lockstep is a conservative discrete-event simulation whose entities are event loops: it is told what each process
yields and says which processes to grant which instant. The live driver moves these messages over Zenoh,
`vnet simulate` by calling; so both give the same trace.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

from emulator.drivers.emulation import Emulation, ProcessActions
from emulator.drivers.protocol import ProtocolError, check_ownership, wire_packet
from vnet.node import INBOX_LIMIT
from vnet.transport import wire


class _Process:
    """One event loop: its nodes, what they last said, and what waits for its next wake-up."""

    def __init__(self, nodes: Sequence[str]) -> None:
        self.nodes = tuple(nodes)
        self.seq = 0
        self.next_timer_ns: int | None = None
        self.waiting_radio: Sequence[str] = ()
        self.waiting_gnss: Sequence[str] = ()
        self.traffic: wire.Traffic | None = None
        self.packets: dict[str, deque[wire.WirePacket]] = {node: deque(maxlen=INBOX_LIMIT) for node in self.nodes}
        self.next_fix = dict.fromkeys(self.nodes, 0)
        self.paused: set[str] = set()
        self.affected: set[str] = set()
        self.clocks: list[wire.ClockError] = []

    @property
    def running(self) -> list[str]:
        """Nodes that are not paused."""
        return [node for node in self.nodes if node not in self.paused]

    def take_packets(self) -> list[wire.WirePacket]:
        due = [packet for node in self.running for packet in self.packets[node]]
        for node in self.running:
            self.packets[node].clear()
        return due

    def take_clocks(self) -> list[wire.ClockError]:
        changed, self.clocks = self.clocks, []
        return changed


class Lockstep:
    """The barrier of a run. `processes` are the node ids of each event loop; the first is its id.

    Use: grants = start(); then, until `step` returns none: do what `take_actions` says, give each grant to its
    process and `receive` its yield (or say that it `died`); when nothing is `owed`, call `step`.

    Processes come and go with faults: `hosts_all` says that one process outlives them (a simulation), and that its
    driver stops and starts programs within it.

    With a `horizon_ns` the run is `held` before anything happens at or after that instant: `step` returns none, and
    goes on when it is called with a later horizon.
    """

    def __init__(self, emulation: Emulation, processes: Sequence[Sequence[str]], hosts_all: bool = False) -> None:
        self._emulation = emulation
        self._groups = {nodes[0]: tuple(nodes) for nodes in processes}
        self._process_of = {node: nodes[0] for nodes in processes for node in nodes}
        there = [nodes for nodes in processes if hosts_all or any(emulation.up[node] for node in nodes)]
        self._processes = {nodes[0]: _Process(nodes) for nodes in there}
        self._hosts_all = hosts_all
        self._actions: list[ProcessActions] = []
        self._woken: set[str] = set()
        self.owed: dict[str, int] = {}
        self.now_ns = 0
        self.horizon_ns: int | None = None
        self.held = False

    def start(self) -> dict[str, wire.Grant]:
        """The first grants, to all, at time 0."""
        if self._emulation.next_change_ns() == 0:
            self._act(0)
        if first := [process_id for process_id, process in self._processes.items() if process.running]:
            return self._grant(first)
        return self._go_on()  # all are dead or paused

    def take_actions(self) -> list[ProcessActions]:
        """Return what is to be done to processes at this instant, before the grants are given."""
        actions, self._actions = self._actions, []
        return actions

    def receive(self, process_id: str, message: wire.Yield) -> None:
        """A process has yielded.

        Raises ProtocolError if it was not owed, speaks for others' nodes, or asks for the same instant again.
        """
        process = self._processes[process_id]
        if self.owed.get(process_id) != message.seq:
            raise ProtocolError(f"yield {message.seq} of {process_id}: expected {self.owed.get(process_id)}")
        if message.next_timer_ns is not None and message.next_timer_ns <= self.now_ns:
            raise ProtocolError(
                f"yield {message.seq} of {process_id}: its next timer is not later than {self.now_ns}"
            )
        waiting = [*message.waiting_radio, *message.waiting_gnss]
        check_ownership(process.nodes, message.traffic, waiting)
        del self.owed[process_id]
        process.next_timer_ns = message.next_timer_ns
        process.waiting_radio = message.waiting_radio
        process.waiting_gnss = message.waiting_gnss
        process.traffic = message.traffic

    def died(self, process_id: str, **details: Any) -> None:
        """A process has ended: its nodes are down from this instant on, and nothing is owed by it."""
        process = self._processes.pop(process_id, None)
        if process is None:  # a fault was faster
            return
        self.owed.pop(process_id, None)
        for node in process.nodes:
            self._emulation.died(self.now_ns, node, **details)

    def step(self) -> dict[str, wire.Grant]:
        """Do what was yielded, go to the next instant, and say who is granted it; none at the end, or if held."""
        assert not self.owed, self.owed
        emulation = self._emulation
        emulation.take(self.now_ns, [p.traffic for p in self._processes.values() if p.traffic is not None])
        for process in self._processes.values():
            process.traffic = None
        return self._go_on()

    def _go_on(self) -> dict[str, wire.Grant]:
        emulation = self._emulation
        while True:
            self._look_ahead()
            wakes = {process_id: self._wake_ns(process) for process_id, process in self._processes.items()}
            next_ns = min((wake for wake in wakes.values() if wake is not None), default=emulation.duration_ns)
            change_ns = emulation.next_change_ns()
            if self._hold(next_ns if change_ns is None else min(next_ns, change_ns)):
                return {}
            if change_ns is None or change_ns > next_ns or change_ns >= emulation.duration_ns:
                break
            self._act(change_ns)
        if next_ns >= emulation.duration_ns:
            emulation.finish(emulation.duration_ns)
            return {}
        self.now_ns = next_ns
        self._collect_packets(next_ns)
        return self._grant([process_id for process_id, wake in wakes.items() if wake == next_ns])

    def _look_ahead(self) -> None:
        """Let the radio come as far as the first instant at which anything else happens, and no further.

        Arrivals depend on what others send before; so far nobody will, but for those whom an arrival wakes.
        """
        emulation = self._emulation
        stops_ns = [emulation.duration_ns, emulation.next_change_ns(), self.horizon_ns]
        stops_ns += [self._wake_ns(process, by_radio=False) for process in self._processes.values()]
        waiting = [n for p in self._processes.values() for n in p.waiting_radio if n not in p.paused]
        emulation.look_ahead(min(time_ns for time_ns in stops_ns if time_ns is not None), waiting)

    def _hold(self, next_ns: int) -> bool:
        """Return whether what comes next lies beyond the horizon; all before it is then done and recorded."""
        self.held = self.horizon_ns is not None and next_ns >= self.horizon_ns
        if self.horizon_ns is not None and self.held:
            self._collect_packets(self.horizon_ns - 1)
            self._emulation.close_periods(self.horizon_ns)
        return self.held

    def _act(self, time_ns: int) -> None:
        """Let faults act: after all that came before this instant, and before anything that happens at it."""
        self._collect_packets(time_ns - 1)
        self.now_ns = time_ns
        actions = self._emulation.act(time_ns)
        self._actions.append(actions)
        for node in actions.stop:
            self._stop(node)
        for node in actions.start:
            self._start(node)
        for process in self._processes.values():
            paused = actions.paused & set(process.nodes)
            if process.paused - paused:
                self._woken.add(process.nodes[0])
            process.paused = paused
            for clock in actions.clocks:
                if clock.node in process.next_fix:
                    self._apply_clock_error(process, clock)

    def _apply_clock_error(self, process: _Process, clock: wire.ClockError) -> None:
        if clock.is_wrong or clock.node in process.affected:
            process.clocks.append(clock)
            process.affected.add(clock.node)

    def _stop(self, node: str) -> None:
        process_id = self._process_of[node]
        if self._hosts_all:
            self._processes[process_id].packets[node].clear()
        else:
            self._processes.pop(process_id, None)

    def _start(self, node: str) -> None:
        process_id = self._process_of[node]
        if process_id not in self._processes:
            # In the order of the first processes, so that nothing depends on who was gone when.
            self._processes[process_id] = _Process(self._groups[process_id])
            self._processes = {
                process_id: self._processes[process_id]
                for process_id in self._groups
                if process_id in self._processes
            }
        process = self._processes[process_id]
        process.next_fix[node] = -(-self.now_ns // self._emulation.world.period_ns)
        self._woken.add(process_id)

    def _wake_ns(self, process: _Process, by_radio: bool = True) -> int | None:
        """Time at which a process must run next: its next timer, or what its nodes' tasks wait for.

        With or without what is on its way to them.
        """
        if not process.running:
            return None
        if process.nodes[0] in self._woken:
            return self.now_ns
        emulation = self._emulation
        candidates = [process.next_timer_ns]
        awaited = set(process.running)
        if by_radio:
            hearing = [n for n in process.waiting_radio if n in awaited]
            candidates += [emulation.engine.next_arrival_ns(emulation.number[n]) for n in hearing]
        candidates += [emulation.fix_time_ns(process.next_fix[n]) for n in process.waiting_gnss if n in awaited]
        due = [time_ns for time_ns in candidates if time_ns is not None]
        return max(min(due), self.now_ns) if due else None

    def _collect_packets(self, time_ns: int) -> None:
        """Put what has arrived by then where its receiver will find it at its next wake-up."""
        node_ids = self._emulation.world.node_ids
        queues = {node: queue for p in self._processes.values() for node, queue in p.packets.items()}
        for delivery in self._emulation.advance(time_ns):
            node = node_ids[delivery.receiver]
            queues[node].append(wire_packet(node, delivery.packet))

    def _grant(self, process_ids: Sequence[str]) -> dict[str, wire.Grant]:
        grants = {}
        for process_id in process_ids:
            process = self._processes[process_id]
            self._woken.discard(process_id)
            fixes = [fix for node in process.running for fix in self._take_fixes(process, node)]
            packets, clocks = process.take_packets(), process.take_clocks()
            grants[process_id] = wire.Grant(process.seq, self.now_ns, packets, fixes, clocks)
            self.owed[process_id] = process.seq
            self._emulation.costs.wake_ups[process_id] += 1
            process.seq += 1
        return grants

    def _take_fixes(self, process: _Process, node: str) -> list[wire.WireFix]:
        world = self._emulation.world
        last = self.now_ns // world.period_ns
        first = max(process.next_fix[node], last - INBOX_LIMIT + 1)
        process.next_fix[node] = last + 1
        if not self._emulation.up[node]:
            return []
        number = self._emulation.number[node]
        fixes = [self._emulation.gnss.fix(period, number) for period in range(first, last + 1)]
        return [wire.WireFix.of(node, fix) for fix in fixes if fix is not None]
