"""Runs with faults are judged from their files: what a fault should do and did not, or the reverse, is found."""

import asyncio
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from emulator.checks.faults import _wrong_fixes, check_pause_respected
from emulator.checks.judge import CheckResult, NotExercised, RecordedRun, Verdict, judge
from emulator.records.events import Event
from emulator.records.tables import STATES
from emulator.scenario.faults import KINDS, parse_fault
from emulator.scenario.scenario import Scenario
from tests.emulator.checks.test_judge import checked, damaged, result, run_scenario, timely, verdict
from tests.support.exchange_programs import exchange_run
from tests.support.motion import scenario_of_trips, still, write_trips
from vnet.errors import ScenarioError
from vnet.node import Node

NEEDED: dict[str, dict[str, Any]] = {
    "loss": {"probability": 0.5},
    "delay": {"delay_ms": 200.0},
    "jitter": {"jitter_ms": 100.0},
    "throttle": {"bitrate_mbps": 0.02},
    "range": {"range_m": 500.0},
    "gnss_jump": {"offset_m": [5.0, 5.0]},
    "gnss_ramp": {"rate_m_s": [1.0, 0.0]},
    "skew": {"offset_ms": 30.0},
    "drift": {"rate_ppm": 20_000.0},
    "block": {"senders": {"count": 3}},
    "burst_loss": {"enter": 0.3, "leave": 0.3},
    "custom": {"rule": "tests.support.rules:everything", "name": "custom"},
    "custom_sender": {"rule": "tests.support.rules:babbles", "name": "custom_sender"},
}
OF_LINKS = (
    "partition", "block", "loss", "burst_loss", "delay", "jitter", "reorder", "duplicate", "corrupt", "custom",
)  # fmt: skip
RESTARTS = ("emulator_restart", "router_restart")
AT_S, DURATION_S = 2.0, 2.0


async def hears(node: Node) -> None:
    """Talk, listen, and report how many packets came since the last report."""
    async for fix in node.gnss:
        await node.radio.broadcast(b"at " + str(fix.time_ns).encode())
        node.report(fix.position_m, fix.covariance_m2, heard=len(node.radio.drain()))


def fault(kind: str, **more: Any) -> dict[str, Any]:
    described = {"kind": kind, "at_s": AT_S, "duration_s": DURATION_S, **NEEDED.get(kind, {}), **more}
    if kind not in (*OF_LINKS, *RESTARTS):
        described.setdefault("nodes", {"count": 4})
    return described


def simulated(
    *faults: dict[str, Any],
    program: str = f"{__name__}:hears",
    options: dict[str, Any] | None = None,
    **sections: Any,
) -> RecordedRun:
    """Eight vehicles for six seconds."""
    settings = {
        "run": {"duration_s": 6.0, "settle_s": 2.0},
        "network": {"vehicles": 8},
        "radio": {"loss": 0.1},
        "program": {"entry": program, "options": options or {}},
        "fault": list(faults),
    }
    with TemporaryDirectory() as folder:
        return run_scenario(Path(folder) / "run", Scenario.model_validate({**settings, **sections}))


@cache
def with_fault(kind: str) -> RecordedRun:
    """A run with one fault of a kind; the same for all tests."""
    return simulated(fault(kind))


def not_valid(recorded: RecordedRun) -> dict[str, Verdict]:
    checks = judge(recorded).checks
    return {check.name: check.verdict for check in checks if check.verdict is not Verdict.VALID}


def shifted(recorded: RecordedRun, seconds: float) -> RecordedRun:
    """Return the same files, as if their fault had been planned at another time."""
    first = recorded.scenario.fault[0]
    moved = first.model_copy(update={"at_s": first.at_s + seconds})
    return replace(recorded, scenario=recorded.scenario.model_copy(update={"fault": (moved,)}))


def with_cells(table: pa.Table, column: str, rows: Any, value: Any) -> pa.Table:
    """A table with other values in some rows of a column; times of arrival are made to fit outcomes."""
    values = table[column].to_pylist()
    for row in np.atleast_1d(rows).tolist():
        values[row] = value
    kind = table.schema.field(column).type
    plain = pa.array(values, pa.string()).dictionary_encode() if pa.types.is_dictionary(kind) else None
    changed = table.set_column(table.column_names.index(column), column, plain or pa.array(values, kind))
    return timely(changed) if column == "outcome" else changed


def without_reports(recorded: RecordedRun, node: str, from_s: float) -> RecordedRun:
    """The states as if a node had reported nothing any more."""
    empty = {name: None for name in STATES.columns if name.endswith(("estimate_m", "covariance_m2"))}
    empty |= dict.fromkeys(recorded.value_names)
    rows = [
        {**row, **empty, "values": []} if row["node"] == node and row["time_ns"] >= from_s * 1e9 else row
        for row in recorded.states.to_pylist()
    ]
    return replace(recorded, states=pa.Table.from_pylist(rows, schema=recorded.states.schema))


def some(recorded: RecordedRun, *outcomes: str, cause: str = "", copies: bool = False) -> np.ndarray:
    """The rows with these outcomes, of this cause."""
    named = np.array(recorded.trace["cause"].to_pylist()) == cause
    return np.flatnonzero(recorded.outcome_is(*outcomes) & named & ((recorded.copy > 0) == copies))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_run_with_a_fault_of_any_kind_is_valid_and_the_fault_took_effect(kind: str) -> None:
    recorded = with_fault(kind)
    assert not_valid(recorded) == {}
    effect = result(recorded, f"effect:{kind}-0")
    cannot_show = kind in ("skew", "drift", *RESTARTS)  # this program sends at each fix, whatever its clock says
    assert isinstance(effect, NotExercised if cannot_show else CheckResult)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["skew", "drift"])
def test_a_bent_clock_shows_where_a_program_sends_by_its_clock(kind: str) -> None:
    recorded = simulated(fault(kind), program=f"{__name__}:sends_by_the_clock")
    assert not_valid(recorded) == {}
    assert verdict(recorded, f"effect:{kind}-0") is Verdict.VALID


async def sends_by_the_clock(node: Node) -> None:
    """Send every 100 ms of one's own clock."""
    while True:
        await asyncio.sleep(0.1 - (node.now_ns + 60_000_000) % 100_000_000 / 1e9)
        await node.radio.broadcast(b"tick")


@pytest.mark.slow
def test_many_faults_at_once_are_told_apart() -> None:
    kinds: tuple[str, ...] = (
        "partition", "kill", "pause", "loss", "burst_loss", "duplicate", "corrupt", "delay", "jitter", "DoS",
    )  # fmt: skip
    kinds += ("Sybil", "DataReplay", "StaleMessages", "swizzle", "range", "throttle", "gnss_outage", "gnss_jump")
    faults = [fault(kind, at_s=0.5 + 0.1 * place) for place, kind in enumerate(kinds)]
    recorded = simulated(*faults, radio={"loss": 0.1, "max_peers": 3, "queue_frames": 3, "delivery_tick_us": 100})
    invalid = {name for name, verdict in not_valid(recorded).items() if verdict is Verdict.INVALID}
    assert invalid == set()


@pytest.mark.slow
@pytest.mark.parametrize("queue_frames", [2, 64])
def test_what_a_throttle_left_waiting_does_not_make_later_frames_too_early(queue_frames: int) -> None:
    slow = [fault("throttle", bitrate_mbps=0.0005), fault("throttle", bitrate_mbps=0.002, at_s=4.0, duration_s=1.0)]
    recorded = simulated(*slow, run={"duration_s": 8.0, "settle_s": 2.0}, radio={"queue_frames": queue_frames})
    assert not_valid(recorded) == {}


@pytest.mark.slow
def test_stale_frames_that_were_cut_tell_nothing_of_what_was_said() -> None:
    faults = [fault("StaleMessages", at_s=1.0, duration_s=3.0), fault("DataReplay", at_s=2.0), fault("block")]
    everybody = [{**described, "nodes": {}, "senders": {}} for described in faults[2:]]
    for described in faults[:2]:
        described["nodes"] = {}
    assert Verdict.INVALID not in not_valid(simulated(*faults[:2], *everybody)).values()


@pytest.mark.slow
def test_a_fault_that_was_healed_before_it_began_leaves_nothing_to_see() -> None:
    recorded = simulated(fault("kill", duration_s=1e-10))
    assert not_valid(recorded) == {}
    found = result(recorded, "effect:kill-0")
    assert isinstance(found, NotExercised)
    assert "less than a nanosecond" in found.reason, "as one that a scenario has, and nobody healed"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "holding"), [("DoS", "kill"), ("Sybil", "pause"), ("DataReplay", "pause"), ("StaleMessages", "kill")]
)
def test_a_vehicle_that_other_faults_keep_down_need_not_be_seen_to_misbehave(kind: str, holding: str) -> None:
    whom = {"nodes": {"ids": ["v01"]}}
    held = simulated(fault(kind, **whom), fault(holding, at_s=1.5, duration_s=1.0, **whom), fault(holding, **whom))
    assert not_valid(held) == {}
    assert isinstance(result(held, f"effect:{kind}-0"), NotExercised)
    freed = simulated(fault(kind, **whom), fault(holding, at_s=1.5, duration_s=2.4, **whom))
    assert not isinstance(result(freed, f"effect:{kind}-0"), NotExercised)


@pytest.mark.parametrize("kind", ["partition", "block", "range", "swizzle"])
def test_a_pair_that_passed_a_cut_is_found(kind: str) -> None:
    recorded = with_fault(kind)
    row = some(recorded, "fault", cause=f"{kind}-0")[5]
    forged = with_cells(with_cells(recorded.trace, "cause", row, ""), "outcome", row, "delivered")
    found = damaged(recorded, forged)
    assert set(found) == {"partition_respected"}
    assert [shown["seq"] for shown in found["partition_respected"].figures["rows"]] == [int(recorded.seq[row])]


@pytest.mark.parametrize("cause", ["", "meteor-7", "partition-1"])
def test_a_pair_that_no_fault_explains_is_found(cause: str) -> None:
    recorded = with_fault("partition")
    row = some(recorded, "fault", cause="partition-0")[0]
    assert set(damaged(recorded, with_cells(recorded.trace, "cause", row, cause))) == {"causes"}


@pytest.mark.slow
@pytest.mark.parametrize(
    "more",
    [{"kind": "corrupt", "probability": 0.5}, {"kind": "custom", "rule": "tests.support.rules:everything"}],
    ids=["corrupt", "custom"],
)
def test_a_fault_may_alter_a_retry_of_what_had_arrived(tmp_path: Path, more: dict[str, Any]) -> None:
    recorded = exchange_run(tmp_path, [{"at_s": 0.1, "duration_s": 0.6, **more}])
    assert "duplicate" in recorded.trace["outcome"].to_numpy()[recorded.cause >= 0]
    assert Verdict.INVALID not in not_valid(recorded).values()


def test_a_fault_outside_its_time_or_its_links_is_found() -> None:
    recorded = with_fault("block")
    outside = some(recorded, "lost")[0]
    assert recorded.sent_ns[outside] < AT_S * 1e9
    forged = with_cells(with_cells(recorded.trace, "outcome", outside, "fault"), "cause", outside, "block-0")
    assert set(damaged(recorded, forged)) == {"causes"}
    links = recorded.plan[0].links
    assert links is not None
    free = ~links[recorded.sender, recorded.receiver]
    within = np.flatnonzero(free & recorded.outcome_is("lost") & (abs(recorded.sent_ns / 1e9 - 3) < 0.9))[0]
    forged = with_cells(with_cells(recorded.trace, "outcome", within, "fault"), "cause", within, "block-0")
    assert set(damaged(recorded, forged)) == {"causes"}


@pytest.mark.slow
def test_without_faults_nothing_may_be_their_doing() -> None:
    recorded = simulated()
    assert isinstance(result(recorded, "causes"), NotExercised)
    row = some(recorded, "lost")[0]
    assert set(damaged(recorded, with_cells(recorded.trace, "outcome", row, "fault"))) == {"causes"}


@pytest.mark.parametrize("kind", ["kill", "restart"])
def test_a_packet_for_a_node_that_is_down_is_found(kind: str) -> None:
    recorded = with_fault(kind)
    for outcomes in (("receiver_down", "delivered"), ("delivered", "receiver_down")):
        row = some(recorded, outcomes[0])[7]
        forged = damaged(recorded, with_cells(recorded.trace, "outcome", row, outcomes[1]))
        assert set(forged) == {"down_respected"}
        assert len(forged["down_respected"].figures["rows"]) == 1


def test_frames_and_reports_of_nodes_that_should_be_down_are_found() -> None:
    found = not_valid(shifted(with_fault("kill"), -1.0))
    assert found["down_respected"] is Verdict.INVALID
    figures = checked(shifted(with_fault("kill"), -1.0), "down_respected").figures
    assert min(figures["spoke"], figures["reports"], figures["missed"]) > 0


@pytest.mark.parametrize(("kind", "check"), [("kill", "down_respected"), ("pause", "pause_respected")])
def test_where_the_machine_did_not_keep_up_frames_may_come_late(kind: str, check: str) -> None:
    early = shifted(with_fault(kind), -0.5)
    gap = Event(0, "transport_gap", "v01", {"count": 1})
    assert not_valid(early)[check] is Verdict.INVALID
    assert not_valid(replace(early, events=[*early.events, gap]))[check] is Verdict.UNKNOWN


def test_a_node_that_does_not_stand_still_is_found() -> None:
    early = shifted(with_fault("pause"), -0.5)
    assert not_valid(early)["pause_respected"] is Verdict.INVALID
    figures = checked(early, "pause_respected").figures
    assert (figures["spoke"] > 0, figures["reports"]) == (True, 4 * 5)


@pytest.mark.parametrize("seconds", [-0.5, 0.5])
def test_a_fix_in_an_outage_or_none_without_is_found(seconds: float) -> None:
    moved = shifted(with_fault("gnss_outage"), seconds)
    assert not_valid(moved) == {"outage_respected": Verdict.INVALID, "fault_events": Verdict.INVALID}
    assert len(checked(moved, "outage_respected").figures["rows"]) == 10


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["loss", "burst_loss"])
def test_a_fault_that_loses_too_little_or_too_much_is_found(kind: str) -> None:
    recorded = with_fault(kind)
    label = f"{kind}-0"
    hit = some(recorded, "fault", cause=label)
    spared = with_cells(recorded.trace, "cause", hit[: 4 * len(hit) // 5], "")
    spared = with_cells(spared, "outcome", hit[: 4 * len(hit) // 5], "delivered")
    assert set(damaged(recorded, spared)) == {f"loss_rate:{label}"}
    passed = [row for row in some(recorded, "delivered") if AT_S <= recorded.sent_ns[row] / 1e9 < AT_S + DURATION_S]
    more = with_cells(recorded.trace, "cause", passed[:150], label)
    more = with_cells(more, "outcome", passed[:150], "fault")
    assert f"loss_rate:{label}" in damaged(recorded, more)


@pytest.mark.slow
@pytest.mark.parametrize("late_ms", [0.5, 40.0])
@pytest.mark.parametrize("kind", ["gnss_jump", "delay", "throttle"])
def test_an_arrival_that_is_too_early_or_too_late_is_found(kind: str, late_ms: float) -> None:
    recorded = with_fault(kind)
    row = some(recorded, "delivered")[3]
    arrival_ns = int(recorded.sent_ns[row] + late_ms * 1e6)
    found = damaged(recorded, with_cells(recorded.trace, "arrival_ns", row, arrival_ns))
    assert set(found) == {"latency"}
    assert len(found["latency"].figures["rows"]) == 1


@pytest.mark.slow
def test_latencies_that_are_all_possible_and_together_are_not() -> None:
    recorded = with_fault("gnss_jump")
    arrived = np.flatnonzero(recorded.arrived)
    arrivals = recorded.trace["arrival_ns"].to_pylist()
    for row in arrived.tolist():
        arrivals[row] = int(recorded.sent_ns[row]) + 2_500_000
    index = recorded.trace.column_names.index("arrival_ns")
    assert set(damaged(recorded, recorded.trace.set_column(index, "arrival_ns", pa.array(arrivals)))) == {"latency"}


def test_a_delay_that_a_fault_owed_is_missed() -> None:
    """Had the delay been planned half a second earlier, those frames came too early."""
    found = not_valid(shifted(with_fault("delay"), -0.5))
    assert found == {"latency": Verdict.INVALID, "fault_events": Verdict.INVALID}


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("kind", "key"), [("gnss_jump", "offset_m"), ("ConstPosOffset", "offset_m"), ("gnss_ramp", "rate_m_s")]
)
def test_offsets_of_fixes_are_judged_as_far_as_they_may_be_and_refused_beyond(kind: str, key: str) -> None:
    limit = {"offset_m": 1e8, "rate_m_s": 1e3}[key]
    for sigma_m in (0.0, 2.0):
        recorded = simulated(fault(kind, **{key: [limit, -limit]}), world={"gnss": {"sigma_m": sigma_m}})
        assert verdict(recorded, "gnss") is Verdict.VALID
    for beyond in (limit * 1.1, -1e18, 1e300):
        with pytest.raises(ScenarioError, match=key):
            parse_fault(fault(kind, **{key: [0.0, beyond]}))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["gnss_jump", "duplicate", "DoS", "DataReplay"])
def test_other_bytes_than_were_sent_are_found(kind: str) -> None:
    recorded = with_fault(kind)
    copies = kind != "gnss_jump"
    row = some(recorded, "delivered", cause=f"{kind}-0" if copies else "", copies=copies)[2]
    assert set(damaged(recorded, with_cells(recorded.trace, "payload_digest", row, 12345))) == {"isolation"}


@pytest.mark.slow
def test_a_stale_frame_of_another_age_is_found() -> None:
    recorded = with_fault("StaleMessages")
    label = "StaleMessages-0"
    rows = np.concatenate([some(recorded, outcome, cause=label) for outcome in ("delivered", "lost")])
    same = rows[recorded.frame[rows] == recorded.frame[rows[0]]]
    assert len(same) > 1
    assert set(damaged(recorded, with_cells(recorded.trace, "payload_digest", same, 12345))) == {"isolation"}


@pytest.mark.slow
def test_a_program_that_heard_more_than_arrived_is_found() -> None:
    recorded = with_fault("partition")
    rows = recorded.states.to_pylist()
    rows[-1]["heard"] = 2000.0
    found = not_valid(replace(recorded, states=pa.Table.from_pylist(rows, schema=recorded.states.schema)))
    assert found == {"isolation": Verdict.INVALID}


def test_copies_without_a_cause_or_with_a_number_missing_break_conservation() -> None:
    recorded = with_fault("DoS")
    row = some(recorded, "delivered", cause="DoS-0", copies=True)[0]
    assert set(damaged(recorded, with_cells(recorded.trace, "cause", row, ""))) == {"conservation"}
    kept = recorded.trace.filter(pa.array(recorded.emission != recorded.emission[row]))
    assert damaged(recorded, kept)["conservation"].figures["missing_frames"] == 1
    assert set(damaged(recorded, kept)) == {"conservation", "copies"}


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["DoS", "Sybil"])
def test_a_frame_that_was_not_sent_as_often_as_it_should_be_is_found(kind: str) -> None:
    recorded = with_fault(kind)
    rows = some(recorded, "delivered", "lost", cause=f"{kind}-0", copies=True)
    last = rows[recorded.copy[rows] == recorded.copy.max()][0]
    kept = recorded.trace.filter(pa.array(recorded.emission != recorded.emission[last]))
    found = damaged(recorded, kept)
    assert set(found) == {"copies"}
    assert found["copies"].figures["miscounted"] == 1


@pytest.mark.parametrize(
    ("kind", "planned"), [("DoS", {"factor": 9}), ("Sybil", {"ghosts": 2}), ("DataReplay", {"age_s": 0.9})]
)
def test_a_frame_that_was_sent_more_often_or_later_than_planned_is_found(
    kind: str, planned: dict[str, Any]
) -> None:
    scenario = with_fault(kind).scenario
    assert {key: getattr(scenario.fault[0], key) for key in planned} != planned
    other = scenario.model_copy(update={"fault": (scenario.fault[0].model_copy(update=planned),)})
    assert not_valid(replace(with_fault(kind), scenario=other)) == {"copies": Verdict.INVALID}


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "key"), [("gnss_jump", "offset_m"), ("gnss_ramp", "rate_m_s")])
def test_fixes_that_stray_otherwise_than_they_should_are_found(kind: str, key: str) -> None:
    recorded = with_fault(kind)
    less = recorded.scenario.fault[0].model_copy(update={key: (4.0, 2.0)})
    scenario = recorded.scenario.model_copy(update={"fault": (less,)})
    assert not_valid(replace(recorded, scenario=scenario)) == {"gnss": Verdict.INVALID}
    assert checked(replace(recorded, scenario=scenario), "gnss").figures["rows"][0]["under"] == f"{kind}-0"


def test_a_receiver_that_is_too_good_or_too_bad_is_found() -> None:
    recorded = with_fault("partition")
    for sigma_m in (0.8, 1.3):
        gnss = recorded.scenario.world.gnss.model_copy(update={"sigma_m": sigma_m})
        world = recorded.scenario.world.model_copy(update={"gnss": gnss})
        forged = replace(recorded, scenario=recorded.scenario.model_copy(update={"world": world}))
        assert not_valid(forged) == {"gnss": Verdict.INVALID}


@pytest.mark.slow
def test_bytes_that_a_corruption_left_alone_show_none() -> None:
    recorded = with_fault("corrupt")
    rows = some(recorded, "delivered", cause="corrupt-0")
    said = {int(recorded.frame[row]): int(recorded.digest[row]) for row in some(recorded, "delivered", "lost")}
    digests = recorded.trace["payload_digest"].to_pylist()
    for row in rows.tolist():
        digests[row] = said.get(int(recorded.frame[row]), digests[row])
    index = recorded.trace.column_names.index("payload_digest")
    spared = recorded.trace.set_column(index, "payload_digest", pa.array(digests, pa.uint64()))
    assert not_valid(replace(recorded, trace=spared)) == {"effect:corrupt-0": Verdict.UNKNOWN}


def test_a_copy_of_nothing_breaks_conservation() -> None:
    recorded = with_fault("duplicate")
    row = some(recorded, "delivered", cause="duplicate-0", copies=True)[0]
    found = damaged(recorded, with_cells(recorded.trace, "seq", row, 59))
    assert found["conservation"].figures["orphans"] == 1


def test_an_arrival_before_the_sending_or_without_a_time_breaks_conservation() -> None:
    recorded = with_fault("gnss_jump")
    row = some(recorded, "delivered")[0]
    for arrival_ns, checks in ((None, {"conservation"}), (int(recorded.sent_ns[row]), {"conservation", "latency"})):
        found = damaged(recorded, with_cells(recorded.trace, "arrival_ns", row, arrival_ns))
        assert set(found) == checks
        assert found["conservation"].figures["mistimed"] == 1


@pytest.mark.slow
def test_faults_that_act_on_nobody_are_unknown() -> None:
    kinds = [kind for kind in KINDS if kind not in (*RESTARTS, "skew", "drift", "partition")]
    nowhere = {"disc": [1e7, 1e7, 1.0]}
    faults = [fault(kind, **{"receivers" if kind in OF_LINKS else "nodes": nowhere}) for kind in kinds]
    found = not_valid(simulated(*faults, run={"duration_s": 3.0, "settle_s": 0.5}))
    assert {f"effect:{kind}-{number}" for number, kind in enumerate(kinds)} <= found.keys()
    assert {*found.values()} == {Verdict.UNKNOWN}


@pytest.mark.slow
def test_a_fault_that_the_run_did_not_come_to_is_unknown() -> None:
    recorded = with_fault("loss")
    cut = replace(recorded, events=[*recorded.events, Event(1_500_000_000, "interrupted", None, {})])
    assert verdict(cut, "effect:loss-0") is Verdict.UNKNOWN


@pytest.mark.slow
def test_restarts_of_the_router_need_an_event_where_there_is_a_router() -> None:
    recorded = with_fault("router_restart")
    live = [Event(0, "started", None, {"start_up_s": 2.0}), *recorded.events[1:]]
    assert verdict(replace(recorded, events=live), "effect:router_restart-0") is Verdict.UNKNOWN
    told = [*live, Event(2_000_000_000, "router_restarted", None, {"fault": "router_restart-0"})]
    assert verdict(replace(recorded, events=told), "effect:router_restart-0") is Verdict.VALID


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["kill", "loss"])
def test_a_node_that_falls_silent_after_the_last_fault_is_found(kind: str) -> None:
    recorded = with_fault(kind)
    node = recorded.node_ids[int(np.flatnonzero(recorded.plan[0].nodes)[0])]
    silent = without_reports(recorded, node, AT_S if kind == "kill" else 4.5)
    assert not_valid(silent) == {"liveness": Verdict.INVALID}
    assert checked(silent, "liveness").figures["rows"][0]["node"] == node


def restarted(recorded: RecordedRun, seconds: float, until_s: float, kind: str = "emulator_restart") -> RecordedRun:
    """Return the files with a restart in their plan, and with its end in the events."""
    restart = parse_fault({"kind": kind, "at_s": seconds})
    faults = (*recorded.scenario.fault, restart)
    ended = Event(round(until_s * 1e9), f"{kind}ed", None, {"down_s": 1.0})
    scenario = recorded.scenario.model_copy(update={"fault": faults})
    return replace(recorded, scenario=scenario, events=[*recorded.events, ended])


@pytest.mark.parametrize(("until_s", "expected"), [(4.0, Verdict.VALID), (2.5, Verdict.INVALID)])
def test_a_silence_is_the_restarts_only_as_long_as_that_takes(until_s: float, expected: Verdict) -> None:
    """In real time it is over when all have answered, and not when its plan says."""
    recorded = simulated()
    states = recorded.states.to_pylist()
    silent = without_reports(recorded, "v03", 2.0)
    both = zip(states, silent.states.to_pylist(), strict=True)
    rows = [row if row["time_ns"] >= 3.9e9 else without for row, without in both]
    back = replace(recorded, states=pa.Table.from_pylist(rows, schema=recorded.states.schema))
    assert verdict(restarted(back, 2.0, until_s), "liveness") is expected
    assert verdict(restarted(silent, 2.0, until_s), "liveness") is Verdict.INVALID


def test_a_pause_that_a_restart_holds_up_is_judged_around_it() -> None:
    """In real time a process that should pause cannot be told while the emulator restarts."""
    early = shifted(with_fault("pause"), -0.5)  # from 1.5 s on, and they did from 2 s on
    assert verdict(restarted(early, 1.4, 2.0), "pause_respected") is Verdict.VALID
    assert verdict(restarted(early, 1.4, 2.0), "effect:pause-0") is Verdict.VALID
    assert verdict(restarted(early, 1.4, 1.7), "effect:pause-0") is Verdict.UNKNOWN
    assert verdict(restarted(early, 1.4, 1.7), "pause_respected") is Verdict.INVALID
    assert verdict(restarted(early, 1.7, 2.0), "pause_respected") is Verdict.INVALID
    assert verdict(restarted(early, 1.5, 2.0), "pause_respected") is Verdict.INVALID, "the pause comes first"


@pytest.mark.parametrize(
    ("kind", "expected"), [("emulator_restart", Verdict.VALID), ("router_restart", Verdict.INVALID)]
)
def test_a_restart_of_the_routers_of_vehicles_holds_no_pause_up(kind: str, expected: Verdict) -> None:
    early = shifted(with_fault("pause"), -0.5)  # from 1.5 s on, and they did from 2 s on
    held = restarted(early, 1.4, 2.0, kind)
    assert verdict(held, "pause_respected") is Verdict.VALID
    scenario = held.scenario
    zenoh = scenario.model_copy(
        update={
            "run": scenario.run.model_copy(update={"pacing": "realtime"}),
            "program": scenario.program.model_copy(update={"kind": "zenoh"}),
        }
    )
    found = check_pause_respected(replace(held, scenario=zenoh))
    assert isinstance(found, CheckResult) and found.verdict is expected


def test_a_short_silence_and_a_death_are_no_lack_of_liveness() -> None:
    recorded = with_fault("loss")
    assert not_valid(without_reports(recorded, "v03", 5.1)) == {}
    dead = replace(recorded, events=[*recorded.events, Event(4_500_000_000, "crashed", "v03", {"error": "tired"})])
    assert verdict(without_reports(dead, "v03", 4.5), "liveness") is Verdict.VALID


def number_of(node: Node) -> int:
    return int(node.id[1:])


REPORTS: dict[str, Callable[[Node, int], bool]] = {
    "every 0.9 to 1.1 s, v03 not in the last three seconds": lambda node, period: (
        (period + number_of(node)) % 30 in (0, 9, 20) and (node.id != "v03" or period < 30)
    ),
    "a second after it comes up": lambda node, period: not node.incarnation or period >= 40,
    "four times, then every three seconds": lambda node, period: period < 4 or period % 30 == 0,
    "from 0.5 s on, v01 never": lambda node, period: node.id != "v01" and period >= 5,
    "v02 from 1.2 s on, and never after a restart": lambda node, period: (
        node.id != "v02" or (period >= 12 and not node.incarnation)
    ),
    "every fifth second, v02 always": lambda node, period: node.id == "v02" or period % 50 == 0,
    "from the third second on": lambda node, period: period >= 30,
}
"""At which of its fixes a vehicle reports, by its period of 0.1 s."""


async def reports(node: Node) -> None:
    """Report at some fixes; one vehicle whose program starts late ends right after a report."""
    when = str(node.options["when"])
    async for fix in node.gnss:
        period = round(fix.time_ns / 1e8)
        if REPORTS[when](node, period):
            node.report(fix.position_m, fix.covariance_m2)
        if when == "from the third second on" and node.id == "v03" and period >= 40:
            return


def reporting(when: str, *faults: dict[str, Any]) -> RecordedRun:
    return simulated(*faults, program=f"{__name__}:reports", options={"when": when})


def of(kind: str, at_s: float, duration_s: float, node: str = "v01") -> dict[str, Any]:
    return {"kind": kind, "at_s": at_s, "duration_s": duration_s, "nodes": [node]}


LATE = of("gnss_outage", 0.0, 3.0, "v02")


@pytest.mark.parametrize(
    ("when", "faults", "expected"),
    [
        ("a second after it comes up", [of("kill", 2.0, 1.0)], Verdict.VALID),
        # A program that nearly stops is not its own measure.
        ("four times, then every three seconds", [], Verdict.INVALID),
        # One that never reports, as the leader of a platoon, is expected to if a fault left it no time.
        ("from 0.5 s on, v01 never", [of("kill", 2.0, 1.0)], Verdict.VALID),
        ("from 0.5 s on, v01 never", [of("pause", 2.0, 1.0)], Verdict.VALID),
        ("from 0.5 s on, v01 never", [of("gnss_outage", 2.0, 1.0)], Verdict.VALID),
        ("from 0.5 s on, v01 never", [of("gnss_freeze", 0.0, 1.0)], Verdict.VALID),
        ("from 0.5 s on, v01 never", [of("pause", 1.0, 1.0)], Verdict.UNKNOWN),
        ("from 0.5 s on, v01 never", [of("kill", 0.0, 1.0)], Verdict.UNKNOWN),
        # What a fault kept from reporting is no measure of the time that others take.
        ("from 0.5 s on, v01 never", [LATE, of("kill", 2.0, 1.0)], Verdict.VALID),
        # Nor is another vehicle, whose program may have other options, where its own reports were seldom before.
        ("every fifth second, v02 always", [of("restart", 2.0, 0.5)], Verdict.VALID),
        # One that had reported once before a fault is expected to again.
        ("v02 from 1.2 s on, and never after a restart", [of("kill", 1.25, 0.5, "v02")], Verdict.INVALID),
    ],
)
def test_a_silence_is_judged_by_when_its_vehicle_could_report(
    when: str, faults: list[dict[str, Any]], expected: Verdict
) -> None:
    assert verdict(reporting(when, *faults), "liveness") is expected


def test_a_program_that_reports_about_once_a_second_is_alive_until_it_falls_silent() -> None:
    recorded = reporting("every 0.9 to 1.1 s, v03 not in the last three seconds")
    found = checked(recorded, "liveness")
    assert found.verdict is Verdict.INVALID and [row["node"] for row in found.figures["rows"]] == ["v03"]
    assert found.text.endswith("silent for over 2.0 s, v03 from period 28")


def test_a_program_may_start_late_and_end_with_a_report() -> None:
    recorded = reporting("from the third second on")
    assert verdict(recorded, "liveness") is verdict(recorded, "down_respected") is Verdict.VALID


def test_where_the_machine_did_not_keep_up_silence_is_unknown() -> None:
    silent = without_reports(with_fault("loss"), "v03", 4.5)
    gap = replace(silent, events=[*silent.events, Event(6_000_000_000, "transport_gap", None, {"count": 1})])
    assert not_valid(gap) == {"liveness": Verdict.UNKNOWN, "transport": Verdict.UNKNOWN}


def test_a_death_that_a_fault_wanted_is_none() -> None:
    recorded = with_fault("restart")
    (planned,) = recorded.plan
    killed = recorded.node_ids[int(np.flatnonzero(planned.nodes)[0])]
    before_ns, within_ns, after_ns = planned.start_ns - 10**8, planned.start_ns + 10**8, planned.end_ns + 10**8
    assert within_ns < planned.end_ns
    for time_ns, expected in (
        (before_ns, Verdict.INVALID),
        (within_ns, Verdict.VALID),
        (after_ns, Verdict.INVALID),
    ):
        died = Event(time_ns, "died", killed, {"how": "SIGKILL"})
        assert verdict(replace(recorded, events=[*recorded.events, died]), "agents_alive") is expected


def test_who_never_comes_back_after_a_fault_in_real_time_was_not_there_to_the_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    recorded = with_fault("restart")
    run = recorded.scenario.run.model_copy(update={"pacing": "realtime"})
    back = replace(recorded, scenario=recorded.scenario.model_copy(update={"run": run}))
    gone = replace(back, events=[event for event in back.events if event.kind != "restarted"])
    (planned,) = recorded.plan
    killed = [recorded.node_ids[node] for node in np.flatnonzero(planned.nodes)]
    for each, is_named in ((back, False), (gone, True)):
        found = result(each, "agents_alive")
        assert isinstance(found, CheckResult) and found.verdict is Verdict.VALID, "it may be on its way"
        assert (killed[0] in found.text) is is_named
    monkeypatch.setattr("emulator.checks.run.START_UP_NS", 0)
    assert verdict(back, "agents_alive") is Verdict.VALID
    found = result(gone, "agents_alive")
    assert isinstance(found, CheckResult) and found.verdict is Verdict.UNKNOWN
    assert found.figures["rows"] == [{"node": node, "since_ns": planned.end_ns} for node in killed]


def test_who_never_comes_up_after_it_has_entered_was_not_there_either(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    vehicles = {"a": [(0, 4, still(0))], "b": [(1, 4, still(50))]}
    scenario = scenario_of_trips(write_trips(tmp_path / "t.csv", vehicles), 4.0)
    recorded = run_scenario(tmp_path / "run", scenario)
    run = scenario.run.model_copy(update={"pacing": "realtime"})
    there = replace(recorded, scenario=scenario.model_copy(update={"run": run}))
    monkeypatch.setattr("emulator.checks.run.START_UP_NS", 10**9)
    assert verdict(there, "agents_alive") is Verdict.VALID
    found = result(replace(there, events=[e for e in there.events if e.kind != "entered"]), "agents_alive")
    assert isinstance(found, CheckResult) and found.verdict is Verdict.UNKNOWN
    assert found.figures["rows"] == [{"node": "b", "since_ns": 10**9}]


@pytest.mark.parametrize("node", ["v01", "emulator"])
def test_growing_memory_is_a_note_of_agents_alone(node: str) -> None:
    recorded = with_fault("loss")
    time_s = [2.0 * n for n in range(30)]
    private_kb = [90_000 + round(500 * t) for t in time_s]
    measured = Event(60_000_000_000, "memory", node, {"time_s": time_s, "private_kb": private_kb})
    found = result(replace(recorded, events=[*recorded.events, measured]), "memory")
    if node == "emulator":
        assert isinstance(found, NotExercised)
    else:
        assert isinstance(found, CheckResult) and found.verdict is Verdict.VALID
        assert "v01 by 512.0 kB a second, 1,843 MB an hour" in found.text
        assert found.figures["growing"] == [{"node": "v01", "kb_per_s": 512.0, "kb_per_hour": 1_843_200.0}]
    assert isinstance(result(recorded, "memory"), NotExercised)


def test_a_process_over_its_memory_limit_leaves_the_run_unknown() -> None:
    recorded = with_fault("loss")
    details = {"nodes": ["v01", "v02"], "memory_mb": 812.5, "limit_mb": 800.0}
    exceeded = Event(1_500_000_000, "memory_exceeded", "v01", details)
    judged = judge(replace(recorded, events=[*recorded.events, exceeded]))
    assert judged.verdict is not Verdict.VALID
    told = {check.name: check for check in judged.checks}
    for name in ("memory", "progress"):
        assert told[name].verdict is Verdict.UNKNOWN
        assert "v01, v02" in told[name].text and "812.5 MB" in told[name].text


def test_in_real_time_what_was_sent_near_a_change_may_be_replayed_later() -> None:
    recorded = with_fault("DataReplay")
    replayed = some(recorded, "delivered", "lost", cause="DataReplay-0", copies=True)
    original = recorded.sent_ns[(recorded.copy == 0) & (recorded.frame == recorded.frame[replayed[5]])][0]
    other = parse_fault({"kind": "gnss_outage", "at_s": original / 1e9, "duration_s": 0.5, "nodes": {"count": 1}})
    run = recorded.scenario.run.model_copy(update={"pacing": "realtime"})
    both = recorded.scenario.model_copy(update={"run": run, "fault": (*recorded.scenario.fault, other)})
    assert verdict(replace(recorded, scenario=both), "copies") is Verdict.VALID


@pytest.mark.parametrize(("count", "text"), [(1, "1 fix is missing, "), (2000, "2,000 fixes are missing, ")])
def test_what_shows_an_effect_is_counted_properly(count: int, text: str) -> None:
    assert _wrong_fixes(count).text.startswith(text)


def test_a_corruption_of_all_receptions_is_seen_by_their_cause() -> None:
    fault = {"kind": "corrupt", "probability": 1.0, "at_s": 0.5, "duration_s": 2.0}
    recorded = simulated(fault, radio={"loss": 0.0})
    assert not_valid(recorded) == {}


async def talks_a_second(node: Node) -> None:
    """Talk, and end."""
    for _ in range(10):
        await node.radio.broadcast(b"x")
        await asyncio.sleep(0.1)


@pytest.mark.parametrize("kind", ["kill", "pause"])
def test_a_fault_of_programs_that_have_ended_has_no_effect(kind: str) -> None:
    recorded = simulated(fault(kind, at_s=3.0), program=f"{__name__}:talks_a_second")
    assert not_valid(recorded)[f"effect:{kind}-0"] is Verdict.UNKNOWN


async def talks_on(node: Node) -> None:
    """Talk all the time."""
    while True:
        await asyncio.sleep(0.007)
        await node.radio.broadcast(b"x")


@pytest.mark.parametrize("kind", ["delay", "corrupt", "range", "block", "loss"])
def test_a_fault_in_a_period_that_the_run_does_not_complete_is_judged_where_vehicles_move(kind: str) -> None:
    described = fault(kind, at_s=0.15, duration_s=0.1)
    recorded = simulated(
        described,
        program=f"{__name__}:talks_on",
        run={"duration_s": 0.25, "settle_s": 0.0},
        network={"kind": "driven", "vehicles": 3},
    )
    assert len(recorded.trace) > recorded.places.known(recorded.sent_ns).sum()
    assert not [name for name, found in not_valid(recorded).items() if found is Verdict.INVALID]
