"""The barrier of a run in lockstep, without any transport.

Lockstep is a conservative discrete-event simulation whose entities are event loops: it is told what each process
yields and says which processes to grant which window of time. `run_in_lockstep` is the one loop that moves these
messages, wherever the processes are; so a live run and its simulation give the same trace.

No frame arrives sooner than L, `lookahead_ns`, after it was sent. So what arrives in a window [T, T + L) was
sent before T, the next instant at which anything happens: each process may pass through the window by itself.
Arrivals are *shown* to processes before the window, and *decided* after it, in the order of time with what the
processes did: a program that ends within the window does not receive what arrives later. A window ends with the
period at the latest, and before faults and the horizon. A process that runs `ahead` may go on by itself where
nobody could notice, and tell in advance the frames that it sends there; it has the fixes of the next period for
that (`agents/host.py`).
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Collection, Iterable, Mapping, Sequence
from heapq import heapify, heappop, heappush
from itertools import count
from typing import Any

import numpy as np
from msgspec.structs import replace

from emulator.drivers.emulation import Emulation, ProcessActions
from emulator.drivers.processes import Processes, ProtocolError, check_yield
from emulator.scenario.scenario import lookahead_ns
from vnet.node import Fix
from vnet.radio import INBOX_LIMIT, Packet
from vnet.runtime.arrivals import Mail
from vnet.transport import wire
from vnet.types import IntArray


class LockstepProcess:
    """One event loop at the barrier: its nodes, what they last said, and what waits for its next wake-up.

    `order` is its place among all processes. `plan` numbers its planned wake-up: earlier ones are void.
    """

    def __init__(self, nodes: Sequence[str], order: int) -> None:
        self.id = nodes[0]
        self.nodes = tuple(nodes)
        self.numbers: IntArray = np.zeros(0, np.int64)
        """The numbers of its nodes among those of the run."""
        self.order = order
        self.plan = -1
        self.seq = 0
        self.granted_ns = 0
        self.quiet_ns = 0
        self.next_timer_ns: int | None = None
        self.waiting_radio: Sequence[str] = ()
        self.waiting_gnss: Sequence[str] = ()
        self.packets: dict[str, list[Packet]] = {}
        """Packets that have yet to be granted, by node."""
        self.next_fix = dict.fromkeys(self.nodes, 0)
        self.paused: set[str] = set()
        self.affected: set[str] = set()
        self.clocks: list[wire.ClockError] = []

    @property
    def running(self) -> Sequence[str]:
        """Nodes that are not paused."""
        return [node for node in self.nodes if node not in self.paused] if self.paused else self.nodes

    def take_packets(self) -> dict[str, list[Packet]]:
        """Return the packets of nodes that run, and have any."""
        packets, self.packets = self.packets, {}
        for node in self.paused & packets.keys():
            self.packets[node] = packets.pop(node)
        return packets

    def take_clocks(self) -> list[wire.ClockError]:
        changed, self.clocks = self.clocks, []
        return changed


class Lockstep:
    """The barrier of a run. `processes` are the node ids of each event loop; the first is its id.

    Use: grants = start(); then, until `step` returns none: do what `take_actions` says, give each grant to its
    process and `receive` its yield (or say that it `died`); when nothing is `owed`, call `step`.

    Processes come and go with faults, unless they are `permanent` (a simulation) and programs do, within them.

    With a `horizon_ns` the run is `held` before anything happens at or after that instant: `step` returns none, and
    goes on when it is called with a later horizon.
    """

    def __init__(self, emulation: Emulation, processes: Sequence[Sequence[str]], permanent: bool = False) -> None:
        self._emulation = emulation
        self._groups = {nodes[0]: tuple(nodes) for nodes in processes}
        self._order = {process_id: order for order, process_id in enumerate(self._groups)}
        self._process_of = {node: nodes[0] for nodes in processes for node in nodes}
        self._processes: dict[str, LockstepProcess] = {}
        self._permanent = permanent
        self._actions: list[ProcessActions] = []
        self._woken: set[str] = set()
        self._wakes: list[tuple[int, int, int, str]] = []
        """Heap of planned wake-ups: time, order, plan and id of a process."""
        self._plans = count()
        self._listens = np.zeros(len(emulation.world.node_ids), dtype=bool)
        """Nodes (N,) that an arrival wakes."""
        self._steps: list[tuple[int, int, int, wire.Step]] = []
        """Heap of what processes have told and is not taken yet: time, order of the process, number, and step."""
        self._deaths: list[tuple[LockstepProcess, dict[str, Any]]] = []
        self._news = emulation.news
        self._crowded: set[str] = set()
        """Nodes for which more packets wait than a mailbox holds."""
        self._end_ns = 0
        self._quiet_ns = 0
        """Instant before which processes that run ahead may pass through quiet instants."""
        self._mail: dict[str, Mail] = {}
        self.ahead: Collection[str] = ()
        """Processes that run ahead."""
        self._lookahead_ns = lookahead_ns(emulation.scenario) if emulation.scenario.run.windows else 1
        self.owed: dict[str, int] = {}
        self.now_ns = 0
        """Emulated time: the beginning of the window, or the last change."""
        self.horizon_ns: int | None = None
        self.held = False
        self.is_to_hold = False
        """True to have the run held where it stands, before its horizon; another thread may say so."""
        for nodes in processes:
            if permanent or any(emulation.up[node] for node in nodes):
                self._add(nodes[0])

    @property
    def decided_ns(self) -> int:
        """Emulated time up to which nothing can be changed any more: new faults act after it."""
        passed_ns = self.horizon_ns - 1 if self.held and self.horizon_ns is not None else 0
        quiet_ns = self._quiet_ns if self.ahead else 0
        return max(self.now_ns, self._end_ns - 1, quiet_ns - 1, passed_ns)

    def start(self) -> dict[str, wire.Grant]:
        """The first grants, to all, at time 0."""
        if self._emulation.next_change_ns() == 0:
            self._act(0)
        if first := [one.id for one in self._processes.values() if one.running or self._known_wake_ns(one) == 0]:
            self._open_window(0)
            return self._grant(dict.fromkeys(first, 0))
        return self._go_on()  # all are dead or paused

    def take_actions(self) -> list[ProcessActions]:
        """Return what is to be done to processes at this instant, before the grants are given."""
        actions, self._actions = self._actions, []
        return actions

    def take_mail(self, process_id: str) -> Mail:
        """Return the packets and fixes that belong to the grant of a process."""
        return self._mail.pop(process_id)

    def receive(self, process_id: str, message: wire.Yield) -> None:
        """A process has yielded.

        Raises ProtocolError if it was not owed, speaks for others' nodes, or does not keep to its window.
        """
        if self.owed.get(process_id) != message.seq:
            raise ProtocolError(f"yield {message.seq} of {process_id}: expected {self.owed.get(process_id)}")
        process = self._processes[process_id]
        check_yield(process.nodes, message, process.granted_ns, self._end_ns, process.quiet_ns)
        del self.owed[process_id]
        process.next_timer_ns = message.next_timer_ns
        process.waiting_radio = message.waiting_radio
        process.waiting_gnss = message.waiting_gnss
        for step in message.steps:
            heappush(self._steps, (step.time_ns, process.order, next(self._plans), step))
        self._plan(process)
        self._emulation.costs.wake_ups[process_id] += message.instants

    def died(self, process_id: str, **details: Any) -> None:
        """A process has ended: its nodes are down from the beginning of the window on, and nothing is owed by it.

        What it did within the window is lost with it, and what it has told in advance. `step` tells of those of a
        window in the order of processes, whichever the system has told of first.
        """
        if process := self._processes.get(process_id):  # else a fault was faster
            self._remove(process_id)
            self.owed.pop(process_id, None)
            self._deaths.append((process, details))

    def tell_deaths(self) -> None:
        """Tell of the processes that have died since, where no `step` follows."""
        for process, details in sorted(self._deaths, key=lambda death: death[0].order):
            for node in process.nodes:
                self._emulation.died(self.now_ns, node, **details)
        self._deaths.clear()

    def step(self) -> dict[str, wire.Grant]:
        """Do what was yielded, go to the next window, and say who is granted it; none at the end, or if held."""
        self.tell_deaths()
        self._settle()
        return self._go_on()

    def _settle(self) -> None:
        """Take what was enqueued in the window, in the order of time, and decide what has arrived in it."""
        assert not self.owed, self.owed
        emulation = self._emulation
        while self._steps and (time_ns := self._steps[0][0]) < self._end_ns:
            told: list[wire.Traffic] = []
            while self._steps and self._steps[0][0] == time_ns:
                told.append(heappop(self._steps)[3].traffic)
            if any(traffic.endings for traffic in told):
                emulation.pass_to(time_ns)  # what arrives at the same instant is still received
            emulation.take(time_ns, told)
        emulation.pass_to(self._end_ns - 1)

    def _go_on(self) -> dict[str, wire.Grant]:
        while self._come_to_window():
            if wakes := self._wakes_in_window():
                return self._grant(wakes)
            self._settle()  # what has come is for nodes that are down or paused
        return {}

    def _come_to_window(self) -> bool:
        """Open the next window, having done what comes before it; returns false at the end, or if held."""
        emulation = self._emulation
        while True:
            next_ns = self._next_instant_ns()
            change_ns = emulation.next_change_ns()
            first_ns = next_ns if change_ns is None else min(next_ns, change_ns)
            if self.is_to_hold:
                here_ns = max(min(first_ns, emulation.next_control_ns() or first_ns), self.decided_ns + 1)
                self.horizon_ns = min(here_ns, self.horizon_ns or here_ns)
            if self._drive(first_ns):
                continue
            if self._hold(first_ns):
                return False
            if change_ns is None or change_ns > next_ns or change_ns >= emulation.duration_ns:
                break
            self._act(change_ns)
        if next_ns >= emulation.duration_ns:
            emulation.finish(emulation.duration_ns)
            return False
        self._open_window(next_ns)
        return True

    def _drive(self, next_ns: int) -> bool:
        """Have vehicles drive to a control instant that is not after `next_ns`; returns whether there was one."""
        control_ns, horizon_ns = self._emulation.next_control_ns(), self.horizon_ns
        if control_ns is None or control_ns > next_ns or (horizon_ns is not None and control_ns >= horizon_ns):
            return False
        self._emulation.drive_to(control_ns)
        return True

    def _next_instant_ns(self) -> int:
        """Return the next instant at which a process has something to do, or the end of the run.

        The radio comes as far as this instant, and no further: arrivals depend on what others send before, and so
        far nobody will but for those whom an arrival, of a frame or by wire, wakes.
        """
        emulation = self._emulation
        told_ns = self._steps[0][0] if self._steps else None
        next_ns = min(ns for ns in (emulation.duration_ns, self._next_planned_ns(), told_ns) if ns is not None)
        changes_ns = emulation.next_change_ns(), emulation.next_control_ns()
        until_ns = [next_ns, self._news.next_ns(), *changes_ns, self.horizon_ns]
        listening = np.flatnonzero(self._listens)
        emulation.engine.look_ahead(min(time_ns for time_ns in until_ns if time_ns is not None), listening)
        if len(listening):
            next_ns = min(next_ns, int(emulation.engine.next_arrivals_ns()[listening].min()))
        news_ns = self._news.next_ns()  # by now also the results of what the radio has done
        return max(next_ns if news_ns is None else min(next_ns, news_ns), self.now_ns)

    def _hold(self, next_ns: int) -> bool:
        """Return whether what comes next lies beyond the horizon; all before it is then done and recorded."""
        self.held = self.horizon_ns is not None and next_ns >= self.horizon_ns
        if self.horizon_ns is not None and self.held:
            self._pass_to(self.horizon_ns - 1)
            self._emulation.close_periods(self.horizon_ns)
        return self.held

    # Windows.

    def _open_window(self, time_ns: int) -> None:
        """Begin the window at `time_ns`, and show what arrives in it."""
        emulation = self._emulation
        period_ns = emulation.world.period_ns
        ends_ns = [time_ns + self._lookahead_ns, (time_ns // period_ns + 1) * period_ns, emulation.duration_ns]
        more_ns = emulation.next_change_ns(), emulation.next_control_ns(), self.horizon_ns
        ends_ns += [end_ns for end_ns in more_ns if end_ns is not None]
        self.now_ns, self._end_ns = time_ns, min(ends_ns)
        assert time_ns < self._end_ns, "an empty window would be opened for ever"
        self._quiet_ns = min([(time_ns // period_ns + 2) * period_ns, *ends_ns[2:]])
        self._show(self._end_ns - 1)
        emulation.close_periods(time_ns)

    def _pass_to(self, time_ns: int) -> None:
        """Show and decide what arrives up to `time_ns`, before which no process has anything to do."""
        self._show(time_ns)
        self._emulation.pass_to(time_ns)

    def _show(self, time_ns: int) -> None:
        """Put what arrives up to `time_ns` where its receiver will find it."""
        for node in self._crowded:
            if process := self._processes.get(self._process_of[node]):
                del process.packets.get(node, [])[:-INBOX_LIMIT]
        self._crowded.clear()
        node_ids, process_of, processes = self._emulation.world.node_ids, self._process_of, self._processes
        for receiver, packets in self._emulation.engine.foresee(time_ns).by_receiver():
            node = node_ids[receiver]
            waiting = processes[process_of[node]].packets.setdefault(node, packets)
            if waiting is not packets:
                waiting += packets
            if len(waiting) > INBOX_LIMIT:
                self._crowded.add(node)
        self._news.show(time_ns)

    def _wakes_in_window(self) -> dict[str, int]:
        """Return the first instant in the window of each process that has one, in the order of the processes."""
        wakes: dict[str, int] = {}
        while (next_ns := self._next_planned_ns()) is not None and next_ns < self._end_ns:
            wakes[heappop(self._wakes)[3]] = next_ns
        arrivals_ns = self._emulation.engine.next_arrivals_ns()
        for number in np.flatnonzero(self._listens & (arrivals_ns < self._end_ns)).tolist():
            process_id = self._process_of[self._emulation.world.node_ids[number]]
            wakes[process_id] = min(wakes.get(process_id, self._end_ns), int(arrivals_ns[number]))
        for node, time_ns in self._news.firsts():
            process = self._processes.get(self._process_of[node])
            if process is not None and node not in process.paused:
                wakes[process.id] = min(wakes.get(process.id, self._end_ns), time_ns)
        in_order = sorted(wakes, key=self._order.__getitem__)
        return {process_id: max(wakes[process_id], self.now_ns) for process_id in in_order}

    # Processes, and when they run next.

    def _add(self, process_id: str) -> LockstepProcess:
        process = LockstepProcess(self._groups[process_id], self._order[process_id])
        process.numbers = np.array([self._emulation.number[node] for node in process.nodes])
        self._processes[process_id] = process
        return process

    def _remove(self, process_id: str) -> None:
        process = self._processes.pop(process_id, None)
        if process is not None:
            self._listens[process.numbers] = False
            self._steps = [told for told in self._steps if told[1] != process.order]
            heapify(self._steps)
        self._news.take(() if process is None else process.nodes)

    def _plan(self, process: LockstepProcess) -> None:
        """Note what a process waits for: an arrival, or a time that is known."""
        self._listens[process.numbers] = False
        for node in process.waiting_radio:
            self._listens[self._emulation.number[node]] = node not in process.paused
        process.plan = next(self._plans)
        wake_ns = self._known_wake_ns(process)
        if wake_ns is not None:
            heappush(self._wakes, (wake_ns, process.order, process.plan, process.id))

    def _known_wake_ns(self, process: LockstepProcess) -> int | None:
        """Return when a process runs next without an arrival: at a timer, at a fix, or now if it was woken."""
        if process.id in self._woken and (self._permanent or process.running):
            return self.now_ns  # a program may end while all are paused
        if not process.running:
            return None
        fixes_ns = [
            self._emulation.fix_time_ns(process.next_fix[node])
            for node in process.waiting_gnss
            if node not in process.paused
        ]
        return min((time_ns for time_ns in (process.next_timer_ns, *fixes_ns) if time_ns is not None), default=None)

    def _next_planned_ns(self) -> int | None:
        """Return the earliest of the planned wake-ups, having dropped those that are void."""
        while self._wakes:
            wake_ns, _, plan, process_id = self._wakes[0]
            process = self._processes.get(process_id)
            if process is not None and process.plan == plan:
                return wake_ns
            heappop(self._wakes)
        return None

    # Changes.

    def _act(self, time_ns: int) -> None:
        """Let faults act: after all that came before this instant, and before anything that happens at it."""
        self._pass_to(time_ns - 1)
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
                self._woken.add(process.id)
            process.paused = paused
            for clock in actions.clocks:
                if clock.node in process.next_fix:
                    self._apply_clock_error(process, clock)
            self._plan(process)

    def _apply_clock_error(self, process: LockstepProcess, clock: wire.ClockError) -> None:
        if clock.is_wrong or clock.node in process.affected:
            process.clocks.append(clock)
            process.affected.add(clock.node)
            self._woken.add(process.id)  # or it would not know its clock at the end of the run

    def _stop(self, node: str) -> None:
        process_id = self._process_of[node]
        self._news.take([node])
        if self._permanent:
            self._processes[process_id].packets.pop(node, None)
            self._woken.add(process_id)  # for what a program does on its way out
        else:
            self._remove(process_id)

    def _start(self, node: str) -> None:
        process_id = self._process_of[node]
        process = self._processes.get(process_id) or self._add(process_id)
        process.next_fix[node] = -(-self.now_ns // self._emulation.world.period_ns)
        self._woken.add(process_id)

    # Grants.

    def _grant(self, wakes: Mapping[str, int]) -> dict[str, wire.Grant]:
        processes = self._processes
        return {each: self._grant_one(processes[each], time_ns) for each, time_ns in wakes.items()}

    def _grant_one(self, process: LockstepProcess, time_ns: int) -> wire.Grant:
        self._woken.discard(process.id)
        process.granted_ns = time_ns
        fixes: list[tuple[str, Fix]] = []
        if min(process.next_fix.values()) <= self.now_ns // self._emulation.world.period_ns:
            fixes = self._take_fixes(process)
        packets, clocks = process.take_packets(), process.take_clocks()
        busy = self._emulation.busy.of(process.nodes, time_ns, self._end_ns)
        results, messages = self._news.take(process.running)
        grant = wire.Grant(
            process.seq, time_ns, self._end_ns, clocks=clocks, busy=busy, results=results, messages=messages
        )
        self._mail[process.id] = Mail(packets, fixes)
        if process.id in self.ahead and self._lookahead_ns > 1 and not process.paused:
            grant = self._quiet_grant(process, grant)
        process.quiet_ns = grant.quiet_ns
        self.owed[process.id] = process.seq
        process.seq += 1
        return grant

    def _take_fixes(self, process: LockstepProcess) -> list[tuple[str, Fix]]:
        """Return the fixes that are due: a window ends with the period, so none is due within it."""
        last = self.now_ns // self._emulation.world.period_ns
        fixes: list[tuple[str, Fix]] = []
        for node in process.running:
            first = max(process.next_fix[node], last - INBOX_LIMIT + 1)
            if first <= last:
                process.next_fix[node] = last + 1
                fixes += self._fixes(node, range(first, last + 1))
        return fixes

    def _fixes(self, node: str, periods: Iterable[int]) -> list[tuple[str, Fix]]:
        """Return the fixes of these periods with their node; none if it is down."""
        if not self._emulation.up[node]:
            return []
        number, fix_of = self._emulation.number[node], self._emulation.gnss.fix
        return [(node, fix) for period in periods if (fix := fix_of(period, number)) is not None]

    def _quiet_grant(self, process: LockstepProcess, grant: wire.Grant) -> wire.Grant:
        """Return the grant with the bound of quiet instants, and the fixes of the next period if it lies before."""
        period = self.now_ns // self._emulation.world.period_ns + 1
        due_ns = period * self._emulation.world.period_ns
        nodes = [node for node in process.nodes if process.next_fix[node] == period]
        if due_ns >= self._quiet_ns or not nodes:
            return replace(grant, quiet_ns=self._quiet_ns)
        process.next_fix.update(dict.fromkeys(nodes, period + 1))
        fixes = [wire.WireFix.of(*each) for node in nodes for each in self._fixes(node, [period])]
        return replace(grant, quiet_ns=self._quiet_ns, next_fixes=fixes, next_fixes_ns=due_ns)


HorizonCallback = Callable[[Lockstep], Awaitable[None]]
"""Sets the barrier's horizon: called before time 0, and whenever the run is held there."""


async def no_horizon(lockstep: Lockstep) -> None:
    """Leave the run without a horizon: nothing holds it."""


async def run_in_lockstep(
    lockstep: Lockstep, processes: Processes, before_horizon: HorizonCallback = no_horizon
) -> None:
    """Run from time 0 to the end: give the barrier's grants to the processes and take their yields."""
    try:
        await before_horizon(lockstep)
        grants = lockstep.start()
        while grants:
            await _act(lockstep, processes)
            for process_id, grant in grants.items():
                processes.send(process_id, grant, lockstep.take_mail(process_id))
            await _all_yielded(lockstep, processes)
            grants = lockstep.step()
            while lockstep.held:
                await before_horizon(lockstep)
                grants = lockstep.step()
        await _act(lockstep, processes)  # faults after which nobody has had anything to do
        for process_id, details in processes.ended().items():
            lockstep.died(process_id, **details)
    finally:
        lockstep.tell_deaths()


async def _act(lockstep: Lockstep, processes: Processes) -> None:
    """Do to the processes what faults and trips have done since the last grants."""
    for actions in lockstep.take_actions():
        await processes.act(actions)


async def _all_yielded(lockstep: Lockstep, processes: Processes) -> None:
    """Take the yields of all processes that were granted a window, or their ends."""
    while owed := lockstep.owed:
        for process_id, details in processes.ended(owed.keys()).items():
            lockstep.died(process_id, **details)
        if owed and (heard := await processes.receive()) is not None:
            assert isinstance(heard.message, wire.Yield)
            try:
                lockstep.receive(heard.process_id, heard.message)
            except ProtocolError as error:
                processes.refuse(heard.process_id, error)
