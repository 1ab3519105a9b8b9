"""Processes of vnet without the second that each takes to import vnet: forks of one process.

`Command([*VNET, …], …)` and `run([*VNET, …], …)` are `subprocess.Popen` and `subprocess.run` of the command, those
of `[*AGENT, …]` of an agent, those of `[*MODULE, NAME, …]` of a module of this repository; in a network namespace
after `ip netns exec NAMESPACE`. Workers of cells, repetitions of runs, and checks of programs that it starts are
forked as well; those of this process, once it has called `fork_processes`. What a process is to do first is a
function of a module that it can import.
tests/emulator/cli, tests/system/test_wheel.py and tests/emulator/cells/test_worker.py start processes as users do.
"""

import atexit
import contextlib
import ctypes
import functools
import gc
import importlib
import json
import os
import pkgutil
import runpy
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from vnet.errors import VnetError
from vnet.runtime import running_node
from vnet.runtime.environment import use_same_arithmetic
from vnet.runtime.outside_loop import end_forked
from vnet.runtime.running_node import RunningNode

PYTHON = [sys.executable, "-P", "-m"]
VNET = [*PYTHON, "emulator"]
AGENT = [*PYTHON, "agents.cli"]
MODULE = [*PYTHON, "runpy"]
WORKER = "emulator.cells.worker"
CHECK = "agents.program_check"
LIBRARIES = {".figure": "scipy.stats", "pytest": "hypothesis"}
"""Libraries that modules use whose name ends so: the first takes as long to import as vnet does."""
_LENGTH = 2**20
_NUMBER = "%-20d"


class Command(subprocess.Popen[str]):
    """A command that is forked. Its status comes over a socket: the process that waits for it is its parent."""

    def _execute_child(self, args: Sequence[str], *more: Any) -> None:
        first, words, namespace = len(PYTHON), list(args), ""
        sys.audit("subprocess.Popen", words[0], words, more[4], more[5])
        if words[:3] == ["ip", "netns", "exec"]:
            namespace, words = words[3], words[4:]
        known = (VNET[first], AGENT[first], MODULE[first], WORKER, CHECK)
        assert words[:first] == PYTHON and words[first] in known, "no other command"
        before, passed, cwd, environment, pipes = more[1], more[3], more[4], more[5], more[9:15]
        standard = [here if pipe < 0 else pipe for here, pipe in enumerate((pipes[0], pipes[3], pipes[5]))]
        request = {"words": words[first:], "cwd": str(cwd or Path.cwd()), "has_session": more[-2]}
        request |= {"passed": list(passed), "has_group": more[-1] == 0, "namespace": namespace}
        request["before"] = f"{before.__module__}:{before.__qualname__}" if before else ""
        request["environment"] = dict(os.environ if environment is None else environment)
        data = json.dumps(request).encode()
        assert len(data) < _LENGTH
        self._status, its = socket.socketpair()
        with its, socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as server:
            server.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _LENGTH)
            server.connect(_address())
            socket.send_fds(server, [data], [its.fileno(), *standard, *passed])
        self.pid = int(self._status.recv(20))
        self._child_created = True
        self._close_pipe_fds(*pipes)  # type: ignore[attr-defined]

    def _is_over(self) -> bool:
        status = select.poll()  # select.select takes no descriptor from 1024 on, and tests open many
        status.register(self._status, select.POLLIN)
        return bool(status.poll(0))

    def _try_wait(self, flags: int) -> tuple[int, int]:
        if self._status.fileno() < 0 or (flags & os.WNOHANG and not self._is_over()):
            return 0, 0
        with self._status:
            return self.pid, int(self._status.recv(20))

    def _internal_poll(self, *_: Any, **__: Any) -> int | None:
        if self.returncode is None and not self._waitpid_lock.locked():  # type: ignore[attr-defined]
            pid, status = self._try_wait(os.WNOHANG)
            if pid:
                self.returncode = os.waitstatus_to_exitcode(status)
        return self.returncode


def run(
    words: Sequence[str], *, timeout: float | None = None, capture_output: bool = False, **options: Any
) -> subprocess.CompletedProcess[str]:
    """Run a command of vnet to its end."""
    if capture_output:
        options |= {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with Command(words, **{"text": True} | options) as process:
        try:
            out, error = process.communicate(timeout=timeout)
        finally:
            process.kill()
    return subprocess.CompletedProcess(words, process.returncode, out, error)


def fork_processes() -> None:
    """Have workers of cells, repetitions of runs and checks of programs be forked that this process starts."""
    from emulator.cells import worker
    from emulator.drivers import determinism, session

    for module in (worker, session):
        vars(module)["subprocess"] = SimpleNamespace(**vars(subprocess) | {"Popen": Command})
    vars(determinism)["subprocess"] = SimpleNamespace(**vars(subprocess) | {"run": _run_any})


def _run_any(words: Sequence[str], **options: Any) -> subprocess.CompletedProcess[str]:
    """Run a command in a process that is forked, if it is one of vnet with its hash seed."""
    return run(words, **options) if list(words[: len(VNET)]) == VNET else subprocess.run(words, **options)


def _refuse(subject: str, *_: str) -> None:
    raise VnetError(f"{subject}: left out in this test")


NO_CHARTS = {"require": _refuse, "is_installed": lambda _: False}
"""Replacements in `emulator.pages.canvas`: forked processes write pages as if matplotlib were not installed.

Charts cost four times what a small run does. tests/emulator/report has them, in its own process.
"""


@functools.cache
def _address() -> bytes:
    """Start the process that is forked, once for each process of pytest; return the address of its socket."""
    requests = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    requests.bind("")
    requests.listen(64)
    alive, its_end = socket.socketpair()
    with requests, its_end:
        words = [*PYTHON, __name__, str(requests.fileno()), str(its_end.fileno())]
        environment = os.environ | {"PYTHONHASHSEED": "0", "PYTHONPATH": str(Path(__file__).parents[2])}
        passed = [requests.fileno(), its_end.fileno()]
        server = subprocess.Popen(words, env=environment, pass_fds=passed, stdin=subprocess.DEVNULL)
        address = requests.getsockname()

    def end() -> None:
        alive.close()
        server.wait()

    atexit.register(end)
    return address


def _import_for(words: Sequence[str]) -> None:
    """Import once for all that are like it what a module takes long to import."""
    for end, library in LIBRARIES.items():
        if words[0] == MODULE[-1] and words[1].endswith(end) and library not in sys.modules:
            importlib.import_module(library)
            gc.freeze()


def serve(requests: socket.socket, alive: socket.socket) -> str:
    """Fork a process for each request until `alive` is closed.

    Return, in the process that is to be the command and in no other, the module that it runs.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    poll = select.poll()
    poll.register(requests, select.POLLIN)
    poll.register(alive, select.POLLIN | select.POLLHUP)
    while True:
        ready = [descriptor for descriptor, _ in poll.poll()]
        with contextlib.suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        if alive.fileno() in ready:
            os._exit(0)
        with requests.accept()[0] as client:
            data, descriptors, _, _ = socket.recv_fds(client, _LENGTH, 8)
        if data:
            _import_for(json.loads(data)["words"])
        if data and not os.fork():
            break
        for descriptor in descriptors:
            os.close(descriptor)
    address = requests.getsockname()
    alive.close()
    requests.close()
    status = socket.socket(fileno=descriptors[0])
    if pid := os.fork():
        for descriptor in (0, 1, 2, *descriptors[1:]):
            os.close(descriptor)
        status.sendall((_NUMBER % pid).encode())
        ended = os.waitpid(pid, 0)[1]
        with contextlib.suppress(OSError):
            status.sendall((_NUMBER % ended).encode())
        os._exit(0)
    status.close()
    return _become(json.loads(data), descriptors[1:], address)


def _become(request: dict[str, Any], descriptors: list[int], address: bytes) -> str:
    """Have this process be as one that was started for the request; return the module that it runs."""
    from tests.support import forked_commands

    signal.signal(signal.SIGINT, signal.default_int_handler)
    if request["has_session"]:
        os.setsid()
    elif request["has_group"]:
        os.setpgid(0, 0)
    for number, descriptor in enumerate(descriptors[:3]):
        os.dup2(descriptor, number)
        os.close(descriptor)
    os.chdir(request["cwd"])
    os.environ.clear()
    os.environ.update(request["environment"], PYTHONHASHSEED="0")
    path = request["environment"].get("PYTHONPATH", "")
    sys.path[:] = [*filter(None, path.split(os.pathsep)), *sys.path[1:]]  # the first was for this module
    if request["namespace"]:
        with Path("/run/netns", request["namespace"]).open() as namespace:
            assert ctypes.CDLL(None).setns(namespace.fileno(), 0) == 0
    if request["before"]:
        pkgutil.resolve_name(request["before"])()
    passed = dict(zip(map(str, request["passed"]), map(str, descriptors[3:]), strict=True))
    module, *words = request["words"]
    sys.argv = ["vnet", *(passed.get(word, word) for word in words)]
    vars(forked_commands)["_address"] = lambda: address
    running_node.running = RunningNode()  # where no killed command has left a vehicle
    forked_commands.fork_processes()
    return str(module)


def _be(module: str) -> int:
    """Be the command that runs a module; return its exit status."""
    if module == WORKER:
        emulator.cells.worker._serve(*map(int, sys.argv[1:]))
    elif module == CHECK:
        return agents.program_check.main(sys.argv[1:])
    elif module == AGENT[-1]:
        agents.cli.main()
    elif module == "runpy":
        del sys.argv[0]
        runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
    else:
        emulator.cli.main()
    return 0


if __name__ == "__main__":
    use_same_arithmetic()
    import matplotlib.figure
    import pyarrow
    import pytest  # noqa: F401  # what pages run as well
    import scipy.linalg
    import scipy.sparse.csgraph
    import scipy.spatial
    import scipy.special  # noqa: F401  # what maps, radios and cooperative vehicles use

    import agents.cli
    import agents.cooperative.program
    import agents.host
    import agents.program_check
    import emulator.cells.sweep
    import emulator.cli
    import emulator.cli.execution
    import emulator.drivers.live.processes
    import emulator.pages.canvas
    import emulator.report.write
    import emulator.testing.trial

    pyarrow.array([0])  # the first array imports pandas where it is installed, which takes as long as vnet does

    matplotlib.figure.Figure().add_axes((0, 0, 1, 1))  # imports what the figures of examples need
    vars(emulator.pages.canvas).update(NO_CHARTS)
    gc.collect()
    gc.freeze()
    sockets = [socket.socket(fileno=int(number)) for number in sys.argv[1:]]
    asked, shared = serve(*sockets), frozenset(sys.modules)
    try:
        status = _be(asked)
    except SystemExit as leave:
        status = leave.code if isinstance(leave.code, int) else 0
        if isinstance(leave.code, str):
            print(leave.code, file=sys.stderr)
            status = 1
    end_forked(status, shared)  # an interpreter that takes its memory apart, and so copies it, takes 0.08 s
