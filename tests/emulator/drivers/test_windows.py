"""Windows change nothing but the number of exchanges: traces, metrics, states and events are the same without."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emulator.drivers.emulation import Emulation
from emulator.drivers.lockstep import Lockstep
from emulator.drivers.simulate import simulate
from emulator.scenario.faults import parse_fault
from emulator.scenario.scenario import Scenario
from emulator.testing.strategies import faults as schedules
from tests.support.motion import along, scenario_of_trips, still, write_trips
from tests.support.multi_loop_driver import emulation_of, run_apart, run_forked, run_together, scenario_of
from vnet.transport import wire
from vnet.units import NS_PER_S

pytestmark = pytest.mark.slow

IMPROVISES = "tests.support.window_programs:improvises"
Fingerprint = tuple[str, Any, Any, list[Any]]

MEDIUM: dict[str, Any] = {
    "max_peers": 1000,
    "path_loss": {
        "kind": "dual_slope",
        "tx_power_dbm": 33.0,
        "exponent": 1.9,
        "far_exponent": 2.5,
        "break_m": 500.0,
    },
    "fading": {},
    "mac": {"access_category": "BE"},
}
"""A shared medium. At 3 Mbit/s some vehicles fill it: frames wait for each other, collide and are held back."""
STILL_AIR = {"loss": 0.0, "jitter_ms": 0.0, "access_jitter_ms": 0.0}


def fingerprint(emulation: Emulation) -> Fingerprint:
    """All that a run leaves behind and that may be compared."""
    rows = [repr(row) for row in emulation.metrics.rows]
    events = [(event.time_ns, event.kind, event.node, event.details) for event in emulation.folder.events]
    return emulation.engine.trace.sha256(), emulation.metrics.states_table().to_pydict(), rows, events


def same(one: Sequence[Any], other: Sequence[Any]) -> bool:
    return repr(one) == repr(other)  # by their text: NaN is not equal to itself


def assert_same_in_all_ways(scenario: Scenario) -> None:
    """Compare a run with windows, on one loop, in processes and on loops of their own, with one without."""
    reference = fingerprint(simulated(scenario, False))
    assert same(fingerprint(simulated(scenario, True)), reference)
    assert same(fingerprint(run_forked(with_windows(scenario, True))), reference)
    assert same(fingerprint(run_apart(with_windows(scenario, True)))[:3], reference[:3])


def with_windows(scenario: Scenario, windows: bool) -> Scenario:
    return scenario.model_copy(update={"run": scenario.run.model_copy(update={"windows": windows})})


def simulated(scenario: Scenario, windows: bool) -> Emulation:
    return run_together(with_windows(scenario, windows))


# Random scenarios and programs.

radios = st.fixed_dictionaries(
    {
        "latency_ms": st.sampled_from([0.001, 0.3, 2.0, 2.3, 20.0, 250.0]),
        "jitter_ms": st.sampled_from([0.0, 1.0, 30.0]),
        "access_jitter_ms": st.sampled_from([0.0, 1.0]),
        "delivery_tick_us": st.sampled_from([0, 0, 1000]),
        "loss": st.sampled_from([0.0, 0.2]),
    }
)
"""Radios without a shared medium; `MEDIUM` makes them ones with."""


@st.composite
def scenarios(draw: st.DrawFn) -> Scenario:
    radio = {**draw(radios), **(draw(st.sampled_from([{}, {**MEDIUM, "bitrate_mbps": 3.0}])))}
    if draw(st.booleans()) and "mac" in radio:
        radio["congestion"] = {"kind": draw(st.sampled_from(["etsi", "limeric"]))}
    vehicles = draw(st.integers(2, 5))
    run = {
        "duration_s": 1.0,
        "settle_s": 0.2,
        "seed": draw(st.integers(0, 10_000)),
        "nodes_per_process": draw(st.sampled_from([1, 3, 1000])),
    }
    network = {"layout": "dense"}
    units = [{"position_m": [500.0 * n, 0.0]} for n in range(draw(st.sampled_from([0, 2])))]
    scenario = scenario_of([], IMPROVISES, vehicles, run=run, radio=radio, network=network, roadside=units)
    drawn = draw(schedules(scenario, most=3))
    return scenario.model_copy(update={"fault": drawn})


@settings(max_examples=4, deadline=None)
@given(scenarios())
def test_random_runs_are_the_same_with_and_without_windows(scenario: Scenario) -> None:
    assert_same_in_all_ways(scenario)


def test_a_medium_under_heavy_load_is_the_same_with_and_without_windows() -> None:
    """Frames wait for the medium longer than a window, collide and are dropped."""
    radio = {**MEDIUM, "bitrate_mbps": 3.0, "latency_ms": 0.3, "access_jitter_ms": 20.0}
    run = {"duration_s": 0.6, "settle_s": 0.0}
    world = {"gnss": {"rate_hz": 20}}
    scenario = scenario_of([], IMPROVISES, 14, run=run, radio=radio, network={"layout": "dense"}, world=world)
    program = scenario.program.model_copy(update={"options": {"filling_bytes": 1300}})
    scenario = scenario.model_copy(update={"program": program})
    reference = simulated(scenario, False)
    loads = np.array(reference.engine.busy_ratios(reference.duration_ns))
    assert loads.mean() > 0.6
    assert same(fingerprint(simulated(scenario, True)), fingerprint(reference))


def test_a_unit_that_hears_by_wire_transmits_at_once_on_a_shared_medium() -> None:
    """The radio once ran past the arrival, so that frames which were queued then went before."""
    units = [{"position_m": [100.0 * n, 0.0]} for n in range(2)]
    radio = {**STILL_AIR, "mac": {"access_category": "BK"}, "latency_ms": 10.0}
    scenario = scenario_of([], "tests.support.window_programs:wakes_a_unit", 1, radio=radio, roadside=units)
    reference = simulated(scenario, False)
    assert same(fingerprint(simulated(scenario, True)), fingerprint(reference))
    woken, *_ = [row for row in reference.engine.trace.to_table().to_pylist() if row["sender"] == "rsu02"]
    assert woken["arrival_ns"] < 0.117 * NS_PER_S, "behind at most one frame, not ten"


@settings(max_examples=2, deadline=None)
@given(latency_ms=st.sampled_from([0.001, 2.0, 250.0]), seed=st.integers(0, 1000), data=st.data())
def test_vehicles_that_enter_and_leave_do_so_at_the_same_instants(
    latency_ms: float, seed: int, data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    vehicles = {
        "v1": [(0.0, 4.0, along(0, 10))],
        "v2": [(0.0, 4.0, still(0, 50))],
        "v3": [(0.6, 4.0, along(-30, 10, 20))],  # enters
        "v4": [(0.0, 0.8, still(100, 20))],  # leaves
    }
    path = write_trips(tmp_path_factory.mktemp("trips") / "trips.csv", vehicles)
    radio = {"latency_ms": latency_ms}
    run = {"seed": seed, "settle_s": 0.2}
    assert_same_in_all_ways(scenario_of_trips(path, 1.6, IMPROVISES, radio=radio, run=run))


# Packets that the process has, but whose receiver has not run since they arrived.


@pytest.mark.parametrize("run", [run_together, run_apart, run_forked])
def test_a_program_that_is_started_again_has_no_packets_of_the_one_before(
    run: Callable[[Scenario], Emulation],
) -> None:
    """v02 is killed after the window in which a packet has come that it has not looked at."""
    kill = {"kind": "kill", "at_s": 0.499, "duration_s": 0.002, "nodes": {"ids": ["v02"]}}
    program = "tests.support.window_programs:looks_as_it_begins"
    emulation = run(scenario_of([kill], program, radio=STILL_AIR))
    logs = [(e.node, e.details["text"]) for e in emulation.folder.events if e.kind == "log"]
    assert sorted(logs) == sorted((node, "0 packets") for node in ["v01", "v02", "v02", "v03", "v04"])
    (row,) = [row for row in emulation.engine.trace.to_table().to_pylist() if row["receiver"] == "v02"]
    assert row["outcome"] == "delivered"


@pytest.mark.parametrize("run", [run_together, run_apart, run_forked])
def test_a_program_that_is_ended_has_the_packets_of_its_own_last_instant(
    run: Callable[[Scenario], Emulation],
) -> None:
    restart = {"kind": "restart", "at_s": 1.005, "duration_s": 0.4, "nodes": {"ids": ["v02"]}}
    scenario = scenario_of([restart], "tests.support.window_programs:tells_of_its_mail", radio=STILL_AIR)
    assert same(fingerprint(run(scenario)), fingerprint(run(with_windows(scenario, False))))


# Quiet instants beyond the window.


@pytest.mark.parametrize("program", ["ticks", "looks_once_a_period", "fails_unheard"])
def test_quiet_instants_change_nothing(program: str) -> None:
    """Programs that are ended find what had come by their own last instant; fixes fail and clocks are wrong."""
    faults = [
        {"kind": "restart", "at_s": 1.005, "duration_s": 0.4, "nodes": {"ids": ["v02"]}},
        {"kind": "kill", "at_s": 1.21, "duration_s": 0.5, "nodes": {"ids": ["v03"]}},
        {"kind": "gnss_outage", "at_s": 0.7, "duration_s": 0.9, "nodes": {"ids": ["v04"]}},
        {"kind": "skew", "at_s": 0.9, "duration_s": 0.6, "nodes": {"ids": ["v04"]}, "offset_ms": 30.0},
    ]
    scenario = scenario_of(faults, f"tests.support.window_programs:{program}")
    apart = run_apart(scenario)
    assert same(fingerprint(apart)[:3], fingerprint(simulated(scenario, False))[:3])
    reference = run_apart(with_windows(scenario, False))
    assert same(fingerprint(apart), fingerprint(reference))
    assert apart.costs.wake_ups == reference.costs.wake_ups


def test_a_program_that_looks_once_a_period_is_granted_once_a_period(monkeypatch: pytest.MonkeyPatch) -> None:
    grants: list[int] = []
    receive = Lockstep.receive

    def counts(lockstep: Lockstep, process_id: str, message: wire.Yield) -> None:
        grants.append(message.instants)
        receive(lockstep, process_id, message)

    monkeypatch.setattr(Lockstep, "receive", counts)
    scenario = scenario_of([], "tests.support.window_programs:looks_once_a_period", vehicles=2)
    emulation = run_apart(scenario)
    periods = emulation.duration_ns // emulation.world.period_ns
    assert len(grants) == 2 * (1 + periods), "one more when the run begins"
    assert sum(grants) == 2 * 4 * periods, "a fix and three timers"


# Stepped, with faults that are injected while the run is held.


def stepped(scenario: Scenario, windows: bool, stops_s: Sequence[float]) -> Emulation:
    """Simulate, held at these times; at the first a fault is injected, and at the second it is healed."""
    emulation = emulation_of(with_windows(scenario, windows))
    stops_ns: list[int | None] = [*(round(stop_s * 1e9) for stop_s in stops_s), None]
    reached = iter(range(len(stops_ns)))

    async def before_horizon(lockstep: Lockstep) -> None:
        number = next(reached)
        now_ns = stops_ns[number - 1] if number else 0
        assert now_ns is not None
        if number == 1:
            fault = {"kind": "loss", "probability": 0.5, "at_s": 0.0, "duration_s": 60.0}
            emulation.inject(parse_fault(fault), now_ns - 1)
        if number == 2:
            emulation.heal("loss-0", now_ns - 1)
        lockstep.horizon_ns = stops_ns[number]

    simulate(emulation, before_horizon)
    return emulation


@settings(max_examples=2, deadline=None)
@given(
    stops_ms=st.lists(st.integers(1, 900_000), min_size=2, max_size=4, unique=True).map(sorted),
    latency_ms=st.sampled_from([0.001, 2.0, 250.0]),
)
def test_a_run_that_is_stepped_and_broken_is_the_same_and_replays(stops_ms: list[int], latency_ms: float) -> None:
    run = {"duration_s": 1.4, "settle_s": 0.3}
    scenario = scenario_of([], IMPROVISES, run=run, radio={"latency_ms": latency_ms})
    stops_s = [stop / 1e6 for stop in stops_ms]
    reference = stepped(scenario, False, stops_s)
    subject = stepped(scenario, True, stops_s)
    assert same(fingerprint(subject), fingerprint(reference))
    again = run_together(subject.scenario)
    assert [planned.label for planned in again.faults.faults] == ["loss-0"]
    assert same(fingerprint(again)[:3], fingerprint(subject)[:3])
