"""Rules of the user's own in whole runs: in scenarios and verdicts, tests, campaigns and recorded runs."""

import asyncio
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from emulator.checks.judge import Verdict, check_run, judge
from emulator.records.recorded_run import RecordedRun
from emulator.scenario.loading import load_scenario, recorded_code
from emulator.scenario.scenario import Scenario
from emulator.testing.campaign_plan import Plan
from emulator.testing.harness import RunHarness
from emulator.testing.scenarios import make_scenario
from tests.emulator.checks.test_judge import run_scenario
from tests.support import rules
from tests.support.command_line import app
from vnet.errors import ScenarioError

pytestmark = pytest.mark.slow

SCENARIO = """
[run]
name = "ruled"
duration_s = 2.0
settle_s = 0.5
[network]
vehicles = 4
[radio]
range_m = 1e5
[[fault]]
kind = "custom"
rule = "rule_of_mine.py:drops"
duration_s = 1.0
"""
RULE = """
from emulator import Answer

def drops(frame, state):
    return Answer(drop=frame.sender == "v01")
"""
DATA: dict[str, Any] = {
    "run": {"duration_s": 2.0, "settle_s": 0.5},
    "network": {"vehicles": 4},
    "radio": {"range_m": 1e5},
}

MAC: dict[str, Any] = {"path_loss": {"kind": "dual_slope"}, "mac": {}}


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with a rule and a scenario, which is not the current one; modules are forgotten afterwards."""
    folder, current = tmp_path / "scenario", tmp_path / "current"
    folder.mkdir()
    current.mkdir()
    (folder / "rule_of_mine.py").write_text(RULE)
    (folder / "ruled.toml").write_text(SCENARIO)
    monkeypatch.chdir(current)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # a file may be written twice within a second
    before = list(sys.path)
    yield folder
    sys.path[:] = before
    sys.modules.pop("rule_of_mine", None)


def vnet(*arguments: object) -> tuple[int, str]:
    """Return the exit status and the output of a command."""
    done = CliRunner(env={"PYTHONHASHSEED": "0", "COLUMNS": "200"}).invoke(app, list(map(str, arguments)))
    return done.exit_code, done.output


def simulate(*arguments: object) -> tuple[int, str]:
    return vnet("simulate", *arguments, "--no-report", "--out", "run")


def ruled(rule: str, **more: Any) -> Scenario:
    fault = {"kind": "custom", "rule": f"tests.support.rules:{rule}", "duration_s": 1.2, **more}
    return Scenario.model_validate({**DATA, "fault": [fault]})


def test_a_rule_beside_the_scenario_acts_and_the_run_is_valid(here: Path) -> None:
    status, output = simulate(here / "ruled.toml", "-v")
    assert status == 0, output
    assert "1 rule of your own answered every frame" in output
    recorded = RecordedRun.open(Path("run"))
    fell = {(row["sender"], row["cause"]) for row in recorded.trace.to_pylist() if row["outcome"] == "fault"}
    assert fell == {("v01", "drops-0")}
    assert recorded.scenario.program.folders == (here,)
    code = recorded_code(Path("run/scenario.toml"))
    assert code["rule_entries"] == "rule_of_mine:drops"


def test_a_changed_rule_is_told_when_the_run_is_run_again(here: Path) -> None:
    assert simulate(here / "ruled.toml")[0] == 0
    status, output = vnet("simulate", "run/scenario.toml", "--no-report", "--out", "again")
    assert (status, "changed" in output) == (0, False)
    sys.modules.pop("rule_of_mine")
    (here / "rule_of_mine.py").write_text(RULE.replace("v01", "v02"))
    status, output = vnet("simulate", "run/scenario.toml", "--no-report", "--out", "other")
    assert status == 0
    assert "the functions rule_of_mine:drops changed since this run was recorded" in output


def test_looking_at_a_run_imports_no_rule(here: Path) -> None:
    assert simulate(here / "ruled.toml")[0] == 0
    sys.modules.pop("rule_of_mine")
    (here / "rule_of_mine.py").write_text("raise SystemExit('imported')")
    assert vnet("check", "run")[0] == 0
    assert vnet("report", "run")[0] == 0
    assert "rule_of_mine" not in sys.modules
    assert check_run(Path("run")).verdict is Verdict.VALID


@pytest.mark.parametrize(
    ("replaced", "by", "said"),
    [
        ("rule_of_mine.py:drops", "nowhere.py", "fault.rule = 'nowhere.py': no such file in"),
        ("rule_of_mine.py:drops", "rule_of_mine.py", "has no 'rule'"),
        ("rule_of_mine.py:drops", "rule_of_mine:dorps", "has no 'dorps'"),
    ],
)
def test_a_rule_that_is_not_there_is_refused_before_a_folder_appears(
    here: Path, replaced: str, by: str, said: str
) -> None:
    (here / "ruled.toml").write_text(SCENARIO.replace(replaced, by))
    status, output = simulate(here / "ruled.toml")
    assert (status, Path("run").exists()) == (2, False)
    assert said in " ".join(output.split())


def test_a_module_that_cannot_be_imported_is_refused_in_one_line(here: Path) -> None:
    (here / "rule_of_mine.py").write_text("1 / 0")
    status, output = simulate(here / "ruled.toml")
    assert (status, Path("run").exists()) == (2, False)
    said = "vnet: fault.rule = 'rule_of_mine:drops': cannot import: ZeroDivisionError: division by zero"
    assert output.splitlines()[-1] == said


def test_a_running_emulator_accepts_no_rule() -> None:
    status, output = vnet("fault", "inject", "custom", "--set", "rule=here.py")
    assert status == 2
    assert output == "vnet: custom: a rule is part of the scenario: write it as [[fault]] there\n"


@pytest.mark.parametrize("name", ["raises", "nonsense"])
def test_a_rule_that_fails_makes_the_run_invalid_and_is_named(tmp_path: Path, name: str) -> None:
    recorded = run_scenario(tmp_path / "run", ruled(name, options={"answer": "Answer(delay_s=-0.001)"}))
    (check,) = [check for check in judge(recorded).checks if check.name == "own_rules"]
    said = {"raises": r"raises ValueError: no idea of v01 (rules.py:", "nonsense": "answers delay_s = -0.001: "}
    assert check.verdict is Verdict.INVALID
    assert check.text.startswith(f"{name}-0 (tests.support.rules:{name}) {said[name]}")
    assert check.figures["rows"][0]["sender"] == "v01"
    (event,) = [event for event in recorded.events if event.kind == "rule_failed"]
    assert (event.time_ns, event.details["fault"]) == (1_000_000_000 if name == "raises" else 0, f"{name}-0")
    others = [check.name for check in judge(recorded).checks if check.verdict is Verdict.INVALID]
    assert others == ["own_rules"]
    assert json.loads((tmp_path / "run" / "verdict.json").read_text())["verdict"] == "invalid"


@pytest.mark.parametrize(
    ("kind", "own"), [("custom", "everything"), ("custom_sender", "babbles"), ("custom_sender", "silences")]
)
@pytest.mark.parametrize(
    "radio", [{}, {"loss": 0.2, "max_peers": 2, "queue_frames": 3}, MAC], ids=["", "full", "mac"]
)
def test_rules_beside_all_other_faults_leave_the_run_valid(
    tmp_path: Path, kind: str, own: str, radio: dict[str, Any]
) -> None:
    kinds = ["DoS", "Sybil", "DataReplay", "StaleMessages", "duplicate", "corrupt"]
    faults: list[dict[str, Any]] = [{"kind": each, "at_s": 0.2, "duration_s": 1.0} for each in kinds]
    faults += [{"kind": "loss", "probability": 0.2, "duration_s": 1.0}]
    faults += [{"kind": kind, "rule": f"tests.support.rules:{own}", "at_s": 0.1, "duration_s": 1.3}]
    recorded = run_scenario(
        tmp_path / "run", Scenario.model_validate({**DATA, "radio": {"range_m": 1e5, **radio}, "fault": faults})
    )
    checks = judge(recorded).checks
    assert {check.name: check.text for check in checks if check.verdict is Verdict.INVALID} == {}
    (effect,) = [check for check in checks if check.name.startswith(f"effect:{own}")]
    assert effect.verdict is Verdict.VALID


@pytest.mark.parametrize(
    "late",
    [
        {"kind": "delay", "delay_ms": 40},
        {"kind": "jitter", "jitter_ms": 40},
        {"kind": "reorder"},
        {"kind": "throttle", "bitrate_mbps": 0.1},
    ],
)
def test_a_delay_shows_beside_a_rule_that_delays_nothing(tmp_path: Path, late: dict[str, Any]) -> None:
    rule = {"kind": "custom", "rule": "tests.support.rules:passes", "duration_s": 1.2}
    faults = [{**late, "at_s": 0.2, "duration_s": 1.0}, rule]
    recorded = run_scenario(tmp_path / "run", Scenario.model_validate({**DATA, "fault": faults}))
    (effect,) = [check for check in judge(recorded).checks if check.name == f"effect:{late['kind']}-0"]
    assert effect.verdict is Verdict.VALID, effect.text


def test_a_test_gives_a_rule_as_a_function_and_its_run_can_be_reproduced(tmp_path: Path) -> None:
    async def run() -> str:
        async with RunHarness(Scenario.model_validate(DATA), tmp_path / "run") as emu:
            await emu.run_until(0.3)
            with emu.rule(rules.drops_far, options={"range_m": 0.5}, senders=["v02"]) as planned:
                assert planned.label == "drops_far-0"
                await emu.run_for(0.4)
            with emu.rule("tests.support.rules:babbles", kind="custom_sender", name="liar", nodes=["v03"]):
                await emu.run_for(0.4)
            own = "own_rules", "effect:drops_far-0", "effect:liar-1"
            return emu.check(*own, "conservation", "isolation").trace_sha256

    trace_sha256 = asyncio.run(run())
    again = run_scenario(tmp_path / "again", load_scenario(tmp_path / "run" / "scenario.toml"))
    assert judge(again).trace_sha256 == trace_sha256
    entries = recorded_code(tmp_path / "run" / "scenario.toml")["rule_entries"]
    assert entries == "tests.support.rules:babbles tests.support.rules:drops_far"


def test_a_function_that_no_module_has_is_no_rule(tmp_path: Path) -> None:
    async def run() -> None:
        async with RunHarness(Scenario.model_validate(DATA), tmp_path / "run") as emu:
            for rule, said in (
                (lambda frame, state: None, "must be a function of a module"),
                ("tests.support.rules:nobody", "has no 'nobody'"),
            ):
                with pytest.raises(ScenarioError, match=said), emu.rule(rule):
                    pass
            assert emu.scenario.fault == ()

    asyncio.run(run())


def test_campaigns_draw_no_rule_and_keep_the_faults_of_their_scenario() -> None:
    scenario = ruled("drops")
    more = [{"kind": "kill", "duration_s": 0.5}, {"kind": "emulator_restart"}]
    scenario = make_scenario(scenario, {"faults": [*scenario.fault, *more]})
    for faults in ("random", "none"):
        plan = Plan.of(scenario, faults, 5, seed=1)
        for number in range(5):
            drawn = [fault.kind for fault in plan.draw(number).fault]
            assert drawn[:2] == ["custom", "kill"] and not {"custom", "emulator_restart"} & {*drawn[1:]}
            assert (len(drawn) > 2) == (faults == "random")
    with pytest.raises(ScenarioError, match="fault 'custom'"):
        Plan.of(scenario, "custom", 5, seed=1)
