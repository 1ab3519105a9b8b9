"""SUMO stepped with the run, with a stand-in for libsumo: programs drive some vehicles, and the others react."""

import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from numpy.testing import assert_allclose

import emulator
from emulator.checks.judge import check_run
from emulator.drivers.conclude import conclude
from emulator.drivers.emulation import Emulation
from emulator.drivers.observers import Messages
from emulator.drivers.simulate import simulate
from emulator.records.recorded_run import RecordedRun
from emulator.records.tables import BACKGROUND, DRIVEN, positions_by_time
from emulator.records.verdicts import Verdict
from emulator.report.drawing import draw_charts
from emulator.report.map_figures import map_charts
from emulator.report.source import Source
from emulator.scenario.loading import load_scenario, scenario_from
from emulator.scenario.scenario import Scenario
from emulator.stream import messages, unpack
from emulator.viewer.recorder import Recorder
from emulator.viewer.sinks import Sinks
from emulator.world.driven.sumo import SumoWorld
from emulator.world.world import build_world
from tests.support.multi_loop_driver import run_forked, run_other_ways, run_together
from tests.support.recorded import prepared
from tests.support.recordings import read_back
from tests.support.sumo import install_fake, write_scenario
from vnet import Node
from vnet.errors import ScenarioError, VnetError

pytestmark = pytest.mark.slow

BRAKES = "tests.support.driving_programs:brakes_and_releases"


@pytest.fixture(autouse=True)
def libsumo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "packages"
    install_fake(folder, monkeypatch)
    return folder


def simulated(tmp_path: Path, data: dict[str, Any], program: Any = BRAKES, **options: Any) -> emulator.Run:
    return emulator.simulate(data, program=program, out=tmp_path / "run", **options)


def by_node(run: emulator.Run, name: str) -> dict[str, Any]:
    assert run.driven is not None
    nodes = run.driven["node"].to_pylist()
    values = np.array(run.driven[name])
    return {node: values[[each == node for each in nodes]] for node in dict.fromkeys(nodes)}


def test_programs_drive_their_vehicles_and_the_others_react(tmp_path: Path) -> None:
    """All in one run: presence, motion, release, reaction, sensors, events, files."""
    seen: dict[str, list[Any]] = {}

    async def main(node: Node) -> None:
        async for fix in node.gnss:
            seen.setdefault(node.id, []).append((fix.time_ns / 1e9, fix.gap_m, dict(fix.sensors)))
            await node.radio.broadcast(b"here")
            if node.id != "lead-23-1":
                continue
            if 0.5 <= fix.time_ns / 1e9 < 1.5:
                node.drive(-20.0)  # more than it can
            elif fix.time_ns / 1e9 == 1.5:
                node.drive(lane=-1)  # there is none
                node.drive(release=True)

    plan = {"closes": str(tmp_path / "closed")}
    sumo = {"nodes": ["behind", "lead#1", "late"], "lights_to": ["late", "unit"]}
    ranging = {"ranging": {"sigma_m": 0.0, "rate_sigma_mps": 0.0}}
    data = write_scenario(tmp_path, plan, network={"sumo": sumo}, world=ranging)
    data["roadside"] = [{"id": "unit", "position_m": [100.0, 0.0]}]
    run = simulated(tmp_path, data, main)
    assert [*run.nodes] == ["behind", "lead-23-1", "late", "unit"], "in the order in which SUMO inserts them"
    assert run.verdict == "valid"
    events = [(event.time_ns / 1e9, event.kind, event.node) for event in run.events]
    assert (1.0, "entered", "late") in events
    limited = [event for event in events if event[1] == "drive_limited"]
    assert limited == [(time_s, "drive_limited", "lead-23-1") for time_s in (0.5, 1.5)]
    speed, command = by_node(run, "speed_m_s"), by_node(run, "command_m_s2")
    assert_allclose(speed["lead-23-1"][[0, 5, 6, 15]], [12.001, 12.001, 11.201, 4.001], atol=1e-9)
    assert_allclose(speed["lead-23-1"][17], 12.001)
    assert speed["behind"].min() < 10.0, "its driver is SUMO's, and keeps its distance"
    assert np.isnan(command["behind"]).all() and np.isnan(command["lead-23-1"][[0, 4, 15]]).all()
    assert command["lead-23-1"][5] == -8.0
    assert np.isnan(speed["late"][:10]).all() and speed["late"][10] == pytest.approx(10.001)
    first_m = RecordedRun.open(tmp_path / "run").vectors("position_m")[0]
    assert_allclose(first_m[:2], [[27.5, 5.0], [57.5, 5.0]], err_msg="centres are half a length behind the bumper")
    gaps_m = [gap for _, gap, _ in seen["behind"]]
    assert gaps_m[0] == pytest.approx(25.0)
    assert seen["lead-23-1"][0][1] is None
    lights = [sensors["traffic_lights"] for _, _, sensors in seen["late"]]
    assert len(seen["unit"]) == 30 and "traffic_lights" in seen["unit"][0][2]
    assert lights[0] == {"a": "rG", "b#1": "rG"}
    assert "traffic_lights" not in seen["behind"][0][2]
    assert (tmp_path / "closed").read_text() == "closed", "SUMO may write its files"


@pytest.mark.parametrize(("lefthand", "to_left"), [("false", 1), ("true", -1)])
def test_left_is_left_wherever_vehicles_drive(tmp_path: Path, lefthand: str, to_left: int) -> None:
    """SUMO counts its two lanes, and places in them, from the left of a network that drives on the left."""

    async def main(node: Node) -> None:
        async for fix in node.gnss:
            if fix.time_ns in (500_000_000, 1_000_000_000):
                node.drive(0.0, lane=1)

    data = write_scenario(tmp_path, network={"sumo": {"nodes": ["lead#1"]}})
    (tmp_path / "a.net.xml").write_text(f'<net lefthand="{lefthand}"><location/></net>')
    run = simulated(tmp_path, data, main)
    limited_ns = [event.time_ns for event in run.events if event.kind == "drive_limited"]
    assert limited_ns == ([1_000_000_000] if to_left > 0 else [500_000_000, 1_000_000_000])
    assert_allclose(by_node(run, "left_m")["lead-23-1"], 0.25 * to_left)


def test_sumo_writes_its_files_in_a_run_in_several_processes(tmp_path: Path) -> None:
    """It ends when its pipe does, of which forked processes must keep no copy."""
    plan, program = {"closes": str(tmp_path / "closed")}, {"entry": BRAKES}
    run_forked(Scenario.model_validate(write_scenario(tmp_path, plan, program=program)))
    assert (tmp_path / "closed").read_text() == "closed"


def test_vehicles_without_programs_are_recorded_and_drawn(tmp_path: Path) -> None:
    """`behind` and `late` have none; `late` comes after a second."""
    scenario = Scenario.model_validate(write_scenario(tmp_path, network={"sumo": {"nodes": ["lead#1"]}}))
    emulation = prepared(scenario, tmp_path / "run")
    live, told = Messages(emulation), list[dict[str, Any]]()
    emulation.watch(lambda view: told.append(live.period(view)))
    conclude(emulation, simulate(emulation)[0], "simulate")
    table = RecordedRun.open(tmp_path / "run").table(BACKGROUND)
    assert table is not None and table.schema == BACKGROUND.schema
    first = table.slice(0, 1).to_pylist()[0]
    assert first == {"time_ns": 0, "vehicle": "behind", "x_m": 30.0, "y_m": 5.0}
    of_late = table.filter(pc.equal(table["vehicle"].cast("string"), "late"))
    assert of_late["time_ns"].to_pylist() == list(range(10**9, 3 * 10**9, 10**8)), "one row a period"
    (drawing, *_), _ = draw_charts(map_charts(Source(tmp_path / "run")))
    assert "the ways of 1 vehicle;" in drawing.caption
    assert "vehicles without programs, where they were at the end" in drawing.caption
    assert [len(each) for each in positions_by_time(table).values()] == [1] * 10 + [2] * 20
    played = list(messages(tmp_path / "run"))
    watched = [message for stream, message in played if stream == "period"]
    assert [len(unpack(message["background_m"], 2)) for message in watched] == [1] * 10 + [2] * 20
    assert [message["background_m"] for message in told] == [message["background_m"] for message in watched]
    with Recorder(Sinks(save=tmp_path / "recording.rrd"), "sumo") as recorder:
        for stream, message in played:
            recorder.take(stream, message)
    drawn = read_back(tmp_path / "recording.rrd")["/map/background"]
    assert_allclose(drawn.array("Points2D:positions", 0.0), [[30.0, -5.0]], err_msg="north is up")
    gone = table.filter(pc.less(table["time_ns"], 2 * 10**9))
    pq.write_table(gone, tmp_path / "run" / BACKGROUND.file)
    (drawing, *_), _ = draw_charts(map_charts(Source(tmp_path / "run")))
    assert "vehicles without programs" not in drawing.caption, "they were not there at the end"


def fingerprint(emulation: Emulation) -> tuple[Any, ...]:
    table = emulation.driving.table()
    assert table is not None
    events = [(event.time_ns, event.kind, event.node, event.details) for event in emulation.folder.events]
    kept = [event for event in events if event[1] not in ("started",)]
    return emulation.engine.trace.sha256(), emulation.metrics.sha256(), repr(table.to_pydict()), kept


def test_a_run_is_the_same_in_every_division_and_again(tmp_path: Path) -> None:
    run = {"control_hz": 20.0}
    data = write_scenario(tmp_path, network={"max_vehicles": 3}, run=run, program={"entry": BRAKES})
    scenario = Scenario.model_validate(data)
    reference = fingerprint(run_together(scenario))
    assert "entered" in {event[1] for event in reference[3]}
    assert fingerprint(run_together(scenario)) == reference
    assert all(fingerprint(other) == reference for other in run_other_ways(scenario))
    other = {**data, "network": {**data["network"], "seed": 2}}
    assert fingerprint(run_together(Scenario.model_validate(other)))[2] != reference[2]


def test_a_folder_is_read_without_sumo_and_runs_again_only_with_the_same(
    tmp_path: Path, libsumo: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulated(tmp_path, write_scenario(tmp_path))
    recorded = tmp_path / "run" / "scenario.toml"
    assert 'libsumo = "1.0 fake_x86_64"' in recorded.read_text()
    again = run_together(load_scenario(recorded))
    verdict = json.loads((tmp_path / "run" / "verdict.json").read_text())
    assert verdict["trace_sha256"] == again.engine.trace.sha256()
    assert verdict["versions"]["sumo"] == "SUMO fake"
    install_fake(libsumo, monkeypatch, "2.0")
    with pytest.raises(ScenarioError, match=r"recorded with libsumo '1.0 fake_x86_64'; here is '2.0 fake_x86_64'"):
        load_scenario(recorded)
    monkeypatch.setitem(sys.modules, "libsumo", None)  # as if it were not installed
    assert check_run(tmp_path / "run").verdict is Verdict.VALID
    assert RecordedRun.open(tmp_path / "run").table(DRIVEN) is not None


def test_without_libsumo_it_is_said_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "libsumo", None)
    with pytest.raises(
        ScenarioError, match=r"network.step = true needs libsumo: pip install 'vnet-emulator\[sumo\]'"
    ):
        build_world(Scenario.model_validate(write_scenario(tmp_path)))


@pytest.mark.parametrize(
    ("plan", "run", "named"),
    [
        ({"fails": 1.0}, {}, r"SUMO: Error: Vehicle 'x' has no valid route\.$"),
        ({"dies": 1.0}, {}, "SUMO: it was ended by signal 6"),
        ({"hangs": 1.0}, {"stall_timeout_s": 0.3}, r"SUMO: no answer for 0\.3 s"),
    ],
)
def test_a_sumo_that_goes_wrong_ends_the_run_in_one_line(
    tmp_path: Path, plan: dict[str, Any], run: dict[str, Any], named: str
) -> None:
    sumo = {"nodes": ["lead#1"]}  # who is there at once: SUMO goes wrong in the run
    data = write_scenario(tmp_path, plan, run=run, network={"sumo": sumo}, program={"entry": BRAKES})
    scenario = Scenario.model_validate(data)
    with pytest.raises(VnetError, match=named) as caught:
        run_together(scenario)
    assert "\n" not in str(caught.value) and "town.sumocfg" in str(caught.value)


def test_no_process_is_left_behind(tmp_path: Path) -> None:
    world = build_world(Scenario.model_validate(write_scenario(tmp_path)))
    assert isinstance(world, SumoWorld)
    pid = world._process.pid
    assert os.getsid(pid) == pid, "Ctrl-C is for the emulator"
    os.kill(pid, signal.SIGINT)
    world.advance()
    del world
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"network": {"kind": "city", "path": None}}, 'step goes with kind = "sumo", not with "city"'),
        ({"network": {"step": False, "sumo": {}}}, "sumo goes with step = true"),
        ({"network": {"disc": [0, 0, 10]}}, "disc goes not with step = true"),
        ({"network": {"max_vehicles": 1, "sumo": {"nodes": ["behind"]}}}, "max_vehicles goes not with sumo.nodes"),
        ({"run": {"control_hz": 64.0}, "world": {"gnss": {"rate_hz": 8}}}, "SUMO steps by whole milliseconds"),
        ({"run": {"control_hz": 25.0}}, "must be a whole multiple of world.gnss.rate_hz"),
        ({"run": {"nodes_per_process": 2}}, "must be 1 w"),
        ({"world": {"common_error": {"gradient_m_per_km": 1.0}}}, "gradient_m_per_km goes not with network.step"),
        ({"network": {"sumo": {"nodes": ["never"]}}}, "'never': SUMO inserts no such vehicle in the run's 3 s"),
        ({"network": {"sumo": {"lights_to": ["x"]}}}, "lights_to = 'x': no such node; there are"),
        ({"network": {"start_s": -1.0}}, "network.start_s = -1: SUMO begins at 0 s"),
        ({"network": {"start_s": 2.05}}, "SUMO begins at 0 s"),
        ({"network": {"start_s": 100.0}}, "SUMO inserts no vehicle in the run's 3 s"),
    ],
)
def test_what_does_not_go_is_one_line(tmp_path: Path, changes: dict[str, Any], named: str) -> None:
    with pytest.raises(ScenarioError, match=named):
        build_world(scenario_from(write_scenario(tmp_path, **changes), tmp_path / "town.toml"))


def test_a_run_may_begin_later_than_sumo(tmp_path: Path) -> None:
    world = build_world(Scenario.model_validate(write_scenario(tmp_path, network={"start_s": 2.0})))
    assert world.node_ids == ("behind", "lead-23-1", "late")
    late_m = world.position_m(0)[2, 0]
    assert late_m == pytest.approx(5.0 + 10.001 - 2.5)
