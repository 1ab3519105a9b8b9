"""The timeline of a report shows the frames of the trace, and of large runs those near what matters."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emulator.api import simulate_into
from emulator.pages.page import render
from emulator.records.events import Event
from emulator.records.recorded_run import Emissions
from emulator.report.source import Source
from emulator.report.timeline import Bar, Mark, Timeline, bars_of, choose, marks_of, points_of, timeline
from emulator.scenario.scenario import Scenario

PROGRAM = """
async def main(node):
    async for fix in node.gnss:
        await node.radio.broadcast(node.id.encode())
        node.log("low", level="warning") if node.now_ns == 300_000_000 else node.log("fine")
        node.event("turned", left=True) if node.now_ns == 400_000_000 else None
        assert node.id != "v03" or node.now_ns < 600_000_000, "worn out"
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Source:
    """A run of a second with a kill, warnings, events, and a crash of v03 at 0.6 s."""
    folder = tmp_path_factory.mktemp("timeline")
    (folder / "worn.py").write_text(PROGRAM)
    scenario = Scenario.model_validate(
        {
            "run": {"duration_s": 1.0, "settle_s": 0.0},
            "network": {"vehicles": 4},
            "radio": {"loss": 0.3},
            "program": {"entry": "worn:main", "folders": [str(folder)]},
            "fault": [{"kind": "kill", "at_s": 0.25, "duration_s": 0.3, "nodes": {"ids": ["v02"]}}],
        }
    )
    return Source(simulate_into(scenario, folder / "run"))


def shown(source: Source, most: int = 20_000) -> tuple[Timeline, dict[str, Any]]:
    found = timeline(source, most)
    assert found is not None
    return found, json.loads(found.data)


@pytest.mark.slow
def test_every_reception_is_there_once_with_its_outcome_and_time(run: Source) -> None:
    found, data = shown(run)
    trace = run.trace.to_pylist()
    assert found.note == f"All {len(trace):,} attempted receptions are shown."
    sent, index, seen = 0, 0, []
    for i, heard in enumerate(data["heard"]):
        sent += data["time"][i]
        for k in range(index, index + heard):
            arrival = sent + data["delay"][k] if data["delay"][k] >= 0 else None
            outcome = data["outcomes"][data["outcome"][k]][0]
            names = [data["nodes"][each] for each in (data["sender"][i], data["receiver"][k])]
            seen.append((sent, *names, data["seq"][i], data["bytes"][i], outcome, arrival))
        index += heard
    expected = [
        (
            row["sent_ns"] // 1000,
            row["sender"],
            row["receiver"],
            row["seq"],
            row["size_bytes"],
            row["outcome"].replace("_", " "),
            None if row["arrival_ns"] is None else row["arrival_ns"] // 1000,
        )
        for row in trace
    ]
    assert Counter(seen) == Counter(expected)
    assert [each[0] for each in seen] == sorted(each[0] for each in seen)
    counts = {title: int(count) for title, _, count in found.outcomes}
    assert counts == Counter(each[5] for each in expected) and counts["lost"] and counts["receiver down"]


def test_marks_bars_and_times_down_are_those_of_the_events(run: Source) -> None:
    found, data = shown(run)
    marks = [(time, data["nodes"][node], kind, text) for time, node, kind, text in data["marks"]]
    assert (300_000, "v01", "warning", "low") in marks
    assert (400_000, "v04", "event", "turned: left True") in marks
    (crashed,) = [text for *where, text in marks if where == [600_000, "v03", "failure"]]
    assert crashed.startswith("crashed: AssertionError: worn out, ")
    assert any(kind == "process" and node == "v02" and time == 550_000 for time, node, kind, _ in marks)
    assert not any("fine" in text for *_, text in marks), "only warnings are marks"
    assert data["bars"] == [["kill-0", 250_000, 550_000, [1]]]
    assert [1, 250_000, 550_000] in data["down"] and [2, 600_000, data["end"]] in data["down"]
    assert [(kind, int(count)) for kind, *_, count in found.kinds] == [
        (kind, sum(mark[2] == kind for mark in marks)) for kind in ("failure", "process", "warning", "event")
    ]
    start, end = data["view"]
    assert start < 600_000 < end and end - start < 500_000


def test_a_large_run_is_thinned_and_says_so(run: Source) -> None:
    found, data = shown(run, 30)
    total = len(run.trace)
    assert 20 <= len(data["receiver"]) <= 30 < total
    assert found.note.startswith(
        f"{len(data['receiver'])} of {total} attempted receptions are shown: those of all "
    )
    assert " of a failure or " in found.note and " of the others." in found.note
    sent_us = np.cumsum(data["time"])
    rows = [row for row in run.trace.to_pylist() if row["sent_ns"] == 600_000_000]
    assert sum(heard for heard, at in zip(data["heard"], sent_us, strict=True) if at == 600_000) == len(rows) > 0


@pytest.mark.parametrize("most", [50, 999, 4000])
def test_frames_near_failures_are_kept_whole_and_the_rest_is_spread(most: int) -> None:
    sent_us = np.arange(2000) * 1000
    frames = Emissions(np.arange(2000), np.repeat(np.arange(2000), 5), np.full(2000, 5))
    marks = [Mark(1_500_000, 0, "failure", "crashed")]
    kept, (radius_us, step) = choose(frames, sent_us, points_of(marks, [Bar("loss-0", 100_000, 300_000, ())]), most)
    assert 0.7 * most - 50 <= 5 * kept.sum() <= most
    near = np.abs(sent_us - 1_500_000) < radius_us
    assert near.any() and kept[near].all()
    near_fault = np.minimum(np.abs(sent_us - 100_000), np.abs(sent_us - 300_000)) * 4 < radius_us
    assert kept[near_fault].all()
    rest = np.flatnonzero(kept & ~near & ~near_fault)
    assert step > 1 and rest[0] < 100 and rest[-1] > 1900 - step


def test_a_fault_that_does_not_end_lasts_until_the_end_and_unknown_nodes_are_left_out() -> None:
    events = [
        Event(5_000_000, "fault_started", None, {"fault": "loss-0", "nodes": ["v01", "v99"]}),
        Event(7_000_000, "crashed", "v99", {"error": "<b>\x1b", "where": "…"}),
        Event(8_000_000, "log", "v01", {"level": "info", "text": "fine"}),
        Event(9_000_000, "interrupted", None, {}),
    ]
    assert bars_of(events, {"v01": 0}, 20_000) == [Bar("loss-0", 5_000, 20_000, (0,))]
    crash, interrupted = marks_of(events, {"v01": 0})
    assert (crash.node, crash.text) == (-1, "crashed: <b>\\x1b")
    assert (interrupted.node, interrupted.kind, interrupted.text) == (-1, "warning", "interrupted")


def test_the_page_holds_all_of_the_data_as_text(run: Source) -> None:
    found, _ = shown(run)
    data = '"</pre><script>alert(1)</script>' + "x" * 50_000
    hostile = Timeline(data, "note", found.outcomes, found.kinds, True)
    text = render("timeline.html.j2", timeline=hostile)
    assert "<script" not in text and text.count("x" * 10_000) >= 4
    assert sum(map(len, hostile.pieces)) == len(data) and "x" * 50_000 in text


def test_a_run_without_a_trace_has_no_timeline(run: Source, tmp_path: Path) -> None:
    (tmp_path / "scenario.toml").write_text((run.folder / "scenario.toml").read_text())
    assert timeline(Source(tmp_path)) is None
