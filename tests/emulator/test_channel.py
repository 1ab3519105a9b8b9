"""The stages of the channel one by one: each decides what is its business, and draws only what it must."""

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binom

from emulator.channel.draws import Draws
from emulator.channel.outcomes import Outcome
from emulator.channel.stages import (
    NO_CAUSE,
    Frame,
    InRange,
    Latency,
    Loss,
    Pairs,
    PayloadLimit,
    PeerCap,
    Stage,
    Topology,
    TransmitQueue,
)
from emulator.engine import Engine
from vnet.scenario import Radio

MS = 1_000_000
seeds = st.integers(0, 2**63 - 1)
frames_of = st.tuples(st.integers(0, 10_000), st.integers(0, 2**40))
lattice = st.lists(st.tuples(st.integers(-3, 3), st.integers(-3, 3)), min_size=1, max_size=12)


def radio(**changes: float) -> Radio:
    return Radio.model_validate(changes)


def pairs(count: int, sent_ns: int = 0, outcome: Sequence[Outcome] | None = None) -> Pairs:
    decided = np.zeros(count, np.uint8) if outcome is None else np.array(outcome, np.uint8)
    return Pairs(decided, np.full(count, sent_ns, np.int64), np.full(count, NO_CAUSE, np.int16))


def sent(stage: Stage, count: int, seq: int = 0, sender: int = 0, sent_ns: int = 0, size: int = 100) -> Pairs:
    """One frame through one stage."""
    result = pairs(count, sent_ns)
    stage(Frame(sender, seq, sent_ns, size), result)
    return result


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
    assert np.array_equal(used.uniform(*frame, count + 3)[:count], fresh), "one more receiver moves nobody's draw"
    assert np.all((fresh >= 0) & (fresh < 1))


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
    chain = Engine(["a", "b", "c"], strict, 1, np.zeros((3, 2)), None).chain
    for decided in set(Outcome) - {Outcome.pending}:
        for stage in chain:
            subject = pairs(3, outcome=[decided] * 3)
            stage(Frame(0, 0, 0, 11), subject)
            assert subject.outcome.tolist() == [decided] * 3


def test_the_range_is_a_closed_disc_without_its_centre() -> None:
    position = np.array([[0.0, 0.0], [3000.0, 0.0], [0.0, np.nextafter(3000.0, 4000.0)], [1800.0, 2400.0]])
    heard = sent(InRange(Topology(position, 3000.0, 30)), 4).outcome
    assert [Outcome(o).name for o in heard] == ["out_of_range", "pending", "out_of_range", "pending"]


@settings(max_examples=60, deadline=None)
@given(lattice, st.integers(1, 5), st.integers(1, 6), st.sets(st.integers(0, 11), max_size=4))
def test_the_cap_is_the_nearest_live_senders_and_ties_go_to_the_lower_number(
    places: list[tuple[int, int]], cap: int, reach: int, down: set[int]
) -> None:
    topology = Topology(np.array(places, float), float(reach), cap)
    count = len(places)
    for node in down & set(range(count)):
        topology.set_up(node, False)

    def squared(a: int, b: int) -> int:
        return sum((x - y) ** 2 for x, y in zip(places[a], places[b], strict=True))

    stage = PeerCap(topology)
    admitted = [sent(stage, count, sender=sender).outcome == Outcome.pending for sender in range(count)]
    for receiver in range(count):
        live = [s for s in range(count) if s != receiver and s not in down and squared(s, receiver) <= reach**2]
        nearest = sorted(live, key=lambda s, r=receiver: (squared(s, r), s))[:cap]
        assert [s for s in range(count) if admitted[s][receiver]] == sorted(nearest)


def test_a_death_lets_the_next_one_in_and_a_restart_puts_it_out_again() -> None:
    topology = Topology(np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [3.0, 0.0]]), 3000.0, 2)
    assert topology.admitted[:, 0].tolist() == [False, True, True, False]
    topology.set_up(1, False)
    topology.move(np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [3.0, 0.0]]))
    assert topology.admitted[:, 0].tolist() == [False, False, True, True], "moving raises nobody from the dead"
    topology.set_up(1, True)
    assert topology.admitted[:, 0].tolist() == [False, True, True, False]


@pytest.mark.parametrize(("size", "outcome"), [(0, "pending"), (1400, "pending"), (1401, "oversize")])
def test_the_payload_limit_is_the_last_size_that_passes(size: int, outcome: str) -> None:
    assert {Outcome(o).name for o in sent(PayloadLimit(1400), 3, size=size).outcome} == {outcome}


def expected_queue(sends: list[tuple[int, int]], limit: int) -> list[int | None]:
    """When each frame of one sender has left it at 1 µs a byte without access jitter; None where there was no room."""  # noqa: E501
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


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 2_000_000), st.integers(0, 1400)), min_size=1, max_size=25),
    st.integers(1, 4),
)
def test_the_queue_fills_and_drains_with_the_bit_rate(gaps: list[tuple[int, int]], limit: int) -> None:
    times = np.cumsum([gap for gap, _ in gaps]).tolist()
    sends = [(time, size) for time, (_, size) in zip(times, gaps, strict=True)]
    stage = TransmitQueue(1, radio(access_jitter_ms=0, bitrate_mbps=8, queue_frames=limit))
    left = []
    for seq, (time_ns, size) in enumerate(sends):
        done = sent(stage, 2, seq, 0, time_ns, size)
        full = done.outcome == Outcome.queue_full
        assert full.all() or not full.any(), "a queue has no favourites"
        left.append(None if full.any() else int(done.arrival_ns[0]))
    assert left == expected_queue(sends, limit)


def test_oversize_frames_and_other_senders_take_no_place_in_a_queue() -> None:
    stage = TransmitQueue(1, radio(access_jitter_ms=0, bitrate_mbps=8, queue_frames=1, max_payload_bytes=100))
    assert int(sent(stage, 2, 0, size=100).arrival_ns[0]) == 100_000
    for seq in range(1, 5):
        assert (sent(stage, 2, seq, size=101).outcome == Outcome.pending).all()
    assert int(sent(stage, 2, 5, size=100).arrival_ns[0]) == 200_000
    assert (sent(stage, 2, 6, size=100).outcome == Outcome.queue_full).all()
    assert int(sent(stage, 2, 0, sender=1, size=100).arrival_ns[0]) == 100_000


def test_access_is_delayed_by_up_to_the_jitter_and_differently_each_time() -> None:
    stage = TransmitQueue(7, radio(access_jitter_ms=5, bitrate_mbps=8))
    delays = np.array(
        [sent(stage, 2, seq, 0, seq * 100 * MS, 100).arrival_ns[0] - seq * 100 * MS for seq in range(200)]
    )
    delays -= 100_000
    assert np.all((delays >= 0) & (delays < 5 * MS))
    assert delays.min() < MS
    assert delays.max() > 4 * MS


@pytest.mark.parametrize("loss", [0.01, 0.1, 0.5, 0.93])
@pytest.mark.parametrize("seed", [0, 1, 2**62])
def test_loss_lies_in_its_band_for_the_run_and_for_each_receiver(loss: float, seed: int) -> None:
    stage, frames, receivers = Loss(seed, loss), 400, 25
    lost = np.array([sent(stage, receivers, seq).outcome == Outcome.lost for seq in range(frames)])
    low, high = binom.interval(0.999, frames * receivers, loss)
    assert low <= lost.sum() <= high
    low, high = binom.interval(1 - 0.001 / receivers, frames, loss)
    assert np.all((low <= lost.sum(axis=0)) & (lost.sum(axis=0) <= high))


@settings(max_examples=30, deadline=None)
@given(seeds, st.floats(0, 1), st.floats(0, 1))
def test_more_loss_loses_more_of_the_same_pairs(seed: int, one: float, other: float) -> None:
    few, many = (sent(Loss(seed, loss), 50).outcome == Outcome.lost for loss in sorted((one, other)))
    assert np.all(many[few])
    assert not (sent(Loss(seed, 0.0), 50).outcome == Outcome.lost).any()
    assert (sent(Loss(seed, 1.0), 50).outcome == Outcome.lost).all()


@settings(max_examples=60, deadline=None)
@given(seeds, st.integers(0, 5000), st.floats(0.001, 50), st.floats(0, 50), st.integers(0, 10**15))
def test_latency_is_within_its_bounds_and_rounded_up_by_less_than_a_tick(
    seed: int, tick_us: int, latency_ms: float, jitter_ms: float, sent_ns: int
) -> None:
    shape = {"latency_ms": latency_ms, "jitter_ms": jitter_ms}
    exact = sent(Latency(seed, radio(**shape)), 20, sent_ns=sent_ns).arrival_ns
    ticked = sent(Latency(seed, radio(**shape, delivery_tick_us=tick_us)), 20, sent_ns=sent_ns).arrival_ns
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
    arrivals = sent(Latency(3, radio(latency_ms=2, jitter_ms=4)), 500).arrival_ns
    assert len(set(arrivals.tolist())) == 500
    assert arrivals.min() < 2.2 * MS
    assert arrivals.max() > 5.8 * MS
