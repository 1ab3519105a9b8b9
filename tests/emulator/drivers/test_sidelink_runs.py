"""Whole runs on sidelinks: live processes, windows and faults change nothing, and the checks find nothing."""

from pathlib import Path
from typing import Any

import pytest

import emulator
from emulator.checks.judge import check_run
from emulator.records.recorded_run import ON_AIR
from tests.support.multi_loop_driver import run_other_ways, run_together, scenario_of
from vnet import Node
from vnet.units import NS_PER_MS

pytestmark = pytest.mark.slow

FAULTS: list[dict[str, Any]] = [
    {"kind": "kill", "at_s": 0.5, "duration_s": 0.5, "nodes": {"ids": ["v02"]}},
    {"kind": "pause", "at_s": 0.9, "duration_s": 0.2, "nodes": {"ids": ["v03"]}},
    {"kind": "loss", "at_s": 0.3, "duration_s": 1.0, "probability": 0.2},
    {"kind": "delay", "at_s": 0.3, "duration_s": 1.0, "delay_ms": 1.5},
    {"kind": "duplicate", "at_s": 0.7, "duration_s": 0.5, "probability": 0.3},
    {"kind": "corrupt", "at_s": 0.6, "duration_s": 0.5, "probability": 0.3},
    {"kind": "throttle", "at_s": 0.2, "duration_s": 1.0, "bitrate_mbps": 0.05, "nodes": {"ids": ["v04"]}},
    {"kind": "DoS", "at_s": 0.8, "duration_s": 0.5, "factor": 3, "nodes": {"ids": ["v01"]}},
    {"kind": "DataReplay", "at_s": 0.9, "duration_s": 0.5, "age_s": 0.3, "nodes": {"ids": ["v01"]}},
]
MACS: list[dict[str, Any]] = [
    {"kind": "lte-mode4", "one_shot": True, "retransmit": True},
    {"kind": "nr-mode2", "scs_khz": 60, "t1_slots": 9},
    {"kind": "nr-mode2", "scheduling": "dynamic", "scs_khz": 15, "t1_slots": 1},
]
PATH_LOSS = {"kind": "winner_b1", "tx_power_dbm": 40.0}


def radio(mac: dict[str, Any], **more: Any) -> dict[str, Any]:
    return {"path_loss": PATH_LOSS, "shadowing": {}, "fading": {}, "access_jitter_ms": 5.0, "mac": mac, **more}


@pytest.mark.parametrize(
    ("mac", "latency_ms"), [*zip(MACS, [7.0, 0.5, 7.0], strict=True)], ids=["mode 4", "mode 2", "dynamic"]
)
def test_live_processes_do_what_their_simulation_does(mac: dict[str, Any], latency_ms: float) -> None:
    sections = {"run": {"duration_s": 1.6, "settle_s": 0.1}, "radio": radio(mac, latency_ms=latency_ms)}
    program = "tests.support.window_programs:improvises"
    scenario = scenario_of(FAULTS, program, 5, network={"layout": "dense"}, **sections)
    expected = run_together(scenario).engine.trace.sha256()
    assert [other.engine.trace.sha256() for other in run_other_ways(scenario)] == [expected] * 3


@pytest.mark.parametrize("mac", MACS, ids=["mode 4", "mode 2", "dynamic"])
def test_checks_find_nothing_with_faults_buildings_and_units(mac: dict[str, Any], tmp_path: Path) -> None:
    wall = tmp_path / "wall.csv"
    wall.write_text("building,x_m,y_m\n1,-20,-20\n1,20,-20\n1,20,20\n1,-20,20\n")
    scenario = {
        "run": {"duration_s": 3.0, "settle_s": 0.5, "seed": 5},
        "network": {"vehicles": 12, "layout": "dense"},
        "radio": {**radio(mac, max_peers=1000), "buildings": {"path": str(wall)}},
        "roadside": [{"id": "u1", "position_m": [0.0, 30.0], "height_m": 6.0, "tx_power_dbm": 23.0}],
        "program": {"entry": "agents.beacon:main"},
        "fault": FAULTS,
    }
    run = emulator.simulate(scenario, out=tmp_path / "run")
    assert run.verdict == "valid", run
    outcomes = run.trace.to_pydict()["outcome"]
    assert {"delivered", "fault", "below_sensing"} <= {*outcomes}


def test_a_frame_is_complete_at_once_if_congestion_control_forbids_the_second_transmission(tmp_path: Path) -> None:
    """Congestion control decides about both before the first has arrived."""
    scenario = {
        "run": {"duration_s": 3.0, "settle_s": 0.2},
        "network": {"vehicles": 12, "layout": "dense"},
        "radio": {
            "path_loss": PATH_LOSS,
            "access_jitter_ms": 90.0,
            "mac": {"kind": "lte-mode4", "retransmit": True},
            "congestion": {"kind": "cr_limit", "busy": [0.0], "most": [0.00125]},
        },
        "program": {"entry": "agents.beacon:main"},
    }
    run = emulator.simulate(scenario, out=tmp_path / "run")
    assert run.verdict == "valid", run
    assert {*run.trace.to_pydict()["outcome"]} >= {"delivered", "no_grant"}


def test_a_unit_that_vehicles_hear_and_do_not_reach_finds_them_deaf_while_they_send(tmp_path: Path) -> None:
    """Frames that nobody is in range of have no rows: checks cannot ask whether somebody sent one."""
    (tmp_path / "at.csv").write_text("id,x_m,y_m,heading_rad\n" + "".join(f"c{n},{n},0,0\n" for n in (600, 1500)))
    for kind, jitter_ms, outcome in (("lte-mode4", 90.0, "half_duplex"), ("80211p", 1.0, "collided")):
        scenario = {
            "run": {"duration_s": 15.0, "settle_s": 0.5},
            "network": {"kind": "file", "path": str(tmp_path / "at.csv")},
            "radio": {
                "access_jitter_ms": jitter_ms,
                "path_loss": {"kind": "winner_b1", "tx_power_dbm": 10.0},
                "mac": {"kind": kind},
            },
            "roadside": [{"position_m": [0.0, 0.0], "tx_power_dbm": 30.0}],
            "program": {"entry": "agents.beacon:main"},
        }
        run = emulator.simulate(scenario, out=tmp_path / kind)
        assert outcome in run.trace.to_pydict()["outcome"]
        assert run.verdict == "valid", run
        assert check_run(tmp_path / kind).verdict.value == "valid"


async def mixes(node: Node) -> None:
    """Send short and long frames by turns; but one vehicle sends long ones alone."""
    async for fix in node.gnss:
        is_long = node.id == "v01" or fix.time_ns // (100 * NS_PER_MS) % 2
        await node.radio.broadcast(bytes(600 if is_long else 100), period_ms=200)


def test_fading_of_short_frames_on_the_resources_of_long_ones_is_not_judged(tmp_path: Path) -> None:
    """They go out on more subchannels than they need, with the power spread over them."""
    scenario = {
        "run": {"duration_s": 5.0, "settle_s": 0.5},
        "network": {"vehicles": 20, "layout": "dense"},
        "radio": {
            "path_loss": {"kind": "winner_b1", "tx_power_dbm": 33.0, "floor_dbm": -110.0},
            "max_peers": 1000,
            "mac": {"kind": "nr-mode2"},
            "fading": {},
        },
    }
    run = emulator.simulate(scenario, program=mixes, out=tmp_path / "run")
    (fading,) = (each for each in run.checks if each.name == "fading")
    assert run.verdict == "valid" and fading.figures["faded"] > 10
    of_v01 = sum(row["sender"] == "v01" and row["outcome"] in ON_AIR for row in run.trace.to_pylist())
    assert 0 < fading.figures["pairs"] <= of_v01
    assert check_run(tmp_path / "run").verdict.value == "valid", "the periods that it told are in the trace"


CHOICES: dict[str, dict[str, Any]] = {
    "rate": {"rate_mbps": 6.0},
    "period": {"period_ms": 30.0},
    "none": {"period_ms": -1},
}


async def asks(node: Node) -> None:
    """Try what only some radios have."""
    for call in ("send", *CHOICES):
        try:
            if call == "send":
                await node.radio.send("v02", b"x")
            else:
                await node.radio.broadcast(b"x", **CHOICES[call])
            node.event(call, ok=True)
        except ValueError as error:
            node.event(call, error=str(error))
    await node.radio.broadcast(b"x", period_ms=50)
    async for _ in node.gnss:
        node.event("busy", ratio=-1.0 if node.radio.busy_ratio is None else node.radio.busy_ratio)


def test_programs_are_told_what_a_sidelink_does_not_have(tmp_path: Path) -> None:
    said: dict[str, dict[str, Any]] = {}
    for mac in ({"kind": "lte-mode4"}, {}):
        scenario = {"network": {"vehicles": 2}, "run": {"duration_s": 1.0, "settle_s": 0.0}, "radio": {"mac": mac}}
        run = emulator.simulate(scenario, program=asks, out=tmp_path / mac.get("kind", "80211p"))
        told = [event.details for event in run.events if event.kind == "event" and event.node == "v01"]
        said[mac.get("kind", "80211p")] = {each["name"]: each["details"] for each in told}
    lte, csma = said["lte-mode4"], said["80211p"]
    assert "802.11p" in lte["send"]["error"] and "802.11p" in lte["rate"]["error"]
    assert "allowed are 20, 50, 100" in lte["period"]["error"] and lte["busy"]["ratio"] >= 0
    assert csma["send"]["ok"] and csma["rate"]["ok"] and csma["period"]["ok"]
    assert "allowed are" in lte["none"]["error"] and "above 0" in csma["none"]["error"]


def test_window_is_as_long_as_a_frame_takes_at_least() -> None:
    plan = scenario_of([], "agents.beacon:main", 3, radio=radio({"kind": "lte-mode4"}, latency_ms=2.0))
    emulation = run_together(plan)
    rows = emulation.engine.trace.to_table().to_pylist()
    assert rows and min(row["arrival_ns"] - row["sent_ns"] for row in rows if row["arrival_ns"]) > 6 * NS_PER_MS
