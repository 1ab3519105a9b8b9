"""Additions to a table show everywhere without another change: those of an outcome, and of a kind of event."""

import json
import os
import subprocess
import sys
from typing import Any

import pytest

from emulator.pages.palette import PALETTE
from tests.support.paths import ROOT

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    """The places where the outcome and the event show, in a process whose tables have them."""
    folder = tmp_path_factory.mktemp("additions")
    environment = os.environ | {"PYTHONHASHSEED": "0", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-P", "-m", "tests.support.additions", str(folder)]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    found: list[dict[str, Any]] = json.loads(done.stdout.splitlines()[-1])
    return found


def test_an_outcome_is_added_in_the_table_alone(shown: list[dict[str, Any]]) -> None:
    found = shown[0]
    assert found["verdict"] == "valid" and found["counted"] > 100
    assert found["summary"] and f"{found['counted']:,}" in found["summary"][0]
    assert found["report"] >= 2, "outcomes over time and in total"
    assert found["legend"] == [True, False], "where it is possible"
    assert found["colour"] == [list(PALETTE["quiet"].rgb)]
    assert found["checks"] and found["dashboard"] and found["reference"]


def test_a_kind_is_added_in_the_enumeration_alone(shown: list[dict[str, Any]]) -> None:
    assert shown[1] == {
        "read": ["v01", "v02"],
        "dead": 2,
        "words": "v01 jammed: channel 5",
        "bad": True,
        "grouped": ["2 vehicles"],
        "timeline": "failure",
        "report": True,
        "rerun": "WARN",
        "reference": True,
    }
