"""`--debug` at a terminal: the user's commands reach the vehicle's process, and nothing times out meanwhile."""

import json
import os
import shlex
import signal
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.docs.markdown import blocks
from tests.docs.pages import shows
from tests.support.forked_commands import VNET, Command, run
from tests.support.paths import ROOT
from tests.system.conftest import TIMEOUT_S, read_terminal

PROGRAM = """
async def main(node):
    count = 0
    async for fix in node.gnss:
        count += 1
        await node.radio.broadcast(b"x" * count)
        if count == 3:
            breakpoint()
"""
SHORT = ["--duration", "1", "--set", "network.vehicles=4", "--set", "run.stall_timeout_s=1", "--no-report"]


def converse(folder: Path, steps: Sequence[tuple[str, str | signal.Signals]], *arguments: str) -> tuple[int, str]:
    """Run vnet on a terminal; whenever it has written what is awaited, enter a line or send it a signal."""
    master, slave = os.openpty()
    environment = {
        **os.environ,
        "TERM": "dumb",
        "PYTHONHASHSEED": "0",
        "HOME": str(folder),
        "PYTHONPATH": str(ROOT),
    }
    written, seen = "", 0
    waiting = list(steps)
    words = [*VNET, *arguments]
    with Command(words, cwd=folder, stdin=slave, stdout=slave, stderr=slave, env=environment) as process:
        os.close(slave)
        while part := read_terminal(master, written):
            written += part.decode().replace("\r\n", "\n")
            while waiting and (found := written.find(waiting[0][0], seen)) >= 0:
                awaited, answer = waiting.pop(0)
                seen = found + len(awaited)
                if isinstance(answer, signal.Signals):
                    process.send_signal(answer)
                    # input() may notice the signal only when there is a line, whose echo comes anywhere
                    answer = "p 7"
                os.write(master, f"{answer}\n".encode())
        os.close(master)
    assert not waiting, written
    return process.wait(TIMEOUT_S), written


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A current folder with a program."""
    (tmp_path / "prog.py").write_text(PROGRAM)
    return tmp_path


def trace_of(run: Path) -> str:
    return str(json.loads((run / "verdict.json").read_text())["trace_sha256"])


def test_a_vehicle_in_a_process_of_its_own_is_debugged(folder: Path) -> None:
    steps: list[tuple[str, str | signal.Signals]] = [
        ("(Pdb) ", "import time; time.sleep(1.2)"),  # longer than run.stall_timeout_s
        ("(Pdb) ", signal.SIGINT),
        ("--KeyboardInterrupt--\n", "c"),
        ("v02, 0.200000 s of emulated time", "!print(node.id, 'at', count)"),
        ("v02 at 3\n(Pdb) ", "c"),
    ]
    options = ["beacon", "--program", "prog.py", *SHORT]
    status, written = converse(folder, steps, "run", *options, "--debug", "v02", "--out", "debugged")
    assert status == 0, written
    (folder / "prog.py").write_text(PROGRAM.replace("breakpoint()", "pass"))
    run([*VNET, "simulate", *options, "--out", "plain"], cwd=folder, capture_output=True)
    assert trace_of(folder / "debugged") == trace_of(folder / "plain")
    assert "breakpoint() is passed over" in (folder / "debugged" / "logs" / "v01.log").read_text()


def test_quitting_ends_a_run_of_processes_that_host_several(folder: Path) -> None:
    options = [
        "beacon",
        "--program",
        "prog.py",
        *SHORT,
        "--set",
        "run.nodes_per_process=2",
        "--set",
        "run.start=spawn",
    ]
    status, written = converse(folder, [("(Pdb) ", "q")], "run", *options, "--debug", "v02:prog.py:5", "--out=run")
    assert status == 130, written
    assert written.count("of emulated time\n") == 2, "the first line of the command, and one stop"
    events = [json.loads(line) for line in (folder / "run" / "events.jsonl").read_text().splitlines()]
    assert "interrupted" in [event["kind"] for event in events]
    assert "stalled" not in [event["kind"] for event in events]


def test_the_documentation_shows_what_happens(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "how-to" / "debugging.md").read_text()
    found = {block.language: block for block in blocks(page, "debugging.md")}
    (tmp_path / "scenarios").symlink_to(ROOT / "scenarios")
    (tmp_path / "echo.py").write_text(found["python"].text)
    shown = found["text"].text
    steps: list[tuple[str, str | signal.Signals]] = [
        ("(Pdb) ", line.removeprefix("(Pdb) ")) for line in shown.splitlines() if line.startswith("(Pdb) ")
    ]
    command = shlex.split(found["sh"].text)
    assert command[0] == "vnet"
    status, written = converse(tmp_path, steps, *command[1:])
    assert status == 0, written
    assert shows(written, shown), written


def test_a_simulated_vehicle_is_debugged(folder: Path) -> None:
    steps: list[tuple[str, str | signal.Signals]] = [
        ("(Pdb) ", signal.SIGINT),
        ("--KeyboardInterrupt--\n", "p node.id"),
        ("'v02'\n", "c"),
        ("(Pdb) ", "c"),
    ]
    options = ["beacon", "--program", "prog.py", *SHORT, "--debug", "v02", "--out", "run"]
    status, written = converse(folder, steps, "simulate", *options)
    assert status == 0, written
    assert written.count("v02, 0.") == 2
