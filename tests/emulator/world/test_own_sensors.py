"""Sensors of the user's own: readings of the truth, the same in any division into processes."""

import tracemalloc
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emulator import SensedTruth
from emulator.drivers.emulation import Emulation
from emulator.scenario.loading import load_scenario
from emulator.scenario.program import Program
from emulator.scenario.scenario import OwnSensor
from emulator.world.own_sensors import OwnSensors
from tests.support.answers import answers
from tests.support.multi_loop_driver import run_apart, run_together, scenario_of
from vnet.errors import ScenarioError
from vnet.node import NOTHING_SENSED, Fix
from vnet.transport import wire

HERE = "tests.emulator.world.test_own_sensors"


def counts(truth: SensedTruth, state: dict[str, Any]) -> dict[str, Any]:
    """Return the number of the period by the state, and something by chance."""
    state["period"] = state.get("period", -1) + 1
    return {node: (state["period"], truth.rng.random()) for node in truth.node_ids}


def places(truth: SensedTruth, state: dict[str, Any]) -> dict[str, Any]:
    """Return where each vehicle is, its heading and its speed; the first reads nothing."""
    rows = np.column_stack([truth.position_m, truth.heading_rad, truth.speed_m_s])
    return dict(zip(truth.node_ids, rows, strict=True)) | {truth.node_ids[0]: None}


def spoils(truth: SensedTruth, state: dict[str, Any]) -> dict[str, Any]:
    """Write to the truth, which must not matter."""
    truth.position_m[:] = 0
    truth.options["more"] = 1  # type: ignore[index]
    return {node: len(truth.options) for node in truth.node_ids}


def stumbles(truth: SensedTruth, state: dict[str, Any]) -> dict[str, Any]:
    """Raise after half a second."""
    return dict.fromkeys(truth.node_ids, 1 / (0.5 - truth.time_s))


def ones(truth: SensedTruth, state: dict[str, Any]) -> dict[str, Any]:
    """Return a number for each vehicle, but two for the second, and none for the third."""
    return dict.fromkeys(truth.node_ids, 1) | {truth.node_ids[1]: (1, 2), truth.node_ids[2]: None}


def given(truth: SensedTruth, state: dict[str, Any]) -> Any:
    """Return what the options say."""
    return eval(truth.options["answer"], {"np": np})


def scenario(*functions: str, faults: Sequence[dict[str, Any]] = (), **sections: Any) -> Any:
    sensor = {name: {"model": f"{HERE}:{name}"} for name in functions}
    run = {"duration_s": 1.0, "settle_s": 0.0, "seed": 3}
    return scenario_of(
        list(faults),
        "tests.support.sensor_programs:tells",
        3,
        **{"run": run, "world": {"gnss": {"rate_hz": 10}, "sensor": sensor}, **sections},
    )


def readings(emulation: Emulation) -> list[tuple[str, int, str, list[float]]]:
    told = [event for event in emulation.folder.events if event.kind == "event"]
    said = [(event.node or "", event.time_ns, event.details["details"]) for event in told]
    return sorted((node, ns, each["sensor"], list(map(float, each["value"].split()))) for node, ns, each in said)


@pytest.mark.slow
def test_programs_read_what_the_function_says_wherever_they_run() -> None:
    plan = scenario("counts", "places")
    emulation = run_together(plan)
    read = readings(emulation)
    assert readings(run_apart(plan)) == read
    periods = [(node, time_ns, values[0]) for node, time_ns, sensor, values in read if sensor == "counts"]
    assert periods == [(f"v0{n}", p * 100_000_000, p) for n in (1, 2, 3) for p in range(10)]
    assert len({values[1] for _, _, sensor, values in read if sensor == "counts"}) == 30, (
        "draws of every vehicle and period"
    )
    told = {node: values for node, _, sensor, values in read if sensor == "places"}
    assert told.keys() == {"v02", "v03"}
    for node, values in told.items():
        number = emulation.number[node]
        np.testing.assert_allclose(values[:2], emulation.world.position_m(9)[number])


@pytest.mark.slow
def test_a_function_cannot_change_the_truth() -> None:
    emulation = run_together(scenario("spoils"))
    assert {values[0] for *_, values in readings(emulation)} == {1.0}
    assert np.abs(emulation.world.position_m(0)).min() > 0


@pytest.mark.slow
@answers("sensor")
def test_a_sensor_that_fails_is_named_once(kind: str, answer: str, said: str) -> None:
    sensor = {"radar": {"model": f"{HERE}:given", "options": {"answer": answer}}}
    sensor["other"] = {"model": f"{HERE}:counts"}
    emulation = run_together(scenario(world={"gnss": {"rate_hz": 10}, "sensor": sensor}))
    (failed,) = [event for event in emulation.folder.events if event.kind == "rule_failed"]
    assert (failed.time_ns, failed.details["fault"]) == (0, "world.sensor.radar")
    assert failed.details["error"].startswith(said)
    assert len([1 for _, _, name, _ in readings(emulation) if name == "other"]) == 30, "others go on"


@pytest.mark.slow
def test_the_failure_of_a_sensor_comes_in_the_order_of_time_wherever_programs_run() -> None:
    pause = {"kind": "pause", "at_s": 0.2, "duration_s": 0.5, "nodes": ["v03"]}
    plan = scenario("stumbles", "counts", faults=[pause])
    together, apart = (
        [(e.time_ns, e.kind, e.node) for e in run(plan).folder.events if e.kind != "started"]
        for run in (run_together, run_apart)
    )
    times_ns = [time_ns for time_ns, *_ in apart]
    assert together == apart and times_ns == sorted(times_ns)
    assert (500_000_000, "rule_failed", None) in apart
    (failed,) = [e for e in run_together(plan).folder.events if e.kind == "rule_failed"]
    assert failed.details["error"].startswith(
        "raises ZeroDivisionError: float division by zero (test_own_sensors.py:"
    )


@pytest.mark.slow
def test_readings_of_many_vehicles_and_periods_take_little_memory_and_time() -> None:
    sensors = OwnSensors(1, {"radar": OwnSensor(model=f"{HERE}:ones")}, Program(entry="agents.beacon:main"))
    ids = tuple(f"v{number:04d}" for number in range(1000))
    zeros = np.zeros(len(ids))

    def truth(period: int) -> SensedTruth:
        return SensedTruth(period, ids, np.zeros((len(ids), 2)), zeros, zeros)

    sensors.readings(0, ids[0], truth)
    tracemalloc.start()
    assert sensors.readings(10, ids[-1], truth) == {"radar": 1.0}
    size, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert size / 10 / len(ids) < 40, "bytes of a vehicle and period"
    assert sensors.readings(3, ids[1], truth) == {"radar": (1.0, 2.0)}
    assert sensors.readings(3, ids[2], truth) == {}


def test_what_is_no_function_is_said_before_a_run(tmp_path: Path) -> None:
    path = tmp_path / "s.toml"
    path.write_text('[world.sensor.radar]\nmodel = "nowhere.py"\n')
    with pytest.raises(ScenarioError, match=r"world.sensor.model = 'nowhere.py': no such file"):
        load_scenario(path)
    path.write_text('[world.sensor."a b"]\nmodel = "nowhere.py"\n')
    with pytest.raises(ScenarioError, match=r"world\.sensor"):
        load_scenario(path)


def test_readings_pass_the_wire() -> None:
    fix = Fix(1, np.zeros(2), np.eye(2), None, sensors={"radar": (1.0, 2.5), "heat": 20.0})
    sent = wire.encode(wire.Grant(0, 1, 2, [], [wire.WireFix.of("v01", fix)]))
    grant = wire.decode_rx(sent)
    assert isinstance(grant, wire.Grant)
    (again,) = grant.fixes
    assert again.fix().sensors == fix.sensors
    assert wire.WireFix.of("v01", Fix(1, np.zeros(2), np.eye(2), None)).fix().sensors is NOTHING_SENSED
