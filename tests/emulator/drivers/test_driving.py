"""Programs that drive, in whole runs: the same in every division into windows and processes, and recorded."""

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

import emulator
from emulator.checks.judge import check_run
from emulator.drivers.emulation import Emulation
from emulator.export.tables import write_csv
from emulator.records.recorded_run import RecordedRun
from emulator.records.tables import DRIVEN
from emulator.records.verdicts import Verdict
from emulator.scenario.scenario import Scenario
from emulator.world.driven.vehicles import COLLISION
from tests.support.map_files import write_map
from tests.support.multi_loop_driver import run_apart, run_forked, run_together, scenario_of
from vnet import Node
from vnet.errors import ScenarioError
from vnet.types import Array

pytestmark = pytest.mark.slow

PLATOON = "tests.support.driving_programs:platoon"
RESTLESS = "tests.support.driving_programs:restless"
NOISELESS: dict[str, Any] = {"sigma_m": 0.0, "speed_sigma_mps": 0.0}


def driven(entry: str, vehicles: int = 4, faults: list[dict[str, Any]] | None = None, **sections: Any) -> Scenario:
    road = {"road": "ring", "length_m": 600.0, "lanes": 2, "gap_m": 15.0}
    keys = {"kind": "driven", "driven": road | sections.pop("road", {})}
    world = {"gnss": {"rate_hz": 10}, "ranging": {}} | sections.pop("world", {})
    return scenario_of(faults or [], entry, vehicles, network=keys, world=world, **sections)


def fingerprint(emulation: Emulation) -> tuple[Any, ...]:
    table = emulation.driving.table()
    assert table is not None
    events = [(event.time_ns, event.kind, event.node, event.details) for event in emulation.folder.events]
    states = repr(emulation.metrics.states_table().to_pydict())
    return emulation.engine.trace.sha256(), emulation.metrics.sha256(), repr(table.to_pydict()), states, events


def test_windows_and_processes_do_not_change_how_vehicles_drive() -> None:
    faults = [{"kind": "restart", "at_s": 0.72, "duration_s": 0.6, "nodes": {"ids": ["v03", "v04"]}}]
    run: dict[str, Any] = {"control_hz": 50.0}
    reference = fingerprint(run_together(driven(RESTLESS, faults=faults, run=run | {"nodes_per_process": 2})))
    kinds = {kind for _, kind, _, _ in reference[4]}
    assert {"drive_limited", "restarted"} <= kinds
    for changes in ({"windows": False}, {"nodes_per_process": 1}, {"windows": False, "nodes_per_process": 1}):
        assert fingerprint(run_together(driven(RESTLESS, faults=faults, run=run | changes))) == reference
    assert fingerprint(run_forked(driven(RESTLESS, faults=faults, run=run))) == reference
    for size in (1, 2):
        apart = run_apart(driven(RESTLESS, faults=faults, run=run | {"nodes_per_process": size}))
        mine = [event for event in fingerprint(apart)[4] if event[1] != "started"]
        assert fingerprint(apart)[:4] == reference[:4]
        assert mine == [event for event in reference[4] if event[1] != "started"]


async def asks_too_much(node: Node) -> None:
    """Ask for more than vehicles can, all at one instant, for which the first one sets its timer last."""
    for wait_s in [0.25, 0.25] if node.id == "v01" else [0.5]:
        await asyncio.sleep(wait_s)
    node.drive(50.0)


@pytest.mark.parametrize("run", [run_together, run_apart, run_forked])
def test_what_vehicles_ask_for_at_one_instant_is_done_in_their_order(run: Callable[[Scenario], Emulation]) -> None:
    emulation = run(driven(f"{__name__}:asks_too_much", 3, run={"duration_s": 1.0, "settle_s": 0.0}))
    assert [e.node for e in emulation.folder.events if e.kind == "drive_limited"] == ["v01", "v02", "v03"]


@pytest.mark.parametrize("is_map", [False, True])
def test_vehicles_that_leave_do_so_alike_in_processes_of_their_own(tmp_path: Path, is_map: bool) -> None:
    sections: dict[str, Any] = {"road": {"road": "straight", "length_m": 120.0, "lanes": 1}}
    if is_map:
        path = write_map(tmp_path, ([(0.0, 0.0), (70.0, 0.0), (70.0, 52.0)], (1, 0)))
        road = {"road": "map", "routes": [["edge 0"]], "length_m": 5000.0, "lanes": 1}
        sections = {"road": road, "map": {"path": str(path)}}
    together, apart, forked = (
        run(driven(PLATOON, run={"duration_s": 6.0}, **sections)) for run in (run_together, run_apart, run_forked)
    )
    left = [event.node for event in together.folder.events if event.kind == "left"]
    assert left == ["v01", "v02", "v03"]
    assert fingerprint(together)[:4] == fingerprint(apart)[:4]
    assert fingerprint(together) == fingerprint(forked)
    last = together.metrics.states_table().to_pylist()[-4:]
    assert [bool(np.isnan(row["position_m"][0])) for row in last] == [True, True, True, False]


def simulated(scenario: Scenario, out: Path, **options: Any) -> emulator.Run:
    return emulator.simulate(scenario.model_dump(mode="json", exclude_none=True), out=out, **options)


def test_a_run_is_judged_and_shown_from_its_folder(tmp_path: Path) -> None:
    column = {"road": "straight", "lanes": 1, "gap_m": 5.0, "speed_mps": (5.0, 25.0, 10.0)}
    done = simulated(driven("tests.support.driving_programs:brakes_not", 3, road=column), tmp_path / "run")
    collisions = [event for event in done.events if event.kind == COLLISION]
    assert [(event.node, event.details["with"]) for event in collisions][:1] == [("v02", "v01")]
    assert done.driving["collisions"] == len(collisions)
    assert done.driving["hardest_braking_m_s2"] == pytest.approx(8.0, abs=0.01)
    assert check_run(tmp_path / "run").verdict is not Verdict.INVALID
    again = RecordedRun.open(tmp_path / "run")
    (tmp_path / "tables").mkdir()
    assert "driven.csv" in write_csv(again, tmp_path / "tables")
    motion = again.table(DRIVEN)
    assert motion is not None
    speed = np.array(motion["speed_m_s"]).reshape(-1, 3)
    along_m = np.array(motion["along_m"]).reshape(-1, 3)
    position_m = again.vectors("position_m")
    assert_allclose(along_m[: len(position_m)], position_m[..., 0])
    assert speed[0].tolist() == [5.0, 25.0, 10.0]


def test_programs_see_their_speed_and_gap_with_noise_and_nothing_of_the_truth(tmp_path: Path) -> None:
    seen: dict[str, list[tuple[float, float, float]]] = {}

    async def looks(node: Node) -> None:
        async for fix in node.gnss:
            assert fix.speed_m_s is not None
            gap = np.nan if fix.gap_m is None else fix.gap_m
            rate = np.nan if fix.gap_rate_m_s is None else fix.gap_rate_m_s
            seen.setdefault(node.id, []).append((fix.speed_m_s, gap, rate))

    ranging = {"sigma_m": 0.5, "rate_sigma_mps": 0.2, "range_m": 50.0}
    road = {"road": "straight", "lanes": 1, "gap_m": 20.0}
    gnss, run = {"rate_hz": 50}, {"control_hz": 50.0}
    scenario = driven("x:y", 2, world={"gnss": gnss, "ranging": ranging}, road=road, run=run)
    simulated(scenario, tmp_path / "run", program=looks, duration_s=10.0)
    speed, gap, rate = np.array(seen["v02"]).T
    assert gap.mean() == pytest.approx(20.0, abs=0.1)
    assert gap.std() == pytest.approx(0.5, rel=0.15)
    assert rate.std() == pytest.approx(0.2, rel=0.15)
    assert speed.std() == pytest.approx(0.1, rel=0.15)
    assert np.isnan(np.array(seen["v01"])[:, 1]).all(), "nobody is ahead"


def test_a_vehicle_whose_program_has_ended_keeps_its_speed(tmp_path: Path) -> None:
    async def gives_up(node: Node) -> None:
        node.drive(1.0)
        async for fix in node.gnss:
            if fix.time_ns >= 1_000_000_000:
                return

    scenario = driven("x:y", 1, road={"lag_s": 0.0, "speed_mps": 10.0}, world={"gnss": NOISELESS | {"rate_hz": 10}})
    done = simulated(scenario, tmp_path / "run", program=gives_up)
    assert done.driven is not None
    speed = np.array(done.driven["speed_m_s"])
    assert_allclose(speed[[0, 5, 10, 11, 29]], [10.0, 10.5, 11.0, 11.0, 11.0])


def test_driving_is_refused_in_one_line_where_programs_do_not_drive(tmp_path: Path) -> None:
    said = []

    async def drives(node: Node) -> None:
        assert node.control_ns == 0
        try:
            node.drive(1.0)
        except ValueError as error:
            said.append(str(error))

    simulated(scenario_of([], "x:y", 1), tmp_path / "run", program=drives)
    assert said == ['drive(…): programs drive only with [network] kind = "driven", or with step = true']


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"acceleration_m_s2": float("nan")}, r"drive\(acceleration_m_s2=nan\): a finite number within"),
        ({"acceleration_m_s2": "fast"}, r"drive\(acceleration_m_s2='fast'\): a finite number"),
        ({"lane": 2}, r"drive\(lane=2\): allowed are -1 \(right\), 1 \(left\)"),
        ({}, r"drive\(\): give acceleration_m_s2, lane or both"),
    ],
)
def test_wrong_actions_are_refused(tmp_path: Path, arguments: dict[str, Any], message: str) -> None:
    async def drives(node: Node) -> None:
        assert node.control_ns == 100_000_000
        with pytest.raises(ValueError, match=message):
            node.drive(**arguments)
        node.log("refused")

    done = simulated(driven("x:y", 1), tmp_path / "run", program=drives)
    assert [event.details["text"] for event in done.events if event.kind == "log"] == ["refused"]


def test_faults_cannot_select_by_a_position_that_is_not_known_yet(tmp_path: Path) -> None:
    fault = {"kind": "kill", "at_s": 1.0, "duration_s": 0.5, "nodes": {"degree": [1, 4]}}
    with pytest.raises(ScenarioError, match="positions at 1 s depend on what programs do until then"):
        run_together(driven(RESTLESS, faults=[fault]))


def test_vehicles_that_may_leave_share_no_process(tmp_path: Path) -> None:
    keys = {"kind": "driven", "vehicles": 4, "driven": {"length_m": 200.0}}
    scenario = {"network": keys, "run": {"nodes_per_process": 4}}
    with pytest.raises(ScenarioError, match="must be 1 where vehicles may leave"):
        emulator.simulate(scenario, program=PLATOON, out=tmp_path / "run", duration_s=10.0)


FREQUENCIES_HZ = (0.02, 0.04, 0.1, 0.2, 0.5)
SETTLE_S, MEASURE_S = 50, 50
KP, KD, FEED, HEADWAY_S = 0.4, 0.9, 0.6, 0.8


def test_a_platoon_answers_as_the_closed_form_of_the_sampled_system(tmp_path: Path) -> None:
    """Gain and phase from the first to each other vehicle, with hold, latency of a period and actuator lag."""

    async def program(node: Node) -> None:
        number, ahead_m_s2 = int(node.id[1:]), 0.0
        async for fix in node.gnss:
            told = {packet.sender: float(packet.payload) for packet in node.radio.drain()}
            ahead_m_s2 = told.get(f"v{number - 1:02d}", ahead_m_s2)
            time_s = fix.time_ns / 1e9
            if fix.gap_m is None or fix.gap_rate_m_s is None or fix.speed_m_s is None:
                asked = 0.2 * sum(np.sin(2 * np.pi * f * time_s) * f**0.5 for f in FREQUENCIES_HZ)
            else:
                error_m = fix.gap_m - 5.0 - HEADWAY_S * fix.speed_m_s
                asked = KP * error_m + KD * fix.gap_rate_m_s + FEED * ahead_m_s2
            node.drive(float(asked))
            await node.radio.broadcast(repr(float(asked)).encode())

    road = {"road": "straight", "lanes": 1, "length_m": 100_000.0, "gap_m": 21.0}
    quiet = {"gnss": NOISELESS | {"rate_hz": 10}, "ranging": {"sigma_m": 0.0, "rate_sigma_mps": 0.0}}
    scenario = driven("x:y", 3, road=road, world=quiet, radio={"loss": 0.0})
    done = simulated(scenario, tmp_path / "run", program=program, duration_s=float(SETTLE_S + MEASURE_S))
    assert done.driven is not None
    assert done.driving["limited_actions"] == 0
    acceleration = np.array(done.driven["acceleration_m_s2"]).reshape(-1, 3)[SETTLE_S * 10 :]
    time_s = np.arange(len(acceleration)) / 10 + SETTLE_S
    for frequency_hz in FREQUENCIES_HZ:
        phasor = np.exp(-2j * np.pi * frequency_hz * time_s) @ acceleration
        measured, expected = phasor[1:] / phasor[0], closed_form(frequency_hz, 2, scenario.driven.lag_s)
        assert_allclose(measured, expected, rtol=0.02)
        assert_allclose(measured, expected, rtol=1e-4)


def closed_form(frequency_hz: float, followers: int, lag_s: float) -> Array:
    """Return the response (followers,) to the first vehicle's acceleration: of the exact sampled system."""
    from scipy.linalg import expm

    step_s = 0.1
    rates = np.zeros((4, 4))
    rates[0, 1] = rates[1, 2] = 1.0
    rates[2, 2], rates[2, 3] = -1 / lag_s, 1 / lag_s
    whole = expm(rates * step_s)
    free, forced = whole[:3, :3], whole[:3, 3:]
    z = np.exp(2j * np.pi * frequency_hz * step_s)
    plant = np.linalg.solve(z * np.eye(3) - free, forced)[:, 0]  # command to position, speed, acceleration
    own = np.array([-KP, -KD - KP * HEADWAY_S, 0.0]) @ plant
    other = np.array([KP, KD, 0.0]) @ plant + FEED / z  # what the command makes of that of the vehicle ahead
    return np.asarray(np.cumprod(np.full(followers, other / (1 - own))))
