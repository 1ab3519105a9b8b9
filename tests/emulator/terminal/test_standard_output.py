"""Standard output is for the result alone where that is asked for, whatever prints."""

import ctypes
import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from emulator.records.run_folder import PROGRAMS_LOG
from emulator.terminal.console import Tolerant, result_only
from tests.support.paths import ROOT

VNET = [sys.executable, "-P", "-m", "emulator"]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}
TALKATIVE = """
import atexit, ctypes, os, subprocess, sys
c = ctypes.CDLL(None)
print("from an import")
atexit.register(print, "at the end")
async def main(node):
    print("from Python")
    c.puts(b"from C")
    os.write(1, b"from a descriptor\\n")
    subprocess.run(["echo", "from a child"])
    await node.sleep(0.1)
"""
SAID = ["from Python", "from C", "from a descriptor", "from a child"]


def test_what_prints_is_kept_and_the_result_is_printed(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with result_only(True) as output:
        print("early")
        output.keep_in(tmp_path)
        print("from Python")
        ctypes.CDLL(None).puts(b"from C")
        os.write(1, b"from a descriptor\n")
        output.print("the result")
        print("late")
    print("afterwards")
    assert capfd.readouterr().out == "the result\nafterwards\n"
    kept = (tmp_path / PROGRAMS_LOG).read_text().splitlines()
    assert kept[0] == "early"
    assert sorted(kept[1:]) == ["from C", "from Python", "from a descriptor", "late"]


def test_a_caller_with_another_standard_output_gets_the_result_alone(capsys: pytest.CaptureFixture[str]) -> None:
    with result_only(True) as output:
        print("noise")
        output.print("the result")
    assert capsys.readouterr().out == "the result\n"


def test_else_everything_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    with result_only(False) as output:
        print("noise")
        output.print("the result")
    assert capsys.readouterr().out == "noise\nthe result\n"


@pytest.mark.slow
def test_a_simulation_in_json_is_one_object(tmp_path: Path) -> None:
    (tmp_path / "talkative.py").write_text(TALKATIVE)
    scenario = str(ROOT / "scenarios" / "beacon.toml")
    command = ["simulate", scenario, "--program", "talkative:main", "--duration", "0.5", "--out", "run"]
    command += ["--log-format", "json", "--no-report", "--set", "network.vehicles=2"]
    done = subprocess.run([*VNET, *command], cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True)
    assert json.loads(done.stdout)["vehicles"] == 2, done.stderr
    assert done.stdout.count("\n") == 1
    log = (tmp_path / "run" / "logs" / PROGRAMS_LOG).read_text()
    assert sorted(log.splitlines()) == sorted(["from an import", *2 * SAID])


def with_closed_pipe(folder: Path, *arguments: str) -> tuple[int, bytes]:
    """Run a command whose output nobody reads; returns its status and its standard error."""
    reading, writing = os.pipe()
    os.close(reading)
    try:
        done = subprocess.run(
            [*VNET, *arguments], env=ENVIRONMENT, cwd=folder, stdout=writing, stderr=subprocess.PIPE
        )
    finally:
        os.close(writing)
    return done.returncode, done.stderr


def test_what_nobody_reads_is_dropped() -> None:
    reading, writing = os.pipe()
    os.close(reading)
    with Tolerant(writing, "w") as stream:
        assert [stream.write(b"text"), stream.write(b"more")] == [4, 4]
    assert stream.failure is not None and stream.failure.errno == errno.EPIPE


@pytest.mark.slow
@pytest.mark.parametrize(("arguments", "status"), [(["--version"], 0), ([], 2)])
def test_a_closed_pipe_leaves_the_status_as_it_is(arguments: list[str], status: int, tmp_path: Path) -> None:
    assert with_closed_pipe(tmp_path, *arguments) == (status, b"")


@pytest.mark.slow
def test_output_that_cannot_be_written_is_an_error_of_one_line() -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run([*VNET, "--version"], env=ENVIRONMENT, stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 2
    assert done.stderr == "vnet: standard output: cannot be written: No space left on device\n"


@pytest.mark.slow
def test_an_invalid_run_is_invalid_though_nobody_reads_its_summary(tmp_path: Path) -> None:
    (tmp_path / "boom.py").write_text("async def main(node):\n    raise ValueError\n")
    status, said = with_closed_pipe(
        tmp_path, "simulate", str(ROOT / "scenarios" / "beacon.toml"), "--program", "boom:main", "--duration", "1"
    )
    assert status == 1, said
