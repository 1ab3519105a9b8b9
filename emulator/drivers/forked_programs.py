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
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any, NamedTuple, NoReturn

from msgspec.structs import replace

from emulator.drivers.hosted_programs import Changes, HostedPrograms, RunOverError, Turn
from emulator.records.run_folder import RunFolder
from vnet.errors import VnetError
from vnet.runtime.die_with_parent import signal_at_parent_death
from vnet.runtime.programs import Programs, error_line
from vnet.transport import wire
from vnet.transport.backbone import MessageRef


class Ended(NamedTuple):
    """The last answer of a process, when the run is over: its figures are those of `HostedPrograms`."""

    final: wire.Traffic
    cpu_ns: Mapping[str, int]
    wake_ups: Mapping[str, int]
    order_steps: Mapping[str, int]


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
    """The process of these nodes, at its parent's side. `others` are those that have been forked before."""

    def __init__(
        self,
        welcomes: Sequence[wire.Welcome],
        programs: Programs,
        folder: RunFolder,
        others: Sequence[ForkedPrograms],
    ) -> None:
        self._nodes = [welcome.node for welcome in welcomes]
        self._connection, its = Pipe()
        self.owes = False
        """True while it has been given a turn that it has not answered."""
        self._is_gone = False
        for stream in (sys.stdout, sys.stderr):
            with suppress(AttributeError, OSError, ValueError):  # what is held back would be written twice
                stream.flush()
        with warnings.catch_warnings():  # of Python 3.12 about a display's thread, which this does not need
            warnings.simplefilter("ignore", DeprecationWarning)
            self._pid = os.fork()
        if self._pid == 0:
            for connection in (self._connection, *(other._connection for other in others)):
                connection.close()  # so that each process sees when its other end is gone
            _be(its, welcomes, programs, folder)
        its.close()

    def give(self, turn: Turn | None) -> None:
        """Give it a turn; None says that the run is over. Raises VnetError if it has ended."""
        self.owes = True
        try:
            self._connection.send_bytes(pickle.dumps(None if turn is None else _Told.of(turn)))
        except OSError:
            self._raise_ended()

    def take(self) -> Any:
        """Wait for its answer: a yield, or `Ended`. Raises VnetError if it has ended, and what it has raised."""
        try:
            said: _Said = pickle.loads(self._connection.recv_bytes())
        except (EOFError, OSError):
            self._raise_ended()
        self.owes = False
        for stream, text in zip((sys.stdout, sys.stderr), said.printed, strict=True):
            if text:
                stream.write(text)
        if isinstance(said.answer, BaseException):
            raise said.answer
        return said.answer

    def _raise_ended(self) -> NoReturn:
        _, status = os.waitpid(self._pid, 0)
        self._is_gone = True
        code = os.waitstatus_to_exitcode(status)
        how = signal.Signals(-code).name if code < 0 else f"status {code}"
        first, last = self._nodes[0], self._nodes[-1]
        raise VnetError(f"the process of {first} to {last} ended with {how} in the middle of the run") from None

    def close(self) -> None:
        """End it, whatever it does."""
        self._connection.close()
        if not self._is_gone:
            self._is_gone = True
            os.kill(self._pid, signal.SIGKILL)
            os.waitpid(self._pid, 0)


# In the process.


def _be(
    connection: Connection, welcomes: Sequence[wire.Welcome], programs: Programs, folder: RunFolder
) -> NoReturn:
    """Be the process of these nodes, to its end."""
    status = 1
    try:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        signal_at_parent_death(signal.SIGKILL)
        gc.freeze()
        _run(connection, welcomes, programs, folder)
        status = 0
    finally:
        os._exit(status)  # what has been opened and begun before the fork is the parent's to end


def _run(connection: Connection, welcomes: Sequence[wire.Welcome], programs: Programs, folder: RunFolder) -> None:
    printed = _Printed(), _Printed()
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
        say(Ended(hosted.final, hosted.meter.cpu_ns, hosted.meter.wake_ups, hosted.order_steps))
    except BaseException as error:
        say(error if isinstance(error, VnetError) else RuntimeError(error_line(error)))


class _Printed(io.TextIOWrapper):
    """A stream that keeps what is written until it is taken."""

    def __init__(self) -> None:
        self._kept = io.BytesIO()
        super().__init__(self._kept, encoding="utf-8", errors="replace", write_through=True)

    def take(self) -> str:
        """Return what was written since the last call."""
        self.flush()
        written = self._kept.getvalue().decode(errors="replace")
        self._kept.seek(0)
        self._kept.truncate()
        return written
