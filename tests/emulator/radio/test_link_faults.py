"""What faults do to frames on a small engine, kind by kind, and that nothing of it stays when they have ended."""

import hashlib
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binom

from emulator.faults.plan import FaultPlan
from emulator.faults.selectors import Nodes
from emulator.radio.engine import Delivery, Engine
from emulator.radio.outcomes import Outcome
from emulator.scenario.scenario import Scenario

pytestmark = pytest.mark.slow

S = 1_000_000_000
PERIOD_NS = S // 10
Row = dict[str, Any]


class Air:
    """An engine with a plan of faults, all nodes on a line 100 m apart, and what has arrived."""

    def __init__(self, faults: Sequence[dict[str, Any]] = (), count: int = 5, seed: int = 1, **radio: Any) -> None:
        data = {"run": {"seed": seed, "duration_s": 1000.0}, "radio": radio, "fault": list(faults)}
        scenario = Scenario.model_validate(data)
        position_m = np.column_stack([100.0 * np.arange(count), np.zeros(count)])
        self.ids = [f"v{n}" for n in range(count)]
        self.plan = FaultPlan(scenario, Nodes(self.ids, position_m, np.full(count, count - 1)))
        self.engine = Engine(self.ids, scenario.radio, seed, position_m, None)
        self.heard: list[Delivery] = []
        self.now_ns = -1

    def go(self, time_ns: int) -> None:
        """Let all happen up to `time_ns`, faults at their instants."""
        while (change_ns := self.plan.next_change_ns(self.now_ns)) is not None and change_ns <= time_ns:
            self.heard += self.engine.advance(change_ns - 1)
            self.engine.set_faults(self.plan.active(change_ns), change_ns)
            self.now_ns = change_ns
        self.heard += self.engine.advance(time_ns)
        self.now_ns = time_ns

    def send(self, time_ns: int, node: int, *payloads: bytes) -> None:
        self.go(time_ns)
        self.engine.transmit(time_ns, node, payloads)

    def chat(self, periods: int, first: int = 0, size: int = 20) -> None:
        """All send, each period, frames that differ."""
        for period in range(first, first + periods):
            for node in range(len(self.ids)):
                self.send(period * PERIOD_NS, node, bytes([node]) + period.to_bytes(4, "big") + bytes(size - 5))

    def rows(self, since_ns: int = 0) -> list[Row]:
        self.engine.drain()
        return [row for row in self.engine.trace.to_table().to_pylist() if row["sent_ns"] >= since_ns]


def fault(kind: str, at_s: float = 0.0, duration_s: float = 100.0, **more: Any) -> dict[str, Any]:
    return {"kind": kind, "at_s": at_s, "duration_s": duration_s, **more}


def pair(row: Row) -> tuple[str, str]:
    return row["sender"], row["receiver"]


def digest(payload: bytes) -> int:
    return int.from_bytes(hashlib.blake2b(payload, digest_size=8).digest(), "little")


def test_a_partition_cuts_between_groups_for_as_long_as_it_lasts_and_by_name() -> None:
    air = Air([fault("partition", 1.0, 2.0, groups=[["v0", "v1"], ["v2"]])])
    air.chat(50)
    group = {"v0": 1, "v1": 1, "v2": 2, "v3": 0, "v4": 0}
    for row in air.rows():
        across = group[row["sender"]] != group[row["receiver"]]
        expected = across and S <= row["sent_ns"] < 3 * S
        assert (row["outcome"], row["cause"]) == (("fault", "partition-0") if expected else ("delivered", ""))


def test_a_block_goes_one_way_only() -> None:
    air = Air([fault("block", senders={"ids": ["v1"]}, receivers={"ids": ["v2", "v3"]})])
    air.chat(3)
    blocked = {pair(row) for row in air.rows() if row["outcome"] == "fault"}
    assert blocked == {("v1", "v2"), ("v1", "v3")}


def test_a_short_range_counts_at_both_ends_and_follows_the_vehicles() -> None:
    air = Air([fault("range", nodes={"ids": ["v1"]}, range_m=150.0)])
    air.chat(1)
    assert {pair(r) for r in air.rows() if r["outcome"] == "fault"} == {
        pair for far in ("v3", "v4") for pair in (("v1", far), (far, "v1"))
    }
    air.engine.set_positions(np.zeros((5, 2)))
    air.chat(1, first=2)
    assert all(row["outcome"] == "delivered" for row in air.rows(2 * PERIOD_NS))


def test_a_swizzle_silences_more_and_more_and_then_fewer_and_fewer() -> None:
    air = Air([fault("swizzle", 1.0, 10.0)], count=6)
    air.chat(130)
    hears = Counter((row["sent_ns"], row["receiver"]) for row in air.rows() if row["outcome"] == "delivered")
    alive = [sum((p * PERIOD_NS, node) in hears for node in air.ids) for p in range(130)]
    assert alive[:10] == [6] * 10
    assert alive[110:] == [6] * 20
    assert alive[10:60] == sorted(alive[10:60], reverse=True), "cut off one by one"
    assert alive[60:110] == sorted(alive[60:110]), "back one by one"
    assert 0 in alive
    assert len(set(alive)) >= 5


def test_a_throttled_sender_is_slow_and_its_queue_fills_and_after_it_nobody_waits_for_it() -> None:
    """20 bytes at 320 bit/s take half a second; after the fault nothing new stands behind what still waits."""
    throttle = fault("throttle", 1.0, 2.0, nodes={"ids": ["v1"]}, bitrate_mbps=0.00032)
    air, free = (Air(faults, queue_frames=4) for faults in ([throttle], []))
    for one in (air, free):
        one.chat(50)
    slow = [r for r in air.rows() if r["sender"] == "v1" and S <= r["sent_ns"] < 3 * S and r["receiver"] == "v0"]
    assert Counter(row["outcome"] for row in slow) == {"delivered": 8, "queue_full": 12}
    arrivals = sorted(row["arrival_ns"] for row in slow if row["arrival_ns"] is not None)
    gaps = np.diff(arrivals)
    assert np.all(np.abs(gaps - S / 2) < 3e6)
    assert [r for r in air.rows() if r not in slow and pair(r) != ("v1", "v0") and r["sender"] != "v1"] == [
        r for r in free.rows() if r["sender"] != "v1"
    ], "others are not slowed"
    assert air.rows(3 * S) == free.rows(3 * S)


def test_the_slowest_of_several_throttles_counts() -> None:
    throttles = [fault("throttle", bitrate_mbps=rate) for rate in (0.016, 0.0016, 0.16)]
    air = Air(throttles, access_jitter_ms=0, jitter_ms=0)
    air.send(0, 0, bytes(20))
    assert {row["arrival_ns"] for row in air.rows()} == {S // 10 + 2_000_000}


def test_loss_lies_in_its_binomial_band_and_is_told_from_the_radios() -> None:
    air = Air([fault("loss", probability=0.3, senders={"ids": ["v0", "v1"]})], loss=0.2)
    air.chat(400)
    rows = [row for row in air.rows() if row["sender"] in ("v0", "v1")]
    counts = Counter(row["outcome"] for row in rows)
    low, high = binom.interval(0.9999, len(rows), 0.3)
    assert low <= counts["fault"] <= high
    low, high = binom.interval(0.9999, len(rows) - counts["fault"], 0.2)
    assert low <= counts["lost"] <= high
    assert all(row["cause"] == ("loss-0" if row["outcome"] == "fault" else "") for row in rows)


def runs_of(values: np.ndarray) -> np.ndarray:
    """The lengths of the runs of True, without a last one that is cut off."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], values, [False]]).astype(int)))
    lengths = edges[1::2] - edges[::2]
    return lengths[:-1] if values[-1] else lengths


def test_bursts_have_the_stationary_rate_and_geometric_lengths() -> None:
    """Gilbert: bad for 1 / leave frames on average, and enter / (enter + leave) of the time; links are apart."""
    enter, leave, frames = 0.1, 0.25, 4000
    air = Air([fault("burst_loss", enter=enter, leave=leave)], count=3)
    for number in range(frames):
        air.send(number * 10_000_000, 0, b"x")
    lost = {r: np.zeros(frames, bool) for r in ("v1", "v2")}
    for row in air.rows():
        lost[row["receiver"]][row["seq"]] = row["outcome"] == "fault"
    for values in lost.values():
        assert abs(values.mean() - enter / (enter + leave)) < 0.04
        lengths = runs_of(values)
        assert abs(lengths.mean() - 1 / leave) < 0.6
        for k in range(1, 6):
            share = (1 - leave) ** (k - 1)
            low, high = binom.interval(0.99999, len(lengths), share)
            assert low <= np.sum(lengths >= k) <= high, k
    assert abs(np.corrcoef(lost["v1"], lost["v2"])[0, 1]) < 0.15


def test_a_good_link_and_a_bad_one_lose_with_their_own_probabilities() -> None:
    never_bad = Air([fault("burst_loss", enter=0.0, loss_good=0.4)], count=2)
    always_bad = Air([fault("burst_loss", enter=1.0, leave=1e-9, loss_bad=0.7)], count=2)
    for air, share in ((never_bad, 0.4), (always_bad, 0.7)):
        air.chat(1000)
        low, high = binom.interval(0.9999, 2000, share)
        assert low <= sum(row["outcome"] == "fault" for row in air.rows()) <= high


def later(faults: Sequence[dict[str, Any]], periods: int = 100) -> np.ndarray:
    """How much later each pair arrives than without the faults, in ms."""
    air, free = Air(faults), Air()
    for one in (air, free):
        one.chat(periods)
    return np.array(
        [(a["arrival_ns"] - b["arrival_ns"]) / 1e6 for a, b in zip(air.rows(), free.rows(), strict=True)]
    )


def test_a_delay_is_exact_and_two_add_up() -> None:
    assert np.all(later([fault("delay", delay_ms=12.5)]) == 12.5)
    assert np.all(later([fault("delay", delay_ms=12.5), fault("delay", delay_ms=100)]) == 112.5)


def test_jitter_is_uniform_up_to_its_limit() -> None:
    ms = later([fault("jitter", jitter_ms=40.0)], 200)
    assert 0 <= ms.min() < 0.5
    assert 39.5 < ms.max() <= 40
    assert abs(ms.mean() - 20) < 1
    assert np.all(np.abs(np.histogram(ms, 4, (0, 40))[0] / len(ms) - 0.25) < 0.04)


def test_reordering_holds_some_back_so_that_later_frames_overtake_them() -> None:
    ms = later([fault("reorder", probability=0.2, delay_ms=250)])
    assert set(ms.tolist()) == {0.0, 250.0}
    low, high = binom.interval(0.9999, len(ms), 0.2)
    assert low <= np.sum(ms > 0) <= high
    air = Air([fault("reorder", probability=0.2, delay_ms=250)])
    air.chat(30)
    air.go(5 * S)
    order = [d.packet.sent_ns for d in air.heard if d.receiver == 0 and d.packet.sender == "v1"]
    assert order != sorted(order)
    assert len(order) == 30


def test_duplicates_are_rows_of_their_own_that_name_their_cause() -> None:
    air = Air([fault("duplicate", probability=0.3, copies=3, delay_ms=7.0, receivers={"ids": ["v0"]})])
    air.chat(100)
    rows = air.rows()
    by_copy = Counter(row["copy"] for row in rows)
    first = {(*pair(row), row["seq"]): row for row in rows if row["copy"] == 0}
    assert by_copy[0] == 100 * 5 * 4
    assert by_copy[1] == by_copy[2] == by_copy[3]
    low, high = binom.interval(0.9999, 400, 0.3)
    assert low <= by_copy[1] <= high
    for row in rows:
        if row["copy"]:
            original = first[*pair(row), row["seq"]]
            assert row["receiver"] == "v0"
            assert (row["outcome"], row["cause"]) == ("delivered", "duplicate-0")
            assert row["arrival_ns"] == original["arrival_ns"] + row["copy"] * 7_000_000
            assert row["payload_digest"] == original["payload_digest"]


@pytest.mark.parametrize(("flips", "size"), [(1, 1), (1, 20), (3, 20), (50, 20), (2, 1)])
def test_a_corrupt_pair_differs_in_exactly_so_many_bytes(flips: int, size: int) -> None:
    air = Air([fault("corrupt", probability=0.4, flips=flips)])
    sent = {}
    for number in range(60):
        payload = bytes([number]) * size
        sent[number * PERIOD_NS] = payload
        air.send(number * PERIOD_NS, 0, payload)
    air.go(10 * S)
    rows = {(row["sent_ns"], row["receiver"]): row for row in air.rows()}
    changed = 0
    for delivery in air.heard:
        packet, row = delivery.packet, rows[delivery.packet.sent_ns, air.ids[delivery.receiver]]
        differ = sum(a != b for a, b in zip(packet.payload, sent[packet.sent_ns], strict=True))
        assert differ == (min(flips, size) if row["cause"] else 0)
        assert row["payload_digest"] == digest(packet.payload)
        assert row["cause"] in ("", "corrupt-0")
        changed += differ > 0
    low, high = binom.interval(0.9999, 240, 0.4)
    assert low <= changed <= high
    assert len({d.packet.payload for d in air.heard if d.packet.sent_ns == 0}) > 1 or size == 1


def test_an_empty_payload_cannot_be_corrupted() -> None:
    air = Air([fault("corrupt", probability=1.0)])
    air.send(0, 0, b"")
    assert {row["cause"] for row in air.rows()} == {""}


def payloads(air: Air, receiver: int = 0) -> list[tuple[str, int, bytes]]:
    return [(d.packet.sender, d.packet.sent_ns, d.packet.payload) for d in air.heard if d.receiver == receiver]


def test_stale_messages_are_those_of_some_time_ago() -> None:
    air = Air([fault("StaleMessages", 1.0, 3.0, nodes={"ids": ["v1"]}, age_s=0.5)], count=2)
    for number in range(60):
        air.send(number * PERIOD_NS, 1, bytes([number]))
    air.go(10 * S)
    said = [payload[0] for _, _, payload in payloads(air)]
    fresh = [n if n < 15 or n >= 40 else n - 5 for n in range(60)]  # the first half second has nothing old enough
    assert said == fresh
    causes = [row["cause"] for row in air.rows()]
    assert causes == ["" if n < 15 or n >= 40 else "StaleMessages-0" for n in range(60)]


def test_replayed_data_come_beside_the_fresh_ones() -> None:
    air = Air([fault("DataReplay", 1.0, 3.0, nodes={"ids": ["v1"]}, age_s=0.5)], count=2)
    for number in range(60):
        air.send(number * PERIOD_NS, 1, bytes([number]))
    air.go(10 * S)
    said = Counter(payload[0] for _, _, payload in payloads(air))
    assert said == Counter({n: 2 if 10 <= n < 35 else 1 for n in range(60)})
    copies = [row for row in air.rows() if row["copy"]]
    assert {row["cause"] for row in copies} == {"DataReplay-0"}
    assert [(row["seq"], row["sent_ns"]) for row in copies] == [(n - 5, n * PERIOD_NS) for n in range(15, 40)]


def test_a_flood_and_ghosts_are_so_many_more_frames() -> None:
    air = Air([fault("DoS", nodes={"ids": ["v1"]}, factor=4), fault("Sybil", nodes={"ids": ["v2"]}, ghosts=2)])
    air.chat(10)
    air.go(5 * S)
    said = Counter(sender for sender, _, _ in payloads(air))
    assert said == {"v1": 40, "v2": 10, "v2~1": 10, "v2~2": 10, "v3": 10, "v4": 10}
    by_cause = Counter((row["sender"], row["cause"]) for row in air.rows() if row["receiver"] == "v0")
    assert by_cause["v1", "DoS-0"] == 30
    assert by_cause["v2", "Sybil-1"] == 20
    assert {row["sender"] for row in air.rows()} == set(air.ids), "the trace says who really sends"


def test_a_flood_fills_the_senders_own_queue_and_has_luck_of_its_own() -> None:
    air = Air([fault("DoS", nodes={"ids": ["v1"]}, factor=50)], queue_frames=10, loss=0.5)
    air.chat(20)
    rows = [row for row in air.rows() if pair(row) == ("v1", "v0")]
    assert Counter(row["outcome"] for row in rows)["queue_full"] >= 20 * 30
    lost = {seq: {r["copy"]: r["outcome"] for r in rows if r["seq"] == seq} for seq in range(20)}
    assert len({tuple(sorted(outcomes.items())) for outcomes in lost.values()}) > 15, (
        "each copy is drawn for itself"
    )


EVERYTHING = [
    fault("partition", 1.0, 5.0, groups="ring"),
    fault("block", 2.0, 1.0, senders={"random": 2}),
    fault("loss", 0.5, 4.0, probability=0.2),
    fault("burst_loss", 1.5, 4.0),
    fault("delay", 2.0, 1.0, delay_ms=300.0),
    fault("jitter", 2.0, 3.0, jitter_ms=200.0),
    fault("reorder", 0.0, 6.0),
    fault("duplicate", 0.2, 6.0, probability=0.5, copies=3),
    fault("corrupt", 0.7, 5.0, probability=0.5, flips=3),
    fault("throttle", 1.2, 3.0, nodes={"random": 2}, bitrate_mbps=0.002),
    fault("range", 0.2, 0.7, nodes={"ids": ["v0", "v4"]}, range_m=150.0),
    fault("swizzle", 1.0, 5.0, nodes={"random": 3}),
    fault("DataReplay", 0.4, 5.0, nodes={"random": 2}, age_s=0.5),
    fault("StaleMessages", 1.4, 4.0, nodes={"random": 2}, age_s=0.3),
    fault("DoS", 1.0, 4.0, nodes={"random": 2}, factor=5),
    fault("Sybil", 2.0, 4.0, nodes={"random": 2}, ghosts=3),
]
ENDED_NS = 6_200_000_000


@pytest.mark.parametrize("seed", range(4))
def test_with_everything_at_once_each_pair_has_one_outcome_and_all_are_counted(seed: int) -> None:
    air = Air(EVERYTHING, seed=seed, loss=0.1, max_peers=3, queue_frames=8)
    air.chat(80)
    rows = air.rows()
    keys = [(row["sender"], row["seq"], row["receiver"], row["copy"]) for row in rows]
    assert len(set(keys)) == len(keys)
    counted = Counter(row["outcome"] for row in rows)
    assert counted == {o.name: n for o, n in air.engine.counts.items() if n and o is not Outcome.out_of_range}
    assert all(row["arrival_ns"] is None or row["arrival_ns"] >= row["sent_ns"] + 1000 for row in rows)
    assert all((row["arrival_ns"] is None) == (row["outcome"] != "delivered") for row in rows)
    assert all(row["cause"] for row in rows if row["outcome"] == "fault" or row["copy"])
    assert len(air.heard) <= counted["delivered"], "the rest was still in flight"
    sent = {(*pair(row), row["seq"]) for row in rows if row["copy"] == 0}
    assert len(sent) == 80 * 5 * 4
    causes = {row["cause"].rpartition("-")[0] for row in rows} - {""}
    assert causes == {f["kind"] for f in EVERYTHING} - {"delay", "jitter", "reorder", "throttle"}


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000), st.data())
def test_one_more_fault_changes_nothing_for_the_pairs_it_does_not_touch(seed: int, data: st.DataObject) -> None:
    """Outcomes, arrivals and bytes of all other pairs stay the same; only the numbers of copies may shift."""
    some = data.draw(st.lists(st.sampled_from(EVERYTHING), max_size=5))
    kind = data.draw(st.sampled_from(["block", "loss", "burst_loss", "delay", "jitter", "duplicate", "corrupt"]))
    more = {"loss": {"probability": 0.5}, "delay": {"delay_ms": 77.0}, "jitter": {"jitter_ms": 77.0}}.get(kind, {})
    more = more | ({"probability": 0.7} if kind in ("duplicate", "corrupt") else {})
    extra = fault(kind, 0.5, 4.0, senders={"ids": ["v1"]}, receivers={"ids": ["v2"]}, **more)
    one, other = Air(some, seed=seed, loss=0.2), Air([*some, extra], seed=seed, loss=0.2)
    for air in (one, other):
        air.chat(70)
    before, after = (
        Counter(tuple(v for k, v in row.items() if k != "copy") for row in air.rows() if pair(row) != ("v1", "v2"))
        for air in (one, other)
    )
    assert before == after


def test_copies_of_one_fault_do_not_depend_on_how_many_another_made() -> None:
    """A flood's copies are drawn for themselves, though the duplicates of other pairs take numbers in between."""
    flood = fault("DoS", nodes={"ids": ["v1"]}, factor=5)
    replay = fault("DataReplay", nodes={"ids": ["v1"]}, age_s=0.3)
    more = fault("duplicate", probability=0.5, senders={"ids": ["v1"]}, receivers={"ids": ["v2"]})
    one, other = Air([flood, replay], loss=0.5), Air([flood, replay, more], loss=0.5)
    for air in (one, other):
        air.chat(30)
    before, after = (
        Counter(
            (*pair(row), row["seq"], row["outcome"], row["arrival_ns"])
            for row in air.rows()
            if row["receiver"] != "v2"
        )
        for air in (one, other)
    )
    assert before == after
    assert max(row["copy"] for row in other.rows()) > max(row["copy"] for row in one.rows())


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000), st.lists(st.sampled_from(EVERYTHING), max_size=5))
def test_one_more_vehicle_out_of_range_changes_nobodys_luck(seed: int, faults: list[dict[str, Any]]) -> None:
    fixed = [f | {"nodes": {"ids": ["v1", "v3"]}} if "nodes" in f else f for f in faults]
    fixed = [f | {"groups": [["v1", "v2"]]} if f["kind"] == "partition" else f for f in fixed]
    fixed = [f | {"senders": {"ids": ["v4"]}} if "senders" in f else f for f in fixed if f["kind"] != "swizzle"]
    one, other = Air(fixed, seed=seed, loss=0.2), Air(fixed, count=6, seed=seed, loss=0.2)
    other.engine.set_positions(np.array([[100.0 * n, 0.0] for n in range(5)] + [[1e7, 0.0]]))
    for air in (one, other):
        for period in range(60):
            for node in range(5):
                air.send(period * PERIOD_NS, node, bytes([node, period]) * 10)
    assert one.rows() == other.rows()


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.data())
def test_after_all_have_ended_the_engine_is_as_one_that_never_had_faults(seed: int, data: st.DataObject) -> None:
    """Any faults, in any order of ending, healed early, twice, or before they begin."""
    faults = [
        {**f, "at_s": data.draw(st.floats(0, 3)), "duration_s": data.draw(st.floats(0.01, 3))}
        for f in data.draw(st.lists(st.sampled_from(EVERYTHING), min_size=1, max_size=6))
    ]
    air, free = Air(faults, seed=seed, loss=0.2, max_peers=3), Air(seed=seed, loss=0.2, max_peers=3)
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


@settings(max_examples=30, deadline=None)
@given(st.data())
def test_the_next_change_visits_every_start_and_end_once(data: st.DataObject) -> None:
    faults = [
        {**f, "at_s": data.draw(st.floats(0, 50)), "duration_s": data.draw(st.floats(1e-6, 50))}
        for f in data.draw(st.lists(st.sampled_from(EVERYTHING), max_size=6))
    ]
    plan = Air(faults).plan
    visited, now_ns = [], -1
    while (now_ns := plan.next_change_ns(now_ns)) is not None:  # type: ignore[assignment]
        visited.append(now_ns)
    assert visited == sorted(set(visited))
    due = {t for p in plan.faults for t in (p.start_ns, p.end_ns)}
    assert due <= set(visited)
    inside = [t for t in visited if t not in due]
    assert all(any(p.fault.kind == "swizzle" and p.acts_at(t) for p in plan.faults) for t in inside)


def test_what_is_in_flight_stays_decided() -> None:
    air = Air([fault("delay", 0.0, 1.0, delay_ms=500.0), fault("partition", 1.0, 1.0)], count=2)
    air.send(900_000_000, 0, b"x")
    air.go(5 * S)
    (row,) = air.rows()
    assert row["outcome"] == "delivered"
    assert 1_402_000_000 <= row["arrival_ns"] <= 1_405_000_000


def test_numbers_of_faults_and_not_their_order_name_the_cause() -> None:
    air = Air([fault("block"), fault("partition", groups=[["v0"]]), fault("loss", probability=1.0)], count=2)
    air.chat(1)
    assert {row["cause"] for row in air.rows()} == {"block-0"}
    air.plan.heal("block-0", air.now_ns + 1)
    air.chat(1, first=1)
    assert {row["cause"] for row in air.rows(PERIOD_NS)} == {"partition-1"}
    air.plan.heal("partition-1", air.now_ns + 1)
    air.chat(1, first=2)
    assert {row["cause"] for row in air.rows(2 * PERIOD_NS)} == {"loss-2"}
