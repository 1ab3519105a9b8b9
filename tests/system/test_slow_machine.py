"""Shipped scenarios on a machine made small and slow: the same verdict or unknown, never invalid."""

import os
from pathlib import Path

from tests.support.forked_commands import VNET, run
from tests.support.paths import ROOT
from tests.system.conftest import PATIENT, TIMEOUT_S, Finished, Vnet

LITTLE_MB = 8
"""Private memory in MB in which a cooperative agent does not fit."""


def make_slow() -> None:
    """Give this process, and all that it starts, one processor and the lowest priority."""
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    os.nice(19)


def run_slowly(folder: Path, *words: str) -> Finished:
    command = [*VNET, "run", *words, "--out", str(folder), "--no-report", *PATIENT]
    done = run(command, cwd=ROOT, capture_output=True, timeout=TIMEOUT_S, preexec_fn=make_slow)
    return Finished(done.returncode, done.stdout, done.stderr, folder)


def test_a_slow_machine_gives_the_same_verdict(vnet: Vnet, tmp_path: Path) -> None:
    words = ["scenarios/faults.toml", "--duration", "15", "--program", "agents.beacon:main"]
    slow, expected = run_slowly(tmp_path / "slow", *words), vnet("simulate", *words)
    assert slow.status == expected.status == 0, slow.stderr + slow.stdout
    assert slow.fingerprint == expected.fingerprint


def test_a_small_machine_is_unknown(tmp_path: Path) -> None:
    small = run_slowly(tmp_path / "small", "scenarios/faults.toml", "--set", f"run.memory_limit_mb={LITTLE_MB}")
    assert small.status == 3, small.stderr + small.stdout
    assert "invalid" not in {check["verdict"] for check in small.verdict["checks"]}
    assert small.events_of("memory_exceeded")


def test_real_time_on_a_slow_machine_is_valid_or_unknown(tmp_path: Path) -> None:
    words = ["scenarios/twelve.toml", "--duration", "2", "--pacing", "realtime"]
    slow = run_slowly(tmp_path / "slow", *words)
    assert slow.status in (0, 3), slow.stderr + slow.stdout
    assert "invalid" not in {check["verdict"] for check in slow.verdict["checks"]}
