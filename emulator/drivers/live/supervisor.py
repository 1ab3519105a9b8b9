"""The supervisor of a live run: it starts, pauses, ends and restarts processes, and knows the state of each.

Faults and trips decide what a process is to do; the operating system and the connections say what it does. Both
meet in one state a process (`ProcessState`), and only `_TRANSITIONS` lead from one to the next.
"""

from __future__ import annotations

import asyncio
import math
import signal
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from emulator.drivers.attachment import Attachment, LiveOptions
from emulator.drivers.emulation import Emulation
from emulator.drivers.join import Membership
from emulator.drivers.launch import AgentProcesses, Exit, Launcher
from emulator.drivers.router import ROUTER
from emulator.drivers.signals import gets_signals, signals_handled
from emulator.records.events import EventKind
from vnet.errors import VnetError
from vnet.runtime.own_packages import foreign_on_path
from vnet.transport import wire
from vnet.transport.access import host_user

DEATH_GRACE_S = 0.3
"""Seconds for which the last messages of a process that has ended may still arrive."""
SHUT_DOWN_S = 1.0
"""Seconds that a process which was told to end has for it, before it is killed."""
CHILDREN_POLL_S = 0.05
"""Seconds between two looks for ended processes on a thread that gets no signals."""
REALTIME_AGENT_NICE = 10
"""Niceness of agents in real time: on a full machine the emulator, which all wait for, comes first."""


class ChangeSignal:
    """Wakes the task that waits for a change. For use on the run's event loop, by one waiting task."""

    def __init__(self) -> None:
        self._waiter: asyncio.Future[bool] | None = None

    def set(self) -> None:
        """Say that something has changed."""
        self._wake(True)

    def _wake(self, has_changed: bool) -> None:
        if self._waiter is not None and not self._waiter.done():
            self._waiter.set_result(has_changed)

    async def wait(self, timeout_s: float) -> bool:
        """Wait for the next change; False if none came in time."""
        loop = asyncio.get_running_loop()
        self._waiter = loop.create_future()
        timer = None if math.isinf(timeout_s) else loop.call_later(timeout_s, self._wake, False)
        try:
            return await self._waiter
        finally:
            if timer is not None:
                timer.cancel()


class ProcessState(StrEnum):
    """State of a process of agents, as far as the emulator knows."""

    RUNNING = "running"
    PAUSED = "paused"
    """Under the fault `pause`: stopped in real time, given no grant in lockstep."""
    AWAY = "away"
    """Not there: its vehicles have not entered yet or have left, or a fault has ended it."""
    RETURNING = "returning"
    """Started, and not ready yet."""
    DEAD = "dead"
    """It has ended without being told to."""


_TRANSITIONS = {
    ProcessState.RUNNING: {ProcessState.PAUSED, ProcessState.AWAY, ProcessState.DEAD},
    ProcessState.PAUSED: {ProcessState.RUNNING, ProcessState.AWAY, ProcessState.DEAD},
    ProcessState.AWAY: {ProcessState.RETURNING},
    ProcessState.RETURNING: {ProcessState.RUNNING, ProcessState.AWAY, ProcessState.DEAD},
    ProcessState.DEAD: {ProcessState.AWAY},
}


@dataclass
class _Process:
    state: ProcessState
    death: dict[str, Any] | None = None
    """Details of its end, until the pacing has taken them."""


class Supervisor:
    """The processes of a run.

    Before `begin` a process that ends is the reason why the run cannot start (`failure`). From then on each has
    a state, and `take_deaths` says which have died. In real time a paused process is stopped with a signal, and
    nobody waits for one that has been told to end. `agents` starts and ends the agents: the `launcher`, which has
    started all else, or hosts. What is said to a node goes through `say`.
    """

    def __init__(
        self,
        emulation: Emulation,
        options: LiveOptions,
        launcher: Launcher,
        agents: AgentProcesses,
        members: Membership,
        attachment: Attachment,
        say: Callable[[str, wire.EmulatorMessage], None],
        time_ns: Callable[[], int],
        changes: ChangeSignal,
    ) -> None:
        self._folder = emulation.folder
        self._realtime = emulation.scenario.run.pacing == "realtime"
        self._options = options
        self._launcher = launcher
        self._agents = agents
        self._members = members
        self._attachment = attachment
        self._say = say
        self._time_ns = time_ns
        self._changes = changes
        self._processes: dict[str, _Process] = {}
        self._to_pause: Collection[str] = ()
        self._ending: set[asyncio.Task[None]] = set()
        self.failure: VnetError | None = None
        self.router_gone: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        """The end of the separate router, in words; without a router no run goes on."""
        self.reconnecting = False
        """True while the emulator itself is disconnected: lost connections then mean nothing."""
        self._all_told_to_end = False
        self._there: Collection[str] = ()
        """Processes that were there when all were told to end."""
        self._ends: dict[str, tuple[Exit, bool]] = {}
        """Ends of processes until they are told as deaths, and whether all had been told to end by then."""

    def begin(self, processes: Iterable[Sequence[str]]) -> None:
        """Give each process (its nodes, its id first) a state, now that every node that must be there is ready."""
        for nodes in processes:
            away = nodes[0] in self._members.later
            self._processes[nodes[0]] = _Process(ProcessState.AWAY if away else ProcessState.RUNNING)

    def state(self, process_id: str) -> ProcessState:
        """State of a process."""
        return self._processes[process_id].state

    def processes_in(self, *states: ProcessState) -> list[str]:
        """The ids of all processes in one of these states."""
        return [process_id for process_id, process in self._processes.items() if process.state in states]

    def _change(self, process_id: str, state: ProcessState) -> None:
        process = self._processes[process_id]
        assert state in _TRANSITIONS[process.state], f"{process_id}: {process.state} -> {state}"
        process.state = state
        if state is not ProcessState.DEAD:
            process.death = None

    # On the order of the run.

    def launch(self, groups: Sequence[Sequence[str]]) -> None:
        """Start a process for each of these groups of nodes."""
        nice = REALTIME_AGENT_NICE if self._realtime else 0
        self._agents.start_agents(self._attachment.endpoint, self._options.access, groups, nice)

    def pause(self, process_ids: Collection[str]) -> None:
        """Pause these processes and no others; one that is returning is paused when it has returned."""
        self._to_pause = process_ids
        for process_id in self.processes_in(ProcessState.PAUSED):
            if process_id not in process_ids:
                self._resume(process_id)
        for process_id in self.processes_in(ProcessState.RUNNING):
            self._pause_if_planned(process_id)

    def _pause_if_planned(self, process_id: str) -> None:
        if process_id in self._to_pause:
            self._change(process_id, ProcessState.PAUSED)
            if self._realtime:
                self._agents.signal(process_id, signal.SIGSTOP)

    def _resume(self, process_id: str) -> None:
        self._change(process_id, ProcessState.RUNNING)
        if self._realtime:
            self._agents.signal(process_id, signal.SIGCONT)

    async def end(self, process_id: str, killed: bool, reason: str, time_ns: int | None = None) -> None:
        """End a process, and one that is not killed at this time.

        Those started by hand are told to go, and whoever started them may start them again.
        """
        if killed and self._options.launch:
            self._change(process_id, ProcessState.AWAY)
            self._agents.kill(process_id)
            return
        if self.state(process_id) is ProcessState.PAUSED:
            self._resume(process_id)  # or it could not go
        self._change(process_id, ProcessState.AWAY)
        self._say(process_id, wire.End(None, reason, time_ns=time_ns))
        if self._options.launch:
            ending = asyncio.create_task(asyncio.to_thread(self._agents.detach(process_id), SHUT_DOWN_S))
            if self._realtime:
                self._ending.add(ending)
                ending.add_done_callback(self._ending.discard)
            else:
                await ending

    def begin_again(self, process_ids: Iterable[str]) -> None:
        """Start processes that are away; `take_returned` tells when they are ready."""
        groups = []
        for process_id in process_ids:
            self._change(process_id, ProcessState.RETURNING)
            nodes = self._members.nodes_with(process_id)
            if process_id in self._members.later:
                if self._members.enter(process_id):
                    continue
            else:
                self._members.expect(nodes)
            groups.append(nodes)
        if self._options.launch:
            self.launch(groups)

    def returning_nodes(self, process_ids: Iterable[str]) -> list[str]:
        """The nodes of these processes that are not ready yet, and still may be."""
        missing = set(self._members.missing)
        returning = [id_ for id_ in process_ids if self.state(id_) is ProcessState.RETURNING]
        return [node for id_ in returning for node in self._members.nodes_with(id_) if node in missing]

    def take_returned(self) -> list[str]:
        """The processes that have become ready since the last call; they run, or are paused if they should be."""
        returned = [
            process_id
            for process_id in sorted(self.processes_in(ProcessState.RETURNING))
            if not self.returning_nodes([process_id])
        ]
        for process_id in returned:
            self._change(process_id, ProcessState.RUNNING)
            self._pause_if_planned(process_id)
        return returned

    def all_told_to_end(self) -> None:
        """Take note that all have been told to end: a process that ends with status 0 from now on has not died."""
        self._all_told_to_end = True
        self._there = self.processes_in(ProcessState.RUNNING, ProcessState.PAUSED)

    def take_last_deaths(self, ends: Mapping[str, Exit]) -> dict[str, dict[str, Any]]:
        """Return the deaths since all were told to end, and those not taken before; `ends` have just been seen.

        A process lives until it has ended: with status 0, and by itself.
        """
        deaths = self.take_deaths()
        for process_id, (how, told) in {**self._ends, **{name: (how, True) for name, how in ends.items()}}.items():
            if process_id in self._there and (how.status or not told):
                after = ", after the run was over" if told else ""
                deaths[process_id] = {"how": f"{how.how}{after}", "log_tail": how.log_tail}
        return deaths

    async def all_ended(self) -> None:
        """Wait for those that have been told to end."""
        await asyncio.gather(*self._ending)

    # Without an order.

    @contextmanager
    def watching_children(self) -> Iterator[None]:
        """Notice within the block which of the processes that the run has started end."""
        loop = asyncio.get_running_loop()
        if gets_signals():
            with signals_handled(lambda *_: loop.call_soon_threadsafe(self._children_ended), signal.SIGCHLD):
                yield
            return
        polling = loop.create_task(self._poll_children())
        try:
            yield
        finally:
            polling.cancel()

    async def _poll_children(self) -> None:
        while True:
            self._children_ended()
            await asyncio.sleep(CHILDREN_POLL_S)

    def _children_ended(self) -> None:
        for name, how in self._launcher.ended().items():
            if not self._agents.takes_end(name, how):
                self.child_ends(name, how)

    def child_ends(self, name: str, how: Exit) -> None:
        """Take note that a process has just ended: its last messages may still arrive."""
        loop = asyncio.get_running_loop()
        self._ends[name] = how, self._all_told_to_end
        loop.call_later(DEATH_GRACE_S, self.child_ended, name, how, self._all_told_to_end)

    def host_lost(self, process_ids: Sequence[str], how: str) -> None:
        """Take note that processes have ended with their host."""
        for process_id in process_ids if self._processes else ():
            self._ended(process_id, self._all_told_to_end, how=how)

    def child_ended(self, name: str, how: Exit, told_to_end: bool = False) -> None:
        """Take note that a process that the run has started has ended, `told_to_end` or by itself."""
        is_host = name in map(host_user, self._options.access.hosts)
        if not told_to_end:
            self._ends.pop(name, None)
        if name == ROUTER and self._processes:
            if not self.router_gone.done():
                self.router_gone.set_result(how.how)
        elif not self._attachment.knows(name) and not is_host and name != ROUTER:
            self._folder.event(self._time_ns(), EventKind.observer_ended, name, how=how.how)
        elif not self._processes:
            last = (how.log_tail.splitlines() or ["its log is empty"])[-1]
            if "No module named" in last and (foreign := foreign_on_path("agents")):
                last = f"{last}; {foreign}"
            what = "process" if is_host or name == ROUTER else "agent"
            self.failure = VnetError(f"{what} {name} ended before the start ({how.how}): {last}")
            self._changes.set()
        elif not is_host:  # the end of a host's connection tells its own
            self._ended(name, told_to_end, how=how.how, log_tail=how.log_tail)

    def disconnected(self, node: str) -> None:
        """Take note that the connection of a node is gone: it tells the end of a process started by hand."""
        if node in self._members.later:
            self._members.expect([node])
        elif self.reconnecting or node not in self._members.joined or node in self._agents.pids:
            return
        elif not self._processes:
            self._members.leave(node)
        elif not self._options.launch and self.is_there(node):
            process = self._members.describe(node)
            loop, told_to_end = asyncio.get_running_loop(), self._all_told_to_end
            loop.call_later(DEATH_GRACE_S, self._connection_closed, node, process, told_to_end)

    def has_died(self, node: str) -> bool:
        """Return whether the process of this name has died: none of its name is started again."""
        return node in self._processes and self.state(node) is ProcessState.DEAD

    def is_there(self, node: str) -> bool:
        """Return whether the process of this name is there: it runs, or is paused."""
        there = (ProcessState.RUNNING, ProcessState.PAUSED)
        return node in self._processes and self.state(node) in there

    def _connection_closed(self, process_id: str, process: str, told_to_end: bool) -> None:
        if self.is_there(process_id):
            self._ended(process_id, told_to_end, how="its connection closed", process=process)

    def _ended(self, process_id: str, told_to_end: bool, **details: Any) -> None:
        over = (ProcessState.AWAY, ProcessState.DEAD)
        if self.state(process_id) in over or process_id in self._agents.pids:
            return  # a fault was faster, and may have started the next process of this name since
        if told_to_end:
            self._change(process_id, ProcessState.AWAY)
        else:
            self._change(process_id, ProcessState.DEAD)
            self._processes[process_id].death = details
        self._changes.set()

    def take_deaths(self, among: Collection[str] | None = None) -> dict[str, dict[str, Any]]:
        """The deaths that have not been taken yet, of all processes or `among` these, with their details."""
        deaths = {}
        for process_id in sorted(self.processes_in(ProcessState.DEAD)):
            process = self._processes[process_id]
            if process.death is not None and (among is None or process_id in among):
                deaths[process_id], process.death = process.death, None
        return deaths
