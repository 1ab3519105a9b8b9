"""The public API, `import emulator`: what it offers, from a script and from a running event loop."""

from __future__ import annotations

import inspect
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import emulator
from emulator.checks.replay import check_replay
from emulator.records.recorded_run import RecordedRun
from emulator.records.verdicts import NotExercised
from tests.support.paths import ROOT
from vnet import Node
from vnet.errors import ProgramError, ScenarioError, VnetError

SMALL: dict[str, Any] = {
    "run": {"name": "small", "duration_s": 0.5},
    "network": {"kind": "generated", "vehicles": 3},
    "program": {"entry": "agents.beacon:main"},
}


async def greet(node: Node) -> None:
    """Broadcast once a period."""
    async for fix in node.gnss:
        await node.radio.broadcast(b"hello")
        node.report(fix.position_m, fix.covariance_m2, heard=len(node.radio.drain()))


def not_a_program(node: Node) -> None:
    """Do nothing, and not even that asynchronously."""


def test_the_public_names_are_these_and_no_more() -> None:
    assert emulator.__all__ == [
        "Answer", "Moment", "RadioFrame", "Result", "Run", "SensedTruth", "environment", "radio_for", "run",
        "simulate", "sweep",
    ]  # fmt: skip
    for name in emulator.__all__:
        assert inspect.getdoc(getattr(emulator, name)), name
        assert name in dir(emulator)
    with pytest.raises(AttributeError, match="module 'emulator' has no attribute 'simulat'"):
        emulator.simulat  # noqa: B018


@pytest.fixture
def fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have this process count as one with hash seed 0 and the arithmetic of other processors."""
    monkeypatch.setattr("emulator.api.is_fit", lambda: True)


REMEMBERS = """
async def main(node):
    import remembers_more
    from remembered import part
    async for fix in node.gnss:
        for known in (KNOWN, remembers_more.KNOWN, part.KNOWN):
            known[node.id] = known.get(node.id, 0) + 1
        node.report(known=KNOWN[node.id] + remembers_more.KNOWN[node.id] + part.KNOWN[node.id])

KNOWN = {}
"""


@pytest.mark.slow
@pytest.mark.usefixtures("fit")
def test_a_run_finds_nothing_that_one_before_has_left_in_modules(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "remembers.py").write_text(REMEMBERS)
    (tmp_path / "remembered").mkdir()
    for name in ("remembers_more.py", "remembered/part.py"):
        (tmp_path / name).write_text("KNOWN = {}\n")
    runs = [emulator.simulate("beacon", program="remembers.py", duration_s=1, out=name) for name in ("one", "two")]
    first, second = (run.reported("known") for run in runs)
    assert first.tolist() == second.tolist() and first[-1, 0] > first[0, 0] == 3


NUMBERS = """
from itertools import count

NUMBERS = count()

async def main(node):
    async for fix in node.gnss:
        node.report(number=next(NUMBERS))
"""


@pytest.mark.slow
@pytest.mark.usefixtures("fit")
def test_programs_are_those_of_the_path_of_this_process_and_keep_nothing_if_they_are_installed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("site-packages", "src"):
        package = tmp_path / name / f"fleet_{name[:3]}"
        package.mkdir(parents=True)
        (package / "car.py").write_text(NUMBERS)
        monkeypatch.syspath_prepend(tmp_path / name)
    one, other = (emulator.simulate(SMALL, program="fleet_sit.car:main") for _ in range(2))
    assert one.reported("number").tolist() == other.reported("number").tolist()
    assert other.scenario.program.folders == ()
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "own_car.py").write_text(NUMBERS)
    (elsewhere / "s.toml").write_text('[program]\nentry = "own_car:main"\n[network]\nvehicles = 1\n')
    emulator.simulate(elsewhere / "s.toml", duration_s=1, set={"run.settle_s": 0})
    with pytest.raises(VnetError, match="own_car"):
        emulator.simulate(SMALL, program="own_car:main")  # of another run's folder
    live = emulator.run(SMALL, program="fleet_src.car:main")
    assert live.scenario.program.folders == (tmp_path / "src",)
    assert live.reported("number")[0].tolist() == [0, 0, 0]


@pytest.mark.slow
@pytest.mark.usefixtures("fit")
def test_simulate_gives_a_run_with_what_was_changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    run = emulator.simulate(SMALL, program=greet, seed=3, duration_s=0.3, set={"radio.loss": 0.0})
    assert run.folder == tmp_path / "runs" / "small-3"
    assert run.verdict == "valid"
    assert (run.scenario.run.seed, run.scenario.run.duration_s, run.scenario.radio.loss) == (3, 0.3, 0.0)
    assert run.scenario.program.entry == "tests.emulator.test_public:greet"
    assert len(run.metrics) == 3 and len(run.states) == 9 and len(run.trace) == 3 * 2 * 3
    assert run.reproduce.endswith("scenario.toml")
    assert emulator.simulate(SMALL, program=greet, seed=3, duration_s=0.3, set={"radio.loss": 0.0}).folder.name == (
        "small-3-2"
    )


@pytest.mark.slow
@pytest.mark.usefixtures("fit")
def test_another_seed_is_another_run(tmp_path: Path) -> None:
    one, two = (emulator.simulate(SMALL, seed=seed, out=tmp_path / str(seed)) for seed in (1, 2))
    assert not one.trace.equals(two.trace)


@pytest.mark.slow
def test_a_function_that_no_command_can_import_runs_here_and_replay_is_not_warranted(tmp_path: Path) -> None:
    heard: list[str] = []

    async def listen(node: Node) -> None:
        async for _ in node.gnss:
            heard.append(node.id)

    run = emulator.simulate(SMALL, program=listen, out=tmp_path / "run")
    assert heard == ["v01", "v02", "v03"] * 5
    (reason,) = [each.reason for each in run.not_applicable if each.name == "replay"]
    assert reason.startswith("not warranted: the program is test_a_function")
    assert "which no command can import, and this process has not PYTHONHASHSEED=0" in reason
    assert run.reproduce.endswith("scenario.toml --program MODULE:FUNCTION")
    said = check_replay(tmp_path / "run")
    assert isinstance(said, NotExercised) and said.reason == reason, "vnet check says it again"


@pytest.mark.slow
@pytest.mark.usefixtures("fit")
def test_an_interrupted_simulation_is_written_down(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C reaches the thread that waits; the run's own thread stops between two instants."""
    from concurrent.futures import Future

    wait, interrupts = Future.result, iter([True])

    def interrupted_once(future: Future[Any], timeout: float | None = None) -> Any:
        if next(interrupts, False):
            raise KeyboardInterrupt
        return wait(future, timeout)

    monkeypatch.setattr(Future, "result", interrupted_once)
    with pytest.raises(KeyboardInterrupt):
        emulator.simulate(SMALL, duration_s=600, out=tmp_path / "run")
    assert [event.kind for event in RecordedRun.open(tmp_path / "run").events][-2:] == ["interrupted", "ended"]
    assert emulator.Run.open(tmp_path / "run").verdict == "unknown"


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: emulator.simulate("twelv"), r"^twelv: cannot be read: .*did you mean twelve"),
        (
            lambda: emulator.simulate(SMALL, set={"radio.los": 1}),
            r"radio\.los: unknown key \(did you mean loss\?\)",
        ),
        (lambda: emulator.simulate(SMALL, program=not_a_program), r"^program = <function not_a_program .*async"),  # type: ignore[arg-type]
        (lambda: emulator.run(SMALL, program=not_a_program), r"^program = <function not_a_program .*async"),  # type: ignore[arg-type]
        (lambda: emulator.run(SMALL, pacing="fast"), r"run\.pacing = 'fast'"),
        (
            lambda: emulator.run(SMALL, program=nested()),
            r"^program = nested\.<locals>\.main of .*: run needs processes",
        ),
        (lambda: emulator.sweep(SMALL, {}, program=nested()), r"^program = nested.*: sweep needs processes"),
        (lambda: emulator.sweep(SMALL, {"radio.los": [1]}), r"^sweep, radio\.los = 1: radio\.los: unknown key"),
        (lambda: emulator.sweep(SMALL, {"radio.loss": [0, 2]}), r"^sweep, radio\.loss = 2: radio\.loss = 2"),
        (
            lambda: emulator.sweep(SMALL, {"radio.loss": "ab"}),
            r"^vary radio\.loss = .ab.: a list of values is needed",
        ),
        (lambda: emulator.sweep(SMALL, {"radio.loss": [0]}, seeds=[1, 2, 1]), r"^seeds: 1 is given twice"),
        (lambda: emulator.sweep(SMALL, {"radio.loss": []}), r"^vary radio\.loss: at least one value"),
        (lambda: emulator.sweep(SMALL, {"run.seed": [1]}), r"^vary run\.seed: a sweep sets it itself"),
        (lambda: emulator.sweep(SMALL, {}, seeds=0), r"^seeds = range\(1, 1\): how many"),
        (lambda: emulator.sweep(SMALL, {}, seeds=10**7), r"^a sweep of 10,000,000 runs"),
    ],
)
def test_what_cannot_be_used_is_one_line(call: Any, message: str) -> None:
    with pytest.raises(VnetError, match=message) as raised:
        call()
    assert isinstance(raised.value, (ScenarioError, ProgramError))
    assert "\n" not in str(raised.value)


def nested() -> Any:
    """A program that nobody can import."""

    async def main(node: Node) -> None: ...

    return main


@pytest.mark.slow
def test_a_process_that_is_not_fit_has_a_worker_run_the_program(tmp_path: Path) -> None:
    """Whatever its hash seed: the trace is that of the command."""
    here = emulator.simulate("beacon", duration_s=0.5, out=tmp_path / "run")
    command = ["simulate", "beacon", "--duration=0.5", f"--out={tmp_path / 'command'}", "--no-report", "--quiet"]
    subprocess.run([sys.executable, "-m", "emulator", *command], check=True, cwd=ROOT, stdout=subprocess.DEVNULL)
    there = emulator.Run.open(tmp_path / "command")
    assert here.trace.equals(there.trace)
    assert [each.reason for each in here.not_applicable if each.name == "replay"] == [
        "it ran once; --check-determinism runs it twice"
    ]


@pytest.mark.parametrize("function", [emulator.simulate, emulator.run, partial(emulator.sweep, vary={})])
def test_a_misspelt_argument_is_hinted_at(function: Callable[..., object]) -> None:
    with pytest.raises(TypeError, match=r"no argument 'duration' \(did you mean duration_s\?\)$"):
        function("beacon", duration=1)
