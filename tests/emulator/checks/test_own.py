"""Checks of a user's own: their results stand in the verdict; what fails is unknown, named, and stops nothing."""

import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import emulator
from emulator.checks.judge import judge
from emulator.checks.own import own_findings
from emulator.records.events import Event
from emulator.records.recorded_run import RecordedRun
from emulator.records.verdicts import CheckResult, NotExercised, Verdict
from emulator.report.source import Source
from emulator.report.write import write_report
from emulator.scenario.program import Program
from tests.emulator.checks.test_judge import run as simulate_in
from tests.support.answers import answers
from tests.support.command_line import app
from vnet.errors import VnetError

pytestmark = pytest.mark.slow

CHECKS = """import sys
from emulator import Result, Run

def sound(run: Run):
    print("looked at", len(run.trace), file=sys.stderr)
    yield "silent", "valid", "nobody was silent", {"frames": len(run.trace), "rate": 0.5}
    yield Result("crowded", "not applicable", "there are only three vehicles")

def broken(run):
    rows = [{"node": node, "distance_m": 3.5} for node in run.nodes for _ in range(9)]
    yield "near", "invalid", f"{len(rows)} too near", {"rows": rows}

def raising(run):
    yield "first", "valid", "still good"
    return deeper(run)

def deeper(run):
    for name in run.nodes:
        raise KeyError(name)

def outside(run):
    return [("far", "valid", str(run.positions(99.0)))]

def single(run):
    return ("one", "unknown", "nobody knows")

def endless(run):
    while True:
        yield "more", "valid", ""

def leaving(run):
    raise SystemExit(0)

def verdict(run):
    yield "verdict", run.verdict, "of the run"

async def waiting(run):
    pass



def elsewhere(run):
    import os
    os.chdir("/")
    print("road\\udce9")
    yield "away", "valid", os.getcwd()

def clearing(run):
    run.events.clear()
    run.nodes.clear()
    run.positions(0.0)[:] = 0.0
    run.runs_the_program[:] = False
    yield "kept", "valid", str(len(run.events) > 0 < len(run.nodes))
"""
SCENARIO = (
    '[run]\nname = "own"\nduration_s = 0.5\nsettle_s = 0.0\n[network]\nvehicles = 3\n[radio]\nrange_m = 1e5\n'
)


Give = Callable[..., dict[str, CheckResult | NotExercised]]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The current folder, with `own_checks.py` and `own.toml` in it."""
    (tmp_path / "own_checks.py").write_text(CHECKS)
    (tmp_path / "own.toml").write_text(SCENARIO)
    monkeypatch.chdir(tmp_path)
    before = list(sys.path)
    yield tmp_path
    sys.path[:] = before
    for name in [name for name in sys.modules if name.startswith("own_")]:
        del sys.modules[name]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> RecordedRun:
    return simulate_in(tmp_path_factory.mktemp("own") / "run", vehicles=3, run={"duration_s": 0.5})


def vnet(*arguments: object) -> tuple[int, str]:
    """The exit status and the output of a command; runs leave no report, which costs more than they do."""
    if arguments[0] == "simulate":
        arguments = (*arguments, "--no-report")
    done = CliRunner(env={"PYTHONHASHSEED": "0", "COLUMNS": "200"}).invoke(app, list(map(str, arguments)))
    return done.exit_code, done.output


def simulate(*functions: str) -> tuple[int, str]:
    checks = [word for function in functions for word in ("--check", f"own_checks.py:{function}")]
    return vnet("simulate", "own.toml", *checks, "--out", "run")


def findings(recorded: RecordedRun, *functions: str) -> dict[str, CheckResult | NotExercised]:
    """The findings of functions of `own_checks`."""
    program = Program(checks=tuple(f"own_checks:{function}" for function in functions))
    found = own_findings(program, emulator.Run(recorded, Path("run")))
    return {finding.name: finding for finding in found}


@pytest.fixture
def give(here: Path, recorded: RecordedRun, monkeypatch: pytest.MonkeyPatch) -> Give:
    """Judge by functions of `own_checks`, of which `given` is this one."""

    def judged(given: Callable[[emulator.Run], object], *functions: str) -> dict[str, CheckResult | NotExercised]:
        monkeypatch.syspath_prepend(str(here))
        monkeypatch.setattr(import_module("own_checks"), "given", given, raising=False)
        return findings(recorded, *functions or ("given",))

    return judged


def test_results_stand_in_the_verdict_of_a_run(here: Path) -> None:
    status, text = simulate("sound")
    assert status == 0
    assert "own:silent" in text and "nobody was silent" in text
    _, listed = vnet("check", "run")
    assert "not applicable: own:crowded: there are only three vehicles" in listed
    written = json.loads((here / "run" / "verdict.json").read_text())
    assert written["checks"][-1] == {
        "name": "own:silent",
        "verdict": "valid",
        "text": "nobody was silent",
        "figures": {"frames": 30, "rate": 0.5},
    }
    assert written["not_exercised"][-1] == {"name": "own:crowded", "reason": "there are only three vehicles"}
    assert (here / "run" / "logs" / "checks.txt").read_text() == "looked at 30\n"
    assert "looked at" not in text


def test_a_check_may_go_elsewhere_and_print_what_is_no_text(here: Path) -> None:
    status, text = simulate("elsewhere")
    assert (status, Path.cwd()) == (0, here)
    assert "own:away" in text
    assert (here / "run" / "logs" / "checks.txt").read_text() == "road\\udce9\n"


def test_a_check_cannot_change_what_others_read(here: Path) -> None:
    status, text = simulate("clearing")
    assert status == 0 and "True" in text
    assert vnet("check", "run")[0] == 0


def test_a_failed_check_makes_the_run_invalid_and_shows_its_rows(here: Path) -> None:
    status, text = simulate("sound", "broken")
    assert status == 1
    assert "27 too near" in text and "own:near: the first offending rows" in text and "3.5" in text
    record = emulator.Run.open(here / "run")
    (found,) = [check for check in record.checks if check.name == "own:near"]
    assert len(found.figures["rows"]) == 10
    assert "27 too near" in write_report(Source(here / "run")).read_text()


def test_one_that_raises_is_unknown_and_named_and_its_results_so_far_count(here: Path) -> None:
    status, text = simulate("raising", "sound")
    assert status == 3
    assert "raises KeyError: 'v01' (own_checks.py:19)" in text
    assert "own:own_checks.raising where:" in text
    checks = {check.name: check for check in emulator.Run.open(here / "run").checks}
    assert checks["own:first"].verdict == checks["own:silent"].verdict == "valid"
    broken = checks["own:own_checks.raising"]
    assert broken.verdict == "unknown"
    assert 'own_checks.py", line 19, in deeper' in broken.figures["where"]
    assert "checks/own.py" not in broken.figures["where"]


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize(
    ("function", "name", "text"),
    [
        (
            "outside",
            "own:own_checks.outside",
            "time_s = 99: the run has periods from 0 s to 0.5 s (own_checks.py:22)",
        ),
        ("single", "own:one", "nobody knows"),
        ("endless", "own:own_checks.endless", "yields 'more', which is there already"),
        ("leaving", "own:own_checks.leaving", "raises SystemExit: 0 (own_checks.py:32)"),
        ("verdict", "own:own_checks.verdict", "run: has no verdict yet: its checks are still being made"),
    ],
)
def test_what_goes_wrong_is_unknown(recorded: RecordedRun, function: str, name: str, text: str) -> None:
    found = findings(recorded, function)[name]
    assert isinstance(found, CheckResult)
    assert found.verdict is Verdict.UNKNOWN
    assert found.text.startswith(text)


@answers("check")
def test_nonsense_is_unknown_and_says_what_is_allowed(give: Give, kind: str, answer: str, said: str) -> None:
    found = give(lambda run: eval(answer, {"np": np}))["own:own_checks.given"]
    assert isinstance(found, CheckResult)
    assert (found.verdict, found.text[: len(said)]) == (Verdict.UNKNOWN, said)


def test_a_result_that_is_nonsense_hides_no_other(give: Give) -> None:
    answer = [("a", "valid", "", {"x": float("nan")}), ("b", "invalid", "too late")]
    found = give(lambda run: answer)
    verdicts = {name: finding.verdict for name, finding in found.items() if isinstance(finding, CheckResult)}
    assert verdicts["own:b"] is Verdict.INVALID
    assert verdicts["own:own_checks.given"] is Verdict.UNKNOWN


def test_figures_of_numpy_are_plain_numbers(give: Give) -> None:
    figures = {
        "n": np.int64(3),
        "share": np.float32(0.5),
        "all": np.array([1.0, 2.0]),
        "is": np.bool_(True),
        "t": None,
    }
    answer = [("a", Verdict.VALID, "line\nline", figures)]
    expected = {"n": 3, "share": 0.5, "all": [1.0, 2.0], "is": True, "t": None}
    assert give(lambda run: answer)["own:a"] == CheckResult("own:a", Verdict.VALID, "line\\nline", expected)
    json.dumps(expected)


def test_ctrl_c_ends_the_checks_and_keeps_what_is_there(give: Give) -> None:
    def interrupted(run: emulator.Run) -> None:
        raise KeyboardInterrupt

    found = give(interrupted, "single", "given", "sound")
    texts = {name: finding.text for name, finding in found.items() if isinstance(finding, CheckResult)}
    cut_short = dict.fromkeys(["own:own_checks.given", "own:own_checks.sound"], "interrupted")
    assert texts == {"own:one": "nobody knows"} | cut_short


def test_where_the_machine_did_not_keep_up_a_failed_own_check_is_unknown(recorded: RecordedRun) -> None:
    own = [CheckResult("own:near", Verdict.INVALID, "too near")]
    assert judge(recorded, own).verdict is Verdict.INVALID
    gap = replace(recorded, events=[*recorded.events, Event(0, "transport_gap", "v01", {"count": 1})])
    (found,) = [check for check in judge(gap, own).checks if check.name == "own:near"]
    assert (found.verdict, found.text) == (Verdict.UNKNOWN, "too near; but the machine did not keep up")


def test_a_folder_is_judged_by_its_own_checks_as_recorded_and_nothing_is_imported(here: Path) -> None:
    simulate("sound", "broken")
    (here / "own_checks.py").write_text("raise AssertionError('imported')\n")
    del sys.modules["own_checks"]
    status, text = vnet("check", "run")
    assert status == 1
    assert "27 too near" in text and "nobody was silent" in text and "own:crowded" in text
    assert "own_checks" not in sys.modules
    assert write_report(Source(here / "run")).exists()
    assert "own_checks" not in sys.modules


def test_own_checks_are_run_again_when_asked(here: Path) -> None:
    simulate("broken")
    (here / "own_checks.py").write_text(CHECKS.replace('"invalid"', '"valid"').replace("too near", "near enough"))
    del sys.modules["own_checks"]
    assert vnet("check", "run")[0] == 1
    status, text = vnet("check", "run", "--own-checks")
    assert status == 0 and "27 near enough" in text


def test_another_check_judges_a_finished_run(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    simulate("sound")
    (here / "later").mkdir()
    (here / "later" / "own_later.py").write_text('def check(run):\n    yield "late", "invalid", "too late"\n')
    monkeypatch.chdir(here / "later")
    status, text = vnet("check", "../run", "--check", "own_later.py", "-v")
    assert status == 1 and "too late" in text and "nobody was silent" in text
    del sys.modules["own_checks"]
    status, text = vnet("check", "../run", "--check", "own_checks:sound")
    assert status == 2 and "cannot import" in text, "the folder has no say in where modules come from"


def test_own_checks_whose_folder_is_gone_are_not_run_again(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (here / "src").mkdir()
    (here / "own_checks.py").rename(here / "src" / "own_checks.py")
    vnet("simulate", "own.toml", "--check", "src/own_checks.py:sound", "--out", "run")
    (here / "src").rename(here / "moved")
    assert vnet("check", "run")[0] == 0
    status, text = vnet("check", "run", "--own-checks")
    assert status == 2 and "/src': no such folder" in text


def test_a_scenario_names_its_checks(here: Path) -> None:
    with (here / "own.toml").open("a") as file:
        file.write('[program]\nchecks = ["own_checks.py:sound"]\n')
    status, _ = vnet("simulate", "own.toml", "--check", "own_checks.py:broken", "--out", "run", "--quiet")
    assert status == 1
    names = [check.name for check in emulator.Run.open(here / "run").checks]
    assert names[-2:] == ["own:silent", "own:near"]
    status, _ = vnet("simulate", "run/scenario.toml", "--out", "again", "--quiet")
    assert status == 1, "the folder's scenario runs them again"


@pytest.mark.usefixtures("here")
async def test_a_test_judges_by_own_checks(vnet_emulation: Any) -> None:
    async with vnet_emulation("own.toml", checks=["own_checks.py:sound", "own_checks.py:broken"]) as emu:
        await emu.run_until(0.3)
    emu.check("own:silent")
    with pytest.raises(AssertionError, match="own:near is invalid: 27 too near"):
        emu.check()


@pytest.mark.usefixtures("here")
def test_a_test_is_told_at_once_of_a_check_that_cannot_be_used(vnet_emulation: Any) -> None:
    with pytest.raises(VnetError, match="has no 'nothing'"):
        vnet_emulation("own.toml", checks=["own_checks.py:nothing"])
