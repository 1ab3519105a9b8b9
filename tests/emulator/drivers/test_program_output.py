"""Output of simulated programs is in the log of their vehicle, and in the terminal."""

import asyncio
import io
import os
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import emulator
from emulator.drivers.emulation import Emulation
from emulator.drivers.local import output_kept
from emulator.drivers.session import Session
from emulator.records import disk
from emulator.records.disk import NodeLogs
from emulator.records.recorded_run import RecordedRun
from emulator.scenario.scenario import Scenario
from tests.support.multi_loop_driver import emulation_of, run_forked, run_together, scenario_of
from vnet.node import Node
from vnet.runtime import running_node


def log_of(emulation: Emulation, node: str) -> str:
    return (emulation.folder.logs / f"{node}.log").read_text()


async def prints_everywhere(node: Node) -> None:
    def say(where: str) -> None:
        print(node.id, "in", where)

    async def task() -> None:
        say("a task")

    say("main")
    await asyncio.create_task(task())
    asyncio.get_running_loop().call_soon(say, "a callback")
    await asyncio.sleep(0.1)
    await asyncio.to_thread(say, "a job")
    thread = threading.Thread(target=say, args=("a thread",))
    thread.start()
    thread.join()
    print(node.id, "in", "error", file=sys.stderr)
    sys.stdout.writelines([node.id, " in ", "pieces", "\n"])
    node.log("noted")
    print(node.id, "without an end", end="")


WHERE = ["main", "a task", "a callback", "a job", "a thread", "error", "pieces"]


@pytest.mark.slow
@pytest.mark.parametrize("run", [run_together, run_forked])
def test_prints_are_in_the_log_of_their_vehicle_and_in_the_terminal(
    capsys: pytest.CaptureFixture[str], run: Callable[[Scenario], Emulation]
) -> None:
    emulation = run(scenario_of([], f"{__name__}:prints_everywhere", vehicles=2))
    terminal = capsys.readouterr()
    for node in ("v01", "v02"):
        said = [f"{node} in {where}" for where in WHERE]
        rest = [f"0.100000 {node} info: noted", f"{node} without an end{node} finished"]
        assert log_of(emulation, node).splitlines() == [*said, *rest]
        assert [line for line in said if f"{line}\n" not in terminal.out] == [f"{node} in error"]
        assert f"{node} in error\n" in terminal.err


@pytest.mark.slow
def test_what_a_modules_handler_writes_is_in_the_log_of_the_vehicle(tmp_path: Path) -> None:
    """It has bound the stream while the module was imported, as loguru does."""
    (tmp_path / "tells.py").write_text(
        """
import logging, sys
log = logging.getLogger("tells")
log.addHandler(logging.StreamHandler(sys.stdout))

async def main(node):
    log.warning(node.id)
"""
    )
    scenario = Scenario.model_validate(
        {"network": {"vehicles": 2}, "program": {"entry": "tells:main", "folders": [str(tmp_path)]}}
    )
    emulator.simulate(scenario, out=tmp_path / "run")
    logs = [(tmp_path / "run" / "logs" / f"{node}.log").read_text() for node in ("v01", "v02")]
    assert [text.splitlines().count(node) for text, node in zip(logs, ("v01", "v02"), strict=True)] == [1, 1]


async def prints_a_beginning(node: Node) -> None:
    print("begun", end="")
    await asyncio.sleep(99)


@pytest.mark.slow
def test_a_line_without_an_end_is_written_when_the_run_ends() -> None:
    emulation = run_together(scenario_of([], f"{__name__}:prints_a_beginning", vehicles=2))
    assert log_of(emulation, "v01") == "begun\n"


async def crashes(node: Node) -> None:
    print(node.incarnation)
    await asyncio.sleep(1.0)
    raise ValueError("boom")


def test_prints_and_a_crash_are_in_order() -> None:
    emulation = run_together(scenario_of([], f"{__name__}:crashes", vehicles=2))
    lines = log_of(emulation, "v01").splitlines()
    assert lines[:2] == ["0", "v01 crashed"]
    assert lines[-1] == "ValueError: boom"


async def takes_the_stream_for_its_own(node: Node) -> None:
    out: Any = sys.stdout
    out.buffer.write("bytes ä\n".encode())
    for stream in out.buffer, out.detach():
        io.TextIOWrapper(stream, encoding="utf-8").write("wrapped\n")  # which closes it as it is collected
    out.close()
    print("further")
    sys.stdout = io.StringIO()


@pytest.mark.slow
@pytest.mark.parametrize("run", [run_together, run_forked])
def test_no_program_closes_the_output_of_all(
    capsys: pytest.CaptureFixture[str], run: Callable[[Scenario], Emulation]
) -> None:
    before = sys.stdout
    emulation = run(scenario_of([], f"{__name__}:takes_the_stream_for_its_own", vehicles=1))
    assert sys.stdout is before
    said = ["bytes ä", "wrapped", "wrapped", "further"]
    assert log_of(emulation, "v01").splitlines() == [*said, "v01 finished"]
    assert [line for line in capsys.readouterr().out.splitlines() if line in said] == said


async def changes_the_process(node: Node) -> None:
    os.chdir("/")
    os.environ.clear()
    sys.path.clear()
    print("moved")
    node.event("moved")


def test_what_programs_change_of_their_process_is_taken_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    variables, modules = dict(os.environ), set(sys.path)
    session = Session(scenario_of([], f"{__name__}:changes_the_process", vehicles=2), Path("run")).open()
    session.run()
    session.close()
    assert (dict(os.environ), Path.cwd()) == (variables, tmp_path) and modules <= set(sys.path)
    assert (tmp_path / "run/logs/v01.log").read_text().startswith("moved\n")
    assert [event.kind for event in RecordedRun.open(Path("run"), {}).events].count("event") == 2


async def never_ends_a_line(node: Node) -> None:
    for _ in range(100):
        print("x" * 100, end="")


def test_a_flood_is_bounded(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(disk, "LARGEST_LOG_BYTES", 5000)
    monkeypatch.setattr(disk, "LONGEST_HELD", 1000)
    emulation = run_together(scenario_of([], f"{__name__}:never_ends_a_line", vehicles=2))
    log = log_of(emulation, "v01")
    assert log == "x" * 5000 + "(the log is full: further lines are left out after 5,000 bytes)\n"
    assert capsys.readouterr().out.count("x") == 20_000


def test_the_streams_are_given_back_also_by_two_simulations_at_once() -> None:
    before = (sys.stdout, sys.stderr)
    emulation = emulation_of(scenario_of([], f"{__name__}:crashes", vehicles=2))
    logs = NodeLogs(emulation.folder.logs)
    first, second = (output_kept(lambda node: False, logs) for _ in range(2))
    first.__enter__()
    second.__enter__()
    assert sys.stdout is not before[0]
    assert sys.stdout.encoding == before[0].encoding
    first.__exit__(None, None, None)
    assert sys.stdout is not before[0], "the other one still goes on"
    second.__exit__(None, None, None)
    assert (sys.stdout, sys.stderr) == before


class Reader(io.StringIO):
    """A stream that notes whose code runs while it is written to."""

    def __init__(self) -> None:
        super().__init__()
        self.running: list[str] = []

    def write(self, text: str) -> int:
        self.running.append(running_node.running.read())
        return super().write(text)

    def flush(self) -> None:
        self.running.append(running_node.running.read())


async def prints_and_flushes(node: Node) -> None:
    print(node.id, flush=True)
    assert running_node.running.read() == node.id


def test_a_program_that_waits_for_who_reads_its_output_does_not_run_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pager that holds a page is no stall."""
    reader = Reader()
    monkeypatch.setattr(sys, "stdout", reader)
    run_together(scenario_of([], f"{__name__}:prints_and_flushes", vehicles=2))
    assert set(reader.running) == {""}
    assert reader.getvalue() == "v01\nv02\n"
