"""Whole runs: real routers on ports that the system chooses, real processes, through the commands users type."""

import contextlib
import errno
import io
import json
import os
import re
import select
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from emulator.terminal.console import run_app
from tests.support import forked_commands, processes
from tests.support.command_line import app
from tests.support.forked_commands import VNET, Command
from tests.support.paths import ROOT
from tests.support.processes import wait_until

TIMEOUT_S = processes.TIMEOUT_S


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark all tests of this folder as slow; `items` holds the tests of other folders too."""
    for item in items:
        if item.path.is_relative_to(Path(__file__).parent):
            item.add_marker(pytest.mark.slow)


@pytest.fixture(autouse=True)
def hears_ctrl_c(default_signals: None) -> None:
    """Let processes hear Ctrl-C however pytest was started."""


@dataclass(frozen=True)
class Finished:
    """A command that has ended, and the folder of its run."""

    status: int
    stdout: str
    stderr: str
    folder: Path

    @property
    def verdict(self) -> dict[str, Any]:
        return json.loads((self.folder / "verdict.json").read_text())

    @property
    def fingerprint(self) -> tuple[str, str]:
        """Results that must be the same wherever the same run is run: the trace and the metrics."""
        return self.verdict["trace_sha256"], self.verdict["metrics_sha256"]

    @property
    def events(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in (self.folder / "events.jsonl").read_text().splitlines()]

    def events_of(self, kind: str) -> list[dict[str, Any]]:
        return [event for event in self.events if event["kind"] == kind]

    @property
    def outcomes(self) -> dict[str, int]:
        return self.verdict["frames_by_outcome"]

    def check(self, name: str) -> dict[str, Any]:
        return next(check for check in self.verdict["checks"] if check["name"] == name)

    def trace(self) -> list[dict[str, Any]]:
        return pq.read_table(self.folder / "trace.parquet").to_pylist()


Vnet = Callable[..., Finished]


PATIENT = ["--set", f"run.join_timeout_s={TIMEOUT_S}", "--set", f"run.stall_timeout_s={TIMEOUT_S}"]
"""Options of live runs, so that no verdict depends on the machine's speed."""
APART = {"--log-format", "--quiet", "--rerun"}
"""Options of simulations that need a standard output, or a process, of their own."""


@pytest.fixture
def vnet(tmp_path: Path) -> Vnet:
    """Run a vnet command to its end: vnet("run", "scenarios/twelve.toml", "--seed", "3").

    What starts processes is a process itself, forked; a simulation runs in this one.
    """
    return command_in(tmp_path)


def command_in(parent: Path) -> Vnet:
    """A function that runs vnet commands to their end, each with a folder of its own in `parent`."""
    numbers = iter(range(100))

    def run(command: str, scenario: str, *options: str) -> Finished:
        folder = parent / f"run{next(numbers)}"
        plain = ["--no-report"] if command in ("run", "simulate") and "--report" not in options else []
        if command == "run":
            plain += PATIENT
        words = [command, scenario, "--out", str(folder), *plain, *options]
        if command == "simulate" and APART.isdisjoint(options):
            return Finished(*in_this_process(words), folder)
        done = forked_commands.run([*VNET, *words], cwd=ROOT, capture_output=True, timeout=TIMEOUT_S)
        return Finished(done.returncode, done.stdout, done.stderr, folder)

    return run


def in_this_process(words: Sequence[str]) -> tuple[int, str, str]:
    """A command's exit status, and what it writes on stdout and stderr."""
    out, error, path = io.StringIO(), io.StringIO(), list(sys.path)
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(error), contextlib.chdir(ROOT):
        try:
            status = run_app(app, words)
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else 1
        finally:
            sys.path[:] = path
    return status, out.getvalue(), error.getvalue()


def run_until(enough: Callable[[], bool], folder: Path, scenario: str, *options: str) -> Finished:
    """`vnet run`, ended by Ctrl-C once it is `enough`: what a run in real time shows in a fixed time depends on the
    machine. The run must be long."""
    command = [*VNET, "run", scenario, "--out", str(folder), "--no-report", *PATIENT, *options]
    with Command(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            wait_until(enough, process)
            process.send_signal(signal.SIGINT)
            stdout, stderr = process.communicate(timeout=TIMEOUT_S)
        finally:
            process.kill()
    return Finished(process.returncode, stdout, stderr, folder)


@contextlib.contextmanager
def killed_at_last(process: subprocess.Popen[str]) -> Iterator[None]:
    """Kill a process when a test is over, which would otherwise wait for one that has not done what it should."""
    try:
        yield
    finally:
        process.kill()


def heard_by(folder: Path, node: str) -> set[tuple[str, int]]:
    """Each `vehicle.incarnation` that a vehicle with the program `names_neighbours` has heard, with the second."""
    log = folder / "logs" / f"{node}.log"
    lines = log.read_text().splitlines() if log.exists() else []
    found = (re.fullmatch(r"heard (\S+) in second (\d+)", line) for line in lines)
    return {(each[1], int(each[2])) for each in found if each}


def running_agents(of: Path) -> list[int]:
    """Pids of agent processes whose log lies in the run folder `of`."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            command = (process / "cmdline").read_bytes().split(b"\0")
            log = str((process / "fd" / "1").readlink())
        except OSError:
            continue
        if b"agents.cli" in command and log.startswith(str(of)):
            found.append(int(process.name))
    return found


def read_terminal(master: int, written: object) -> bytes:
    """Bytes that come next on a pseudo-terminal to which this was written; none once its other end is closed."""
    assert select.select([master], [], [], TIMEOUT_S)[0], f"nothing comes after {written!r}"
    try:
        return os.read(master, 65_536)
    except OSError as error:  # nobody has the other end open any more
        assert error.errno == errno.EIO
        return b""


def zygote_of(emulator: int) -> int:
    """Pid of the process from which the agents of an emulator are forked; 0 if there is none just now."""
    for child in Path(f"/proc/{emulator}/task/{emulator}/children").read_text().split():
        with contextlib.suppress(OSError):  # it has just ended
            if b"agents.zygote" in Path(f"/proc/{child}/cmdline").read_bytes().split(b"\0"):
                return int(child)
    return 0
