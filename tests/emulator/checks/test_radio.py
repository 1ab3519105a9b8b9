"""The checks of a physical radio: what really happened is valid, and every breach of its rules is seen."""

import asyncio
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from emulator.checks.judge import NotExercised, Verdict, check_run, judge
from emulator.drivers.conclude import conclude
from emulator.drivers.simulate import simulate
from emulator.radio.csma import Csma
from emulator.records.recorded_run import RecordedRun
from emulator.records.tables import BUSY
from emulator.scenario.scenario import Scenario
from tests.emulator.checks.test_judge import checked, result, verdict
from tests.support.recorded import prepared
from tests.support.recorded import recorded as record_run
from vnet.errors import VnetError
from vnet.node import Node

pytestmark = pytest.mark.slow

LOG_DISTANCE = {"kind": "log_distance", "tx_power_dbm": 33.0}
Change = Callable[[dict[str, Any], np.ndarray], None]
"""Changes the trace's columns, given which rows arrived."""


def run(folder: Path, faults: list[dict[str, Any]] | None = None, **radio: Any) -> RecordedRun:
    """Twelve beacons within four kilometres for three seconds."""
    scenario = Scenario.model_validate(
        {
            "run": {"duration_s": 3.0, "settle_s": 0.5},
            "network": {"vehicles": 12, "layout": "dense"},
            "program": {"entry": "agents.beacon:main"},
            "radio": {"access_jitter_ms": 5.0, "path_loss": LOG_DISTANCE, **radio},
            "fault": faults or [],
        }
    )
    record_run(scenario, folder)
    done = RecordedRun.open(folder)
    return RecordedRun(scenario, done.trace, done.states, done.metrics, done.events, more={BUSY: done.table(BUSY)})


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> RecordedRun:
    return run(tmp_path_factory.mktemp("shared") / "run", mac={})


@pytest.fixture(scope="module")
def faded(tmp_path_factory: pytest.TempPathFactory) -> RecordedRun:
    return run(tmp_path_factory.mktemp("faded") / "run", fading={}, shadowing={}, mac={}, loss=0.1)


def changed(recorded: RecordedRun, change: Change) -> RecordedRun:
    """The evidence with some columns of the trace changed."""
    trace = recorded.trace
    names = ("sent_ns", "on_air_ns", "left_ns", "arrival_ns", "outcome")
    columns = {
        name: trace[name].cast(pa.string() if name == "outcome" else pa.int64()).to_pylist() for name in names
    }
    change(columns, np.flatnonzero(recorded.arrived))
    for name, values in columns.items():
        column = pa.array(values, pa.string()).dictionary_encode() if name == "outcome" else pa.array(values)
        trace = trace.set_column(trace.column_names.index(name), name, column)
    return replace(recorded, trace=trace)


def became(columns: dict[str, Any], row: int, outcome: str) -> None:
    """Another outcome, that does not arrive."""
    columns["outcome"][row], columns["arrival_ns"][row] = outcome, None


def arrives(row: int) -> Change:
    """Return the change by which one that does not arrive does."""

    def change(columns: dict[str, Any], _: np.ndarray) -> None:
        columns["outcome"][row], columns["arrival_ns"][row] = "delivered", columns["left_ns"][row] + 2_500_000

    return change


def test_what_really_happened_is_valid(shared: RecordedRun, faded: RecordedRun) -> None:
    for recorded in (shared, faded):
        judgement = judge(recorded)
        assert judgement.verdict is Verdict.VALID, [c for c in judgement.checks if c.verdict is not Verdict.VALID]
        assert {"fading", "medium", "latency", "range"} <= {check.name for check in judgement.checks}
        assert recorded.outcome_is("collided").sum() > 10


def test_on_a_disc_neither_is_exercised(tmp_path: Path) -> None:
    emulation = prepared({"run": {"duration_s": 1.0}, "program": {"entry": "agents.beacon:main"}}, tmp_path / "run")
    simulate(emulation)
    judgement, _ = conclude(emulation, 1.0, "simulate")
    left = {check.name: check.reason for check in judgement.not_exercised}
    assert left["fading"] == "unit-disc radio: no fading"
    assert left["medium"] == "no MAC configured ([radio.mac])"
    assert not (tmp_path / "run" / "busy.parquet").exists()


def test_without_a_medium_only_the_fading_is_judged(tmp_path: Path) -> None:
    recorded = run(tmp_path / "run", fading={})
    assert verdict(recorded, "fading") is Verdict.VALID
    assert isinstance(result(recorded, "medium"), NotExercised)
    judgement = judge(recorded)
    assert judgement.verdict is Verdict.VALID, judgement.checks


def test_a_run_in_which_nobody_speaks_is_unknown_and_not_valid(shared: RecordedRun) -> None:
    silent = replace(shared, trace=shared.trace.slice(0, 0))
    assert verdict(silent, "fading") is Verdict.UNKNOWN
    assert verdict(silent, "medium") is Verdict.UNKNOWN


def test_without_fading_one_frame_beyond_the_threshold_is_one_too_many(shared: RecordedRun) -> None:
    hopeless = np.flatnonzero(shared.outcome_is("faded"))[0]
    broken = checked(changed(shared, arrives(int(hopeless))), "fading")
    assert broken.verdict is Verdict.INVALID
    assert broken.figures["impossible"] == 1
    assert broken.figures["rows"][0]["outcome"] == "delivered"
    certain = changed(shared, lambda columns, arrived: became(columns, arrived[0], "faded"))
    assert checked(certain, "fading").figures["impossible"] == 1


def test_with_fading_any_pair_may_do_anything_once(faded: RecordedRun) -> None:
    weakest = int(np.flatnonzero(faded.outcome_is("faded"))[0])
    assert verdict(changed(faded, arrives(weakest)), "fading") is Verdict.VALID


def test_too_much_and_too_little_fading_is_seen_where_no_link_alone_tells(faded: RecordedRun) -> None:
    few = replace(faded, trace=faded.trace.slice(0, faded.trace.num_rows // 4))

    def fade(columns: dict[str, Any], arrived: np.ndarray) -> None:
        for row in arrived[::4].tolist():
            became(columns, row, "faded")

    def arrive(columns: dict[str, Any], arrived: np.ndarray) -> None:
        for row in np.flatnonzero(few.outcome_is("faded")).tolist():
            arrives(row)(columns, arrived)

    for change in (fade, arrive):
        found = checked(changed(few, change), "fading")
        assert (found.verdict, found.figures["links"]) == (Verdict.INVALID, 0)


def test_another_law_than_the_scenarios_is_seen(faded: RecordedRun) -> None:
    """Judge the same trace by a scenario in which senders are 2 dB stronger, or in which nothing is in the way."""
    for update in ({"path_loss": {**LOG_DISTANCE, "tx_power_dbm": 35.0}}, {"shadowing": None}):
        data = faded.scenario.model_dump()
        data["radio"] = {**data["radio"], **update}
        other = replace(faded, scenario=Scenario.model_validate(data))
        assert verdict(other, "fading") is Verdict.INVALID


def test_a_collision_needs_somebody_to_collide_with(shared: RecordedRun) -> None:
    """A pair whose frame was alone on air."""
    began, left = shared.on_air_ns, shared.column("left_ns")
    alone = next(
        row
        for row in np.flatnonzero(shared.outcome_is("delivered")).tolist()
        if not ((began < left[row]) & (left > began[row]) & (shared.emission != shared.emission[row])).any()
    )
    broken = checked(changed(shared, lambda columns, _: became(columns, alone, "collided")), "medium")
    assert broken.verdict is Verdict.INVALID
    assert broken.figures["collided_alone"] == 1


def test_nobody_hears_while_it_sends(shared: RecordedRun) -> None:
    began, left = shared.on_air_ns, shared.column("left_ns")
    deaf = next(
        row
        for row in np.flatnonzero(shared.outcome_is("collided")).tolist()
        if ((shared.sender == shared.receiver[row]) & (began < left[row]) & (left > began[row])).any()
    )
    assert checked(changed(shared, arrives(deaf)), "medium").figures["heard_while_sending"] == 1


def moved(recorded: RecordedRun, row: int, by_ns: int) -> RecordedRun:
    """The frame of a row was on air at another time."""
    rows = np.flatnonzero(recorded.emission == recorded.emission[row])

    def move(columns: dict[str, Any], _: np.ndarray) -> None:
        for each in rows.tolist():
            for name in ("on_air_ns", "left_ns", "arrival_ns"):
                if columns[name][each] is not None:
                    columns[name][each] += by_ns

    return changed(recorded, move)


def test_who_talks_while_another_is_heard_breaks_the_rules(shared: RecordedRun) -> None:
    """The second of two frames that follow each other begins 20 µs after the first."""
    order = np.argsort(shared.on_air_ns, kind="stable")
    first = next(
        row
        for row, after in zip(order, np.roll(order, -1), strict=True)
        if shared.sender[row] != shared.sender[after]
        and 300_000 < shared.on_air_ns[after] - shared.on_air_ns[row] < 900_000
        and shared.sent_ns[after] < shared.on_air_ns[row]
    )
    second = np.roll(order, -1)[np.flatnonzero(order == first)[0]]
    early = moved(shared, second, int(shared.on_air_ns[first] + 20_000 - shared.on_air_ns[second]))
    assert checked(early, "medium").figures["into_others"] > 0


def test_a_sender_pauses_between_its_frames(shared: RecordedRun) -> None:
    again = np.flatnonzero(shared.seq == 1)[0]
    last = np.flatnonzero((shared.sender == shared.sender[again]) & (shared.seq == 0))[0]
    by_ns = int(shared.column("left_ns")[last] + 50_000 - shared.on_air_ns[again])

    def early(columns: dict[str, Any], _: np.ndarray) -> None:
        for row in np.flatnonzero(shared.emission == shared.emission[again]).tolist():
            for name in columns:
                if name != "outcome" and columns[name][row] is not None:
                    columns[name][row] += by_ns

    assert checked(changed(shared, early), "medium").figures["without_pause"] == 1


@pytest.mark.parametrize(
    ("name", "by_ns"), [("on_air_ns", -6_000_000), ("left_ns", -1), ("left_ns", 1), ("on_air_ns", None)]
)
def test_frames_are_on_air_for_their_airtime_after_they_are_sent(
    shared: RecordedRun, name: str, by_ns: int
) -> None:
    def change(columns: dict[str, Any], arrived: np.ndarray) -> None:
        row = int(arrived[5])
        columns[name][row] = None if by_ns is None else columns[name][row] + by_ns

    assert checked(changed(shared, change), "medium").figures["mistimed"] >= 1


def test_arrivals_are_held_to_the_end_of_the_transmission(shared: RecordedRun) -> None:
    def late(columns: dict[str, Any], arrived: np.ndarray) -> None:
        columns["arrival_ns"][int(arrived[3])] += 1_100_000

    def shifted(columns: dict[str, Any], arrived: np.ndarray) -> None:
        for row in arrived.tolist():
            columns["arrival_ns"][row] -= 100_000

    assert checked(changed(shared, late), "latency").figures["late"] == 1
    assert verdict(changed(shared, shifted), "latency") is Verdict.INVALID


def test_the_medium_is_busy_at_least_while_one_sends_oneself(shared: RecordedRun) -> None:
    busy = shared.table(BUSY)
    assert busy is not None
    ratio = pc.multiply(busy["busy_ratio"], 0.001)
    idle = busy.set_column(2, "busy_ratio", ratio)
    assert checked(replace(shared, more={BUSY: idle}), "medium").figures["too_idle"] > 100


def test_who_never_senses_others_sends_when_it_likes_and_is_busy_while_it_sends(tmp_path: Path) -> None:
    """Carrier sense above all that anybody sends with: Aloha."""
    recorded = run(tmp_path / "run", mac={"carrier_sense_dbm": 40.0})
    judgement = judge(recorded)
    assert judgement.verdict is Verdict.VALID, [c for c in judgement.checks if c.verdict is not Verdict.VALID]
    airtime_ns = np.bincount(recorded.sender, recorded.airtime_ns * (recorded.on_air_ns >= 0), minlength=12)
    assert airtime_ns.min() > 0
    assert recorded.busy_ratio.sum(axis=0).min() > 0


def test_frames_held_back_too_briefly_are_seen(tmp_path: Path) -> None:
    pauses = {"kind": "etsi", "pause_ms": (250, 250, 250, 250, 250)}
    held = run(tmp_path / "run", mac={}, congestion=pauses)
    assert judge(held).verdict is Verdict.VALID
    assert held.outcome_is("held_back").sum() > 100
    data = held.scenario.model_dump()
    data["radio"]["congestion"]["pause_ms"] = (400,) * 5
    longer = replace(held, scenario=Scenario.model_validate(data))
    assert checked(longer, "medium").figures["without_pause"] > 10


def test_a_busy_table_that_cannot_be_read_is_said_in_one_line(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    run(folder, mac={})
    assert check_run(folder).verdict is Verdict.VALID
    path = folder / "busy.parquet"
    table = pq.read_table(path)
    spoilt = (
        (table.drop_columns(["node"]), "has no column 'node'"),
        (table.slice(1), "not those of 12 vehicles"),
        (table.set_column(1, "node", pa.array(["x"] * len(table)).dictionary_encode()), "not those of 12 vehicles"),
    )
    for wrong, text in spoilt:
        pq.write_table(wrong, path)
        with pytest.raises(VnetError, match=text):
            check_run(folder)
    path.write_bytes(b"nothing")
    with pytest.raises(VnetError, match=r"busy\.parquet: cannot be read"):
        check_run(folder)
    path.unlink()
    with pytest.raises(VnetError, match=r"there is no busy\.parquet in it"):
        check_run(folder)


# Faults on a physical radio.

FAULTS: list[dict[str, Any]] = [
    {"kind": "block", "senders": {"ids": ["v01"]}, "receivers": {"ids": ["v02", "v03"]}},
    {"kind": "range", "nodes": {"ids": ["v04"]}, "range_m": 600.0},
    {"kind": "loss", "probability": 0.3},
    {"kind": "burst_loss", "senders": {"ids": ["v05", "v06"]}, "enter": 0.3, "leave": 0.3},
    {"kind": "partition", "groups": "halves"},
    {"kind": "delay", "delay_ms": 40.0},
    {"kind": "duplicate", "probability": 0.5, "copies": 2, "delay_ms": 5.0},
    {"kind": "corrupt", "probability": 0.5, "flips": 3},
    {"kind": "throttle", "nodes": {"ids": ["v01", "v02"]}, "bitrate_mbps": 0.02},
    {"kind": "DoS", "nodes": {"ids": ["v03"]}, "factor": 5},
    {"kind": "Sybil", "nodes": {"ids": ["v03"]}, "ghosts": 2},
    {"kind": "DataReplay", "nodes": {"ids": ["v07"]}, "age_s": 0.5},
    {"kind": "StaleMessages", "nodes": {"ids": ["v07"]}, "age_s": 0.5},
    {"kind": "kill", "nodes": {"ids": ["v08"]}},
    {"kind": "pause", "nodes": {"ids": ["v09"]}},
]


@pytest.mark.parametrize("fault", FAULTS, ids=[fault["kind"] for fault in FAULTS])
def test_a_fault_acts_on_a_shared_medium_as_it_says(tmp_path: Path, fault: dict[str, Any]) -> None:
    recorded = run(
        tmp_path / "run", [{"at_s": 0.9, "duration_s": 1.2, **fault}], fading={}, mac={}, access_jitter_ms=60.0
    )
    judgement = judge(recorded)
    assert judgement.verdict is Verdict.VALID, [c for c in judgement.checks if c.verdict is not Verdict.VALID]
    effect = next(check for check in judgement.checks if check.name == f"effect:{fault['kind']}-0")
    assert effect.figures["count"] > 0


def test_a_throttle_that_does_nothing_did_not_bite(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames that wait as long for their jitter are none that it slowed."""
    monkeypatch.setattr(Csma, "throttle", lambda *_: None)
    throttle = {"kind": "throttle", "at_s": 0.9, "duration_s": 1.2, "nodes": {"ids": ["v01", "v02"]}}
    recorded = run(tmp_path / "run", [{**throttle, "bitrate_mbps": 3.0}], fading={}, mac={}, access_jitter_ms=60.0)
    assert verdict(recorded, "effect:throttle-0") is Verdict.UNKNOWN


def test_what_a_fault_keeps_from_a_receiver_is_still_on_air(tmp_path: Path) -> None:
    """A block takes the words and not the signal: as many pairs collide, though nobody hears v01's."""
    block = {"kind": "block", "at_s": 0.0, "duration_s": 2.5, "senders": {"ids": ["v01"]}}
    plain, blocked = run(tmp_path / "a", mac={}), run(tmp_path / "b", [block], mac={})
    assert np.array_equal(plain.on_air_ns, blocked.on_air_ns)
    others = (plain.sender != 0) & (plain.sent_ns < 2_500_000_000)
    assert (plain.trace["outcome"].to_numpy()[others] == blocked.trace["outcome"].to_numpy()[others]).all()
    mine = (blocked.sender == 0) & (blocked.sent_ns < 2_500_000_000)
    assert set(blocked.trace["outcome"].to_numpy()[mine]) == {"fault"}


def test_frames_of_a_period_that_the_run_does_not_complete_are_heard_by_whoever_they_met(tmp_path: Path) -> None:
    """Positions of that period are unknown, and so is who could hear."""
    for seed in (1, 3):
        scenario = Scenario.model_validate(
            {
                "run": {"duration_s": 1.15, "settle_s": 0.0, "seed": seed},
                "network": {"kind": "driven", "vehicles": 20, "driven": {"lanes": 4, "gap_m": 20.0}},
                "radio": {
                    "max_peers": 1000,
                    "path_loss": {"kind": "winner_b1", "tx_power_dbm": 33.0, "floor_dbm": -110.0},
                    "mac": {"kind": "lte-mode4", "subchannels": 1},
                },
                "program": {"entry": f"{__name__}:ticks"},
            }
        )
        record_run(scenario, tmp_path / f"{seed}")
        checks = {each.name: each.verdict for each in judge(RecordedRun.open(tmp_path / f"{seed}")).checks}
        assert checks["medium"] is Verdict.VALID


async def ticks(node: Node) -> None:
    """Send 100 bytes every 50 ms."""
    await asyncio.sleep(float(node.rng.uniform(0, 0.05)))
    while True:
        await node.radio.broadcast(b"x" * 100)
        await asyncio.sleep(0.05)
