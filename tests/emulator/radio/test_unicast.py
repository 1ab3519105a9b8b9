"""Frames to single vehicles: every one ends, is delivered once, and keeps to the rules of 802.11p."""

from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emulator.radio.dot11p import AIFSN_AND_CW, MAX_WINDOW, SIFS_NS, SLOT_NS, airtime_ns
from emulator.radio.engine import Engine
from emulator.radio.frames import Receptions, Transmission, UnicastResult
from emulator.radio.unicast import ACK_BYTES, ACK_TIMEOUT_NS, EIFS_NS, MOST_ATTEMPTS, ack_airtime_ns
from tests.support.radio import drained, engine, line
from vnet.radio import SentFrame

MS = 1_000_000
LATENCY_NS = 2 * MS
PHYSICAL: dict[str, Any] = {"path_loss": {"kind": "log_distance"}, "mac": {}, "max_peers": 1000}
AIFS_NS = SIFS_NS + AIFSN_AND_CW["BE"][0] * SLOT_NS
ACK_NS = ack_airtime_ns(6.0)

sends = st.lists(
    st.tuples(st.integers(0, 40).map(lambda tenth: tenth * MS // 10), st.integers(0, 4), st.integers(0, 6)),
    min_size=1,
    max_size=12,
)
"""Frames: time, sender, and addressee: one of five vehicles, or nobody, or all."""
radios = st.fixed_dictionaries(
    {
        "mac": st.fixed_dictionaries({"access_category": st.sampled_from([*AIFSN_AND_CW]), "eifs": st.booleans()}),
        "loss": st.sampled_from([0.0, 0.4, 0.9]),
        "fading": st.sampled_from([None, {}]),
        "max_peers": st.sampled_from([2, 1000]),
        "queue_frames": st.sampled_from([1, 64]),
        "access_jitter_ms": st.sampled_from([0.0, 1.0]),
    }
)


def transmit(
    subject: Engine, frames: list[tuple[int, int, int]], stops: list[int] | None = None
) -> list[UnicastResult]:
    """Send, with looks at the engine at `stops`; returns the results."""
    results = []
    numbers = [0] * 5
    for time_ns in sorted({frame[0] for frame in frames} | set(stops or ())):
        if stops is not None:
            subject.advance(time_ns)
            results += subject.take_results(time_ns)
        for _, sender, to in [frame for frame in frames if frame[0] == time_ns]:
            payload = bytes([sender]) * 200
            alone = SentFrame(f"v{sender}", payload, to=f"v{to}", number=numbers[sender])
            numbers[sender] += to < 6
            subject.transmit(time_ns, sender, [alone if to < 6 else payload])
    subject.drain()
    return results + subject.take_results(10**12)


def rows_of(subject: Engine) -> list[dict[str, Any]]:
    return subject.trace.to_table().to_pylist()


@pytest.mark.slow
@settings(max_examples=20, deadline=None)
@given(sends, radios, st.integers(0, 1000), st.lists(st.integers(0, 60 * MS), max_size=12))
def test_every_frame_ends_and_is_delivered_at_most_once(
    frames: list[tuple[int, int, int]], radio: dict[str, Any], seed: int, stops: list[int]
) -> None:
    position_m = np.random.default_rng(seed).uniform(0, 700, (5, 2))
    plain, looked_at = (engine(position_m, seed, **{**PHYSICAL, **radio}) for _ in range(2))
    results = transmit(plain, frames)
    assert transmit(looked_at, frames, stops) == results
    rows = rows_of(plain)
    assert rows_of(looked_at) == rows
    unicasts = [frame for frame in frames if frame[2] < 6]
    assert sorted((r.sender, r.number) for r in results) == sorted(
        (sender, number) for sender in range(5) for number in range(sum(frame[1] == sender for frame in unicasts))
    )
    exchanges: dict[tuple[str, int], list[dict[str, Any]]] = {}
    for row in rows:
        if row.get("attempt"):
            exchanges.setdefault((row["sender"], row["seq"]), []).append(row)
    assert sum(result.attempts for result in results) == sum(
        row["on_air_ns"] is not None for of_one in exchanges.values() for row in of_one
    )
    assert sum(result.delivered for result in results) == sum(
        any(row["acked"] for row in of_one) for of_one in exchanges.values()
    )
    for attempts in exchanges.values():
        attempts.sort(key=lambda row: row["attempt"])
        assert [row["attempt"] for row in attempts] == list(range(1, len(attempts) + 1))
        assert len(attempts) <= MOST_ATTEMPTS
        assert not any(row["acked"] for row in attempts[:-1])
        assert sum(row["outcome"] == "delivered" for row in attempts) <= 1
        for row in attempts:
            assert row["outcome"] in ("delivered", "duplicate") or not row["acked"]
            if row["ack_on_air_ns"] is not None:
                assert row["ack_on_air_ns"] == row["left_ns"] + SIFS_NS
    for result in results:
        assert result.delivered or result.attempts in (0, MOST_ATTEMPTS)


@pytest.mark.slow
@settings(max_examples=8, deadline=None)
@given(st.sampled_from([*AIFSN_AND_CW]), st.integers(0, 10_000))
def test_the_window_doubles_until_the_largest(category: str, seed: int) -> None:
    subject = engine(line(0, 5000), seed, **{**PHYSICAL, "mac": {"access_category": category}})
    (result,) = transmit(subject, [(0, 0, 1)])
    rows = rows_of(subject)
    aifsn, window = AIFSN_AND_CW[category]
    assert (result.delivered, result.attempts, len(rows)) == (False, MOST_ATTEMPTS, MOST_ATTEMPTS)
    assert {row["outcome"] for row in rows} == {"out_of_range"}
    for before, after in pairwise(rows):
        waited_ns = after["on_air_ns"] - before["left_ns"] - ACK_TIMEOUT_NS - SIFS_NS - aifsn * SLOT_NS
        slots, rest = divmod(waited_ns, SLOT_NS)
        window = min(2 * window + 1, MAX_WINDOW[category])
        assert rest == 0 and 0 <= slots <= window
    last_ns = rows[-1]["left_ns"] + ACK_TIMEOUT_NS
    assert result.time_ns == last_ns + LATENCY_NS


@pytest.mark.slow
def test_windows_are_drawn_evenly() -> None:
    subject = engine(line(0, 5000), 7, **{**PHYSICAL, "queue_frames": 500})
    transmit(subject, [(0, 0, 1)] * 200)
    rows = rows_of(subject)
    ends_ns = {(row["seq"], row["attempt"]): row["left_ns"] + ACK_TIMEOUT_NS + AIFS_NS for row in rows}
    slots = [(row["on_air_ns"] - ends_ns[row["seq"], 1]) // SLOT_NS for row in rows if row["attempt"] == 2]
    assert len(slots) == 200 and min(slots) == 0 and max(slots) == 31
    assert np.mean(slots) == pytest.approx(15.5, abs=2.0)


def test_a_result_comes_a_lookahead_after_the_acknowledgement() -> None:
    subject = engine(line(0, 100), **PHYSICAL)
    (result,) = transmit(subject, [(0, 0, 1)])
    (row,) = rows_of(subject)
    assert row["left_ns"] == AIFS_NS + airtime_ns(200, 6.0)
    assert result == UnicastResult(row["left_ns"] + SIFS_NS + ACK_NS + LATENCY_NS, 0, 0, True, 1)


def test_others_keep_silent_until_an_acknowledgement_that_they_cannot_sense_has_ended() -> None:
    """v2 hears v0, and not v1: its frame waits for AIFS after the reserved time, and not after what it senses."""
    for to, silent_ns in ((1, SIFS_NS + ACK_NS), (6, 0)):
        subject = engine(line(0, 350, -350), **PHYSICAL)
        subject.transmit(0, 0, [SentFrame("v0", bytes(200), to=f"v{to}" if to < 6 else None)])
        subject.transmit(AIFS_NS + 50_000, 2, [bytes(200)])
        first, second = (next(row for row in drained(subject) if row["sender"] == f"v{n}") for n in (0, 2))
        slots, rest = divmod(second["on_air_ns"] - first["left_ns"] - silent_ns - AIFS_NS, SLOT_NS)
        assert rest == 0 and 0 <= slots <= 15


def test_a_backoff_that_counts_stops_where_a_frame_is_read_and_not_sensed() -> None:
    """v2 has a frame behind it, and so a backoff; it reads the frame of v0 below its carrier sense."""
    radio = {**PHYSICAL, "mac": {"carrier_sense_dbm": -60.0}, "receiver": {"min_rssi_dbm": -82.0}}
    silent_ns, waited = SIFS_NS + ACK_NS + AIFS_NS, 0
    for start_ns in range(330_000, 420_000, 5_000):
        subject = engine(line(0, -50, 300), start_ns, **radio)
        subject.transmit(0, 2, [bytes(200)])
        subject.transmit(start_ns, 0, [SentFrame("v0", bytes(20), to="v1")])
        subject.transmit(start_ns, 2, [bytes(200)])
        rows = drained(subject)
        left_ns = next(row["left_ns"] for row in rows if row["sender"] == "v0")
        after_ns = next(row["on_air_ns"] for row in rows if (row["sender"], row["seq"]) == ("v2", 1)) - left_ns
        slots, rest = divmod(after_ns - silent_ns, SLOT_NS)
        assert after_ns <= 0 or (rest == 0 and 0 <= slots <= 15)
        waited += after_ns > 0
    assert waited > 5


@pytest.mark.slow
def test_no_frame_overlaps_an_acknowledgement_where_all_can_read_its_frame() -> None:
    subject = engine(line(0, 30, 60, 90, 120), 5, **PHYSICAL)
    rng = np.random.default_rng(5)
    frames = [(int(rng.integers(0, 100)) * MS // 10, n % 5, (n + 1 + n // 5 % 4) % 5) for n in range(60)]
    transmit(subject, [(time_ns, sender, to) for time_ns, sender, to in frames if sender != to])
    rows = rows_of(subject)
    acks = [row["ack_on_air_ns"] for row in rows if row["ack_on_air_ns"] is not None]
    assert len(acks) > 30
    for begin_ns in acks:
        assert not [row for row in rows if row["on_air_ns"] < begin_ns + ACK_NS and row["left_ns"] > begin_ns]


@pytest.mark.parametrize("eifs", [False, True])
def test_who_cannot_decode_a_broadcast_waits_longer_only_if_asked_to(eifs: bool) -> None:
    """v1 detects the frame of v0 at 27 Mbit/s, and cannot decode it."""
    subject = engine(line(0, 400), **{**PHYSICAL, "mac": {"eifs": eifs}})
    subject.transmit(0, 0, [SentFrame("v0", bytes(300), rate_mbps=27.0)])
    subject.transmit(AIFS_NS + 50_000, 1, [bytes(200)])
    first, second = drained(subject)
    assert first["outcome"] == "faded"
    slots, rest = divmod(second["on_air_ns"] - first["left_ns"] - AIFS_NS - (EIFS_NS if eifs else 0), SLOT_NS)
    assert rest == 0 and 0 <= slots <= 15


@pytest.mark.slow
def test_a_lost_acknowledgement_has_the_frame_sent_again_and_delivered_once() -> None:
    subject = engine(line(0, 50), 3, **{**PHYSICAL, "loss": 0.5})
    results = transmit(subject, [(0, 0, 1)] * 40)
    assert len(results) == 40 and not subject.advance(10**10)  # all has been decided
    duplicates = 0
    for number, result in enumerate(results):
        outcomes = [row["outcome"] for row in rows_of(subject) if row["seq"] == number]
        assert outcomes.count("delivered") <= 1 and len(outcomes) == result.attempts
        duplicates += outcomes.count("duplicate")
    assert duplicates > 10


def test_a_vehicle_that_is_down_acknowledges_nothing_and_is_told_nothing() -> None:
    subject = engine(line(0, 50), **PHYSICAL)
    subject.set_up(1, False)
    assert transmit(subject, [(0, 0, 1)])[0][3:] == (False, MOST_ATTEMPTS)
    subject = engine(line(0, 50), **PHYSICAL)
    subject.transmit(0, 0, [SentFrame("v0", b"x", to="v1")])
    subject.set_up(0, False)
    assert subject.take_results(10**12) == [] and drained(subject)[0]["acked"]
    assert subject.next_result_ns() is None


def test_a_vehicle_that_comes_back_between_attempts_receives_the_first_that_finds_it() -> None:
    """Attempts that reach it while it is down are `receiver_down`, and none of them has been received."""
    subject = engine(line(0, 50), **PHYSICAL)
    subject.transmit(0, 0, [SentFrame("v0", bytes(200), to="v1")])
    subject.advance(200_000)
    subject.set_up(1, False)  # while the first attempt is on air
    arrived = list(subject.advance(3 * MS))
    subject.set_up(1, True)
    arrived += list(subject.advance(1000 * MS))
    *before, last = rows_of(subject)
    assert before and {row["outcome"] for row in before} == {"receiver_down"}
    assert (last["outcome"], last["acked"]) == ("delivered", True)
    assert [result.delivered for result in subject.take_results(10**12)] == [True] and len(arrived) == 1


def lose_acknowledgements(subject: Engine) -> Callable[[], None]:
    """Have nobody receive acknowledgements, until what this returns is called."""
    mac = subject._mac
    judge = mac.judge

    def judge_frames_alone(transmissions: Sequence[Transmission], receptions: Receptions) -> None:
        judge(transmissions, receptions)
        for sent in transmissions:
            if not sent.attempt and sent.frame.size_bytes == ACK_BYTES and sent.decoded is not None:
                sent.decoded[:] = False

    def hear_again() -> None:
        mac.judge = judge  # type: ignore[method-assign]

    mac.judge = judge_frames_alone  # type: ignore[method-assign]
    return hear_again


@pytest.mark.parametrize("comes_back", [False, True])
def test_an_attempt_after_one_that_found_nobody_in_the_end_is_no_duplicate(comes_back: bool) -> None:
    """Its addressee acknowledges it and goes down before it arrives; its sender misses the acknowledgement."""
    subject = engine(line(0, 50), **PHYSICAL)
    hear_again = lose_acknowledgements(subject)
    subject.transmit(0, 0, [SentFrame("v0", bytes(200), to="v1")])
    subject.advance(LATENCY_NS)
    rows = rows_of(subject)
    assert len(rows) > 1 and {row["outcome"] for row in rows[1:]} == {"duplicate"}
    subject.set_up(1, False)
    arrived = list(subject.advance(LATENCY_NS + 1_000_000))
    if comes_back:
        subject.set_up(1, True)
        hear_again()
    arrived += list(subject.advance(1000 * MS))
    outcomes = [row["outcome"] for row in rows_of(subject)]
    assert len(arrived) == outcomes.count("delivered") == int(comes_back)
    if comes_back:
        assert (outcomes[0], outcomes[-1]) == ("receiver_down", "delivered")
    else:
        assert set(outcomes) == {"receiver_down"} and len(outcomes) == MOST_ATTEMPTS
    counts = {outcome.name: count for outcome, count in subject.counts.items() if count}
    assert counts == {name: outcomes.count(name) for name in outcomes}


@pytest.mark.parametrize("seed", [3, 4, 6])
def test_what_becomes_of_an_attempt_does_not_depend_on_the_looks_at_the_engine(seed: int) -> None:
    """With much jitter attempts would arrive before the one that was received first, which finds nobody."""

    def outcomes(stops: Iterable[int]) -> list[str]:
        subject = engine(line(0, 50), seed, **{**PHYSICAL, "jitter_ms": 20.0})
        lose_acknowledgements(subject)
        subject.transmit(0, 0, [SentFrame("v0", bytes(200), to="v1")])
        subject.advance(LATENCY_NS - 500_000)
        subject.set_up(1, False)
        for stop_ns in stops:
            subject.advance(stop_ns)
        return [row["outcome"] for row in drained(subject)]

    at_once = outcomes([])
    assert outcomes(range(LATENCY_NS, 60 * MS, 100_000)) == at_once
    assert at_once[:2] == ["receiver_down", "duplicate"] and len(at_once) == MOST_ATTEMPTS
