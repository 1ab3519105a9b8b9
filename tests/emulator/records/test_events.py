"""The enumeration of events is all that vnet knows about them."""

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
    assert event.level is Level.NOTE and not event.has(ENDS_PROGRAM) and event.what == "teleported"


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
    scenario = load_scenario(
        ROOT / "scenarios" / "faults.toml", ["run.duration_s=15", "program.entry=agents.beacon:main"]
    )
    session = Session(scenario, tmp_path / "run").open()
    session.run()
    session.close()
    events = session.folder.events
    assert {"started", "fault_started", "fault_ended", "restarted", "ended"} <= {event.kind for event in events}
    assert [event for event in events if not event.details.keys() <= set(KINDS[event.kind].details)] == []


def _own(**details: object) -> Event:
    return Event(0, "event", "v02", {"name": "suspect", "details": details})


@pytest.mark.parametrize(
    ("event", "said"),
    [
        (Event(0, "started", None, {"start_up_s": 0.0}), "started"),
        (Event(0, "restarted", "v01", {"incarnation": 2}), "v01 restarted: incarnation 2"),
        (Event(0, "fault_ended", None, {"fault": "loss-3"}), "loss-3 ended"),
        (Event(0, "fault_started", None, {"fault": "loss-3", "nodes": []}), "loss-3 started"),
        (Event(0, "refused", "v01", {"key": "k", "reason": "not its own"}), "v01 refused: not its own"),
        (Event(0, "transport_gap", None, {"count": 3}), "transport gap: count 3"),
        (Event(0, "crashed", "v01", {"error": "a\nb", "where": "line 1"}), "v01 crashed: a\nb"),
        (Event(0, "observer_ended", "recorder", {"how": "SIGTERM"}), "recorder observer ended: SIGTERM"),
        (Event(0, "interrupted", None, {}), "interrupted"),
        (Event(0, "fault_started", None, {"fault": "loss-3", "nodes": ["v01", "v02"]}), "loss-3 started: v01, v02"),
        (Event(0, "exception", "v01", {"error": "E: x", "place": "a.py:3", "where": "…"}), "v01: E: x, a.py:3"),
        (Event(0, "log", "v01", {"level": "warning", "text": "late"}), "v01: late"),
        (_own(member="v01", late_s=0.5, heard=["v02"]), "v02 suspect: member v01, late_s 0.5, heard v02"),
        (_own(), "v02 suspect"),
        (_own(error="a: b", nodes=2), "v02 suspect: error a: b, nodes 2"),
    ],
)
def test_events_in_words(event: Event, said: str) -> None:
    assert event.text == said
