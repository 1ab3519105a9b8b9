"""Links kept as rows of neighbours and links kept as matrices of all pairs give the same run."""

import hashlib
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emulator.radio import topology
from emulator.radio.topology import Disc, Matrix, Topology
from tests.support.faulty_engine import PERIOD_NS, FaultyEngine, fault
from vnet.types import Array

FAULTS = [
    fault("range", range_m=150.0, nodes=["v2", "v5"]),
    fault("partition", duration_s=0.4, groups="halves"),
    fault("burst_loss", at_s=0.3, duration_s=0.6),
    fault("swizzle", at_s=0.2, duration_s=0.6, nodes=["v3"]),
    fault("jitter", jitter_ms=50.0, nodes=["v1"]),
    fault("delay", delay_ms=30.0, nodes=["v1", "v4"]),
    fault("duplicate", probability=0.5, copies=2, delay_ms=20.0),
    fault("corrupt", probability=0.5),
    fault("throttle", at_s=0.4, duration_s=0.5, bitrate_mbps=0.01, nodes=["v6"]),
    fault("DataReplay", at_s=0.5, duration_s=0.4, nodes=["v7"]),
]


def hashed(
    position_m: Array, seed: int, kinds: list[dict[str, Any]], down: set[int], **radio: Any
) -> tuple[str, ...]:
    """Run an engine whose vehicles move in every third period; return its trace's hash, packets and counts."""
    count = len(position_m)
    subject = FaultyEngine(kinds, count, seed, **radio)
    subject.engine.set_positions(position_m)
    for period in range(9):
        if period % 3 == 2:
            position_m = position_m + np.random.default_rng([seed, period]).normal(0, 60, (count, 2))
            subject.engine.set_positions(position_m)
        for node in down:
            subject.engine.set_up(node, period < 3 or period > 6)
        subject.chat(1, first=period)
    subject.go(12 * PERIOD_NS)
    subject.rows()
    packets = hashlib.sha256(repr([(d.receiver, d.packet) for d in subject.delivered]).encode()).hexdigest()
    return subject.engine.trace.sha256(), packets, str(subject.engine.counts)


@pytest.mark.slow
@settings(max_examples=12, deadline=None)
@given(
    st.integers(0, 2**32),
    st.integers(8, 20),
    st.lists(st.sampled_from(FAULTS), max_size=4, unique_by=id),
    st.sets(st.integers(0, 7), max_size=3),
    st.sampled_from([1, 3, 30]),
)
def test_rows_of_neighbours_and_matrices_give_the_same_run(
    seed: int, count: int, kinds: list[dict[str, Any]], down: set[int], cap: int
) -> None:
    rng = np.random.default_rng(seed)
    position_m = np.round(rng.uniform(0, 600, (count, 2)), -2)  # many coincide, or are exactly at the range
    position_m[rng.random(count) < 0.1] = np.nan
    radio = {"range_m": 300.0, "max_peers": cap, "latency_ms": 150.0, "jitter_ms": 80.0, "queue_frames": 3}
    traces = []
    for most in (0, 1000):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(topology, "MOST_IN_MATRICES", most)
            traces.append(hashed(position_m, seed, kinds, down, **radio))
    assert traces[0] == traces[1]


@pytest.mark.slow
@given(st.integers(0, 2**32), st.integers(1, 30), st.integers(1, 6), st.booleans())
def test_the_cap_admits_the_same_links_of_both(seed: int, count: int, cap: int, is_matrix: bool) -> None:
    rng = np.random.default_rng(seed)
    position_m = np.round(rng.uniform(0, 500, (count, 2)), -2)
    reach = Matrix(rng.random((count, count)) < 0.3) if is_matrix else Disc(200.0)
    admitted = []
    for most in (0, 1000):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(topology, "MOST_IN_MATRICES", most)
            subject = Topology(position_m, reach, cap)
            for node in range(0, count, 5):
                subject.set_up(node, False)
            pairs = subject.admitted_links()
            admitted.append((pairs.sender.tolist(), pairs.receiver.tolist(), pairs.distance_m.tolist()))
            assert subject.links.matrix().tolist() == reach.links(position_m).matrix().tolist()
    assert admitted[0] == admitted[1]


def test_a_thousand_nodes_set_up_rank_the_senders_once(monkeypatch: pytest.MonkeyPatch) -> None:
    rank = Mock(side_effect=Topology._admitted, autospec=True)
    monkeypatch.setattr(Topology, "_admitted", lambda self: rank(self))
    subject = Topology(np.random.default_rng(1).uniform(0, 1e4, (1000, 2)), Disc(500.0), 5)
    for node in range(1000):
        subject.set_up(node, node % 2 == 0)
    first = subject.now
    subject.set_up(3, False)  # it is down already
    assert subject.now is first and rank.call_count == 1
    assert not subject.now.admitted[1::2].any()
