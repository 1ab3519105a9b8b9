"""The enumeration of events is all that vnet knows about them."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from emulator.drivers.session import Session
from emulator.records.events import CUTS_RUN, ENDS_PROGRAM, KINDS, Event, EventKind, Level, kinds_with
from emulator.scenario.loading import load_scenario
from tests.support.paths import ROOT


def test_kinds_are_named_by_their_values() -> None:
    assert {kind.name: kind for kind in EventKind} == KINDS
    assert all(kind.value == kind.name and kind.meaning for kind in EventKind)
    assert not set(kinds_with(CUTS_RUN)) & set(kinds_with(ENDS_PROGRAM))


def test_a_kind_of_another_version_is_a_note() -> None:
    event = Event(0, "teleported", "v01", {})
    assert event.level is Level.NOTE and not event.has(ENDS_PROGRAM) and event.words == "teleported"


@pytest.mark.parametrize(
    ("kind", "details", "level"),
    [
        ("log", {"level": "INFO"}, Level.TOLD),
        ("log", {"level": "error"}, Level.WARNING),
        ("late_deliveries", {"count": 0}, Level.NOTE),
        ("late_deliveries", {"count": 1}, Level.WARNING),
    ],
)
def test_details_decide_the_level_of_some(kind: str, details: dict[str, object], level: Level) -> None:
    assert Event(0, kind, None, details).level is level


@pytest.mark.slow
def test_events_have_the_details_that_are_declared(tmp_path: Path) -> None:
    scenario = load_scenario(ROOT / "scenarios" / "faults.toml", ["run.duration_s=30"])
    session = Session(scenario, tmp_path / "run").open()
    session.run()
    session.close()
    events = session.folder.events
    assert {"started", "fault_started", "fault_ended", "restarted", "ended"} <= {event.kind for event in events}
    assert [event for event in events if not event.details.keys() <= set(KINDS[event.kind].details)] == []


@pytest.mark.slow
def test_a_kind_is_added_in_the_enumeration_alone(tmp_path: Path) -> None:
    environment = os.environ | {"PYTHONHASHSEED": "0", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-P", "-m", "tests.support.added_event", str(tmp_path / "run")]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1]) == {
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
