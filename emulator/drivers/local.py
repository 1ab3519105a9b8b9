"""Programs of a simulation on one virtual-time loop: the emulator's own (`InLoop`), or that of a forked process.

The loop of the pacing and that of the programs take turns: the one waits where the other runs.
"""

from __future__ import annotations

import asyncio
import math
import os
import signal
import sys
import threading
from abc import abstractmethod
from collections.abc import Callable, Coroutine, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import coroutine
from typing import TYPE_CHECKING, Any, NamedTuple

from msgspec.structs import replace

from emulator.drivers.emulation import Emulation, PeriodView, ProcessActions
from emulator.drivers.processes import Heard, Processes
from emulator.drivers.signals import signals_handled
from emulator.drivers.usage import first_over
from emulator.records.node_files import NodeLogs
from emulator.records.run_folder import RunFolder
from vnet.node import Node
from vnet.runtime import running_node
from vnet.runtime.arrivals import Mail
from vnet.runtime.debug_target import DebugTarget
from vnet.runtime.host import Disks, Host
from vnet.runtime.outside_loop import present_node
from vnet.runtime.process_end import caught
from vnet.runtime.programs import Programs, load_programs
from vnet.runtime.ready_queue import CpuMeter
from vnet.runtime.virtual_time import VirtualTimeLoop
from vnet.transport import wire

if TYPE_CHECKING:
    from vnet.runtime.debugger import NodeDebugger

NONCE = b""
"""Nonce of simulated processes, which nobody can impersonate."""


class NoMoreGrantsError(Exception):
    """The barrier has granted nothing more."""


Call = tuple[str, tuple[Any, ...]]
"""A method of `Host` that faults and trips have called, and its arguments."""
Turn = tuple[Sequence[Call], wire.Grant, Mail | None]
"""The next window of a process, and what is to be called before it; the mail is None if it is in the grant."""
Swap = Callable[[wire.Yield | None], Turn]
"""Yield, and return the next turn; without a yield, the first. Raises RunOverError, KeyboardInterrupt."""


class Ended(NamedTuple):
    """The answer of a process when the run is over: what its programs left to tell, and their costs.

    `final` are exceptions and notes of programs as they were ended; the others are by node. `order_steps` are
    decisions, where orders of events are tried.
    """

    final: wire.Traffic
    cpu_ns: Mapping[str, int]
    wake_ups: Mapping[str, int]
    order_steps: Mapping[str, int]


class LocalProcesses(Processes):
    """Programs that this process runs, or has forked: nodes stay in their process, where programs end and start.

    Setting `stop` ends the run at the next barrier.
    """

    def __init__(self, emulation: Emulation, groups: Sequence[Sequence[str]], stop: threading.Event) -> None:
        self._emulation = emulation
        self._groups = {nodes[0]: frozenset(nodes) for nodes in groups}
        self._calls: dict[str, list[Call]] = {process_id: [] for process_id in self._groups}
        """Calls for programs of each process, until it is granted its next window."""
        self.stop = stop
        self.is_cut_short = False
        """True once a process holds more than `run.memory_limit_mb`, or does not end its window."""
        self.pids = {nodes[0]: os.getpid() for nodes in groups}
        self.endings: list[Ended] = []
        """Answers of the processes at the end of the run."""
        self.no_signal_raises: Callable[[], bool] = lambda: False
        """Tells whether a KeyboardInterrupt can only be the programs' own."""
        if emulation.scenario.run.memory_limit_mb is not None:
            emulation.watch(self._look_at_memory)

    def _look_at_memory(self, view: PeriodView) -> None:
        over = first_over(self._emulation.scenario.run.memory_limit_mb, self.pids)
        if over is not None and not self.is_cut_short:
            self.is_cut_short = True
            self._emulation.memory_exceeded(self._emulation.emulated_ns, *over, sorted(self._groups[over[0]]))

    @property
    def is_ending(self) -> bool:
        """True if the run is to end at the next barrier."""
        return self.stop.is_set() or self.is_cut_short

    def welcomes(self, nodes: Iterable[str]) -> list[wire.Welcome]:
        """Return the welcomes of the nodes of a process, at the start of the run."""
        welcomes = [self._emulation.welcome(node, NONCE) for node in nodes]
        return [replace(each, runs=each.runs and self._emulation.up[each.node]) for each in welcomes]

    def nodes_of(self, process_id: str) -> list[str]:
        """Return the nodes of a process."""
        return sorted(self._groups[process_id])

    async def act(self, actions: ProcessActions) -> None:
        """Have programs stopped, started and paused within their processes, before the next window."""
        for process_id, nodes in self._groups.items():
            calls = self._calls[process_id]
            stopped = {node: killed for node, killed in actions.stop.items() if node in nodes}
            calls += [("stop", (node, killed, actions.time_ns)) for node, killed in stopped.items()]
            started = [self._emulation.welcome(node, NONCE) for node in actions.start if node in nodes]
            calls += [("restart", (welcome,)) for welcome in started]
            calls.append(("pause", (actions.paused & nodes,)))

    def _take_calls(self, process_id: str) -> list[Call]:
        calls, self._calls[process_id] = self._calls[process_id], []
        return calls

    @abstractmethod
    def run(self, course: Coroutine[Any, Any, None]) -> None:
        """Run the loop of the pacing to its end, and end the programs. Raises KeyboardInterrupt."""


@coroutine
def _programs_run() -> Generator[None, None, None]:
    """Let the programs' loop run until it yields."""
    yield


class InLoop(LocalProcesses):
    """All nodes on one loop of this process. The loop of the pacing goes on when the programs' loop yields."""

    def __init__(self, emulation: Emulation, stop: threading.Event, debug: DebugTarget | None = None) -> None:
        node_ids = emulation.world.node_ids
        super().__init__(emulation, [node_ids], stop)
        self._id = node_ids[0]
        welcomes = self.welcomes(node_ids)
        programs = load_programs(welcomes)  # which may fail, and then there is nothing to close
        debugger = None if debug is None else _debugger(debug, self._quit)
        self._hosted = HostedPrograms(welcomes, programs, emulation.folder, self._swap, debugger)
        self._hosted.only_programs_raise = lambda: not self.is_ending and self.no_signal_raises()
        self._said: wire.Yield | None = None
        self._turn: Turn

    def _quit(self) -> None:
        """End the run wherever the debugger has stopped it."""
        self.stop.set()
        raise KeyboardInterrupt

    def send(self, process_id: str, message: wire.Grant | wire.Batch, mail: Mail | None = None) -> None:
        """Give the loop its next window, which begins when it goes on."""
        assert isinstance(message, wire.Grant)
        self._turn = self._take_calls(process_id), message, mail

    async def receive(self, timeout_s: float = math.inf) -> Heard:
        """Let the programs run until they yield. Raises KeyboardInterrupt if the run is to end."""
        while self._said is None:
            await _programs_run()
        if self.is_ending:
            raise KeyboardInterrupt
        said, self._said = self._said, None
        return Heard(self._id, said)

    def _swap(self, message: wire.Yield | None) -> Turn:
        self._said = message
        try:
            self._course.send(None)
        except StopIteration:
            raise NoMoreGrantsError from None
        return self._turn

    def run(self, course: Coroutine[Any, Any, None]) -> None:
        """Run the programs, and the loop of the pacing whenever they yield. Raises KeyboardInterrupt."""
        self._course = course
        try:
            self._hosted.run()
        finally:
            course.close()
            self.endings = [self._hosted.ended]


def _debugger(target: DebugTarget, on_quit: Callable[[], None]) -> NodeDebugger:
    """Return a debugger on this process's terminal. While it asks, Ctrl-C drops what was typed."""
    from vnet.runtime.debugger import NodeDebugger  # pdb, which few runs need

    return NodeDebugger(target, lambda: signals_handled(signal.default_int_handler, signal.SIGINT), on_quit)


class HostedPrograms:
    """The nodes of one process, which `run` takes from the first grant to the last.

    `only_programs_raise` tells whether a KeyboardInterrupt can only be the programs' own.
    """

    def __init__(
        self,
        welcomes: Sequence[wire.Welcome],
        programs: Programs,
        folder: RunFolder,
        swap: Swap,
        debugger: NodeDebugger | None = None,
    ) -> None:
        self._programs = programs
        self._swap = swap
        self._seq = 0
        self.only_programs_raise: Callable[[], bool] = lambda: True
        self.loop = VirtualTimeLoop(self._exchange, welcomes[0].spin_limit)
        self.meter = CpuMeter(shown=running_node.running)
        if folder.is_open:  # else nobody asks what programs have cost
            self.loop.measure(self.meter)
        self._logs = NodeLogs(folder.logs)
        self._host = Host(
            welcomes,
            lambda: self.loop.now_ns,
            on_line=self._logs.write,
            disks=Disks(folder.disks),
            debugger=debugger,
        )
        self._final = wire.Traffic()
        self._order_steps: Mapping[str, int] = {}

    @property
    def ended(self) -> Ended:
        """The answer at the end of the run."""
        return Ended(self._final, self.meter.cpu_ns, self.meter.wake_ups, self._order_steps)

    def _owns(self, node: Node) -> bool:
        """Return whether `node` is one of these, and not an earlier incarnation."""
        return self._host.nodes.get(node.id) is node

    def run(self) -> None:
        """From the first grant to the last. Raises KeyboardInterrupt."""
        with output_kept(self._owns, self._logs), caught(self._host.process_ended):
            asyncio.set_event_loop(self.loop)
            try:
                self._run()
            finally:
                asyncio.set_event_loop(None)
                self.loop.close()
                running_node.running.show("")
                self._host.discard_abandoned()
                if (ordered := self._host.mail.ordered) is not None:
                    self._order_steps = ordered.steps

    def _run(self) -> None:
        try:
            self._host.order_events(self.loop)
            self._host.start(self.loop, self._programs)
            self.loop.start_at(self._take(self._swap(None)))
            self._host.run(self.loop, self.only_programs_raise)
        except NoMoreGrantsError:
            self._close()
        except KeyboardInterrupt:
            self._host.forget_interrupt()
            self._close()
            raise

    def _close(self) -> None:
        self._host.close(self.loop)
        self._final = self._host.take_final()

    def _exchange(self, next_timer_ns: int | None) -> int:
        next_ns = self._host.next_instant(next_timer_ns)
        if next_ns is not None:
            return next_ns
        return self._take(self._swap(self._host.make_yield(NONCE, self._seq, next_timer_ns)))

    def _take(self, turn: Turn) -> int:
        calls, grant, mail = turn
        self._seq = grant.seq
        self._host.apply_clock_error(grant.clocks, self.loop)
        for name, arguments in calls:
            getattr(self._host, name)(*arguments)
        return self._host.open_window(grant, mail)


# What simulated programs print goes to the terminal, and to `logs/NODE.log` as in a run of many processes.

_lock = threading.Lock()
_simulations: list[tuple[Callable[[Node], bool], NodeLogs]] = []


@contextmanager
def output_kept(is_its_own: Callable[[Node], bool], logs: NodeLogs) -> Iterator[None]:
    """Write to `logs`, too, what is printed on behalf of the nodes that are a simulation's own within the block.

    What is printed on nobody's behalf, as by a module that is imported, goes to the terminal alone.
    """
    simulation = (is_its_own, logs)
    with _lock:
        _simulations.append(simulation)
        if not isinstance(sys.stdout, _Branched):
            sys.stdout = _Branched(sys.stdout)
        if not isinstance(sys.stderr, _Branched):
            sys.stderr = _Branched(sys.stderr)
    try:
        yield
    finally:
        with _lock:
            _simulations.remove(simulation)
            if not _simulations:
                sys.stdout, sys.stderr = _trunk(sys.stdout), _trunk(sys.stderr)
        logs.end_lines()


class _Branched:
    """Stands for stdout or stderr while programs run; all but what it also writes to logs is that of `stream`."""

    def __init__(self, stream: Any) -> None:
        self.stream = stream

    def write(self, text: str) -> int:
        """Write to the stream, and to the log of the node on whose behalf the present code runs."""
        written: int = self.stream.write(text)
        node = present_node()
        if node is not None:
            for is_its_own, logs in tuple(_simulations):
                if is_its_own(node):
                    logs.add(node.id, text)
        return written

    def writelines(self, lines: Iterable[str]) -> None:
        """Write each of these texts."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


def _trunk(stream: Any) -> Any:
    return stream.stream if isinstance(stream, _Branched) else stream
