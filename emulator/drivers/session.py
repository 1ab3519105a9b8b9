"""A run from its scenario to its verdict: `Session` is the one way to make and to drive a run.

Commands, the Python API, tests, cells, campaigns, learning and benchmarks are its clients. They differ in where the
programs are (`Local`, or `LiveOptions` for processes over Zenoh), in the files that are kept, and in who watches.
"""

from __future__ import annotations

import asyncio
import ctypes
import os
import shlex
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, InvalidStateError
from concurrent.futures import wait as wait_for
from contextlib import closing, nullcontext, redirect_stdout, suppress
from contextvars import copy_context
from dataclasses import dataclass
from functools import partial
from io import StringIO
from pathlib import Path
from queue import SimpleQueue
from tempfile import TemporaryDirectory
from typing import Any

from emulator.checks.judge import Judgement
from emulator.drivers.attachment import LiveOptions
from emulator.drivers.conclude import conclude, judge_unkept
from emulator.drivers.emulation import Emulation
from emulator.drivers.join import split_into_processes
from emulator.drivers.launch import AGENT_ENVIRONMENT, Exit
from emulator.drivers.local import output_branched
from emulator.drivers.lockstep import Lockstep, no_horizon
from emulator.drivers.simulate import ProcessCount, process_count, simulate
from emulator.records.code_digest import entries_of
from emulator.records.run_folder import RunFolder
from emulator.scenario.faults import refuse_router_restart
from emulator.scenario.scenario import Scenario
from emulator.world.world import World, build_world
from vnet.errors import ProgramError, VnetError
from vnet.runtime.debug_target import DebugTarget
from vnet.runtime.environment import SAME_ARITHMETIC
from vnet.runtime.own_packages import foreign_on_path
from vnet.runtime.programs import forget_imports, imports_kept, load_program, search_programs_in
from vnet.transport.access import Access
from vnet.transport.session import quiet_zenoh


@dataclass(frozen=True)
class Local:
    """Programs in this process, or in so many `processes` that are forked from it, without Zenoh.

    `debug` has a debugger stop in a program. `apart` is a vehicle that gets a process of its own, because it has
    ended the process of an earlier attempt, or has `stalled` there.
    """

    processes: ProcessCount | str = 1
    debug: DebugTarget | None = None
    apart: str | None = None
    stalled: bool = False


def over_zenoh(emulation: Emulation) -> LiveOptions:
    """Return the options of a run with a process for each vehicle, or each group of them, on this machine.

    Raises ScenarioError for a fault that this cannot show.
    """
    scenario = emulation.scenario
    if not scenario.has_gateways:
        refuse_router_restart(scenario.fault)
    groups = split_into_processes(emulation.world.node_ids, scenario.run.nodes_per_process)
    return LiveOptions(Access.create(scenario.run.name, groups, units=scenario.unit_ids))


Programs = Local | Callable[[Emulation], LiveOptions]
"""The place of the programs of a run. Options of a live run are made when all else is ready."""
Folder = RunFolder | Callable[[Scenario, World], RunFolder] | Path | None
"""The folder of a run: one that is there, what prepares it, its path, or None for the next of `runs/`."""


class Session:
    """One run: made ready, then driven by `run`, or by `start` and `go` step by step, and judged.

    emulation: the run's parts.
    command: the vnet command that makes the same run, "simulate" or "run".
    wall_s: wall-clock seconds that driving has taken.
    interrupted: True if Ctrl-C or `stop` has ended the run before its time.

    Nothing is written before `open`, unless `folder` is one that is there. Raises VnetError for what cannot be run:
    a world, a program, or the order of events, which may need a run of its own.
    """

    def __init__(
        self,
        scenario: Scenario,
        folder: Folder = None,
        programs: Programs = Local(),
        loads_programs: bool = True,
    ) -> None:
        """`loads_programs` has live ones loaded in a process aside first, to tell of what is wrong with them."""
        scenario = with_order_steps(scenario)
        forget_imports()
        is_local = isinstance(programs, Local)
        loads_programs = loads_programs and not is_local and bool(entries_of(scenario))
        with closing(ProgramCheck(scenario)) if loads_programs else nullcontext() as check:
            world = build_world(scenario)
            self._local = programs if isinstance(programs, Local) else Local()
            self._processes = process_count(self._local.processes, len(world.node_ids))
            self.emulation = Emulation(scenario, world, _folder(folder, scenario, world))
            self.live: LiveOptions | None = None
            if not isinstance(programs, Local):
                quiet_zenoh()
                self.live = programs(self.emulation)
            if check is not None:
                check.wait()
        self.command = "simulate" if is_local else "run"
        self.wall_s = 0.0
        self.interrupted = False
        self.over = False
        """True once a run that was stepped has come to its end."""
        self.stands: Future[None] = Future()
        """Done when a run that is stepped is held or over."""
        self._horizons: SimpleQueue[int | None] = SimpleQueue()
        self._give: Callable[[int | None], Any] = self._horizons.put
        self._went_at: float | None = None
        self._lockstep: Lockstep | None = None
        self._stop = threading.Event()
        self._interrupt: Callable[[], Any] = self._interrupt_local
        self._thread: threading.Thread | None = None

    @property
    def folder(self) -> RunFolder:
        """The run's folder."""
        return self.emulation.folder

    @property
    def started(self) -> bool:
        """True once `start` was called."""
        return self._thread is not None

    def open(self) -> Session:
        """Make the run's folder, once the programs that run in this process have proved to load."""
        scenario = self.emulation.scenario
        if self.live is None:
            search_programs_in(scenario.program.folders)
            with output_branched():
                for entry in entries_of(scenario):
                    load_program(entry)
        _ = self.emulation.metrics.declared  # what cannot be is refused before anything is written
        self.folder.open(scenario)
        return self

    def run(
        self,
        stop: threading.Event | None = None,
        on_interrupt: Callable[[], None] = lambda: None,
        on_state: Callable[[str], None] = lambda text: None,
        on_missing: Callable[[Sequence[str]], None] = lambda nodes: None,
        on_open: Callable[[], None] = lambda: None,
    ) -> None:
        """Drive the run to its end, or to Ctrl-C.

        Setting `stop` ends a local run as Ctrl-C does, and `on_interrupt` is called when that comes. The others are
        of live runs: `on_state` is told how it goes, `on_missing` which nodes have not joined, and `on_open` that
        the emulator's endpoint is open; it may make the run's folder.
        """
        if self.live is None:
            where = self._local
            earlier = where.apart, where.stalled
            with imports_kept():
                self.wall_s, self.interrupted = simulate(
                    self.emulation, no_horizon, stop, on_interrupt, where.debug, self._processes, *earlier
                )
        else:
            from emulator.drivers.live import run_live  # slow to import, and simulations do without

            running = run_live(self.emulation, self.live, on_state, on_missing=on_missing, on_open=on_open)
            self.wall_s, self.interrupted = asyncio.run(running)

    def judge(self) -> Judgement:
        """Judge a run of which nothing is kept."""
        return judge_unkept(self.emulation, self.wall_s)

    def close(self, replay: str = "") -> tuple[Judgement, dict[str, Any]]:
        """Write what is kept of the run and judge it; returns the judgement, and what verdict.json has.

        `replay` says why no replay is warranted, if none is.
        """
        agent = [] if self.live is None or not self.live.agent else ["--agent", shlex.join(self.live.agent)]
        return conclude(self.emulation, self.wall_s, shlex.join([self.command, *agent]), replay)

    # Step by step, in lockstep, on a thread of its own. While the run is held, faults may be planned.

    def start(self) -> Future[None]:
        """Get ready for time 0. The future, here and in `go`, is done when the run is held or over."""
        run = copy_context().run  # of what a test has set for the programs that it imports
        name = f"vnet {self.command}"
        self._thread = threading.Thread(target=run, args=(self._run_held,), name=name, daemon=True)
        self._thread.start()
        return self.stands

    def go(self, horizon_ns: int | None) -> Future[None]:
        """Do all that happens before `horizon_ns`, or all to the end."""
        assert self.stands.done() and not self.over
        assert self._lockstep is not None
        self.stands, self._lockstep.is_to_hold = Future(), False
        self._went_at = time.monotonic()
        self._give(horizon_ns)
        return self.stands

    def wait(self, patience_s: float) -> None:
        """Wait until the run is held or over; one whose programs do not yield for so long is interrupted.

        Raises VnetError if that does not end it either.
        """
        wait_for([self.stands], patience_s)
        if not self.stands.done():
            self._interrupt()
            wait_for([self.stands], patience_s if self.live is None else None)  # a live run kills who does not end
        if not self.stands.done():
            self._settle(
                VnetError(f"a program has not yielded for {2 * patience_s:g} s, and cannot be interrupted")
            )
        self.stands.result()

    def _settle(self, error: BaseException | None = None) -> None:
        """Let all go who wait for the run to stand, unless they have been told that it does not."""
        with suppress(InvalidStateError):
            self.stands.set_result(None) if error is None else self.stands.set_exception(error)

    def _interrupt_local(self) -> None:
        """Interrupt programs on the run's thread as Ctrl-C would on the main one."""
        self._stop.set()
        assert self._thread is not None
        thread = ctypes.c_ulong(self._thread.ident or 0)
        ctypes.pythonapi.PyThreadState_SetAsyncExc(thread, ctypes.py_object(KeyboardInterrupt))

    def hold(self, patience_s: float) -> int:
        """Have a run that is on its way held where it stands; returns that emulated time (ns). See `wait`."""
        if self._lockstep is not None:
            self._lockstep.is_to_hold = True
        self.wait(patience_s)
        if self.over or self._lockstep is None:
            return self.emulation.ended_ns or 0
        return self._lockstep.horizon_ns or 0

    def _run_held(self) -> None:
        try:
            if self.live is None:
                with imports_kept():
                    simulate(self.emulation, self._hold, self._stop)
            else:
                asyncio.run(self._run_live())
        except BaseException as error:
            self.over = True
            self._settle(error)
        else:
            self.over = True
            self._stand()

    async def _hold(self, lockstep: Lockstep) -> None:
        self._lockstep = lockstep
        self._stand()
        lockstep.horizon_ns = self._horizons.get()

    async def _run_live(self) -> None:
        from emulator.drivers.live import run_live

        task, loop = asyncio.current_task(), asyncio.get_running_loop()
        assert task is not None and self.live is not None
        self._interrupt = partial(loop.call_soon_threadsafe, task.cancel)
        await run_live(self.emulation, self.live, before_horizon=self._hold_live)

    async def _hold_live(self, lockstep: Lockstep) -> None:
        self._lockstep = lockstep
        loop = asyncio.get_running_loop()
        horizon: asyncio.Future[int | None] = loop.create_future()
        self._give = lambda horizon_ns: loop.call_soon_threadsafe(horizon.set_result, horizon_ns)
        self._stand()
        lockstep.horizon_ns = await horizon

    def _stand(self) -> None:
        if self._went_at is not None:
            self.wall_s += time.monotonic() - self._went_at
        self._settle()


def _folder(folder: Folder, scenario: Scenario, world: World) -> RunFolder:
    if folder is None or isinstance(folder, Path):
        return RunFolder.prepare(folder, scenario)
    return folder if isinstance(folder, RunFolder) else folder(scenario, world)


def with_order_steps(scenario: Scenario) -> Scenario:
    """Return a scenario that has `run.order_steps` if `run.order` is "pct": decisions of a vehicle in a FIFO run.

    Raises KeyboardInterrupt, and VnetError if it cannot be simulated.
    """
    run = scenario.run
    if run.order != "pct" or run.order_steps is not None:
        return scenario
    fifo = scenario.model_copy(update={"run": run.model_copy(update={"order": "fifo"})})
    with TemporaryDirectory(prefix="vnet-order-") as name, redirect_stdout(StringIO()):
        session = Session(fifo, Path(name) / "run").open()
        session.emulation.orders.explores = True
        session.run()
    if session.interrupted:
        raise KeyboardInterrupt
    steps = max([1, *session.emulation.orders.steps.values()])
    return scenario.model_copy(update={"run": run.model_copy(update={"order_steps": steps})})


_LONGEST_REASON = 1 << 16
"""Bytes of a reason, which fit into a pipe."""


class ProgramCheck:
    """A process that imports the programs of a scenario in the background, until `close`."""

    def __init__(self, scenario: Scenario) -> None:
        self._entries = entries_of(scenario)
        self._limit_s = scenario.run.join_timeout_s
        self._reason, write_end = os.pipe()
        folders = [word for folder in scenario.program.folders for word in ("--path", str(folder))]
        arguments = ["-P", "-m", "agents.program_check", str(write_end), *folders, *self._entries]
        try:
            self._process = subprocess.Popen(
                [sys.executable, *arguments],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                pass_fds=[write_end],
                process_group=0,  # Ctrl-C in the terminal is the emulator's
                env={**SAME_ARITHMETIC, **os.environ, **AGENT_ENVIRONMENT},
            )
        finally:
            os.close(write_end)

    def wait(self) -> None:
        """Wait for its end. Raises ProgramError if a program cannot be loaded."""
        entries = ", ".join(map(repr, self._entries))
        try:
            status = self._process.wait(self._limit_s)
        except subprocess.TimeoutExpired:
            raise ProgramError(
                f"program.entry = {entries}: not imported within run.join_timeout_s = {self._limit_s:g}"
            ) from None
        if status == 0:
            return
        if foreign := foreign_on_path("agents"):
            raise ProgramError(foreign)
        os.set_blocking(self._reason, False)
        reason = os.read(self._reason, _LONGEST_REASON).decode() if status == 2 else ""
        raise ProgramError(
            reason or f"program.entry = {entries}: importing it ended the process ({Exit(status, '').how})"
        )

    def close(self) -> None:
        """End the process if it is still there."""
        self._process.kill()
        self._process.wait()
        os.close(self._reason)
