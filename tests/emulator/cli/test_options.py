"""Options of commands that run a scenario: each has its effect."""

from pathlib import Path

import pytest

from emulator.cli.options import RunOptions, load
from tests.support.paths import ROOT
from vnet.errors import ScenarioError

BEACON = ROOT / "scenarios" / "beacon.toml"


def test_each_option_changes_the_scenario() -> None:
    options = RunOptions(
        scenario=BEACON,
        seed=3,
        duration=12.5,
        order="shuffle",
        order_seed=7,
        overrides=["radio.loss=0.5"],
        option=["period_s=0.2"],
    )
    scenario = options.load(None)
    run = scenario.run
    assert (run.seed, run.duration_s, run.order, run.order_seed, run.pacing) == (3, 12.5, "shuffle", 7, "lockstep")
    assert scenario.radio.loss == 0.5 and scenario.program.options["period_s"] == 0.2
    assert RunOptions(scenario=BEACON).load("realtime").run.pacing == "realtime"


def test_a_tape_is_that_of_the_present_folder(tmp_path: Path) -> None:
    tape = tmp_path / "tape.jsonl"
    tape.write_text("")
    assert RunOptions(scenario=BEACON, tape=tape).load(None).run.tape == tape


def test_seed_of_an_order_is_refused_where_the_order_is_fifo(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="--order-seed 3: the order is FIFO"):
        load(Path("beacon"), None, order_seed=3)
    assert load(Path("beacon"), ["run.order_slack_us=10"], order_seed=3).run.order_seed == 3
    tape = tmp_path / "tape.jsonl"
    tape.write_text("")
    with pytest.raises(ScenarioError, match=r"--order-seed 3: the order is that of the tape, which has no seed$"):
        load(Path("beacon"), None, order_seed=3, tape=tape)
