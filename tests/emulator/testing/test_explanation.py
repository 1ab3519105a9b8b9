"""A failure is compared with the run that is most like it and passes."""

from pathlib import Path
from typing import Any

import pytest

from emulator.records.run_folder import RunFolder
from emulator.scenario.scenario import Scenario
from emulator.testing.campaign import Explanation, explain
from emulator.testing.campaign_plan import with_seed
from emulator.testing.trial import Trial, TrialPool, run_trial


class Here(TrialPool):
    """Runs trials in this process, and counts them."""

    def __init__(self, scenario: Scenario) -> None:
        super().__init__(60.0, scenario)
        self.runs = 0

    def run(self, scenario: Scenario, folder: Path, apart: bool = False) -> Trial:
        self.runs += 1
        return run_trial(scenario, RunFolder.create(folder, scenario))


def planted(program: str, **sections: Any) -> Scenario:
    run = {"duration_s": 1.0, "settle_s": 0.0} | sections.pop("run", {})
    entry = f"tests.emulator.testing.programs:{program}"
    return Scenario.model_validate(
        {"run": run, "network": {"vehicles": 2}, "program": {"entry": entry}, **sections}
    )


def explained(scenario: Scenario, tmp_path: Path, passed: Scenario | None = None) -> tuple[Explanation, Here]:
    pool = Here(scenario)
    assert pool.run(scenario, tmp_path / "failing").failed
    pool.runs = 0
    return explain(scenario, tmp_path / "failing", passed, pool), pool


@pytest.mark.slow
def test_an_order_is_compared_with_fifo_and_the_crash_has_its_line(tmp_path: Path) -> None:
    found, pool = explained(planted("tells_before_it_measures", run={"order": "shuffle"}), tmp_path)
    assert found.passing == "the same run in FIFO order" and pool.runs == 1
    first = found.partings[0]
    assert (first.kind, first.first) == ("decision", "") and " before " in first.second
    assert found.line().startswith("parts from the same run in FIFO order at ")
    assert found.line().endswith("; there: FIFO order")
    crash = next(row for row in found.rows() if row["first"] == "event")
    assert crash["in the run that passes"] == "nothing"
    assert "programs.py" in crash["in this run"] and "in tell" in crash["in this run"]
    assert crash["in this run"] in found.text()


@pytest.mark.slow
def test_faults_are_compared_with_none(tmp_path: Path) -> None:
    pause = {"kind": "pause", "at_s": 0.25, "duration_s": 0.4, "nodes": {"ids": ["v02"]}}
    found, pool = explained(planted("impatient", fault=[pause]), tmp_path)
    assert found.passing == "the same run without faults" and pool.runs == 1
    assert 250_000_000 <= found.partings[0].time_ns <= 650_000_000
    frame = next(row for row in found.rows() if row["first"] == "frame")
    assert frame["in the run that passes"].startswith("frame 2 of v02, ") and frame["in this run"] == "nothing"
    assert "v02 until then, in this run:" in found.text()


@pytest.mark.slow
def test_a_seed_is_compared_with_one_that_passes_and_without_one_says_so(tmp_path: Path) -> None:
    scenarios = [with_seed(planted("northerner"), seed) for seed in range(1, 9)]
    pool = Here(scenarios[0])
    failed = [bool(pool.run(each, tmp_path / str(number)).failed) for number, each in enumerate(scenarios)]
    assert True in failed and False in failed
    failing, passing = failed.index(True), failed.index(False)
    pool.runs = 0
    found = explain(scenarios[failing], tmp_path / str(failing), scenarios[passing], pool)
    assert found.passing == f"the campaign's run with seed {passing + 1}" and pool.runs == 1
    assert any(each.kind == "event" and "too far south-east" in each.second for each in found.partings)
    short = with_seed(planted("northerner", run={"duration_s": 0.6}), failing + 1)
    shorter = explain(short, tmp_path / str(failing), scenarios[passing], pool)
    assert shorter.passing == f"the same run with seed {passing + 1}" and pool.runs == 2
    alone = explain(scenarios[failing], tmp_path / str(failing), None, pool)
    assert alone.line() == "was not compared: no run of the campaign has passed" and pool.runs == 2
    assert alone.as_json() == {"why_not": "no run of the campaign has passed"}


@pytest.mark.slow
def test_a_run_that_fails_in_any_case_says_what_was_tried(tmp_path: Path) -> None:
    pause = {"kind": "pause", "at_s": 0.25, "duration_s": 0.4}
    found, pool = explained(planted("growing", run={"duration_s": 2.0}, fault=[pause]), tmp_path)
    assert found.why_not == "no run of the campaign has passed: the same run without faults fails too"
    assert pool.runs == 1


def test_a_run_without_a_trace_is_not_compared(tmp_path: Path) -> None:
    pool = Here(planted("growing"))
    found = explain(planted("growing"), tmp_path / "nothing", None, pool)
    assert found.why_not == "the run did not come to its end, and has no trace" and pool.runs == 0


@pytest.mark.slow
def test_nothing_is_run_once_the_pool_is_closed(tmp_path: Path) -> None:
    pool = Here(scenario := planted("growing", run={"duration_s": 2.0}))
    assert pool.run(scenario, tmp_path / "failing").failed
    pool.close()
    found = explain(scenario, tmp_path / "failing", with_seed(scenario, 7), pool)
    assert (found.why_not, pool.runs) == ("no time was left for it", 1)
