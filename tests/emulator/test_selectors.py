"""Targets of faults: each selector against its plain definition, and choices that depend on nothing else."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emulator.fault_plan import (
    FaultPlan,
    Nodes,
    PlannedFault,
    fault_stream,
    partitioned_links,
    select,
    swizzle_times_ns,
)
from emulator.scenario.faults import Partition, Selector
from emulator.scenario.scenario import Scenario
from vnet.errors import ScenarioError

seeds = st.integers(0, 2**63 - 1)
counts = st.integers(1, 25)


def some_nodes(count: int, seed: int = 0) -> Nodes:
    rng = np.random.default_rng(seed)
    return Nodes([f"v{n}" for n in range(count)], rng.uniform(-100, 100, (count, 2)), rng.integers(0, count, count))


def chosen(nodes: Nodes, seed: int = 0, **selector: Any) -> list[int]:
    return np.flatnonzero(select(Selector(**selector), nodes, fault_stream(seed, 0, "select"))).tolist()


def planned(faults: list[dict[str, Any]], count: int, seed: int = 1) -> list[PlannedFault]:
    scenario = Scenario.model_validate({"run": {"seed": seed}, "fault": faults})
    return FaultPlan(scenario, some_nodes(count)).faults


@given(counts)
def test_without_a_word_all_are_meant(count: int) -> None:
    assert chosen(some_nodes(count)) == list(range(count))


@pytest.mark.slow
@given(counts, st.data())
def test_ids_are_exactly_those(count: int, data: st.DataObject) -> None:
    ids = data.draw(st.lists(st.integers(0, count - 1), max_size=count))
    assert chosen(some_nodes(count), ids=[f"v{n}" for n in ids]) == sorted(set(ids))


def test_a_vehicle_is_known_by_the_id_in_its_file_too() -> None:
    nodes = Nodes(["car", "flow-23-1", "x-23-2"], np.zeros((3, 2)), np.zeros(3, int))
    assert nodes.numbers(["flow#1", "#2", "flow-23-1", "car"]) == [1, 2, 1, 0]
    with pytest.raises(ScenarioError, match="'flow#2' is no vehicle"):
        nodes.numbers(["flow#2"])


@pytest.mark.slow
@given(counts, seeds, st.floats(0, 1, exclude_min=True))
def test_a_fraction_is_that_share_and_at_least_one(count: int, seed: int, fraction: float) -> None:
    number = len(chosen(some_nodes(count), seed, fraction=fraction))
    assert 1 <= number <= count
    assert number == 1 or abs(number - fraction * count) <= 0.5


@pytest.mark.slow
@given(counts, seeds, st.integers(1, 30))
def test_random_is_so_many_or_all(count: int, seed: int, number: int) -> None:
    assert len(chosen(some_nodes(count), seed, count=number)) == min(number, count)


@pytest.mark.slow
def test_everybody_is_drawn_as_often_as_the_others() -> None:
    nodes = some_nodes(8)
    drawn = np.bincount([n for seed in range(2000) for n in chosen(nodes, seed, count=2)], minlength=8)
    assert drawn.sum() == 4000
    assert np.all(np.abs(drawn - 500) < 5 * math.sqrt(500)), drawn


@pytest.mark.slow
@given(seeds, st.floats(-100, 100), st.floats(-100, 100), st.floats(0.1, 200))
def test_a_disc_holds_those_within_its_radius(seed: int, x: float, y: float, radius_m: float) -> None:
    nodes = some_nodes(20, seed % 1000)
    inside = [n for n, (px, py) in enumerate(nodes.position_m) if math.hypot(px - x, py - y) <= radius_m]
    assert chosen(nodes, disc=(x, y, radius_m)) == inside


@pytest.mark.slow
@settings(max_examples=80)
@given(
    seeds,
    st.lists(st.floats(0, 2 * math.pi), min_size=3, max_size=8, unique=True),
    st.floats(-60, 60),
    st.floats(5, 150),
    st.booleans(),
)
def test_a_convex_polygon_holds_those_on_the_inner_side_of_all_its_sides(
    seed: int, angles: list[float], middle: float, radius_m: float, backwards: bool
) -> None:
    nodes = some_nodes(20, seed % 1000)
    ordered = sorted(angles)
    corners = [(middle + radius_m * math.cos(a), radius_m * math.sin(a) - middle) for a in ordered]

    def side(k: int, x: float, y: float) -> float:
        (x1, y1), (x2, y2) = corners[k], corners[(k + 1) % len(corners)]
        return (x2 - x1) * (y - y1) - (y2 - y1) * (x - x1)

    sides = {n: [side(k, *p) for k in range(len(corners))] for n, p in enumerate(nodes.position_m.tolist())}
    clear = [n for n, values in sides.items() if min(map(abs, values)) > 1e-6]
    found = chosen(nodes, polygon=corners[::-1] if backwards else corners)
    assert [n for n in found if n in clear] == [n for n in clear if min(sides[n]) > 0]


def test_a_polygon_need_not_be_convex_and_its_order_counts() -> None:
    position_m = np.array([[1.0, 1.0], [5.0, 1.0], [9.0, 1.0], [5.0, 6.0], [5.0, 3.9]])
    nodes = Nodes([f"v{n}" for n in range(5)], position_m, np.zeros(5, int))
    horseshoe = [(0, 0), (10, 0), (10, 8), (8, 8), (8, 4), (2, 4), (2, 8), (0, 8)]
    assert chosen(nodes, polygon=horseshoe) == [0, 1, 2, 4]


@pytest.mark.slow
@given(seeds, st.integers(0, 20), st.integers(0, 20))
def test_a_degree_is_between_the_least_and_the_most(seed: int, one: int, other: int) -> None:
    nodes, least, most = some_nodes(20, seed % 1000), min(one, other), max(one, other)
    assert chosen(nodes, degree=(least, most)) == [n for n in range(20) if least <= nodes.degree[n] <= most]


KILL_ONE_OF_MANY = {"kind": "kill", "duration_s": 1, "nodes": {"count": 5}}


def test_the_same_seed_and_place_make_the_same_choice_and_others_another() -> None:
    one, again = (planned([KILL_ONE_OF_MANY] * 3, 25) for _ in range(2))
    assert [p.nodes.tolist() for p in one] == [p.nodes.tolist() for p in again]
    by_number = {tuple(p.nodes.tolist()) for p in one}
    by_seed = {tuple(planned([KILL_ONE_OF_MANY], 25, seed)[0].nodes.tolist()) for seed in range(20)}
    assert len(by_number) == 3, "each fault of a list draws for itself"
    assert len(by_seed) == 20


@pytest.mark.slow
@given(seeds, st.lists(st.sampled_from(["kill", "block", "partition", "swizzle"]), min_size=1, max_size=5))
def test_one_more_fault_at_the_end_changes_nothing_before_it(seed: int, kinds: list[str]) -> None:
    faults = [{"kind": k, "duration_s": 1} | ({} if k == "partition" else {"nodes": {"count": 3}}) for k in kinds]
    fewer, more = planned(faults, 12, seed), planned([*faults, KILL_ONE_OF_MANY], 12, seed)
    for one, same in zip(fewer, more, strict=False):
        assert one.nodes.tolist() == same.nodes.tolist()
        assert one.links is None or one.links.tolist() == same.links.tolist()  # type: ignore[union-attr]
        if one.fault.kind == "swizzle":
            assert swizzle_times_ns(one, seed) == swizzle_times_ns(same, seed)


@pytest.mark.slow
@given(seeds, st.data())
def test_links_have_an_end_among_the_nodes_and_go_from_senders_to_receivers(seed: int, data: st.DataObject) -> None:
    some = st.lists(st.integers(0, 7), unique=True).map(lambda ns: [f"v{n}" for n in ns]) | st.none()
    given_ids = {key: data.draw(some, key) for key in ("nodes", "senders", "receivers")}
    fault: dict[str, Any] = {"kind": "block", "duration_s": 1}
    fault |= {key: {"ids": ids} for key, ids in given_ids.items() if ids is not None}
    (one,) = planned([fault], 8, seed)

    def among(n: int, key: str) -> bool:
        ids = given_ids[key]
        return ids is None or f"v{n}" in ids

    assert one.links is not None
    for s in range(8):
        for r in range(8):
            expected = (among(s, "nodes") or among(r, "nodes")) and among(s, "senders") and among(r, "receivers")
            assert one.links[s, r] == expected


def cut(count: int, seed: int, groups: Any) -> np.ndarray:
    fault = Partition(kind="partition", duration_s=1, groups=groups)
    return partitioned_links(fault, some_nodes(count), fault_stream(seed, 0, "select"))


def islands(severed: np.ndarray) -> list[int]:
    """The sizes of the groups of a partition, which must be groups: connected within, and cut between."""
    rows = {tuple(row) for row in severed.tolist()}
    groups = [[n for n, out in enumerate(row) if not out] for row in rows]
    assert sorted(n for group in groups for n in group) == list(range(len(severed)))
    return sorted(map(len, groups))


@pytest.mark.slow
@given(st.integers(2, 25), seeds)
def test_halves_differ_by_one_at_most_and_one_is_one(count: int, seed: int) -> None:
    assert islands(cut(count, seed, "halves")) == [count // 2, count - count // 2]
    assert islands(cut(count, seed, "one")) == [1, count - 1]


def test_groups_are_cut_from_each_other_and_from_those_whom_nobody_named() -> None:
    severed = cut(7, 1, [["v0", "v1"], ["v2"]])
    assert islands(severed) == [1, 2, 4]
    assert not severed[0, 1]
    assert severed[1, 2]
    assert not severed[5, 6]


@pytest.mark.slow
@given(st.integers(1, 30), seeds)
def test_on_a_ring_each_hears_a_majority_and_no_two_the_same_one(count: int, seed: int) -> None:
    severed = cut(count, seed, "ring")
    heard = [frozenset(np.flatnonzero(~severed[:, receiver]).tolist()) for receiver in range(count)]
    assert {len(others) for others in heard} == {count // 2 + 1}
    assert all(receiver in others for receiver, others in enumerate(heard))
    if count > 2:
        assert len(set(heard)) == count


@pytest.mark.slow
@given(st.integers(1, 12), seeds, st.floats(0.001, 24), st.floats(0.001, 30))
def test_a_swizzle_cuts_all_off_one_by_one_and_has_them_back_by_its_end(
    count: int, seed: int, over_s: float, duration_s: float
) -> None:
    fault = {"kind": "swizzle", "at_s": 0.5, "duration_s": duration_s, "over_s": over_s, "nodes": {"count": 5}}
    (one,) = planned([fault], count, seed)
    times = swizzle_times_ns(one, seed)
    half_ns = round(over_s * 1e9) // 2
    assert sorted(node for node, _, _ in times) == np.flatnonzero(one.nodes).tolist()
    assert sorted(off for _, off, _ in times) == [off for _, off, _ in times], "one after the other"
    assert all(one.start_ns <= off <= one.start_ns + half_ns < back for _, off, back in times if half_ns >= 5)
    assert all(back <= one.start_ns + 2 * half_ns for _, _, back in times)


def test_a_swizzles_way_back_is_in_an_order_of_its_own() -> None:
    fault = {"kind": "swizzle", "duration_s": 10.0}
    orders = set()
    for seed in range(20):
        times = swizzle_times_ns(planned([fault], 6, seed)[0], seed)
        off = [node for node, _, _ in times]
        back = [node for node, _, _ in sorted(times, key=lambda t: t[2])]
        orders.add(tuple(off.index(node) for node in back))
    assert len(orders) > 10


@pytest.mark.parametrize("kind", ["emulator_restart", "router_restart"])
def test_infrastructure_concerns_all(kind: str) -> None:
    (one,) = planned([{"kind": kind}], 5)
    assert one.nodes.all()
    assert one.links is None
