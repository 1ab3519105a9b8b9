"""The observer of a live run: whatever becomes of it, the run goes on, and the recording is there."""

import json
import os
import shlex
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest

from emulator.viewer.sinks import is_closed
from tests.support.forked_commands import VNET, Command, run
from tests.support.paths import ROOT
from tests.support.processes import has_ended, wait_until
from tests.support.recordings import descendants, listening_addresses, read_back, rrd
from tests.system.conftest import TIMEOUT_S, killed_at_last
from tests.system.test_faults import processes_of, started, wait_until_all_are_gone, write

LONG: dict[str, dict[str, Any]] = {
    "run": {"duration_s": 30.0, "name": "watched"},
    "program": {"entry": "agents.beacon:main"},
}


def observer_of(folder: Path) -> int:
    """The pid of the observer of a run."""
    for process in Path("/proc").glob("[0-9]*"):
        try:
            log = str((process / "fd" / "1").readlink())
            command = (process / "cmdline").read_bytes().split(b"\0")
        except OSError:
            continue
        if log == str(folder / "logs" / "recorder.log") and b"record" in command:
            return int(process.name)
    raise AssertionError("there is no observer")


def wait_for_recording(folder: Path, process: subprocess.Popen[str], growths: int = 5) -> None:
    """Wait until the recording has grown several times: it has its scene by then, and rows of the run."""
    path = folder / "recording.rrd"
    sizes: set[int] = set()

    def has_grown() -> bool:
        if path.exists():
            sizes.add(path.stat().st_size)
        return len(sizes) > growths

    wait_until(has_grown, process)


def wait_for_end(pid: int) -> None:
    assert has_ended(pid, TIMEOUT_S)


def verdict_of(folder: Path) -> str:
    return json.loads((folder / "verdict.json").read_text())["verdict"]


def test_a_killed_observer_does_not_end_the_run_and_its_recording_is_repaired_by_the_printed_command(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "run"
    with started(write(tmp_path, [], **LONG), folder, "--rerun", "save", after="started") as process:
        wait_for_recording(folder, process)
        os.kill(observer_of(folder), signal.SIGKILL)
        stdout, stderr = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 0, stdout + stderr
    assert verdict_of(folder) == "valid"
    assert not is_closed(folder / "recording.rrd")
    printed = next(line for line in stdout.splitlines() if "rrd optimize" in line).partition("   (")[0]
    words = shlex.split(printed.removeprefix("next"))
    assert subprocess.run(words, cwd=ROOT, capture_output=True).returncode == 0
    repaired = folder / "recording-repaired.rrd"
    assert rrd("verify", str(repaired)).returncode == 0
    assert read_back(repaired)["/map/true"].at["Points2D:positions"]


def test_an_observer_that_is_told_to_end_closes_the_recording_and_the_run_goes_on(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with started(write(tmp_path, [], **LONG), folder, "--rerun", "save", after="started") as process:
        wait_for_recording(folder, process)
        observer = observer_of(folder)
        os.kill(observer, signal.SIGTERM)
        wait_for_end(observer)
        assert is_closed(folder / "recording.rrd")
        stdout, stderr = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 0, stdout + stderr
    assert rrd("verify", str(folder / "recording.rrd")).returncode == 0
    assert "rrd optimize" not in stdout


def test_an_observer_that_stands_still_holds_nothing_up(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with started(write(tmp_path, [], **LONG), folder, "--rerun", "save", after="started") as process:
        wait_for_recording(folder, process)
        observer = observer_of(folder)
        os.kill(observer, signal.SIGSTOP)
        wait_until(lambda: set(processes_of(folder)) == {observer})  # the vehicles have run to their end
        os.kill(observer, signal.SIGCONT)
        stdout, stderr = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 0, stdout + stderr
    assert verdict_of(folder) == "valid"
    assert rrd("verify", str(folder / "recording.rrd")).returncode == 0


def test_what_is_served_is_served_here_only_and_nothing_of_it_outlives_an_emulator_that_is_killed(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "run"
    long = {**LONG, "run": {**LONG["run"], "duration_s": 7200.0, "orphan_timeout_s": 0.5}}
    with started(write(tmp_path, [], **long), folder, "--rerun", "serve", after="started") as process:
        wait_for_recording(folder, process)
        told = run([*VNET, "view", str(folder)], cwd=ROOT, capture_output=True, text=True)
        assert told.returncode == 0, told.stderr
        assert told.stdout.startswith("the run is on\nviewer: rerun --connect rerun+http://127.0.0.1:")
        pids = descendants(observer_of(folder))
        assert len(pids) == 2, "the observer, and the server of web pages"
        listening = set().union(*map(listening_addresses, pids))
        assert len(listening) == 2
        assert all(address.startswith("127.0.0.1:") for address in listening)
        process.kill()
        wait_until_all_are_gone(folder)
    assert rrd("verify", str(folder / "recording.rrd")).returncode == 0


def test_the_server_of_web_pages_ends_with_an_observer_that_is_killed(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    long = {**LONG, "run": {**LONG["run"], "duration_s": 150.0}}
    with started(write(tmp_path, [], **long), folder, "--rerun", "serve", after="started") as process:
        wait_for_recording(folder, process)
        observer = observer_of(folder)
        (pages,) = descendants(observer) - {observer}
        os.kill(observer, signal.SIGKILL)
        wait_for_end(pages)
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=TIMEOUT_S)


@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGTERM])
def test_a_finished_run_is_served_until_it_is_enough(tmp_path: Path, ending: signal.Signals) -> None:
    folder = tmp_path / "run"
    scenario = write(tmp_path, [], run={"duration_s": 1.0}, program={"entry": "agents.beacon:main"})
    done = run([*VNET, "simulate", scenario, "--out", str(folder), "--rerun", "save"], cwd=ROOT)
    assert done.returncode == 0
    whole = (folder / "recording.rrd").read_bytes()
    (folder / "recording.rrd").write_bytes(whole[:-100])  # as if it had been killed
    command = [*VNET, "view", str(folder), "--serve"]
    with Command(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process, killed_at_last(process):
        assert process.stdout is not None
        assert "was not closed" in process.stdout.readline()
        assert process.stdout.readline().startswith("serving ")
        viewer = process.stdout.readline()
        port = int(viewer.rpartition(":")[2].partition("/")[0])
        wanted = {f"127.0.0.1:{port}", f"127.0.0.1:{port + 1}"}
        wait_until(lambda: set().union(*map(listening_addresses, descendants(process.pid))) == wanted, process)
        pids = descendants(process.pid)
        process.send_signal(ending)
        assert process.wait(TIMEOUT_S) == 0
    assert not any(Path(f"/proc/{pid}").exists() for pid in pids)
