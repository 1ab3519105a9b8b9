"""The table of outcomes is all that vnet knows about them."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from emulator.pages.palette import PALETTE
from emulator.radio.outcomes import DRAWN, Outcome, Stage, decided_at
from tests.support.paths import ROOT


def test_numbers_names_and_stages() -> None:
    assert [outcome.value for outcome in Outcome] == list(range(len(Outcome))), "they index tables"
    assert Outcome(7) is Outcome.fault and Outcome.fault.title == "fault" and Outcome.peer_cap.title == "peer cap"
    assert set(Outcome) - set(DRAWN) == {Outcome.pending, Outcome.out_of_range}
    assert DRAWN[0] is Outcome.delivered
    staged = {outcome for outcome in Outcome if outcome.facts.stage is not None}
    assert staged == {*DRAWN}
    assert decided_at(Stage.SENDER) == ("queue_full", "oversize", "held_back", "no_grant")
    assert decided_at(Stage.ARRIVAL) == ("delivered", "receiver_down", "transport")


def test_outcomes_are_told_apart_by_colour_and_by_sign() -> None:
    colours = [PALETTE[outcome.facts.colour] for outcome in DRAWN]
    for shade in ("light", "dark", "either"):
        assert len({getattr(colour, shade) for colour in colours}) == len(DRAWN)
    assert len({outcome.facts.sign for outcome in DRAWN}) == len(DRAWN)


@pytest.mark.slow
def test_an_outcome_is_added_in_the_table_alone(tmp_path: Path) -> None:
    environment = os.environ | {"PYTHONHASHSEED": "0", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-P", "-m", "tests.support.added_outcome", str(tmp_path / "run")]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["verdict"] == "valid" and found["counted"] > 100
    assert found["summary"] and f"{found['counted']:,}" in found["summary"][0]
    assert found["report"] >= 2, "outcomes over time and in total"
    assert found["legend"] == [True, False], "where it is possible"
    assert found["colour"] == [list(PALETTE["quiet"].rgb)]
    assert found["checks"] and found["dashboard"] and found["reference"]
