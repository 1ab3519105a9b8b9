"""An emulator, agents and a router that are started by hand."""

import re
import subprocess
import threading
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.support.forked_commands import AGENT, VNET, Command
from tests.support.paths import ROOT
from tests.system.conftest import TIMEOUT_S, Finished

SCENARIO = "scenarios/beacon.toml"
OPTIONS = ["--duration", "2", "--set", "network.vehicles=4"]
NODES = ["v01", "v02", "v03", "v04"]
ROUTER = """
import sys, zenoh
with zenoh.open(zenoh.Config.from_file(sys.argv[1])):
    print("up", flush=True)
    input()
"""


def start_agents(stack: ExitStack, endpoint: str, access: Path) -> None:
    for node in NODES:
        command = [*AGENT, "--connect", endpoint, "--run", "beacon", "--node", node]
        command += ["--credentials", str(access / "credentials" / f"{node}.json")]
        stack.enter_context(Command(command, cwd=ROOT))


def finish(emulator: subprocess.Popen[str], folder: Path) -> Finished:
    stdout, stderr = emulator.communicate(timeout=TIMEOUT_S)
    return Finished(emulator.returncode, stdout, stderr, folder)


def start_emulator(stack: ExitStack, folder: Path, *options: str) -> tuple[subprocess.Popen[str], str]:
    """`vnet emulator`, once it waits for its vehicles; and the endpoint that it names."""
    command = [*VNET, "emulator", SCENARIO, *OPTIONS, "--out", str(folder), *options]
    emulator = stack.enter_context(
        Command(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    )
    stack.callback(emulator.kill)
    return emulator, line_of(emulator, r"listening at (\S+); waiting for 4 vehicles")[1]


def line_of(process: subprocess.Popen[str], pattern: str) -> re.Match[str]:
    """Wait until a process has written a line with this pattern on standard error; return the match."""
    assert process.stderr is not None
    watchdog = threading.Timer(TIMEOUT_S, process.kill)
    watchdog.start()
    try:
        for line in process.stderr:
            if found := re.search(pattern, line):
                return found
    finally:
        watchdog.cancel()
    pytest.fail(f"it has ended, or has not said {pattern!r} in time")
