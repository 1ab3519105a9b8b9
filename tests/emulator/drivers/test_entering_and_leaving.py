"""Vehicles that drive, enter and leave: where they are when they send, who hears them, and that checks notice."""

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
from hypothesis import Phase, assume, given, settings
from hypothesis import strategies as st

from emulator.checks.judge import NotExercised, RecordedRun, Verdict, judge
from emulator.drivers.simulate import simulate
from emulator.drivers.status import Course
from emulator.records.events import Event
from emulator.scenario.scenario import Scenario
from emulator.stream import messages, unpack
from emulator.viewer.recorder import Recorder
from emulator.viewer.sinks import Sinks
from emulator.world.neighbours import Links, links_within
from emulator.world.world import build_world, components
from tests.emulator.checks.test_judge import checked, result, run_scenario, verdict
from tests.emulator.terminal.test_dashboard import row as row_of
from tests.support.motion import along, scenario_of_trips, still, write_trips
from tests.support.multi_loop_driver import emulation_of, run_apart, run_forked, run_together
from vnet.errors import ScenarioError

pytestmark = pytest.mark.slow

ORDERED = "tests.support.fault_programs:minds_the_order"
TRAFFIC = {
    "v1": [(0, 9, along(0, 10))],
    "v2": [(0, 9, still(0, 50))],
    "v3": [(3, 9, along(-30, 10, 20))],  # enters
    "v4": [(0, 4, still(100, 20))],  # leaves
    "v5": [(0, 2, still(60)), (6, 9, still(40))],  # comes back
}


def traffic(folder: Path, duration_s: float = 8.0, **options: Any) -> Scenario:
    return scenario_of_trips(write_trips(folder / "trips.csv", TRAFFIC), duration_s, **options)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> RecordedRun:
    folder = tmp_path_factory.mktemp("motion")
    return run_scenario(folder / "run", traffic(folder, program="tests.emulator.checks.test_faults:hears"))


def events_of(recorded: RecordedRun, *kinds: str) -> list[tuple[str, str | None, float]]:
    return [(event.kind, event.node, event.time_ns / 1e9) for event in recorded.event(*kinds)]


def rows_of(recorded: RecordedRun) -> list[dict[str, Any]]:
    return recorded.trace.to_pylist()


# The world.


def test_truth_is_the_trip_and_fixes_have_the_error_of_all_and_noise(tmp_path: Path) -> None:
    path = write_trips(tmp_path / "t.csv", {"a": [(0, 200, along(0, 3))], "b": [(0, 200, still(7))]})
    noise = {"common_error": {"sigma_m": 3.0}, "gnss": {"rate_hz": 10, "sigma_m": 1.0}}
    world = build_world(scenario_of_trips(path, 199.0, world=noise))
    instants = [world.at(period) for period in range(world.periods - 1)]
    position_m = np.array([instant.position_m for instant in instants])
    assert position_m[:, 0, 0] == pytest.approx(3 * np.arange(len(instants)) / 10)
    assert position_m[:, 1] == pytest.approx(np.tile([7.0, 0.0], (len(instants), 1))), "no lateral process"
    own_m = np.array([instant.fix_m - instant.position_m - instant.common_error_m for instant in instants])
    assert own_m.std(axis=(0, 2)) == pytest.approx([1.0, 1.0], rel=0.05)
    fix = world.fix(50, 0)
    assert np.array_equal(fix.position_m, instants[50].fix_m[0])
    assert fix.heading_rad == pytest.approx(instants[50].fix_heading_rad[0])
    assert world.fix(50, 1).heading_rad is None, "nobody knows how a vehicle that never moves stands"


def test_one_more_vehicle_that_comes_later_changes_nothing_for_the_others(tmp_path: Path) -> None:
    some = {name: stays for name, stays in TRAFFIC.items() if name != "v3"}
    less = build_world(scenario_of_trips(write_trips(tmp_path / "less.csv", some), 8.0))
    more = build_world(traffic(tmp_path))
    assert more.node_ids == (*less.node_ids, "v3")
    for period in range(less.periods):
        one, other = less.at(period), more.at(period)
        assert np.array_equal(one.fix_m, other.fix_m[:-1], equal_nan=True)


def test_components_are_of_those_that_are_there() -> None:
    position_m = np.array([[0, 0], [np.nan, np.nan], [50, 0], [1000, 0]])
    assert components(position_m, links_within(position_m, 100.0)).tolist() == [0, -1, 0, 1]
    links = np.ones((4, 4), dtype=bool)
    assert components(position_m, Links.of_matrix(links, position_m)).tolist() == [0, -1, 0, 0]


def test_who_enters_or_leaves_shares_no_process(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="nodes_per_process = 2: must be 1 where vehicles enter or leave"):
        build_world(traffic(tmp_path, run={"nodes_per_process": 2}))
    path = write_trips(tmp_path / "all.csv", {"a": [(0, 9, along(0, 10))], "b": [(0, 9, still(0))]})
    build_world(scenario_of_trips(path, 8.0, run={"nodes_per_process": 2}))


# Frames.


@settings(max_examples=6, deadline=None, phases=[Phase.generate])
@given(st.lists(st.tuples(st.floats(-400, 400), st.floats(-25, 25)), min_size=2, max_size=6), st.floats(50, 500))
def test_frames_reach_whom_their_sender_is_near_when_it_sends(
    tmp_path_factory: pytest.TempPathFactory, drives: list[tuple[float, float]], range_m: float
) -> None:
    assume(len({round(x_m) for x_m, _ in drives}) == len(drives))  # no two in one place
    folder = tmp_path_factory.mktemp("drives")
    vehicles = {f"v{n}": [(0, 4, along(x_m, speed))] for n, (x_m, speed) in enumerate(drives)}
    scenario = scenario_of_trips(
        write_trips(folder / "t.csv", vehicles), 3.0, radio={"range_m": range_m, "max_peers": 2}
    )
    recorded = run_scenario(folder / "run", scenario)
    listed = {(row["sent_ns"], row["sender"], row["receiver"]) for row in rows_of(recorded)}
    rows = [row for row in rows_of(recorded) if row["outcome"] != "peer_cap"]
    admitted = {(row["sent_ns"], row["sender"], row["receiver"]) for row in rows}
    rounded = [(float(f"{x_m:.6f}"), speed) for x_m, speed in drives]
    for period in range(15):
        x_m = [float(f"{x + speed * period / 5:.6f}") for x, speed in rounded]
        for receiver, here_m in enumerate(x_m):
            apart = sorted((abs(there_m - here_m), s) for s, there_m in enumerate(x_m) if s != receiver)
            near = [sender for away_m, sender in apart if away_m <= range_m]
            for sender, away_m in ((s, a) for a, s in apart):
                if abs(away_m - range_m) < 1e-4:
                    continue
                key = (period * 200_000_000, f"v{sender}", f"v{receiver}")
                assert (key in listed) == (sender in near)
                ties = len({round(away, 3) for away, _ in apart}) < len(apart)
                if not ties:
                    assert (key in admitted) == (sender in near[:2])
    assert judge(recorded).verdict is not Verdict.INVALID


def test_links_given_as_a_matrix_hold_for_those_that_are_there(tmp_path: Path) -> None:
    everybody = [[1] * 5 for _ in range(5)]
    recorded = run_scenario(tmp_path / "run", traffic(tmp_path, radio={"links": everybody}))
    assert judge(recorded).verdict is Verdict.VALID
    before = [row for row in rows_of(recorded) if row["sent_ns"] < 3_000_000_000]
    assert before and all("v3" not in (row["sender"], row["receiver"]) for row in before)


# Entering and leaving.


def test_vehicles_enter_and_leave_with_their_programs(recorded: RecordedRun) -> None:
    assert judge(recorded).verdict is Verdict.VALID
    assert events_of(recorded, "entered", "left") == [
        ("left", "v5", 2.2),
        ("entered", "v3", 3.0),
        ("left", "v4", 4.2),
        ("entered", "v5", 6.0),
    ]
    incarnations = {event.node: event.details["incarnation"] for event in recorded.event("entered")}
    assert incarnations == {"v3": 0, "v5": 1}
    for row in rows_of(recorded):
        for node in (row["sender"], row["receiver"]):
            stays = TRAFFIC[node]
            assert any(start <= row["sent_ns"] / 1e9 < end + 0.2 for start, end, _ in stays), row
    assert checked(recorded, "presence").figures["changes"] == 4


def test_what_is_on_its_way_to_one_who_leaves_does_not_reach_it(tmp_path: Path) -> None:
    slow = {"latency_ms": 250.0, "loss": 0.0}
    recorded = run_scenario(tmp_path / "run", traffic(tmp_path, radio=slow))
    lost = [row for row in rows_of(recorded) if row["outcome"] == "receiver_down"]
    assert {row["receiver"] for row in lost} == {"v4", "v5"}
    assert all(row["arrival_ns"] >= 2_200_000_000 for row in lost)
    assert judge(recorded).verdict is Verdict.VALID


FAULTS: list[dict[str, Any]] = [
    {"kind": "kill", "at_s": 2.6, "duration_s": 1.1, "nodes": {"ids": ["v3", "v2"]}},  # v3 enters meanwhile
    {"kind": "restart", "at_s": 3.9, "duration_s": 0.5, "nodes": {"ids": ["v4"]}},  # and v4 leaves
    {"kind": "pause", "at_s": 5.5, "duration_s": 1.0, "nodes": {"ids": ["v5", "v1"]}},
    {"kind": "gnss_freeze", "at_s": 2.0, "duration_s": 5.0, "nodes": {"ids": ["v3", "v5"]}},
    {"kind": "skew", "at_s": 1.0, "duration_s": 6.2, "offset_ms": 40, "nodes": {"ids": ["v3"]}},
    {"kind": "gnss_outage", "at_s": 6.1, "duration_s": 0.7, "nodes": {"disc": [55.0, 10.0, 40.0]}},
    {"kind": "loss", "at_s": 1.0, "duration_s": 6.0, "probability": 0.5, "nodes": {"disc": [0.0, 50.0, 45.0]}},
]


def test_apart_and_together_are_one_run(tmp_path: Path) -> None:
    scenario = traffic(tmp_path, program=ORDERED, faults=FAULTS)
    together, apart = run_together(scenario), run_apart(scenario)
    assert together.engine.trace.sha256() == apart.engine.trace.sha256()
    assert together.metrics.sha256() == apart.metrics.sha256()
    told = [[(e.kind, e.node, e.time_ns) for e in run.folder.events] for run in (together, apart)]
    assert [event for event in told[0] if event[0] != "started"] == told[1]
    forked = run_forked(scenario)
    assert [(e.kind, e.node, e.time_ns) for e in forked.folder.events] == told[0]
    assert forked.metrics.sha256() == together.metrics.sha256()


def test_faults_of_vehicles_that_come_and_go_are_judged(tmp_path: Path) -> None:
    recorded = run_scenario(tmp_path / "run", traffic(tmp_path, program=ORDERED, faults=FAULTS))
    found = {check.name: check for check in judge(recorded).checks if check.verdict is not Verdict.VALID}
    assert not found
    assert ("entered", "v3", 3.7) in events_of(recorded, "entered", "restarted"), "it enters when it may"
    assert ("restarted", "v2", 3.7) in events_of(recorded, "restarted")
    assert not [event for event in events_of(recorded, "restarted") if event[1] == "v4"], "it is not there any more"


def test_who_has_crashed_does_not_come_back(tmp_path: Path) -> None:
    recorded = run_scenario(tmp_path / "run", traffic(tmp_path, program=f"{__name__}:crashes"))
    assert ("entered", "v5", 6.0) not in events_of(recorded, "entered")
    assert verdict(recorded, "agents_alive") is Verdict.INVALID
    for name in ("presence", "down_respected", "conservation"):
        assert verdict(recorded, name) is Verdict.VALID


async def crashes(node: Any) -> None:
    """One of the vehicles that come back fails before it leaves."""
    async for fix in node.gnss:
        await node.radio.broadcast(b"x")
        if node.id == "v5" and fix.time_ns >= 1_000_000_000:
            raise RuntimeError("broken")


def test_nobody_there_at_first_and_nobody_at_last(tmp_path: Path) -> None:
    trips = write_trips(tmp_path / "t.csv", {"a": [(2, 4, still(0))], "b": [(3, 5, still(10))]})
    scenario = scenario_of_trips(trips, 8.0)
    recorded = run_scenario(tmp_path / "run", scenario)
    assert judge(recorded).verdict is Verdict.VALID
    assert run_apart(scenario).engine.trace.sha256() == judge(recorded).trace_sha256


# Regions.


def test_a_region_acts_on_whom_it_holds_when_they_send(tmp_path: Path) -> None:
    """One vehicle drives through a disc in which nothing is heard."""
    vehicles = {"far": [(0, 9, still(0, 500))], "drives": [(0, 9, along(-45, 10))]}
    block = {"kind": "block", "at_s": 1.0, "duration_s": 7.0, "nodes": {"disc": [0.0, 0.0, 20.0]}}
    scenario = scenario_of_trips(
        write_trips(tmp_path / "t.csv", vehicles), 9.0, faults=[block], radio={"loss": 0.0}
    )
    recorded = run_scenario(tmp_path / "run", scenario)
    assert judge(recorded).verdict is Verdict.VALID
    cut = {row["sent_ns"] for row in rows_of(recorded) if row["outcome"] == "fault"}
    assert cut == {k * 200_000_000 for k in range(45) if abs(-45 + 2 * k) <= 20}


def test_receivers_fail_where_the_region_is_and_processes_are_killed_where_it_was_at_first(tmp_path: Path) -> None:
    vehicles = {"stands": [(0, 9, still(0))], "drives": [(0, 9, along(-45, 10))]}
    region = {"polygon": [[-20.0, -5.0], [20.0, -5.0], [20.0, 5.0], [-20.0, 5.0]]}
    outage = {"kind": "gnss_outage", "at_s": 1.0, "duration_s": 7.0, "nodes": region}
    kill = {"kind": "kill", "at_s": 4.0, "duration_s": 3.5, "nodes": region}
    trips = write_trips(tmp_path / "t.csv", vehicles)
    recorded = run_scenario(tmp_path / "run", scenario_of_trips(trips, 9.0, faults=[outage]))
    without = np.isnan(recorded.vectors("fix_m")[:, recorded.number["drives"], 0])
    assert np.flatnonzero(without).tolist() == [k for k in range(45) if abs(-45 + 2 * k) <= 20]
    assert judge(recorded).verdict is Verdict.VALID
    later = {**kill, "at_s": 7.6, "duration_s": 0.5}
    recorded = run_scenario(tmp_path / "kill", scenario_of_trips(trips, 9.0, faults=[kill, later]))
    chosen = [event.details["nodes"] for event in recorded.event("fault_started")]
    assert chosen == [["stands", "drives"], ["stands"]]


def test_degrees_are_those_of_the_period(tmp_path: Path) -> None:
    vehicles = {f"v{n}": [(0, 9, still(10.0 * n))] for n in range(3)} | {"comer": [(4, 9, still(5.0))]}
    lonely = {"kind": "gnss_outage", "at_s": 1.0, "duration_s": 7.0, "nodes": {"degree": [0, 2]}}
    scenario = scenario_of_trips(write_trips(tmp_path / "t.csv", vehicles), 9.0, faults=[lonely])
    recorded = run_scenario(tmp_path / "run", scenario)
    without = np.isnan(recorded.vectors("fix_m")[..., 0])
    assert without[5:20, :3].all() and not without[20:, :].any()
    assert judge(recorded).verdict is Verdict.VALID


# Checks.


def with_events(recorded: RecordedRun, *events: Event, without: tuple[str, str] | None = None) -> RecordedRun:
    kept = [event for event in recorded.events if (event.kind, event.node) != without]
    return replace(recorded, events=[*kept, *events])


def test_a_missing_or_an_odd_event_is_found(recorded: RecordedRun) -> None:
    assert verdict(recorded, "presence") is Verdict.VALID
    for missing in (("entered", "v3"), ("left", "v4")):
        assert verdict(with_events(recorded, without=missing), "presence") is Verdict.INVALID
    for odd in (("left", "v1"), ("entered", "v2"), ("entered", "v4")):
        assert verdict(with_events(recorded, Event(5_000_000_000, *odd, {})), "presence") is Verdict.INVALID


def test_who_is_not_there_is_neither_dead_nor_heard(recorded: RecordedRun) -> None:
    assert verdict(recorded, "liveness") is Verdict.VALID
    silent = recorded.states.to_pydict()
    for row, (period, node) in enumerate(zip(silent["period"], silent["node"], strict=True)):
        if node == "v3" and period >= 25:
            for name in recorded.reported_names:
                silent[name][row] = None
    states = pa.Table.from_pydict(silent, schema=recorded.states.schema)
    assert verdict(replace(recorded, states=states), "liveness") is Verdict.INVALID
    assert verdict(with_events(recorded, without=("entered", "v3")), "down_respected") is Verdict.INVALID


def test_a_delivery_out_of_range_is_found_by_where_the_vehicles_were_then(tmp_path: Path) -> None:
    """Two vehicles meet and part: what is plausible in the middle is impossible at the ends."""
    vehicles = {"east": [(0, 20, along(-500, 50))], "west": [(0, 20, along(500, -50))]}
    trips = write_trips(tmp_path / "t.csv", vehicles)
    recorded = run_scenario(tmp_path / "run", scenario_of_trips(trips, 18.0, radio={"range_m": 200.0}))
    assert judge(recorded).verdict is Verdict.VALID
    sent_s = recorded.sent_ns / 1e9
    assert sent_s.min() == pytest.approx(8.0) and sent_s.max() == pytest.approx(12.0)
    shifted = recorded.trace.set_column(0, "sent_ns", pc.add(recorded.trace["sent_ns"], 1_000_000_000))
    later = shifted.set_column(8, "arrival_ns", pc.add(recorded.trace["arrival_ns"], 1_000_000_000))
    wrong = replace(recorded, trace=later)
    assert verdict(wrong, "range") is Verdict.INVALID
    assert verdict(wrong, "conservation") is Verdict.INVALID


def test_where_vehicles_stand_there_is_nothing_to_enter(tmp_path: Path) -> None:
    standing = run_scenario(tmp_path / "run", Scenario.model_validate({"run": {"duration_s": 1.0}}))
    assert isinstance(result(standing, "presence"), NotExercised)
    trips = write_trips(tmp_path / "t.csv", {"a": [(0, 9, still(0))], "b": [(0, 9, still(10))]})
    staying = run_scenario(tmp_path / "stay", scenario_of_trips(trips, 2.0))
    assert isinstance(result(staying, "presence"), NotExercised)


def test_a_run_that_ends_within_a_period_is_judged_as_far_as_its_places_are_known(tmp_path: Path) -> None:
    recorded = run_scenario(tmp_path / "run", traffic(tmp_path, duration_s=7.5))
    assert recorded.sent_ns.max() == 7_400_000_000 and len(recorded.metrics) == 37
    assert judge(recorded).verdict is Verdict.VALID


def test_figures_by_component_are_those_of_the_period(tmp_path: Path) -> None:
    vehicles = {"a": [(0, 9, still(0))], "b": [(0, 9, along(10, 50))], "c": [(5, 9, still(5))]}
    program = "agents.cooperative:main"
    scenario = scenario_of_trips(
        write_trips(tmp_path / "t.csv", vehicles), 8.0, program=program, radio={"range_m": 100.0}
    )
    recorded = run_scenario(tmp_path / "run", scenario)
    counts = [len(row) for row in recorded.metrics["component_rmse_m"].to_pylist()]
    assert counts[0] == 1 and counts[20] == 2 and counts[30] == 2, "a and c at the end, and b far away"


# The scenario.


# Those who watch.


def test_who_watches_is_told_who_is_not_there_and_none_of_them_is_down(tmp_path: Path) -> None:
    scenario = traffic(tmp_path)
    emulation = emulation_of(scenario)
    course = Course(emulation)
    shots = {}
    emulation.watch(lambda view: shots.update({view.instant.period: course.snapshot()}))
    simulate(emulation)
    assert {shot.down for shot in shots.values()} == {()}
    assert shots[0].absent == ("v3",) and shots[12].absent == ("v5", "v3") and shots[35].absent == ("v4",)
    text = row_of(shots[12], "vehicles")
    assert "3 up" in text and "2 not there" in text and "down" not in text


def test_a_recording_is_drawn_without_lanes_and_of_vehicles_that_are_not_there(tmp_path: Path) -> None:
    run_scenario(tmp_path / "run", traffic(tmp_path))
    told = list(messages(tmp_path / "run"))
    streams = [stream for stream, _ in told]
    assert streams == ["scene", *["period"] * 40, "end"]
    scene = told[0][1]
    assert scene["moves"] and unpack(scene["area_m"], 2).tolist() == [[0, 0], [100, 50]]
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        with Recorder(Sinks(save=tmp_path / "a.rrd"), "driving") as recorder:
            for stream, message in told:
                recorder.take(stream, message)
    assert (tmp_path / "a.rrd").stat().st_size > 0
