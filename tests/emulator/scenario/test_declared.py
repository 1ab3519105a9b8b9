"""Modules that programs declare: found without the program, judged as own checks, drawn as a reference."""

import json
import sys
from pathlib import Path

import pytest

from emulator.api import simulate_into
from emulator.checks.judge import check_run
from emulator.records.metrics import reference_series
from emulator.records.recorded_run import RecordedRun
from emulator.scenario.loading import load_scenario
from emulator.scenario.own_functions import are_here, declared_checks
from emulator.scenario.program import Program
from emulator.scenario.scenario import Scenario

PROGRAM = """
DECLARES = "{name}_declared"

async def main(node):
    async for fix in node.gnss:
        node.report(fix.position_m, fix.covariance_m2, seen=1)
"""
DECLARED = """
import numpy as np

CHECKS = ("{name}_declared:check",)
REFERENCE = "{name}_declared:Reference"

def check(run):
    return "seen", "valid" if (run.reported("seen") == 1).all() else "invalid", "all were seen"

class Reference:
    NAME, TEXT, COLUMNS = "half", "half of the fixes' error", ("position_m", "fix_m")

    def __init__(self, setting):
        self.vehicles = len(setting.component)

    def step(self, time_ns, states):
        assert len(states["fix_m"]) == self.vehicles
        error_m = np.linalg.norm(states["fix_m"] - states["position_m"], axis=1)
        return {{"position_rmse_m": float(np.sqrt((error_m**2).mean())) / 2}}
"""


def written(folder: Path, name: str, declared: str = DECLARED) -> Scenario:
    """A scenario beside its program and what that declares; modules keep their names for a whole process."""
    (folder / f"{name}.py").write_text(PROGRAM.format(name=name))
    (folder / f"{name}_declared.py").write_text(declared.format(name=name))
    (folder / "scenario.toml").write_text(
        f'run = {{ duration_s = 1.0, settle_s = 0.0 }}\nnetwork = {{ vehicles = 3 }}\nprogram.entry = "{name}.py"\n'
    )
    return load_scenario(folder / "scenario.toml")


@pytest.mark.slow
def test_a_program_s_checks_and_reference_are_those_that_it_declares(tmp_path: Path) -> None:
    run = simulate_into(written(tmp_path, "declaring"), tmp_path / "run")
    checks = {check["name"]: check["verdict"] for check in json.loads((run / "verdict.json").read_text())["checks"]}
    assert checks["own:seen"] == "valid"
    recorded = RecordedRun.open(run)
    series = reference_series(recorded)["position_rmse_m"]
    assert series.tolist() == pytest.approx([value / 2 for value in recorded.metrics["fix_rmse_m"].to_pylist()])
    assert {check.name for check in check_run(run).checks} >= {"own:seen"}
    assert [check for check in check_run(run).checks if check.verdict == "invalid"] == []


def test_a_declaration_is_read_without_the_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written(tmp_path, "unloaded")
    monkeypatch.syspath_prepend(tmp_path)
    program = Program(entry="unloaded:main")
    assert are_here(program)
    assert declared_checks(program) == ["unloaded_declared:check"]
    assert "unloaded" not in sys.modules
    assert not are_here(Program(entry="nowhere_to_be_found:main"))


@pytest.mark.parametrize(
    ("name", "declared", "said"),
    [
        ("failing", "raise RuntimeError('broken')", "RuntimeError: broken"),
        ("functions", "CHECKS = (print,)", 'a list of "module:function" is needed'),
        ("one", "CHECKS = ('one:check')", 'a list of "module:function" is needed'),
        ("none", "CHECKS = 5", 'a list of "module:function" is needed'),
    ],
)
def test_a_declared_module_that_fails_makes_a_check_unknown(
    name: str, declared: str, said: str, tmp_path: Path
) -> None:
    run = simulate_into(written(tmp_path, name, declared), tmp_path / "run")
    record = json.loads((run / "verdict.json").read_text())
    failed = {check["name"]: check for check in record["checks"]}[f"own:{name}_declared.CHECKS"]
    assert failed["verdict"] == record["verdict"] == "unknown"
    assert said in failed["text"]
