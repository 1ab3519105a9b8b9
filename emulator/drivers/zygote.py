"""The emulator's side of the zygote: the process that forks a run's agents, and the processes forked from it.

A fork shares what the zygote has imported, so that an agent costs milliseconds and a few megabytes, where a new
interpreter costs half a second and tens of megabytes. `agents/zygote.py` is the other side.
"""

from __future__ import annotations

import ctypes
import os
import select
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Protocol

from vnet.errors import VnetError
from vnet.runtime import forking
from vnet.runtime.die_with_parent import STARTED_BY_VNET
from vnet.runtime.environment import KEPT_MEMORY, SAME_ARITHMETIC
from vnet.runtime.own_packages import foreign_on_path
from vnet.transport.scheduling import default_time_slice
from vnet.transport.session import AGENT_RUNTIME, LOCKSTEP_AGENT_RUNTIME, RUNTIME_VARIABLE

AGENT_ENVIRONMENT = {
    "PYTHONHASHSEED": "0",
    RUNTIME_VARIABLE: AGENT_RUNTIME,
    "PYTHONUNBUFFERED": "1",
    STARTED_BY_VNET: "1",
    **KEPT_MEMORY,
}
LOCKSTEP_ENVIRONMENT = {**AGENT_ENVIRONMENT, RUNTIME_VARIABLE: LOCKSTEP_AGENT_RUNTIME}
"""The environment of agents in lockstep, forked or spawned."""
START_TIMEOUT_S = 60.0
"""Seconds for the zygote to import its modules, or to answer: long enough for a loaded machine."""
ROOM_FOR_ARGUMENTS = 300
"""Characters of its arguments that a forked agent can show in /proc/PID/cmdline beside its interpreter's path."""

_PR_SET_CHILD_SUBREAPER = 36
_PR_GET_CHILD_SUBREAPER = 37


class ZygoteGoneError(Exception):
    """The zygote has ended before it answered."""


class Process(Protocol):
    """A child process, as `subprocess.Popen` has it."""

    pid: int

    def poll(self) -> int | None:
        """Return the exit status (minus the signal's number), or None while it runs."""

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end. Raises subprocess.TimeoutExpired."""

    def send_signal(self, sig: int) -> None:
        """Send it a signal, unless it has ended."""

    def terminate(self) -> None:
        """Send it SIGTERM."""

    def kill(self) -> None:
        """Send it SIGKILL."""


class ForkedProcess:
    """A process that was forked from the zygote, and whose parent is this process; its group ends with it."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self._status: int | None = None

    def poll(self) -> int | None:
        """Return the exit status (minus the signal's number), or None while it runs."""
        if self._status is None and has_ended(self.pid):
            with rest_of_group_ended(self.pid):
                self._status = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
        return self._status

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end, at most so many seconds. Raises subprocess.TimeoutExpired."""
        status = self.poll()
        if status is None:
            wait_until_ended(self.pid, timeout)
            status = self.poll()
        if status is None:
            raise subprocess.TimeoutExpired(str(self.pid), timeout or 0.0)
        return status

    def send_signal(self, sig: int) -> None:
        """Send it a signal, unless it has ended."""
        if self.poll() is None:
            os.kill(self.pid, sig)

    def terminate(self) -> None:
        """Send it SIGTERM."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """Send it SIGKILL."""
        self.send_signal(signal.SIGKILL)


class _Subreaper:
    """Adoption of orphaned descendants by this process, as long as a zygote is in use."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._zygotes = 0
        self._before = 0

    def begin(self) -> None:
        """Adopt orphans from now on."""
        with self._lock:
            if self._zygotes == 0:
                before = ctypes.c_int()
                _prctl(_PR_GET_CHILD_SUBREAPER, ctypes.byref(before))
                self._before = before.value
                _prctl(_PR_SET_CHILD_SUBREAPER, 1)
            self._zygotes += 1

    def end(self) -> None:
        """Do as before the first `begin`, once every one of them has had its `end`."""
        with self._lock:
            self._zygotes -= 1
            if self._zygotes == 0:
                _prctl(_PR_SET_CHILD_SUBREAPER, self._before)


def _prctl(option: int, argument: object) -> None:
    if ctypes.CDLL(None).prctl(option, argument, 0, 0, 0) != 0:
        raise VnetError('run.start = "fork": this system cannot adopt processes; use --set run.start=spawn')


_subreaper = _Subreaper()


class Zygote:
    """The process from which agents are forked. `modules` are imported there, if they are vnet's own programs.

    `environment` is that of agents, beside this process's own.
    """

    def __init__(self, modules: Sequence[str], environment: Mapping[str, str] = AGENT_ENVIRONMENT) -> None:
        self._environment = environment
        self._modules = [module for module in modules if module.partition(".")[0] == "agents"]
        self._process: subprocess.Popen[bytes] | None = None
        self._ready = False

    @property
    def pid(self) -> int | None:
        """Its process id; None before `start` and after `close`."""
        return None if self._process is None else self._process.pid

    def start(self) -> None:
        """Start the process, again if need be; it is ready a little later. Raises VnetError."""
        if self._process is None:
            _subreaper.begin()
        else:
            self._discard()
        self._ready = False
        self._output = tempfile.TemporaryFile()  # noqa: SIM115  # closed by _discard
        self._channel, other_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._channel.settimeout(START_TIMEOUT_S)
        arguments = [str(other_end.fileno()), *self._modules, " " * ROOM_FOR_ARGUMENTS]
        try:
            with default_time_slice():
                self._process = subprocess.Popen(
                    [sys.executable, "-P", "-m", "agents.zygote", *arguments],
                    stdin=subprocess.DEVNULL,
                    stdout=self._output,
                    stderr=subprocess.STDOUT,
                    pass_fds=[other_end.fileno()],
                    process_group=0,
                    env={**SAME_ARITHMETIC, **os.environ, **self._environment},
                )
        except OSError as error:
            raise VnetError(f"cannot start the process from which agents are forked: {error.strerror}") from None
        finally:
            other_end.close()

    def is_ready(self) -> bool:
        """Return whether it has imported its modules. Raises VnetError if it ended before."""
        if not self._ready:
            poll = select.poll()
            poll.register(self._channel, select.POLLIN)
            if poll.poll(0):
                self._await_ready()
        return self._ready

    def _await_ready(self) -> None:
        try:
            self._receive()
        except ZygoteGoneError:
            raise VnetError(self._describe_end()) from None
        self._ready = True

    def _describe_end(self) -> str:
        assert self._process is not None
        status = self._process.wait()
        self._output.seek(0)
        said = self._output.read().decode(errors="replace").splitlines() or ["it said nothing"]
        last = said[-1]
        if "No module named" in last and (foreign := foreign_on_path("agents")):
            last = f"{last}; {foreign}"
        return f"the process from which agents are forked ended before the start (status {status}): {last}"

    def fork(self, request: forking.ForkRequest, descriptors: Sequence[int]) -> forking.ForkReply:
        """Fork the agents of a request, with two descriptors each. Raises VnetError and ZygoteGoneError."""
        if not self._ready:
            self._await_ready()
        with suppress(BrokenPipeError, ConnectionError):  # then it is gone
            socket.send_fds(self._channel, [forking.encode(request)], list(descriptors))
        return self._receive()

    def _receive(self) -> forking.ForkReply:
        try:
            data = self._channel.recv(forking.LONGEST_MESSAGE_BYTES)
        except TimeoutError:
            raise VnetError(
                f"the process from which agents are forked does not answer within {START_TIMEOUT_S:g} s"
            ) from None
        except ConnectionError:
            data = b""
        if not data:
            raise ZygoteGoneError
        return forking.decode_reply(data)

    def start_if_gone(self) -> None:
        """Start it again if it has ended after it was ready."""
        if self._ready and self._process is not None and self._process.poll() is not None:
            self.start()

    def close(self) -> None:
        """End the process. Agents that were forked from it go on."""
        if self._process is not None:
            self._discard()
            self._process = None
            _subreaper.end()

    def _discard(self) -> None:
        assert self._process is not None
        self._process.kill()
        self._process.wait()
        self._channel.close()
        self._output.close()


# Ending a process together with its process group: what a program has forked ends with its vehicle.
#
# A group is killed between the end of its first process and the call that forgets it: until then no other process
# can get its id. A descendant that has left the group, as a session of its own does, is not reached.


def has_ended(pid: int) -> bool:
    """Return whether a child of this process has ended, or is none (any more); does not forget it."""
    try:
        return os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None
    except ChildProcessError:
        return True


def wait_until_ended(pid: int, timeout_s: float | None) -> None:
    """Wait for the end of a child of this process that nobody has waited for yet, at most so many seconds."""
    descriptor = os.pidfd_open(pid)
    try:
        poll = select.poll()
        poll.register(descriptor, select.POLLIN)
        poll.poll(None if timeout_s is None else timeout_s * 1000)
    finally:
        os.close(descriptor)


@contextmanager
def rest_of_group_ended(pid: int) -> Iterator[None]:
    """Kill the group of a process that has ended; the block waits for the process itself.

    Those of the group that this process has adopted are waited for.
    """
    with suppress(ProcessLookupError, PermissionError):  # it has ended before it had a group
        os.killpg(pid, signal.SIGKILL)
    yield
    with suppress(ChildProcessError):
        while True:
            os.waitpid(-pid, 0)


class GroupProcess(subprocess.Popen[bytes]):
    """A process started in a group of its own, which ends with it."""

    def poll(self) -> int | None:
        """Return the exit status (minus the signal's number), or None while it runs."""
        if self.returncode is None and has_ended(self.pid):
            with rest_of_group_ended(self.pid):
                super().poll()
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end, at most so many seconds. Raises subprocess.TimeoutExpired."""
        if self.poll() is None:
            wait_until_ended(self.pid, timeout)
        status = self.poll()
        if status is None:
            raise subprocess.TimeoutExpired(self.args, timeout or 0.0)
        return status
