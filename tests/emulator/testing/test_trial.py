"""Runs of a campaign leave no files, unless a check of the user's own asks for them."""

from pathlib import Path

import pytest

from emulator.checks.own import PREFIX
from emulator.records.run_folder import SCENARIO_FILE, RunFolder
from emulator.records.tables import TRACE
from emulator.records.verdicts import Verdict
from emulator.scenario.scenario import Scenario
from emulator.testing.trial import REFUSED, TrialPool, run_trial
from tests.emulator.testing import programs

CHECKS = "tests.emulator.testing.own_checks"


def scenario_with(check: str) -> Scenario:
    program = {"entry": "agents.beacon:main", "checks": [f"{CHECKS}:{check}"]}
    run = {"duration_s": 1.0, "settle_s": 0.0}
    return Scenario.model_validate({"run": run, "network": {"vehicles": 2}, "program": program})


@pytest.mark.slow
def test_tables_that_a_check_looks_at_are_in_no_file(tmp_path: Path) -> None:
    trial = run_trial(scenario_with("reads_tables"), RunFolder.scratch(tmp_path))
    assert trial.verdicts[f"{PREFIX}tables"] is Verdict.VALID, trial.texts
    assert [path.name for path in tmp_path.iterdir()] == ["logs"]


@pytest.mark.slow
def test_files_that_a_check_asks_for_are_written(tmp_path: Path) -> None:
    trial = run_trial(scenario_with("reads_files"), RunFolder.scratch(tmp_path))
    assert trial.verdicts[f"{PREFIX}files"] is Verdict.VALID, trial.texts
    assert {SCENARIO_FILE, TRACE.file} <= {path.name for path in tmp_path.iterdir()}


def test_the_next_run_finds_nothing_of_the_last(tmp_path: Path) -> None:
    for name in ("logs/v01.log", "disks/v01/kept.txt", SCENARIO_FILE):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("left")
    folder = RunFolder.scratch(tmp_path)
    assert [path.name for path in tmp_path.rglob("*")] == ["logs"]
    assert folder.events == [] and not folder.is_open


@pytest.mark.slow
def test_a_kept_trial_and_one_that_is_not_give_the_same(tmp_path: Path) -> None:
    scenario = scenario_with("reads_tables")
    kept = run_trial(scenario, RunFolder.create(tmp_path / "kept", scenario))
    unkept = run_trial(scenario, RunFolder.scratch(tmp_path / "unkept"))
    assert (kept.verdicts, kept.texts, kept.trace_sha256) == (unkept.verdicts, unkept.texts, unkept.trace_sha256)


@pytest.mark.slow
def test_only_estimates_and_covariances_grow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A column of the program's own may hold any number, unless it is declared as an estimate."""
    monkeypatch.setattr(programs, "DECLARES", programs.__name__, raising=False)
    monkeypatch.setattr(programs, "FIGURES", "docs.examples.middle:Figures", raising=False)
    run = {"duration_s": 1.0, "settle_s": 0.0}
    entry = f"{programs.__name__}:counts_far"
    scenario = {"run": run, "network": {"vehicles": 2}, "program": {"entry": entry}}
    trial = run_trial(Scenario.model_validate(scenario), RunFolder.scratch(tmp_path))
    assert trial.verdicts["growth"] is Verdict.VALID
    scenario["program"] = {"entry": f"{programs.__name__}:growing"}
    trial = run_trial(
        Scenario.model_validate(scenario | {"run": run | {"duration_s": 2.0}}), RunFolder.scratch(tmp_path)
    )
    assert trial.texts["growth"].startswith("estimate_m of v")


@pytest.mark.slow
def test_a_scenario_that_cannot_be_does_not_fail_as_the_emulator_does(tmp_path: Path) -> None:
    """Else a failure of the emulator would be shrunk to one without the vehicles that the scenario names."""
    scenario = scenario_with("reads_tables")
    exception = {"nodes": ["v03"], "entry": "agents.beacon:main"}
    program = type(scenario.program).model_validate({"entry": "agents.beacon:main", "exceptions": [exception]})
    pool = TrialPool(300.0, scenario)
    try:
        trial = pool.run(scenario.model_copy(update={"program": program}), tmp_path / "run")
    finally:
        pool.close()
    assert trial.failed == [REFUSED]
