"""Link and sender faults on a small engine, kind by kind."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import scipy  # scipy.stats is imported when it is first used

from tests.support.faulty_engine import PERIOD_NS, FaultyEngine, S, digest, fault, link

pytestmark = pytest.mark.slow


def test_a_partition_cuts_between_groups_for_as_long_as_it_lasts_and_by_name() -> None:
    air = FaultyEngine([fault("partition", 1.0, 2.0, groups=[["v0", "v1"], ["v2"]])])
    air.chat(50)
    group = {"v0": 1, "v1": 1, "v2": 2, "v3": 0, "v4": 0}
    for row in air.rows():
        across = group[row["sender"]] != group[row["receiver"]]
        expected = across and S <= row["sent_ns"] < 3 * S
        assert (row["outcome"], row["cause"]) == (("fault", "partition-0") if expected else ("delivered", ""))


RANDOM: dict[str, dict[str, Any]] = {
    "loss": {"probability": 0.4},
    "burst_loss": {"loss_bad": 0.9},
    "corrupt": {"probability": 0.5},
    "duplicate": {"probability": 0.5},
    "block": {"senders": {"fraction": 0.4}},
    "swizzle": {},
}


@pytest.mark.parametrize("kind", RANDOM)
def test_a_fault_has_the_draws_that_it_had_behind_another(kind: str) -> None:
    """And others without `draws_of`, so that this can fail."""

    def played(*faults: dict[str, Any]) -> list[dict[str, Any]]:
        air = FaultyEngine([*faults], loss=0.2)
        air.chat(40)
        return [{**row, "cause": row["cause"].partition("-")[0]} for row in air.rows()]

    first, random = fault("range", 3.0, 0.5, nodes={"ids": ["v1"]}, range_m=1e5), fault(kind, **RANDOM[kind])
    behind = played(first, random)
    assert played(random | {"draws_of": 1}) == behind != played(random)


def test_a_block_goes_one_way_only() -> None:
    air = FaultyEngine([fault("block", senders={"ids": ["v1"]}, receivers={"ids": ["v2", "v3"]})])
    air.chat(3)
    blocked = {link(row) for row in air.rows() if row["outcome"] == "fault"}
    assert blocked == {("v1", "v2"), ("v1", "v3")}


def test_a_short_range_counts_at_both_ends_and_follows_the_vehicles() -> None:
    air = FaultyEngine([fault("range", nodes={"ids": ["v1"]}, range_m=150.0)])
    air.chat(1)
    assert {link(r) for r in air.rows() if r["outcome"] == "fault"} == {
        pair for far in ("v3", "v4") for pair in (("v1", far), (far, "v1"))
    }
    air.engine.set_positions(np.zeros((5, 2)))
    air.chat(1, first=2)
    assert all(row["outcome"] == "delivered" for row in air.rows(2 * PERIOD_NS))


def test_a_swizzle_silences_more_and_more_and_then_fewer_and_fewer() -> None:
    air = FaultyEngine([fault("swizzle", 1.0, 10.0)], count=6)
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
    air, free = (FaultyEngine(faults, queue_frames=4) for faults in ([throttle], []))
    for one in (air, free):
        one.chat(50)
    slow = [r for r in air.rows() if r["sender"] == "v1" and S <= r["sent_ns"] < 3 * S and r["receiver"] == "v0"]
    assert Counter(row["outcome"] for row in slow) == {"delivered": 8, "queue_full": 12}
    arrivals = sorted(row["arrival_ns"] for row in slow if row["arrival_ns"] is not None)
    gaps = np.diff(arrivals)
    assert np.all(np.abs(gaps - S / 2) < 3e6)
    assert [r for r in air.rows() if r not in slow and link(r) != ("v1", "v0") and r["sender"] != "v1"] == [
        r for r in free.rows() if r["sender"] != "v1"
    ], "others are not slowed"
    assert air.rows(3 * S) == free.rows(3 * S)


def test_the_slowest_of_several_throttles_counts() -> None:
    throttles = [fault("throttle", bitrate_mbps=rate) for rate in (0.016, 0.0016, 0.16)]
    air = FaultyEngine(throttles, access_jitter_ms=0, jitter_ms=0)
    air.send(0, 0, bytes(20))
    assert {row["arrival_ns"] for row in air.rows()} == {S // 10 + 2_000_000}


def test_loss_lies_in_its_binomial_band_and_is_told_from_the_radios() -> None:
    air = FaultyEngine([fault("loss", probability=0.3, senders={"ids": ["v0", "v1"]})], loss=0.2)
    air.chat(400)
    rows = [row for row in air.rows() if row["sender"] in ("v0", "v1")]
    counts = Counter(row["outcome"] for row in rows)
    low, high = scipy.stats.binom.interval(0.9999, len(rows), 0.3)
    assert low <= counts["fault"] <= high
    low, high = scipy.stats.binom.interval(0.9999, len(rows) - counts["fault"], 0.2)
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
    air = FaultyEngine([fault("burst_loss", enter=enter, leave=leave)], count=3)
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
            low, high = scipy.stats.binom.interval(0.99999, len(lengths), share)
            assert low <= np.sum(lengths >= k) <= high, k
    assert abs(np.corrcoef(lost["v1"], lost["v2"])[0, 1]) < 0.15


def test_a_good_link_and_a_bad_one_lose_with_their_own_probabilities() -> None:
    never_bad = FaultyEngine([fault("burst_loss", enter=0.0, loss_good=0.4)], count=2)
    always_bad = FaultyEngine([fault("burst_loss", enter=1.0, leave=1e-9, loss_bad=0.7)], count=2)
    for air, share in ((never_bad, 0.4), (always_bad, 0.7)):
        air.chat(1000)
        low, high = scipy.stats.binom.interval(0.9999, 2000, share)
        assert low <= sum(row["outcome"] == "fault" for row in air.rows()) <= high


def later(faults: Sequence[dict[str, Any]], periods: int = 100) -> np.ndarray:
    """Return the extra delay of each reception by the faults, in ms."""
    air, free = FaultyEngine(faults), FaultyEngine()
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
    low, high = scipy.stats.binom.interval(0.9999, len(ms), 0.2)
    assert low <= np.sum(ms > 0) <= high
    air = FaultyEngine([fault("reorder", probability=0.2, delay_ms=250)])
    air.chat(30)
    air.go(5 * S)
    order = [d.packet.sent_ns for d in air.delivered if d.receiver == 0 and d.packet.sender == "v1"]
    assert order != sorted(order)
    assert len(order) == 30


def test_duplicates_are_rows_of_their_own_that_name_their_cause() -> None:
    air = FaultyEngine([fault("duplicate", probability=0.3, copies=3, delay_ms=7.0, receivers={"ids": ["v0"]})])
    air.chat(100)
    rows = air.rows()
    by_copy = Counter(row["copy"] for row in rows)
    first = {(*link(row), row["seq"]): row for row in rows if row["copy"] == 0}
    assert by_copy[0] == 100 * 5 * 4
    assert by_copy[1] == by_copy[2] == by_copy[3]
    low, high = scipy.stats.binom.interval(0.9999, 400, 0.3)
    assert low <= by_copy[1] <= high
    for row in rows:
        if row["copy"]:
            original = first[*link(row), row["seq"]]
            assert row["receiver"] == "v0"
            assert (row["outcome"], row["cause"]) == ("delivered", "duplicate-0")
            assert row["arrival_ns"] == original["arrival_ns"] + row["copy"] * 7_000_000
            assert row["payload_digest"] == original["payload_digest"]


@pytest.mark.parametrize(("flips", "size"), [(1, 1), (1, 20), (3, 20), (50, 20), (2, 1)])
def test_a_corrupt_pair_differs_in_exactly_so_many_bytes(flips: int, size: int) -> None:
    air = FaultyEngine([fault("corrupt", probability=0.4, flips=flips)])
    sent = {}
    for number in range(60):
        payload = bytes([number]) * size
        sent[number * PERIOD_NS] = payload
        air.send(number * PERIOD_NS, 0, payload)
    air.go(10 * S)
    rows = {(row["sent_ns"], row["receiver"]): row for row in air.rows()}
    changed = 0
    for delivery in air.delivered:
        packet, row = delivery.packet, rows[delivery.packet.sent_ns, air.ids[delivery.receiver]]
        differ = sum(a != b for a, b in zip(packet.payload, sent[packet.sent_ns], strict=True))
        assert differ == (min(flips, size) if row["cause"] else 0)
        assert row["payload_digest"] == digest(packet.payload)
        assert row["cause"] in ("", "corrupt-0")
        changed += differ > 0
    low, high = scipy.stats.binom.interval(0.9999, 240, 0.4)
    assert low <= changed <= high
    assert len({d.packet.payload for d in air.delivered if d.packet.sent_ns == 0}) > 1 or size == 1


def test_an_empty_payload_cannot_be_corrupted() -> None:
    air = FaultyEngine([fault("corrupt", probability=1.0)])
    air.send(0, 0, b"")
    assert {row["cause"] for row in air.rows()} == {""}


def payloads(air: FaultyEngine, receiver: int = 0) -> list[tuple[str, int, bytes]]:
    return [(d.packet.sender, d.packet.sent_ns, d.packet.payload) for d in air.delivered if d.receiver == receiver]


BEFORE_THEM: list[list[dict[str, Any]]] = [
    [],
    [fault("DataReplay", 0.0, 1.5, nodes={"ids": ["v1"]}, age_s=9.0)],
    [fault("StaleMessages", 0.0, 5.0, nodes={"ids": ["v1"]}, age_s=9.0)],
]
"""Other faults on the same vehicle, which have nothing old enough to send."""


@pytest.mark.parametrize("others", BEFORE_THEM)
def test_stale_messages_are_those_of_some_time_ago(others: list[dict[str, Any]]) -> None:
    air = FaultyEngine([fault("StaleMessages", 1.0, 3.0, nodes={"ids": ["v1"]}, age_s=0.5), *others], count=2)
    for number in range(60):
        air.send(number * PERIOD_NS, 1, bytes([number]))
    air.go(10 * S)
    said = [payload[0] for _, _, payload in payloads(air)]
    fresh = [n if n < 15 or n >= 40 else n - 5 for n in range(60)]  # the first half second has nothing old enough
    assert said == fresh
    causes = [row["cause"] for row in air.rows()]
    assert causes == ["" if n < 15 or n >= 40 else "StaleMessages-0" for n in range(60)]


@pytest.mark.parametrize("others", BEFORE_THEM)
def test_replayed_data_come_beside_the_fresh_ones(others: list[dict[str, Any]]) -> None:
    air = FaultyEngine([fault("DataReplay", 1.0, 3.0, nodes={"ids": ["v1"]}, age_s=0.5), *others], count=2)
    for number in range(60):
        air.send(number * PERIOD_NS, 1, bytes([number]))
    air.go(10 * S)
    said = Counter(payload[0] for _, _, payload in payloads(air))
    assert said == Counter({n: 2 if 10 <= n < 35 else 1 for n in range(60)})
    copies = [row for row in air.rows() if row["copy"]]
    assert {row["cause"] for row in copies} == {"DataReplay-0"}
    assert [(row["seq"], row["sent_ns"]) for row in copies] == [(n - 5, n * PERIOD_NS) for n in range(15, 40)]


def test_a_flood_and_ghosts_are_so_many_more_frames() -> None:
    air = FaultyEngine(
        [fault("DoS", nodes={"ids": ["v1"]}, factor=4), fault("Sybil", nodes={"ids": ["v2"]}, ghosts=2)]
    )
    air.chat(10)
    air.go(5 * S)
    said = Counter(sender for sender, _, _ in payloads(air))
    assert said == {"v1": 40, "v2": 10, "v2~1": 10, "v2~2": 10, "v3": 10, "v4": 10}
    by_cause = Counter((row["sender"], row["cause"]) for row in air.rows() if row["receiver"] == "v0")
    assert by_cause["v1", "DoS-0"] == 30
    assert by_cause["v2", "Sybil-1"] == 20
    assert {row["sender"] for row in air.rows()} == set(air.ids), "the trace says who really sends"


def test_a_flood_fills_the_senders_own_queue_and_has_draws_of_its_own() -> None:
    air = FaultyEngine([fault("DoS", nodes={"ids": ["v1"]}, factor=50)], queue_frames=10, loss=0.5)
    air.chat(20)
    rows = [row for row in air.rows() if link(row) == ("v1", "v0")]
    assert Counter(row["outcome"] for row in rows)["queue_full"] >= 20 * 30
    lost = {seq: {r["copy"]: r["outcome"] for r in rows if r["seq"] == seq} for seq in range(20)}
    assert len({tuple(sorted(outcomes.items())) for outcomes in lost.values()}) > 15, "each is drawn for itself"
