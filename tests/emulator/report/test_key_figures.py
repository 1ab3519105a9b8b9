"""A program declares a figure in one place: all that shows a run has it, as it has vnet's own."""

import io
import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pyarrow.parquet as pq
import pytest
from rich.console import Console

from emulator.api import simulate_into
from emulator.checks.judge import check_run
from emulator.drivers.session import Session
from emulator.drivers.status import Course
from emulator.records.period_figures import program_figures, views_of
from emulator.records.recorded_run import RecordedRun
from emulator.report.comparison import Comparison, comparison_page
from emulator.report.figures import figures_of
from emulator.report.index import index_page
from emulator.report.source import Source
from emulator.report.sweep_page import heading
from emulator.report.write import report_page
from emulator.scenario import own_functions
from emulator.scenario.program import Program
from emulator.scenario.scenario import Scenario
from emulator.stream import messages, pack
from emulator.terminal import summary
from emulator.terminal.progress import Dashboard
from emulator.viewer.drawing import PeriodArrays
from emulator.viewer.recorder import Recorder
from emulator.viewer.sinks import Sinks
from tests.support.recordings import read_back
from vnet.errors import ScenarioError, VnetError
from vnet.node import Node

DECLARES = __name__
FIGURES = "docs.examples.middle:Figures"
"""The example of the page on figures, for a program that takes the origin for the middle."""


async def guess(node: Node) -> None:
    """Take the origin for the middle of all vehicles."""
    async for fix in node.gnss:
        node.report(fix.position_m, fix.covariance_m2, middle_m=[0.0, 0.0])


SCENARIO = Scenario.model_validate(
    {
        "run": {"duration_s": 2.0, "settle_s": 0.0},
        "network": {"vehicles": 3},
        "program": {"entry": f"{__name__}:guess"},
    }
)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate_into(SCENARIO, tmp_path_factory.mktemp("runs") / "run")


@pytest.mark.slow
def test_a_figure_is_declared_in_one_place(run: Path) -> None:
    verdict = json.loads((run / "verdict.json").read_text())
    console = Console(file=io.StringIO(), width=120)
    console.print(summary._figures(verdict))
    key = program_figures(Program(entry=f"{__name__}:guess")).key
    shown = {
        "report": report_page(Source(run)),
        "comparison": comparison_page(Comparison.of(run, run)),
        "sweep": heading("middle_rmse_m", key),
        "summary": console.file.getvalue(),  # type: ignore[attr-defined]
    }
    assert not [page for page, text in shown.items() if "middle, RMSE" not in text]
    assert "Middle of all vehicles" in shown["report"]
    assert "middle (m)" in index_page(run.parent)


def test_a_declared_figure_is_what_its_function_gives(run: Path) -> None:
    states, metrics = (pq.read_table(run / f"{name}.parquet") for name in ("states", "metrics"))
    position_m = np.array(states["position_m"].to_pylist()[:3])
    wanted = float(np.hypot(*position_m.mean(axis=0)))
    assert metrics["middle_rmse_m"].to_pylist()[0] == pytest.approx(wanted)
    assert states["middle_m"].to_pylist()[0] == [0.0, 0.0]
    assert {check.name: check.verdict.value for check in check_run(run).checks}["metrics"] == "valid"


@pytest.mark.slow
def test_a_recording_and_the_live_picture_have_a_declared_figure(run: Path, tmp_path: Path) -> None:
    with Recorder(Sinks(save=tmp_path / "run.rrd"), "run") as recorder:
        for stream, message in messages(run):
            recorder.take(stream, message)
    curve = read_back(tmp_path / "run.rrd")["/figures/middle"]
    assert list(curve.static["SeriesLines:names"]) == ["RMSE"]
    session = Session(SCENARIO, tmp_path / "again")
    course = Course(session.emulation)
    session.open().run()
    console = Console(file=io.StringIO(), width=100, height=20)
    console.print(Dashboard(course.snapshot()))
    assert "middle" in console.file.getvalue()  # type: ignore[attr-defined]


@pytest.mark.slow
def test_a_folder_shows_declared_charts_where_the_program_is_not_installed(run: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(run, tmp_path / "run"))
    text = (folder / "scenario.toml").read_text()
    (folder / "scenario.toml").write_text(text.replace(__name__, "not_installed"))
    assert "Middle of all vehicles" in report_page(Source(folder))
    assert figures_of(Source(folder))["middle"][0] == "Middle of all vehicles"  # those of the picture
    assert Source(folder).metric("reporting").max() > 0, "whole numbers are drawn, too"
    with Recorder(Sinks(save=tmp_path / "run.rrd"), "run") as recorder:
        for stream, message in messages(folder):
            recorder.take(stream, message)
    assert "/figures/middle" in read_back(tmp_path / "run.rrd")


@pytest.mark.slow
def test_views_of_a_folder_that_cannot_be_are_one_line(run: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(run, tmp_path / "run"))
    verdict = json.loads((folder / "verdict.json").read_text())
    for change, said in {"id": "<b>", "lines": {}}.items():
        wrong = {**verdict, "views": {"charts": [{**verdict["views"]["charts"][0], change: said}]}}
        (folder / "verdict.json").write_text(json.dumps(wrong))
        with pytest.raises(VnetError, match=rf"verdict\.json: views\.charts\.0\.{change}"):
            _ = RecordedRun.open(folder).record


@pytest.mark.parametrize(
    "change",
    [
        {"name": "../../a b"},
        {"rings_m": []},
        {"rings_m": [float("nan")]},
        {"view_m": 0.0},
        {"covariance": "x" * 65},
    ],
    ids=str,
)
def test_estimates_of_a_folder_are_bounded(change: dict[str, Any]) -> None:
    declared = {"name": "common", "title": "common error", "estimate": "a_m", "covariance": "b_m2", "truth": "c_m"}
    good = {**declared, "rings_m": [1.0], "view_m": 2.0}
    assert views_of({"estimates": [good], "peers": ["weight"] * 64}).estimates[0].cloud == ""
    with pytest.raises(VnetError, match=r"^views: estimates\.0\."):
        views_of({"estimates": [{**good, **change}]})
    with pytest.raises(VnetError, match=r"^views: peers"):
        views_of({"peers": ["weight"] * 65})


def test_a_column_of_another_size_is_as_good_as_none() -> None:
    """A folder may name any column as an estimate."""
    period = PeriodArrays({"a": pack(np.ones((2, 4))), "node_ids": ["v1"]}, ["v1", "v2"])
    assert np.isnan(period.points("a")).all() and np.isnan(period.covariances("node_ids")).all()
    assert (period.covariances("a") == 1).all()


class Wrong:
    """No figures: not even a dataclass."""


@dataclass(frozen=True)
class OfTexts:
    """A figure that is no number."""

    name: str

    @staticmethod
    def compute(periods: Any) -> dict[str, str]:
        """Return nothing."""
        return {}


@dataclass(frozen=True)
class Broken:
    """A figure whose function answers as `answer` says."""

    half: float | None
    answer: ClassVar[Callable[[int], Any]]

    @staticmethod
    def compute(periods: Any) -> Any:
        """Answer for as many periods as there are; what it does to its arrays is its own affair."""
        periods["estimate_m"][:] += 100.0
        return Broken.answer(len(periods["fix_m"]))


BrokenRun = Callable[[Callable[[int], Any]], Path]


@pytest.fixture
def broken(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> BrokenRun:
    """Simulate with a figure whose function answers so."""
    monkeypatch.setitem(globals(), "FIGURES", f"{__name__}:Broken")

    def run(answer: Callable[[int], Any]) -> Path:
        monkeypatch.setattr(Broken, "answer", answer, raising=False)
        return simulate_into(SCENARIO, tmp_path / "run")

    return run


@pytest.mark.slow
@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (
            lambda count: {"half": [1 / 0] * count},
            "raises ZeroDivisionError: division by zero (test_key_figures.py:",
        ),
        (lambda count: sys.exit("out"), "raises SystemExit: out (test_key_figures.py:"),
        (lambda count: None, "answers None: figures by name are needed"),
        (lambda count: {}, "answers half = None: a value for each of 1 periods is needed"),
        (lambda count: {"half": [1.0, 2.0] * count}, "answers half = [1.0, 2.0]: a value for each of 1 periods"),
        (lambda count: exec("while True: pass"), "does not answer within"),
        (lambda count: {"half": ["1"] * count}, "answers half = ['1']: float | None is needed for each period"),
    ],
)
def test_figures_that_fail_are_named_and_the_rest_is_kept(
    answer: Callable[[int], Any], said: str, monkeypatch: pytest.MonkeyPatch, broken: BrokenRun
) -> None:
    monkeypatch.setattr(own_functions, "LIMIT_S", 0.2)
    folder = broken(answer)
    verdicts = {check.name: (check.verdict.value, check.text) for check in check_run(folder).checks}
    assert verdicts["own_rules"][0] == "invalid"
    assert verdicts["own_rules"][1].startswith(f"FIGURES ({__name__}:Broken) {said}")
    events = RecordedRun.open(folder).events
    assert events[-1].kind == "ended" and all("During handling" not in str(event.details) for event in events)
    assert verdicts["metrics"][0] == "valid", "unknown in the folder, and computed again"
    assert verdicts["verdict_file"][0] == "valid"
    metrics = pq.read_table(folder / "metrics.parquet")
    assert metrics["half"].null_count == len(metrics) == 20
    assert metrics["position_rmse_m"].to_pylist() == metrics["fix_rmse_m"].to_pylist(), "vnet's own are right"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("answer", "kept"),
    [
        (lambda count: {"half": [0.5]}, [0.5] * 20),
        (lambda count: {"half": np.where(np.arange(count) < 9, np.nan, 2)}, [None] * 9 + [2.0] * 11),
    ],
    ids=["fails for several periods together, and is computed one by one", "not finite, and a whole number"],
)
def test_figures_that_are_odd_are_kept(
    broken: BrokenRun, answer: Callable[[int], Any], kept: list[float | None]
) -> None:
    folder = broken(answer)
    assert {check.name: check.verdict.value for check in check_run(folder).checks}["metrics"] == "valid"
    assert pq.read_table(folder / "metrics.parquet")["half"].to_pylist() == kept


@pytest.mark.parametrize("kind", [Wrong, OfTexts])
def test_a_declaration_that_cannot_be_is_refused(kind: type, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(globals(), "FIGURES", f"{__name__}:{kind.__name__}")
    with pytest.raises(ScenarioError, match=f"DECLARES: '{__name__}:{kind.__name__}' declares no figures"):
        program_figures(Program(entry=f"{__name__}:guess"))


@pytest.mark.slow
def test_a_run_that_ends_before_its_first_period_has_the_columns_of_its_program(tmp_path: Path) -> None:
    scenario = Scenario.model_validate({"program": {"entry": "agents.cooperative:main"}})
    Session(scenario, tmp_path / "run").open().close()
    judged = check_run(tmp_path / "run", own_checks=True)
    assert not [check.text for check in judged.checks if check.name.startswith("own:")], "none is applicable"
