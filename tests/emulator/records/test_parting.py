"""Two runs are set side by side to the first decision, frame, reception, event and value in which they differ."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from emulator.api import simulate_into
from emulator.records.parting import (
    FRAME,
    RECEPTION,
    Entry,
    Parting,
    _first_entry,
    _first_reception,
    _frame,
    _reception,
    before,
    first_frame,
    partings,
)
from emulator.records.recorded_run import OpenedRun, RecordedRun
from emulator.records.tables import TRACE
from emulator.scenario.scenario import Scenario
from tests.support.command_line import app


def simulated(folder: Path, **sections: Any) -> OpenedRun:
    data: dict[str, Any] = {
        "run": {"duration_s": 1.0, "settle_s": 0.0},
        "network": {"vehicles": 3},
        "program": {"entry": "tests.emulator.testing.programs:tells_before_it_measures"},
    }
    for name, section in sections.items():
        data[name] = {**data.get(name, {}), **section}
    return RecordedRun.open(simulate_into(Scenario.model_validate(data), folder))


def told(run: OpenedRun, parting: Parting) -> list[str]:
    return before(run.trace, run.events, parting.node, parting.time_ns)


@pytest.mark.slow
def test_runs_that_are_alike_do_not_part(tmp_path: Path) -> None:
    assert partings(simulated(tmp_path / "a"), simulated(tmp_path / "b")) == []


@pytest.mark.slow
def test_another_order_parts_from_fifo_at_a_decision_and_the_crash_names_its_line(tmp_path: Path) -> None:
    fifo = simulated(tmp_path / "a")
    shuffled = simulated(tmp_path / "b", run={"order": "shuffle", "duration_s": 1.0})
    found = partings(fifo, shuffled)
    assert found[0].kind == "decision" and found[0].first == "" and " before " in found[0].second
    event = next(each for each in found if each.kind == "event")
    assert event.first == "" and event.second.startswith("crashed error = ")
    assert "programs.py" in event.second and "in tell" in event.second
    frame = next(each for each in found if each.kind == "frame")
    assert frame.first.startswith("frame ") and told(fifo, frame) == sorted(told(fifo, frame))


@pytest.mark.slow
def test_a_lost_frame_is_a_reception_and_what_follows_is_told(tmp_path: Path) -> None:
    """A block keeps v02 from hearing v01 for a while: no frame and no event differs before that."""
    run: dict[str, Any] = {"program": {"entry": "agents.beacon:main"}, "run": {"duration_s": 2.0, "settle_s": 0.5}}
    fault = {"kind": "block", "at_s": 0.95, "duration_s": 0.2, "senders": {"ids": ["v01"]}}
    plain = simulated(tmp_path / "a", **run)
    data = plain.scenario.model_dump(mode="json", exclude_none=True) | {"fault": [fault]}
    blocked = RecordedRun.open(simulate_into(Scenario.model_validate(data), tmp_path / "b"))
    reception = next(each for each in partings(plain, blocked) if each.kind == "reception")
    assert "delivered" in reception.first and "fault" in reception.second
    assert reception.first.partition(": ")[0] == reception.second.partition(": ")[0], (
        "it is the same one, at its own time"
    )
    assert 0.95 < reception.time_ns / 1e9 < 1.2
    assert any(line.endswith("heard frame 0 of v01") for line in told(plain, reception)) is False
    assert len(told(plain, reception)) == 8


@pytest.mark.slow
def test_a_frame_that_was_changed_on_its_way_is_a_reception(tmp_path: Path) -> None:
    """It was sent as in the other run, whether all receivers hear it otherwise or some."""
    run: dict[str, Any] = {"program": {"entry": "agents.beacon:main"}, "run": {"duration_s": 2.0, "settle_s": 0.5}}
    plain = simulated(tmp_path / "a", **run)
    for receivers in ["v02"], ["v02", "v03"]:
        fault = {"kind": "corrupt", "at_s": 0.95, "duration_s": 0.5, "nodes": receivers, "probability": 1.0}
        data = plain.scenario.model_dump(mode="json", exclude_none=True) | {"fault": [fault]}
        changed = RecordedRun.open(simulate_into(Scenario.model_validate(data), tmp_path / "-".join(receivers)))
        assert [each.kind for each in partings(plain, changed)][:1] == ["reception"]
        assert first_frame(plain, changed) is None


@pytest.mark.slow
def test_vehicles_of_one_run_alone_are_named_and_values_are_those_of_both(tmp_path: Path) -> None:
    """Campaigns compare shrunk runs, which have fewer vehicles."""
    program = {"program": {"entry": "agents.beacon:main"}}
    three = simulated(tmp_path / "a", **program)
    one = simulated(tmp_path / "b", **program, network={"vehicles": 1})
    found = partings(three, one)
    assert [(each.node, each.first, each.second) for each in found if each.kind == "vehicle"] == [
        ("v02", "v02 and 1 more", "")
    ]
    value = next(each for each in found if each.kind == "value")
    assert value.node == "v01"
    assert value.first.partition(" = ")[0] == value.second.partition(" = ")[0]
    assert [each.second for each in partings(one, three) if each.kind == "vehicle"] == ["v02 and 1 more"]


@pytest.mark.slow
def test_a_shorter_run_parts_where_it_ends(tmp_path: Path) -> None:
    long, short = simulated(tmp_path / "a"), simulated(tmp_path / "b", run={"duration_s": 0.5})
    value = next((each for each in partings(long, short) if each.kind == "value"), None)
    assert value is None or (value.time_ns >= 5e8 and value.second == "")


V01, V02, V02_LATER = (5, "v01", "frame of v01"), (5, "v02", "frame of v02"), (9, "v02", "frame of v02")


@pytest.mark.parametrize(
    "first, second, expected",
    [
        ([V01, V02], [V02], Parting(5, "frame", "v01", "frame of v01", "")),
        ([V02], [V01, V02], Parting(5, "frame", "v01", "", "frame of v01")),
        ([V01], [V02_LATER], Parting(5, "frame", "v01", "frame of v01", "")),
        ([(5, "v01", "a"), (5, "v01", "b")], [(5, "v01", "b")], Parting(5, "frame", "v01", "a", "")),
        ([(5, "v01", "lost")], [(5, "v01", "delivered")], Parting(5, "frame", "v01", "lost", "delivered")),
        ([V01, V02], [V01, V02], None),
    ],
    ids=["missing", "more", "later", "one of two", "another", "same"],
)
def test_a_parting_names_the_entry_that_one_run_lacks(
    first: list[Entry], second: list[Entry], expected: Parting | None
) -> None:
    assert _first_entry("frame", first, second) == expected


rows = st.lists(
    st.fixed_dictionaries(
        {
            "sent_ns": st.integers(0, 3),
            "sender": st.sampled_from(["v01", "v02"]),
            "seq": st.integers(0, 1),
            "size_bytes": st.just(8),
            "payload_digest": st.integers(0, 1),
            "copy": st.just(0),
            "receiver": st.sampled_from(["v01", "v02", "v03"]),
            "outcome": st.sampled_from(["delivered", "lost"]),
            "cause": st.none() | st.just("block-0"),
            "arrival_ns": st.none() | st.integers(0, 6),
        }
    ).filter(lambda row: row["outcome"] == "lost" or row["cause"] is None),
    max_size=6,
)


@given(rows, rows, rows)
def test_traces_part_where_all_their_entries_do(same: list[Any], first: list[Any], second: list[Any]) -> None:
    """In whatever order their rows are: a damaged trace is not sorted by time."""
    schema = pa.schema([TRACE.schema.field(name) for name in dict.fromkeys((*FRAME, *RECEPTION))])
    ours, theirs = same + first, same + second
    runs: list[Any] = [SimpleNamespace(trace=pa.Table.from_pylist(rows, schema)) for rows in (ours, theirs)]
    frames = [sorted({*map(_frame, rows)}) for rows in (ours, theirs)]
    receptions = [sorted(map(_reception, rows)) for rows in (ours, theirs)]
    for found, kind, entries in (
        (first_frame(*runs), "frame", frames),
        (_first_reception(*runs), "reception", receptions),
    ):
        whole = _first_entry(kind, *entries)
        places = [each and (each.time_ns, each.kind, each.node) for each in (found, whole)]
        assert places[0] == places[1]


@pytest.mark.slow
@pytest.mark.parametrize(
    "other, status, told",
    [("a", 0, "two runs agree"), ("b", 1, "the runs part at 0.000000 s"), ("nothing", 2, "nothing")],
)
def test_the_command_tells_it(other: str, status: int, told: str, tmp_path: Path) -> None:
    simulated(tmp_path / "a")
    simulated(tmp_path / "b", run={"order": "shuffle", "duration_s": 1.0})
    done = CliRunner().invoke(app, ["compare", str(tmp_path / "a"), str(tmp_path / other)])
    assert done.exit_code == status and told in done.output.replace("\n", "")
