"""Programs of a simulation: on the emulator's own virtual-time loop (`InLoop`), or in forked processes (`Pipes`).

The loop of the pacing and that of the programs take turns: the one waits where the other runs.

Forked, a process finds programs as they have been loaded, also those that no other process could import. What it is
told and what it says passes through a pair of sockets. What its programs print is a part of what it says: only the
emulator's process writes to the terminal, where there may be a picture.
"""

from __future__ import annotations

import asyncio
import gc
import io
import math
import os
import pickle
import select
import signal
import sys
import threading
import traceback
import warnings
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Collection, Coroutine, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from functools import partial
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from types import FrameType, coroutine
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn, TextIO

from msgspec.structs import replace

from emulator.drivers.emulation import Emulation, PeriodView, ProcessActions
from emulator.drivers.launch import Exit
from emulator.drivers.processes import Heard, Processes
from emulator.drivers.signals import signals_handled
from emulator.drivers.usage import first_over
from emulator.records.disk import NodeLogs
from emulator.records.events import EventKind
from emulator.records.run_folder import RunFolder
from vnet.errors import VnetError
from vnet.node import Node
from vnet.runtime import running_node
from vnet.runtime.arrivals import Mail
from vnet.runtime.debug_target import DebugTarget
from vnet.runtime.die_with_parent import end_left, rest_of_groups, signal_at_parent_death, started_processes
from vnet.runtime.error_text import NOT_THE_PROGRAM, error_line
from vnet.runtime.host import Disks, Host, is_discarding
from vnet.runtime.outside_loop import caught, collected_by_schedule, present_node
from vnet.runtime.programs import Programs, imports_noted, load_programs
from vnet.runtime.ready_queue import CpuMeter
from vnet.runtime.running_node import LOOK_S, Patience, RunningNode
from vnet.runtime.virtual_time import VirtualTimeLoop
from vnet.transport import wire

if TYPE_CHECKING:
    from vnet.runtime.debugger import NodeDebugger

STACK_S, MOST_CALLS = 1.0, 10
"""Seconds for which a process that does not answer is asked where it is, and the number of calls that are kept."""
_STACK = b"Most recent call last:\n"
"""Beginning of what such a process says; the pickles of other answers begin otherwise."""
NONCE = b""
"""Nonce of simulated processes, which nobody can impersonate."""


class NoMoreGrantsError(Exception):
    """The barrier has granted nothing more: the run is over, at `time_ns` if it was not cut short."""

    def __init__(self, time_ns: int | None) -> None:
        super().__init__()
        self.time_ns = time_ns


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
            raise NoMoreGrantsError(self._emulation.ended_ns) from None
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
        with process_kept(), output_kept(self._owns, self._logs), caught(self._host.process_ended):
            asyncio.set_event_loop(self.loop)
            try:
                with collected_by_schedule(), closing(self.loop):  # at the end nothing is collected any more
                    self._run()
            finally:
                asyncio.set_event_loop(None)
                self._host.discard_abandoned(running_node.running.show)
                if (ordered := self._host.mail.ordered) is not None:
                    self._order_steps = ordered.steps

    def _run(self) -> None:
        try:
            self._host.order_events(self.loop)
            self._host.start(self.loop, self._programs)
            self.loop.start_at(self._take(self._swap(None)))
            self._host.run(self.loop, self.only_programs_raise)
        except NoMoreGrantsError as end:
            self._close(end.time_ns)
        except KeyboardInterrupt:
            self._host.forget_interrupt()
            self._close(None)
            raise

    def _close(self, time_ns: int | None) -> None:
        self._host.close(self.loop, time_ns)
        self._final = self._host.take_final()

    def _exchange(self, next_timer_ns: int | None) -> int:
        next_ns = self._host.next_instant(next_timer_ns)
        if next_ns is not None:
            return next_ns
        return self._take(self._swap(self._host.make_yield(NONCE, self._seq, next_timer_ns)))

    def _take(self, turn: Turn) -> int:
        calls, grant, mail = turn
        self._seq = grant.seq
        for name, arguments in calls:
            getattr(self._host, name)(*arguments)
        self._host.apply_clock_error(grant.clocks, self.loop)  # after what has ended by then
        return self._host.open_window(grant, mail)


@contextmanager
def process_kept() -> Iterator[None]:
    """Take back what programs have changed of this process within the block, which goes on without them.

    The processes that they have started are ended, as by a live vehicle's end, unless another thread may have.
    """
    folder, variables, modules = Path.cwd(), dict(os.environ), list(sys.path)
    here = threading.current_thread()
    is_alone = here is threading.main_thread() and all(
        each.daemon or each is here for each in threading.enumerate()
    )
    others, finalizers = {*started_processes(os.getpid())}, {*_finalizers()}
    try:
        with imports_noted(lambda: present_node() is not None):
            yield
    finally:
        if is_alone:
            _end_pools(finalizers)
            end_left(started_processes(os.getpid(), others))
        os.chdir(folder)
        sys.path[:] = modules
        if os.environ != variables:
            os.environ.clear()
            os.environ.update(variables)


def _end_pools(others: set[Any]) -> None:
    """End the pools of processes beyond those that were there: they would replace processes that are ended."""
    for key, finalizer in _finalizers().items():
        if key not in others:
            with suppress(Exception):
                finalizer()


def _finalizers() -> dict[Any, Callable[[], object]]:
    """Return what multiprocessing does first at the end of a process: it ends pools and managers."""
    registry = getattr(sys.modules.get("multiprocessing.util"), "_finalizer_registry", {})
    first = [key for key in registry if key[0] is not None and key[0] >= 0]
    return {key: registry[key] for key in sorted(first, reverse=True)}


# What simulated programs print goes to the terminal, and to `logs/NODE.log` as in a run of many processes.

_lock = threading.Lock()
_simulations: list[tuple[Callable[[Node], bool], NodeLogs]] = []
_streams: tuple[Any, Any] = sys.stdout, sys.stderr
"""Stdout and stderr as they were before programs ran."""
_users = 0


@contextmanager
def output_kept(is_its_own: Callable[[Node], bool], logs: NodeLogs) -> Iterator[None]:
    """Write to `logs`, too, what is printed on behalf of the nodes that are a simulation's own within the block.

    What is printed on nobody's behalf, as by a module that is imported, goes to the terminal alone.
    """
    simulation = (is_its_own, logs)
    with output_branched():
        _simulations.append(simulation)
        try:
            yield
        finally:
            _simulations.remove(simulation)
            logs.end_lines()


@contextmanager
def output_branched() -> Iterator[None]:
    """Let what is printed, or bound by a module that is imported, be streams that write to logs, too."""
    global _streams, _users
    with _lock:
        if not _users:
            _streams = sys.stdout, sys.stderr
            sys.stdout, sys.stderr = map(_Branched, _streams)
        _users += 1
    try:
        yield
    finally:
        with _lock:
            _users -= 1
            if not _users:  # also where a program has set others
                sys.stdout, sys.stderr = _streams


class _Branched:
    """Stands for stdout or stderr while programs run; all but what it also writes to logs is that of `stream`.

    No program closes it: it has the output of all, and of vnet.
    """

    def __init__(self, stream: Any) -> None:
        self.stream = stream

    @property
    def buffer(self) -> io.BufferedIOBase:
        """The stream of bytes below it."""
        return _BranchedBytes(self)

    def flush(self) -> None:
        """Write what is held back."""
        with running_node.running.pause():
            self.stream.flush()

    close = flush

    def detach(self) -> io.BufferedIOBase:
        """Return the stream of bytes below it."""
        return self.buffer

    def write(self, text: str) -> int:
        """Write to the stream, and to the log of the node on whose behalf the present code runs, if it lives."""
        if is_discarding():
            return len(text)
        with running_node.running.pause():
            written: int = self.stream.write(text)
        self.keep(text)
        return written

    def keep(self, text: str) -> None:
        """Write to the log alone."""
        node = present_node()
        if node is not None:
            for is_its_own, logs in tuple(_simulations):
                if is_its_own(node):
                    logs.add(node.id, text)

    def writelines(self, lines: Iterable[str]) -> None:
        """Write each of these texts."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


class _BranchedBytes(io.BufferedIOBase):
    """Stands for the `buffer` of stdout or stderr. What closes it, as `io.TextIOWrapper` does, closes it alone."""

    def __init__(self, text: _Branched) -> None:
        self._text = text

    def writable(self) -> bool:
        """Return True."""
        return True

    def write(self, data: Any) -> int:
        """Write bytes; the log has them as text."""
        content = bytes(data)
        if is_discarding():
            return len(content)
        self.flush()  # what was written as text before
        with running_node.running.pause():
            self._text.stream.buffer.write(content)
        self._text.keep(content.decode(errors="replace"))
        return len(content)

    def flush(self) -> None:
        """Write what is held back."""
        self._text.flush()

    def fileno(self) -> int:
        """Return the descriptor of the stream."""
        return int(self._text.stream.fileno())


class ProcessDiedError(VnetError):
    """A process has ended before its time. Its text says how, and which node's program ran."""


class StalledError(VnetError):
    """A process does not end its window. Its text is the node whose program runs, `where` its lines."""

    def __init__(self, node: str, where: str) -> None:
        super().__init__(node)
        self.where = where


class _Said(NamedTuple):
    """One answer of the process, and what its programs have printed on both streams since the last one."""

    answer: wire.Yield | Ended | BaseException
    printed: tuple[str, str]


class ForkedPrograms:
    """One process of these nodes, at its parent's side. Raises VnetError if there can be none.

    `others` are those that have been forked before. In the process `detach` lets go of what only its parent needs.
    What its programs print is in their logs alone unless this process `prints` it.
    """

    def __init__(
        self,
        welcomes: Sequence[wire.Welcome],
        programs: Programs,
        folder: RunFolder,
        others: Sequence[ForkedPrograms],
        detach: Callable[[], None],
        stall_limit_s: float,
        prints: bool = True,
    ) -> None:
        self._prints = prints
        self._nodes = [welcome.node for welcome in welcomes]
        self.pid = 0
        """Its process id."""
        self._running = RunningNode()
        self._patience = Patience(self._running, stall_limit_s)
        self.owes = False
        """True while it has been given a turn that it has not answered."""
        self._is_gone = False
        for stream in (sys.stdout, sys.stderr):
            with suppress(AttributeError, OSError, ValueError):  # what is held back would be written twice
                stream.flush()
        try:
            self._connection, its = Pipe()
            with warnings.catch_warnings():  # of Python 3.12 about a display's thread, which this does not need
                warnings.simplefilter("ignore", DeprecationWarning)
                self.pid = os.fork()
        except OSError as error:
            raise VnetError(f"process {len(others) + 1} for programs: {error.strerror}") from None
        if self.pid == 0:
            for connection in (self._connection, *(other._connection for other in others)):
                connection.close()  # so that each process sees when its other end is gone
            running_node.running = self._running
            _be(its, welcomes, programs, folder, detach)
        its.close()
        self._answer = select.poll()  # as `Connection.poll`, which makes one at each call
        self._answer.register(self._connection.fileno(), select.POLLIN)

    def give(self, calls: Sequence[Call], grant: wire.Grant) -> None:
        """Give it a window, with what is to be called before.

        A grant may have thousands of packets: it is encoded sooner than pickled. Encoded it only refers to messages
        of the backbone.
        """
        self._tell((calls, wire.encode(replace(grant, messages=())), grant.messages))

    def end(self, time_ns: int | None) -> None:
        """Have its programs end: the run is over, at this time if it was not cut short."""
        self._tell(time_ns)

    def _tell(self, told: Any) -> None:
        self.owes = True
        with suppress(OSError):  # it has ended, which `take` tells, or the error that it has raised before
            self._connection.send_bytes(pickle.dumps(told))

    def take(self) -> Any:
        """Wait for its answer: a yield, or `Ended`. Raises ProcessDiedError, and what it has raised.

        Raises StalledError if one of its nodes runs for `stall_limit_s` without a pause.
        """
        while not self._answer.poll(LOOK_S * 1000):
            if self._patience.is_over(self.pid):
                raise StalledError(self._running.read(), self._stack())
        try:
            while (content := self._connection.recv_bytes()).startswith(_STACK):
                pass  # somebody else has asked
            said: _Said = pickle.loads(content)
        except (EOFError, OSError):
            self._raise_ended()
        self.owes = False
        for stream, text in zip((sys.stdout, sys.stderr), said.printed, strict=True):
            if text and self._prints:
                _write(stream, text)
        if isinstance(said.answer, BaseException):
            raise said.answer
        return said.answer

    def _stack(self) -> str:
        """Return the lines of the program that does not answer; "" if it computes in C."""
        os.kill(self.pid, signal.SIGUSR1)
        with suppress(EOFError, OSError):
            if self._answer.poll(STACK_S * 1000) and (said := self._connection.recv_bytes()).startswith(_STACK):
                return said.removeprefix(_STACK).decode(errors="replace")
        return ""

    def _raise_ended(self) -> NoReturn:
        _, status = os.waitpid(self.pid, 0)
        self._is_gone = True
        how = Exit(os.waitstatus_to_exitcode(status), "").how
        node = self._running.read()
        raise ProcessDiedError(f"{how}, while {node} ran" if node and len(self._nodes) > 1 else how) from None

    def close(self) -> None:
        """End it, whatever it does."""
        self._connection.close()
        if not self._is_gone:
            self._is_gone = True
            os.kill(self.pid, signal.SIGKILL)
            os.waitpid(self.pid, 0)


class Pipes(LocalProcesses):
    """The nodes in parts in processes forked from this one, which work side by side.

    What their programs print is in their logs alone unless this process `prints` it.
    """

    def __init__(
        self, emulation: Emulation, groups: Sequence[Sequence[str]], stop: threading.Event, prints: bool
    ) -> None:
        super().__init__(emulation, groups, stop)
        self._prints = prints
        self._welcomes = {nodes[0]: self.welcomes(nodes) for nodes in groups}
        self._programs = load_programs(each for welcomes in self._welcomes.values() for each in welcomes)
        self._processes: dict[str, ForkedPrograms] = {}
        self._granted: list[str] = []
        """Processes that have been granted a window and not been heard since."""
        self._heard: deque[Heard] = deque()
        self._died: dict[str, dict[str, Any]] = {}
        self._limit_s = emulation.scenario.run.stall_timeout_s

    def send(self, process_id: str, message: wire.Grant | wire.Batch, mail: Mail | None = None) -> None:
        """Give a process its next window."""
        assert isinstance(message, wire.Grant) and mail is not None
        self._processes[process_id].give(self._take_calls(process_id), mail.within(message))
        self._granted.append(process_id)
        self._now_ns = message.time_ns

    async def receive(self, timeout_s: float = math.inf) -> Heard | None:
        """Wait for the yields of all processes. Raises KeyboardInterrupt if the run is to end."""
        if self._granted:
            granted, self._granted = self._granted, []
            try:
                answers = {process_id: self._take(process_id) for process_id in granted}
            except StalledError as stalled:
                self.is_cut_short = True
                error = f"no yield within {self._limit_s:g} s of wall clock"
                told = {"error": error, "where": stalled.where}
                self._emulation.folder.event(self._now_ns, EventKind.stalled, str(stalled), **told)
                raise KeyboardInterrupt from None
            self._heard = deque(Heard(process_id, each) for process_id, each in answers.items() if each is not None)
            if self.is_ending:
                raise KeyboardInterrupt
        return self._heard.popleft() if self._heard else None

    def _take(self, process_id: str) -> Any:
        """Return the answer of a process; None if it has ended before its time."""
        try:
            return self._processes[process_id].take()
        except ProcessDiedError as death:
            self._died[process_id] = {"how": str(death)}
            return None

    def ended(self, among: Collection[str] | None = None) -> dict[str, dict[str, Any]]:
        """Return the processes that have ended before their time, with how, and have not been returned yet."""
        died, self._died = self._died, {}
        return died

    def run(self, course: Coroutine[Any, Any, None]) -> None:
        """Fork the processes, and run the loop of the pacing, which waits for them. Raises KeyboardInterrupt."""
        processes = self._processes
        try:
            for process_id, welcomes in self._welcomes.items():
                processes[process_id] = ForkedPrograms(
                    welcomes,
                    self._programs,
                    self._emulation.folder,
                    others=list(processes.values()),
                    detach=self._emulation.driving.detach,
                    stall_limit_s=self._limit_s,
                    prints=self._prints,
                )
                self.pids[process_id] = processes[process_id].pid
            with suppress(StopIteration):
                course.send(None)
        except KeyboardInterrupt:
            self._end()
            raise
        else:
            self._end()
        finally:
            course.close()
            for process in processes.values():
                process.close()
            end_left(rest_of_groups({process.pid for process in processes.values()}))

    def _end(self) -> None:
        """End all processes but those that are in the midst of a window, and take what they have left to say."""
        asked = [process_id for process_id, process in self._processes.items() if not process.owes]
        for process_id in asked:
            self._processes[process_id].end(self._emulation.ended_ns)
        for process_id in asked:
            try:
                self.endings.append(self._processes[process_id].take())
            except ProcessDiedError as death:
                self._died[process_id] = {"how": str(death)}
            except StalledError as stalled:
                self._died[process_id] = {"how": f"did not end within {self._limit_s:g} s, while {stalled} ran"}


def _write(stream: TextIO, text: str) -> None:
    """Write what a program has printed, without the characters that the stream has not: the run goes on."""
    encoding = getattr(stream, "encoding", None) or "utf-8"
    stream.write(text.encode(encoding, "replace").decode(encoding))


# In the process.


def _be(
    connection: Connection,
    welcomes: Sequence[wire.Welcome],
    programs: Programs,
    folder: RunFolder,
    detach: Callable[[], None],
) -> NoReturn:
    """Be the process of these nodes, to its end."""
    status = 1
    try:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        os.setpgid(0, 0)  # by it what programs have started is found, and nothing that ends the parent's ends it
        # A group in the background does not read from the terminal, and is not stopped for that it writes there.
        null = os.open(os.devnull, os.O_RDONLY)
        os.dup2(null, 0)
        os.close(null)
        for number in (signal.SIGTTIN, signal.SIGTTOU):
            signal.signal(number, signal.SIG_IGN)
        signal.signal(signal.SIGUSR1, partial(_tell_stack, connection, os.getpid()))
        signal_at_parent_death(signal.SIGKILL)
        detach()
        gc.freeze()
        _run(connection, welcomes, programs, folder)
        status = 0
    finally:
        os._exit(status)  # what has been opened and begun before the fork is the parent's to end


def _run(connection: Connection, welcomes: Sequence[wire.Welcome], programs: Programs, folder: RunFolder) -> None:
    printed = _Printed(sys.stdout), _Printed(sys.stderr)
    sys.stdout, sys.stderr = printed

    def say(answer: wire.Yield | Ended | BaseException) -> None:
        out, error = printed
        connection.send_bytes(pickle.dumps(_Said(answer, (out.take(), error.take()))))

    def swap(message: wire.Yield | None) -> Turn:
        if message is not None:
            say(message)
        told: Any = pickle.loads(connection.recv_bytes())
        if told is None or isinstance(told, int):
            raise NoMoreGrantsError(told)
        calls, encoded, messages = told
        grant = wire.decode_rx(encoded)
        assert isinstance(grant, wire.Grant)
        return calls, replace(grant, messages=messages), None

    try:
        hosted = HostedPrograms(welcomes, programs, folder, swap)
        hosted.run()
        _flush_files()
        say(hosted.ended)
    except BaseException as error:
        _flush_files()
        say(error if isinstance(error, VnetError) else RuntimeError(error_line(error)))


def _tell_stack(connection: Connection, pid: int, _: int, frame: FrameType | None) -> None:
    """Say the lines of the program that runs, the innermost last, as a traceback has them."""
    if os.getpid() != pid:
        return  # a child of the program's
    calls = traceback.extract_stack(frame)
    ours = [number for number, call in enumerate(calls, 1) if call.filename == __file__]
    own = [call for call in calls[max(ours, default=0) :] if not call.filename.startswith(NOT_THE_PROGRAM)]
    lines = "".join(traceback.format_list(own or calls)[-MOST_CALLS:])
    connection.send_bytes(_STACK + lines.encode(errors="replace"))


def _flush_files() -> None:
    """Write what programs have yet to write to files, as the end of a process does.

    Files that were open before the fork are the parent's: `gc.freeze` has put them where they are not found.
    """
    for each in gc.get_objects():
        if type(each) in (io.TextIOWrapper, io.BufferedWriter, io.BufferedRandom):
            with suppress(OSError, ValueError):  # it is closed, or its disk is full
                each.flush()


class _Printed(io.TextIOWrapper):
    """A stream that keeps what is written until it is taken, in place of `stream`, whose encoding it has."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._kept = _Kept()
        encoding = getattr(stream, "encoding", None) or "utf-8"
        errors = getattr(stream, "errors", None) or "replace"
        super().__init__(self._kept, encoding=encoding, errors=errors, write_through=True)

    def fileno(self) -> int:
        """Return the descriptor of the stream, for what other processes write."""
        return self._stream.fileno()

    def take(self) -> str:
        """Return what was written since the last call."""
        self.flush()
        return self._kept.take().decode(self.encoding, "replace")


class _Kept(io.BytesIO):
    """The bytes of a stream, which threads may write while they are taken."""

    def __init__(self) -> None:
        super().__init__()
        self._lock = threading.RLock()

    def write(self, data: Any, /) -> int:
        """Keep some more."""
        with self._lock:
            return super().write(data)

    def take(self) -> bytes:
        """Return what was written since the last call."""
        with self._lock:
            written = self.getvalue()
            self.seek(0)
            self.truncate()
        return written
