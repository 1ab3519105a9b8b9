"""Failures as a user meets them: one clear line, no process left, files readable."""

import resource
import signal
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from emulator.checks.judge import check_run
from tests.support.forked_commands import VNET, Command, run
from tests.support.paths import ROOT
from tests.support.processes import has_ended
from tests.system.by_hand import line_of
from tests.system.conftest import TIMEOUT_S, Finished, Vnet, killed_at_last, running_agents

LONG = [
    "--program", "tests.system.programs:runs_long", "--duration", "3600", "--set", "network.vehicles=3",
    "--no-report",
]  # fmt: skip


@contextmanager
def long_run(folder: Path, *options: str) -> Iterator[subprocess.Popen[str]]:
    """`vnet run` of a run that would take very long, once it has emulated its first periods."""
    command = [*VNET, "run", "scenarios/beacon.toml", "--out", str(folder), *LONG, *options]
    with Command(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        line_of(process, "real time")
        try:
            yield process
        finally:
            process.kill()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interruption_ends_everything_and_leaves_readable_files(tmp_path: Path, number: signal.Signals) -> None:
    folder = tmp_path / "run"
    with long_run(folder) as process:
        assert len(running_agents(folder)) == 3
        process.send_signal(number)
        stdout, stderr = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 130
    assert running_agents(folder) == []
    assert "Traceback" not in stderr
    assert "interrupted at" in stdout
    done = Finished(process.returncode, stdout, stderr, folder)
    assert done.verdict["verdict"] == "unknown"
    assert check_run(folder).exit_status == 3


def test_an_interruption_before_the_start_is_as_clean(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    command = [*VNET, "emulator", "scenarios/beacon.toml", "--listen", "tcp/127.0.0.1:0", "--out", str(folder)]
    with (
        Command(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process,
        killed_at_last(process),
    ):
        line_of(process, "waiting for 10 vehicles")
        process.send_signal(signal.SIGINT)
        stdout, stderr = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 130
    assert "Traceback" not in stderr
    assert "interrupted at 0.000 s" in stdout
    assert check_run(folder).exit_status == 3


@pytest.mark.slow
@pytest.mark.parametrize(
    "options", [[], ["--set", "run.start=spawn"], ["--hosts", "1"]], ids=["forked", "spawned", "on hosts"]
)
def test_agents_end_with_an_emulator_that_is_killed_also_in_a_busy_loop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: list[str]
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))  # where a host keeps the logs of its agents
    folder = tmp_path / "run"
    with long_run(folder, "--program", "tests.system.programs:computes_for_ever", *options) as process:
        agents = running_agents(tmp_path)
        assert len(agents) == 3
        process.kill()
        for pid in agents:
            assert has_ended(pid, 2.0), f"process {pid} is still there"


def test_a_killed_run_can_still_be_read(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with long_run(folder) as process:
        agents = running_agents(folder)
        process.kill()
        assert [pid for pid in agents if not has_ended(pid, TIMEOUT_S)] == []
    done = Finished(-9, "", "", folder)
    assert done.events_of("started")
    judged = run([*VNET, "check", str(folder)], cwd=ROOT, capture_output=True, text=True, timeout=TIMEOUT_S)
    assert judged.returncode == 2
    assert judged.stderr.count("\n") == 1
    assert "not the folder of a finished run" in judged.stderr


def test_a_port_in_use_is_one_line(vnet: Vnet) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        done = vnet("emulator", "scenarios/beacon.toml", "--listen", endpoint)
    assert done.status == 2
    assert done.stderr.splitlines()[-1] == f"vnet: cannot listen on {endpoint}: the address is already in use"


def small_files_only() -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (15_000, 15_000))


def test_a_file_that_the_disk_refuses_is_one_line_and_no_process_stays(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    command = [*VNET, "run", "scenarios/beacon.toml", "--out", str(folder), "--duration", "8", "--no-report"]
    done = run(command, cwd=ROOT, capture_output=True, timeout=TIMEOUT_S, preexec_fn=small_files_only)
    assert done.returncode == 3
    assert "Traceback" not in done.stderr
    assert any(
        line.startswith(f"vnet: note: {folder}/states.parquet: cannot write: ") for line in done.stderr.splitlines()
    )
    assert (folder / "metrics.parquet").is_file() and (folder / "verdict.json").is_file()
    assert running_agents(folder) == []


def test_nodes_that_never_join_are_named(vnet: Vnet) -> None:
    done = vnet("emulator", "scenarios/beacon.toml", "--listen", "tcp/127.0.0.1:0", "--set=run.join_timeout_s=0.2")
    assert done.status == 2
    assert "10 of 10 nodes have not joined within 0.2 s: v01, v02, v03" in done.stderr
