"""A disk that is full or read-only, and small limits of a process: one line each, and what can be kept is kept."""

import json
import os
import resource
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from emulator.checks.judge import check_run
from tests.support import forked_commands
from tests.support.forked_commands import run
from tests.system.conftest import in_this_process

pytestmark = pytest.mark.slow

VNET = shlex.join([sys.executable, "-P", "-m", "emulator"])
OPTIONS = "--quiet --no-report"
ENOUGH_KB = 1_100_000
FEW = "--set program.options.particles=20"


def shell(command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["bash", "-c", command], cwd=folder, capture_output=True, text=True, timeout=120)


def on_disk(options: str, command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a command on a disk of its own, whose files are copied to `kept` at the end."""
    if os.geteuid() != 0 or shutil.which("unshare") is None:
        pytest.skip("mounts need root and unshare")
    (folder / "disk").mkdir()
    script = f"mount -t tmpfs -o {options} none disk && ({command}); status=$?; cp -r disk kept; exit $status"
    done = subprocess.run(
        ["unshare", "-m", "bash", "-c", script], cwd=folder, capture_output=True, text=True, timeout=120
    )
    if "permission denied" in done.stderr.lower():
        pytest.skip("mounts are not permitted here")
    return done


def is_one_line_each(text: str) -> bool:
    return all(line.startswith("vnet: ") for line in text.splitlines()) and "Traceback" not in text


def test_on_a_full_disk_what_fits_is_kept_and_the_run_is_unknown(tmp_path: Path) -> None:
    done = on_disk("size=200k", f"{VNET} simulate twelve --duration 5 --out disk/run {FEW} {OPTIONS}", tmp_path)
    assert done.returncode == 3, done.stderr
    assert is_one_line_each(done.stderr) and "No space left on device" in done.stderr
    names = {path.name for path in (tmp_path / "kept" / "run").iterdir()}
    assert {"scenario.toml", "events.jsonl", "metrics.parquet", "verdict.json", "manifest.json"} <= names
    verdict = json.loads((tmp_path / "kept" / "run" / "verdict.json").read_text())
    (files,) = [check for check in verdict["checks"] if check["name"] == "files"]
    assert files["verdict"] == verdict["verdict"] == "unknown" and "states.parquet" in files["text"]
    status, _, error = in_this_process(["check", str(tmp_path / "kept" / "run")])
    assert status == 2 and "not kept" in error and is_one_line_each(error)


def test_a_disk_that_holds_no_verdict_is_told_in_one_line(tmp_path: Path) -> None:
    done = on_disk("size=16k", f"{VNET} simulate beacon --duration 1 --out disk/run {OPTIONS}", tmp_path)
    assert done.returncode == 2
    assert is_one_line_each(done.stderr) and "verdict.json: cannot write: No space left" in done.stderr


def test_a_read_only_disk_is_told_in_one_line(tmp_path: Path) -> None:
    done = on_disk("ro", f"{VNET} simulate beacon --duration 1 --out disk/run {OPTIONS}", tmp_path)
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1] == "vnet: disk/run: cannot write: Read-only file system"


@pytest.mark.parametrize(("command", "kilobytes"), [("run", 1 << 20), ("simulate", 1 << 18), ("check", 1 << 18)])
def test_too_little_address_space_is_told_before_anything_is_done(
    tmp_path: Path, command: str, kilobytes: int
) -> None:
    done = shell(f"ulimit -v {kilobytes}; {VNET} {command} beacon", tmp_path)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"vnet: ulimit -v: {kilobytes} kB of address space: ")
    assert not any(tmp_path.iterdir())


def test_a_simulation_ends_with_its_report_in_little_address_space(tmp_path: Path) -> None:
    """A library that finds no room for its memory tries for ever."""
    done = shell(f"ulimit -v {ENOUGH_KB}; {VNET} simulate quickstart --duration 1 --out run --quiet", tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "run" / "report.html").exists()


def test_memory_that_is_gone_in_the_midst_is_told_in_one_line(tmp_path: Path) -> None:
    size = "--set network.vehicles=10000 --set network.layout=dense --duration 10"
    done = shell(f"ulimit -v {ENOUGH_KB}; {VNET} simulate beacon {size} --out run {OPTIONS}", tmp_path)
    assert done.returncode == 2
    assert is_one_line_each(done.stderr) and "not enough memory: " in done.stderr


def sixty_four_descriptors() -> None:
    resource.setrlimit(resource.RLIMIT_NOFILE, (64, 64))


def test_sixty_four_descriptors_are_few_for_a_live_run_and_enough_for_a_simulated_one(tmp_path: Path) -> None:
    live, simulated = (
        run(
            [*forked_commands.VNET, command, "quickstart", "--duration", "1", "--out", command, *OPTIONS.split()],
            cwd=tmp_path,
            capture_output=True,
            preexec_fn=sixty_four_descriptors,
        )
        for command in ("run", "simulate")
    )
    assert live.returncode == 2
    assert is_one_line_each(live.stderr) and "Too many open files" in live.stderr
    assert (simulated.returncode, simulated.stderr) == (0, "")


def test_closed_descriptors_are_nobodys_files(tmp_path: Path) -> None:
    command = f"{VNET} simulate beacon --duration 1 --out run {OPTIONS} 0<&- 1>&- 2>&-"
    assert shell(command, tmp_path).returncode == 0
    assert check_run(tmp_path / "run").exit_status == 0
