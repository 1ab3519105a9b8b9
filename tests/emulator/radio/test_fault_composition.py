"""Several link and sender faults at once: independence of each other, and no effect after their end."""

from collections import Counter
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emulator.radio.outcomes import Outcome
from tests.support.faulty_engine import PERIOD_NS, FaultyEngine, S, fault, link

EVERYTHING = [
    fault("partition", 1.0, 5.0, groups="ring"),
    fault("block", 2.0, 1.0, senders={"count": 2}),
    fault("loss", 0.5, 4.0, probability=0.2),
    fault("burst_loss", 1.5, 4.0),
    fault("delay", 2.0, 1.0, delay_ms=300.0),
    fault("jitter", 2.0, 3.0, jitter_ms=200.0),
    fault("reorder", 0.0, 6.0),
    fault("duplicate", 0.2, 6.0, probability=0.5, copies=3),
    fault("corrupt", 0.7, 5.0, probability=0.5, flips=3),
    fault("throttle", 1.2, 3.0, nodes={"count": 2}, bitrate_mbps=0.002),
    fault("range", 0.2, 0.7, nodes={"ids": ["v0", "v4"]}, range_m=150.0),
    fault("swizzle", 1.0, 5.0, nodes={"count": 3}),
    fault("DataReplay", 0.4, 5.0, nodes={"count": 2}, age_s=0.5),
    fault("StaleMessages", 1.4, 4.0, nodes={"count": 2}, age_s=0.3),
    fault("DoS", 1.0, 4.0, nodes={"count": 2}, factor=5),
    fault("Sybil", 2.0, 4.0, nodes={"count": 2}, ghosts=3),
]
ENDED_NS = 6_200_000_000


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_with_everything_at_once_each_reception_has_one_outcome_and_all_are_counted(seed: int) -> None:
    air = FaultyEngine(EVERYTHING, seed=seed, loss=0.1, max_peers=3, queue_frames=8)
    air.chat(80)
    rows = air.rows()
    keys = [(row["sender"], row["seq"], row["receiver"], row["copy"]) for row in rows]
    assert len(set(keys)) == len(keys)
    counted = Counter(row["outcome"] for row in rows)
    assert counted == {o.name: n for o, n in air.engine.counts.items() if n and o is not Outcome.out_of_range}
    assert all(row["arrival_ns"] is None or row["arrival_ns"] >= row["sent_ns"] + 1000 for row in rows)
    assert all((row["arrival_ns"] is None) == (row["outcome"] != "delivered") for row in rows)
    assert all(row["cause"] for row in rows if row["outcome"] == "fault" or row["copy"])
    assert len(air.delivered) <= counted["delivered"], "the rest was still in flight"
    sent = {(*link(row), row["seq"]) for row in rows if row["copy"] == 0}
    assert len(sent) == 80 * 5 * 4
    causes = {row["cause"].rpartition("-")[0] for row in rows} - {""}
    assert causes == {f["kind"] for f in EVERYTHING} - {"delay", "jitter", "reorder", "throttle"}


@pytest.mark.slow
@settings(max_examples=4, deadline=None)
@given(st.integers(0, 1000), st.data())
def test_one_more_fault_changes_no_reception_it_does_not_touch(seed: int, data: st.DataObject) -> None:
    """Outcomes, arrivals and bytes of all other pairs stay the same; only the numbers of copies may shift."""
    some = data.draw(st.lists(st.sampled_from(EVERYTHING), max_size=5))
    kind = data.draw(st.sampled_from(["block", "loss", "burst_loss", "delay", "jitter", "duplicate", "corrupt"]))
    more = {"loss": {"probability": 0.5}, "delay": {"delay_ms": 77.0}, "jitter": {"jitter_ms": 77.0}}.get(kind, {})
    more = more | ({"probability": 0.7} if kind in ("duplicate", "corrupt") else {})
    extra = fault(kind, 0.5, 4.0, senders={"ids": ["v1"]}, receivers={"ids": ["v2"]}, **more)
    one, other = FaultyEngine(some, seed=seed, loss=0.2), FaultyEngine([*some, extra], seed=seed, loss=0.2)
    for air in (one, other):
        air.chat(60)
    before, after = (
        Counter(tuple(v for k, v in row.items() if k != "copy") for row in air.rows() if link(row) != ("v1", "v2"))
        for air in (one, other)
    )
    assert before == after


@pytest.mark.slow
def test_copies_of_one_fault_do_not_depend_on_how_many_another_made() -> None:
    """A flood's copies are drawn for themselves, though the duplicates of other pairs take numbers in between."""
    flood = fault("DoS", nodes={"ids": ["v1"]}, factor=5)
    replay = fault("DataReplay", nodes={"ids": ["v1"]}, age_s=0.3)
    more = fault("duplicate", probability=0.5, senders={"ids": ["v1"]}, receivers={"ids": ["v2"]})
    one, other = FaultyEngine([flood, replay], loss=0.5), FaultyEngine([flood, replay, more], loss=0.5)
    for air in (one, other):
        air.chat(30)
    before, after = (
        Counter(
            (*link(row), row["seq"], row["outcome"], row["arrival_ns"])
            for row in air.rows()
            if row["receiver"] != "v2"
        )
        for air in (one, other)
    )
    assert before == after
    assert max(row["copy"] for row in other.rows()) > max(row["copy"] for row in one.rows())


@pytest.mark.slow
@settings(max_examples=4, deadline=None)
@given(st.integers(0, 1000), st.lists(st.sampled_from(EVERYTHING), max_size=5))
def test_one_more_vehicle_out_of_range_changes_no_draws_of_others(seed: int, faults: list[dict[str, Any]]) -> None:
    fixed = [f | {"nodes": {"ids": ["v1", "v3"]}} if "nodes" in f else f for f in faults]
    fixed = [f | {"groups": [["v1", "v2"]]} if f["kind"] == "partition" else f for f in fixed]
    fixed = [f | {"senders": {"ids": ["v4"]}} if "senders" in f else f for f in fixed if f["kind"] != "swizzle"]
    one, other = FaultyEngine(fixed, seed=seed, loss=0.2), FaultyEngine(fixed, count=6, seed=seed, loss=0.2)
    other.engine.set_positions(np.array([[100.0 * n, 0.0] for n in range(5)] + [[1e7, 0.0]]))
    for air in (one, other):
        for period in range(50):
            for node in range(5):
                air.send(period * PERIOD_NS, node, bytes([node, period]) * 10)
    assert one.rows() == other.rows()


@pytest.mark.slow
@settings(max_examples=5, deadline=None)
@given(st.integers(0, 1000), st.data())
def test_after_all_have_ended_the_engine_is_as_one_that_never_had_faults(seed: int, data: st.DataObject) -> None:
    """Any faults, in any order of ending, healed early, twice, or before they begin."""
    faults = [
        {**f, "at_s": data.draw(st.floats(0, 3)), "duration_s": data.draw(st.floats(0.01, 3))}
        for f in data.draw(st.lists(st.sampled_from(EVERYTHING), min_size=1, max_size=6))
    ]
    air, free = (
        FaultyEngine(faults, seed=seed, loss=0.2, max_peers=3),
        FaultyEngine(seed=seed, loss=0.2, max_peers=3),
    )
    heals = sorted(
        data.draw(
            st.lists(st.tuples(st.integers(0, 6), st.sampled_from([p.label for p in air.plan.faults])), max_size=4)
        )
    )
    for second in range(9):
        for _, label in [heal for heal in heals if heal[0] == second]:
            for _ in range(2):
                air.plan.heal(label, air.now_ns + 1)
        for one in (air, free):
            one.chat(10, first=10 * second)
    assert air.plan.active(air.now_ns) == []
    assert air.rows(ENDED_NS + S) == free.rows(ENDED_NS + S)


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(st.data())
def test_the_next_change_visits_every_start_and_end_once(data: st.DataObject) -> None:
    faults = [
        {**f, "at_s": data.draw(st.floats(0, 50)), "duration_s": data.draw(st.floats(1e-6, 50))}
        for f in data.draw(st.lists(st.sampled_from(EVERYTHING), max_size=6))
    ]
    plan = FaultyEngine(faults).plan
    visited, now_ns = [], -1
    while (now_ns := plan.next_change_ns(now_ns)) is not None:  # type: ignore[assignment]
        visited.append(now_ns)
    assert visited == sorted(set(visited))
    due = {t for p in plan.faults for t in (p.start_ns, p.end_ns)}
    assert due <= set(visited)
    inside = [t for t in visited if t not in due]
    assert all(any(p.fault.kind == "swizzle" and p.acts_at(t) for p in plan.faults) for t in inside)


def test_what_is_in_flight_stays_decided() -> None:
    air = FaultyEngine([fault("delay", 0.0, 1.0, delay_ms=500.0), fault("partition", 1.0, 1.0)], count=2)
    air.send(900_000_000, 0, b"x")
    air.go(5 * S)
    (row,) = air.rows()
    assert row["outcome"] == "delivered"
    assert 1_402_000_000 <= row["arrival_ns"] <= 1_405_000_000


def test_numbers_of_faults_and_not_their_order_name_the_cause() -> None:
    air = FaultyEngine(
        [fault("block"), fault("partition", groups=[["v0"]]), fault("loss", probability=1.0)], count=2
    )
    air.chat(1)
    assert {row["cause"] for row in air.rows()} == {"block-0"}
    air.plan.heal("block-0", air.now_ns + 1)
    air.chat(1, first=1)
    assert {row["cause"] for row in air.rows(PERIOD_NS)} == {"partition-1"}
    air.plan.heal("partition-1", air.now_ns + 1)
    air.chat(1, first=2)
    assert {row["cause"] for row in air.rows(2 * PERIOD_NS)} == {"loss-2"}
