"""One live run: `run_live` joins its parts and drives it to the end.

It opens the emulator's session (an embedded router, or a client of a separate one), starts the agents or waits for
those started by hand, runs the pacing to the end, and leaves no process and no signal handler behind.
"""

from __future__ import annotations

import asyncio
import gc
import json
import sys
import time
from collections.abc import Callable, Coroutine, Mapping, Sequence
from contextlib import ExitStack, nullcontext
from typing import Any

import zenoh

from emulator.drivers.attachment import Attachment, LiveOptions
from emulator.drivers.control import answer, control_endpoint
from emulator.drivers.cpu_watch import CpuWatch
from emulator.drivers.debugging import debug_point
from emulator.drivers.emulation import Emulation, PeriodView
from emulator.drivers.join import Membership
from emulator.drivers.launch import Launcher
from emulator.drivers.live.driver import Driver, Parts
from emulator.drivers.live.fleet import Fleet
from emulator.drivers.live.inbox import Inbox, Refusals
from emulator.drivers.live.joining import RECORDER, Joining
from emulator.drivers.live.lockstep_driver import LockstepDriver
from emulator.drivers.live.observer_feed import ObserverFeed
from emulator.drivers.live.realtime_driver import RealTimeDriver
from emulator.drivers.live.reconnection import Reconnection
from emulator.drivers.live.supervisor import SHUT_DOWN_S, Supervisor
from emulator.drivers.live.waiting import ChangeSignal, Stalled
from emulator.drivers.lockstep import HorizonCallback, no_horizon
from emulator.drivers.memory import MemoryWatch, first_over
from emulator.drivers.signals import cancelled_by_signals
from emulator.drivers.status import Course
from emulator.drivers.zygote import AGENT_ENVIRONMENT, LOCKSTEP_ENVIRONMENT, Zygote
from emulator.records.code_digest import entries_of
from emulator.records.events import EventKind
from emulator.scenario.scenario import Scenario
from vnet.errors import VnetError
from vnet.transport import wire
from vnet.transport.scheduling import DEFAULT_SLICE, PROMPT_SLICE_NS, preempting_nobody, set_time_slice

LEASE_MS = 60_000
"""Milliseconds. Long: a starved machine must not look like a dead one, and a closed connection is seen at once."""
PATIENCE_S = 0.5
"""Seconds for which a run that did not come to its end waits for its processes to end by themselves."""
FULL_PATIENCE_S = 5.0
"""Seconds for which a run that came to its end waits for processes that others have started."""
END_LIMIT_S = 30.0
"""Seconds for which it waits for those that it has started. Long: one that has not ended by then never does."""
RECORDER_WAIT_S = 20.0
"""Seconds for which a run that came to its end waits for its recorder to write all down."""
MEMORY_LOOK_S = 0.2
"""Seconds of wall clock after which processes are compared with `run.memory_limit_mb` again."""


async def run_live(
    emulation: Emulation,
    options: LiveOptions,
    on_state: Callable[[str], None] = lambda text: None,
    before_horizon: HorizonCallback = no_horizon,
    on_missing: Callable[[Sequence[str]], None] = lambda nodes: None,
    on_open: Callable[[], None] = lambda: None,
) -> tuple[float, bool]:
    """Run `emulation` to its end over Zenoh; returns the wall-clock seconds, and whether it was interrupted.

    Ctrl-C and SIGTERM end the run early, with the event `interrupted`; afterwards both are handled as before.
    Raises VnetError if it cannot start. `before_horizon` holds a run in lockstep. `on_missing` is called with the
    nodes that have not joined, whenever they change; `on_open` once the emulator's endpoint is open, and may make
    the run's folder.
    """
    with ExitStack() as stack:
        zygote = _zygote(emulation.scenario) if options.launch and not options.access.hosts else None
        scenario = emulation.scenario
        launcher = Launcher(emulation.folder.logs, scenario.program.folders, zygote, scenario.run.join_timeout_s)
        launcher.agent_environment = _agent_environment(scenario)
        stack.callback(launcher.stop)
        if emulation.scenario.run.pacing == "realtime":
            set_time_slice(PROMPT_SLICE_NS)
            stack.callback(set_time_slice, DEFAULT_SLICE)
        async with cancelled_by_signals():
            launcher.prepare()
            if options.router is not None:
                options.router.start(launcher)
            session = LiveSession(emulation, options, launcher, before_horizon)
            stack.callback(session.close)
            on_open()
            launcher.debug = stack.enter_context(debug_point(options.debug))
            launcher.logs, launcher.disks = emulation.folder.logs, emulation.folder.disks
            stack.enter_context(
                control_endpoint(emulation.folder.path, session.endpoint, options.access, options.record)
            )
            return await session.run(on_state, on_missing)


def _zygote(scenario: Scenario) -> Zygote | None:
    """The process from which agents are forked, if they are to be, and this system can."""
    if scenario.run.start == "spawn" or sys.platform != "linux":
        return None
    return Zygote([entry.partition(":")[0] for entry in entries_of(scenario)], _agent_environment(scenario))


def _agent_environment(scenario: Scenario) -> Mapping[str, str]:
    return LOCKSTEP_ENVIRONMENT if scenario.run.pacing == "lockstep" else AGENT_ENVIRONMENT


def _lease_ms(scenario: Scenario) -> int:
    """Milliseconds without a message after which a connection ends; a planned pause must not end it."""
    pauses_s = [fault.duration_s for fault in scenario.fault if fault.kind == "pause"]
    return LEASE_MS + round(1000 * max(pauses_s, default=0.0))


class LiveSession:
    """The parts of one live run, and its course: join, drive, shut down."""

    def __init__(
        self,
        emulation: Emulation,
        options: LiveOptions,
        launcher: Launcher,
        before_horizon: HorizonCallback,
    ) -> None:
        node_ids = emulation.world.node_ids
        realtime = emulation.scenario.run.pacing == "realtime"
        later = [node for node, up in emulation.up.items() if not up]
        self._emulation = emulation
        self._in_lockstep = not realtime
        self._options = options
        self._launcher = launcher
        self._before_horizon = before_horizon
        self._driver: Driver | None = None
        self._status = Course(emulation)
        self._memory = MemoryWatch(emulation.duration_ns)
        self._cpu = CpuWatch()
        self._changes = ChangeSignal()
        self._members = Membership(node_ids, later, emulation.world.has_traffic)
        self._refusals = Refusals(options.access.run, emulation.folder, self._time_ns)
        self._inbox = Inbox(
            self._members, self._refusals, self._changes, on_disconnected=self._disconnected, on_query=self._answer
        )
        self._attachment = Attachment(
            options,
            node_ids,
            _lease_ms(emulation.scenario),
            realtime,
            self._inbox.put_message,
            self._inbox.put_token,
            self._inbox.put_query,
            self._inbox.put_host_message,
            self._inbox.put_host_token,
            self._inbox.put_backbone,
        )
        self._fleet = self._make_fleet() if options.access.hosts else None
        agents = self._fleet or launcher
        self._feed = ObserverFeed(emulation, self._attachment)
        self._supervisor = Supervisor(
            launcher=launcher,
            agents=agents,
            members=self._members,
            attachment=self._attachment,
            options=options,
            folder=emulation.folder,
            time_ns=self._time_ns,
            changes=self._changes,
            realtime=realtime,
        )
        self._joining = Joining(
            emulation=emulation,
            members=self._members,
            supervisor=self._supervisor,
            launcher=launcher,
            agents=agents,
            attachment=self._attachment,
            options=options,
            refusals=self._refusals,
            changes=self._changes,
        )
        self._inbox.handlers[wire.Hello] = self._joining.take_hello
        if self._fleet is not None:
            self._fleet.on_ended, self._fleet.on_lost = self._supervisor.child_ends, self._supervisor.host_lost
        self._attachment.open()

    def _make_fleet(self) -> Fleet:
        """The hosts, between the attachment and the inbox."""
        scenario, attachment, inbox = self._emulation.scenario, self._attachment, self._inbox
        fleet = Fleet(
            self._options.access,
            self._emulation.folder,
            scenario,
            self._emulation.duration_ns,
            attachment.send_host,
            self._time_ns,
            lambda: self._supervisor.reconnecting,
            self._changes,
        )
        attachment.to_hosted, attachment.to_hosted_unit = fleet.send, fleet.send_content
        inbox.on_host_message, inbox.on_host_token = fleet.take, fleet.take_token
        fleet.on_message, fleet.on_token = inbox.take_message, inbox.take_token
        fleet.on_backbone = inbox.take_backbone
        return fleet

    @property
    def endpoint(self) -> str:
        """Endpoint to which agents and operators connect."""
        return self._attachment.endpoint

    def close(self) -> None:
        """Close what is open to the world."""
        self._attachment.close()

    async def run(
        self, on_state: Callable[[str], None], on_missing: Callable[[Sequence[str]], None]
    ) -> tuple[float, bool]:
        """Join, run, end. Returns the wall-clock seconds between time 0 and the end, and whether interrupted."""
        with self._supervisor.watching_children():
            try:
                return await self._run(on_state, on_missing)
            finally:
                self._inbox.close()

    async def _run(
        self, on_state: Callable[[str], None], on_missing: Callable[[Sequence[str]], None]
    ) -> tuple[float, bool]:
        folder = self._emulation.folder
        started_s = time.monotonic()
        completed = interrupted = False

        def tell_missing(nodes: Sequence[str]) -> None:
            self._status.awaits(nodes)
            on_missing(nodes)

        try:
            processes = await self._joining.join(on_state, tell_missing)
            folder.event(0, EventKind.started, start_up_s=round(time.monotonic() - started_s, 3))
            self._emulation.watch(self._feed.period)
            self._emulation.watch(self._look_at_processes)
            self._measure_cpu()
            gc.freeze()  # what is loaded stays: it need not be searched for garbage again and again
            started_s = time.monotonic()
            self._feed.begin()
            self._driver = self._make_driver(processes)
            with preempting_nobody() if self._in_lockstep else nullcontext():
                await self._within_memory(self._driver.run())
            completed = True
        except Stalled:
            self._emulation.finish(self._time_ns())
        except asyncio.CancelledError:
            interrupted = True
            folder.event(self._time_ns(), EventKind.interrupted)
            self._emulation.finish(self._time_ns())
        finally:
            wall_s = time.monotonic() - started_s
            self._measure_cpu()
            await self._shut_down(completed)
            in_all_ns = self._cpu.cpu_ns if self._fleet is None else self._cpu.cpu_ns + self._fleet.cpu_ns
            self._emulation.costs.take_processes(in_all_ns)
            self._memory.write(folder, self._time_ns())
            self._refusals.write_totals()
        return wall_s, interrupted

    async def _within_memory(self, running: Coroutine[Any, Any, None]) -> None:
        """Await the run; raise Stalled, with an event, as soon as a process exceeds `run.memory_limit_mb`."""
        limit_mb = self._emulation.scenario.run.memory_limit_mb
        if limit_mb is None:
            return await running
        run, nodes = asyncio.ensure_future(running), frozenset(self._emulation.world.node_ids)
        exceeded: list[tuple[str, float]] = []
        if self._fleet is not None:
            self._fleet.on_memory = lambda *over: exceeded.append(over)
        try:
            while not (await asyncio.wait([run], timeout=MEMORY_LOOK_S))[0]:
                if self._fleet is not None:
                    self._fleet.look(self._time_ns())
                pids = {name: pid for name, pid in self._launcher.pids.items() if name in nodes}
                if over := exceeded[0] if exceeded else first_over(limit_mb, pids):
                    self._emulation.memory_exceeded(self._time_ns(), *over, self._members.nodes_with(over[0]))
                    raise Stalled
        finally:
            run.cancel()
            await asyncio.wait([run])
        return run.result()

    def _make_driver(self, processes: Sequence[Sequence[str]]) -> Driver:
        reconnection = Reconnection(
            emulation=self._emulation,
            members=self._members,
            supervisor=self._supervisor,
            launcher=self._launcher,
            attachment=self._attachment,
            options=self._options,
            inbox=self._inbox,
            time_ns=self._time_ns,
        )
        parts = Parts(
            emulation=self._emulation,
            members=self._members,
            supervisor=self._supervisor,
            agents=self._fleet or self._launcher,
            attachment=self._attachment,
            inbox=self._inbox,
            reconnection=reconnection,
            changes=self._changes,
            debugged=None if self._options.debug is None else self._options.debug.node,
        )
        if self._in_lockstep:
            return LockstepDriver(parts, processes, self._before_horizon)
        return RealTimeDriver(parts, processes)

    async def _shut_down(self, completed: bool) -> None:
        """Tell all that the run is over, take their last messages, and wait until every process has ended."""
        self._supervisor.pause(())
        for node in self._members.joined:
            self._attachment.send(node, wire.End(None, "the run is over"))
        self._supervisor.all_told_to_end()
        patience_s = (END_LIMIT_S if self._options.launch else FULL_PATIENCE_S) if completed else PATIENCE_S
        deadline_s = time.monotonic() + (patience_s if completed else SHUT_DOWN_S)
        if self._driver is not None:
            await self._driver.finish(deadline_s)
        if not self._options.launch:  # whoever closes at once may take the last messages along
            while self._inbox.connected and await self._changes.wait(deadline_s - time.monotonic()):
                pass
        if self._fleet is not None:
            await self._fleet.hand_in(patience_s)
        self._feed.end()
        if self._options.record is not None:
            self._launcher.wait_for(RECORDER, RECORDER_WAIT_S if completed else PATIENCE_S)
        ends = self._launcher.stop(patience_s)
        for process_id, details in self._supervisor.take_last_deaths(ends).items() if completed else ():
            for node in self._members.nodes_with(process_id):
                self._emulation.folder.event(self._emulation.duration_ns, EventKind.died, node, **details)

    def _time_ns(self) -> int:
        """Emulated time for events; 0 before the start."""
        return 0 if self._driver is None else self._driver.time_ns

    def _disconnected(self, node: str) -> None:
        self._supervisor.disconnected(node)

    def _answer(self, verb: str, query: zenoh.Query) -> None:
        """Answer an operator, with an error in one line if need be."""
        payload = b"" if query.payload is None else query.payload.to_bytes()
        own_router = self._options.router is not None
        with query:
            try:
                now_ns = 0 if self._driver is None else self._driver.decided_ns
                answered = answer(self._emulation, self._status, verb, payload, now_ns, own_router)
                query.reply(query.key_expr, json.dumps(answered))
            except VnetError as error:
                query.reply_err(str(error))

    def _measure_cpu(self) -> None:
        self._cpu.look(self._launcher.pids)
        if self._fleet is not None:
            self._fleet.look(self._time_ns())

    def _look_at_processes(self, view: PeriodView) -> None:
        self._cpu.look(self._launcher.pids)
        if self._fleet is not None:
            self._fleet.look(view.instant.time_ns)
        self._memory.look(view.instant.time_ns, self._launcher.pids)
