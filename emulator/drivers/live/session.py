"""One live run: `run_live` opens it to the world and drives it to the end.

It opens the emulator's session (an embedded router, or a client of a separate one), starts the agents or waits for
those started by hand, runs the pacing to the end, and leaves no process and no signal handler behind.
"""

from __future__ import annotations

import asyncio
import gc
import json
import time
from collections.abc import Callable, Coroutine, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from typing import Any

import zenoh

from emulator.drivers.attachment import LiveOptions
from emulator.drivers.control import answer, control_endpoint
from emulator.drivers.debugging import debug_point
from emulator.drivers.emulation import Emulation, PeriodView
from emulator.drivers.launch import AGENT_ENVIRONMENT, LOCKSTEP_ENVIRONMENT, Launcher, Zygote, can_fork
from emulator.drivers.live.processes import RECORDER, LiveProcesses, to_its_end
from emulator.drivers.live.supervisor import SHUT_DOWN_S
from emulator.drivers.lockstep import HorizonCallback, Lockstep, no_horizon, run_in_lockstep
from emulator.drivers.observers import Messages
from emulator.drivers.processes import Stalled
from emulator.drivers.realtime import RealTime, run_in_real_time
from emulator.drivers.signals import cancelled_by_signals
from emulator.drivers.status import Course
from emulator.drivers.usage import CpuWatch, MemoryWatch, first_over
from emulator.records.code_digest import entries_of
from emulator.records.events import EventKind
from emulator.scenario.scenario import Scenario
from vnet.errors import VnetError
from vnet.runtime.outside_loop import is_frozen
from vnet.transport.scheduling import DEFAULT_SLICE, PROMPT_SLICE_NS, preempting_nobody, set_time_slice

PATIENCE_S = 0.5
"""Seconds for which a run that did not come to its end waits for its processes to end by themselves."""
FULL_PATIENCE_S = 5.0
"""Seconds for which a run that came to its end waits for processes that others have started."""
END_LIMIT_S = 30.0
"""Seconds for which it waits for those that it has started. Long: one that has not ended by then never does."""
RECORDER_WAIT_S = 20.0
"""Seconds for which a run that came to its end waits for its recorder to write all down."""
SCENE_EVERY_PERIODS = 50
"""Periods between two messages with the scene, for observers that come late."""
LOGS_LOOK_S = 0.2
"""Seconds between two looks whether a log is full."""
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
        forks = options.launch and not options.access.hosts and not options.agent
        zygote = _zygote(emulation.scenario) if forks else None
        scenario = emulation.scenario
        launcher = Launcher(emulation.folder.logs, scenario.program.folders, zygote, scenario.run.join_timeout_s)
        launcher.agent_environment = _agent_environment(scenario)
        launcher.agent_command = options.agent
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
    if scenario.run.start == "spawn" or not can_fork() or scenario.has_gateways:
        return None
    return Zygote([entry.partition(":")[0] for entry in entries_of(scenario)], _agent_environment(scenario))


def _agent_environment(scenario: Scenario) -> Mapping[str, str]:
    return LOCKSTEP_ENVIRONMENT if scenario.run.pacing == "lockstep" else AGENT_ENVIRONMENT


class LiveSession:
    """One live run's course: join, drive, shut down."""

    def __init__(
        self, emulation: Emulation, options: LiveOptions, launcher: Launcher, before_horizon: HorizonCallback
    ) -> None:
        self._emulation = emulation
        self._options = options
        self._launcher = launcher
        self._before_horizon = before_horizon
        self._pacing: Lockstep | RealTime | None = None
        self._status = Course(emulation)
        self._memory = MemoryWatch(emulation.duration_ns)
        self._cpu = CpuWatch()
        self._messages = Messages(emulation)
        self._watched = True  # the run's own recorder watches from the first period on
        self._processes = LiveProcesses(emulation, options, launcher, self._answer)
        self._fleet = self._processes.fleet

    @property
    def endpoint(self) -> str:
        """Endpoint to which agents and operators connect."""
        return self._processes.attachment.endpoint

    def close(self) -> None:
        """Close what is open to the world."""
        self._processes.attachment.close()

    async def run(
        self, on_state: Callable[[str], None], on_missing: Callable[[Sequence[str]], None]
    ) -> tuple[float, bool]:
        """Join, run, end. Returns the wall-clock seconds between time 0 and the end, and whether interrupted."""
        with self._processes.supervisor.watching_children():
            short_logs = asyncio.ensure_future(self._keep_logs_short())
            try:
                return await self._run(on_state, on_missing)
            finally:
                short_logs.cancel()
                self._processes.close()

    async def _keep_logs_short(self) -> None:
        while True:
            self._launcher.cut_logs()
            await asyncio.sleep(LOGS_LOOK_S)

    async def _run(
        self, on_state: Callable[[str], None], on_missing: Callable[[Sequence[str]], None]
    ) -> tuple[float, bool]:
        folder = self._emulation.folder
        started_s = time.monotonic()
        completed = interrupted = False
        freezes = not is_frozen()

        def tell_missing(nodes: Sequence[str]) -> None:
            self._status.awaits(nodes)
            on_missing(nodes)

        try:
            groups = await self._processes.join(on_state, tell_missing)
            folder.event(0, EventKind.started, start_up_s=round(time.monotonic() - started_s, 3))
            self._emulation.watch(self._publish_period)
            self._emulation.watch(self._look_at_processes)
            self._measure_cpu()
            gc.freeze()  # what is loaded stays: it need not be searched for garbage again and again
            started_s = time.monotonic()
            self._processes.attachment.publish("scene", self._messages.scene())
            await self._while_it_can(self._drive(groups))
            completed = True
        except Stalled:
            self._emulation.finish(self._time_ns())
        except asyncio.CancelledError:
            interrupted, time_ns = True, min(self._time_ns(), self._emulation.duration_ns)
            folder.event(time_ns, EventKind.interrupted)
            self._emulation.finish(time_ns)
        finally:
            if freezes:
                gc.unfreeze()
            wall_s = time.monotonic() - started_s
            self._measure_cpu()
            interrupted |= await to_its_end(self._shut_down(completed))
            in_all_ns = self._cpu.cpu_ns if self._fleet is None else self._cpu.cpu_ns + self._fleet.cpu_ns
            self._emulation.costs.cpu_ns = in_all_ns
            self._memory.write(folder, self._time_ns())
            self._processes.write_refused()
        return wall_s, interrupted

    async def _drive(self, groups: Sequence[Sequence[str]]) -> None:
        """Run the loop of the pacing."""
        processes = self._processes
        if self._emulation.scenario.run.pacing == "realtime":
            self._pacing = realtime = RealTime(self._emulation, groups)
            processes.begin(groups, self._time_ns)
            await run_in_real_time(realtime, processes)
            return
        self._pacing = lockstep = Lockstep(self._emulation, groups)
        if not self._emulation.orders.explores:  # where an order is tried, no instant is quiet
            lockstep.ahead = processes.members.ahead
        processes.begin(groups, self._time_ns)
        with preempting_nobody():
            await run_in_lockstep(lockstep, processes, self._before_horizon)

    async def _while_it_can(self, running: Coroutine[Any, Any, None]) -> None:
        """Await the run; raise Stalled, with an event, once a process exceeds its memory or the router is gone."""
        limit_mb = self._emulation.scenario.run.memory_limit_mb
        run, nodes = asyncio.ensure_future(running), frozenset(self._emulation.world.node_ids)
        exceeded, router_gone = self._processes.over_memory, self._processes.supervisor.router_gone
        ends: list[asyncio.Future[Any]] = [run, router_gone]
        look_s = None if limit_mb is None else MEMORY_LOOK_S
        while_both_go_on = partial(asyncio.wait, ends, timeout=look_s, return_when=asyncio.FIRST_COMPLETED)
        try:
            while run not in (await while_both_go_on())[0]:
                if router_gone.done():
                    self._emulation.folder.event(self._time_ns(), EventKind.router_ended, how=router_gone.result())
                    raise Stalled
                assert limit_mb is not None, "who waits without end waits for something"
                if self._fleet is not None:
                    self._fleet.look(self._time_ns())
                pids = {name: pid for name, pid in self._launcher.pids.items() if name in nodes}
                if over := exceeded[0] if exceeded else first_over(limit_mb, pids):
                    over_nodes = self._processes.members.nodes_with(over[0])
                    self._emulation.memory_exceeded(self._time_ns(), *over, over_nodes)
                    raise Stalled
        finally:
            run.cancel()
            await asyncio.wait([run])
        return run.result()

    async def _shut_down(self, completed: bool) -> None:
        """Tell all that the run is over, take their last messages, and wait until every process has ended."""
        processes = self._processes
        processes.tell_to_end()
        patience_s = (END_LIMIT_S if self._options.launch else FULL_PATIENCE_S) if completed else PATIENCE_S
        deadline_s = time.monotonic() + (patience_s if completed else SHUT_DOWN_S)
        if isinstance(self._pacing, RealTime):
            await processes.finish_real_time(self._pacing, deadline_s)
        elif self._pacing is not None:
            time_ns = self._emulation.duration_ns if completed else self._time_ns()
            self._emulation.take_final(time_ns, await processes.last_traffic(deadline_s))
        if not self._options.launch:
            await processes.all_disconnected(deadline_s)
        if self._fleet is not None:
            await self._fleet.hand_in(patience_s)
        processes.attachment.publish("end", self._messages.end())
        if self._options.record is not None:
            self._launcher.wait_for(RECORDER, RECORDER_WAIT_S if completed else PATIENCE_S)
        if processes.gateways is not None:
            await processes.gateways.close()
        ends = self._launcher.stop(patience_s)
        for node, details in processes.last_deaths(ends).items() if completed else ():
            self._emulation.folder.event(self._emulation.duration_ns, EventKind.died, node, **details)

    def _time_ns(self) -> int:
        """Emulated time for events; 0 before the start."""
        return 0 if self._pacing is None else max(self._pacing.now_ns, 0)

    def _answer(self, verb: str, query: zenoh.Query) -> None:
        """Answer an operator, with an error in one line if need be."""
        payload = b"" if query.payload is None else query.payload.to_bytes()
        own_router = self._options.router is not None or self._processes.gateways is not None
        decided_ns = self._pacing.decided_ns if isinstance(self._pacing, Lockstep) else self._time_ns()
        with query:
            try:
                answered = answer(self._emulation, self._status, verb, payload, decided_ns, own_router)
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

    def _publish_period(self, view: PeriodView) -> None:
        """Publish a period to observers, if there are any: a message is of a whole period."""
        attachment = self._processes.attachment
        was_watched, self._watched = self._watched, attachment.is_watched("period")
        if not self._watched:
            return
        if not was_watched or view.instant.period % SCENE_EVERY_PERIODS == 0:
            attachment.publish("scene", self._messages.scene())
        if was_watched:
            attachment.publish("period", self._messages.period(view))
        else:
            self._messages.begin()
