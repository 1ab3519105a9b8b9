"""The zygote: it has imported what agents need, and forks one for each that the emulator asks for.

An agent is forked by a process in between, which ends at once; so the emulator, a subreaper, becomes its parent:
it gets the exit status and SIGCHLD, and the agent's parent-death signal tells of the emulator's end, not of the
zygote's. An agent waits until its credentials can be read from a descriptor that it alone has open: the emulator
writes them once it knows the process, and the zygote, which opens no session, never has them.

`python -m agents.zygote DESCRIPTOR [MODULE …]` answers on that socket, and imports these modules beforehand.
"""

from __future__ import annotations

import ctypes
import gc
import importlib
import os
import random
import select
import signal
import socket
import sys
from collections import defaultdict
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy.random  # numpy itself imports it when it is first used, which would be in each agent

import agents.cli
import agents.host  # what every agent needs
from vnet.runtime import forking
from vnet.runtime.die_with_parent import signal_at_parent_death
from vnet.runtime.outside_loop import end_forked

STANDARD_ERROR = 2


@dataclass(frozen=True)
class _Agent:
    """An agent to become: its arguments, and its descriptors."""

    arguments: Sequence[str]
    credentials: int
    log: int


def main() -> None:
    """Fork agents until the emulator is gone; in each of them, be that agent."""
    channel = socket.socket(fileno=int(sys.argv[1]))
    signal_at_parent_death(signal.SIGKILL)
    gc.disable()
    for module in filter(None, sys.argv[2:]):
        with suppress(Exception):  # the agents tell what is wrong with it
            imported = importlib.import_module(module)
            for name in getattr(imported, "__all__", ()):  # programs that are imported when first asked for
                getattr(imported, name)
    _show_arguments(sys.orig_argv[:4])
    gc.collect()
    gc.freeze()  # so that collections of the agents do not write to the memory that they share
    channel.send(forking.encode(forking.READY))
    agent = _fork_until_agent(channel)
    if agent is not None:
        shared = frozenset(sys.modules)
        end_forked(_status_of(agent), shared)


def _fork_until_agent(channel: socket.socket) -> _Agent | None:
    """Answer requests until there are no more; in each process that is forked, return the agent to become."""
    while True:
        data, descriptors, _, _ = socket.recv_fds(
            channel, forking.LONGEST_MESSAGE_BYTES, 2 * forking.MOST_AGENTS, socket.MSG_CMSG_CLOEXEC
        )
        if not data:
            return None
        request = forking.decode_request(data)
        assert len(list(Path("/proc/self/task").iterdir())) == 1, "a process with threads cannot be forked"
        agents_asked = [
            _Agent(arguments, *descriptors[2 * index : 2 * index + 2])
            for index, arguments in enumerate(request.agents)
        ]
        reply_end, report_end = os.pipe()
        between = os.fork()
        if between == 0:
            agent = _fork_each(agents_asked, report_end)
            channel.detach()  # its descriptor is closed
            return agent
        for descriptor in (report_end, *descriptors):
            os.close(descriptor)
        with os.fdopen(reply_end, "rb") as replies:
            reply = replies.read() or forking.encode(forking.ForkReply([], "the process in between was killed"))
        os.waitpid(between, 0)  # from now on the emulator is the parent of its children
        channel.send(reply)


def _fork_each(agents_asked: Sequence[_Agent], report_end: int) -> _Agent:
    """Fork these agents, report their process ids and end; in each of them, return it."""
    pids: list[int] = []
    failure = ""
    try:
        for agent in agents_asked:
            pid = os.fork()
            if pid == 0:
                _take_descriptors(agent)
                return agent
            pids.append(pid)
    except OSError as error:
        failure = error.strerror or str(error)
    os.write(report_end, forking.encode(forking.ForkReply(pids, failure)))
    os._exit(0)


def _take_descriptors(agent: _Agent) -> None:
    """Write to the agent's own log; close every descriptor but its own, and those of other agents with them."""
    os.dup2(agent.log, 1)
    os.dup2(agent.log, 2)
    for descriptor in [int(path.name) for path in Path("/proc/self/fd").iterdir()]:
        if descriptor > STANDARD_ERROR and descriptor != agent.credentials:
            with suppress(OSError):  # that of the listing itself
                os.close(descriptor)


def _status_of(agent: _Agent) -> int:
    """Be this agent to its end; returns the status with which `vnet-agent` would exit."""
    try:
        _be(agent)
    except SystemExit as leave:
        return leave.code if isinstance(leave.code, int) else 0
    return 0


def _be(agent: _Agent) -> None:
    """Be this agent to its end, as `vnet-agent` is one, if the emulator goes on to want it."""
    os.setpgid(0, 0)
    if not _has_credentials(agent.credentials):
        return
    gc.enable()
    random.seed()
    numpy.random.seed()  # noqa: NPY002  # whoever uses the global generator must not draw what others draw
    sys.argv = [str(agents.cli.__file__), *agent.arguments, "--credentials", f"/dev/fd/{agent.credentials}"]
    sys.orig_argv = [sys.executable, "-P", "-m", "agents.cli", *sys.argv[1:]]
    sys.modules["__main__"] = agents.cli
    _show_arguments(sys.orig_argv)
    _call(sys.argv[1:])


def _call(arguments: Sequence[str]) -> None:
    """Call the command with these arguments of the emulator's: parsing a user's would take longer than the fork."""
    given = defaultdict(list)
    for name, value in zip(arguments[::2], arguments[1::2], strict=True):
        given[name].append(value)
    agents.cli.agent(
        connect=given["--connect"][0],
        run=given["--run"][0],
        node=given["--node"],
        credentials=Path(given["--credentials"][0]),
        path=[Path(folder) for folder in given["--path"]],
        files=Path(given["--files"][0]) if given["--files"] else None,
        debug=given["--debug"][0] if given["--debug"] else None,
        debug_socket=Path(given["--debug-socket"][0]) if given["--debug-socket"] else None,
    )


def _has_credentials(descriptor: int) -> bool:
    """Wait until the emulator has written the credentials; return false if it never will."""
    poll = select.poll()
    poll.register(descriptor, select.POLLIN)
    ((_, events),) = poll.poll()
    return bool(events & select.POLLIN)


def _show_arguments(arguments: Sequence[str]) -> None:
    """Show these arguments, or as many as there is room for, in /proc/PID/cmdline: `ps` tells processes apart."""
    with suppress(OSError, ValueError, IndexError):
        fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
        start, end = int(fields[45]), int(fields[46])  # arg_start and arg_end of proc_pid_stat(5)
        text = "\0".join(arguments).encode()[: end - start - 1]
        ctypes.memset(start, 0, end - start)
        ctypes.memmove(start, text, len(text))


if __name__ == "__main__":
    main()
