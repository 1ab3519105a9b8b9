"""Streams that cannot be written fail nobody who prints, and what failed is known at the end."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from emulator.terminal.console import Tolerant
from tests.support.paths import ROOT

VNET = [sys.executable, "-P", "-m", "emulator"]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}


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
