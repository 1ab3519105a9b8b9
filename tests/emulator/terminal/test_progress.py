"""Progress of a run, for terminals, logs and machines; and whoever listens, the run is the same."""

import io
import json
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from emulator.drivers.conclude import conclude
from emulator.drivers.simulate import simulate
from emulator.terminal.console import LogFormat
from emulator.terminal.live import terminal
from emulator.terminal.progress import JsonLines, Picture, PlainLines, Progress, show_progress
from tests.emulator.drivers.test_status import KILLED, emulate
from tests.emulator.terminal.test_live import Terminal

CRASHING = {"entry": "tests.system.programs:raises"}


@pytest.fixture
def pty_file() -> Iterator[Any]:
    """The end of a pseudo-terminal that programs write to."""
    master, slave = os.openpty()
    with os.fdopen(slave, "w", encoding="utf-8") as file:
        yield file
    os.close(master)


def test_a_terminal_that_can_shows_a_picture(pty_file: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("NO_COLOR", "FORCE_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("COLORTERM", "truecolor")
    console = terminal(pty_file)
    assert console is not None
    assert console.color_system == "truecolor"
    monkeypatch.setenv("NO_COLOR", "1")
    console = terminal(pty_file)
    assert console is not None
    assert console.color_system is None


@pytest.mark.parametrize(
    "environment", [{"TERM": "dumb"}, {"TERM": "unknown"}, {"TTY_COMPATIBLE": "0"}, {"TTY_INTERACTIVE": "0"}]
)
def test_a_terminal_that_cannot_gets_lines(
    pty_file: Any, monkeypatch: pytest.MonkeyPatch, environment: dict[str, str]
) -> None:
    monkeypatch.setenv("TERM", "xterm")
    for name, value in {"FORCE_COLOR": "1", **environment}.items():
        monkeypatch.setenv(name, value)
    assert terminal(pty_file) is None


def test_a_terminal_without_the_signs_gets_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    master, slave = os.openpty()
    with os.fdopen(slave, "w", encoding="iso8859-1") as file:
        assert terminal(file) is None
    os.close(master)


def test_what_shows_depends_on_who_looks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    emulation = emulate(tmp_path / "run")
    assert type(show_progress(emulation, LogFormat.TEXT, quiet=False)) is PlainLines
    assert type(show_progress(emulation, LogFormat.JSON, quiet=False)) is JsonLines
    for log_format in LogFormat:
        assert type(show_progress(emulation, log_format, quiet=True)) is Progress


def told(folder: Path, show: Callable[..., Progress], file: Any, **sections: object) -> dict[str, Any]:
    """A simulated run that is shown; returns its verdict."""
    emulation = emulate(folder, **sections)
    with show(emulation, file) as progress:
        progress.state("all set")
        wall_s, _ = simulate(emulation)
        progress.judging()
        judgement, verdict = conclude(emulation, wall_s, "simulate")
        progress.close()
        progress.ended(verdict, str(folder), judgement.exit_status)
    return verdict


@pytest.mark.slow
def test_plain_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(PlainLines, "every_s", 0.0)
    file = io.StringIO()
    verdict = told(tmp_path / "run", PlainLines, file, fault=[KILLED])
    lines = file.getvalue().splitlines()
    assert lines[0] == "all set"
    assert len(lines) == 40, "one a period, but for the first"
    assert "\x1b" not in file.getvalue()
    down = [line.endswith("  down v02") for line in lines[1:]]
    assert down[10:18] == [True] * 8, "from 1 to 2 s"
    assert not any([*down[:8], *down[20:]])
    told_of = re.fullmatch(r"   4\.0 s +[0-9.]+× real time  delivered (\d+) of ([\d,]+)", lines[-1])
    assert told_of is not None
    counts = verdict["frames_by_outcome"]
    assert 0 < int(told_of[1]) <= counts["delivered"], "the last ones are on their way"
    decided = int(told_of[2].replace(",", ""))
    assert int(told_of[1]) < decided <= counts["delivered"] + counts["lost"] + counts["receiver_down"]


@pytest.mark.slow
def test_what_goes_wrong_has_a_line_at_once(tmp_path: Path) -> None:
    file = io.StringIO()
    told(tmp_path / "run", PlainLines, file, program=CRASHING)
    assert "   0.5 s  v02 crashed: RuntimeError: the battery is flat, programs.py:" in file.getvalue()


@pytest.mark.slow
def test_lines_of_json_hold_the_figures_of_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(JsonLines, "every_s", 0.0)
    file = io.StringIO()
    verdict = told(tmp_path / "run", JsonLines, file, fault=[KILLED])
    lines = [json.loads(line) for line in file.getvalue().splitlines()]
    assert {line["kind"] for line in lines} == {"state", "event", "progress", "ended"}
    walls = [line["wall_s"] for line in lines]
    assert walls == sorted(walls)
    states = [(line["phase"], line.get("text")) for line in lines if line["kind"] == "state"]
    assert states == [("starting", None), ("starting", "all set"), ("running", None), ("judging", None)]
    events = [json.loads(line) for line in (tmp_path / "run" / "events.jsonl").read_text().splitlines()]
    assert [line["event"] for line in lines if line["kind"] == "event"] == events
    progress = [line for line in lines if line["kind"] == "progress"]
    assert [line["emulated_s"] for line in progress] == pytest.approx([n / 10 for n in range(2, 41)] + [4.0])
    at_work = [line["emulated_s"] for line in progress if line["faults_acting"] == ["kill-0"]]
    assert (at_work[0], at_work[-1]) == (1.0, 1.9)
    assert {line["emulated_s"] for line in progress if line["down"] == ["v02"]} >= set(at_work[1:])
    last = progress[-1]
    assert last["frames_by_outcome"] == {n: count for n, count in verdict["frames_by_outcome"].items() if count}
    assert (last["vehicles"], last["seed"], last["duration_s"]) == (6, 1, 4.0)
    assert last["position_rmse_m"] > 0
    assert last["fix_rmse_m"] > 0
    assert lines[-1] == {
        "kind": "ended",
        "wall_s": walls[-1],
        "exit_status": 0,
        "folder": str(tmp_path / "run"),
        "verdict": "valid",
        "emulated_s": 4.0,
        "real_time_factor": verdict["real_time_factor"],
        "seed": 1,
    }


@pytest.mark.slow
def test_a_picture_of_a_run_leaves_nothing_but_what_was_said(tmp_path: Path) -> None:
    screen = Terminal(80, 24)
    verdict = told(tmp_path / "run", lambda emulation, file: Picture(emulation, file.console), screen)
    assert verdict["verdict"] == "valid"
    assert "lockstep · seed 1" in "".join(screen.written), "it was there"
    assert screen.screen.text == "all set"
