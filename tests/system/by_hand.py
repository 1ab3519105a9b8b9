"""Agents started by hand with a separate router: the same run as in one process, as `vnet run` has it."""

import re
import socket
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.support.paths import ROOT
from tests.system.conftest import AGENT, TIMEOUT_S, VNET, Finished, Vnet

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
        stack.enter_context(subprocess.Popen(command, cwd=ROOT))


def finish(emulator: subprocess.Popen[str], folder: Path) -> Finished:
    stdout, stderr = emulator.communicate(timeout=TIMEOUT_S)
    return Finished(emulator.returncode, stdout, stderr, folder)


def start_emulator(stack: ExitStack, folder: Path, *options: str) -> tuple[subprocess.Popen[str], str]:
    """`vnet emulator`, once it waits for its vehicles; and the endpoint that it names."""
    command = [*VNET, "emulator", SCENARIO, *OPTIONS, "--out", str(folder), *options]
    emulator = stack.enter_context(
        subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    )
    stack.callback(emulator.kill)
    assert emulator.stderr is not None
    for line in emulator.stderr:
        if found := re.search(r"listening at (\S+); waiting for 4 vehicles", line):
            return emulator, found[1]
    pytest.fail("the emulator ended early")


def test_a_separate_router_changes_nothing(vnet: Vnet, tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    access = tmp_path / "access"
    command = [*VNET, "access", SCENARIO, *OPTIONS[2:], "--out", str(access), "--listen", endpoint]
    subprocess.run(command, cwd=ROOT, check=True, timeout=TIMEOUT_S, capture_output=True)
    assert all(path.stat().st_mode & 0o077 == 0 for path in access.rglob("*") if path.is_file())
    with ExitStack() as stack:
        router = stack.enter_context(
            subprocess.Popen(
                [sys.executable, "-c", ROUTER, str(access / "zenohd.json5")],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
        )
        assert router.stdout is not None
        assert router.stdout.readline() == "up\n"
        folder = tmp_path / "separate"
        emulator, _ = start_emulator(stack, folder, "--connect", endpoint, "--access", str(access))
        start_agents(stack, endpoint, access)
        separate = finish(emulator, folder)
        router.communicate("\n", timeout=TIMEOUT_S)
    assert separate.status == 0, separate.stderr + separate.stdout
    assert separate.fingerprint == vnet("simulate", SCENARIO, *OPTIONS).fingerprint
