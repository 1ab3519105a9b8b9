"""A debugger stops in one vehicle's program, and the trace is the same as without."""

import asyncio
import bdb
import io
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from emulator.drivers import local
from emulator.drivers.conclude import conclude
from emulator.drivers.debugging import DebugPoint, debug_point
from emulator.drivers.emulation import Emulation
from emulator.drivers.signals import signals_handled
from emulator.drivers.simulate import simulate
from emulator.scenario.scenario import Scenario
from tests.support.multi_loop_driver import emulation_of, run_together, scenario_of
from vnet.errors import VnetError
from vnet.node import Node
from vnet.runtime.debug_target import DebugTarget, resolve
from vnet.runtime.debugger import NodeDebugger, RemoteTerminal

HERE = f"{__name__}:"
THIS_FILE = Path(__file__)


async def later(node: Node) -> int:
    await asyncio.sleep(0.01)
    return len(node.id)  # returned


async def sends(node: Node) -> None:
    count = 0
    async for fix in node.gnss:
        length = await later(node)
        count += 1  # counted
        node.report(fix.position_m, fix.covariance_m2, length=length)
        await node.radio.broadcast(b"x" * count)


async def asks(node: Node) -> None:
    async for _ in node.gnss:
        breakpoint()
        await node.radio.broadcast(b"x")


async def crashes(node: Node) -> None:
    await later(node)
    raise ValueError(f"boom of {node.id}")


async def clears_up(node: Node) -> None:
    try:
        await sends(node)
    finally:
        breakpoint()


def line_of(mark: str) -> int:
    """Number of the line of this file that ends with a comment."""
    return 1 + next(n for n, line in enumerate(THIS_FILE.read_text().splitlines()) if line.endswith(f"# {mark}"))


@pytest.fixture(autouse=True)
def _no_startup_files(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("PYTHONBREAKPOINT", raising=False)


Debug = Callable[..., tuple[Emulation, list[str], bool]]


@pytest.fixture
def debug(monkeypatch: pytest.MonkeyPatch) -> Debug:
    """Simulate under a debugger that gets these commands; returns the run, what was said, and if it ended early."""

    def run(
        program: str | Scenario, target: str, *commands: str, faults: Sequence[dict[str, Any]] = ()
    ) -> tuple[Emulation, list[str], bool]:
        said = io.StringIO()
        bdb.Breakpoint.clearBreakpoints()  # Python numbers them throughout a process

        def debugger(target: DebugTarget, on_quit: Callable[[], None]) -> NodeDebugger:
            entered = io.StringIO("".join(f"{command}\n" for command in commands))
            return NodeDebugger(target, io.StringIO, on_quit, entered, said)

        monkeypatch.setattr(local, "_debugger", debugger)
        scenario = program if isinstance(program, Scenario) else scenario_of(faults, HERE + program)
        emulation = emulation_of(scenario)
        trace, hook = sys.gettrace(), sys.breakpointhook
        _, interrupted = simulate(emulation, debug=DebugTarget.parse(target))
        assert (sys.gettrace(), sys.breakpointhook) == (trace, hook), "all is as it was"
        return emulation, said.getvalue().splitlines(), interrupted

    return run


def fingerprint(emulation: Emulation) -> str:
    return str(conclude(emulation, 1.0, "simulate")[1]["trace_sha256"])


def stops(said: list[str]) -> list[str]:
    """Source lines at which it stopped."""
    return [line.removeprefix("-> ") for line in said if line.startswith("-> ")]


@pytest.mark.slow
def test_it_stops_at_the_first_line_and_steps_over_what_waits(debug: Debug) -> None:
    emulation, said, _ = debug("sends", "v02", "n", "n", "n", "p node.id, node.now_ns", "c")
    assert stops(said) == [
        "count = 0",
        "async for fix in node.gnss:",
        "length = await later(node)",
        "count += 1  # counted",
    ]
    assert said[0] == "v02, 0.000000 s of emulated time"
    assert "(Pdb) ('v02', 10000000)" in said
    assert fingerprint(emulation) == fingerprint(run_together(scenario_of([], HERE + "sends")))


@pytest.mark.slow
def test_a_step_goes_on_in_who_awaits(debug: Debug) -> None:
    _, said, _ = debug("sends", "v03", "n", "n", "s", "n", "n", "n", "w", "c")
    assert stops(said)[3:7] == [
        "await asyncio.sleep(0.01)",
        *2 * ["return len(node.id)  # returned"],
        "count += 1  # counted",
    ]
    shown = [line.partition("(")[2] for line in said if line.startswith("> ")]
    assert shown[-1] == f"{line_of('counted')})sends()", "the stack has no frame of what runs the program"


@pytest.mark.slow
def test_a_step_stops_nowhere_in_between(debug: Debug) -> None:
    _, said, _ = debug("sends", "v02", *["s"] * 30, "c")
    places = {line.partition("(")[0] for line in said if line.startswith("> ")}
    assert places == {f"> {THIS_FILE}"}


@pytest.mark.slow
def test_breakpoints_of_others_pass(debug: Debug) -> None:
    emulation, said, _ = debug("asks", "v03", *["c", "p node.id"] * 20, "c")
    assert "(Pdb) 'v03'" in said
    assert len([line for line in said if "of emulated time" in line]) == 1 + 15, "one at the first line, one a fix"
    assert [event.kind for event in emulation.folder.events if event.node] == []


@pytest.mark.slow
def test_a_line_is_a_breakpoint_for_one_vehicle(debug: Debug) -> None:
    _, said, _ = debug(
        "sends",
        f"v02:{THIS_FILE}:{line_of('counted')}",
        "p (node.id, count)",
        "c",
        "p (node.id, count)",
        "cl 1",
        "c",
    )
    assert stops(said) == ["count += 1  # counted"] * 2
    assert [line for line in said if "'v0" in line] == ["(Pdb) ('v02', 0)", "(Pdb) ('v02', 1)"]


@pytest.mark.slow
def test_clear_asks_where_the_debugger_does(debug: Debug) -> None:
    _, said, _ = debug("sends", f"v02:{THIS_FILE}:{line_of('counted')}", "clear", "y", "c")
    assert stops(said) == ["count += 1  # counted"]
    assert any("Clear all breaks? Deleted breakpoint" in line for line in said)


def test_interact_asks_where_the_debugger_does(debug: Debug) -> None:
    streams = sys.stdin, sys.stdout, sys.stderr
    _, said, _ = debug("sends", "v03", "interact", "print(node.id + '!')", "1 / 0")
    assert ">>> v03!" in said
    assert "ZeroDivisionError: division by zero" in said
    assert (sys.stdin, sys.stdout, sys.stderr) == streams


@pytest.mark.slow
def test_a_crash_can_be_looked_at(debug: Debug) -> None:
    emulation, said, _ = debug("crashes", "v02", "c", "p node.id", "c")
    assert "v02 has crashed: ValueError: boom of v02" in "\n".join(said)
    assert "(Pdb) 'v02'" in said
    crashed = [event.node for event in emulation.folder.events if event.kind == "crashed"]
    assert crashed == ["v01", "v02", "v03", "v04"]


@pytest.mark.parametrize("commands", [["n", "q"], ["n"]], ids=["q", "end of input"])
def test_quitting_ends_the_run(debug: Debug, commands: list[str]) -> None:
    emulation, said, interrupted = debug("sends", "v02", *commands)
    assert interrupted
    assert [event.kind for event in emulation.folder.events][-1] == "interrupted"
    assert len(stops(said)) == 2


@pytest.mark.slow
def test_it_lets_go_when_the_run_ends(debug: Debug) -> None:
    _, said, _ = debug("clears_up", "v02", "c")
    assert len(stops(said)) == 1, "not in a finally block after the end"


@pytest.mark.slow
def test_a_restarted_program_stops_again(debug: Debug) -> None:
    fault = {"kind": "restart", "at_s": 1.0, "duration_s": 0.2, "nodes": ["v02"]}
    _, said, _ = debug("sends", "v02", "c", "p node.incarnation", "c", faults=[fault])
    assert stops(said) == ["count = 0"] * 2
    assert "(Pdb) 1" in said


@pytest.mark.slow
def test_it_cannot_be_started_again(debug: Debug) -> None:
    _, said, interrupted = debug("sends", "v02", "run", "c")
    assert "(Pdb) *** the run cannot be started again from here; q ends it" in said
    assert not interrupted


@pytest.mark.parametrize("text", ["", ":", "v02:", "v02:12", "v02:a.py:", "v02:a.py:0", "v02:a.py:x", ":a.py:1"])
def test_a_wrong_target_is_refused(text: str) -> None:
    with pytest.raises(VnetError, match=r"--debug .*: write it as NODE or NODE:FILE:LINE"):
        DebugTarget.parse(text)


def test_a_file_is_looked_for_here_and_beside_the_program(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text("import os\n\n\nasync def main(node):\n    # nothing\n    pass\n")
    target = resolve(DebugTarget.parse("v02:own.py:6"), (tmp_path,))
    assert target == DebugTarget("v02", str(tmp_path / "own.py"), 6)
    assert DebugTarget.parse(str(target)) == target
    with pytest.raises(VnetError, match=r"no code on line 5; the next one with code is 6"):
        resolve(DebugTarget.parse("v02:own.py:5"), (tmp_path,))
    with pytest.raises(VnetError, match=r"no code on line 99$"):
        resolve(DebugTarget.parse("v02:own.py:99"), (tmp_path,))
    with pytest.raises(VnetError, match=r"own.py: no such file"):
        resolve(DebugTarget.parse("v02:own.py:6"), ())


@pytest.mark.slow
def test_a_script_of_a_zenoh_vehicle_is_stopped_at_its_first_line_and_outside_of_functions(
    debug: Debug, tmp_path: Path
) -> None:
    path = tmp_path / "script.py"
    path.write_text("import time\n\nfor number in range(3):\n    time.sleep(0.1)\n    number *= 2\n")
    program = {"kind": "zenoh", "command": ["python", str(path)]}
    scenario = Scenario.model_validate({"run": {"duration_s": 1.0}, "network": {"vehicles": 2}, "program": program})
    _, said, _ = debug(scenario, "v02", "n", "c")
    assert stops(said) == ["import time", "for number in range(3):"]
    target = resolve(DebugTarget.parse(f"v02:{path}:5"), (), has_scripts=True)
    _, said, _ = debug(scenario, str(target), "c", f"cl {path}:5", "c")
    assert stops(said) == ["number *= 2"] * 2
    *_, interrupted = debug(scenario, "v02", "q")
    assert interrupted


# The terminal of another process.


def answered(*answers: str | BaseException, talk: Callable[[RemoteTerminal], None]) -> None:
    """Let a debugger `talk` on a thread, and answer it on a loop here."""
    queue = iter(answers)

    def ask(prompt: str) -> str:
        answer = next(queue)
        if isinstance(answer, BaseException):
            raise answer
        return answer

    async def main() -> None:
        point: DebugPoint | None
        with debug_point(DebugTarget("v02"), ask) as point:
            assert point is not None
            await asyncio.to_thread(talk, RemoteTerminal(point.socket))

    asyncio.run(main())


def test_a_debugger_elsewhere_asks_here(capsys: pytest.CaptureFixture[str]) -> None:
    lines = []

    def talk(terminal: RemoteTerminal) -> None:
        with terminal.open():
            terminal.write("here\n(Pdb) ")
            lines.append(terminal.readline())
            terminal.write("12\n(Pdb) ")
            lines.append(terminal.readline())
            terminal.write("bye\n")

    answered("p 12", KeyboardInterrupt(), EOFError(), talk=talk)
    assert lines == ["p 12\n", ""]
    assert capsys.readouterr().out == "here\n12\n\n--KeyboardInterrupt--\n\nbye\n"


@pytest.fixture
def signals() -> Iterator[list[int]]:
    """The signals that end a run, as they come."""
    came: list[int] = []
    with signals_handled(lambda number, frame: came.append(number), signal.SIGINT, signal.SIGTERM):
        yield came


def test_quitting_elsewhere_is_an_interrupt_here(signals: list[int]) -> None:
    answered(talk=RemoteTerminal.quit)
    assert signals == [signal.SIGINT]


def test_sigterm_ends_a_prompt(signals: list[int]) -> None:
    def talk(terminal: RemoteTerminal) -> None:
        with terminal.open():
            assert terminal.readline() == ""

    async def main() -> None:
        def ask(prompt: str) -> str:
            signal.raise_signal(signal.SIGTERM)
            raise AssertionError("the signal comes first")

        with debug_point(DebugTarget("v02"), ask) as point:
            assert point is not None
            await asyncio.to_thread(talk, RemoteTerminal(point.socket))

    asyncio.run(main())
    assert signals == [signal.SIGTERM]


def test_a_debugger_without_its_user_gets_no_line(tmp_path: Path) -> None:
    terminal = RemoteTerminal(tmp_path / "gone")
    with terminal.open():
        assert terminal.readline() == ""
