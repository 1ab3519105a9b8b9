"""Vehicles that exchange information about the common error: a small network without a radio."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import fields, replace
from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.cooperative.attacker import Attack, InformationAttacker, Lie
from agents.cooperative.cmm.information import Five, Information
from agents.cooperative.cmm.plausibility import moved, scaled_by
from agents.cooperative.frame import FrameError, name_of_code, short_name
from agents.cooperative.information_estimator import LOST_PERIODS, InformationEstimator, _pooled
from agents.cooperative.information_frame import PASSED, InformationFrame, decode, encode, room
from agents.cooperative.options import Options
from tests.agents.cooperative.cmm.test_city_roads import road_map
from vnet import Fix, Packet
from vnet.roads.lanes import LaneMap
from vnet.types import Array

pytestmark = pytest.mark.slow

PERIOD_NS = 100_000_000
COMMON_M = np.array([2.0, -1.5])
Change = Callable[[str, InformationFrame], InformationFrame | None]


def _honest(_: str, frame: InformationFrame) -> InformationFrame:
    return frame


class Network:
    """Vehicles on lanes through the origin in all directions, that hear their neighbours on a ring, or all.

    late: the vehicles whose frames reach the others a period later.
    """

    period_ns = PERIOD_NS
    late: Collection[str] = ()

    def __init__(self, count: int = 6, reach: int | None = None, **options: object) -> None:
        headings = np.arange(count) * np.pi / count
        self.lanes = LaneMap(np.zeros((count, 2)), headings, 0.85)
        self.ids = [f"v{k}" for k in range(count)]
        self.options = Options.parse({"exchange": "information", "particles": 300, **options})
        self.estimators = [self.new(k) for k in range(count)]
        self.reach = count if reach is None else reach
        self.period = 0
        self._delayed: list[tuple[int, bytes]] = []
        self._rng = np.random.default_rng(1)

    def new(self, k: int) -> InformationEstimator:
        """Return a vehicle that has just started."""
        return InformationEstimator(self.ids[k], self.options, self.lanes, np.random.default_rng(k), self.period_ns)

    def run(self, periods: int, change: Change = _honest) -> None:
        """Run some periods; `change` is what becomes of the frame of each vehicle, None if it is lost."""
        for _ in range(periods):
            now_ns = self.period * self.period_ns
            fixes = [self.fix(k) for k in range(len(self.ids))]
            sent: list[bytes | None] = []
            for name, estimator, fix in zip(self.ids, self.estimators, fixes, strict=True):
                payload = estimator.frame(fix, 1400)
                if change is not _honest:
                    frame = change(name, decode(payload))
                    sent.append(None if frame is None else encode(frame))
                else:
                    sent.append(payload)
            payloads = [(j, payload) for j, payload in enumerate(sent) if payload is not None]
            arriving = self._delayed + [each for each in payloads if self.ids[each[0]] not in self.late]
            self._delayed = [each for each in payloads if self.ids[each[0]] in self.late]
            for k, estimator in enumerate(self.estimators):
                packets = [
                    Packet(self.ids[j], now_ns, now_ns + 5_000_000, payload)
                    for j, payload in arriving
                    if 0 < min((j - k) % len(sent), (k - j) % len(sent)) <= self.reach
                ]
                estimator.read(packets, now_ns + 50_000_000)
                estimator.filter(fixes[k])
                estimator.agree()
            self.period += 1

    def fix(self, k: int) -> Fix:
        """Return a fix of vehicle k, which stands at the origin."""
        noise_m = self._rng.standard_normal(2)
        heading = float(self.lanes.heading_rad[k])
        return Fix(self.period * self.period_ns, COMMON_M + noise_m, np.eye(2), heading)

    def errors_m(self) -> Array:
        """Return the errors (n,) of all estimates of the common error."""
        return np.array([np.linalg.norm(e.common_error[0] - COMMON_M) for e in self.estimators])


def test_vehicles_agree_on_the_common_error() -> None:
    network = Network()
    network.run(60)
    assert network.errors_m().max() < 0.6
    positions = np.array([e.position(network.fix(k))[0] for k, e in enumerate(network.estimators)])
    assert np.abs(positions).max() < 1.0
    assert sum(e.rejected.total() for e in network.estimators) < 0.01 * 60 * 30  # of all frames


class RoadNetwork(Network):
    """Vehicles that drive away from each other, each on a road of its own, at 12 m/s, with two fixes a second."""

    period_ns = 500_000_000

    def __init__(self, count: int, reach: int) -> None:
        self.heading_rad = 2 * np.pi * np.arange(count) / count
        self.ahead = np.column_stack([np.cos(self.heading_rad), np.sin(self.heading_rad)])
        places, headings = (100 * self.ahead).tolist(), self.heading_rad.tolist()
        lanes = [(x, y, heading, 2000.0) for (x, y), heading in zip(places, headings, strict=True)]
        self.roads = road_map(lanes, sigma_m=1.0)
        super().__init__(count, reach)

    def new(self, k: int) -> InformationEstimator:
        return InformationEstimator(self.ids[k], self.options, self.roads, np.random.default_rng(k), self.period_ns)

    def fix(self, k: int) -> Fix:
        position_m = (150 + 12e-9 * self.period_ns * self.period) * self.ahead[k]
        seen_m = position_m + COMMON_M + self._rng.standard_normal(2)
        return Fix(self.period * self.period_ns, seen_m, np.eye(2), float(self.heading_rad[k]))


class MovingNetwork(Network):
    """Vehicles with receivers of some deviations (m), in the program's own world: c moves, and offsets do.

    common: deviation (m) and correlation time (s) of c, of which the program is told.
    """

    def __init__(
        self, sigma_m: list[float], seed: int, reach: int | None = None, common: tuple[float, float] = (3.0, 600.0)
    ) -> None:
        super().__init__(len(sigma_m), reach, common_sigma_m=common[0], common_tau_s=common[1])
        self._sigma_m, self._common = sigma_m, common
        self.change: Change = _honest
        self._rng = np.random.default_rng(seed)
        self.common_m = common[0] * self._rng.standard_normal(2)
        self._offset_m = 0.38 * self._rng.standard_normal(len(sigma_m))

    def advance(self, periods: int) -> list[float]:
        """Run some periods; returns the mean of the normalized squared errors of c after each: 1 if consistent."""
        found: list[float] = []
        for _ in range(periods):
            self.run(1, self.change)
            self.move()
            errors = [(e.common_error[0] - self.common_m, e.common_error[1]) for e in self.estimators]
            found.append(float(np.mean([off @ np.linalg.solve(spread, off) / 2 for off, spread in errors])))
        return found

    def move(self) -> None:
        """Move on by a period."""
        for state, sigma_m, tau_s in ((self.common_m, *self._common), (self._offset_m, 0.38, 20.0)):
            keep = np.exp(-0.1 / tau_s)
            state *= keep
            state += sigma_m * np.sqrt(1 - keep**2) * self._rng.standard_normal(len(state))

    def fix(self, k: int) -> Fix:
        """Return a fix of vehicle k, which stands beside the origin."""
        heading, sigma_m = float(self.lanes.heading_rad[k]), self._sigma_m[k]
        beside_m = self._offset_m[k] * np.array([np.sin(heading), -np.cos(heading)])
        noise_m = sigma_m * self._rng.standard_normal(2)
        return Fix(self.period * PERIOD_NS, self.common_m + beside_m + noise_m, sigma_m**2 * np.eye(2), heading)


@pytest.mark.parametrize("sigma_m", [[0.1] * 6, [0.03] * 6, [0.03, 0.3, 3.0, 0.1, 1.0, 30.0]])
@pytest.mark.parametrize("reach", [1, 6])
def test_precise_receivers_do_not_claim_too_much(sigma_m: list[float], reach: int) -> None:
    """With increments about c alone the mean is 4 to 60."""
    found: list[float] = []
    for seed in range(2):
        found += MovingNetwork(sigma_m, seed, reach).advance(60)
    assert np.mean(found) < 1.8


def test_a_precise_vehicle_that_comes_later_is_consistent() -> None:
    found: list[float] = []
    for seed in range(3):
        network = MovingNetwork([0.1] * 6, seed)
        network.advance(21)
        network.estimators[0] = network.new(0)
        found += network.advance(39)[5:]
    assert np.mean(found) < 3.1


def test_hardly_any_honest_prior_is_dropped() -> None:
    """On a ring neighbours know of different others, so that some are off for long, and right."""
    network = Network(12, reach=2)
    network.run(50)
    assert sum(e.rejected["prior"] + e.rejected["banned"] for e in network.estimators) < 0.001 * 50 * 48  # frames


def test_alone_a_vehicle_knows_less() -> None:
    together, alone = Network(), Network(reach=0)
    together.run(60)
    alone.run(60)
    assert np.sqrt(np.mean(together.errors_m() ** 2)) < 0.6 * np.sqrt(np.mean(alone.errors_m() ** 2))


def test_without_fusion_increments_are_added_all_the_same() -> None:
    network = Network(fusion="none")
    network.run(60)
    assert network.errors_m().max() < 0.8
    assert all(e.weights[name] == 1 for name, e in zip(network.ids, network.estimators, strict=True))


@pytest.mark.parametrize("relay_increments", [0, 30])
def test_increments_are_passed_on_one_hop(relay_increments: int) -> None:
    """On a ring each vehicle hears two others; two more are two hops away."""
    network = Network(8, reach=1, relay_increments=relay_increments)
    network.run(5)
    assert {e.imported for e in network.estimators} == ({4} if relay_increments else {2})
    frame = network.estimators[0].compose(network.fix(0), 1400)
    names = [name_of_code(code) for code in frame.passed["name"].tolist()]
    expected = [short_name(name) for name in ("v0", "v1", "v7")]
    assert names[:1] == expected[:1] * bool(relay_increments)
    assert sorted(names) == sorted(expected) * bool(relay_increments)


@pytest.mark.parametrize(("lost", "least"), [(0.0, 0.35), (0.3, 0.25)])
def test_on_a_map_an_increment_goes_on_until_all_have_used_it_once(lost: float, least: float) -> None:
    """Roads say little at a time, and c hardly moves while that is passed on.

    With increments of two hops a vehicle of this ring states 0.27 of what all fixes say, and 0.22 with loss.
    """
    network, rng = RoadNetwork(12, reach=1), np.random.default_rng(5)
    told = []

    def listen(_: str, frame: InformationFrame) -> InformationFrame | None:
        told.append(frame.increment)
        return frame if rng.random() >= lost else None

    network.run(20, listen)
    known = np.array([Information.of(*e.common_error).numbers for e in network.estimators])
    share = known[:, [0, 2]].sum(axis=1) / (np.array(told)[:, [0, 2]].sum() + 2 / 9)
    assert share.min() > least
    assert share.max() < 1, "nothing is used twice"
    assert network.errors_m().max() < 0.6
    assert sum(e.rejected["forged"] for e in network.estimators) == 0
    if not lost:
        assert {e.imported for e in network.estimators} == {11}


@given(count=st.integers(1, 2000), said=st.floats(1e-3, 1e3), common_m2=st.floats(1e-4, 1.0))
def test_many_increments_say_no_more_than_their_common_error_allows(
    count: int, said: float, common_m2: float
) -> None:
    increment = said, 0.0, said, 3 * said, -2 * said
    pooled = _pooled([], [], [increment] * count, common_m2)
    assert pooled.matrix[0, 0] == pytest.approx(1 / (1 / (count * said) + common_m2))
    assert pooled.moments()[0].tolist() == pytest.approx([3.0, -2.0])


def test_what_pooled_priors_hold_is_not_added_again() -> None:
    """All hear all, so nobody has an increment that the others have not used themselves."""
    network = Network(6, relay_increments=30)
    network.run(5)
    assert {e.imported for e in network.estimators} == {5}


def test_a_frame_holds_as_many_increments_as_there_is_room_for() -> None:
    network = Network(8, relay_increments=30)
    network.run(5)
    estimator, seen = network.estimators[0], set()
    for _ in range(7):
        fix = network.fix(0)
        payload = estimator.frame(fix, 170)
        frame = decode(payload)
        assert len(payload) <= 170
        assert len(frame.passed) == room(len(frame.heard), 170) == 3
        assert name_of_code(frame.passed["name"][0]) == estimator.name
        seen |= set(frame.passed["name"][1:].tolist())
        network.run(1)
    assert len(seen) > 3  # in turns


def _shifted(information: Five, by_m: Array, factor: float = 1.0) -> Five:
    return scaled_by(moved(information, *by_m.tolist()), factor)


@pytest.mark.parametrize(("off_m", "factor"), [(10.0, 1.0), (10.0, 100.0), (3.0, 1.0)])
def test_a_liar_moves_nobody(off_m: float, factor: float) -> None:
    def lie(name: str, frame: InformationFrame) -> InformationFrame:
        if name != "v0" or network.period < 20:
            return frame
        by_m = np.array([off_m, 0.0])
        increment = _shifted(frame.increment, by_m, factor)
        return replace(frame, prior=_shifted(frame.prior, by_m), increment=increment)

    network = Network(8)
    network.run(80, lie)
    assert network.errors_m()[1:].max() < 0.7
    assert all(e.rejected["prior"] > 20 for e in network.estimators[1:])


@pytest.mark.parametrize("lie", get_args(Lie))
def test_an_attacker_moves_nobody(lie: Lie) -> None:
    """One of eight lies from second 2 on, in each of the ways that there are."""
    network = Network(8)
    attacker = InformationAttacker("v0", network.options, network.lanes, np.random.default_rng(0), PERIOD_NS)
    attacker.attack = Attack(lie=lie, offset_m=(10.0, 0.0), from_s=2.0)
    network.estimators[0] = attacker
    network.run(80)
    assert attacker.sent == 60
    assert network.errors_m()[1:].max() < 0.7


def test_who_is_always_to_one_side_gets_no_weight() -> None:
    """The priors of one of eight are off by less than a gate lets through, always to the same side."""

    def lie(name: str, frame: InformationFrame) -> InformationFrame:
        return replace(frame, prior=_shifted(frame.prior, np.array([0.3, 0.0]))) if name == "v0" else frame

    network = Network(8)
    network.run(80, lie)
    others = [e.weights for e in network.estimators[1:]]
    assert [weights["v0"] for weights in others] == [0.0] * 7
    assert [sum(weights.values()) for weights in others] == pytest.approx([1.0] * 7)
    assert all(max(weights[f"v{k}"] for weights in others) > 0 for k in range(1, 8))


def test_an_increment_with_a_negative_eigenvalue_is_gated_like_any_other() -> None:
    def lie(name: str, frame: InformationFrame) -> InformationFrame:
        return replace(frame, increment=(0.0, 0.18, 2.0, 3e3, 0.0)) if name == "v0" else frame

    network = Network(6)
    network.run(10, lie)
    assert network.errors_m()[1:].max() < 2.0


def test_passed_on_increments_that_are_forged_are_seen() -> None:
    def lie(name: str, frame: InformationFrame) -> InformationFrame:
        passed = frame.passed.copy()
        if name == "v0":
            passed["information"][:, 3] += 2.0
        return replace(frame, passed=passed)

    network = Network(8, reach=2)
    network.run(40, lie)
    assert network.errors_m()[1:].max() < 0.7
    assert all(network.estimators[k].rejected["forged"] > 20 for k in (1, 2, 6, 7))


@pytest.mark.parametrize("count", [1, 2])  # two say the same as each other
def test_vehicles_that_are_wrong_begin_again_where_the_others_are(count: int) -> None:
    network = Network(8)
    network.run(30)
    for lost in network.estimators[:count]:
        prior = lost.own.prior
        lost.restart(prior.plus(Information.from_arrays(prior.matrix, prior.matrix @ np.array([30.0, 0]))))
    network.run(1)
    assert network.errors_m()[:count].min() > 5
    network.run(LOST_PERIODS)
    assert network.errors_m()[:count].max() < 2, "at once"
    network.run(30)
    assert network.errors_m().max() < 0.7


def test_who_begins_three_deviations_off_believes_the_only_two_it_hears() -> None:
    """They are too few for it to begin again, and its own lane does not tell it."""
    network = Network(8, reach=1)
    network.run(30)
    covariance_m2 = np.diag([5.8, 0.1])  # its lane leads east
    network.estimators[0].restart(Information.of(COMMON_M + np.array([7.5, 0.0]), covariance_m2))
    assert network.errors_m()[0] > 7
    network.run(80)
    assert network.errors_m()[0] < 1.0


def test_a_restarted_vehicle_learns_from_the_others() -> None:
    network = Network(6)
    network.run(30)
    network.estimators[0] = network.new(0)
    network.run(10)
    assert network.errors_m()[0] < 0.9


def test_a_frame_that_is_late_by_more_than_a_period_is_not_used() -> None:
    network = Network(3)
    network.run(5)
    late = network.estimators[1].frame(network.fix(1), 1400)
    network.period += 2
    estimator, fix = network.estimators[0], network.fix(0)
    estimator.read([Packet("v1", 0, 0, late)], fix.time_ns + 1)
    estimator.filter(fix)
    estimator.agree()
    assert estimator.imported == 0
    assert estimator.rejected["late"] == 1


@pytest.mark.parametrize("late", [["v0"], ["v0", "v2", "v4"], [f"v{k}" for k in range(6)]])
@pytest.mark.parametrize("sigma_m", [1.0, 0.1])
def test_an_increment_that_misses_its_period_is_used_in_the_next(late: list[str], sigma_m: float) -> None:
    punctual, network = MovingNetwork([sigma_m] * 6, 0), MovingNetwork([sigma_m] * 6, 0)
    network.late = late
    punctual.advance(60)
    assert np.mean(network.advance(60)) < 1.2
    stated_m2, expected_m2 = [
        [np.trace(each.common_error[1]) for each in some.estimators] for some in (network, punctual)
    ]
    assert 0.9 * np.mean(expected_m2) < np.min(stated_m2) < np.max(stated_m2) < 1.1 * np.mean(expected_m2), (
        "none twice"
    )
    assert all(each.mean_m is not None for each in network.estimators), "the consensus goes on"
    assert sum(each.rejected.total() for each in network.estimators) == 0


@pytest.mark.parametrize("every", [1, 2])
@pytest.mark.parametrize("reach", [1, 2])
def test_what_frames_that_miss_their_period_know_goes_round(every: int, reach: int) -> None:
    """None of it twice, and more than half of what goes round in time."""
    punctual, network = Network(12, reach), Network(12, reach)
    network.late = network.ids[::every]
    for each in (punctual, network):
        each.run(60)
    usual, known = (
        [Information.of(*e.common_error).matrix.trace() for e in each.estimators] for each in (punctual, network)
    )
    assert 0.53 * min(usual) < min(known) < max(known) < max(usual)
    assert network.errors_m().mean() < 0.5


@pytest.mark.parametrize("late", [[], ["v0", "v2", "v4"], [f"v{k}" for k in range(6)]])
def test_on_a_map_none_that_misses_its_period_is_used_twice(late: list[str]) -> None:
    network, told = RoadNetwork(6, reach=1), []
    network.late = late

    def listen(_: str, frame: InformationFrame) -> InformationFrame:
        told.append(frame.increment)
        return frame

    network.run(20, listen)
    known = np.array([Information.of(*e.common_error).numbers for e in network.estimators])
    share = known[:, [0, 2]].sum(axis=1) / (np.array(told)[:, [0, 2]].sum() + 2 / 9)
    assert 0.3 < share.min() <= share.max() < 1


@pytest.mark.parametrize(("liars", "always_new"), [(["v0"], True), (["v0", "v4"], False)])
@pytest.mark.parametrize(("off_m", "claim"), [(1.0, 0.5), (5.0, 0.1)])
def test_increments_of_origins_that_are_invented_hardly_draw(
    liars: list[str], always_new: bool, off_m: float, claim: float
) -> None:
    """Twenty a period, which one of eight lists, or two list alike; as many are about lanes, and say the same."""
    network = Network(8)
    network.run(30)
    false = np.zeros(40, dtype=PASSED)
    false["information"][:20] = claim, 0.0, claim, claim * (COMMON_M[0] + off_m), claim * COMMON_M[1]
    false["information"][20:] = np.sqrt(claim), 0.0, -1.0, np.sqrt(claim) * (COMMON_M[0] + off_m), 1.0

    def lie(name: str, frame: InformationFrame) -> InformationFrame:
        if name not in liars:
            return frame
        false["name"] = np.arange(40) + (40 * network.period if always_new else 0)
        return replace(frame, passed=np.concatenate([frame.passed, false]))

    network.run(50, lie)
    honest_m = [m for name, m in zip(network.ids, network.errors_m(), strict=True) if name not in liars]
    assert np.sqrt(np.mean(np.square(honest_m))) < 0.5 * off_m


@pytest.mark.parametrize("off_m", [1.0, 2.0])
def test_two_hundred_origins_that_one_invents_in_one_period_move_nobody_far(off_m: float) -> None:
    network = Network(8)
    network.run(30)
    false = np.zeros(200, dtype=PASSED)
    false["name"] = np.arange(200)
    false["information"] = 0.5, 0.0, 0.5, 0.5 * (COMMON_M[0] + off_m), 0.5 * COMMON_M[1]
    before = [e.common_error[0] for e in network.estimators]
    network.run(
        1, lambda name, frame: replace(frame, passed=np.append(frame.passed, false)) if name == "v0" else frame
    )
    moved_m = [np.linalg.norm(e.common_error[0] - was) for e, was in zip(network.estimators, before, strict=True)]
    assert max(moved_m[1:]) < 0.2


def _off(liars: Collection[str], off_m: float, claim: float = 1.0) -> Change:
    """Return the lie that c is off, by priors and by increments, of so many times the claim."""

    def lie(name: str, frame: InformationFrame) -> InformationFrame:
        if name not in liars:
            return frame
        prior, increment = (moved(scaled_by(said, claim), off_m, 0.0) for said in (frame.prior, frame.increment))
        return replace(frame, prior=prior, increment=increment)

    return lie


def test_few_that_are_in_time_are_no_majority_of_the_late() -> None:
    network = Network(10)
    network.late = network.ids[3:]
    network.run(20)
    network.run(60, _off(network.ids[:3], 50.0))
    assert network.errors_m()[3:].max() < 1.0


def test_a_late_prior_that_claims_more_than_most_draws_nobody_along() -> None:
    """Late priors that are more certain than one's own count by their share of all that are late."""
    network = Network(12, reach=1)
    network.late = network.ids
    network.run(40)

    def lie(name: str, frame: InformationFrame) -> InformationFrame:
        return replace(frame, prior=moved(scaled_by(frame.prior, 1.5), 0.5, 0.0)) if name == "v0" else frame

    network.run(100, lie)
    assert np.sqrt(np.mean(np.square(network.errors_m()[1:]))) < 0.6


def test_liars_that_are_most_of_what_is_heard_in_one_period_move_nobody() -> None:
    network = Network(10)
    network.run(60)
    lie = _off(network.ids[:3], 20.0, 100.0)
    network.run(10, lie)
    network.run(1, lambda name, frame: lie(name, frame) if name in network.ids[:4] else None)
    assert network.errors_m()[3:].max() < 0.5


def test_late_frames_tell_a_vehicle_that_it_is_wrong() -> None:
    network = Network(6)
    network.late = network.ids
    network.run(30)
    network.estimators[0].restart(Information.of(COMMON_M + np.array([7.5, 0.0]), 0.01 * np.eye(2)))
    network.run(40)
    assert network.errors_m()[0] < 1.0


def test_without_the_defence_late_frames_do_not_have_a_vehicle_begin_again(monkeypatch: pytest.MonkeyPatch) -> None:
    network = Network(6, defence=False)
    network.late = network.ids
    network.run(20)
    network.estimators[0].restart(Information.of(COMMON_M + np.array([50.0, 0.0]), 0.0001 * np.eye(2)))
    monkeypatch.setattr(InformationEstimator, "restart", lambda *_: pytest.fail("it has begun again"))
    network.run(20)


def test_what_is_not_used_is_not_passed_on() -> None:
    network = Network(10)
    network.run(30)
    network.run(30, _off(["v0"], 20.0))
    frames = [estimator.compose(network.fix(k), 1400) for k, estimator in enumerate(network.estimators)]
    assert all(int(short_name("v0"), 16) not in frame.passed["name"] for frame in frames[1:])


def test_who_misses_a_period_calls_nobody_a_forger() -> None:
    network = Network(6)
    network.run(10)
    missing, network.estimators[0] = network.estimators[0], network.new(0)
    network.run(1)
    network.estimators[0] = missing
    network.run(2)
    assert missing.rejected.total() == 0


@pytest.mark.parametrize("is_late", [False, True])
def test_a_precise_vehicle_that_begins_later_takes_the_age_of_the_others(is_late: bool) -> None:
    network = MovingNetwork([0.1] * 6, 0)
    network.late = network.ids if is_late else ()
    network.advance(21)
    network.estimators[0] = network.new(0)
    network.advance(15)
    frames = [estimator.compose(network.fix(k), 1400) for k, estimator in enumerate(network.estimators)]
    assert len({frame.increment[4] for frame in frames}) == 1


def test_who_passes_on_what_a_liar_claims_is_still_heard() -> None:
    """A huge increment with the right mean contradicts nobody; with half precision it would be infinite."""

    def lie(name: str, frame: InformationFrame) -> InformationFrame:
        huge = (1e5, 0.0, 1e5, *(1e5 * COMMON_M).tolist())
        return replace(frame, increment=huge) if name == "v0" else frame

    network = Network(6)
    with pytest.raises(FrameError, match="absurd"):
        decode(encode(lie("v0", decode(network.estimators[0].frame(network.fix(0), 1400)))))
    network.run(20, lie)
    assert all(e.rejected["not_finite"] == 0 and e.rejected["absurd"] > 0 for e in network.estimators[1:])


def test_a_receiver_of_millimetres_keeps_to_what_a_frame_holds() -> None:
    network = Network(3)
    fix = replace(network.fix(0), covariance_m2=1e-8 * np.eye(2))
    estimator = network.estimators[0]
    for period in range(3):
        frame = decode(estimator.frame(replace(fix, time_ns=period * PERIOD_NS), 1400))
        assert np.isfinite(frame.passed["information"]).all()
        estimator.agree()


def test_a_frame_that_is_sent_again_by_another_is_rejected() -> None:
    network = Network(3)
    network.run(2)
    payload = network.estimators[1].frame(network.fix(1), 1400)
    estimator = network.estimators[0]
    estimator.read([Packet("v2", 0, 0, payload)], network.period * PERIOD_NS)
    assert estimator.rejected == {"replayed": 1}


def test_vehicles_that_say_nothing_of_c_are_not_taken_for_one() -> None:
    """The increments of all outliers are 0, and those of vehicles off the road nearly."""
    network = Network(3)
    network.run(20)
    fixes = [network.fix(k) for k in range(3)]
    far = [replace(fix, position_m=fix.position_m + 500.0) for fix in fixes]
    payloads = [estimator.frame(fix, 1400) for estimator, fix in zip(network.estimators, far, strict=True)]
    assert not np.any([decode(payload).increment for payload in payloads])
    packets = [Packet(f"v{k}", 0, 0, payloads[k]) for k in (1, 2)]
    network.estimators[0].read(packets, network.period * PERIOD_NS)
    assert not network.estimators[0].rejected


def test_a_receiver_that_fails_sends_and_counts_nothing() -> None:
    network = Network(3)
    network.run(20)
    estimator = network.estimators[0]
    before = estimator.common_error
    fix = Fix(network.period * PERIOD_NS, np.full(2, np.nan), np.eye(2), None)
    estimator.filter(fix)
    estimator.agree()
    assert np.isfinite(estimator.position(fix)[0]).all()
    assert np.linalg.norm(estimator.common_error[0] - before[0]) < 0.1


def test_without_a_lane_a_vehicle_learns_from_the_others() -> None:
    network = Network(6)
    network.lanes = LaneMap(np.zeros((0, 2)), np.zeros(0), 0.85)
    network.estimators[0] = network.new(0)
    network.lanes = LaneMap(np.zeros((6, 2)), np.arange(6) * np.pi / 6, 0.85)
    network.run(40)
    assert network.errors_m()[0] < 0.7
    position_m, covariance_m2 = network.estimators[0].position(network.fix(0))
    assert np.linalg.norm(position_m) < 4
    assert np.linalg.eigvalsh(covariance_m2)[1] > 0.9  # across, no better than a fix


@st.composite
def frames(draw: st.DrawFn) -> InformationFrame:
    """Draw a frame as a vehicle sends one, with single precision."""
    number = st.floats(-3, 3, width=32)
    matrix = [draw(st.floats(low, high, width=32)) for low, high in ((0.5, 4), (-0.25, 0.25), (0.5, 4))]
    information = matrix[0], matrix[1], matrix[2], draw(number), draw(number)
    heard = draw(st.dictionaries(st.integers(0, 2**32 - 1).map(name_of_code), st.booleans(), max_size=12))
    passed = np.zeros(draw(st.integers(0, 30)), dtype=PASSED)
    passed["name"] = np.arange(len(passed))
    passed["information"] = np.array(information, dtype=np.float16)
    weight = draw(st.floats(0, 100))
    return InformationFrame(
        name=name_of_code(draw(st.integers(0, 2**32 - 1))),
        fix_time_ns=draw(st.integers(0, 2**60)),
        prior=information,
        increment=information,
        epoch=draw(st.integers(0, 2**32 - 1)),
        running_sum=(weight * draw(st.floats(-9, 9)), weight * draw(st.floats(-9, 9)), weight),
        heard=heard,
        passed=passed,
        largest_degree=draw(st.integers(0, 255)),
    )


@given(frames())
def test_a_frame_comes_back(frame: InformationFrame) -> None:
    payload = encode(frame)
    got = decode(payload)
    assert np.array_equal(got.passed, frame.passed)
    others = [field.name for field in fields(frame) if field.name != "passed"]
    assert [getattr(got, name) for name in others] == [getattr(frame, name) for name in others]
    assert len(frame.passed) <= room(len(frame.heard), len(payload))


@given(frames(), st.data())
def test_a_frame_that_is_changed_does_not_decode(frame: InformationFrame, data: st.DataObject) -> None:
    payload = bytearray(encode(frame))
    payload[data.draw(st.integers(0, len(payload) - 1))] ^= data.draw(st.integers(1, 255))
    with pytest.raises(FrameError):
        decode(bytes(payload))


ONE = (1.0, 0.0, 1.0, 0.0, 0.0)


def passed_on(information: Five) -> dict[str, Array]:
    return {"passed": np.array([(7, ONE), (8, information)], dtype=PASSED)}


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"prior": (np.nan, 0.0, 1.0, 0.0, 0.0)}, "not_finite"),
        ({"prior": (1.0, 2.0, 1.0, 0.0, 0.0)}, "covariance"),
        ({"prior": (-1.0, 0.0, -1.0, 0.0, 0.0)}, "covariance"),
        ({"prior": (1.0, 0.0, 1.0, 1e6, 0.0)}, "absurd"),
        ({"prior": (1e9, 0.0, 1.0, 0.0, 0.0)}, "absurd"),
        ({"increment": (1e9, 0.0, 1.0, 0.0, 0.0)}, "absurd"),
        ({"increment": (-1.0, 0.0, 1.0, 0.0, 0.0)}, "covariance"),
        ({"increment": (1.0, 0.0, -1.5, 0.0, 0.0)}, "absurd"),
        ({"increment": (1.0, 0.0, -1985.0, 0.0, 0.0)}, "absurd"),
        ({"increment": (1.0, 0.0, -1.0, 0.0, 256.0)}, "absurd"),
        ({"increment": (np.inf, 0.0, 1.0, 0.0, 0.0)}, "not_finite"),
        ({"running_sum": (1e9, 0.0, 1.0)}, "absurd"),
        ({"running_sum": (0.0, 0.0, -1.0)}, "absurd"),
        (passed_on((1.0, 0.0, 1.0, np.inf, 0.0)), "not_finite"),
        (passed_on((1.0, 0.0, 1.0, 0.0, np.nan)), "not_finite"),
        (passed_on((1.0, 2.0, 1.0, 0.0, 0.0)), "covariance"),
        (passed_on((-1.0, 0.0, 1.0, 0.0, 0.0)), "covariance"),
    ],
)
def test_numbers_that_cannot_be_are_refused(change: dict[str, Any], reason: str) -> None:
    frame = InformationFrame("00000001", 0, ONE, ONE, 0, (0.0, 0.0, 1.0), {})
    assert decode(encode(frame)).prior == ONE
    with pytest.raises(FrameError, match=reason):
        decode(encode(replace(frame, **change)))
