"""The checks judge frames to single vehicles, also beside broadcasts and under faults."""

import asyncio
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

import emulator
from emulator.checks.radio import check_medium
from emulator.records.radio_metrics import unicast_figures
from emulator.records.recorded_run import RecordedRun
from emulator.records.verdicts import CheckResult
from vnet import Node

pytestmark = pytest.mark.slow

RADIO: dict[str, Any] = {"path_loss": {"kind": "log_distance", "tx_power_dbm": 33.0}, "mac": {}, "max_peers": 1000}
FAULTS: list[dict[str, Any]] = [
    {"kind": "loss", "at_s": 0.2, "duration_s": 0.3, "probability": 0.3, "nodes": {"count": 8}},
    {"kind": "DoS", "at_s": 0.5, "duration_s": 0.2, "factor": 3, "nodes": ["v01"]},
    {"kind": "duplicate", "at_s": 0.5, "duration_s": 0.3, "probability": 0.5, "nodes": {"count": 8}},
    {"kind": "kill", "at_s": 0.7, "duration_s": 0.2, "nodes": ["v02"]},
    {"kind": "StaleMessages", "at_s": 0.1, "duration_s": 0.4, "age_s": 0.05, "nodes": ["v04"]},
    {"kind": "DataReplay", "at_s": 0.3, "duration_s": 0.3, "age_s": 0.05, "nodes": ["v05"]},
    {"kind": "range", "at_s": 0.9, "duration_s": 0.1, "nodes": ["v03"], "range_m": 1.0},
]


async def mixes(node: Node) -> None:
    """Broadcast and send to another vehicle, at each fix."""
    others = [f"v{number:02d}" for number in range(1, 9) if f"v{number:02d}" != node.id]
    async for _ in node.gnss:
        for _ in range(5):
            await node.radio.broadcast(bytes(200))
            await node.radio.send(str(node.rng.choice(others)), bytes(int(node.rng.integers(20, 600))))
        node.report(heard=len(node.radio.drain()))


def run_of(folder: Path, **sections: Any) -> RecordedRun:
    run = {"duration_s": 1.2, "settle_s": 0.0}
    scenario = {"run": run, "network": {"vehicles": 8, "layout": "dense"}, **sections}
    result = emulator.simulate(scenario, program=mixes, out=folder)
    found = {check.name: check.verdict for check in result.checks}
    assert not [name for name, verdict in found.items() if verdict == "invalid"], found
    for name in ("conservation", "medium", "latency", "isolation"):
        assert found[name] == "valid", (name, found)
    return RecordedRun.open(folder)


async def sends_at_once(node: Node) -> None:
    """v01 sends four frames at one instant to a vehicle that is out of its range; both broadcast."""
    if node.id == "v01":
        results = await asyncio.gather(*(node.radio.send("v02", bytes(100)) for _ in range(4)))
        node.report(attempts=[result.attempts for result in results])
    async for _ in node.gnss:
        await node.radio.broadcast(b"here")


def test_a_frame_that_a_full_queue_drops_was_not_sent_though_its_addressee_is_out_of_range(tmp_path: Path) -> None:
    scenario = {
        "run": {"duration_s": 1.0, "settle_s": 0.0},
        "network": {"kind": "driven", "vehicles": 2, "driven": {"start_m": [4900, 100], "speed_mps": 0}},
        "radio": {"queue_frames": 1, "path_loss": {"kind": "log_distance", "exponent": 3.0}, "mac": {}},
    }
    result = emulator.simulate(scenario, program=sends_at_once, out=tmp_path / "run")
    assert result.verdict == "valid", result.checks
    rows = [row for row in result.trace.to_pylist() if row["attempt"]]
    assert [row["outcome"] for row in rows if row["seq"]] == ["queue_full"] * 3
    assert {row["outcome"] for row in rows if not row["seq"]} == {"out_of_range"}


@pytest.mark.parametrize(
    ("more", "faults"),
    [({"fading": {}, "loss": 0.1}, []), ({}, FAULTS), ({"congestion": {"kind": "etsi"}, "max_peers": 4}, [])],
    ids=["fading", "faults", "congestion and cap"],
)
def test_checks_accept_what_the_radio_does(more: Any, faults: Any, tmp_path: Path) -> None:
    recorded = run_of(tmp_path / "run", radio={**RADIO, **more}, fault=faults)
    figures = unicast_figures(recorded)
    assert figures is not None and figures.sent > 50 and figures.retries > 10
    assert 0 < figures.acknowledged < figures.sent


def test_checks_accept_vehicles_that_come_back_between_attempts(tmp_path: Path) -> None:
    """Each is down for a millisecond or nine, in turn, while the others send to it."""
    kills = [
        {
            "kind": "kill",
            "at_s": 0.005 + 0.006 * n,
            "duration_s": 0.001 * (1 + n % 3 * 4),
            "nodes": [f"v{n % 8 + 1:02d}"],
        }
        for n in range(60)
    ]
    scenario = {
        "run": {"duration_s": 0.4, "settle_s": 0.0},
        "network": {"vehicles": 8, "layout": "dense"},
        "radio": {**RADIO, "loss": 0.3},
        "fault": kills,
    }
    result = emulator.simulate(scenario, program=mixes, out=tmp_path / "run")
    assert not [check for check in result.checks if check.verdict == "invalid"]
    rows = [row for row in RecordedRun.open(tmp_path / "run").trace.to_pylist() if row["attempt"] > 1]
    assert {"receiver_down", "delivered", "duplicate"} <= {row["outcome"] for row in rows}


def test_a_broken_exchange_is_found(tmp_path: Path) -> None:
    recorded = run_of(tmp_path / "run", radio={**RADIO, "loss": 0.2})
    assert badly_acknowledged(recorded) == 0
    rows = recorded.trace.to_pylist()
    acked = next(row for row in rows if row["acked"])
    again = next(row for row in rows if row["attempt"] == 3)
    for row, change in (
        (acked, {"ack_on_air_ns": acked["ack_on_air_ns"] + 13_000}),
        (acked, {"ack_on_air_ns": None}),
        (again, {"attempt": 9}),
        (again, {"outcome": "duplicate" if again["outcome"] != "duplicate" else "delivered"}),
    ):
        forged = [{**each, **change} if each is row else each for each in rows]
        table = pa.Table.from_pylist(forged, schema=recorded.trace.schema)
        changed = RecordedRun(recorded.scenario, table, recorded.states, recorded.metrics, recorded.events)
        assert badly_acknowledged(changed) >= 1, change


def badly_acknowledged(recorded: RecordedRun) -> int:
    found = check_medium(recorded)
    assert isinstance(found, CheckResult)
    return int(found.figures["badly_acknowledged"])
