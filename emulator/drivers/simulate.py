"""The simulated driver: the same programs and the same engine on one machine, without Zenoh.

One virtual-time loop hosts all nodes, and its yields go straight to the barrier; or some processes, forked from
this one, host a part of the nodes each (`forked_programs.py`). In lockstep a live run and its simulation give the
same trace, and a test holds them to it.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from msgspec.structs import replace

from emulator.drivers.collector import rare_collections
from emulator.drivers.emulation import Emulation, PeriodView, ProcessActions
from emulator.drivers.forked_programs import Ended, ForkedPrograms, ProcessDiedError, StalledError
from emulator.drivers.hosted_programs import NONCE, Changes, HostedPrograms, RunOverError, Turn
from emulator.drivers.lockstep import Lockstep
from emulator.drivers.memory import first_over
from emulator.drivers.process_count import split_evenly
from emulator.drivers.signals import signals_handled, tell_from_handler
from emulator.records.events import EventKind
from vnet.errors import VnetError
from vnet.runtime.debug_target import DebugTarget
from vnet.runtime.program_path import search_programs_in
from vnet.runtime.programs import load_programs
from vnet.transport import wire

if TYPE_CHECKING:
    from vnet.runtime.debugger import NodeDebugger

MOST_APART = 100
"""Processes of the vehicles of a run that is made again because one of them has ended its process."""


def simulate(
    emulation: Emulation,
    before_horizon: Callable[[Lockstep], None] | None = None,
    stop: threading.Event | None = None,
    on_interrupt: Callable[[], None] = lambda: None,
    debug: DebugTarget | None = None,
    processes: int = 1,
    apart: str | None = None,
) -> tuple[float, bool]:
    """Run `emulation` to its end; returns the wall-clock seconds, and whether it was interrupted.

    Ctrl-C ends the run early, with the event `interrupted` and without the window in which it comes; a second one
    ends it wherever it is, for programs that do not yield. Raises ProgramError if the program cannot be loaded.
    `before_horizon` sets the barrier's horizon: it is called before time 0, and whenever the run is held there.
    Setting `stop` is like a first Ctrl-C, for runs on other threads than the main one. `on_interrupt` is called, on
    a thread of its own, at the first Ctrl-C. `debug` has a debugger stop in a program. With `processes` above 1 so
    many processes run the programs, and not this one; the vehicles of one that ends before its time have died.
    `apart` is the vehicle that has ended the process of an earlier attempt, "" if unknown: each vehicle has a
    process of its own (beyond `MOST_APART` others, these share so many), and what they print has been printed then.
    If none dies now, that one has, at the end; raises VnetError if it is unknown.
    """
    node_ids = emulation.world.node_ids
    groups = split_evenly(node_ids, processes)
    if apart is not None:
        others = [node for node in node_ids if node != apart]
        groups = [*([[apart]] if apart else []), *(split_evenly(others, MOST_APART) if others else [])]
    emulation.costs.processes = len(groups)
    stop = stop or threading.Event()
    barrier = _Barrier(emulation, groups, before_horizon, stop)
    search_programs_in(emulation.scenario.program.folders)
    simulation: _Apart | _Together
    if len(groups) > 1 or apart is not None:
        simulation = _Apart(emulation, barrier, groups, prints=apart is None)
    else:
        simulation = _Together(emulation, barrier, debug)
    emulation.folder.event(0, EventKind.started, start_up_s=0.0)
    started = time.monotonic()
    interrupted = False
    try:
        with (
            _ending_between_windows(simulation, stop, on_interrupt),
            rare_collections(len(node_ids)),
        ):
            simulation.run()
    except KeyboardInterrupt:
        interrupted = not barrier.is_cut_short
        if interrupted:
            emulation.folder.event(simulation.now_ns, EventKind.interrupted)
        emulation.finish(simulation.now_ns)
    if (
        apart is not None
        and not (interrupted or barrier.is_cut_short)
        and not any(each.kind == EventKind.died for each in emulation.folder.events)
    ):
        if not apart:
            raise VnetError("a process of programs ended, and none did when each vehicle had one of its own")
        how = "ended the process of all vehicles, and not one of its own"
        emulation.folder.event(emulation.duration_ns, EventKind.died, apart, how=how)
    return time.monotonic() - started, interrupted


@contextmanager
def _ending_between_windows(
    simulation: _Together | _Apart, stop: threading.Event, on_interrupt: Callable[[], None]
) -> Iterator[None]:
    """Have the first Ctrl-C wait until programs have yielded: in their midst it would leave things half done."""

    def ask(number: int, frame: object) -> None:
        stop.set()
        signal.signal(signal.SIGINT, signal.default_int_handler)
        tell_from_handler(on_interrupt)

    here = threading.current_thread() is threading.main_thread()
    if not here or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:  # others see to it
        simulation.no_signal_raises = lambda: not here or signal.getsignal(signal.SIGINT) is signal.SIG_IGN
        yield
        return
    signal.signal(signal.SIGINT, ask)
    simulation.no_signal_raises = lambda: signal.getsignal(signal.SIGINT) is ask
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _debugger(target: DebugTarget, on_quit: Callable[[], None]) -> NodeDebugger:
    """Return a debugger on this process's terminal. While it asks, Ctrl-C drops what was typed."""
    from vnet.runtime.debugger import NodeDebugger  # pdb, which few runs need

    return NodeDebugger(target, lambda: signals_handled(signal.default_int_handler, signal.SIGINT), on_quit)


class _Barrier:
    """The barrier of a simulation, which tells each process what comes next. `groups` are their nodes."""

    def __init__(
        self,
        emulation: Emulation,
        groups: Sequence[Sequence[str]],
        before_horizon: Callable[[Lockstep], None] | None,
        stop: threading.Event,
    ) -> None:
        self._emulation = emulation
        self._lockstep = Lockstep(emulation, groups, permanent=True)
        self._before_horizon = before_horizon or (lambda lockstep: None)
        self._groups = {nodes[0]: frozenset(nodes) for nodes in groups}
        self._changes: dict[str, list[Changes]] = {process_id: [] for process_id in self._groups}
        """Changes of the programs of processes, until these are granted their next window."""
        self.stop = stop
        self.is_cut_short = False
        """True once a process holds more than `run.memory_limit_mb`, or does not end its window."""
        self.pids = {nodes[0]: os.getpid() for nodes in groups}
        if emulation.scenario.run.memory_limit_mb is not None:
            emulation.watch(self._look_at_memory)

    def _look_at_memory(self, view: PeriodView) -> None:
        over = first_over(self._emulation.scenario.run.memory_limit_mb, self.pids)
        if over is not None and not self.is_cut_short:
            self.is_cut_short = True
            self._emulation.memory_exceeded(self.now_ns, *over, sorted(self._groups[over[0]]))

    @property
    def is_ending(self) -> bool:
        """True if the run is to end at the next barrier."""
        return self.stop.is_set() or self.is_cut_short

    @property
    def now_ns(self) -> int:
        """Emulated time: the beginning of the window."""
        return self._lockstep.now_ns

    def welcomes(self, nodes: Sequence[str]) -> list[wire.Welcome]:
        """Return the welcomes of the nodes of a process, at the start of the run."""
        welcomes = [self._emulation.welcome(node, NONCE) for node in nodes]
        return [replace(each, runs=each.runs and self._emulation.up[each.node]) for each in welcomes]

    def begin(self) -> dict[str, Turn]:
        """Return the first turns, by process."""
        self._before_horizon(self._lockstep)
        return self._turns(self._lockstep.start())

    def go_on(self, yields: Mapping[str, wire.Yield]) -> dict[str, Turn]:
        """Take the yields of all processes that were granted a window; returns the next turns, none at the end.

        Raises KeyboardInterrupt if the run is to stop.
        """
        if self.is_ending:
            raise KeyboardInterrupt
        for process_id, message in yields.items():
            self._lockstep.receive(process_id, message)
        grants = self._lockstep.step()
        while self._lockstep.held:
            self._before_horizon(self._lockstep)
            grants = self._lockstep.step()
        return self._turns(grants)

    def died(self, process_id: str, how: str) -> None:
        """Take note that a process has ended before its time, and its nodes with it."""
        self._lockstep.died(process_id, how=how)

    def stalled(self, node: str, limit_s: float) -> None:
        """Have the run end, since the code of a node runs on and on."""
        self.is_cut_short = True
        error = f"no yield within {limit_s:g} s of wall clock"
        self._emulation.folder.event(self.now_ns, EventKind.stalled, node, error=error)

    def _turns(self, grants: Mapping[str, wire.Grant]) -> dict[str, Turn]:
        for actions in self._lockstep.take_actions():
            for process_id, nodes in self._groups.items():
                self._changes[process_id].append(self._part(actions, nodes))
        mail = self._lockstep.take_mail()
        turns = {process_id: Turn(self._changes[process_id], grant, mail) for process_id, grant in grants.items()}
        self._changes.update({process_id: [] for process_id in turns})
        return turns

    def _part(self, actions: ProcessActions, nodes: frozenset[str]) -> Changes:
        """Return the part of actions that concerns the nodes of a process."""
        return Changes(
            time_ns=actions.time_ns,
            stop={node: killed for node, killed in actions.stop.items() if node in nodes},
            start=[self._emulation.welcome(node, NONCE) for node in actions.start if node in nodes],
            paused=actions.paused & nodes,
        )


class _Together:
    """All nodes on one loop of this process."""

    def __init__(self, emulation: Emulation, barrier: _Barrier, debug: DebugTarget | None) -> None:
        self._emulation, self._barrier = emulation, barrier
        welcomes = barrier.welcomes(emulation.world.node_ids)
        programs = load_programs(welcomes)  # which may fail, and then there is nothing to close
        debugger = None if debug is None else _debugger(debug, self._quit)
        self._hosted = HostedPrograms(welcomes, programs, emulation.folder, self._swap, debugger)
        self.no_signal_raises: Callable[[], bool] = lambda: False
        """Tells whether a KeyboardInterrupt can only be the programs' own."""

    @property
    def now_ns(self) -> int:
        """Emulated time of the programs."""
        return self._hosted.loop.now_ns

    def _quit(self) -> None:
        """End the run wherever the debugger has stopped it."""
        self._barrier.stop.set()
        raise KeyboardInterrupt

    def _swap(self, message: wire.Yield | None) -> Turn:
        process_id = self._emulation.world.node_ids[0]
        turns = self._barrier.begin() if message is None else self._barrier.go_on({process_id: message})
        if not turns:
            raise RunOverError
        return turns[process_id]

    def run(self) -> None:
        """From the first grant to the last. Raises KeyboardInterrupt."""
        emulation, hosted = self._emulation, self._hosted
        hosted.only_programs_raise = lambda: not self._barrier.is_ending and self.no_signal_raises()
        try:
            hosted.run()
        except KeyboardInterrupt:
            emulation.take_final(self.now_ns, [hosted.final])
            raise
        else:
            emulation.take_final(emulation.duration_ns, [hosted.final])
        finally:
            emulation.costs.take_programs(hosted.meter.cpu_ns, hosted.meter.wake_ups)
            emulation.orders.steps = hosted.order_steps


class _Apart:
    """The nodes in equal parts in processes of their own, which work side by side."""

    no_signal_raises: Callable[[], bool]

    def __init__(
        self, emulation: Emulation, barrier: _Barrier, groups: Sequence[Sequence[str]], prints: bool
    ) -> None:
        self._emulation, self._barrier, self._prints = emulation, barrier, prints
        self._welcomes = {nodes[0]: barrier.welcomes(nodes) for nodes in groups}
        self._programs = load_programs(each for welcomes in self._welcomes.values() for each in welcomes)
        self._processes: dict[str, ForkedPrograms] = {}
        self._limit_s = emulation.scenario.run.stall_timeout_s

    @property
    def now_ns(self) -> int:
        """Emulated time: the beginning of the window."""
        return self._barrier.now_ns

    def run(self) -> None:
        """From the first grant to the last. Raises KeyboardInterrupt."""
        processes = self._processes
        try:
            for process_id, welcomes in self._welcomes.items():
                processes[process_id] = ForkedPrograms(
                    welcomes,
                    self._programs,
                    self._emulation.folder,
                    others=list(processes.values()),
                    detach=self._emulation.driving.detach,
                    prints=self._prints,
                )
                self._barrier.pids[process_id] = processes[process_id].pid
            self._grant_all()
        except KeyboardInterrupt:
            self._end(self.now_ns)
            raise
        else:
            self._end(self._emulation.duration_ns)
        finally:
            for process in processes.values():
                process.close()

    def _grant_all(self) -> None:
        turns = self._barrier.begin()
        while turns:
            for process_id, turn in turns.items():
                self._processes[process_id].give(turn)
            try:
                yields = {process_id: self._take(process_id) for process_id in turns}
            except StalledError as stalled:
                self._barrier.stalled(str(stalled), self._limit_s)
                raise KeyboardInterrupt from None
            turns = self._barrier.go_on(
                {process_id: each for process_id, each in yields.items() if each is not None}
            )

    def _take(self, process_id: str) -> Any:
        """Return the answer of a process; None if it has ended before its time, and its vehicles have died."""
        try:
            return self._processes[process_id].take(self._limit_s)
        except ProcessDiedError as death:
            self._barrier.died(process_id, str(death))
            return None

    def _end(self, time_ns: int) -> None:
        """End all processes but those that are in the midst of a window, and take what they have left to say."""
        emulation = self._emulation
        asked = [process_id for process_id, process in self._processes.items() if not process.owes]
        for process_id in asked:
            self._processes[process_id].give(None)
        ended: list[Ended] = []
        after = ", after the run was over" if time_ns == emulation.duration_ns else ""
        for process_id in asked:
            try:
                ended.append(self._processes[process_id].take(self._limit_s))
            except (ProcessDiedError, StalledError) as error:
                how = str(error)
                if isinstance(error, StalledError):
                    how = f"did not end within {self._limit_s:g} s, while {error} ran"
                for welcome in self._welcomes[process_id]:
                    emulation.died(time_ns, welcome.node, how=f"{how}{after}")
        emulation.take_final(time_ns, [each.final for each in ended])
        cpu_ns, wake_ups = Counter[str](), Counter[str]()
        for each in ended:
            cpu_ns.update(each.cpu_ns)
            wake_ups.update(each.wake_ups)
        emulation.costs.take_programs(cpu_ns, wake_ups)
        emulation.orders.steps = {node: count for each in ended for node, count in each.order_steps.items()}
