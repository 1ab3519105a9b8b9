"""Programs of a simulation in a process of their own, forked from the emulator's.

Forked, it finds programs as they have been loaded, also those that no other process could import. What it is told
and what it says passes through a pair of sockets. What its programs print is a part of what it says: only the
emulator's process writes to the terminal, where there may be a picture.
"""

from __future__ import annotations

import gc
import io
import os
import pickle
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any, NamedTuple, NoReturn, TextIO

from msgspec.structs import replace

from emulator.drivers.hosted_programs import Changes, HostedPrograms, RunOverError, Turn
from emulator.drivers.launch import Exit
from emulator.records.run_folder import RunFolder
from vnet.errors import VnetError
from vnet.runtime import running_node
from vnet.runtime.die_with_parent import signal_at_parent_death
from vnet.runtime.programs import Programs, error_line
from vnet.runtime.running_node import LOOK_S, Patience, RunningNode
from vnet.transport import wire
from vnet.transport.backbone import MessageRef


class Ended(NamedTuple):
    """The last answer of a process, when the run is over: its figures are those of `HostedPrograms`."""

    final: wire.Traffic
    cpu_ns: Mapping[str, int]
    wake_ups: Mapping[str, int]
    order_steps: Mapping[str, int]


class ProcessDiedError(VnetError):
    """A process has ended before its time. Its text says how, and which node's program ran."""


class StalledError(VnetError):
    """A process does not end its window. Its text is the node whose program runs."""


class _Said(NamedTuple):
    """One answer of the process, and what its programs have printed on both streams since the last one."""

    answer: wire.Yield | Ended | BaseException
    printed: tuple[str, str]


class _Told(NamedTuple):
    """A turn as it is passed: a grant, which may have thousands of packets, is encoded sooner than pickled."""

    changes: Sequence[Changes]
    grant: bytes
    messages: Sequence[MessageRef]
    """Messages of the backbone, which an encoded grant only refers to."""

    @classmethod
    def of(cls, turn: Turn) -> _Told:
        """Return the form of a turn."""
        return cls(turn.changes, wire.encode(replace(turn.grant, messages=())), turn.grant.messages)

    def turn(self) -> Turn:
        """Return the turn."""
        grant = wire.decode_rx(self.grant)
        assert isinstance(grant, wire.Grant)
        return Turn(self.changes, replace(grant, messages=self.messages))


class ForkedPrograms:
    """The process of these nodes, at its parent's side. Raises VnetError if there can be none.

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
        prints: bool = True,
    ) -> None:
        self._prints = prints
        self._nodes = [welcome.node for welcome in welcomes]
        self.pid = 0
        """Its process id."""
        self._running = RunningNode()
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

    def give(self, turn: Turn | None) -> None:
        """Give it a turn; None says that the run is over."""
        self.owes = True
        with suppress(OSError):  # it has ended, which `take` tells, or the error that it has raised before
            self._connection.send_bytes(pickle.dumps(None if turn is None else _Told.of(turn)))

    def take(self, stall_limit_s: float) -> Any:
        """Wait for its answer: a yield, or `Ended`. Raises ProcessDiedError, and what it has raised.

        Raises StalledError if one of its nodes runs for `stall_limit_s` without a pause.
        """
        patience = Patience(self._running, stall_limit_s)
        while not self._connection.poll(LOOK_S):
            if patience.is_over(self.pid):
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
        told: _Told | None = pickle.loads(connection.recv_bytes())
        if told is None:
            raise RunOverError
        return told.turn()

    try:
        hosted = HostedPrograms(welcomes, programs, folder, swap)
        hosted.run()
        _flush_files()
        say(Ended(hosted.final, hosted.meter.cpu_ns, hosted.meter.wake_ups, hosted.order_steps))
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
