"""A simulation in one process outlives what ends a process in its midst: that is the death of the vehicle."""

import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from tests.support.forked_commands import VNET, Command, run
from tests.support.paths import ROOT
from tests.support.processes import wait_until
from tests.system.by_hand import line_of
from tests.system.conftest import TIMEOUT_S

PROGRAM = """
import asyncio, ctypes, os, pathlib, signal, threading
async def main(node):
    async for fix in node.gnss:
        if node.id == "v02" and fix.time_ns == 500_000_000:
            END
        await node.radio.broadcast(b"x")
"""
FAULT = "ctypes.string_at(0)"
ENDLESS = "pathlib.Path('new').write_text(str(os.getpid())); os.rename('new', 'pid')\n            while True: pass"


def command(folder: Path, end: str) -> list[str]:
    text = (ROOT / "scenarios" / "beacon.toml").read_text()
    (folder / "beacon.toml").write_text(text.replace("duration_s = 10.0", "duration_s = 2.0"))
    (folder / "deadly.py").write_text(PROGRAM.replace("END", end))
    return [*VNET, "simulate", "beacon.toml", "--program", "deadly.py:main", "--out", "run", "--no-report"]


def ended(words: list[str], folder: Path, status: int) -> subprocess.CompletedProcess[str]:
    """Run a command to its end, which is of this status."""
    done = run(words, cwd=folder, capture_output=True, timeout=TIMEOUT_S)
    assert done.returncode == status, done.stderr
    return done


@pytest.mark.parametrize(
    "end", [FAULT, "ctypes.CDLL(None)._exit(0)", "await asyncio.to_thread(ctypes.string_at, 0)"]
)
def test_the_end_of_the_process_is_the_death_of_its_vehicle(tmp_path: Path, end: str) -> None:
    done = ended(command(tmp_path, end), tmp_path, 1)
    verdict = json.loads((tmp_path / "run" / "verdict.json").read_text())
    assert verdict["verdict"] == "invalid"
    assert (tmp_path / "run" / "trace.parquet").exists()
    assert died(tmp_path / "run") == {"v02"}
    assert "v02" in done.stdout


@pytest.mark.parametrize(
    ("endless", "kind", "status", "processes"),
    [("while True: pass", "stalled", 3, "1"), ("ctypes.CDLL(None).pthread_exit(None)", "died", 1, "2")],
)
def test_a_program_that_stalls_ends_the_run_with_its_name(
    tmp_path: Path, endless: str, kind: str, status: int, processes: str
) -> None:
    ended(
        [*command(tmp_path, endless), "--set", "run.stall_timeout_s=0.3", "--processes", processes],
        tmp_path,
        status,
    )
    assert "v02" in {event["node"] for event in events(tmp_path / "run") if event["kind"] == kind}


def test_a_program_that_stalls_once_and_not_again_has_not_died(tmp_path: Path) -> None:
    """It was the machine that stood, or who reads the output."""
    stalls = "is_first = not os.path.exists('once'); open('once', 'w').close()\n            while is_first: pass"
    ended([*command(tmp_path, stalls), "--set", "run.stall_timeout_s=2"], tmp_path, 0)
    assert died(tmp_path / "run") == set()


@pytest.mark.parametrize("end", ["while True: pass", FAULT])
def test_what_ends_the_process_after_the_run_is_a_death_then_and_no_earlier(tmp_path: Path, end: str) -> None:
    words = [*command(tmp_path, "pass"), "--set", "run.stall_timeout_s=0.3"]
    program = PROGRAM.replace("END", "pass")
    ending = f"    finally:\n        if node.id == 'v02':\n            {end}\n"
    program = program.replace("    async for", "    try:\n     async for") + ending
    (tmp_path / "deadly.py").write_text(program)
    ended(words, tmp_path, 1)
    assert died(tmp_path / "run") == {"v02"}
    checks = json.loads((tmp_path / "run" / "verdict.json").read_text())["checks"]
    assert [check["name"] for check in checks if check["verdict"] == "invalid"] == ["agents_alive"]


CATCHES_ALL = """while True:
                try:
                    await asyncio.sleep(1.0)
                except BaseException as error:
                    ANSWER"""


@pytest.mark.parametrize(
    ("answer", "status"), [("pass", 0), ("while isinstance(error, GeneratorExit): pass", 1)], ids=["waits", "spins"]
)
def test_a_program_that_catches_all_that_ends_it_has_died_after_the_run_if_it_does_not_wait(
    tmp_path: Path, answer: str, status: int
) -> None:
    words = command(tmp_path, CATCHES_ALL.replace("ANSWER", answer))
    ended([*words, "--set", "run.stall_timeout_s=0.3"], tmp_path, status)
    assert died(tmp_path / "run") == ({"v02"} if status else set())


STALL = "all(True for _ in iter(int, 1))"


@pytest.mark.parametrize("processes", ["1", "2"])
@pytest.mark.parametrize(("end", "status"), [("0", 0), (FAULT, 1), (STALL, 3)], ids=["ends", "fault", "stall"])
def test_what_a_program_has_started_ends_with_the_simulation(
    tmp_path: Path, end: str, status: int, processes: str
) -> None:
    """Otherwise it would keep what is printed open, and who reads that would wait for ever."""
    begins = f"__import__('subprocess').Popen(['sh', '-c', 'sleep 1000; true']); {end}"
    words = [*command(tmp_path, begins), "--set", "run.stall_timeout_s=0.5"]
    ended([*words, "--processes", processes], tmp_path, status)


def test_a_stall_is_seen_while_orphans_of_programs_end(tmp_path: Path) -> None:
    orphans = "threading.Thread(target=lambda: [os.system('true &') for _ in iter(int, 1)], daemon=True).start()"
    words = [*command(tmp_path, f"{orphans}; {STALL}"), "--set", "run.stall_timeout_s=0.5"]
    ended(words, tmp_path, 3)
    assert "v02" in {event["node"] for event in events(tmp_path / "run") if event["kind"] == "stalled"}


def test_what_was_there_before_the_command_lives_on(tmp_path: Path) -> None:
    """A shell keeps its background jobs, and what reads its output, when it becomes a command by `exec`."""
    words = shlex.join([*command(tmp_path, FAULT), "--quiet"])
    script = f"sleep 1000 >/dev/null 2>&1 & echo $! >sleeps; exec {words} >out.txt 2>&1"
    subprocess.run(["sh", "-c", script], cwd=tmp_path, timeout=TIMEOUT_S, check=False)
    assert died(tmp_path / "run") == {"v02"}
    os.kill(int((tmp_path / "sleeps").read_text()), signal.SIGKILL)


LATER = """
import atexit, ctypes, os, pathlib, threading
def end():
    while not pathlib.Path("run/AFTER").exists():
        pass
    END
async def main(node):
    if node.id == "v02":
        BEGIN
    async for fix in node.gnss:
        await node.radio.broadcast(b"x")
"""


def later(folder: Path, begin: str, end: str, after: str = "world.npz") -> subprocess.CompletedProcess[str]:
    """Run a program that ends so once a file is there, by default the first of those written after a run."""
    words = command(folder, "")
    (folder / "deadly.py").write_text(LATER.replace("BEGIN", begin).replace("END", end).replace("AFTER", after))
    return run(words, cwd=folder, capture_output=True, timeout=TIMEOUT_S)


def test_a_thread_that_ends_the_process_before_the_command_has_ended_is_no_pass(tmp_path: Path) -> None:
    begin, end = "threading.Thread(target=end, daemon=True).start()", "ctypes.CDLL(None)._exit(0)"
    assert later(tmp_path, begin, end).returncode in (1, 2)


def test_a_fatal_signal_once_all_is_written_leaves_the_run_as_it_is(tmp_path: Path) -> None:
    begin = "threading.Thread(target=end, daemon=True).start()"
    assert later(tmp_path, begin, "os.abort()", after="manifest.json").returncode == -signal.SIGABRT
    assert (tmp_path / "run" / "trace.parquet").exists() and died(tmp_path / "run") == set()
    assert json.loads((tmp_path / "run" / "verdict.json").read_text())["verdict"] == "valid"


@pytest.mark.parametrize("end", ["while True: pass", "os._exit(1)"])
def test_what_a_program_registers_with_atexit_does_not_run(tmp_path: Path, end: str) -> None:
    done = later(tmp_path, "atexit.register(end)", end)
    assert done.returncode == 0, done.stderr
    assert json.loads((tmp_path / "run" / "verdict.json").read_text())["verdict"] == "valid"


def events(folder: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]


def died(folder: Path) -> set[object]:
    return {event["node"] for event in events(folder) if event["kind"] == "died"}


def test_vehicles_that_end_the_process_die_and_no_others(tmp_path: Path) -> None:
    end = f"{FAULT}\n        if node.id in ('v04', 'v07') and fix.time_ns == 700_000_000:\n            {FAULT}"
    ended(command(tmp_path, end), tmp_path, 1)
    assert died(tmp_path / "run") == {"v02", "v04", "v07"}


@pytest.mark.parametrize("options", [["--log-format", "json"], ["--rerun", "save"], ["--check-determinism"]])
def test_options_hold_for_the_run_that_is_made_again(tmp_path: Path, options: list[str]) -> None:
    """Standard output has one result, and the folder what was asked for."""
    done = ended([*command(tmp_path, FAULT), *options], tmp_path, 1)
    assert done.stdout.count('"verdict": "invalid"' if "json" in options else "verdict: invalid") >= 1
    if options[0] == "--log-format":
        assert len(done.stdout.splitlines()) == 1
    verdict = json.loads((tmp_path / "run" / "verdict.json").read_text())
    checks = {check["name"]: check for check in verdict["checks"]}
    assert died(tmp_path / "run") == {"v02"}
    assert (tmp_path / "run" / "recording.rrd").exists() is ("--rerun" in options)
    if options == ["--check-determinism"]:
        assert checks["replay"]["verdict"] == "unknown", "when a process ends depends on how the run is made"
    assert [name for name, check in checks.items() if check["verdict"] == "invalid"] == ["agents_alive"]


def test_no_folder_is_left_of_the_first_attempt(tmp_path: Path) -> None:
    without_out = [each for each in command(tmp_path, FAULT) if each not in ("--out", "run")]
    ended(without_out, tmp_path, 1)
    assert sorted(path.name for path in (tmp_path / "runs").iterdir()) == ["beacon-1", "latest"]
    assert died(tmp_path / "runs" / "latest") == {"v02"}


def test_a_closed_standard_output_does_not_lose_the_verdict(tmp_path: Path) -> None:
    words = command(tmp_path, FAULT)
    with Command(words, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        assert process.stdout is not None
        process.stdout.close()
        process.wait(TIMEOUT_S)
    assert json.loads((tmp_path / "run" / "verdict.json").read_text())["verdict"] == "invalid"


def waits(pid: int) -> bool:
    """Return whether a process sleeps, and has taken every signal that was sent to it."""
    status = Path(f"/proc/{pid}/status").read_text()
    return "State:\tS" in status and "ShdPnd:\t0000000000000000" in status


@pytest.mark.parametrize("to_all", [True, False])
def test_one_interrupt_ends_the_run_once(tmp_path: Path, to_all: bool) -> None:
    """Sent to the command alone, or to its group: either way programs yield, and the folder is kept."""
    end = "pathlib.Path('reached').touch()\n            while not pathlib.Path('go').exists(): pass"
    end += "\n            pathlib.Path('went').touch()"
    arguments = [*command(tmp_path, end), "--duration", "600"]
    process = Command(
        arguments, cwd=tmp_path, start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        wait_until((tmp_path / "reached").exists, process)
        os.kill(process.pid, signal.SIGSTOP)  # so that a child in its group would see to the signal first
        (os.killpg if to_all else os.kill)(process.pid, signal.SIGINT)
        os.kill(process.pid, signal.SIGCONT)
        line_of(process, "vnet: interrupted")
        wait_until(lambda: waits(process.pid), process)  # what the command passed on now would be a second one
        (tmp_path / "go").touch()
        _, errors = process.communicate(timeout=TIMEOUT_S)
    finally:
        process.kill()
    assert process.returncode == 130, errors
    assert (tmp_path / "went").exists(), "the program was to go on until it yields"
    assert "vnet:" not in errors
    events = (tmp_path / "run" / "events.jsonl").read_text()
    assert events.count('"interrupted"') == 1 and '"died"' not in events
    assert (tmp_path / "run" / "verdict.json").exists()


def test_an_interrupt_at_the_terminal_comes_once(tmp_path: Path) -> None:
    """The kernel sends it to all that are in the foreground."""
    terminal, its = os.openpty()
    arguments = [*command(tmp_path, "pathlib.Path('reached').touch()"), "--duration", "600", "--quiet"]
    process = subprocess.Popen(
        [sys.executable, "-c", AT_TERMINAL, *arguments],
        cwd=tmp_path,
        start_new_session=True,
        stdin=its,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        wait_until((tmp_path / "reached").exists, process)
        os.write(terminal, b"\x03")
        _, errors = process.communicate(timeout=TIMEOUT_S)
    finally:
        process.kill()
        os.close(terminal)
        os.close(its)
    assert process.returncode == 130, errors
    assert errors.splitlines() == ["vnet: interrupted, as soon as the programs yield; Ctrl-C again: at once"]
    assert (tmp_path / "run" / "verdict.json").exists()


AT_TERMINAL = (
    "import fcntl, os, sys, termios; fcntl.ioctl(0, termios.TIOCSCTTY); os.execv(sys.argv[1], sys.argv[1:])"
)
"""Make the terminal on standard input that of the session, whose foreground is this process, and run a command."""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_signal_that_ends_the_command_ends_its_child(tmp_path: Path, number: signal.Signals) -> None:
    """And is not taken for the vehicle's death. The first SIGTERM waits until programs yield, which none does."""
    pid_file = tmp_path / "pid"
    process = Command(command(tmp_path, ENDLESS), cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        wait_until(pid_file.exists, process)
        assert int(pid_file.read_text()) != process.pid
        process.send_signal(number)
        if number is signal.SIGTERM:
            assert process.stderr is not None
            assert any("as soon as the programs yield" in str(line) for line in process.stderr)
            while process.poll() is None:  # a second one soon after the first is the same
                process.send_signal(number)
                with suppress(subprocess.TimeoutExpired):
                    process.wait(0.1)
        assert process.wait(TIMEOUT_S) == -number
        process.communicate(timeout=TIMEOUT_S)  # the child has closed its ends
    finally:
        process.kill()


@pytest.mark.parametrize("processes", ["1", "2"])
def test_sigterm_is_an_interrupt_and_one_that_a_program_sends_itself_its_death(
    tmp_path: Path, processes: str
) -> None:
    told = "pathlib.Path('new').write_text('x'); os.rename('new', 'pid')"
    words = [*command(tmp_path, told), "--processes", processes, "--duration", "3000"]
    process = Command(words, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        wait_until((tmp_path / "pid").exists, process)
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=TIMEOUT_S)
        assert process.returncode == 130
    finally:
        process.kill()
    assert [event["kind"] for event in events(tmp_path / "run")][-2:] == ["interrupted", "ended"]
    shutil.rmtree(tmp_path / "run")
    itself = [*command(tmp_path, "os.kill(os.getpid(), 15)"), "--processes", processes]
    assert run(itself, cwd=tmp_path, capture_output=True, timeout=TIMEOUT_S).returncode == 1
    assert "v02" in died(tmp_path / "run")
