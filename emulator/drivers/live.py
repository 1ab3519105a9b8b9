"""The live driver: real processes over Zenoh, in lockstep or real time.

`run_live` opens the emulator's session (an embedded router, or a client of a separate one), starts the agents
or waits for those started by hand, runs the pacing to the end, and leaves no process behind.
"""

from __future__ import annotations

import asyncio
import gc
import json
import os
import signal
import threading
import time
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import ExitStack, asynccontextmanager
from typing import Any

import zenoh

from emulator.drivers.attachment import Attachment, LiveOptions
from emulator.drivers.control import answer, control_endpoint
from emulator.drivers.emulation import Emulation, PeriodView, ProcessActions
from emulator.drivers.join import Membership, split_into_processes
from emulator.drivers.launch import Exit, Launcher
from emulator.drivers.lockstep import Lockstep, ProtocolError, RealTime
from emulator.drivers.memory import MemoryWatch
from emulator.drivers.observers import Messages
from emulator.drivers.router import ROUTER
from emulator.drivers.status import Course
from emulator.scenario.fault_families import Infrastructure
from emulator.scenario.faults import EmulatorRestart
from emulator.scenario.scenario import Scenario
from emulator.viewer.sinks import Sinks
from vnet.errors import ProgramError, TransportError, VnetError, WireError
from vnet.transport import keys, wire
from vnet.transport.access import OBSERVER
from vnet.transport.scheduling import DEFAULT_SLICE, PROMPT_SLICE_NS, set_time_slice

LEASE_MS = 60_000
"""Long, because a starved machine must not look like a dead one; a closed connection is seen at once."""
REALTIME_LEASE_MS = 2_000
DEATH_GRACE_S = 0.3
"""How long the last words of a process that has ended may still be on their way."""
STANDING_WAIT_S = 1.0
AWAIT_WARNING_S = 0.2
"""How long before it goes the emulator tells agents that it will."""
REJOIN_POLL_S = 0.1
FAREWELL_S = 1.0
RECORDER_WAIT_S = 20.0
RECORDER = "recorder"
EMULATOR_PROCESS = "emulator"
REALTIME_AGENT_NICE = 10
SCENE_EVERY_PERIODS = 50


CHILDREN_POLL_S = 0.05
"""How often ended processes are looked for where no signal tells of them."""

HorizonCallback = Callable[[Lockstep], Awaitable[None]]
"""Sets the barrier's horizon: called before time 0, and whenever the run is held there."""


class Stalled(Exception):
    """The run cannot go on: it ends with verdict unknown."""


async def _open(lockstep: Lockstep) -> None:
    """A gate that holds nothing."""


def _gets_signals() -> bool:
    """Whether this thread is the one that Python gives signals to."""
    return threading.current_thread() is threading.main_thread()


@asynccontextmanager
async def _interruptible() -> AsyncIterator[None]:
    """Ctrl-C and SIGTERM cancel the block, once; asyncio's own handling would do so less cleanly."""
    if not _gets_signals():
        yield
        return
    loop = asyncio.get_running_loop()
    task = asyncio.current_task()
    assert task is not None
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, task.cancel)
    try:
        yield
    finally:
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.remove_signal_handler(number)
            signal.signal(number, signal.SIG_IGN)  # a second Ctrl-C must not lose the records


async def run_live(
    emulation: Emulation,
    options: LiveOptions,
    on_state: Callable[[str], None] = lambda text: None,
    before_horizon: HorizonCallback = _open,
    on_missing: Callable[[Sequence[str]], None] = lambda nodes: None,
) -> tuple[float, bool]:
    """Run `emulation` to its end over Zenoh; returns the wall-clock seconds, and whether it was interrupted.

    Ctrl-C and SIGTERM end the run early, with the event `interrupted`. Raises VnetError if it cannot start.
    `before_horizon` holds a run in lockstep. `on_missing` is called with the nodes that have not joined, whenever
    they change.
    """
    with ExitStack() as stack:
        launcher = Launcher(emulation.folder.logs)
        stack.callback(launcher.stop)
        if emulation.scenario.run.pacing == "realtime":
            set_time_slice(PROMPT_SLICE_NS)
            stack.callback(set_time_slice, DEFAULT_SLICE)
        async with _interruptible():
            if options.router is not None:
                options.router.start(launcher)
            run = LiveRun(emulation, options, launcher, before_horizon)
            stack.callback(run.close)
            stack.enter_context(
                control_endpoint(emulation.folder.path, run.endpoint, options.access, options.record)
            )
            return await run.run(on_state, on_missing)


def _lease_ms(scenario: Scenario) -> int:
    """How long nothing may be heard of a process; in real time a planned pause is not to end its connection."""
    if scenario.run.pacing == "lockstep":
        return LEASE_MS
    pauses_s = [fault.duration_s for fault in scenario.fault if fault.kind == "pause"]
    return REALTIME_LEASE_MS + round(1000 * max(pauses_s, default=0.0))


class LiveRun:
    """One live run: its attachment, its processes and its pacing."""

    def __init__(
        self,
        emulation: Emulation,
        options: LiveOptions,
        launcher: Launcher,
        before_horizon: HorizonCallback = _open,
    ) -> None:
        self._emulation = emulation
        self._options = options
        self._launcher = launcher
        self._gate = before_horizon
        self._loop = asyncio.get_running_loop()
        self._name = options.access.run
        self._realtime = emulation.scenario.run.pacing == "realtime"
        later = [node for node, up in emulation.up.items() if not up]
        self._members = Membership(emulation.world.node_ids, later, emulation.world.has_traffic)
        self._pacing: Lockstep | RealTime | None = None
        self._origin_ns = 0
        self._incoming: deque[tuple[str, bytes | bool | zenoh.Query]] = deque()
        self._wake_pending = False
        self._over = False
        self._changed = asyncio.Event()
        self._dead: dict[str, dict[str, Any]] = {}
        self._returning: set[str] = set()  # nodes whose processes faults have ended, or who have left
        self._connected: set[str] = set()  # nodes whose processes are connected
        self._going: set[asyncio.Task[None]] = set()  # what sees them off (real time)
        self._expected: set[str] = set()  # leads of processes that were started anew (real time)
        self._paused: set[str] = set()
        self._restarting = False
        self._join_failure: VnetError | None = None
        self._standing: dict[str, str] = {}
        self._refused: dict[str, int] = {}
        self._messages = Messages(emulation)
        self._watched = True  # from the first period on, by a recorder of the run's own
        self._memory = MemoryWatch(emulation.duration_ns)
        self._seen = Course(emulation)
        lease_ms = _lease_ms(emulation.scenario)
        self._attachment = Attachment(
            options, emulation.world.node_ids, lease_ms, self._realtime, self._intake, self._intake, self._intake
        )
        self._attachment.open()

    @property
    def endpoint(self) -> str:
        """Where agents and operators connect."""
        return self._attachment.endpoint

    def close(self) -> None:
        """Close what is open to the world."""
        self._attachment.close()

    # Zenoh's threads: append, and wake the loop once.

    def _intake(self, name: str, item: bytes | bool | zenoh.Query) -> None:
        self._incoming.append((name, item))
        if not self._wake_pending and not self._over:
            self._wake_pending = True
            self._loop.call_soon_threadsafe(self._drain)

    # The loop.

    def _drain(self) -> None:
        self._wake_pending = False
        while self._incoming and not self._over:
            node, item = self._incoming.popleft()
            if isinstance(item, bool):
                if item:
                    self._connected.add(node)
                else:
                    self._connected.discard(node)
                    self._token_lost(node)
                    self._changed.set()
                continue
            if isinstance(item, zenoh.Query):
                self._answer(node, item)
                continue
            try:
                self._take(node, wire.decode_tx(item))
            except (WireError, ProtocolError) as error:
                self._refuse(node, str(error))

    def _answer(self, verb: str, query: zenoh.Query) -> None:
        """Answer an operator, with an error in one line if need be."""
        payload = b"" if query.payload is None else query.payload.to_bytes()
        own_router = self._options.router is not None
        with query:
            try:
                told = answer(self._emulation, self._seen, verb, payload, self._time_ns(), own_router)
                query.reply(query.key_expr, json.dumps(told))
            except VnetError as error:
                query.reply_err(str(error))
        self._changed.set()

    def _take(self, node: str, message: wire.AgentMessage) -> None:
        if isinstance(message, wire.Hello):
            self._hello(node, message)
        elif not self._members.speaks_for(node, message.nonce):
            self._refuse(node, "a message without the nonce of its process")
        elif isinstance(message, wire.StackDump):
            self._standing[node] = message.text
        elif isinstance(message, wire.Yield) and isinstance(self._pacing, Lockstep):
            self._pacing.receive(node, message)
            if not self._pacing.owed:
                self._changed.set()
        elif isinstance(message, wire.Frames) and isinstance(self._pacing, RealTime):
            self._pacing.receive(self._time_ns(), node, message)
            self._changed.set()
        else:
            self._refuse(node, f"an unexpected {type(message).__name__}")

    def _refuse(self, node: str, reason: str) -> None:
        """Count what is not understood, and log its first appearance with its key."""
        key = keys.node_tx(self._name, node)
        if key not in self._refused:
            self._emulation.folder.event(self._time_ns(), "refused", node, key=key, reason=reason)
        self._refused[key] = self._refused.get(key, 0) + 1

    def _hello(self, node: str, hello: wire.Hello) -> None:
        refusal = self._members.hello(node, hello)
        if refusal is not None:
            self._refuse(node, refusal)
            if self._attachment.knows(node):
                self._attachment.send(node, wire.End(hello.nonce, refusal, refused=True))
            return
        if hello.failure is not None:
            self._join_failure = ProgramError(f"{node}: {hello.failure}")
        elif not hello.ready:
            self._attachment.send(node, self._emulation.welcome(node, hello.nonce))
        self._changed.set()

    def _time_ns(self) -> int:
        """Emulated time for the event log."""
        if isinstance(self._pacing, Lockstep):
            return self._pacing.now_ns
        return max(self._now_ns(), 0) if self._pacing is not None else 0

    def _now_ns(self) -> int:
        return time.monotonic_ns() - self._origin_ns

    # Processes that end, or whose connection does.

    def _watch_children(self) -> Callable[[], object]:
        """Have `_children_ended` called from now on; returns what ends that."""
        if _gets_signals():
            self._loop.add_signal_handler(signal.SIGCHLD, self._children_ended)
            return lambda: self._loop.remove_signal_handler(signal.SIGCHLD)
        return self._loop.create_task(self._poll_children()).cancel

    async def _poll_children(self) -> None:
        while True:
            self._children_ended()
            await asyncio.sleep(CHILDREN_POLL_S)

    def _children_ended(self) -> None:
        for name, how in self._launcher.ended().items():
            self._loop.call_later(DEATH_GRACE_S, self._process_ended, name, how)

    def _process_ended(self, name: str, how: Exit) -> None:
        if not self._attachment.knows(name):
            self._emulation.folder.event(self._time_ns(), "observer_ended", name, how=how.how)
        elif self._pacing is None:
            last = how.log_tail.splitlines()[-1:] or ["its log is empty"]
            self._join_failure = VnetError(f"agent {name} ended before the start ({how.how}): {last[0]}")
            self._changed.set()
        else:
            self._process_dead(name, how=how.how, log_tail=how.log_tail)

    def _token_lost(self, node: str) -> None:
        if node in self._members.later:
            self._members.expect([node])
            return
        away = self._restarting or node in self._returning
        if away or node not in self._members.joined or node in self._launcher.pids:
            return
        if self._pacing is None:
            self._members.leave(node)
        elif not self._options.launch and self._members.lead_of(node) == node:
            details = {"how": "its connection closed", "process": self._members.describe(node)}
            self._loop.call_later(DEATH_GRACE_S, lambda: self._process_dead(node, **details))

    def _process_dead(self, process_id: str, **details: Any) -> None:
        self._dead[process_id] = details
        if isinstance(self._pacing, RealTime):
            self._pacing.died(self._now_ns(), process_id, **self._dead.pop(process_id))
        self._changed.set()

    # The course of a run.

    async def run(
        self, on_state: Callable[[str], None], on_missing: Callable[[Sequence[str]], None]
    ) -> tuple[float, bool]:
        """Join, run, end. Returns the wall-clock seconds between time 0 and the end, and whether interrupted."""
        watching = self._watch_children()
        folder = self._emulation.folder
        started = time.monotonic()
        patience_s = 0.5
        interrupted = False
        try:
            await self._join(on_state, on_missing)
            folder.event(0, "started", start_up_s=round(time.monotonic() - started, 3))
            self._emulation.watch(self._publish_period)
            self._emulation.watch(self._look_at_memory)
            gc.freeze()  # what is loaded stays: it need not be searched for garbage again and again
            started = time.monotonic()
            await self._course()
            patience_s = FAREWELL_S * 5
        except Stalled:
            self._emulation.finish(self._time_ns())
        except asyncio.CancelledError:
            interrupted = True
            folder.event(self._time_ns(), "interrupted")
            self._emulation.finish(self._time_ns())
        finally:
            wall_s = time.monotonic() - started
            self._stand_still(set())
            await self._shut_down(patience_s)
            self._memory.write(folder, self._time_ns())
            for key, count in self._refused.items():
                folder.event(self._time_ns(), "refused_total", key=key, count=count)
            watching()
            self._over = True
        return wall_s, interrupted

    async def _join(self, on_state: Callable[[str], None], on_missing: Callable[[Sequence[str]], None]) -> None:
        """Start what is to be started and wait until every node is ready."""
        run = self._emulation.scenario.run
        node_ids = self._emulation.world.node_ids
        groups = split_into_processes(node_ids, run.nodes_per_process)
        groups = [nodes for nodes in groups if nodes[0] not in self._members.later]
        endpoint = self._attachment.endpoint
        deadline = time.monotonic() + run.join_timeout_s
        if self._options.record is not None:
            self._start_recorder(endpoint, self._options.record)
        if self._options.launch:
            on_state(f"listening at {endpoint}; starting {len(groups)} agent processes")
            for nodes in groups:
                self._launch(nodes)
        else:
            on_state(f"listening at {endpoint}; waiting for {len(node_ids) - len(self._members.later)} vehicles")
        missing: list[str] = []
        while self._members.missing or not self._recorder_listens():
            if missing != self._members.missing:
                missing = self._members.missing
                self._tell_missing(missing, on_missing)
            if self._join_failure is not None:
                raise self._join_failure
            if time.monotonic() > deadline:
                raise TransportError(self._who_is_missing(run.join_timeout_s))
            await self._change(0.05 if self._options.record else deadline - time.monotonic())
        self._members.closed = True
        self._tell_missing([], on_missing)

    def _tell_missing(self, nodes: Sequence[str], on_missing: Callable[[Sequence[str]], None]) -> None:
        self._seen.awaits(nodes)
        on_missing(nodes)

    def _launch(self, nodes: Sequence[str]) -> None:
        nice = REALTIME_AGENT_NICE if self._realtime else 0
        self._launcher.start_agent(self._attachment.endpoint, self._options.access, nodes, nice)

    def _start_recorder(self, endpoint: str, sinks: Sinks) -> None:
        arguments = ["-P", "-m", "emulator.cli", "record", "--connect", endpoint, "--run", self._name]
        arguments += ["--out", str(sinks.save), *sinks.arguments]
        environment = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        credentials = self._options.access.credentials(OBSERVER)
        self._launcher.start(RECORDER, arguments, credentials, environment, own_session=True)

    def _recorder_listens(self) -> bool:
        return self._options.record is None or self._attachment.is_watched("period")

    def _who_is_missing(self, timeout_s: float) -> str:
        missing = self._members.missing or ["the recorder"]
        shown = ", ".join(missing[:8]) + (", …" if len(missing) > 8 else "")
        total = len(self._emulation.world.node_ids)
        return f"{len(missing)} of {total} nodes have not joined within {timeout_s:g} s: {shown}"

    async def _change(self, timeout_s: float) -> bool:
        """Wait for a change of state; False if none came in time."""
        self._changed.clear()
        try:
            async with asyncio.timeout(max(timeout_s, 0)):
                await self._changed.wait()
        except TimeoutError:
            return False
        return True

    async def _course(self) -> None:
        processes = self._members.processes()
        self._attachment.publish("scene", self._messages.scene())
        if self._emulation.scenario.run.pacing == "lockstep":
            self._pacing = lockstep = Lockstep(self._emulation, processes)
            await self._run_lockstep(lockstep)
        else:
            self._pacing = realtime = RealTime(self._emulation, processes)
            await self._run_realtime(realtime)

    async def _run_lockstep(self, lockstep: Lockstep) -> None:
        await self._gate(lockstep)
        grants = lockstep.start()
        while grants:
            for actions in lockstep.take_actions():
                await self._apply_process_faults(actions)
            for process_id, grant in grants.items():
                self._attachment.send(process_id, grant)
            await self._all_yielded(lockstep)
            grants = lockstep.step()
            while lockstep.held:
                await self._gate(lockstep)
                grants = lockstep.step()
        for process_id in sorted(self._dead):
            lockstep.died(process_id, **self._dead[process_id])

    # Faults of processes.

    async def _apply_process_faults(self, actions: ProcessActions) -> None:
        """Do to the processes what the faults of an instant do."""
        ended = {self._members.lead_of(node): killed for node, killed in actions.stop.items()}
        for process_id, killed in ended.items():
            await self._end_process(process_id, killed)
        started = list(dict.fromkeys(map(self._members.lead_of, actions.start)))
        for process_id in started:
            self._begin_process(process_id)
        if isinstance(self._pacing, Lockstep) and started:
            await self._returned(started)
        elif started:
            self._expected.update(started)
        self._stand_still({self._members.lead_of(node) for node in actions.paused})
        for fault in actions.restarts:
            await self._restart_link(fault)

    def _stand_still(self, process_ids: set[str]) -> None:
        """Stop the processes that are paused, and let the others go on. In lockstep it is enough not to grant."""
        if self._realtime:
            for process_id in sorted(self._paused - process_ids):
                self._launcher.signal(process_id, signal.SIGCONT)
            for process_id in sorted(process_ids - self._paused):
                self._launcher.signal(process_id, signal.SIGSTOP)
        self._paused = process_ids

    def _welcome_back(self, realtime: RealTime) -> None:
        """Real time: start what has come back."""
        missing = set(self._members.missing)
        for process_id in sorted(self._expected):
            if not missing & set(self._members.nodes_with(process_id)):
                self._expected.discard(process_id)
                self._returning.difference_update(self._members.nodes_with(process_id))
                self._attachment.send(process_id, realtime.returned(self._now_ns(), process_id))

    async def _end_process(self, process_id: str, killed: bool) -> None:
        """End a process; those started by hand are told to go, and whoever started them may again."""
        self._returning.update(self._members.nodes_with(process_id))
        self._expected.discard(process_id)
        if killed and self._options.launch:
            self._paused.discard(process_id)
            self._launcher.kill(process_id)
            return
        self._stand_still(self._paused - {process_id})  # or it could not go
        reason = "it has left" if self._emulation.has_left(process_id) else "restarted by a fault"
        self._attachment.send(process_id, wire.End(None, "killed by a fault" if killed else reason))
        if self._options.launch:
            going = asyncio.create_task(asyncio.to_thread(self._launcher.detach(process_id), FAREWELL_S))
            if self._realtime:  # nobody waits for it
                self._going.add(going)
                going.add_done_callback(self._going.discard)
            else:
                await going

    def _begin_process(self, process_id: str) -> None:
        nodes = self._members.nodes_with(process_id)
        if process_id in self._members.later:
            if self._members.enter(process_id):
                return
        else:
            self._members.expect(nodes)
        if self._options.launch:
            self._launch(nodes)

    async def _returned(self, process_ids: Sequence[str]) -> None:
        """Wait until processes that start anew are there again. Raises Stalled if they are not in time."""
        timeout_s = self._emulation.scenario.run.join_timeout_s
        deadline = time.monotonic() + timeout_s
        nodes = [node for process_id in process_ids for node in self._members.nodes_with(process_id)]
        while late := self._late(nodes):
            if not await self._change(deadline - time.monotonic()):
                error = f"has not come back within {timeout_s:g} s"
                self._emulation.folder.event(self._time_ns(), "stalled", late[0], error=error)
                raise Stalled
        self._returning.difference_update(nodes)

    def _late(self, nodes: Sequence[str]) -> list[str]:
        """Those of `nodes` that are not there yet, and may still come."""
        missing = set(self._members.missing)
        return [node for node in nodes if node in missing and self._members.lead_of(node) not in self._dead]

    async def _restart_link(self, fault: Infrastructure) -> None:
        """Take the emulator's connection (or the separate router) down and up again; the agents are told first."""
        patience_s = fault.down_s + self._emulation.scenario.run.join_timeout_s
        # The emulation may be ahead: who is up there again need not have been started yet.
        up = [node for node in self._emulation.world.node_ids if self._emulation.up[node]]
        living = [node for node in up if node not in self._returning]
        for node in living:
            self._attachment.send(node, wire.Await(patience_s))
        await asyncio.sleep(AWAIT_WARNING_S)
        self._restarting = True
        if isinstance(fault, EmulatorRestart):
            await asyncio.to_thread(self._attachment.close)
            await asyncio.sleep(fault.down_s)
            await asyncio.to_thread(self._attachment.open)
        else:
            self._launcher.kill(ROUTER)
            await asyncio.sleep(fault.down_s)
            assert self._options.router is not None
            await asyncio.to_thread(self._options.router.start, self._launcher)
        process_ids = {self._members.lead_of(node) for node in living}
        if self._realtime:
            process_ids -= self._paused  # they cannot answer, and have time until they go on
        await self._all_answer(sorted(process_ids), patience_s)
        self._restarting = False
        self._emulation.folder.event(self._time_ns(), f"{fault.kind}ed", None, down_s=fault.down_s)

    async def _all_answer(self, process_ids: Sequence[str], patience_s: float) -> None:
        """Wait until each process has answered: only then do messages pass in both directions again."""
        self._standing.clear()
        deadline = time.monotonic() + patience_s
        while silent := [
            process_id
            for process_id in process_ids
            if process_id not in self._standing and process_id not in self._dead
        ]:
            if time.monotonic() > deadline:
                error = f"has not found the emulator again within {patience_s:g} s"
                self._emulation.folder.event(self._time_ns(), "stalled", silent[0], error=error)
                raise Stalled
            for process_id in silent:
                self._attachment.send(process_id, wire.StackRequest())
            await asyncio.sleep(REJOIN_POLL_S)
        self._standing.clear()

    async def _all_yielded(self, lockstep: Lockstep) -> None:
        stall_timeout_s = self._emulation.scenario.run.stall_timeout_s
        while lockstep.owed:
            for process_id in sorted(self._dead.keys() & lockstep.owed):
                lockstep.died(process_id, **self._dead.pop(process_id))
            if lockstep.owed and not await self._change(stall_timeout_s):
                await self._stall(sorted(lockstep.owed), stall_timeout_s)

    async def _stall(self, process_ids: list[str], timeout_s: float) -> None:
        """Ask those who do not yield where they stand, write it down and give up."""
        for process_id in process_ids:
            self._attachment.send(process_id, wire.StackRequest())
            self._launcher.request_stack(process_id)
        await asyncio.sleep(STANDING_WAIT_S)
        for process_id in process_ids:
            where = self._standing.get(process_id) or self._launcher.log_tail(process_id)
            self._emulation.folder.event(
                self._time_ns(),
                "stalled",
                process_id,
                error=f"no yield within {timeout_s:g} s of wall clock; {self._members.describe(process_id)}",
                where=where,
            )
        raise Stalled

    async def _run_realtime(self, realtime: RealTime) -> None:
        self._origin_ns = time.monotonic_ns() + wire.HEAD_START_NS
        duration_ns = self._emulation.duration_ns
        for process_id, batch in realtime.start(self._origin_ns).items():
            self._attachment.send(process_id, batch)
        await asyncio.sleep(wire.HEAD_START_NS / 1e9)
        while (now_ns := self._now_ns()) < duration_ns:
            batches = realtime.due(now_ns)
            for actions in realtime.take_actions():
                await self._apply_process_faults(actions)
            for process_id, batch in batches.items():
                self._attachment.send(process_id, batch)
            self._welcome_back(realtime)
            next_ns = min(realtime.next_time_ns() or duration_ns, duration_ns)
            await self._change((next_ns - self._now_ns()) / 1e9)

    async def _shut_down(self, patience_s: float) -> None:
        """Tell everybody that it is over, hear last words, and see every process off."""
        for node in self._members.joined:
            self._attachment.send(node, wire.End(None, "the run is over"))
        deadline = time.monotonic() + FAREWELL_S
        if isinstance(self._pacing, RealTime):
            while not self._pacing.all_final and await self._change(deadline - time.monotonic()):
                pass
            self._pacing.finish()
            await asyncio.gather(*self._going)
        if not self._options.launch:  # who closes at once may take the last words along
            while self._connected and await self._change(deadline - time.monotonic()):
                pass
        self._attachment.publish("end", self._messages.end())
        if self._options.record is not None:
            self._launcher.wait_for(RECORDER, RECORDER_WAIT_S if patience_s > FAREWELL_S else 0.5)
        self._launcher.stop(patience_s)

    # Those who watch.

    def _look_at_memory(self, view: PeriodView) -> None:
        processes = {**self._launcher.pids, EMULATOR_PROCESS: os.getpid()}
        self._memory.look(view.instant.time_ns, processes)

    def _publish_period(self, view: PeriodView) -> None:
        """Tell who watches. A message is of a whole period: who comes within one hears of the next."""
        was_watched, self._watched = self._watched, self._attachment.is_watched("period")
        if not self._watched:
            return
        if not was_watched or view.instant.period % SCENE_EVERY_PERIODS == 0:  # for those who come late
            self._attachment.publish("scene", self._messages.scene())
        if was_watched:
            self._attachment.publish("period", self._messages.period(view))
        else:
            self._messages.begin()
