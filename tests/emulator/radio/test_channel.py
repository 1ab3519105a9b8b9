"""The stages of the channel one by one: each decides what is its business, and draws only what it must."""

from typing import NamedTuple
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from emulator.radio.engine import Engine
from emulator.radio.faults import ActiveLinkFaults
from emulator.radio.frames import Frame, Receptions, Stage, Transmission
from emulator.radio.mac import TransmitQueue
from emulator.radio.outcomes import Outcome
from emulator.radio.reception import LatencyStage, LossStage, in_range, peer_cap, sender_side
from emulator.radio.topology import Disc, Topology
from emulator.records.distributions import binomial_interval
from emulator.scenario.random_streams import Draws, philox_words_at, uniform_of
from emulator.scenario.scenario import Radio
from tests.support.radio import drained

MS = 1_000_000
seeds = st.integers(0, 2**63 - 1)
frames_of = st.tuples(st.integers(0, 10_000), st.integers(0, 2**40))
lattice = st.lists(st.tuples(st.integers(-3, 3), st.integers(-3, 3)), min_size=1, max_size=12)


def radio(**changes: float) -> Radio:
    return Radio.model_validate(changes)


class Row(NamedTuple):
    """The receptions of one frame, by receiver."""

    outcome: NDArray[np.uint8]
    arrival_ns: NDArray[np.int64]


def frame_of(
    sender: int = 0, seq: int = 0, sent_ns: int = 0, size: int = 100, among: Topology | None = None
) -> Transmission:
    """A frame that has been sent without taking any time."""
    topology = (among or Topology(np.zeros((1, 2)), Disc(1.0), 1)).now
    frame = Frame(
        sender=sender,
        seq=seq,
        sent_ns=sent_ns,
        payload=bytes(size),
        topology=topology,
        effects=ActiveLinkFaults(),
        bitrate_mbps=8.0,
    )
    return Transmission(frame, end_ns=sent_ns)


def sent(
    stage: Stage, count: int, seq: int = 0, sender: int = 0, sent_ns: int = 0, among: Topology | None = None
) -> Row:
    """One frame through one stage: its outcomes and arrivals."""
    frame = frame_of(sender, seq, sent_ns, among=among)
    receptions = Receptions.of([frame], count)
    stage([frame], receptions)
    return Row(receptions.outcome[0], receptions.arrival_ns[0])


def queued(queue: TransmitQueue, seq: int, sender: int = 0, time_ns: int = 0, size: int = 100) -> int | None:
    """Enqueue a frame of 8 Mb/s; return the end of its transmission, or None if the queue was full."""
    frame = frame_of(sender, seq, time_ns, size)
    queue.enqueue([frame])
    assert queue.sent.pop() is frame
    return frame.end_ns if frame.sender_outcome == Outcome.pending else None


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(seeds, frames_of, st.integers(1, 40), st.lists(st.tuples(frames_of, st.integers(1, 9)), max_size=4))
def test_draws_depend_on_the_frame_and_not_on_what_was_drawn_before(
    seed: int, frame: tuple[int, int], count: int, before: list[tuple[tuple[int, int], int]]
) -> None:
    fresh = Draws(seed, "loss").uniform(*frame, count)
    used = Draws(seed, "loss")
    for other, number in before:
        used.uniform(*other, number)
    assert np.array_equal(used.uniform(*frame, count), fresh)
    assert np.array_equal(used.uniform(*frame, count + 3)[:count], fresh), "another receiver changes no other draw"
    assert np.all((fresh >= 0) & (fresh < 1))


@pytest.mark.slow
@given(seeds, st.lists(st.tuples(frames_of, st.integers(0, 99)), min_size=1, max_size=6), st.data())
def test_single_draws_are_those_of_the_frames_whole_vectors(
    seed: int, frames: list[tuple[tuple[int, int], int]], data: st.DataObject
) -> None:
    receivers = [data.draw(st.lists(st.integers(0, 70), max_size=9)) for _ in frames]
    draws = Draws(seed, "loss")
    expected = [
        float(draws.uniform(*frame, 71, copy)[receiver])
        for (frame, copy), some in zip(frames, receivers, strict=True)
        for receiver in some
    ]
    keys = np.array([(*frame, copy) for frame, copy in frames], np.uint64)
    each, receiver = (
        np.array([len(some) for some in receivers]),
        np.array([r for some in receivers for r in some], np.intp),
    )
    assert draws.uniform_at(keys, each, receiver).tolist() == expected
    alone = philox_words_at(draws.key, np.repeat(keys, each, axis=0), receiver)
    assert uniform_of(alone).tolist() == expected


def test_many_single_draws_are_computed_alone_and_few_are_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thousand frames to a dozen of a thousand receivers: no vector of a thousand draws is made for any."""
    rng = np.random.default_rng(4)
    keys = np.column_stack([np.arange(1000), rng.integers(0, 2**40, 1000), np.zeros(1000)]).astype(np.uint64)
    each, receiver = np.full(1000, 12), rng.integers(0, 1000, 12_000)
    draws, frame = Draws(3, "loss"), keys[17].tolist()
    expected = draws.uniform(frame[0], frame[1], 1000)[receiver[17 * 12 : 18 * 12]]
    monkeypatch.setattr(Draws, "uniform", Mock(side_effect=AssertionError))
    assert draws.uniform_at(keys, each, receiver)[17 * 12 : 18 * 12].tolist() == expected.tolist()
    with pytest.raises(AssertionError):
        draws.uniform_at(keys[:1], each[:1], receiver[:12])


def test_seed_stage_sender_and_sequence_each_give_other_draws() -> None:
    streams = {
        tuple(Draws(seed, stage).uniform(sender, seq, 8))
        for seed in (0, 1)
        for stage in ("loss", "latency")
        for sender in (0, 1)
        for seq in (0, 1)
    }
    assert len(streams) == 16
    assert len({draw for stream in streams for draw in stream}) == 16 * 8, "no stream is another one shifted"


def test_a_pair_that_is_decided_stays_decided() -> None:
    strict = radio(loss=1.0, max_payload_bytes=10, max_peers=1)
    engine = Engine(["a", "b", "c"], strict, 1, np.zeros((3, 2)), None)
    among = Topology(np.zeros((3, 2)), Disc(1.0), 1)
    for decided in set(Outcome) - {Outcome.pending}:
        for stage in (*engine.deciding, *engine.timing):
            frame = frame_of(size=11, among=among)
            frame.sender_outcome = Outcome.oversize
            subject = Receptions.of([frame], 3)
            subject.outcome[:] = decided
            stage([frame], subject)
            assert subject.outcome.tolist() == [[decided] * 3]


def test_the_range_is_a_closed_disc_without_its_centre() -> None:
    position = np.array([[0.0, 0.0], [3000.0, 0.0], [0.0, np.nextafter(3000.0, 4000.0)], [1800.0, 2400.0]])
    heard = sent(in_range, 4, among=Topology(position, Disc(3000.0), 30)).outcome
    assert [Outcome(o).name for o in heard] == ["out_of_range", "pending", "out_of_range", "pending"]


@pytest.mark.slow
@given(lattice, st.integers(1, 5), st.integers(1, 6), st.sets(st.integers(0, 11), max_size=4))
def test_the_cap_is_the_nearest_live_senders_and_ties_go_to_the_lower_number(
    places: list[tuple[int, int]], cap: int, reach: int, down: set[int]
) -> None:
    topology = Topology(np.array(places, float), Disc(float(reach)), cap)
    count = len(places)
    for node in down & set(range(count)):
        topology.set_up(node, False)

    def squared(a: int, b: int) -> int:
        return sum((x - y) ** 2 for x, y in zip(places[a], places[b], strict=True))

    admitted = [
        sent(peer_cap, count, sender=sender, among=topology).outcome == Outcome.pending for sender in range(count)
    ]
    for receiver in range(count):
        live = [s for s in range(count) if s != receiver and s not in down and squared(s, receiver) <= reach**2]
        nearest = [s for _, s in sorted((squared(s, receiver), s) for s in live)][:cap]
        assert [s for s in range(count) if admitted[s][receiver]] == sorted(nearest)


def test_a_death_lets_the_next_one_in_and_a_restart_puts_it_out_again() -> None:
    topology = Topology(np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [3.0, 0.0]]), Disc(3000.0), 2)
    assert topology.now.admitted[:, 0].tolist() == [False, True, True, False]
    topology.set_up(1, False)
    topology.move(np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [3.0, 0.0]]))
    assert topology.now.admitted[:, 0].tolist() == [False, False, True, True], "moving does not set a node up"
    topology.set_up(1, True)
    assert topology.now.admitted[:, 0].tolist() == [False, True, True, False]


@pytest.mark.parametrize(("size", "outcome"), [(0, "pending"), (1400, "pending"), (1401, "oversize")])
def test_the_payload_limit_is_the_last_size_that_passes(size: int, outcome: str) -> None:
    subject = Engine(["a", "b", "c"], radio(max_payload_bytes=1400), 1, np.zeros((3, 2)), None)
    subject.transmit(0, 0, [bytes(size)])
    assert {row["outcome"] for row in subject.trace.to_table().to_pylist()} == {outcome}


def test_what_a_sender_did_not_send_reaches_nobody() -> None:
    frame = frame_of()
    frame.sender_outcome = Outcome.queue_full
    subject = Receptions.of([frame_of(), frame], 2)
    subject.outcome[1, 0] = Outcome.out_of_range
    sender_side([frame_of(), frame], subject)
    assert subject.outcome.tolist() == [[Outcome.pending] * 2, [Outcome.out_of_range, Outcome.queue_full]]


def expected_queue(sends: list[tuple[int, int]], limit: int) -> list[int | None]:
    """Return the end of each frame of one sender at 1 µs a byte without access jitter; None if the queue was full."""  # noqa: E501
    ends: list[int | None] = []
    on_air: list[tuple[int, int]] = []
    for time_ns, size in sends:
        waiting = sum(start > time_ns for start, _ in on_air)
        if waiting >= limit:
            ends.append(None)
            continue
        start = max([time_ns, *(end for _, end in on_air)])
        on_air.append((start, start + size * 1000))
        ends.append(start + size * 1000)
    return ends


@pytest.mark.slow
@given(
    st.lists(st.tuples(st.integers(0, 2_000_000), st.integers(0, 1400)), min_size=1, max_size=25), st.integers(1, 4)
)
def test_the_queue_fills_and_drains_with_the_bit_rate(gaps: list[tuple[int, int]], limit: int) -> None:
    times = np.cumsum([gap for gap, _ in gaps]).tolist()
    sends = [(time, size) for time, (_, size) in zip(times, gaps, strict=True)]
    stage = TransmitQueue(1, radio(access_jitter_ms=0, queue_frames=limit))
    left = [queued(stage, seq, 0, time_ns, size) for seq, (time_ns, size) in enumerate(sends)]
    assert left == expected_queue(sends, limit)


def test_oversize_frames_and_other_senders_take_no_place_in_a_queue() -> None:
    quick = radio(access_jitter_ms=0, bitrate_mbps=8, queue_frames=1, max_payload_bytes=100, latency_ms=0.001)
    subject = Engine(["a", "b", "c"], quick.model_copy(update={"jitter_ms": 0.0}), 1, np.zeros((3, 2)), None)
    subject.transmit(0, 0, [bytes(100), *[bytes(101)] * 4, bytes(100), bytes(100)])
    subject.transmit(0, 1, [bytes(100)])
    rows = [row for row in drained(subject) if row["receiver"] == "c"]
    assert [row["outcome"] for row in rows] == [
        "delivered",
        *["oversize"] * 4,
        "delivered",
        "queue_full",
        "delivered",
    ]
    arrivals = [row["arrival_ns"] for row in rows if row["outcome"] == "delivered"]
    assert arrivals == [101_000, 201_000, 101_000]


def test_access_is_delayed_by_up_to_the_jitter_and_differently_each_time() -> None:
    stage = TransmitQueue(7, radio(access_jitter_ms=5, bitrate_mbps=8))
    ends = [queued(stage, seq, time_ns=seq * 100 * MS) for seq in range(200)]
    delays = np.array([end - seq * 100 * MS for seq, end in enumerate(ends) if end is not None])
    assert len(delays) == 200
    delays -= 100_000
    assert np.all((delays >= 0) & (delays < 5 * MS))
    assert delays.min() < MS
    assert delays.max() > 4 * MS


@pytest.mark.slow
@pytest.mark.parametrize("loss", [0.01, 0.1, 0.5, 0.93])
@pytest.mark.parametrize("seed", [0, 1, 2**62])
def test_loss_lies_in_its_band_for_the_run_and_for_each_receiver(loss: float, seed: int) -> None:
    stage, frames, receivers = LossStage(seed, loss), 400, 25
    lost = np.array([sent(stage, receivers, seq).outcome == Outcome.lost for seq in range(frames)])
    low, high = binomial_interval(0.999, frames * receivers, loss)
    assert low <= lost.sum() <= high
    low, high = binomial_interval(1 - 0.001 / receivers, frames, loss)
    assert np.all((low <= lost.sum(axis=0)) & (lost.sum(axis=0) <= high))


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(seeds, st.floats(0, 1), st.floats(0, 1))
def test_more_loss_loses_more_of_the_same_pairs(seed: int, one: float, other: float) -> None:
    few, many = (sent(LossStage(seed, loss), 50).outcome == Outcome.lost for loss in sorted((one, other)))
    assert np.all(many[few])
    assert not (sent(LossStage(seed, 0.0), 50).outcome == Outcome.lost).any()
    assert (sent(LossStage(seed, 1.0), 50).outcome == Outcome.lost).all()


@settings(max_examples=20, deadline=None)
@given(seeds, st.integers(0, 5000), st.floats(0.001, 50), st.floats(0, 50), st.integers(0, 10**15))
def test_latency_is_within_its_bounds_and_rounded_up_by_less_than_a_tick(
    seed: int, tick_us: int, latency_ms: float, jitter_ms: float, sent_ns: int
) -> None:
    shape = {"latency_ms": latency_ms, "jitter_ms": jitter_ms}
    exact = sent(LatencyStage(seed, radio(**shape)), 20, sent_ns=sent_ns).arrival_ns
    ticked = sent(LatencyStage(seed, radio(**shape, delivery_tick_us=tick_us)), 20, sent_ns=sent_ns).arrival_ns
    delay_ns = exact - sent_ns
    assert np.all(delay_ns >= max(1000, int(latency_ms * MS)))
    assert np.all(delay_ns <= max(1000, (latency_ms + jitter_ms) * MS))
    tick_ns = tick_us * 1000
    if not tick_ns:
        assert np.array_equal(ticked, exact)
        return
    assert np.all(ticked % tick_ns == 0)
    assert np.all((ticked - exact >= 0) & (ticked - exact < tick_ns))


def test_receivers_of_one_frame_hear_it_at_different_times() -> None:
    arrivals = sent(LatencyStage(3, radio(latency_ms=2, jitter_ms=4)), 500).arrival_ns
    assert len(set(arrivals.tolist())) == 500
    assert arrivals.min() < 2.2 * MS
    assert arrivals.max() > 5.8 * MS
