"""Faults on the wall clock, without one: what the pacing tells the driver and the processes."""

import asyncio
import math
from types import SimpleNamespace
from typing import Any

import pytest

from emulator.drivers.emulation import Emulation, ProcessActions
from emulator.drivers.processes import Heard, Processes
from emulator.drivers.realtime import RealTime, run_in_real_time
from emulator.radio.outcomes import Outcome
from emulator.scenario.faults import parse_fault
from emulator.scenario.scenario import Scenario
from tests.support.multi_loop_driver import emulation_of, scenario_of
from vnet.errors import ScenarioError
from vnet.radio import SentFrame
from vnet.runtime.arrivals import Mail
from vnet.transport import wire
from vnet.transport.wire import MessageRef, SentMessage, arrived_in_full
from vnet.units import NS_PER_S

IDS = ["v01", "v02", "v03", "v04"]
MS = 1_000_000


def fault(kind: str, at_s: float, duration_s: float, **more: Any) -> dict[str, Any]:
    return {"kind": kind, "at_s": at_s, "duration_s": duration_s, "nodes": {"ids": ["v02"]}, **more}


def started(*faults: dict[str, Any], **sections: Any) -> tuple[RealTime, Emulation]:
    run = {"pacing": "realtime"} | sections.pop("run", {})
    emulation = emulation_of(scenario_of(faults, "agents.beacon:main", run=run, **sections))
    realtime = RealTime(emulation, [[node] for node in IDS])
    realtime.start(0)
    return realtime, emulation


def with_units() -> RealTime:
    units = [{"position_m": [0.0, 0.0]}, {"position_m": [10.0, 0.0]}]
    plan = Scenario.model_validate({"run": {"pacing": "realtime"}, "network": {"vehicles": 1}, "roadside": units})
    realtime = RealTime(emulation_of(plan), [["v01"], ["rsu01"], ["rsu02"]])
    realtime.start(0)
    return realtime


def test_a_result_in_a_batch_that_was_missed_goes_out_again() -> None:
    realtime, _ = started(radio={"mac": {}})
    traffic = wire.Traffic([SentFrame("v01", b"x", to="v02", number=7)])
    realtime.receive(10 * MS, "v01", wire.Frames(b"n", 0, 1, [], traffic))
    batch = realtime.due(100 * MS)["v01"]
    (result,) = batch.results
    assert (result.number, result.delivered) == (7, True)
    assert "v01" not in realtime.due(101 * MS)
    realtime.receive(150 * MS, "v01", wire.Frames(b"n", 1, batch.seq + 1, [(batch.seq, batch.seq)], wire.Traffic()))
    assert realtime.due(151 * MS)["v01"].results == [result]
    assert "v01" not in realtime.due(152 * MS)


def test_a_message_of_the_backbone_in_a_batch_that_was_missed_goes_out_again() -> None:
    realtime = with_units()
    traffic = wire.Traffic(messages=[SentMessage("rsu01", 0, None, b"x")])
    realtime.receive(10 * MS, "rsu01", wire.Frames(b"n", 0, 1, [], traffic))
    batch = realtime.due(20 * MS)["rsu02"]
    (message,) = arrived_in_full(batch.messages)
    assert (message.sender, message.payload, message.time_ns) == ("rsu01", b"x", 15 * MS)
    missed = [(batch.seq, batch.seq)]
    realtime.receive(30 * MS, "rsu02", wire.Frames(b"n", 0, batch.seq + 1, missed, wire.Traffic()))
    repeated = realtime.due(31 * MS)["rsu02"]
    assert repeated.messages == [message]
    unseen = [MessageRef("rsu02", message.number)]
    answer = wire.Frames(b"n", 1, repeated.seq + 1, [], wire.Traffic(), unseen=unseen)
    realtime.receive(40 * MS, "rsu02", answer)
    assert realtime.due(41 * MS)["rsu02"].messages == [message]
    assert realtime.gaps == 2


def test_an_old_message_of_the_backbone_goes_out_again_to_a_process_that_was_paused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It is kept from when it went out, and not from when it came."""
    monkeypatch.setattr("emulator.drivers.realtime.KEPT_NS", 10 * MS)
    realtime = with_units()
    traffic = wire.Traffic(messages=[SentMessage("rsu01", 0, None, b"x")])
    realtime.receive(10 * MS, "rsu01", wire.Frames(b"n", 0, 1, [], traffic))
    batch = realtime.due(50 * MS)["rsu02"]
    unseen = [MessageRef("rsu02", batch.messages[0].number)]
    realtime.receive(51 * MS, "rsu02", wire.Frames(b"n", 0, batch.seq + 1, [], wire.Traffic(), unseen=unseen))
    assert realtime.due(52 * MS)["rsu02"].messages == batch.messages


def test_a_process_is_told_of_frames_that_were_lost_until_it_has_taken_that() -> None:
    realtime, _ = started()
    realtime.receive(10 * MS, "v01", wire.Frames(b"n", 3, 1, [], wire.Traffic()))
    batch = realtime.due(11 * MS)["v01"]
    assert batch.lost == [(0, 2)]
    assert "v01" not in realtime.due(12 * MS)
    missed = [(batch.seq, batch.seq)]
    realtime.receive(20 * MS, "v01", wire.Frames(b"n", 4, batch.seq + 1, missed, wire.Traffic()))
    assert realtime.due(21 * MS)["v01"].lost == [(0, 2)]
    assert "v01" not in realtime.due(22 * MS)


@pytest.mark.parametrize("network", [{}, {"kind": "driven"}], ids=["given", "driven"])
def test_a_frame_meets_the_faults_of_its_time_on_a_machine_that_is_late(network: dict[str, Any]) -> None:
    """While messages wait to be taken, `due` is not called."""
    cut = {"kind": "partition", "at_s": 0.5, "duration_s": 0.5, "groups": [["v02"], ["v01", "v03", "v04"]]}
    realtime, emulation = started(cut, network=network)
    for seq, time_ns in enumerate((10 * MS, 700 * MS, 1200 * MS)):
        traffic = wire.Traffic([SentFrame("v01", b"x")])
        realtime.receive(time_ns, "v01", wire.Frames(b"n", seq, 1, [], traffic))
    realtime.due(1300 * MS)
    assert emulation.engine.counts[Outcome.fault] == 1, "of v02, and of the second frame alone"


def test_what_came_before_a_program_ended_has_arrived_on_a_machine_that_is_late() -> None:
    """While messages wait to be taken, `due` is not called."""
    realtime, emulation = started(radio={"loss": 0.0, "range_m": 1e6})
    said = [("v01", 10, [SentFrame("v01", b"x")], []), ("v02", 100, [], [wire.Ending("v02", "finished")])]
    for node, time_ms, frames, endings in said:
        traffic = wire.Traffic(frames, endings=endings)
        realtime.receive(time_ms * MS, node, wire.Frames(b"n", 0, 1, [], traffic))
    realtime.due(200 * MS)
    assert emulation.engine.counts[Outcome.delivered] == 3 and not emulation.engine.counts[Outcome.receiver_down]
    emulation.finish(200 * MS)
    periods = len(emulation.metrics.metrics_table())
    end = wire.Traffic(endings=[wire.Ending("v03", "finished")])
    realtime.receive(900 * MS, "v03", wire.Frames(b"n", 0, 1, [], end))  # of a run that was interrupted
    assert len(emulation.metrics.metrics_table()) == periods


@pytest.mark.parametrize("interrupted_ms", [None, 50])
def test_a_program_that_ended_within_the_run_has_ended_though_that_is_told_after_it(
    interrupted_ms: int | None,
) -> None:
    """Its message was lost with a restart of the emulator; one that ends as the run does has ended by then."""
    realtime, emulation = started(radio={"loss": 0.0, "range_m": 1e6})
    end_ns = emulation.duration_ns if interrupted_ms is None else interrupted_ms * MS
    realtime.receive(10 * MS, "v02", wire.Frames(b"n", 0, 1, [], wire.Traffic([SentFrame("v02", b"x")])))
    if interrupted_ms is not None:
        emulation.finish(end_ns)
    for node, time_ns in (("v01", end_ns - 1), ("v02", end_ns), ("v01", end_ns - 1)):
        traffic = wire.Traffic(endings=[wire.Ending(node, "crashed", "boom", time_ns=time_ns)])
        realtime.receive(end_ns + MS, node, wire.Frames(b"n", 1, 1, [], traffic, final=True))
    realtime.finish()
    assert [each.node for each in emulation.folder.events if each.kind == "crashed"] == ["v01"]
    assert not emulation.engine.counts[Outcome.receiver_down], "what it was sent before counts as before"


def clocks(batches: dict[str, wire.Batch], node: str = "v02") -> list[tuple[int, float]]:
    return [(c.offset_ns, c.rate) for c in batches[node].clocks] if node in batches else []


def test_a_clock_goes_wrong_and_right_again_at_its_time() -> None:
    realtime, _ = started(fault("skew", 0.5, 1.0, offset_ms=100), fault("drift", 1.0, 1.0, rate_ppm=1000))
    assert clocks(realtime.due(400 * MS)) == []
    assert clocks(realtime.due(500 * MS)) == [(100 * MS, 0.0)]
    ((offset_ns, rate),) = clocks(realtime.due(1000 * MS))
    assert offset_ns == 100 * MS and rate == pytest.approx(0.001)
    ((offset_ns, rate),) = clocks(realtime.due(1500 * MS))
    assert offset_ns == MS // 2 and rate == pytest.approx(0.001)
    assert clocks(realtime.due(2000 * MS)) == [(0, 0.0)]


def test_who_stands_still_is_given_nothing_and_then_all_without_blame() -> None:
    realtime, _ = started(fault("pause", 0.5, 0.8))
    realtime.due(450 * MS)
    held = [realtime.due(t * MS) for t in range(500, 1300, 50)]
    assert all("v02" not in batches for batches in held)
    assert [a.paused for a in realtime.take_actions()] == [{"v02"}]
    batch = realtime.due(1300 * MS)["v02"]
    assert [fix.time_ns for fix in batch.fixes] == [600 * MS, 800 * MS, 1000 * MS, 1200 * MS]
    assert batch.held
    assert [a.paused for a in realtime.take_actions()] == [set()]
    assert not realtime.due(1400 * MS)["v02"].held


def test_who_is_killed_again_before_it_was_back_is_killed_and_comes_back_once_more() -> None:
    realtime, emulation = started(fault("kill", 0.5, 0.3), fault("restart", 1.0, 0.4))
    realtime.due(900 * MS)
    assert [(a.stop, a.start) for a in realtime.take_actions()] == [({"v02": True}, []), ({}, ["v02"])]
    assert not emulation.up["v02"], "its process is still starting"
    realtime.due(1000 * MS)
    assert [(a.stop, a.start) for a in realtime.take_actions()] == [({"v02": False}, [])]
    realtime.due(1400 * MS)
    assert [(a.stop, a.start) for a in realtime.take_actions()] == [({}, ["v02"])]
    batch = realtime.returned(1700 * MS, "v02")
    assert (batch.seq, batch.start_ns) == (0, 1700 * MS)
    assert emulation.up["v02"]
    assert emulation.incarnation["v02"] == 2


def test_what_a_killed_process_still_says_counts_for_nothing() -> None:
    realtime, emulation = started(fault("kill", 0.5, 1.0))
    realtime.due(500 * MS)
    realtime.receive(501 * MS, "v02", wire.Frames(b"n", 0, 1, [], wire.Traffic([SentFrame("v02", b"x")])))
    realtime.due(600 * MS)
    assert len(emulation.engine.trace) == 0
    assert realtime.gaps == 0


def test_what_an_operator_does_late_makes_no_fault_miss_its_end() -> None:
    """A query is answered between the instant of a change and the moment at which the driver gets to it."""
    realtime, emulation = started(fault("pause", 0.5, 0.5))
    realtime.due(500 * MS)
    emulation.inject(parse_fault(fault("loss", 2.0, 0.2, probability=0.5)), 1001 * MS)
    realtime.take_actions()
    realtime.due(1002 * MS)
    assert [a.paused for a in realtime.take_actions()] == [set()]


@pytest.mark.parametrize("is_told", [True, False])
def test_a_program_that_does_not_come_up_again_has_died(is_told: bool) -> None:
    """Its process may end before it has said a word, or never say one."""
    realtime, emulation = started(fault("kill", 0.5, 0.5), run={"join_timeout_s": 0.5})
    for time_ms in (500, 1000):
        realtime.due(time_ms * MS)
        realtime.take_actions()
    if is_told:
        realtime.died(1200 * MS, "v02", how="exit status 9")
    realtime.finish()
    (death,) = [event for event in emulation.folder.events if event.kind == "died"]
    assert death.node == "v02" and (death.time_ns, death.details["how"]) == (
        (1200 * MS, "exit status 9") if is_told else (1500 * MS, "not up within run.join_timeout_s = 0.5")
    )


def test_a_program_that_does_not_come_up_again_is_ended_once_its_time_is_over() -> None:
    faults = [fault("kill", 0.5, 0.5), fault("pause", 0.5, 2.0, nodes=["v03"])]
    realtime, emulation = started(*faults, run={"join_timeout_s": 0.5})
    realtime.due(1000 * MS)
    realtime.take_actions()
    realtime.give_up_starts(1499 * MS)
    assert realtime.take_actions() == [] and emulation.presence.starting() == ["v02"]
    for time_ms in (1510, 1600):
        realtime.give_up_starts(time_ms * MS)
    (ended,) = realtime.take_actions()
    assert (ended.stop, ended.start, ended.paused) == ({"v02": True}, [], {"v03"})
    (death,) = [event for event in emulation.folder.events if event.kind == "died"]
    assert (death.node, death.time_ns) == ("v02", 1500 * MS)
    assert not emulation.welcome("v02", b"n").runs


def test_a_fault_that_programs_cannot_have_is_refused_as_it_is_injected() -> None:
    """Else nothing would come of it, and the scenario that the run leaves could not be read."""
    emulation = emulation_of(Scenario.model_validate({"run": {"pacing": "realtime"}, "program": {"kind": "zenoh"}}))
    for text in fault("skew", 1.0, 0.2, offset_ms=5.0), fault("drift", 1.0, 0.2, rate_ppm=5.0):
        with pytest.raises(ScenarioError, match="in real time nothing changes the clock"):
            emulation.inject(parse_fault(text), 0)
    assert emulation.scenario.fault == ()


def test_healing_ends_a_fault_at_once_and_again_changes_nothing() -> None:
    realtime, emulation = started(fault("kill", 0.5, 2.0))
    realtime.due(500 * MS)
    realtime.take_actions()
    for _ in range(2):
        emulation.heal("kill-0", 800 * MS)
        realtime.due(801 * MS)
    assert [a.start for a in realtime.take_actions()] == [["v02"]]
    (written,) = emulation.scenario.fault
    assert written.duration_s == pytest.approx(0.3)


def test_whose_program_has_ended_is_not_up_again_when_its_process_is() -> None:
    realtime, emulation = started(fault("kill", 0.5, 0.2))
    ended = wire.Traffic((), (), [wire.Ending("v02", "finished")])
    realtime.receive(100 * MS, "v02", wire.Frames(b"n", 0, 1, [], ended))
    realtime.due(900 * MS)
    assert [(a.stop, a.start) for a in realtime.take_actions()] == [({}, []), ({}, [])]
    assert not emulation.welcome("v02", b"n").runs
    assert emulation.welcome("v01", b"n").runs


def test_frames_that_come_after_an_interruption_are_no_part_of_the_run() -> None:
    realtime, emulation = started()
    realtime.due(450 * MS)
    emulation.finish(500 * MS)
    late = wire.Frames(b"n", 0, 1, [], wire.Traffic([SentFrame("v02", b"x")]), None, final=True)
    realtime.receive(501 * MS, "v02", late)
    realtime.finish()
    assert emulation.engine.counts[Outcome.pending] == 0
    assert len(emulation.engine.trace) == 0
    assert "v02" not in realtime.awaited


def test_the_true_latency_of_a_late_delivery_is_in_the_trace() -> None:
    realtime, emulation = started()
    realtime.receive(10 * MS, "v01", wire.Frames(b"n", 0, 1, [], wire.Traffic([SentFrame("v01", b"x")])))
    batches = {node: batch for node, batch in realtime.due(60 * MS).items() if batch.packets}
    arrived_ns = {node: batch.packets[0].received_ns for node, batch in batches.items()}
    # v02 was late by 40 ms, v03 by 19 ms; v04 speaks of the future, and of a batch that it has never been sent
    says = {
        "v02": [(batches["v02"].seq, arrived_ns["v02"] + 40 * MS)],
        "v03": [(batches["v03"].seq, arrived_ns["v03"] + 19 * MS)],
        "v04": [(batches["v04"].seq, 2**62), (99, 70 * MS)],
    }
    for node, late in says.items():
        realtime.receive(80 * MS, node, wire.Frames(b"n", 0, batches[node].seq + 1, [], wire.Traffic(), late=late))
    emulation.finish(emulation.duration_ns)
    rows = {row["receiver"]: row for row in emulation.engine.trace.to_table().to_pylist()}
    assert rows["v02"]["arrival_ns"] == arrived_ns["v02"] + 40 * MS
    assert rows["v03"]["arrival_ns"] == arrived_ns["v03"]
    assert rows["v04"]["arrival_ns"] == 80 * MS
    assert {node: row["arrival_ns"] - row["late_ns"] for node, row in rows.items()} == arrived_ns


def test_a_trace_without_late_deliveries_has_no_column_for_them() -> None:
    _, emulation = started()
    assert "late_ns" not in emulation.engine.trace.to_table().column_names


def test_messages_are_taken_at_the_instants_at_which_they_came_and_never_before_what_has_gone_out() -> None:
    realtime, _ = started()
    assert [realtime.taken_ns(came_ms * MS) // MS for came_ms in (3, 5, 4)] == [3, 5, 5]
    realtime.due(20 * MS)
    assert [realtime.taken_ns(came_ms * MS) // MS for came_ms in (12, 21)] == [20, 21]


def test_an_interrupted_run_has_no_event_after_its_end() -> None:
    realtime, emulation = started()
    realtime.gaps = 1
    emulation.finish(50 * MS)
    realtime.finish()
    assert [event.time_ns for event in emulation.folder.events if event.kind == "transport_gap"] == [50 * MS]


def late_batch(realtime: RealTime, sent_ms: int, due_ms: int) -> tuple[wire.Batch, wire.Receipts]:
    """Have v01 send, take what is due at another instant, and return the batch of v02 with its receipts."""
    realtime.receive(sent_ms * MS, "v01", wire.Frames(b"n", 0, 1, [], wire.Traffic([SentFrame("v01", b"x")])))
    receipts = wire.Receipts()
    receipts.take(wire.Batch((), 0), 0)
    return realtime.due(due_ms * MS)["v02"], receipts


def late_count(realtime: RealTime, emulation: Emulation) -> tuple[int, int]:
    realtime.finish()
    (event,) = [event for event in emulation.folder.events if event.kind == "late_deliveries"]
    return event.details["count"], event.details["total"]


@pytest.mark.parametrize(
    ("held_ms", "arrived_ms", "count"),
    [((12, 900), 905, 0), ((12, 900), 940, 1), ((12, 400), 905, 1), ((950, 990), 905, 1), (None, 905, 1)],
    ids=["by the restart alone", "and by the machine", "long after it", "before it", "without one"],
)
def test_only_lateness_beyond_that_of_a_restart_counts(
    held_ms: tuple[int, int] | None, arrived_ms: int, count: int
) -> None:
    realtime, emulation = started()
    batch, receipts = late_batch(realtime, 10, 60)
    if held_ms is not None:
        realtime.hold(held_ms[0] * MS)
        realtime.release(held_ms[1] * MS)
    receipts.take(batch, arrived_ms * MS)
    realtime.receive(1000 * MS, "v02", receipts.frames(b"n", wire.Traffic()))
    (row,) = [row for row in emulation.engine.trace.to_table().to_pylist() if row["receiver"] == "v02"]
    assert row["arrival_ns"] == arrived_ms * MS, "the trace says what has happened"
    assert late_count(realtime, emulation) == (count, 1)


@pytest.mark.parametrize("slow_ms", [15, 2000])
def test_a_host_whose_clock_was_stopped_has_not_kept_up(slow_ms: int) -> None:
    """By its clock deliveries come before they have arrived: its vehicles live in the past."""
    realtime, emulation = started()
    batch, receipts = late_batch(realtime, 10, 60)
    (packet,) = batch.packets
    receipts.take(batch, packet.received_ns - slow_ms * MS)
    realtime.receive(1000 * MS, "v02", receipts.frames(b"n", wire.Traffic()))
    (row,) = [row for row in emulation.engine.trace.to_table().to_pylist() if row["receiver"] == "v02"]
    assert row["arrival_ns"] == packet.received_ns, "nothing was late by the emulator's clock"
    assert late_count(realtime, emulation) == (slow_ms > 20, 1)


def test_messages_lost_in_a_restart_are_no_gaps_of_the_machine() -> None:
    realtime, _ = started()
    frames = [wire.Frames(b"n", seq, 1, [], wire.Traffic()) for seq in range(9)]
    realtime.receive(100 * MS, "v01", frames[0])
    realtime.hold(150 * MS)
    realtime.receive(850 * MS, "v01", frames[3])
    realtime.take_answer("v01", wire.StackDump(b"n", "", seq=5))
    realtime.release(900 * MS)
    assert realtime.due(901 * MS)["v01"].lost == [(1, 2), (4, 4)], "its process is told all the same"
    realtime.receive(910 * MS, "v01", frames[5])
    assert realtime.gaps == 0
    realtime.receive(950 * MS, "v01", frames[7])
    assert realtime.gaps == 1


@pytest.mark.parametrize("answered", [True, False])
def test_messages_lost_in_a_silence_longer_than_a_restart_are_gaps(answered: bool) -> None:
    realtime, _ = started()
    realtime.receive(100 * MS, "v01", wire.Frames(b"n", 0, 1, [], wire.Traffic()))
    realtime.hold(150 * MS)
    if answered:
        realtime.take_answer("v01", wire.StackDump(b"n", "", seq=2))
    realtime.release(160 * MS)
    realtime.take_answer("v01", wire.StackDump(b"n", "", seq=60))  # nothing is to be answered any more
    realtime.receive(1500 * MS, "v01", wire.Frames(b"n", 60, 1, [], wire.Traffic()))
    assert realtime.gaps == 1


def test_who_does_not_say_what_it_has_sent_is_excused_by_its_answer_for_one_message() -> None:
    realtime, _ = started()
    realtime.hold(150 * MS)
    realtime.take_answer("v01", wire.StackDump(b"n", ""))
    realtime.release(160 * MS)
    for seq, gaps in ((3, 0), (5, 1)):
        realtime.receive(200 * MS, "v01", wire.Frames(b"n", seq, 1, [], wire.Traffic()))
        assert realtime.gaps == gaps


@pytest.mark.parametrize(("due_ms", "gaps"), [(60, 1), (160, 0), (260, 1)], ids=["before", "within", "after"])
def test_a_missed_batch_is_a_gap_unless_it_went_out_within_a_restart(due_ms: int, gaps: int) -> None:
    realtime, _ = started()
    realtime.receive(10 * MS, "v01", wire.Frames(b"n", 0, 1, [], wire.Traffic([SentFrame("v01", b"x")])))
    if due_ms > 150:
        realtime.hold(150 * MS)
    if due_ms > 200:
        realtime.release(200 * MS)
    seq = realtime.due(due_ms * MS)["v02"].seq
    if due_ms < 150:
        realtime.hold(150 * MS)
    if due_ms < 200:
        realtime.release(200 * MS)
    realtime.receive(300 * MS, "v02", wire.Frames(b"n", 0, seq + 1, [(seq, seq)], wire.Traffic()))
    assert realtime.gaps == gaps


def test_who_was_paused_in_a_restart_is_sent_nothing_until_it_has_found_the_emulator_again() -> None:
    realtime, emulation = started(fault("pause", 0.1, 0.4))
    realtime.due(100 * MS)
    realtime.receive(110 * MS, "v01", wire.Frames(b"n", 0, 1, [], wire.Traffic([SentFrame("v01", b"x")])))
    (pause,) = realtime.take_actions()
    realtime.hold(200 * MS, pause.paused)
    realtime.receive(210 * MS, "v02", wire.Frames(b"n", 0, 1, [], wire.Traffic()))  # it came before the pause
    realtime.release(400 * MS)
    assert "v02" not in realtime.due(510 * MS)
    realtime.receive(900 * MS, "v02", wire.Frames(b"n", 4, 1, [], wire.Traffic()))
    batch = realtime.due(901 * MS)["v02"]
    assert batch.held and [packet.sender for packet in batch.packets] == ["v01"]
    assert batch.lost == [(1, 3)], "those that it sent before it had found the emulator"
    assert realtime.gaps == 0
    missed = [(batch.seq, batch.seq)]
    realtime.receive(1000 * MS, "v02", wire.Frames(b"n", 6, batch.seq + 1, missed, wire.Traffic()))
    assert realtime.gaps == 2, "what is lost from then on is the machine's"
    assert emulation.engine.counts[Outcome.transport] == 1


class _Restarting(Processes):
    """Processes whose restart takes time of the clock, as does what is sent within `slow_ms`.

    That of v02 is ready again at `ready_ms`, if ever. The loop wakes up `late_ms` later than it asks for.
    """

    def __init__(self, slow_ms: range, ready_ms: int | None = None, late_ms: int = 0) -> None:
        self.now_ns = 0
        self._ready_ms = ready_ms
        self._late_ms = late_ms
        self.stopped: list[str] = []
        self._slow_ms = slow_ms
        self._receipts = {node: wire.Receipts() for node in IDS}
        self._heard: list[Heard] = []

    async def act(self, actions: ProcessActions) -> None:
        self.stopped += actions.stop
        for _ in actions.restarts:
            for node in IDS:  # a program that sends by a timer of its own
                self._say(node, self.now_ns + 300 * MS, [SentFrame(node, b"x")])
            self.now_ns += 700 * MS

    def send(self, process_id: str, message: wire.Grant | wire.Batch, mail: Mail | None = None) -> None:
        assert isinstance(message, wire.Batch)
        if self.now_ns // MS in self._slow_ms:
            self.now_ns += 30 * MS
        self._receipts[process_id].take(message, self.now_ns)
        self._say(process_id, self.now_ns, [SentFrame(process_id, b"x")] if message.fixes else [])

    def returned(self) -> list[str]:
        if self._ready_ms is None or self.now_ns < self._ready_ms * MS:
            return []
        self._ready_ms = None
        return ["v02"]

    def _say(self, process_id: str, now_ns: int, frames: list[SentFrame]) -> None:
        self._heard.append(Heard(process_id, self._receipts[process_id].frames(b"n", wire.Traffic(frames)), now_ns))

    async def receive(self, timeout_s: float = math.inf) -> Heard | None:
        if self._heard:
            return self._heard.pop(0)
        self.now_ns += math.ceil(timeout_s * 1e9) + self._late_ms * MS
        return None


def run_to_the_end(processes: _Restarting, *faults: dict[str, Any], **run: Any) -> tuple[RealTime, Emulation]:
    """Run in real time by the clock of these processes."""
    plan = scenario_of(faults, "agents.beacon:main", run={"pacing": "realtime", **run})
    realtime = RealTime(emulation := emulation_of(plan), [[node] for node in IDS])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("emulator.drivers.realtime.time", SimpleNamespace(monotonic_ns=lambda: processes.now_ns))
        patch.setattr(wire, "HEAD_START_NS", 0)
        asyncio.run(run_in_real_time(realtime, processes))
    return realtime, emulation


@pytest.mark.parametrize("kind", ["emulator_restart", "router_restart"])
@pytest.mark.parametrize(
    ("slow_ms", "least"),
    [(range(0), 0), (range(1101, 1102), 0), (range(1602, 1610), 1)],
    ids=["fast", "slow in catching up", "slow later"],
)
def test_a_run_in_real_time_keeps_up_whatever_a_restart_holds_back(kind: str, slow_ms: range, least: int) -> None:
    realtime, emulation = run_to_the_end(_Restarting(slow_ms), {"kind": kind, "at_s": 0.401})
    count, total = late_count(realtime, emulation)
    assert total > 100 and (count >= least if least else count == 0)
    rows = emulation.engine.trace.to_table().to_pylist()
    late_ns = [row["late_ns"] for row in rows if row["sent_ns"] == 701 * MS and row["outcome"] == "delivered"]
    assert late_ns and min(late_ns) > 350 * MS, "the trace says what has happened"


@pytest.mark.parametrize(
    ("restart_s", "ready_ms", "died_ms"),
    [(0.2, None, [1500]), (1.02, 1450, []), (1.02, 2190, []), (0.95, 2140, []), (0.95, None, [2150])],
)
def test_a_restart_takes_no_time_from_a_program_that_starts(
    restart_s: float, ready_ms: int | None, died_ms: list[int]
) -> None:
    """It starts at 1 s, and the restart takes 0.7 s."""
    faults = [fault("kill", 0.5, 0.5), {"kind": "emulator_restart", "at_s": restart_s}]
    processes = _Restarting(range(0), ready_ms)
    realtime, emulation = run_to_the_end(processes, *faults, join_timeout_s=0.5)
    realtime.finish()
    assert [event.time_ns // MS for event in emulation.folder.events if event.kind == "died"] == died_ms
    assert emulation.up["v02"] is (died_ms == [])
    assert processes.stopped == ["v02"] * (1 + len(died_ms))


def fault_events(emulation: Emulation) -> list[tuple[str, str, float]]:
    events = [event for event in emulation.folder.events if event.kind.startswith("fault_")]
    return [(event.kind, event.details["fault"], event.time_ns / NS_PER_S) for event in events]


@pytest.mark.parametrize("at_s", [2.401, None], ids=["held by a restart", "late"])
def test_all_that_the_plan_says_until_the_end_is_done_however_late_the_run_comes_to_it(at_s: float | None) -> None:
    held = [] if at_s is None else [{"kind": "emulator_restart", "at_s": at_s, "down_s": 0.7}]
    faults = [fault("loss", 2.5, 0.3, probability=0.5), fault("kill", 2.5, 0.499), fault("pause", 2.5, 0.4995)]
    processes = _Restarting(range(0), late_ms=0 if held else 3)
    realtime, emulation = run_to_the_end(processes, *faults, *held, settle_s=0.0)
    realtime.finish()
    planned = emulation.faults.faults
    starts = [("fault_started", each.label, each.start_ns / NS_PER_S) for each in planned]
    ends = [("fault_ended", each.label, each.end_ns / NS_PER_S) for each in planned]
    assert sorted(fault_events(emulation)) == sorted(
        event for event in [*starts, *ends] if event[2] < emulation.duration_ns / NS_PER_S
    )


def test_an_interruption_that_comes_later_than_the_end_is_one_at_the_end() -> None:
    """A restart has held the run for longer."""
    _, emulation = started()
    emulation.finish(emulation.duration_ns + 500 * MS)
    assert emulation.ended_ns == emulation.duration_ns == emulation.emulated_ns


def test_what_the_plan_says_until_an_interruption_is_done_and_nothing_of_later() -> None:
    realtime, emulation = started(fault("loss", 0.46, 0.03, probability=0.5), fault("pause", 0.52, 0.5))
    realtime.due(450 * MS)
    emulation.finish(500 * MS)
    realtime.receive(550 * MS, "v02", wire.Frames(b"n", 0, 1, [], wire.Traffic()))
    realtime.finish()
    assert fault_events(emulation) == [("fault_started", "loss-0", 0.46), ("fault_ended", "loss-0", 0.49)]
