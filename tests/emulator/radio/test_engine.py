"""The engine and its channel: one outcome for every reception, and draws that depend only on what they decide."""

import mmap
import sys
import tracemalloc
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emulator.pages.palette import PALETTE
from emulator.radio.engine import INITIAL_CAPACITY, NO_ARRIVAL_NS, Delivery, Engine
from emulator.radio.outcomes import DRAWN, Outcome, Stage, decided_at
from emulator.radio.trace import Trace
from emulator.scenario.scenario import Radio
from emulator.world.radio_inputs import RadioInputs
from tests.support.radio import drained

PERIOD_NS = 100_000_000
seeds = st.integers(0, 2**63 - 1)


def place(count: int, seed: int, side_m: float = 8000.0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0, side_m, (count, 2))


def engine(position_m: np.ndarray, seed: int = 1, links: np.ndarray | None = None, **radio: float) -> Engine:
    ids = [f"v{number}" for number in range(len(position_m))]
    return Engine(ids, Radio.model_validate(radio), seed, position_m, RadioInputs(links))


def rows(of: Engine) -> list[dict[str, Any]]:
    return of.trace.to_table().to_pylist()


def in_range(position_m: np.ndarray, range_m: float = 3000.0) -> np.ndarray:
    distance = np.linalg.norm(position_m[:, None] - position_m[None], axis=2)
    return (distance <= range_m) & ~np.eye(len(position_m), dtype=bool)


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(st.integers(1, 12), seeds, st.floats(0, 1), st.lists(st.integers(0, 1600), min_size=1, max_size=8))
def test_every_pair_has_exactly_one_outcome(count: int, seed: int, loss: float, sizes: list[int]) -> None:
    position = place(count, seed % 1000)
    subject = engine(position, seed, loss=loss, max_peers=3, queue_frames=2)
    for number, size in enumerate(sizes):
        subject.transmit(number * 1_000_000, number % count, [bytes(size)] * 2)
        if number == 3 and count > 1:
            subject.set_up(0, False)
    table = drained(subject)
    sent = Counter((row["sender"], row["seq"]) for row in table)
    degree = in_range(position).sum(axis=1)
    assert all(number == degree[int(sender[1:])] for (sender, _), number in sent.items())
    keys = [(row["sender"], row["seq"], row["receiver"]) for row in table]
    assert len(set(keys)) == len(keys)
    assert all(row["outcome"] != "pending" for row in table)
    counted = Counter(row["outcome"] for row in table)
    listed = {o.name: n for o, n in subject.counts.items() if n and o is not Outcome.out_of_range}
    assert counted == listed
    frames = sum(subject._next_seq)
    assert len(table) + subject.counts[Outcome.out_of_range] == frames * (count - 1)


def run_all(subject: Engine, order: list[int], steps: int) -> list[Delivery]:
    deliveries: list[Delivery] = []
    for period in range(4):
        for node in order:
            subject.transmit(period * PERIOD_NS, node, [bytes([node, period])])
        for step in range(1, steps + 1):
            deliveries += subject.advance(period * PERIOD_NS + step * PERIOD_NS // steps)
    subject.drain()
    return deliveries


@pytest.mark.slow
@settings(max_examples=15, deadline=None)
@given(seeds, st.permutations(range(6)), st.integers(1, 7))
def test_neither_the_order_of_calls_nor_the_size_of_steps_matters(seed: int, order: list[int], steps: int) -> None:
    position = place(6, seed % 100, 5000)
    one, other = (engine(position, seed, loss=0.2, max_peers=3) for _ in range(2))
    first, second = run_all(one, list(range(6)), 1), run_all(other, order, steps)
    assert one.trace.sha256() == other.trace.sha256()
    assert [(d.receiver, d.packet) for d in first] == [(d.receiver, d.packet) for d in second]


def test_a_receiver_that_is_down_at_the_instant_of_arrival_hears_nothing() -> None:
    subject = engine(np.zeros((3, 2)))
    subject.transmit(0, 0, [b"x"])
    subject.set_up(1, False)
    assert [d.receiver for d in subject.advance(PERIOD_NS)] == [2]
    subject.set_up(1, True)
    subject.transmit(PERIOD_NS, 0, [b"x"])
    assert sorted(d.receiver for d in subject.advance(2 * PERIOD_NS)) == [1, 2]
    assert [row["outcome"] for row in rows(subject)] == ["receiver_down", "delivered", "delivered", "delivered"]


def test_a_sender_that_is_down_sends_nothing_and_goes_on_counting() -> None:
    subject = engine(np.zeros((2, 2)))
    subject.transmit(0, 0, [b"x"])
    subject.set_up(0, False)
    subject.transmit(1, 0, [b"x"])
    subject.set_up(0, True)
    subject.transmit(2, 0, [b"x"])
    assert [row["seq"] for row in drained(subject)] == [0, 1]


def test_what_the_transport_lost_is_said_so() -> None:
    subject = engine(np.zeros((2, 2)))
    subject.transmit(0, 0, [b"x"])
    (delivery,) = subject.advance(PERIOD_NS)
    subject.lose(delivery)
    assert subject.counts[Outcome.transport] == 1
    assert subject.counts[Outcome.delivered] == 0
    assert [row["outcome"] for row in rows(subject)] == ["transport"]


def test_next_times_are_those_of_the_earliest_arrival() -> None:
    subject = engine(place(5, 3, 2000))
    assert subject.next_time() is None
    subject.transmit(0, 0, [b"x"])
    arrivals = {row["receiver"]: row["arrival_ns"] for row in rows(subject)}
    assert subject.next_time() == min(arrivals.values())
    assert all(subject.next_arrivals_ns()[int(r[1:])] == t for r, t in arrivals.items())
    assert subject.next_arrivals_ns()[0] == NO_ARRIVAL_NS


def test_moving_changes_who_hears_from_then_on() -> None:
    subject = engine(np.array([[0.0, 0.0], [1e4, 0.0]]))
    subject.transmit(0, 0, [b"x"])
    subject.set_positions(np.zeros((2, 2)))
    subject.transmit(1, 0, [b"x"])
    subject.drain()
    assert subject.counts[Outcome.out_of_range] == 1
    assert subject.counts[Outcome.delivered] == 1


def heard(subject: Engine) -> set[tuple[str, str]]:
    """Return the links (sender, receiver) with a delivery."""
    return {(row["sender"], row["receiver"]) for row in rows(subject) if row["outcome"] == "delivered"}


def test_in_a_matrix_a_row_is_what_a_receiver_hears_and_the_cap_goes_by_distance() -> None:
    links = np.zeros((4, 4), dtype=bool)
    links[0] = [False, True, True, True]  # vehicle 0 hears all others, and is heard by none
    position = np.array([[0.0, 0.0], [9e3, 0.0], [7e3, 0.0], [8e3, 0.0]])
    subject = engine(position, links=links, max_peers=2)
    for time_ns, down in ((0, []), (PERIOD_NS, [2])):
        for node in down:
            subject.set_up(node, False)
        for node in range(4):
            subject.transmit(time_ns, node, [b"x"])
        subject.advance(time_ns + PERIOD_NS)
        live = {("v2", "v0"), ("v3", "v0")} if not down else {("v1", "v0"), ("v2", "v0"), ("v3", "v0")}
        assert heard(subject) == live
    assert subject.counts[Outcome.peer_cap] == 1, "vehicle 1, as long as vehicle 2 lived"


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 8), seeds)
def test_any_matrix_decides_who_hears_whom(count: int, seed: int) -> None:
    links = np.random.default_rng(seed % 1000).random((count, count)) < 0.5
    np.fill_diagonal(links, False)
    subject = engine(place(count, seed % 1000), seed, links)
    for node in range(count):
        subject.transmit(0, node, [b"x"])
    subject.drain()
    assert heard(subject) == {(f"v{j}", f"v{i}") for i in range(count) for j in range(count) if links[i, j]}


@pytest.mark.parametrize("change", ["payload", "time", "loss"])
def test_the_hash_sees_every_change(change: str) -> None:
    def digest(**changes: Any) -> str:
        subject = engine(np.zeros((3, 2)), loss=changes.get("loss", 0.0))
        subject.transmit(changes.get("time", 0), 0, [changes.get("payload", b"x")])
        subject.drain()
        return subject.trace.sha256()

    assert digest() == digest()
    assert digest() != digest(**{change: {"payload": b"y", "time": 1, "loss": 1.0}[change]})


def trace_of(count: int) -> Trace:
    """Frames of one receiver each, whose digests are their numbers."""
    trace = Trace(["v0", "v1"])
    trace.append(
        {"payload_digest": np.arange(count, dtype=np.uint64), "sent_ns": np.arange(count)},
        np.ones(count, np.intp),
        np.ones(count, np.intp),
        np.full(count, Outcome.delivered, np.uint8),
        np.zeros(count, np.int16),
        np.zeros(count, np.int64),
    )
    return trace


@pytest.mark.parametrize(
    "which",
    [slice(None), slice(3, 9), slice(8, 2, -2), slice(-4, None), np.array([7, 1, 1, 11]), np.array([], int)],
)
def test_what_arrives_with_other_bytes_has_another_digest_whichever_rows_are_asked_for(
    which: slice | np.ndarray,
) -> None:
    trace = trace_of(12)
    for row, payload_digest in ((1, 501), (7, 507), (8, 500), (8, 508)):
        trace.alter(row, payload_digest)
    expected = np.arange(12)
    expected[[1, 7, 8]] += 500
    assert trace.rows(which)["payload_digest"].tolist() == expected[which].tolist()


def test_a_row_of_a_long_trace_in_which_bytes_were_changed_costs_no_more_than_of_a_short_one() -> None:
    """Measured by allocated memory: deliveries look up a few rows at a time."""
    trace = trace_of(100_000)
    trace.alter(5, 1)
    tracemalloc.start()
    trace.rows(np.array([3, 5]))
    _, most_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most_bytes < 20_000


@pytest.mark.slow
@given(seeds, st.integers(2, 9), st.integers(0, 3))
def test_arrivals_at_one_time_are_ordered_and_are_shown_in_that_order(seed: int, count: int, tick_ms: int) -> None:
    """With a delivery tick many packets arrive at the same time: then sender, number and receiver decide."""
    rng = np.random.default_rng(seed)
    subject = engine(place(count, seed % 1000, side_m=3000), seed, delivery_tick_us=tick_ms * 1000)
    for time_ns in range(0, 4_000_000, 1_000_000):
        for node in rng.permutation(count).tolist():
            subject.transmit(time_ns, node, [bytes([time_ns // 1_000_000])] * 2)
    shown = dict(subject.foresee(50_000_000).by_receiver())
    packets = list(subject.advance(50_000_000))
    receivers = {each.receiver for each in packets}
    assert shown == {node: [each.packet for each in packets if each.receiver == node] for node in receivers}
    table = subject.trace.rows(np.array([each.row for each in packets], dtype=np.intp)).tolist()
    names = subject.trace.rows(slice(0, 0)).dtype.names
    assert names is not None
    keys = [tuple(row[names.index(name)] for name in ("arrival_ns", "sender", "seq", "receiver")) for row in table]
    assert keys == sorted(keys)
    assert len(packets) > 10 or subject.counts[Outcome.delivered] == len(packets)


def test_more_frames_may_be_in_flight_than_there_is_room_for_at_first() -> None:
    subject = engine(np.zeros((40, 2)), latency_ms=1000.0, max_peers=40)
    for time_ns in range(3):
        for node in range(40):
            subject.transmit(time_ns, node, [b"x"])
    assert len(subject.advance(10**12)) == 3 * 40 * 39 > INITIAL_CAPACITY


def test_the_room_of_a_trace_takes_memory_only_as_it_is_written() -> None:
    def resident() -> int:
        return int(Path("/proc/self/statm").read_text().split()[1]) * mmap.PAGESIZE

    def traces(count: int) -> list[Trace]:
        return [Trace(["v0"], knows_power=True) for _ in range(count)]

    del traces(1)[0]  # malloc learns of sizes as they are given back
    held = traces(20)
    del held[::2]
    before = resident()
    held += traces(10)
    assert resident() - before < 10 * 2**20


def test_frames_on_their_way_load_no_module(monkeypatch: pytest.MonkeyPatch) -> None:
    """`np.unique` alone would load numpy.ma at its first call, in the middle of a run."""
    monkeypatch.delitem(sys.modules, "numpy.ma", raising=False)
    monkeypatch.delattr(np, "ma", raising=False)
    subject = engine(place(4, 1, 100.0), jitter_ms=0)
    before = set(sys.modules)
    for number in range(200):
        subject.transmit(number * PERIOD_NS, number % 4, [b"x"])
        assert len(list(subject.advance(number * PERIOD_NS + PERIOD_NS // 2))) == 3
    assert set(sys.modules) == before


def test_numbers_names_and_stages() -> None:
    assert [outcome.value for outcome in Outcome] == list(range(len(Outcome))), "they index tables"
    assert Outcome(7) is Outcome.fault and Outcome.fault.title == "fault" and Outcome.peer_cap.title == "peer cap"
    assert set(Outcome) - set(DRAWN) == {Outcome.pending, Outcome.out_of_range}
    assert DRAWN[0] is Outcome.delivered
    staged = {outcome for outcome in Outcome if outcome.stage is not None}
    assert staged == {*DRAWN}
    assert decided_at(Stage.SENDER) == ("queue_full", "oversize", "held_back", "no_grant")
    assert decided_at(Stage.ARRIVAL) == ("delivered", "receiver_down", "transport")


def test_outcomes_are_told_apart_by_colour_and_by_sign() -> None:
    colours = [PALETTE[outcome.colour] for outcome in DRAWN]
    for shade in ("light", "dark", "either"):
        assert len({getattr(colour, shade) for colour in colours}) == len(DRAWN)
    assert len({outcome.sign for outcome in DRAWN}) == len(DRAWN)
