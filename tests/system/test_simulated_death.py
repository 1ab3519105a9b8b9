"""A simulation in one process outlives what ends a process in its midst: that is the death of the vehicle."""

import json
import signal
import subprocess
import time
from pathlib import Path

import pytest

from tests.support.forked_commands import VNET
from tests.support.paths import ROOT
from tests.system.conftest import TIMEOUT_S

PROGRAM = """
import ctypes, os, pathlib, signal
async def main(node):
    async for fix in node.gnss:
        if node.id == "v02" and fix.time_ns == 500_000_000:
            END
        await node.radio.broadcast(b"x")
"""


def command(folder: Path, end: str) -> list[str]:
    (folder / "deadly.py").write_text(PROGRAM.replace("END", end))
    return [*VNET, "simulate", "beacon.toml", "--program", "deadly.py:main", "--out", "run", "--no-report"]


def scenario(folder: Path) -> None:
    (folder / "beacon.toml").write_text((ROOT / "scenarios" / "beacon.toml").read_text())


@pytest.mark.parametrize(
    "end",
    ["ctypes.string_at(0)", "os.kill(os.getpid(), signal.SIGSEGV)", "ctypes.CDLL(None)._exit(0)"],
)
def test_the_end_of_the_process_is_the_death_of_its_vehicle(tmp_path: Path, end: str) -> None:
    scenario(tmp_path)
    done = subprocess.run(command(tmp_path, end), cwd=tmp_path, capture_output=True, text=True, timeout=TIMEOUT_S)
    assert done.returncode == 1, done.stderr
    verdict = json.loads((tmp_path / "run" / "verdict.json").read_text())
    assert verdict["verdict"] == "invalid"
    assert (tmp_path / "run" / "trace.parquet").exists()
    events = [json.loads(line) for line in (tmp_path / "run" / "events.jsonl").read_text().splitlines()]
    assert {event["node"] for event in events if event["kind"] == "died"} == {"v02"}
    assert "v02" in done.stdout


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_signal_that_ends_the_command_ends_its_child(tmp_path: Path, number: signal.Signals) -> None:
    """And is not taken for the vehicle's death."""
    scenario(tmp_path)
    pid_file = tmp_path / "pid"
    end = f"pathlib.Path({str(tmp_path / 'new')!r}).write_text(str(os.getpid())); os.rename('new', 'pid')"
    end += "\n            while True: pass"
    process = subprocess.Popen(command(tmp_path, end), cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        while not pid_file.exists():
            assert process.poll() is None
            time.sleep(0.01)
        assert int(pid_file.read_text()) != process.pid
        process.send_signal(number)
        assert process.wait(TIMEOUT_S) == -number
        process.communicate(timeout=TIMEOUT_S)  # the child has closed its ends
    finally:
        process.kill()
