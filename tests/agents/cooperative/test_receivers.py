"""Receivers of all kinds in one network: stated multipath, outliers, and headings that come and go."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import emulator
from agents.cooperative.cmm.kalman_bound import LaneModel, OffsetAndMultipath
from agents.cooperative.cmm.lane_memory import LaneExchange
from agents.cooperative.cmm.own_vehicle import OwnConfig, OwnVehicle
from agents.cooperative.cmm.rbpf import Observation, RbpfConfig
from agents.cooperative.information_frame import InformationFrame
from tests.agents.cooperative.test_information import PERIOD_NS, Change, MovingNetwork
from vnet import Fix
from vnet.roads.lanes import LaneMap

pytestmark = pytest.mark.slow
PERIOD_S = PERIOD_NS / 1e9


@dataclass(frozen=True)
class Receiver:
    """A receiver: deviation of its noise, deviation and correlation time of multipath, shares of bad fixes."""

    sigma_m: float = 1.0
    multipath_m: float = 0.0
    tau_s: float = 60.0
    outliers: float = 0.0
    headless: float = 0.0


class MixedNetwork(MovingNetwork):
    """Vehicles with any receivers; what they state of multipath is true.

    beside: true if there is another lane beside that of the first.
    """

    def __init__(
        self,
        receivers: list[Receiver],
        seed: int,
        reach: int | None = None,
        common: tuple[float, float] = (3.0, 600.0),
        beside: bool = False,
    ) -> None:
        super().__init__([each.sigma_m for each in receivers], seed, reach, common)
        if beside:
            places_m = np.vstack([np.zeros((len(receivers), 2)), [0.0, -3.0]])
            self.lanes = LaneMap(places_m, np.append(self.lanes.heading_rad, 0.0), 0.85)
            self.estimators = [self.new(k) for k in range(len(receivers))]
        self._receivers = receivers
        self._multipath_m = np.array([each.multipath_m for each in receivers])[:, None] * self._rng.standard_normal(
            (len(receivers), 2)
        )

    def move(self) -> None:
        """Move on by a period."""
        super().move()
        for row, each in zip(self._multipath_m, self._receivers, strict=True):
            keep = math.exp(-PERIOD_S / each.tau_s)
            row *= keep
            row += each.multipath_m * math.sqrt(1 - keep**2) * self._rng.standard_normal(2)

    def fix(self, k: int) -> Fix:
        """Return a fix of vehicle k."""
        fix, receiver = super().fix(k), self._receivers[k]
        away_m = 30.0 if self._rng.random() < receiver.outliers else 0.0
        direction = self._rng.standard_normal(2)
        return replace(
            fix,
            position_m=fix.position_m + self._multipath_m[k] + away_m * direction / np.linalg.norm(direction),
            covariance_m2=fix.covariance_m2 + receiver.multipath_m**2 * np.eye(2),
            heading_rad=None if self._rng.random() < receiver.headless else fix.heading_rad,
            multipath_sigma_m=receiver.multipath_m,
            multipath_tau_s=receiver.tau_s if receiver.multipath_m else 0.0,
        )


def consistency(receivers: list[Receiver], seeds: int, reach: int, periods: int = 60) -> float:
    """Return the mean of the normalized squared errors of c over some runs."""
    found: list[float] = []
    for seed in range(seeds):
        found += MixedNetwork(receivers, seed, reach).advance(periods)
    return float(np.mean(found))


@pytest.mark.parametrize("reach", [1, 6])
@pytest.mark.parametrize(
    "receivers",
    [
        [Receiver(multipath_m=1.0)] * 6,
        [Receiver(sigma_m=0.1, multipath_m=1.0)] * 6,
        [Receiver(0.1), Receiver(1.0, 0.5), Receiver(3.0, 3.0)] * 2,
    ],
)
def test_with_multipath_that_is_stated_vehicles_do_not_claim_too_much(
    receivers: list[Receiver], reach: int
) -> None:
    assert consistency(receivers, 2, reach) < 1.8


receivers = st.builds(
    Receiver,
    sigma_m=st.sampled_from([0.03, 0.1, 0.3, 1.0, 3.0, 10.0]),
    multipath_m=st.sampled_from([0.0, 0.3, 1.0, 3.0]),
    tau_s=st.floats(20, 200),
    outliers=st.sampled_from([0.0, 0.02, 0.1]),
    headless=st.sampled_from([0.0, 0.5, 1.0]),
).filter(lambda each: each.sigma_m > 0.03 or not each.headless)  # particles are too few for it: docs/estimator.md


@settings(max_examples=8, deadline=None, derandomize=True)
@given(
    st.lists(receivers, min_size=3, max_size=6),
    st.integers(0, 2**16),
    st.integers(1, 3),
    st.sampled_from([(3.0, 600.0), (10.0, 300.0), (5.0, 100.0)]),
    st.booleans(),
)
def test_in_any_network_errors_are_as_stated(
    drawn: list[Receiver], seed: int, reach: int, common: tuple[float, float], beside: bool
) -> None:
    """A world is one sample: the normalized squared error of two coordinates is beyond 16 once in ten million."""
    network = MixedNetwork(drawn, seed, reach, common, beside)
    assert network.advance(40)[-1] < 16
    for estimator in network.estimators:
        assert np.isfinite(estimator.common_error[0]).all()
        assert (np.linalg.eigvalsh(estimator.common_error[1]) > 0).all()


class BadStart(MixedNetwork):
    """The first fix of a vehicle is an outlier, at a time when nobody can tell."""

    def fix(self, k: int) -> Fix:
        """Return a fix of vehicle k."""
        fix = super().fix(k)
        return replace(fix, position_m=fix.position_m + np.array([6.0, 9.0])) if k == self.period == 0 else fix


def test_a_first_fix_that_is_an_outlier_moves_nobody() -> None:
    found: list[float] = []
    for seed in range(3):
        found += BadStart([Receiver()] * 6, seed).advance(10)
    assert np.mean(found) < 2


@pytest.mark.parametrize("sigma_m", [0.03, 0.3])
def test_who_hears_of_older_memories_at_second_hand_alone_is_consistent(sigma_m: float) -> None:
    """Three of a ring of six begin late at once: the middle one hears only the other two."""
    found: list[float] = []
    for seed in range(3):
        network = MixedNetwork([Receiver(sigma_m)] * 6, seed, 1)
        network.advance(20)
        for k in (0, 1, 5):
            network.estimators[k] = network.new(k)
        found += network.advance(30)[6:]
    assert np.mean(found) < 1.6


def root_mean_square_m(network: MixedNetwork, periods: int, liars: set[str], lie: Change) -> float:
    """Return the error of c of the others over some periods."""
    squares, network.change = [], lie
    for _ in range(periods):
        network.advance(1)
        honest = [e for name, e in zip(network.ids, network.estimators, strict=True) if name not in liars]
        squares += [float(np.sum((e.common_error[0] - network.common_m) ** 2)) for e in honest]
    return math.sqrt(np.mean(squares))


@pytest.mark.parametrize("count", [6, 8])
def test_increments_of_a_minority_that_colludes_do_not_take_over(count: int) -> None:
    """Two of a vehicle's five neighbours, or three of seven, claim a thousand times as much, 0.3 m off."""
    liars = {f"v{k}" for k in range((count - 1) // 2)}
    network = MixedNetwork([Receiver()] * count, 0)

    def bold(name: str, frame: InformationFrame) -> InformationFrame:
        if name not in liars:
            return frame
        x, y = network.estimators[int(name[1:])].common_error[0] + np.array([0.3, 0.0])
        return replace(frame, increment=(1e3, 0.0, 1e3, 1e3 * float(x), 1e3 * float(y)))

    network.advance(30)
    assert root_mean_square_m(network, 30, liars, bold) < 0.8


@pytest.mark.parametrize(("count", "most_m"), [(1, 0.55), (2, 1.2)])
def test_increments_of_lanes_that_claim_much_do_not_weigh_as_the_honest_do(count: int, most_m: float) -> None:
    """One or two of six precise receivers claim 900 m⁻² of the direction that their lane tells, 0.3 m off."""
    liars = {f"v{k}" for k in range(count)}
    network = MixedNetwork([Receiver(0.1)] * 6, 0)

    def bold(name: str, frame: InformationFrame) -> InformationFrame:
        a, b, kind, x, age = frame.increment
        if name not in liars or kind >= 0 or not (a or b):
            return frame
        more = 30.0 / math.hypot(a, b)
        return replace(frame, increment=(more * a, more * b, kind, more * x + 30.0 * 0.3, age))

    network.advance(30)
    assert root_mean_square_m(network, 50, liars, bold) < most_m


@pytest.mark.parametrize("reach", [1, 8])
def test_who_claims_ever_older_memories_does_not_stop_the_exchange(reach: int) -> None:
    network = MixedNetwork([Receiver(0.1)] * 8, 0, reach)

    def older(name: str, frame: InformationFrame) -> InformationFrame:
        if name != "v0":
            return frame
        return replace(frame, increment=(0.0, 0.0, -1.0, 0.0, float(2 * network.period)))

    network.advance(30)
    assert root_mean_square_m(network, 60, {"v0"}, older) < 0.45


def test_an_increment_of_another_age_is_not_judged_and_not_used() -> None:
    lanes = LaneMap(np.zeros((1, 2)), np.zeros(1), 0.85)
    exchange = LaneExchange(OwnVehicle(OwnConfig(RbpfConfig()), lanes, np.random.default_rng(1)), PERIOD_S)
    exchange.join([(0.0, 1.0, -3.0, 0.5, 20.0)])
    for age, is_before, is_used in ((20, False, True), (20, True, False), (19, True, True), (5, False, False)):
        assert exchange.can_use((0.0, 1.0, -3.0, 0.5, float(age)), is_before) == is_used


@pytest.mark.parametrize(
    ("has_joined", "multipath_m", "says"), [(False, 3.0, True), (True, 3.0, False), (True, 0.0, True)]
)
def test_who_is_between_two_lanes_says_nothing_beside_increments_of_lanes(
    has_joined: bool, multipath_m: float, says: bool
) -> None:
    """A precise receiver: its increments about c claim how that has moved once more. c had an ANEES of 60."""
    lanes = LaneMap(np.array([[0.0, 0.0], [0.0, 3.0]]), np.zeros(2), 0.85)
    exchange = LaneExchange(OwnVehicle(OwnConfig(RbpfConfig()), lanes, np.random.default_rng(1)), PERIOD_S)
    if has_joined:
        exchange.join([(0.0, 1.0, -3.0, 0.5, 20.0)])
    fix = Observation(np.array([0.0, 1.5]), (1 + multipath_m**2) * np.eye(2), 0.0, multipath=(multipath_m, 200.0))
    said = np.array([exchange.step(PERIOD_S, fix) for _ in range(20)])
    assert (said[:, 2] >= 0).all(), "no increment of a lane"
    assert said.any() == says


def test_in_a_city_a_common_error_that_moves_fast_is_followed(tmp_path: Path) -> None:
    """Ten precise receivers corrected c by many times its movement: after 18 s by 17 m too much, stating 0.5."""
    scenario = {
        "run": {"seed": 7, "duration_s": 18.0, "settle_s": 0.0},
        "network": {"kind": "city", "vehicles": 10, "seed": 5007},
        "world": {
            "gnss": {"sigma_m": 0.25},
            "common_error": {"sigma_m": 10.0, "tau_s": 300.0},
            "lateral": {"half_width_m": 1.5, "sigma_m": 0.35},
        },
        "program": {
            "entry": "agents.cooperative:main",
            "options": {"common_sigma_m": 10.0, "common_tau_s": 300.0},
        },
    }
    figures = emulator.simulate(scenario, out=tmp_path / "run").figures
    assert max(figures[name] or 0 for name in ("common_error_rmse_m", "common_error_anees")) < 2


@pytest.mark.parametrize(("rate_hz", "lateral_tau_s"), [(40.0, 20.0), (10.0, 200.0)])
def test_many_fixes_and_offsets_that_last_claim_no_more_than_precise_ones(
    tmp_path: Path, rate_hz: float, lateral_tau_s: float
) -> None:
    """Both show how c moves between fixes, as precise receivers do: as coarse ones they had 2.7 and 1.8."""
    scenario = {
        "run": {"duration_s": 20.0},
        "network": {"vehicles": 8, "layout": "dense"},
        "world": {"gnss": {"rate_hz": rate_hz}, "lateral": {"tau_s": lateral_tau_s}},
        "radio": {"loss": 0.1},
        "program": {"entry": "agents.cooperative:main", "options": {"lateral_tau_s": lateral_tau_s}},
    }
    anees = emulator.simulate(scenario, seed=4, out=tmp_path / "run").figures["common_error_anees"]
    assert anees is not None and 0.4 < anees < 1.4


def test_offset_and_multipath_make_one_process() -> None:
    lane = LaneModel()
    both = OffsetAndMultipath.of(lane, 1.0, 60.0)
    assert both.lateral_sigma_m**2 == pytest.approx(lane.lateral_sigma_m**2 + 1)
    power = lane.lateral_sigma_m**2 * lane.lateral_tau_s + 60.0
    assert both.lateral_sigma_m**2 * both.lateral_tau_s == pytest.approx(power)
    share, across_m2, along_m2 = both.hidden
    assert share**2 * both.lateral_sigma_m**2 + across_m2 == pytest.approx(lane.lateral_sigma_m**2)
    assert along_m2 == 1.0


def observed(sigma_m: float = 1.0, multipath_m: float = 0.0) -> Observation:
    covariance_m2 = (sigma_m**2 + multipath_m**2) * np.eye(2)
    return Observation(np.array([0.2, 0.1]), covariance_m2, 0.0, multipath=(multipath_m, 60.0))


def test_positions_are_as_uncertain_as_the_multipath_that_nobody_can_tell_from_them() -> None:
    lanes = LaneMap(np.zeros((1, 2)), np.zeros(1), 0.85)
    own = OwnVehicle(OwnConfig(RbpfConfig()), lanes, np.random.default_rng(1))
    for _ in range(20):
        own.step(0.1, observed(0.1, 2.0))
    position = own.position_m()
    assert position is not None
    across_m2, along_m2 = position[1][1, 1], position[1][0, 0]
    assert along_m2 > 4 and 0.38**2 * 0.8 < across_m2 <= 0.38**2 * 1.01
    own.step(0.1, observed(0.1))
    position = own.position_m()
    assert position is not None and position[1][1, 1] < 0.38**2
