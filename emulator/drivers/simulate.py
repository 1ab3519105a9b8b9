"""The simulated driver: the same programs and the same engine in one process, without Zenoh.

One virtual-time loop hosts all nodes; its yields go straight to the barrier. In lockstep a live run and its
simulation give the same trace, and a test holds them to it.
"""

from __future__ import annotations

import asyncio
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from msgspec.structs import replace

from emulator.drivers.collector import rare_collections
from emulator.drivers.emulation import Emulation, ProcessActions
from emulator.drivers.lockstep import Lockstep
from emulator.drivers.program_output import output_kept
from emulator.drivers.signals import signals_handled, tell_from_handler
from emulator.records.node_logs import NodeLogs
from vnet.node import Node
from vnet.runtime.cpu_meter import CpuMeter
from vnet.runtime.debug_target import DebugTarget
from vnet.runtime.disks import Disks
from vnet.runtime.host import Host
from vnet.runtime.program_path import search_programs_in
from vnet.runtime.programs import load_programs
from vnet.runtime.virtual_time import SpinError, VirtualTimeLoop
from vnet.transport import wire

if TYPE_CHECKING:
    from vnet.runtime.debugger import NodeDebugger

_NONCE = b""


class _RunOverError(Exception):
    """The barrier has granted nothing more."""


def simulate(
    emulation: Emulation,
    before_horizon: Callable[[Lockstep], None] | None = None,
    stop: threading.Event | None = None,
    on_interrupt: Callable[[], None] = lambda: None,
    debug: DebugTarget | None = None,
) -> tuple[float, bool]:
    """Run `emulation` to its end in this process; returns the wall-clock seconds, and whether it was interrupted.

    Ctrl-C ends the run early, with the event `interrupted` and without the window in which it comes; a second one
    ends it wherever it is, for programs that do not yield. Raises ProgramError if the program cannot be loaded.
    `before_horizon` sets the barrier's horizon: it is called before time 0, and whenever the run is held there.
    Setting `stop` is like a first Ctrl-C, for runs on other threads than the main one. `on_interrupt` is called, on
    a thread of its own, at the first Ctrl-C. `debug` has a debugger stop in a program.
    """
    simulation = _Simulation(emulation, before_horizon, stop or threading.Event(), debug)
    emulation.folder.event(0, "started", start_up_s=0.0)
    started = time.monotonic()
    interrupted = False
    try:
        with (
            _ending_between_windows(simulation, on_interrupt),
            rare_collections(len(emulation.world.node_ids)),
            output_kept(simulation.owns, simulation.logs),
        ):
            simulation.run()
    except KeyboardInterrupt:
        interrupted = True
        emulation.folder.event(simulation.loop.now_ns, "interrupted")
        emulation.finish(simulation.loop.now_ns)
    return time.monotonic() - started, interrupted


@contextmanager
def _ending_between_windows(simulation: _Simulation, on_interrupt: Callable[[], None]) -> Iterator[None]:
    """Have the first Ctrl-C wait until programs have yielded: in their midst it would leave things half done."""

    def ask(number: int, frame: object) -> None:
        simulation.stop.set()
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


class _Simulation:
    """All nodes on one loop, and the barrier that this loop yields to."""

    def __init__(
        self,
        emulation: Emulation,
        before_horizon: Callable[[Lockstep], None] | None,
        stop: threading.Event,
        debug: DebugTarget | None,
    ) -> None:
        node_ids = emulation.world.node_ids
        self._process_of = node_ids[0]
        self._emulation = emulation
        self._lockstep = Lockstep(emulation, [node_ids], hosts_all=True)
        self._before_horizon = before_horizon or (lambda lockstep: None)
        self._seq = 0
        self.stop = stop
        self.no_signal_raises: Callable[[], bool] = lambda: False
        """Tells whether a KeyboardInterrupt can only be the programs' own."""
        welcomes = [emulation.welcome(node, _NONCE) for node in node_ids]
        welcomes = [replace(welcome, runs=welcome.runs and emulation.up[welcome.node]) for welcome in welcomes]
        search_programs_in(emulation.scenario.program.folders)
        self._programs = load_programs(welcomes)  # which may fail, and then there is nothing to close
        self.loop = VirtualTimeLoop(self._exchange, emulation.scenario.run.spin_limit)
        self._meter = CpuMeter()
        if emulation.folder.is_open:  # else nobody asks what programs have cost
            self.loop.measure(self._meter)
        self.logs = NodeLogs(emulation.folder.logs)
        disks = Disks(emulation.folder.disks)
        debugger = None if debug is None else _debugger(debug, self._quit)
        self._host = Host(
            welcomes, lambda: self.loop.now_ns, on_line=self.logs.write, disks=disks, debugger=debugger
        )

    def _quit(self) -> None:
        """End the run wherever the debugger has stopped it."""
        self.stop.set()
        raise KeyboardInterrupt

    def owns(self, node: Node) -> bool:
        """Return whether `node` is one of this simulation, and not an earlier incarnation."""
        return self._host.nodes.get(node.id) is node

    def run(self) -> None:
        """From the first grant to the last."""
        asyncio.set_event_loop(self.loop)
        try:
            self._host.order_events(self.loop)
            self._host.start(self.loop, self._programs)
            self._before_horizon(self._lockstep)
            self.loop.start_at(self._take(self._lockstep.start()))
            while True:
                try:
                    self.loop.run_forever()
                except SpinError as spin:
                    self._host.end_spinning(self.loop, spin)
                except SystemExit as leave:
                    self._host.end_exited(leave)
                except KeyboardInterrupt as leave:
                    if self.stop.is_set() or not self.no_signal_raises():
                        raise
                    self._host.end_exited(leave)
        except _RunOverError:
            self._close(self._emulation.duration_ns)
        except KeyboardInterrupt:
            self._host.forget_interrupt()
            self._close(self.loop.now_ns)
            raise
        finally:
            asyncio.set_event_loop(None)
            self.loop.close()
            self._host.discard_abandoned()
            self._emulation.costs.take_programs(self._meter.cpu_ns, self._meter.wake_ups)
            if (ordered := self._host.mail.ordered) is not None:
                self._emulation.orders.steps = ordered.steps

    def _close(self, time_ns: int) -> None:
        self._host.close(self.loop)
        self._emulation.take_final(time_ns, [self._host.take_final()])

    def _exchange(self, next_timer_ns: int | None) -> int:
        next_ns = self._host.next_instant(next_timer_ns)
        if next_ns is not None:
            return next_ns
        if self.stop.is_set():
            raise KeyboardInterrupt
        self._lockstep.receive(self._process_of, self._host.make_yield(_NONCE, self._seq, next_timer_ns))
        grants = self._lockstep.step()
        while self._lockstep.held:
            self._before_horizon(self._lockstep)
            grants = self._lockstep.step()
        return self._take(grants)

    def _take(self, grants: dict[str, wire.Grant]) -> int:
        if not grants:
            raise _RunOverError
        grant = grants[self._process_of]
        self._seq = grant.seq
        self._host.apply_clock_error(grant.clocks, self.loop)
        self._apply_process_faults(self._lockstep.take_actions())
        return self._host.open_window(grant, self._lockstep.take_mail())

    def _apply_process_faults(self, actions: Sequence[ProcessActions]) -> None:
        """Do to the programs what faults do to processes."""
        for action in actions:
            for node, killed in action.stop.items():
                self._host.stop(node, killed, action.time_ns)
            for node in action.start:
                self._host.restart(self._emulation.welcome(node, _NONCE))
            self._host.pause(action.paused)
