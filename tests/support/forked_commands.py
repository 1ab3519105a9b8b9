"""Commands of vnet without the second that each takes to import vnet: forks of one process that has done so.

`Command([*VNET, …], …)` and `run([*VNET, …], …)` are `subprocess.Popen` and `subprocess.run` of the command. That
one works from the first instruction of its process on is for tests/emulator/cli and tests/system/test_wheel.py.
"""

import atexit
import contextlib
import functools
import gc
import json
import os
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vnet.runtime.environment import use_same_arithmetic

VNET = [sys.executable, "-P", "-m", "emulator.cli"]
_LENGTH = 2**20
_NUMBER = "%-20d"


class Command(subprocess.Popen[str]):
    """A command that is forked. Its status comes over a socket: the process that waits for it is its parent."""

    def _execute_child(self, args: Sequence[str], *more: Any) -> None:
        assert list(args[: len(VNET)]) == VNET and more[1] is None, "no other command, and no `preexec_fn`"
        sys.audit("subprocess.Popen", args[0], args, more[4], more[5])
        cwd, environment, pipes = more[4], more[5], more[9:15]
        standard = [here if pipe < 0 else pipe for here, pipe in enumerate((pipes[0], pipes[3], pipes[5]))]
        request = {"words": list(args[len(VNET) :]), "cwd": str(cwd or Path.cwd()), "has_session": more[-2]}
        request["environment"] = dict(os.environ if environment is None else environment)
        data = json.dumps(request).encode()
        assert len(data) < _LENGTH
        self._status, its = socket.socketpair()
        with its:
            socket.send_fds(_server(), [data], [its.fileno(), *standard])
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


@functools.cache
def _server() -> socket.socket:
    """Start the process that is forked, once for each process of pytest; return the socket to it."""
    ours, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _LENGTH)
    with its:
        words = [sys.executable, "-P", "-m", __name__, str(its.fileno())]
        environment = os.environ | {"PYTHONHASHSEED": "0", "PYTHONPATH": str(Path(__file__).parents[2])}
        server = subprocess.Popen(words, env=environment, pass_fds=[its.fileno()], stdin=subprocess.DEVNULL)

    def end() -> None:
        ours.close()
        server.wait()

    atexit.register(end)
    return ours


def serve(requests: socket.socket) -> None:
    """Fork a process for each request; return in the process that is to be the command, and in no other."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    while True:
        data, descriptors, _, _ = socket.recv_fds(requests, _LENGTH, 4)
        with contextlib.suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        if not data:
            os._exit(0)
        if not os.fork():
            break
        for descriptor in descriptors:
            os.close(descriptor)
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
    _become(json.loads(data), descriptors[1:])


def _become(request: dict[str, Any], standard: list[int]) -> None:
    """Have this process be as one that was started for the request."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if request["has_session"]:
        os.setsid()
    for number, descriptor in enumerate(standard):
        os.dup2(descriptor, number)
        os.close(descriptor)
    os.chdir(request["cwd"])
    os.environ.clear()
    os.environ.update(request["environment"], PYTHONHASHSEED="0")
    path = request["environment"].get("PYTHONPATH", "")
    sys.path[:] = [*filter(None, path.split(os.pathsep)), *sys.path[1:]]  # the first was for this module
    sys.argv = ["vnet", *request["words"]]


if __name__ == "__main__":
    use_same_arithmetic()
    import pyarrow

    import emulator.cli
    import emulator.cli.commands
    import emulator.cli.execution
    import emulator.drivers.live.processes

    pyarrow.array([0])  # the first array imports pandas where it is installed, which takes as long as vnet does

    gc.collect()
    gc.freeze()
    serve(socket.socket(fileno=int(sys.argv[1])))
    emulator.cli.main()
