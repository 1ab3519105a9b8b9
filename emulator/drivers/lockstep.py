"""The two pacings of a run, lockstep and real time, without any transport.

Lockstep is a conservative discrete-event simulation whose entities are event loops: it is told what each
process yields and says whom to grant what. The live driver moves these messages over Zenoh, `vnet simulate`
by calling; so both give the same trace. Real time runs the same engine on a clock that the driver reads.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from itertools import accumulate
from typing import Any

from emulator.drivers.emulation import Emulation, ProcessActions
from emulator.radio.engine import Delivery
from vnet.errors import VnetError
from vnet.node import INBOX_LIMIT, Packet
from vnet.transport import wire

WORST_PROCESSES, WORST_SECONDS = 8, 20
"""How many are named of those to which deliveries came late."""


class ProtocolError(VnetError):
    """A message that does not fit what its process was told, or speaks for others."""


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
        """The nodes that do not stand still."""
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
    """The barrier of a run. `processes` are the node ids of each event loop, the lead first.

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
        return self._go_on()  # all are dead or stand still

    def take_actions(self) -> list[ProcessActions]:
        """What processes suffer at this instant, before the grants are given."""
        actions, self._actions = self._actions, []
        return actions

    def receive(self, process_id: str, message: wire.Yield) -> None:
        """A process has yielded. Raises ProtocolError if it was not owed or speaks for others' nodes."""
        process = self._processes[process_id]
        if self.owed.get(process_id) != message.seq:
            raise ProtocolError(f"yield {message.seq} of {process_id}: expected {self.owed.get(process_id)}")
        waiting = [*message.waiting_radio, *message.waiting_gnss]
        _check_ownership(process.nodes, message.traffic, waiting)
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
        """Whether what comes next lies beyond the horizon; all that lies before it is then done and recorded."""
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
                    self._bend(process, clock)

    def _bend(self, process: _Process, clock: wire.ClockError) -> None:
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
        """When a process must run next: its next timer, or what its nodes' tasks wait for.

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
            queues[node].append(_wire_packet(node, delivery.packet))

    def _grant(self, process_ids: Sequence[str]) -> dict[str, wire.Grant]:
        grants = {}
        for process_id in process_ids:
            process = self._processes[process_id]
            self._woken.discard(process_id)
            fixes = [fix for node in process.running for fix in self._take_fixes(process, node)]
            packets, clocks = process.take_packets(), process.take_clocks()
            grants[process_id] = wire.Grant(process.seq, self.now_ns, packets, fixes, clocks)
            self.owed[process_id] = process.seq
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


class RealTime:
    """A run on the wall clock: traffic is taken when it comes, and what is due goes out in batches.

    Each batch is remembered until its process acknowledges it; what it missed is lost in `transport`. Processes
    come and go with faults: do what `take_actions` says, and tell `returned` when one is there again.
    """

    def __init__(self, emulation: Emulation, processes: Sequence[Sequence[str]]) -> None:
        self._emulation = emulation
        self._nodes = {nodes[0]: tuple(nodes) for nodes in processes}
        self._process_of = {node: nodes[0] for nodes in processes for node in nodes}
        self._batch_seq = dict.fromkeys(self._nodes, 0)
        self._frames_seq = dict.fromkeys(self._nodes, 0)
        self._unacknowledged: dict[str, dict[int, list[Delivery]]] = {process_id: {} for process_id in self._nodes}
        self._lateness: dict[tuple[str, int], Sequence[int]] = {}  # by process and incarnation
        self._late_in: Counter[int] = Counter()  # how many deliveries were late, by the second that reported them
        self._present = {
            process_id for process_id, nodes in self._nodes.items() if any(emulation.up[node] for node in nodes)
        }
        self._awaited = set(self._present)
        self._paused: set[str] = set()
        self._was_paused: set[str] = set()
        self._actions: list[ProcessActions] = []
        self._packets: dict[str, list[Delivery]] = {}
        self._fixes: dict[str, list[wire.WireFix]] = {}
        self._clocks: dict[str, list[wire.ClockError]] = {process_id: [] for process_id in self._nodes}
        self._affected: set[str] = set()
        self._next_period = 0
        self._origin_ns = 0
        self.gaps = 0

    def start(self, origin_ns: int) -> dict[str, wire.Batch]:
        """The batches that start every process that is there; time 0 is `origin_ns` on the monotonic clock."""
        self._origin_ns = origin_ns
        return {
            process_id: self._batch(process_id, origin_ns=origin_ns)
            for process_id in self._nodes
            if process_id in self._present
        }

    def next_time_ns(self) -> int | None:
        """When `due` must be called next: the next arrival, fix or fault."""
        candidates = [
            self._emulation.engine.next_time(),
            self._emulation.fix_time_ns(self._next_period),
            self._emulation.next_change_ns(),
        ]
        due = [time_ns for time_ns in candidates if time_ns is not None]
        return min(due) if due else None

    def receive(self, now_ns: int, process_id: str, message: wire.Frames) -> None:
        """Take a process's traffic and acknowledgements. Raises ProtocolError if it speaks for others."""
        _check_ownership(self._nodes[process_id], message.traffic, ())
        if message.seq != self._frames_seq[process_id]:
            self.gaps += 1
        self._frames_seq[process_id] = message.seq + 1
        self._acknowledge(process_id, message)
        if message.lateness is not None:
            process = process_id, self._emulation.incarnation[process_id]
            before = _late(self._lateness.get(process, ()))
            self._late_in[now_ns // 10**9] += _late(message.lateness.counts) - before
            self._lateness[process] = message.lateness.counts
        if message.final:
            self._awaited.discard(process_id)
        if now_ns < self._emulation.duration_ns:
            self._emulation.take(now_ns, [message.traffic])

    @property
    def all_final(self) -> bool:
        """Whether every process that lives has said its last words."""
        return not self._awaited

    def _acknowledge(self, process_id: str, message: wire.Frames) -> None:
        waiting = self._unacknowledged[process_id]
        for first, last in message.missed:
            self.gaps += 1
            for seq in [seq for seq in waiting if first <= seq <= last]:
                self._lose(waiting.pop(seq))
        for seq in [seq for seq in waiting if seq < message.received_seq]:
            del waiting[seq]

    def _lose(self, deliveries: Sequence[Delivery]) -> None:
        for delivery in deliveries:
            self._emulation.engine.lose(delivery)

    def due(self, now_ns: int) -> dict[str, wire.Batch]:
        """What has become due by `now_ns`, by process."""
        while (change_ns := self._emulation.next_change_ns()) is not None and change_ns <= now_ns:
            self._collect(change_ns - 1)
            self._act(change_ns)
        self._collect(now_ns)
        ready = self._present - self._paused
        return {
            process_id: self._batch(process_id)
            for process_id in self._nodes
            if process_id in ready
            and (process_id in self._packets or process_id in self._fixes or self._clocks[process_id])
        }

    def take_actions(self) -> list[ProcessActions]:
        """What processes suffer by now."""
        actions, self._actions = self._actions, []
        return actions

    def _act(self, time_ns: int) -> None:
        actions = self._emulation.act(time_ns, starts_at_once=False)
        self._actions.append(actions)
        for process_id in {self._process_of[node] for node in actions.stop}:
            self._present.discard(process_id)
            self._awaited.discard(process_id)
            self._unacknowledged[process_id].clear()
            self._packets.pop(process_id, None)
            self._fixes.pop(process_id, None)
        paused = {self._process_of[node] for node in actions.paused}
        self._was_paused |= self._paused - paused
        self._paused = paused
        for clock in actions.clocks:
            if clock.is_wrong or clock.node in self._affected:
                self._clocks[self._process_of[clock.node]].append(clock)
                self._affected.add(clock.node)

    def returned(self, now_ns: int, process_id: str) -> wire.Batch:
        """A process that was started anew is ready; returns the batch that starts it."""
        self._emulation.come_back(self._nodes[process_id], now_ns)
        self._batch_seq[process_id] = self._frames_seq[process_id] = 0
        self._unacknowledged[process_id].clear()
        self._present.add(process_id)
        self._awaited.add(process_id)
        return self._batch(process_id, origin_ns=self._origin_ns, start_ns=now_ns)

    def _collect(self, time_ns: int) -> None:
        """Take what arrives, and the fixes that are due, by then."""
        node_ids = self._emulation.world.node_ids
        for delivery in self._emulation.advance(time_ns):
            process_id = self._process_of[node_ids[delivery.receiver]]
            if process_id in self._present:
                self._packets.setdefault(process_id, []).append(delivery)
        while (due_ns := self._emulation.fix_time_ns(self._next_period)) is not None and due_ns <= time_ns:
            for number, node in enumerate(node_ids):
                fix = self._emulation.gnss.fix(self._next_period, number) if self._emulation.up[node] else None
                if fix is not None and self._process_of[node] in self._present:
                    self._fixes.setdefault(self._process_of[node], []).append(wire.WireFix.of(node, fix))
            self._next_period += 1

    def _batch(self, process_id: str, origin_ns: int | None = None, start_ns: int = 0) -> wire.Batch:
        seq = self._batch_seq[process_id]
        self._batch_seq[process_id] = seq + 1
        deliveries, fixes = self._packets.pop(process_id, []), self._fixes.pop(process_id, [])
        self._unacknowledged[process_id][seq] = deliveries
        node_ids = self._emulation.world.node_ids
        packets = [_wire_packet(node_ids[delivery.receiver], delivery.packet) for delivery in deliveries]
        clocks, self._clocks[process_id] = self._clocks[process_id], []
        held = process_id in self._was_paused
        self._was_paused.discard(process_id)
        return wire.Batch(fixes, seq, packets, origin_ns, start_ns, held, clocks)

    def died(self, now_ns: int, process_id: str, **details: Any) -> None:
        """A process has ended: its nodes are down from now on."""
        for node in self._nodes[process_id]:
            self._emulation.died(now_ns, node, **details)
        self._unacknowledged[process_id].clear()
        self._present.discard(process_id)
        self._awaited.discard(process_id)

    def finish(self) -> None:
        """End of the run: what nobody acknowledged is lost in transport; say how late deliveries were."""
        self._emulation.finish(self._emulation.duration_ns)
        for waiting in self._unacknowledged.values():
            for deliveries in waiting.values():
                self._lose(deliveries)
        if self.gaps:
            self._emulation.folder.event(self._emulation.duration_ns, "transport_gap", count=self.gaps)
        counts = [sum(column) for column in zip(*self._lateness.values(), strict=True)]
        if sum(counts):
            figures = lateness_figures(counts)
            worst = sorted(self._lateness, key=lambda process: -_late(self._lateness[process]))[:WORST_PROCESSES]
            figures["worst"] = {
                f"{process_id}.{start}": _late(self._lateness[process_id, start]) for process_id, start in worst
            }
            worst_s = self._late_in.most_common(WORST_SECONDS)
            figures["worst_s"] = {str(second): count for second, count in worst_s if count > 0}
            self._emulation.folder.event(self._emulation.duration_ns, "late_deliveries", None, **figures)


def _late(counts: Sequence[int]) -> int:
    """How many deliveries of a lateness histogram are over the limit."""
    return sum(counts[wire.lateness_bin(wire.LATENESS_LIMIT_NS) :])


def lateness_figures(counts: Sequence[int]) -> dict[str, Any]:
    """Figures of a lateness histogram: deliveries, how many over the limit, percentiles in ms."""
    total = sum(counts)
    cumulative = list(accumulate(counts))

    def percentile_ms(share: float) -> float:
        """Interpolated within its bin."""
        index = next(i for i, c in enumerate(cumulative) if c >= share * total)
        below = cumulative[index] - counts[index]
        inside = (share * total - below) / counts[index]
        low_ms, high_ms = wire.lateness_edge_ms(index - 1), wire.lateness_edge_ms(index)
        return low_ms + inside * (high_ms - low_ms)

    return {
        "total": total,
        "count": _late(counts),
        "p50_ms": percentile_ms(0.5),
        "p99_ms": percentile_ms(0.99),
        "max_ms": percentile_ms(1.0),
    }


def _wire_packet(node: str, packet: Packet) -> wire.WirePacket:
    return wire.WirePacket(node, packet.sender, packet.sent_ns, packet.received_ns, packet.payload)


def _check_ownership(nodes: Sequence[str], traffic: wire.Traffic, waiting: Sequence[str]) -> None:
    named = [part.node for parts in (traffic.frames, traffic.reports, traffic.endings) for part in parts]
    for node in [*named, *waiting]:
        if node not in nodes:
            raise ProtocolError(f"the process of {nodes[0]} speaks for {node}, which is not its own")
