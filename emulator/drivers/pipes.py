"""Programs of a simulation in a process of their own, forked from the emulator's.

Forked, it finds programs as they have been loaded, also those that no other process could import. What it is told
and what it says passes through a pair of sockets. What its programs print is a part of what it says: only the
emulator's process writes to the terminal, where there may be a picture.
"""

from __future__ import annotations

import gc
import io
import math
import os
import pickle
import select
import signal
import sys
import threading
import warnings
from collections import deque
from collections.abc import Callable, Collection, Coroutine, Sequence
from contextlib import suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any, NamedTuple, NoReturn, TextIO

from msgspec.structs import replace

from emulator.drivers.emulation import Emulation
from emulator.drivers.launch import Exit
from emulator.drivers.local import Call, Ended, HostedPrograms, LocalProcesses, NoMoreGrantsError, Turn
from emulator.drivers.processes import Heard
from emulator.records.events import EventKind
from emulator.records.run_folder import RunFolder
from vnet.errors import VnetError
from vnet.runtime import running_node
from vnet.runtime.arrivals import Mail
from vnet.runtime.die_with_parent import signal_at_parent_death
from vnet.runtime.programs import Programs, error_line, load_programs
from vnet.runtime.running_node import LOOK_S, Patience, RunningNode
from vnet.transport import wire


class ProcessDiedError(VnetError):
    """A process has ended before its time. Its text says how, and which node's program ran."""


class StalledError(VnetError):
    """A process does not end its window. Its text is the node whose program runs."""


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

    def give(self, calls: Sequence[Call], grant: wire.Grant | None) -> None:
        """Give it a window, with what is to be called before; without one the run is over.

        A grant may have thousands of packets: it is encoded sooner than pickled. Encoded it only refers to messages
        of the backbone.
        """
        self.owes = True
        told = None if grant is None else (calls, wire.encode(replace(grant, messages=())), grant.messages)
        with suppress(OSError):  # it has ended, which `take` tells, or the error that it has raised before
            self._connection.send_bytes(pickle.dumps(told))

    def take(self) -> Any:
        """Wait for its answer: a yield, or `Ended`. Raises ProcessDiedError, and what it has raised.

        Raises StalledError if one of its nodes runs for `stall_limit_s` without a pause.
        """
        while not self._answer.poll(LOOK_S * 1000):
            if self._patience.is_over(self.pid):
                raise StalledError(self._running.read())
        try:
            said: _Said = pickle.loads(self._connection.recv_bytes())
        except (EOFError, OSError):
            self._raise_ended()
        self.owes = False
        for stream, text in zip((sys.stdout, sys.stderr), said.printed, strict=True):
            if text and self._prints:
                _write(stream, text)
        if isinstance(said.answer, BaseException):
            raise said.answer
        return said.answer

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
                self._emulation.folder.event(self._now_ns, EventKind.stalled, str(stalled), error=error)
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

    def _end(self) -> None:
        """End all processes but those that are in the midst of a window, and take what they have left to say."""
        asked = [process_id for process_id, process in self._processes.items() if not process.owes]
        for process_id in asked:
            self._processes[process_id].give((), None)
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
        if told is None:
            raise NoMoreGrantsError
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
