"""The shared medium: nothing depends on how time is cut, and access goes by the rules of 802.11p."""

import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from emulator.fault_plan import PlannedFault
from emulator.radio.dot11p import AIFSN_AND_CW, SIFS_NS, SLOT_NS, airtime_ns
from emulator.radio.engine import Engine
from emulator.radio.outcomes import Outcome
from emulator.scenario.faults import DataReplay, DoS, Duplicate, Fault, StaleMessages, Throttle
from tests.support.paths import ROOT
from tests.support.radio import drained, engine, line

MS = 1_000_000
US = 1_000
PHYSICAL = {"path_loss": {"kind": "log_distance"}, "fading": {}, "mac": {}}
seeds = st.integers(0, 2**63 - 1)
Send = tuple[int, int, int]
"""Transmissions: time, sender, bytes."""
Span = tuple[int, int]
"""From when until when."""


def scattered(count: int, seed: int, side_m: float = 1200.0) -> np.ndarray:
    return np.random.default_rng(seed % 1000).uniform(0, side_m, (count, 2))


def run(
    subject: Engine, sends: list[Send], stops: Sequence[int] | None = None, plan: Sequence[PlannedFault] = ()
) -> list[tuple[int, int, bytes]]:
    """Let all happen, with a look at every one of `stops` and whenever something is sent, or none at all.

    Returns what was delivered.
    """
    heard = []
    changes_ns = {time_ns for planned in plan for time_ns in (planned.start_ns, planned.end_ns)}
    for time_ns in sorted({time for time, _, _ in sends} | set(stops or ()) | changes_ns):
        if stops is not None:
            heard += [(d.packet.received_ns, d.receiver, d.packet.payload) for d in subject.advance(time_ns)]
        if time_ns in changes_ns:
            subject.set_faults([planned for planned in plan if planned.acts_at(time_ns)], time_ns)
        for _, node, size in [send for send in sends if send[0] == time_ns]:
            subject.transmit(time_ns, node, [bytes([node]) * size])
    heard += [(d.packet.received_ns, d.receiver, d.packet.payload) for d in subject.advance(10**10)]
    subject.drain()
    return heard


IMPORTS = """
import sys
from tests.emulator.radio.test_csma import engine, line, run
for mac in ({"kind": "80211p"}, {"kind": "lte-mode4"}, {"kind": "nr-mode2"}):
    subject = engine(line(0, 100), path_loss={"kind": "winner_b1", "frequency_ghz": 5.9}, mac=mac)
    before = set(sys.modules)
    run(subject, [(0, 0, 100)])
    print(*sorted(set(sys.modules) - before))
"""


@pytest.mark.slow
def test_a_first_frame_imports_nothing() -> None:
    """In real time it would be late by the time that an import takes, and the machine be blamed for it."""
    done = subprocess.run([sys.executable, "-c", IMPORTS], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


crowds = st.lists(
    st.tuples(st.integers(0, 4 * MS).map(lambda ns: ns - ns % (100 * US)), st.integers(0, 5), st.integers(1, 600)),
    min_size=1,
    max_size=14,
)
options = st.fixed_dictionaries(
    {
        "access_jitter_ms": st.sampled_from([0.0, 1.0]),
        "loss": st.sampled_from([0.0, 0.3]),
        "queue_frames": st.sampled_from([1, 64]),
        "delivery_tick_us": st.sampled_from([0, 500]),
    },
    optional={
        "congestion": st.sampled_from([{"kind": "etsi", "pause_ms": (1, 2, 4, 8, 16)}, {"kind": "limeric"}]),
        "shadowing": st.just({"sigma_db": 6.0}),
        "mac": st.just({"eifs": True}),
    },
)


@pytest.mark.slow
@given(seeds, crowds, options, st.lists(st.integers(0, 8 * MS), max_size=40))
def test_however_time_is_cut_the_same_happens(
    seed: int, sends: list[Send], radio: dict[str, Any], stops: list[int]
) -> None:
    position_m = scattered(6, seed)
    one, other = (engine(position_m, seed, **PHYSICAL | radio) for _ in range(2))
    assert run(one, sends) == run(other, sends, stops)
    assert one.trace.sha256() == other.trace.sha256()
    assert one.counts == other.counts


def planned(number: int, fault: Fault, span: Span, count: int, *nodes: int) -> PlannedFault:
    """A fault of these nodes, or of all links if there are none."""
    of, links = np.isin(np.arange(count), nodes), None if nodes else np.ones((count, count), dtype=bool)
    return PlannedFault(number, number, fault, span[0], span[1], of, links)


ACT: dict[str, Any] = {"at_s": 0.0, "duration_s": 1.0}
VILLAIN: dict[str, Any] = {**ACT, "nodes": {"ids": ["v0"]}}
spans = st.tuples(st.integers(0, 4 * MS), st.integers(1, 4 * MS)).map(lambda span: (span[0], sum(span)))
villains = st.sampled_from(
    [
        DataReplay(kind="DataReplay", age_s=0.001, **VILLAIN),
        StaleMessages(kind="StaleMessages", age_s=0.001, **VILLAIN),
        DoS(kind="DoS", factor=3, **VILLAIN),
    ]
)
QUIET: dict[str, Any] = {"access_jitter_ms": 0.0, "loss": 0.0, "queue_frames": 64, "delivery_tick_us": 0}


@pytest.mark.slow
@given(seeds, crowds, options, st.lists(st.integers(0, 8 * MS), max_size=20), villains, spans, spans)
@example(
    seed=1,
    sends=[(0, 0, 300), (2 * MS, 0, 100)],
    radio=QUIET,
    stops=[1_500_000],
    fault=DataReplay(kind="DataReplay", age_s=0.001, **VILLAIN),
    span=(0, 9 * MS),
    twice=(0, 300_000),
).via("duplicates end while a frame is on air, and then it is replayed")
def test_however_time_is_cut_copies_have_the_same_numbers(
    seed: int, sends: list[Send], radio: dict[str, Any], stops: list[int], fault: Fault, span: Span, twice: Span
) -> None:
    """While a sender misbehaves, and for another time all frames arrive twice."""
    position_m = scattered(6, seed, side_m=600.0)
    duplicate = Duplicate(kind="duplicate", probability=0.8, delay_ms=2.0, **ACT)
    plan = [planned(0, duplicate, twice, 6), planned(1, fault, span, 6, 0, 1)]
    one, other = (engine(position_m, seed, **PHYSICAL | radio) for _ in range(2))
    assert run(one, sends, plan=plan) == run(other, sends, stops, plan)
    assert drained(one) == drained(other)


@pytest.mark.slow
@given(seeds, crowds, options)
def test_who_looks_ahead_knows_the_next_arrival_and_changes_nothing(
    seed: int, sends: list[Send], radio: dict[str, Any]
) -> None:
    """Predict the first arrival at some nodes before each send, as lockstep does."""
    position_m = scattered(6, seed)
    plain, asked = (engine(position_m, seed, **PHYSICAL | radio) for _ in range(2))
    told = []
    times_ns = sorted({time for time, _, _ in sends})
    for time_ns, until_ns in zip(times_ns, [*times_ns[1:], 10**10], strict=True):
        for _, node, size in [send for send in sends if send[0] == time_ns]:
            asked.transmit(time_ns, node, [bytes([node]) * size])
        while True:
            asked.look_ahead(until_ns, [2, 3])
            first_ns = min(until_ns, *asked.next_arrivals_ns()[[2, 3]].tolist())
            if first_ns >= until_ns:
                break
            told.append(first_ns)
            asked.advance(first_ns)
        asked.advance(until_ns)
    asked.drain()
    heard = run(plain, sends)
    assert told == sorted({time_ns for time_ns, receiver, _ in heard if receiver in (2, 3)} - set(times_ns))
    assert plain.trace.sha256() == asked.trace.sha256()


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(seeds, crowds, st.permutations(range(6)), options)
def test_at_one_instant_it_does_not_matter_whom_the_drivers_ask_first(
    seed: int, sends: list[Send], order: list[int], radio: dict[str, Any]
) -> None:
    position_m = scattered(6, seed)
    one, other = (engine(position_m, seed, **PHYSICAL | radio) for _ in range(2))
    first = sorted(sends, key=lambda send: (send[0], send[1]))
    second = sorted(first, key=lambda send: (send[0], order.index(send[1])))
    run(one, first)
    run(other, second)
    assert one.trace.sha256() == other.trace.sha256()


@settings(max_examples=8, deadline=None)
@given(seeds, crowds, st.lists(st.tuples(st.integers(0, 4 * MS), st.integers(6, 8)), max_size=10), options)
def test_others_far_away_change_nothing(
    seed: int, sends: list[Send], elsewhere: list[tuple[int, int]], radio: dict[str, Any]
) -> None:
    """Bit by bit, though they talk all the time, among themselves."""
    near = scattered(6, seed)
    far = np.vstack([near, near[:3] + 1e5])
    one, other = engine(near, seed, **PHYSICAL | radio), engine(far, seed, **PHYSICAL | radio)
    run(one, sends)
    run(other, sends + [(time, node, 400) for time, node in elsewhere])
    ours = [row for row in drained(other) if int(row["sender"][1:]) < 6]
    assert ours == drained(one)


def test_a_lone_frame_takes_its_airtime_and_arrives_everywhere() -> None:
    subject = engine(line(0, 50, 100), mac={}, path_loss={"kind": "free_space"}, latency_ms=2, jitter_ms=0)
    subject.transmit(5 * MS, 0, [bytes(300)])
    for row in drained(subject):
        assert row["outcome"] == "delivered"
        assert row["arrival_ns"] - row["on_air_ns"] == 448 * US + 2 * MS
        assert 0 < row["on_air_ns"] - 5 * MS <= SLOT_NS, "at the next boundary of a slot"


@pytest.mark.parametrize("category", ["VO", "VI", "BE", "BK"])
def test_a_sender_waits_aifs_and_a_backoff_between_its_frames(category: str) -> None:
    subject = engine(line(0, 50), mac={"access_category": category}, path_loss={"kind": "free_space"})
    subject.transmit(0, 0, [bytes(100)] * 60)
    on_air_ns = np.array([row["on_air_ns"] for row in drained(subject)])
    pauses_ns = np.diff(on_air_ns) - airtime_ns(100, 6.0)
    aifsn, window = AIFSN_AND_CW[category]
    slots = (pauses_ns - SIFS_NS - aifsn * SLOT_NS) / SLOT_NS
    assert np.all(slots == slots.round())
    assert set(slots) <= set(range(window + 1))
    assert slots.max() > window / 2
    assert slots.min() < 2


def test_who_finds_the_medium_busy_waits_for_its_end_and_backs_off() -> None:
    subject = engine(line(0, 50, 100), mac={}, path_loss={"kind": "free_space"})
    for number in range(40):
        start_ns = number * 10 * MS
        subject.transmit(start_ns, 0, [bytes(1000)])
        subject.transmit(start_ns + 400 * US, 1, [bytes(100)])
    on_air = {(row["sender"], row["seq"]): row["on_air_ns"] for row in drained(subject)}
    aifsn, window = AIFSN_AND_CW["BE"]
    slots = set()
    for number in range(40):
        free_ns = on_air["v0", number] + airtime_ns(1000, 6.0) + SIFS_NS + aifsn * SLOT_NS
        assert (on_air["v1", number] - free_ns) % SLOT_NS == 0
        slots.add((on_air["v1", number] - free_ns) // SLOT_NS)
    assert slots <= set(range(window + 1))
    assert len(slots) > 8
    assert {row["outcome"] for row in drained(subject)} == {"delivered"}


def test_a_backoff_stands_still_while_others_send() -> None:
    """Whoever waits longest comes first in the end: with one contender less each time, all three get through."""
    subject = engine(line(0, 50, 100, 150), mac={}, path_loss={"kind": "free_space"})
    subject.transmit(0, 0, [bytes(1400)])
    for node in (1, 2, 3):
        subject.transmit(1 * MS, node, [bytes(300)])
    ends = sorted({(row["on_air_ns"], airtime_ns(row["size_bytes"], 6.0)) for row in drained(subject)})
    aifsn, window = AIFSN_AND_CW["BE"]
    waited = [
        (start_ns - before_ns - length_ns - SIFS_NS - aifsn * SLOT_NS) / SLOT_NS
        for (before_ns, length_ns), (start_ns, _) in pairwise(ends)
    ]
    assert all(slots == round(slots) >= 0 for slots in waited)
    assert sum(waited) <= window, "what has been counted down stays counted down"


def test_all_that_start_in_one_slot_collide_and_nobody_within_it_hears() -> None:
    subject = engine(line(0, 50, 75, 150), mac={}, path_loss={"kind": "free_space"})
    for node in (0, 1):
        subject.transmit(0, node, [bytes(300)])
    assert {row["on_air_ns"] for row in drained(subject)} == {drained(subject)[0]["on_air_ns"]}
    outcomes = {(row["sender"], row["receiver"]): row["outcome"] for row in drained(subject)}
    assert outcomes["v0", "v1"] == outcomes["v1", "v0"] == "collided", "who sends does not hear"
    # v3 is 100 m from v1 and 150 m from v0: 3.5 dB are too little.
    assert outcomes["v0", "v3"] == outcomes["v1", "v3"] == "collided"
    assert outcomes["v1", "v2"] == "delivered", "9.5 dB stronger at v2"
    assert outcomes["v0", "v2"] == "collided"


def test_hidden_terminals_collide_between_them_and_only_there() -> None:
    """v0 and v2 do not sense each other, 900 m apart; v1 between them hears neither, v3 beside v2 hears v2."""
    subject = engine(line(0, 450, 900, 910), mac={}, path_loss={"kind": "free_space"})
    subject.transmit(0, 0, [bytes(1000)])
    subject.transmit(300 * US, 2, [bytes(300)])
    on_air = {row["sender"]: row["on_air_ns"] for row in drained(subject)}
    assert on_air["v2"] < on_air["v0"] + airtime_ns(1000, 6.0)
    outcomes = {(row["sender"], row["receiver"]): row["outcome"] for row in drained(subject)}
    assert outcomes["v0", "v1"] == outcomes["v2", "v1"] == "collided"
    assert outcomes["v2", "v3"] == "delivered"
    assert outcomes["v0", "v3"] == "faded", "it is too far away anyway"


def test_a_receiver_stays_with_the_frame_it_has_begun_to_hear() -> None:
    """The later one is 7 dB stronger at v1 and v3, and lost at v1, which hears the earlier one: no capture."""
    subject = engine(line(0, 500, 725, 515), mac={}, path_loss={"kind": "log_distance", "exponent": 2.0})
    subject.transmit(0, 0, [bytes(1000)])
    subject.transmit(300 * US, 2, [bytes(100)])
    outcomes = {(row["sender"], row["receiver"]): row["outcome"] for row in drained(subject)}
    assert outcomes["v2", "v1"] == outcomes["v0", "v1"] == "collided"
    assert outcomes["v2", "v3"] == "delivered", "v3 is just out of v0's reach"


def test_on_a_disc_all_signals_are_equally_strong() -> None:
    subject = engine(line(0, 90, 180), mac={}, range_m=100)
    subject.transmit(0, 0, [bytes(300)])
    subject.transmit(50 * US, 2, [bytes(300)])
    subject.transmit(20 * MS, 0, [bytes(300)])
    outcomes = Counter((row["sender"], row["seq"], row["receiver"], row["outcome"]) for row in drained(subject))
    collided = {(sender, 0, "v1", "collided"): 1 for sender in ("v0", "v2")}
    assert outcomes == collided | {("v0", 1, "v1", "delivered"): 1}


def test_a_full_queue_and_oversize_are_as_without_a_medium() -> None:
    subject = engine(line(0, 50), mac={}, path_loss={"kind": "free_space"}, queue_frames=2, max_payload_bytes=500)
    subject.transmit(0, 0, [bytes(501), *[bytes(500)] * 4])
    assert [row["outcome"] for row in drained(subject)] == ["oversize", *["delivered"] * 2, *["queue_full"] * 2]
    assert [row["on_air_ns"] is None for row in drained(subject)] == [True, False, False, True, True]


@pytest.mark.slow
def test_a_throttled_sender_has_no_longer_a_queue_than_others() -> None:
    """Six want more than twice what the medium has room for; v0's frames come to it slowly, but not too slowly."""
    subject = engine(line(*range(0, 60, 10)), mac={}, path_loss={"kind": "free_space"}, queue_frames=4)
    slow = Throttle(kind="throttle", bitrate_mbps=5.0, **VILLAIN)  # 2.24 ms a frame
    subject.set_faults([planned(0, slow, (0, 10**10), 6, 0)], 0)
    for number in range(200):
        for node in range(6):
            subject.transmit(number * 5 * MS + node * 300 * US, node, [bytes(1400)])
    subject.drain()
    trace = subject.trace.rows(slice(None))
    mine = trace[(trace["sender"] == 0) & (trace["receiver"] == 1)]
    full = mine["outcome"] == Outcome.queue_full
    assert 80 < full.sum() < 180
    sent, waits = mine[~full]["sent_ns"], mine[~full]["on_air_ns"]
    waiting = [np.count_nonzero((sent <= time_ns) & (waits > time_ns)) for time_ns in sent]
    assert max(waiting) == 4 + 1, "and one that is still on its way to the queue"
    assert np.all(mine[full]["left_ns"] >= mine[full]["sent_ns"])


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(seeds, crowds, options)
def test_every_pair_has_one_outcome_and_what_collided_met_a_frame_in_its_receivers_range(
    seed: int, sends: list[Send], radio: dict[str, Any]
) -> None:
    """Another's that overlapped it, or its receiver's own."""
    position_m = scattered(6, seed, side_m=3000.0)
    subject = engine(position_m, seed, **PHYSICAL | radio)
    run(subject, sends)
    table = drained(subject)
    keys = {(row["sender"], row["seq"], row["receiver"]) for row in table}
    assert len(keys) == len(table)
    assert {o.name: n for o, n in subject.counts.items() if n and o is not Outcome.out_of_range} == Counter(
        row["outcome"] for row in table
    )
    on_air = {
        (row["sender"], row["seq"]): (row["on_air_ns"], row["on_air_ns"] + airtime_ns(row["size_bytes"], 6.0))
        for row in table
        if row["on_air_ns"] is not None
    }
    for row in table:
        if row["outcome"] == "collided":
            mine = on_air[row["sender"], row["seq"]]
            others = [
                times
                for (sender, seq), times in on_air.items()
                if sender == row["receiver"] or (sender != row["sender"] and (sender, seq, row["receiver"]) in keys)
            ]
            assert any(mine[0] < end and start < mine[1] for start, end in others)


@pytest.mark.slow
def test_the_same_frames_alone_show_what_would_have_arrived() -> None:
    """Outcomes among many vehicles, against those of each frame alone: faded in both, or collided only there."""
    position_m = scattered(12, 3, side_m=900)
    vehicles, lonely = (engine(position_m, 5, **PHYSICAL) for _ in range(2))
    for number in range(40):
        for node in range(12):
            vehicles.transmit(number * 20 * MS + 150 * US * node, node, [bytes(300)])
            lonely.transmit((number * 12 + node) * 20 * MS, node, [bytes(300)])
    vehicles.drain()
    alone = {(row["sender"], row["seq"], row["receiver"]): row["outcome"] for row in drained(lonely)}
    assert set(alone.values()) == {"delivered", "faded"}
    seen = Counter((alone[row["sender"], row["seq"], row["receiver"]], row["outcome"]) for row in drained(vehicles))
    assert set(seen) == {("faded", "faded"), ("delivered", "delivered"), ("delivered", "collided")}
