"""Rules of the user's own on the radio: what they see, what they may answer, and what happens if they fail."""

import signal
import threading
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from types import FrameType
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emulator.drivers.signals import signals_handled
from emulator.radio.own_rules import OwnRules
from emulator.scenario import own_functions
from emulator.scenario.program import Program
from emulator.scenario.scenario import Scenario
from tests.support import rules
from tests.support.answers import answers
from tests.support.faulty_engine import PERIOD_NS, FaultyEngine, Row, S, digest, fault
from vnet.errors import ScenarioError, VnetError
from vnet.radio import SentFrame

pytestmark = pytest.mark.slow


def rule(function: str, at_s: float = 0.0, duration_s: float = 100.0, kind: str = "custom", **more: Any) -> Row:
    return fault(kind, at_s, duration_s, rule=f"tests.support.rules:{function}", **more)


def chatted(*faults: dict[str, Any], periods: int = 20, **more: Any) -> FaultyEngine:
    air = FaultyEngine(faults, **more)
    air.chat(periods)
    return air


def without_cause(rows: list[Row]) -> list[Row]:
    return [{**row, "cause": ""} for row in rows]


def test_a_dropped_frame_is_a_fault_by_the_rule_s_name_while_it_acts() -> None:
    air = chatted(rule("drops", 0.5, 1.0, senders={"ids": ["v1"]}, name="shadow"), rule("drops", 1.8, 0.1))
    fell = Counter((row["sender"], row["cause"], row["sent_ns"] // PERIOD_NS) for row in air.rows() if row["cause"])
    assert fell == {("v1", "shadow-0", period): 4 for period in range(5, 15)} | {
        (node, "drops-1", 18): 4 for node in air.ids
    }
    assert {row["outcome"] for row in air.rows() if row["cause"]} == {"fault"}


@pytest.mark.parametrize(
    ("own", "built_in"),
    [
        (rule("drops", receivers={"count": 2}), fault("block", receivers={"count": 2})),
        (rule("delays", 0.3, 0.9, senders={"ids": ["v1"]}), fault("delay", 0.3, 0.9, senders=["v1"], delay_ms=150)),
        (rule("drops_far", options={"range_m": 150}), fault("range", range_m=150)),
        (rule("doubles"), fault("duplicate", probability=1.0, copies=2, delay_ms=7.0)),
        (rule("passes"), fault("block", 90.0, 1.0)),
    ],
    ids=["block", "delay", "range", "duplicate", "nothing"],
)
@settings(max_examples=4, deadline=None)
@given(seed=st.integers(0, 2**40), loss=st.sampled_from([0.0, 0.3]), peers=st.sampled_from([2, 100]))
def test_a_rule_that_answers_as_a_built_in_fault_does_gives_the_same_receptions(
    own: dict[str, Any], built_in: dict[str, Any], seed: int, loss: float, peers: int
) -> None:
    first, second = (chatted(each, periods=15, seed=seed, loss=loss, max_peers=peers) for each in (own, built_in))
    assert without_cause(first.rows()) == without_cause(second.rows())
    assert first.delivered == second.delivered
    assert first.failures == []


@pytest.mark.parametrize("kind", ["custom", "custom_sender"])
def test_a_rule_sees_power_and_bit_rate_of_the_frame(kind: str) -> None:
    rules.SEEN.clear()
    physical = {"path_loss": {"kind": "free_space", "tx_power_dbm": 23.0}, "bitrate_mbps": 12.0}
    for radio in (physical, {"range_m": 250.0, "bitrate_mbps": 2.5}):
        air = FaultyEngine([rule("looks", kind=kind)], **radio)
        air.go(0)
        air.engine.transmit(0, 1, [b"a", SentFrame("v1", b"b", power_dbm=10.5, rate_mbps=3.0)])
        air.rows()
    assert [(frame.power_dbm, frame.rate_mbps) for frame in rules.SEEN] == [(23, 12), (10.5, 3), *[(None, 2.5)] * 2]


def test_a_rule_sees_the_frame_and_its_receivers_and_can_change_nothing_of_it() -> None:
    rules.SEEN.clear()
    chatted(rule("looks", receivers={"ids": ["v0", "v3"]}, options={"a": [1]}), periods=2, range_m=250.0)
    assert len(rules.SEEN) == 2 * 3, "v0 and v3 hear v1, v2 and v4, and not each other"
    frame = next(each for each in rules.SEEN if each.sender == "v2" and each.sequence == 1)
    assert frame.receivers == ("v0", "v3")
    assert frame.distance_m.tolist() == [200.0, 100.0]
    assert frame.position_m.tolist() == [[0.0, 0.0], [300.0, 0.0]]
    assert frame.sender_position_m.tolist() == [200.0, 0.0] == frame.where("v2").tolist()
    assert (frame.copy, frame.time_ns, frame.time_s) == (0, PERIOD_NS, 0.1)
    assert frame.payload == bytes([2]) + (1).to_bytes(4, "big") + bytes(15)
    assert frame.options == {"a": [1]}
    for array in (frame.distance_m, frame.position_m, frame.sender_position_m, frame.where("v1")):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0
    with pytest.raises(KeyError, match="no vehicle 'v9'"):
        frame.where("v9")
    with pytest.raises(AttributeError):
        frame.sequence = 3  # type: ignore[misc]


def test_many_vehicles_whose_links_are_no_matrices_are_seen_as_they_are() -> None:
    rules.SEEN.clear()
    air = FaultyEngine([rule("looks")], count=70, range_m=150.0)
    air.send(0, 40, b"hello")
    air.rows()
    (frame,) = rules.SEEN
    assert frame.receivers == ("v39", "v41")
    assert frame.position_m.tolist() == [[3900.0, 0.0], [4100.0, 0.0]]


def test_the_draws_of_a_frame_are_its_own_and_do_not_depend_on_other_faults_or_frames() -> None:
    def drawn(*before: dict[str, Any], seed: int = 1) -> dict[tuple[str, int], list[float]]:
        rules.SEEN.clear()
        chatted(fault("block", 90.0, 1.0), rule("looks"), *before, periods=3, seed=seed)
        return {(frame.sender, frame.sequence): frame.rng.random(3).tolist() for frame in rules.SEEN}

    plain = drawn()
    assert len({draw for draws in plain.values() for draw in draws}) == 15 * 3
    assert drawn(fault("loss", probability=0.5), rule("drops")) == plain
    assert not {draw for draws in plain.values() for draw in draws} & {
        draw for draws in drawn(seed=2).values() for draw in draws
    }


def test_the_state_is_made_anew_for_each_run_and_each_fault() -> None:
    once, again = (chatted(rule("every_third"), periods=6) for _ in range(2))
    assert once.rows() == again.rows()
    twice = chatted(rule("every_third", senders={"ids": ["v0"]}), rule("every_third", senders={"ids": ["v1"]}))
    fell = {(row["cause"], row["seq"]) for row in twice.rows() if row["outcome"] == "fault"}
    assert fell == {(f"every_third-{n}", seq) for n in range(2) for seq in range(2, 20, 3)}


def test_all_that_a_rule_may_do_leaves_one_outcome_for_each_reception() -> None:
    others = fault("corrupt", probability=0.3), fault("DoS", factor=3)
    air = chatted(rule("everything"), *others, loss=0.1, periods=40)
    rows = air.rows()
    assert air.failures == []
    keys = [(row["sender"], row["seq"], row["receiver"], row["copy"]) for row in rows]
    assert len(set(keys)) == len(keys)
    mine = [row for row in rows if row["cause"] == "everything-0"]
    dropped = sum(row["outcome"] == "fault" for row in mine)
    assert dropped == pytest.approx(0.2 * 3 * 40 * 5 * 4, rel=0.1)
    assert sum(row["copy"] > 0 and row["outcome"] == "delivered" for row in mine) > 1000
    assert max(row["arrival_ns"] - row["sent_ns"] for row in mine if row["arrival_ns"]) > 0.2 * S


def test_a_rule_gives_some_receivers_other_bytes_and_leaves_others_to_chance() -> None:
    air = FaultyEngine([rule("everything")], count=3)
    for n in range(60):
        air.send(n * PERIOD_NS, 0, b"abcdef")
    rows = [row for row in air.rows() if row["outcome"] == "delivered" and row["copy"] == 0]
    got = {delivery.packet.payload for delivery in air.delivered}
    assert b"fedcba" in got and b"abcdef" in got and len(got) > 20
    assert {len(payload) for payload in got} == {6}
    changed = [row for row in rows if row["payload_digest"] != digest(b"abcdef")]
    assert {row["cause"] for row in changed} == {"everything-0"}


def test_a_sender_s_rule_says_what_is_sent_in_place_of_each_frame() -> None:
    air = FaultyEngine([rule("babbles", 1.0, 1.0, "custom_sender", nodes={"ids": ["v1"]})], count=3)
    for n in range(30):
        air.send(n * PERIOD_NS, 1, b"%d" % n)
        air.send(n * PERIOD_NS, 0, b"good")
    sent: dict[int, list[bytes]] = {}
    for row in air.rows():
        assert (row["cause"] == "babbles-0") == (row["sender"] == "v1" and 1 * S <= row["sent_ns"] < 2 * S)
    for delivery in air.delivered:
        if delivery.receiver == 2 and delivery.packet.payload != b"good":
            sent.setdefault(delivery.packet.sent_ns // PERIOD_NS, []).append(delivery.packet.payload)
    assert sorted(sent[9]) == [b"9"]
    assert sorted(sent[10]) == [b"10", b"lie 10", b"none"]
    assert sorted(sent[11]) == [b"10", b"11", b"lie 11"]
    assert sorted(sent[20]) == [b"20"]


def test_a_sender_s_rule_drops_a_frame_that_is_recorded_and_never_sent() -> None:
    silent, free = chatted(rule("silences", 0.5, 1.0, "custom_sender", nodes={"ids": ["v1"]})), chatted()
    for air in (silent, free):
        air.go(3 * S)
    dropped = [row for row in silent.rows() if row["outcome"] == "fault"]
    assert {(row["sender"], row["cause"], row["arrival_ns"]) for row in dropped} == {("v1", "silences-0", None)}
    assert Counter(row["seq"] for row in dropped) == dict.fromkeys(range(5, 15, 2), 4)
    key = ("sender", "seq", "receiver", "payload_digest")
    mine, all_rows = (
        [tuple(row[name] for name in key) for row in air.rows() if row["copy"] == 0] for air in (silent, free)
    )
    assert mine == all_rows, "each frame has its number, and its rows"
    heard = [delivery.packet.payload for delivery in silent.delivered if delivery.receiver == 0]
    assert Counter(payload[4] for payload in heard if payload[0] == 1) == {
        seq: 3 if seq in (6, 12) else 1 for seq in range(20) if not (5 <= seq < 15 and seq % 2)
    }


def test_a_dropped_frame_takes_no_time_of_its_sender_s_queue_and_no_other_rule_is_asked() -> None:
    silence, babble = (rule(name, kind="custom_sender") for name in ("silences", "babbles"))
    slow: dict[str, Any] = {"count": 2, "bitrate_mbps": 0.01, "access_jitter_ms": 0.0, "jitter_ms": 0.0}
    silent, free = FaultyEngine([silence, babble], **slow), FaultyEngine([babble], **slow)
    for air in (silent, free):
        air.send(0, 0, b"0")
    silent.send(10 * S, 0, b"1", b"2")
    free.send(10 * S, 0, b"2")
    rows = silent.rows(10 * S)
    assert [(row["outcome"], row["cause"]) for row in rows if row["seq"] == 1] == [("fault", "silences-0")]
    assert {row["cause"] for row in rows if row["seq"] == 2} == {"babbles-1"}
    arrivals = [row["arrival_ns"] for row in rows if row["seq"] == 2]
    assert arrivals == [row["arrival_ns"] for row in free.rows(10 * S)], "as if nothing had been sent before"


@answers("custom", "custom_sender")
def test_nonsense_is_told_once_and_then_everything_passes(kind: str, answer: str, said: str) -> None:
    air, free = chatted(rule("nonsense", kind=kind, options={"answer": answer}), periods=3), chatted(periods=3)
    assert without_cause(air.rows()) == free.rows()
    (failure,) = air.failures
    assert failure.error.startswith(said) and "\n" not in failure.error
    assert (failure.fault, failure.rule, failure.time_ns, failure.sender) == (
        "nonsense-0",
        "tests.support.rules:nonsense",
        0,
        "v0",
    )


def test_a_rule_that_raises_is_told_with_its_line_and_what_it_did_before_stays() -> None:
    air = chatted(rule("raises"))
    (failure,) = air.failures
    assert failure.error.startswith("raises ValueError: no idea of v0 (rules.py:")
    assert failure.time_ns == 1 * S
    assert 'raise ValueError(f"no idea of {frame.sender}")' in failure.where
    assert "own_rules.py" not in failure.where
    fell = {row["sent_ns"] for row in air.rows() if row["outcome"] == "fault"}
    assert fell == {n * PERIOD_NS for n in range(10)}


def test_a_rule_that_ends_the_process_fails_like_any_other() -> None:
    (failure,) = chatted(rule("exits"), periods=1).failures
    assert failure.error.startswith("raises SystemExit: enough (rules.py:")


def test_a_rule_that_never_answers_is_interrupted_after_its_processor_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(own_functions, "LIMIT_S", 0.05)
    air, free = chatted(rule("loops"), periods=3), chatted(periods=3)
    (failure,) = air.failures
    assert failure.error.startswith("does not answer within 0.05 s of processor time (rules.py:")
    assert air.rows() == free.rows()


def test_a_machine_without_room_for_the_watch_is_no_failure_of_the_rule(monkeypatch: pytest.MonkeyPatch) -> None:
    def start(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(own_functions, "_WATCH", own_functions._Watch())
    monkeypatch.setattr("threading.Thread.start", start)
    with pytest.raises(VnetError, match=r"own figures, rules and sensors: can't start new thread: see ulimit"):
        chatted(rule("loops"), periods=1)


@pytest.fixture
def handled(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[int]]:
    """A handler of the signal that interrupts rules, and what it was given; a rule may not wait at all."""
    given: list[int] = []

    def handler(number: int, frame: FrameType | None) -> None:
        given.append(number)

    monkeypatch.setattr(own_functions, "WAIT_LIMIT_S", 0.0)
    monkeypatch.setattr(own_functions, "LOOK_EVERY_S", 0.01)
    with signals_handled(handler, own_functions.WAKE_UP):
        yield given
        assert signal.getsignal(own_functions.WAKE_UP) is handler


@pytest.mark.parametrize("elsewhere", [False, True], ids=["here", "on another thread"])
@pytest.mark.parametrize("name", ["sleeps", "locks_up"])
def test_a_rule_that_waits_is_left_and_handlers_stay(name: str, elsewhere: bool, handled: list[int]) -> None:
    with ThreadPoolExecutor(1) as pool:
        call = (lambda *given, **more: pool.submit(chatted, *given, **more).result()) if elsewhere else chatted
        air = call(rule(name), periods=3)
    (failure,) = air.failures
    assert failure.error.startswith("does not answer within 0 s of waiting (rules.py:")
    assert air.rows() == chatted(periods=3).rows()
    assert handled == [], "no handler but the call's own saw the signal"


def test_other_signals_of_the_kind_reach_the_handler_of_before(
    handled: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(own_functions, "WAIT_LIMIT_S", 1e9)
    air = chatted(rule("alarms"), periods=2)
    assert air.failures == []
    assert handled == [own_functions.WAKE_UP] * 10


def test_a_rule_that_computes_on_another_thread_is_left_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(own_functions, "LIMIT_S", 0.05)
    try:
        with ThreadPoolExecutor(1) as pool:
            air = pool.submit(chatted, rule("loops_for_now"), periods=3).result()
    finally:
        rules.ENOUGH.set()
    (failure,) = air.failures
    assert failure.error.startswith("does not answer within 0.05 s of processor time (rules.py:")
    assert air.rows() == chatted(periods=3).rows()


def test_a_rule_that_catches_everything_is_interrupted_until_it_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(own_functions, "LIMIT_S", 0.05)
    caught = []

    def stubborn() -> None:
        while True:
            try:
                while True:
                    pass
            except BaseException as error:
                caught.append(error)
                if len(caught) == 2:
                    raise

    with pytest.raises(own_functions.NoAnswerError):
        own_functions.call_bounded(stubborn)
    assert len(caught) == 2


def test_on_another_thread_no_handler_is_set(handled: list[int]) -> None:
    with ThreadPoolExecutor(1) as pool:
        during = pool.submit(own_functions.call_bounded, signal.getsignal, own_functions.WAKE_UP).result()
    assert during is signal.getsignal(own_functions.WAKE_UP)
    assert own_functions.call_bounded(signal.getsignal, own_functions.WAKE_UP) is not during


def test_calls_are_bounded_one_by_one_and_not_in_sum(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(own_functions, "LIMIT_S", 0.05)
    for _ in range(3):
        with pytest.raises(own_functions.NoAnswerError):
            own_functions.call_bounded(rules.loops, None, {})
        assert own_functions.call_bounded(np.add, 1, 2) == 3


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("tests.support.nowhere:rule", "cannot import: ModuleNotFoundError: No module .*nowhere'"),
        ("tests.support.rules:nobody", r"module tests.support.rules \(.*rules.py\) has no 'nobody'"),
        ("tests.support.rules:NUMBER", r"is not a function of a frame and a state: def NUMBER\(frame, state\)"),
        ("tests.support.rules:waits", r"is not a function of a frame and a state: def waits\(frame, state\)"),
        ("agents.beacon:main", "is in the program's module: put it into a module of its own"),
    ],
)
def test_a_rule_that_is_none_is_a_mistake_of_the_scenario(name: str, said: str) -> None:
    scenario = Scenario.model_validate({"fault": [{"kind": "custom", "rule": name, "duration_s": 1.0}]})
    with pytest.raises(ScenarioError, match=rf"^fault\.rule = '{name}': {said}$"):
        OwnRules(1, ["v1"]).load(scenario.fault, Program())
