"""Starting agent processes, watching them, and ending every one of them.

Each process gets a log, a process group of its own (so that Ctrl-C in the terminal reaches only the emulator) that
ends with it, a fixed hash seed, the same arithmetic, and its credentials through an inherited descriptor. They stay
in the emulator's session: Linux shares processors out between sessions first (autogroups, sched(7), where no CPU
cgroup does), whatever their niceness.

Agents are forked from a zygote, or are interpreters of their own. A fork shares what the zygote has imported, so
that an agent costs milliseconds and a few megabytes, where a new interpreter costs half a second and tens of
megabytes. `agents/zygote.py` is the other side of the `Zygote` here.
"""

from __future__ import annotations

import _posixsubprocess
import inspect
import os
import select
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Protocol

from emulator.drivers.debugging import DebugPoint
from emulator.drivers.usage import cpu_time_ns
from emulator.records.disk import cut_log
from vnet.errors import VnetError
from vnet.runtime import forking
from vnet.runtime.die_with_parent import STARTED_BY_VNET, TIED, adoption
from vnet.runtime.environment import KEPT_MEMORY, SAME_ARITHMETIC
from vnet.runtime.own_packages import foreign_on_path
from vnet.transport.access import Access, node_user
from vnet.transport.credentials import Credentials
from vnet.transport.scheduling import default_time_slice
from vnet.transport.session import AGENT_RUNTIME, LOCKSTEP_AGENT_RUNTIME, RUNTIME_VARIABLE
from vnet.units import NS_PER_S

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

LOG_TAIL_LINES = 12
LOWEST_PRIORITY = 19
STARVED = 0.1
"""Share of a processor below which a process that wants to run has got none: its machine keeps it from ending."""
STARVED_LOOKS = 10
STARVED_LOOK_S = 0.02
"""Looks at a process, and seconds between two, until it counts as starved."""
CREDENTIALS = "{credentials}"
PLACEHOLDERS = ("{endpoint}", "{run}", "{node}", CREDENTIALS)
"""Words in an agent's command that stand for what differs from one to the next."""
MOST_ZYGOTES = 3
"""Attempts to fork an agent: a zygote that has ended is started again."""


class ZygoteGoneError(Exception):
    """The zygote has ended before it answered; its last line says why."""


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


def can_fork() -> bool:
    """Return whether agents can be forked here.

    A debugger that follows new processes (that of VS Code, of PyCharm) starts itself in each, with threads, so that
    a zygote could not fork: it then follows agents that are interpreters of their own.
    """
    return sys.platform == "linux" and inspect.isbuiltin(_posixsubprocess.fork_exec)


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
        if self._process is not None:
            self._discard()
        elif not adoption.begin():
            raise VnetError('run.start = "fork": this system cannot adopt processes; use --set run.start=spawn')
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
        last = self._last_line()
        if "No module named" in last and (foreign := foreign_on_path("agents")):
            last = f"{last}; {foreign}"
        return f"the process from which agents are forked ended before the start (status {status}): {last}"

    def _last_line(self) -> str:
        self._output.seek(0)
        return (self._output.read().decode(errors="replace").splitlines() or ["it said nothing"])[-1]

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
            raise ZygoteGoneError(self._last_line())
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
            adoption.end()

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


COMMAND = "VNET_COMMAND"
"""Variable of a command's environment whose value no other command has: by it all is found that it has started."""


STRAY_LOOKS = 2
"""Times that a command's processes outside of its group are ended: one may just have started another."""


class GroupProcess(subprocess.Popen[bytes]):
    """A process started in a group of its own, which ends with it.

    A command's processes do so wherever they have gone: job control, `setsid` and `script` leave the group.
    """

    _groups: ClassVar[set[int]] = {os.getpgrp()}
    """This process's own group, and those of all that it has started."""

    def __init__(self, command: Sequence[str], mark: str | None, **options: Any) -> None:
        self._mark = None if mark is None else f"{COMMAND}={mark}".encode()
        super().__init__(command, **options)
        self._groups.add(self.pid)

    def poll(self) -> int | None:
        """Return the exit status (minus the signal's number), or None while it runs."""
        if self.returncode is None and has_ended(self.pid):
            with rest_of_group_ended(self.pid):
                super().poll()
            for _ in range(STRAY_LOOKS):
                for stray in self._strays():
                    with suppress(OSError):  # it has ended, or its parent waits for it
                        os.kill(stray, signal.SIGKILL)
                        wait_until_ended(stray, 1.0)
                        os.waitpid(stray, os.WNOHANG)
            self._groups.discard(self.pid)
        return self.returncode

    def signal_all(self, number: int) -> None:
        """Send a signal to the process and all of its group; SIGSTOP and SIGCONT to all that it has started.

        A shell that sees its job stopped waits for it no longer: it is stopped first, and goes on last.
        """
        if number != signal.SIGCONT:
            os.killpg(self.pid, number)
        for stray in self._strays() if number in (signal.SIGSTOP, signal.SIGCONT) else ():
            with suppress(ProcessLookupError):
                os.kill(stray, number)
        if number == signal.SIGCONT:
            os.killpg(self.pid, number)

    def _strays(self) -> list[int]:
        """Return the command's processes that are outside of its group."""
        if self._mark is None:
            return []
        found = list[int]()
        for pid in [int(entry.name) for entry in os.scandir("/proc") if entry.name.isdigit()]:
            with suppress(OSError):  # of somebody else, or gone
                if os.getpgid(pid) in self._groups:  # most are, and to read all takes long
                    continue
                if self._mark in Path(f"/proc/{pid}/environ").read_bytes().split(b"\0"):
                    found.append(pid)
        return found

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end, at most so many seconds. Raises subprocess.TimeoutExpired."""
        if self.poll() is None:
            wait_until_ended(self.pid, timeout)
        status = self.poll()
        if status is None:
            raise subprocess.TimeoutExpired(self.args, timeout or 0.0)
        return status


@dataclass(frozen=True)
class Exit:
    """End of a process: its status and the last lines of its log."""

    status: int
    log_tail: str
    overdue_s: float | None = None
    """Seconds in which a process that was told to end has not, so that it was killed."""

    @property
    def how(self) -> str:
        """In words: an exit status, or the signal that ended it, or that it did not end."""
        if self.overdue_s is not None:
            return f"did not end within {self.overdue_s:g} s"
        if self.status >= 0:
            return f"exit status {self.status}"
        try:
            return signal.Signals(-self.status).name
        except ValueError:
            return f"signal {-self.status}"


class AgentProcesses(Protocol):
    """Processes of the agents of a run, as a launcher starts and ends them on this machine, or hosts elsewhere."""

    @property
    def pids(self) -> Mapping[str, int]:
        """Numbers that tell the processes of one name apart, of those that should be there."""

    def is_prepared(self) -> bool:
        """Return whether agents can be started without waiting. Raises VnetError if they never can."""

    @property
    def missing(self) -> Sequence[str]:
        """Names of all that agents wait for before they can be started."""

    def start_agents(self, endpoint: str, access: Access, groups: Sequence[Sequence[str]], nice: int = 0) -> None:
        """Start the processes of these groups of nodes; the name of each is the id of its first node."""

    def signal(self, name: str, number: signal.Signals) -> None:
        """Send a signal to a process, if it is there."""

    def kill(self, name: str) -> None:
        """End a process at once, and forget it."""

    def detach(self, name: str) -> Callable[[float], None]:
        """Forget a process that has been told to go; returns what waits so many seconds for its end."""

    def request_stack(self, name: str) -> None:
        """Have a process write its stacks to its log."""

    def log_tail(self, name: str) -> str:
        """Return the last lines of a process's log."""

    def takes_end(self, name: str, how: Exit) -> bool:
        """Take the end of a process that the launcher has started and that is no agent; returns whether it is."""


class Launcher:
    """The processes that a run has started, which log to `logs`.

    `stop` ends all that are left, whatever happened before. Agents are forked from the `zygote`, if there is one.
    """

    def __init__(
        self, logs: Path, folders: Sequence[Path] = (), zygote: Zygote | None = None, patience_s: float = 60.0
    ) -> None:
        """Processes with logs in `logs`; agents look for their programs in `folders` too.

        Agents wait `patience_s` for the router, which is there but may be busy with others, and for the emulator.
        """
        self.logs = logs
        self.disks: Path | None = None
        """Folder of the disks of vehicles, if agents are to have them in one place."""
        self.debug: DebugPoint | None = None
        """The debugger of a vehicle, and where its user answers."""
        self.agent_environment: Mapping[str, str] = AGENT_ENVIRONMENT
        """The environment of agents that are not forked, beside this process's own."""
        self.agent_command: Sequence[str] = ()
        """The words of the command that an agent is, with placeholders, unless agents are those of vnet."""
        self._folders = folders
        self._zygote = zygote
        self._patience_s = patience_s
        self._processes: dict[str, ForkedProcess | GroupProcess] = {}
        self._services: set[str] = set()

    def prepare(self) -> None:
        """Make ready for starting agents, in the background. Raises VnetError."""
        if self._zygote is not None:
            self._zygote.start()

    def is_prepared(self) -> bool:
        """Return whether agents can be started without waiting. Raises VnetError if they never can."""
        return self._zygote is None or self._zygote.is_ready()

    @property
    def missing(self) -> Sequence[str]:
        """Names of all that agents wait for before they can be started."""
        return [] if self.is_prepared() else ["the process from which agents are forked"]

    def start_agents(self, endpoint: str, access: Access, groups: Sequence[Sequence[str]], nice: int = 0) -> None:
        """Start the processes of these groups of nodes; the name of each is the id of its first node.

        `nice` lowers their priority, so that on a full machine the emulator, which all wait for, comes first.
        """
        if self.agent_command:
            for name in (nodes[0] for nodes in groups):
                given = {"{endpoint}": endpoint, "{run}": access.run, "{node}": name}
                words = [*TIED, *(_filled(word, given) for word in self.agent_command)]
                self._start(name, words, {**SAME_ARITHMETIC, **os.environ}, access.credentials(node_user(name)))
                self._lower_priority(name, nice)
            return
        agents = {nodes[0]: self._agent_arguments(endpoint, access.run, nodes) for nodes in groups}
        if self._zygote is not None:
            for names in forking.split(agents):
                self._fork_agents(self._zygote, access, {name: agents[name] for name in names}, nice)
            return
        for name, arguments in agents.items():
            command = ["-P", "-m", "agents.cli", *arguments]
            self.start(name, command, access.credentials(node_user(name)), self.agent_environment)
            self._lower_priority(name, nice)

    def _agent_arguments(self, endpoint: str, run: str, nodes: Sequence[str]) -> list[str]:
        """Return the arguments of `vnet-agent`, but for its credentials."""
        arguments = ["--connect", endpoint, "--run", run]
        arguments += ["--connect-timeout-s", str(self._patience_s), "--join-timeout-s", str(self._patience_s)]
        for node in nodes:
            arguments += ["--node", node]
        if self.disks is not None:
            arguments += ["--files", str(self.disks.absolute())]
        for folder in self._folders:
            arguments += ["--path", str(folder)]
        if self.debug is not None and self.debug.target.node in nodes:
            arguments += ["--debug", str(self.debug.target), "--debug-socket", str(self.debug.socket)]
        return arguments

    def _fork_agents(self, zygote: Zygote, access: Access, agents: Mapping[str, list[str]], nice: int) -> None:
        """Fork agents (arguments by name), and give each its credentials once its process is known.

        An agent that never gets its credentials ends; so none is there twice if a zygote ends meanwhile.
        """
        request = forking.ForkRequest(list(agents.values()))
        names, last = list(agents), ""
        for _ in range(MOST_ZYGOTES):
            with ExitStack() as stack:
                ends = [self._open_ends(name, stack) for name in names]
                try:
                    reply = zygote.fork(request, [end for read_end, _, log in ends for end in (read_end, log)])
                except ZygoteGoneError as gone:
                    last = str(gone)
                    zygote.start()
                    continue
                for name, pid, (_, write_end, _) in zip(names, reply.pids, ends, strict=False):
                    self._processes[name] = ForkedProcess(pid)
                    self._lower_priority(name, nice)
                    os.write(write_end, access.credentials(node_user(name)).dumps().encode())
            if reply.failure:
                raise _cannot_start(names[len(reply.pids)], reply.failure)
            return
        raise _cannot_start(names[0], f"{MOST_ZYGOTES} zygotes in a row have ended: {last}")

    def _open_ends(self, name: str, stack: ExitStack) -> tuple[int, int, int]:
        """Open a pipe for the credentials of an agent (both ends) and its log; `stack` closes them."""
        try:
            read_end, write_end = os.pipe()
            stack.callback(os.close, read_end)
            stack.callback(os.close, write_end)
            return read_end, write_end, stack.enter_context((self.logs / f"{name}.log").open("ab")).fileno()
        except OSError as error:
            raise _cannot_start(name, error.strerror) from None

    def _lower_priority(self, name: str, nice: int) -> None:
        if nice:
            nice = min(os.getpriority(os.PRIO_PROCESS, 0) + nice, LOWEST_PRIORITY)
            os.setpriority(os.PRIO_PROCESS, self._processes[name].pid, nice)

    def start(
        self,
        name: str,
        arguments: Sequence[str],
        credentials: Credentials | None,
        environment: Mapping[str, str],
        own_session: bool = False,
    ) -> None:
        """Start `python ARGUMENTS`, with `--credentials` if there are any; its output goes to `logs/{name}.log`.

        In a session of its own it gets processor time even where the run could use all of it, if autogroups act.
        """
        command = [sys.executable, *arguments, *(["--credentials", CREDENTIALS] if credentials else [])]
        self._start(name, command, {**SAME_ARITHMETIC, **os.environ, **environment}, credentials, own_session)

    def start_command(self, name: str, words: Sequence[str], environment: Mapping[str, str], nice: int) -> None:
        """Start a command in a group of its own that ends with this process; it prints to `logs/{name}.log`."""
        self._start(name, [*TIED, *words], environment, mark=environment[COMMAND])
        self._lower_priority(name, nice)

    def _start(
        self,
        name: str,
        command: Sequence[str],
        environment: Mapping[str, str],
        credentials: Credentials | None = None,
        own_session: bool = False,
        mark: str | None = None,
    ) -> None:
        """Start a command, with the path of a pipe that holds the credentials in place of `CREDENTIALS`."""
        descriptors: list[int] = []
        try:
            if credentials is not None:
                read_end, write_end = os.pipe()
                descriptors.append(read_end)
                with os.fdopen(write_end, "w") as pipe:
                    pipe.write(credentials.dumps())
                command = [_filled(word, {CREDENTIALS: f"/dev/fd/{read_end}"}) for word in command]
            inherit = nullcontext() if name in self._services else default_time_slice()
            with (self.logs / f"{name}.log").open("ab") as log, inherit:
                self._processes[name] = GroupProcess(
                    command,
                    mark,
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    pass_fds=descriptors,
                    process_group=None if own_session else 0,
                    start_new_session=own_session,
                    env=environment,
                )
        except OSError as error:
            raise _cannot_start(name, error.strerror) from None
        finally:
            for descriptor in descriptors:
                os.close(descriptor)

    @property
    def pids(self) -> dict[str, int]:
        """Process ids by name."""
        return {name: process.pid for name, process in self._processes.items()}

    def ended(self) -> dict[str, Exit]:
        """The processes that have ended since the last call; they are forgotten."""
        if self._zygote is not None:
            self._zygote.start_if_gone()
        done = {}
        for name, process in list(self._processes.items()):
            status = process.poll()
            if status is not None:
                del self._processes[name]
                done[name] = Exit(status, self.log_tail(name))
        return done

    def log_tail(self, name: str) -> str:
        """The last lines of a process's log."""
        try:
            text = (self.logs / f"{name}.log").read_text(errors="replace")
        except OSError:
            return ""
        return "\n".join(text.splitlines()[-LOG_TAIL_LINES:])

    def cut_logs(self) -> None:
        """Cut the logs that are full: processes write them by themselves, and are not to wait for anybody."""
        for log in self.logs.glob("*.log"):
            cut_log(log)

    def request_stack(self, name: str) -> None:
        """Have a process write its stacks to its log (its faulthandler answers SIGUSR1), if it is one of vnet's."""
        if name in self._processes and not self.agent_command:
            self._processes[name].send_signal(signal.SIGUSR1)

    def start_service(self, name: str, arguments: Sequence[str]) -> None:
        """Start `python ARGUMENTS`, which goes on until it is told to end."""
        self._services.add(name)
        self.start(name, arguments, None, {})

    def kill(self, name: str) -> None:
        """End a process at once; it is not among those that `ended` reports."""
        process = self._processes.pop(name, None)
        if process is not None:
            process.kill()
            process.wait()

    def signal(self, name: str, number: signal.Signals) -> None:
        """Send a signal to a process, if it is there."""
        if name in self._processes:
            self._processes[name].send_signal(number)

    def signal_group(self, name: str, number: int) -> None:
        """Send a signal to a command and all that it has started, if it is there."""
        process = self._processes.get(name)
        if isinstance(process, GroupProcess) and process.poll() is None:
            process.signal_all(number)

    def takes_end(self, name: str, how: Exit) -> bool:
        """All that it starts are agents, and what belongs to the run itself."""
        return False

    def detach(self, name: str) -> Callable[[float], None]:
        """Forget a process that has been told to go: `ended` does not report it.

        Returns what waits so many seconds for its end, and kills it if it does not go.
        """
        process = self._processes.pop(name, None)

        def wait_or_kill(patience_s: float) -> None:
            if process is not None:
                try:
                    process.wait(patience_s)
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()

        return wait_or_kill

    def wait_for(self, name: str, timeout_s: float) -> None:
        """Wait for one process to end by itself."""
        with suppress(KeyError, subprocess.TimeoutExpired):
            self._processes[name].wait(timeout_s)

    def stop(self, patience_s: float = 1.0) -> dict[str, Exit]:
        """End every process: wait for those that end by themselves, then SIGTERM, then SIGKILL.

        Returns the ends of those that ended by themselves, and of those that were not going to, awake or asleep:
        one that wanted to run and got no processor may have been about to end.
        """
        before_ns = {name: cpu_time_ns(pid) or 0 for name, pid in self.pids.items()}
        ends = self._wait(patience_s, self._services)
        for name, pid in self.pids.items():
            if name not in self._services and not _is_starved(pid, before_ns[name], patience_s):
                ends[name] = Exit(-signal.SIGKILL, self.log_tail(name), patience_s)
        for process in self._processes.values():
            process.terminate()
        self._wait(0.5)
        for process in self._processes.values():
            process.kill()
        for process in self._processes.values():
            process.wait()
        self._processes.clear()
        self.cut_logs()
        if self._zygote is not None:
            self._zygote.close()
        return ends

    def _wait(self, timeout_s: float, but: Set[str] = frozenset()) -> dict[str, Exit]:
        """Wait until all but these have ended; returns how those ended that have."""
        deadline = time.monotonic() + timeout_s
        ends: dict[str, Exit] = {}
        while time.monotonic() < deadline:
            for name, process in list(self._processes.items()):
                if (status := process.poll()) is not None:
                    del self._processes[name]
                    ends[name] = Exit(status, self.log_tail(name))
            if self._processes.keys() <= but:
                break
            time.sleep(0.01)
        return ends


def _is_starved(pid: int, before_ns: int, wall_s: float) -> bool:
    """Return whether a process wants to run, or waits for a disk, and has had less than a tenth of a processor.

    One that sleeps again and again may want to run at one look: it is starved if it wants to at each of several.
    """
    if (cpu_time_ns(pid) or 0) - before_ns >= STARVED * wall_s * NS_PER_S:
        return False
    for _ in range(STARVED_LOOKS):
        if _state_of(pid) not in "RD":
            return False
        time.sleep(STARVED_LOOK_S)
    return True


def _state_of(pid: int) -> str:
    """Return the letter of proc_pid_stat(5) for a process; R if it has just ended, or this system does not say."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return "R"


def _filled(word: str, given: Mapping[str, str]) -> str:
    """Return a word of a command with what stands for its placeholders."""
    for placeholder, value in given.items():
        word = word.replace(placeholder, value)
    return word


def _cannot_start(name: str, reason: str | None) -> VnetError:
    return VnetError(f"cannot start the process of {name}: {reason}")
