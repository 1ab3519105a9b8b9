"""Increments about c less a filter's memory of it: laws that hold exactly, against a filter of all states."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.cooperative.cmm.information import Five, Information
from agents.cooperative.cmm.kalman_bound import LaneModel
from agents.cooperative.cmm.lane_memory import (
    ALL_KINDS,
    KINDS,
    MAX_KINDS,
    CommonMemory,
    LaneFilter,
    gains_of,
    information_of,
    kind_of,
    kind_of_increment,
    law_of,
    summed,
)
from vnet.types import Array

PERIOD_S = 0.1
MODEL = LaneModel()
KEEP = math.exp(-PERIOD_S / MODEL.lateral_tau_s)
SPREAD_M2 = MODEL.lateral_sigma_m**2


def noise_m2(kind: int) -> float:
    """Return the variance of fixes for which the gains of `kind` are the best."""
    first = gains_of(kind, KEEP, SPREAD_M2)[0]
    return law_of(kind, KEEP, SPREAD_M2)[1] * (1 - first) / first


def multipath_of(kind: int) -> tuple[float, float]:
    """Return variance and correlation time of the offset in the family of `kind`, relative to the first one."""
    keep, spread_m2 = law_of(kind, KEEP, SPREAD_M2)
    return spread_m2 / SPREAD_M2, math.log(KEEP) / math.log(keep)


class AllStates:
    """The Kalman filter of c and of all offsets, which hears all fixes across the lanes."""

    def __init__(self, heading_rad: Array, kinds: list[int]) -> None:
        self._normal = np.column_stack([np.sin(heading_rad), -np.cos(heading_rad)])
        self._noise_m2 = np.diag([noise_m2(kind) for kind in kinds])
        laws = [law_of(kind, KEEP, SPREAD_M2) for kind in kinds]
        self._keep, self._spread_m2 = [keep for keep, _ in laws], np.array([spread_m2 for _, spread_m2 in laws])
        self.mean = np.zeros(2 + len(kinds))
        self.covariance = np.diag([MODEL.common_sigma_m**2] * 2 + self._spread_m2.tolist())

    def predict(self) -> None:
        keep_c, more_m2 = MODEL.common_step(PERIOD_S)
        moves = np.array([keep_c] * 2 + self._keep)
        self.mean = moves * self.mean
        noise = np.diag([more_m2] * 2 + (self._spread_m2 * (1 - moves[2:] ** 2)).tolist())
        self.covariance = self.covariance * np.outer(moves, moves) + noise

    def take(self, across_m: Array) -> None:
        measured = np.column_stack([self._normal, np.eye(len(across_m))])
        seen = measured @ self.covariance @ measured.T + self._noise_m2
        gain = self.covariance @ measured.T @ np.linalg.inv(seen)
        self.mean = self.mean + gain @ (across_m - measured @ self.mean)
        self.covariance = self.covariance - gain @ measured @ self.covariance


@st.composite
def vehicles(draw: st.DrawFn) -> tuple[Array, list[int], int]:
    """Draw headings, kinds of at most three receivers with or without multipath, and a seed."""
    count = draw(st.integers(2, 6))
    heading_rad = np.array(draw(st.lists(st.floats(0, 6.28), min_size=count, max_size=count)))
    some = draw(st.lists(st.integers(4, 28), min_size=1, max_size=3, unique=True))
    families = draw(st.lists(st.integers(0, ALL_KINDS // KINDS - 1) | st.just(0), min_size=3, max_size=3))
    some = [kind + KINDS * family for kind, family in zip(some, families, strict=False)]
    return heading_rad, [some[k % len(some)] for k in range(count)], draw(st.integers(0, 2**32 - 1))


def _filters(heading_rad: Array, kinds: list[int]) -> list[LaneFilter]:
    return [
        LaneFilter((np.zeros(2), float(heading)), MODEL, noise_m2(kind) * np.eye(2), PERIOD_S, multipath_of(kind))
        for heading, kind in zip(heading_rad, kinds, strict=True)
    ]


def _take(memory: CommonMemory, increments: list[Five], is_before: bool = False) -> None:
    sums = summed((kind_of_increment(each), information_of(each)) for each in increments)
    for kind, information in sums.items():
        assert memory.follow(kind)
        memory.take(kind, information, is_before)


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(vehicles())
def test_increments_of_all_receivers_add_up_exactly(drawn: tuple[Array, list[int], int]) -> None:
    heading_rad, kinds, seed = drawn
    rng, filters = np.random.default_rng(seed), _filters(heading_rad, kinds)
    assert [each.kind for each in filters] == kinds
    whole, memory = AllStates(heading_rad, kinds), CommonMemory(MODEL, PERIOD_S)
    for period in range(12):
        if period:
            whole.predict()
            memory.predict()
        fixes_m = rng.normal(0, 3, (len(kinds), 2))
        increments = []
        for lane, fix_m in zip(filters, fixes_m, strict=True):
            if period:
                lane.predict()
            memory.follow(lane.kind)
            lane.begin(memory.memory(lane.kind))
            increments.append(lane.take(fix_m, memory.age))
        _take(memory, increments)
        whole.take(np.sum(whole._normal * fixes_m, axis=1))
        (x, y), (xx, xy, yy) = memory.common
        np.testing.assert_allclose([x, y], whole.mean[:2], rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose([[xx, xy], [xy, yy]], whole.covariance[:2, :2], rtol=1e-5, atol=1e-8)


def test_an_increment_that_comes_a_period_late_says_the_same() -> None:
    heading_rad, kinds = np.array([0.3, 1.9]), [20, 15]
    rng, filters = np.random.default_rng(3), _filters(heading_rad, kinds)
    in_time, late = CommonMemory(MODEL, PERIOD_S), CommonMemory(MODEL, PERIOD_S)
    waiting: list[Five] = []
    for period in range(10):
        for memory in (in_time, late):
            if period:
                memory.predict()
            for kind in kinds:
                memory.follow(kind)
        _take(late, waiting, is_before=True)
        np.testing.assert_allclose(late.common[0], in_time.common[0], rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(late.common[1], in_time.common[1], rtol=1e-6)
        increments = []
        for lane in filters:
            if period:
                lane.predict()
            lane.begin(in_time.memory(lane.kind))
            increments.append(lane.take(rng.normal(0, 1, 2), period))
        _take(in_time, increments)
        _take(late, increments[:1])
        waiting = increments[1:]


def test_who_comes_later_knows_as_much_of_memories_as_who_has_waited() -> None:
    waited = CommonMemory(MODEL, PERIOD_S)
    waited.follow(18)
    for _ in range(40):
        waited.predict()
    late = CommonMemory(MODEL, PERIOD_S, waited.age)
    late.follow(18)
    late.predict()
    waited.predict()
    belief = Information.of(np.array([1.0, -2.0]), np.diag([0.2, 0.1]))
    for memory in (waited, late):
        memory.absorb(belief)
    np.testing.assert_allclose(late.memory(18)[0], waited.memory(18)[0], rtol=0.02)
    np.testing.assert_allclose(late.memory(18)[1], waited.memory(18)[1], rtol=0.1, atol=1e-6)


def test_kinds_that_nobody_uses_are_forgotten_and_no_more_than_a_few_are_followed() -> None:
    memory = CommonMemory(MODEL, PERIOD_S)
    assert all(memory.follow(kind) for kind in range(1, MAX_KINDS + 1))
    assert not memory.follow(MAX_KINDS + 1)
    assert memory.follow(MAX_KINDS + 2, is_own=True)
    for _ in range(102):
        memory.predict()
        memory.follow(1)
    assert all(memory.follow(kind) for kind in range(20, 20 + MAX_KINDS - 1))


@pytest.mark.parametrize("kind", [*range(1, KINDS + 1), 20 + KINDS, 20 + KINDS * 63])
def test_a_kind_has_its_own_gain(kind: int) -> None:
    gains = gains_of(kind, KEEP, SPREAD_M2)
    assert kind_of(gains[-1]) == 1 + (kind - 1) % KINDS
    assert max(np.diff(gains)) < 1e-9, "the less is known, the more a fix says"
