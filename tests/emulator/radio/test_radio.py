"""The stages of a physical radio one by one, against formulas and figures from elsewhere."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from scipy.integrate import quad

from emulator.drivers.emulation import Emulation
from emulator.drivers.simulate import simulate
from emulator.radio.congestion import BusyRatioMeter, LimericControl, ReactiveControl
from emulator.radio.connectivity import connectivity_of, distances_m
from emulator.radio.dot11p import COST_STEPS, airtime_ns, arrival_probability, cost
from emulator.radio.engine import Engine
from emulator.radio.medium import SLICE_NS, WINDOW_NS
from emulator.radio.outcomes import Outcome
from emulator.radio.propagation import QUANTILES, MeanPower, Nakagami, ShadowField, loss_db
from emulator.radio.signals import reception_draws
from emulator.radio.topology import Topology
from emulator.records.run_folder import RunFolder
from emulator.scenario.radio import (
    RATES_MBPS,
    DualSlope,
    EtsiReactive,
    Fading,
    FreeSpace,
    Limeric,
    LogDistance,
    Shadowing,
    TwoRay,
)
from emulator.scenario.scenario import Radio, Scenario, dump_scenario, load_scenario
from emulator.world.world import build_world
from tests.support.motion import along, scenario_of_trips, write_trips
from vnet.errors import ScenarioError

MS = 1_000_000
LIGHT_M_S = 299_792_458.0
PERIOD_NS = 100 * MS


def engine(position_m: np.ndarray, seed: int = 1, **radio: Any) -> Engine:
    ids = [f"v{number}" for number in range(len(position_m))]
    return Engine(ids, Radio.model_validate({"access_jitter_ms": 0, **radio}), seed, position_m, None)


def line(*east_m: float) -> np.ndarray:
    return np.column_stack([east_m, np.zeros(len(east_m))])


# Path loss.


def test_free_space_is_friis_and_the_default_reference_is_its_first_metre() -> None:
    distance_m = np.array([1.0, 10.0, 250.0, 3000.0])
    wavelength_m = LIGHT_M_S / 5.9e9
    friis = (wavelength_m / (4 * np.pi * distance_m)) ** 2
    assert loss_db(FreeSpace(kind="free_space"), distance_m) == pytest.approx(-10 * np.log10(friis))
    assert loss_db(FreeSpace(kind="free_space"), distance_m)[0] == pytest.approx(47.86, abs=0.01)
    log_distance = loss_db(LogDistance(kind="log_distance"), distance_m)
    assert log_distance == pytest.approx(loss_db(FreeSpace(kind="free_space"), distance_m), abs=0.01)


def test_slopes_are_what_the_exponents_say_and_meet_at_the_break() -> None:
    model = DualSlope(kind="dual_slope", exponent=2.0, far_exponent=4.0, break_m=100.0)
    one, ten, hundred, thousand = loss_db(model, np.array([1.0, 10.0, 100.0, 1000.0]))
    assert (ten - one, hundred - ten, thousand - hundred) == pytest.approx((20, 20, 40))
    steep = loss_db(LogDistance(kind="log_distance", exponent=3.5, reference_db=50.0), np.array([100.0]))
    assert steep == pytest.approx(50 + 70)


def test_nearer_than_a_metre_is_like_a_metre() -> None:
    for model in (LogDistance(kind="log_distance"), TwoRay(kind="two_ray"), FreeSpace(kind="free_space")):
        assert np.ptp(loss_db(model, np.array([0.0, 0.5, 1.0]))) == 0


def test_two_rays_swing_about_free_space_and_far_away_fall_with_the_fourth_power() -> None:
    model = TwoRay(kind="two_ray", antenna_m=1.5)
    near_m = np.linspace(10, 100, 5000)
    gain = loss_db(FreeSpace(kind="free_space"), near_m) - loss_db(model, near_m)
    assert gain.max() > 2
    assert gain.min() < -4
    far = loss_db(model, np.array([3000.0, 30_000.0]))
    assert far[1] - far[0] == pytest.approx(40, abs=0.5)
    # Both rays by hand, at 200 m.
    path, bounce, wavelength_m = 200.0, math.hypot(200.0, 3.0), LIGHT_M_S / 5.9e9
    sine, root = 3.0 / bounce, math.sqrt(1.02 - (200.0 / bounce) ** 2)
    reflected = (sine - root) / (sine + root) * np.exp(2j * np.pi * (path - bounce) / wavelength_m)
    expected = -20 * math.log10(wavelength_m / (4 * np.pi * path) * abs(1 + reflected))
    assert loss_db(model, np.array([200.0]))[0] == pytest.approx(expected)


# Shadowing.


@pytest.fixture(scope="module")
def field() -> ShadowField:
    return ShadowField(Shadowing(sigma_db=4.0, decorrelation_m=25.0), seed=7)


def test_shadowing_has_its_deviation(field: ShadowField) -> None:
    position_m = np.random.default_rng(1).uniform(0, 20_000, (500, 2))
    loss = field.between(position_m, distances_m(position_m))[np.triu_indices(500, 1)]
    assert loss.mean() == pytest.approx(0, abs=0.1)
    assert loss.std() == pytest.approx(4.0, rel=0.03)
    assert abs(stats.kurtosis(loss)) < 0.2


@pytest.mark.parametrize("step_m", [5.0, 25.0, 60.0])
def test_shadowing_has_gudmundsons_correlation_for_either_end(step_m: float) -> None:
    count, upper = 200, np.triu_indices(200, 1)
    position_m = np.random.default_rng(1).uniform(0, 20_000, (count, 2))
    both = np.vstack([position_m, position_m + np.array([step_m, 0])])
    found = []
    for seed in range(8):
        loss = ShadowField(Shadowing(decorrelation_m=25.0), seed).between(both, distances_m(both))
        still, one, two = loss[:count, :count][upper], loss[count:, :count][upper], loss[count:, count:][upper]
        found.append([np.corrcoef(still, one)[0, 1], np.corrcoef(still, two)[0, 1]])
    expected = [math.exp(-step_m / 25), math.exp(-2 * step_m / 25)]
    assert np.mean(found, axis=0) == pytest.approx(expected, abs=0.04)


def test_shadowing_is_the_same_both_ways_and_whoever_else_is_there(field: ShadowField) -> None:
    position_m = np.random.default_rng(2).uniform(0, 2000, (40, 2))
    loss = field.between(position_m, distances_m(position_m))
    assert np.array_equal(loss, loss.T)
    some = position_m[[3, 30, 17]]
    assert field.between(some, distances_m(some)) == pytest.approx(loss[np.ix_([3, 30, 17], [3, 30, 17])])
    again = ShadowField(Shadowing(sigma_db=4.0), seed=7).between(some, distances_m(some))
    assert np.array_equal(again, field.between(some, distances_m(some)))
    assert not np.allclose(again, ShadowField(Shadowing(sigma_db=4.0), seed=8).between(some, distances_m(some)))


def test_shadowing_of_neighbours_is_no_stronger_than_of_others() -> None:
    """Where both ends are at one place, both directions are the same wave."""
    drawn = [
        ShadowField(Shadowing(sigma_db=3.0), seed).between(line(0, 0.1), distances_m(line(0, 0.1)))[0, 1]
        for seed in range(400)
    ]
    assert np.std(drawn) == pytest.approx(3.0, rel=0.12)


# Fading.


@pytest.mark.parametrize("m", [0.5, 0.75, 1.0, 1.5, 10.0])
def test_factors_are_gamma_distributed_with_mean_one(m: float) -> None:
    nakagami = Nakagami(Fading(m=(m, 1.0), until_m=(1e6,)))
    shape = nakagami.shape(np.full(QUANTILES, 10.0))
    factors = nakagami.factor(shape, np.arange(QUANTILES, dtype=np.uint64))
    assert factors.mean() == pytest.approx(1, abs=1e-4)
    assert stats.kstest(factors, stats.gamma(m, scale=1 / m).cdf).statistic < 1e-4


def test_each_stretch_has_its_shape() -> None:
    nakagami = Nakagami(Fading(m=(1.5, 0.75), until_m=(80.0,)))
    middle = np.full(3, QUANTILES // 2, np.uint64)
    near, edge, far = nakagami.factor(nakagami.shape(np.array([5.0, 80.0, 80.1])), middle)
    assert near == edge == pytest.approx(stats.gamma(1.5, scale=1 / 1.5).ppf(0.5), rel=1e-4)
    assert far == pytest.approx(stats.gamma(0.75, scale=1 / 0.75).ppf(0.5), rel=1e-4)


# 802.11p.


@pytest.mark.parametrize(
    ("size", "rate", "expected_us"),
    [(300, 6.0, 448), (300, 3.0, 40 + 8 * 101), (300, 27.0, 40 + 8 * 12), (1400, 6.0, 40 + 8 * 234), (0, 6.0, 48)],
)
def test_airtimes_are_those_of_the_standard(size: int, rate: float, expected_us: int) -> None:
    assert airtime_ns(size, rate) == expected_us * 1000


def nist_qpsk_half(snr: float, bits: int) -> float:
    """Pei and Henderson's formula for 6 Mbit/s, term by term."""
    raw = 0.5 * math.erfc(math.sqrt(snr / 2))
    d = math.sqrt(4 * raw * (1 - raw))
    weights = [36, 211, 1404, 11633, 77433, 502690, 3322763, 21292910, 134365911]
    error = 0.5 * sum(weight * d ** (10 + 2 * number) for number, weight in enumerate(weights))
    return float((1 - min(error, 1)) ** bits)


@pytest.mark.parametrize("snr_db", [2, 4, 5, 5.5, 6, 6.5, 7, 8, 9, 12])
def test_arrival_is_the_nist_models(snr_db: float) -> None:
    snr = 10 ** (snr_db / 10)
    found = arrival_probability(np.array([snr]), airtime_ns(300, 6.0), 6.0)[0]
    assert found == pytest.approx(nist_qpsk_half(snr, 51 * 48), abs=1e-6)


@pytest.mark.parametrize(
    ("rate", "half_db"),
    [
        (3.0, 2.954),
        (4.5, 5.798),
        (6.0, 5.967),
        (9.0, 8.808),
        (12.0, 12.401),
        (18.0, 15.492),
        (24.0, 20.234),
        (27.0, 21.460),
    ],
)
def test_faster_modes_need_more_and_all_improve_with_the_signal(rate: float, half_db: float) -> None:
    """The ratios at which half of all frames of 300 bytes arrive, as the error model of ns-3 3.37 gives them."""
    snr = 10 ** (np.arange(-5, 35, 0.01) / 10)
    arrives = arrival_probability(snr, airtime_ns(300, rate), rate)
    assert np.all(np.diff(arrives) >= 0)
    assert arrives[0] == 0
    assert arrives[-1] == 1
    assert 10 * np.log10(snr[np.searchsorted(arrives, 0.5)]) == pytest.approx(half_db, abs=0.011)


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.integers(1, 1000), min_size=1, max_size=6), st.floats(0.1, 100), st.sampled_from([3.0, 6.0, 27.0])
)
def test_costs_add_up_however_time_is_cut(pieces: list[int], snr: float, rate: float) -> None:
    one = cost(np.array([snr]), rate)
    assert (one * np.array(pieces)[:, None]).sum() == (one * sum(pieces)).sum()


@pytest.mark.parametrize("rate", RATES_MBPS)
def test_even_the_longest_frame_without_any_signal_has_a_cost_that_can_be_told(rate: float) -> None:
    """Else it would come round and be less than nothing: a frame that is destroyed would arrive."""
    longest = max(bound.le for bound in Radio.model_fields["max_payload_bytes"].metadata if hasattr(bound, "le"))
    worst = int(cost(np.zeros(1), rate)[0])
    assert worst * airtime_ns(longest, rate) < 2**63
    assert worst * 1000 / COST_STEPS > -math.log(reception_draws(np.zeros(1, np.uint64))[0]), "a microsecond"


def test_the_longest_frames_destroy_each_other_between_hidden_terminals() -> None:
    radio: dict[str, Any] = {
        "path_loss": {"kind": "log_distance"},
        "mac": {},
        "bitrate_mbps": 3.0,
        "max_payload_bytes": 65_000,
    }
    subject = engine(line(0, 450, 900), **radio)
    subject.transmit(0, 0, [bytes(65_000)])
    subject.transmit(50_000, 2, [bytes(65_000)])
    subject.drain()
    outcomes = [row["outcome"] for row in subject.trace.to_table().to_pylist() if row["receiver"] == "v1"]
    assert outcomes == ["collided", "collided"]


class Counted:
    """How often mean powers have been worked out."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.times = 0
        dbm = MeanPower.dbm

        def counted(power: MeanPower, position_m: np.ndarray, distance_m: np.ndarray) -> np.ndarray:
            self.times += 1
            return dbm(power, position_m, distance_m)

        monkeypatch.setattr(MeanPower, "dbm", counted)


@pytest.mark.parametrize(
    "radio",
    [{"path_loss": {"kind": "log_distance"}, "shadowing": {}}, {"range_m": 900.0, "mac": {}}, {"range_m": 900.0}],
    ids=["path loss", "disc with a medium", "disc"],
)
def test_who_is_in_range_is_told_by_the_powers_where_there_are_any(
    radio: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    model = Radio.model_validate(radio)
    reach, nakagami = connectivity_of(model, 1, None), Nakagami(None) if model.is_physical else None
    counted = Counted(monkeypatch)
    first_m, then_m = np.random.default_rng(2).uniform(0, 4000, (2, 30, 2))
    then_m[7] = np.nan
    topology = Topology(first_m, reach, 1000, nakagami)
    topology.move(then_m)
    assert counted.times == (2 if "path_loss" in radio else 0), "once for each set of positions"
    in_range = reach.in_range(then_m, distances_m(then_m))
    assert np.array_equal(topology.now.in_range, in_range)
    assert in_range.any() and not in_range[7].any() and not in_range[:, 7].any()


def test_where_vehicles_drive_powers_are_worked_out_once_a_period(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_trips(tmp_path / "trips.csv", {f"c{n}": [(0.0, 3.0, along(60.0 * n, 20.0 * n))] for n in range(4)})
    scenario = scenario_of_trips(path, 2.0, radio={"path_loss": {"kind": "log_distance"}, "mac": {}})
    counted = Counted(monkeypatch)
    emulation = Emulation(scenario, build_world(scenario), RunFolder.create(tmp_path / "run", scenario))
    simulate(emulation)
    assert len(emulation.engine.trace) > 50
    assert counted.times == 2 * 5, "two seconds, five periods each"


# The chain without a medium.


def test_without_fading_the_threshold_is_a_circle() -> None:
    """20 dBm are -82 dBm after 509.3 m, and -94 dBm, the floor, after 2 028 m."""
    subject = engine(line(0, 509, 510, 2027, 2029), path_loss={"kind": "log_distance"})
    subject.transmit(0, 0, [bytes(300)])
    subject.drain()
    outcomes = [row["outcome"] for row in subject.trace.to_table().to_pylist()]
    assert outcomes == ["delivered", "faded", "faded"]
    assert subject.counts[Outcome.out_of_range] == 1


def test_the_noise_decides_where_it_is_loud() -> None:
    """With 20 dB more noise half of all frames arrive at -71.03 dBm: after 144 m, and at 27 Mbit/s after 24 m."""
    loud: dict[str, Any] = {"path_loss": {"kind": "log_distance"}, "receiver": {"noise_dbm": -84.0}}
    subject = engine(line(0, 120, 144, 170), **loud)
    fast = engine(line(0, 20, 40, 80), **loud, bitrate_mbps=27.0)
    for one in (subject, fast):
        one.transmit(0, 0, [bytes(300)] * 40)
        one.drain()
    rows = subject.trace.to_table().to_pylist()
    share = {
        node: np.mean([row["outcome"] == "delivered" for row in rows if row["receiver"] == node])
        for node in ("v1", "v2", "v3")
    }
    assert share["v1"] == 1
    assert 0.2 < share["v2"] < 0.8
    assert share["v3"] == 0
    arrived = {row["receiver"] for row in fast.trace.to_table().to_pylist() if row["outcome"] == "delivered"}
    assert arrived == {"v1"}


def test_delivery_against_distance_is_the_integral_over_the_fading() -> None:
    """Twenty receivers, two thousand frames, without a medium: Monte Carlo against quadrature."""
    east_m = np.linspace(30, 900, 20)
    subject = engine(
        np.vstack([[[0.0, 0.0]], line(*east_m)]), path_loss={"kind": "log_distance"}, fading={}, max_peers=100
    )
    for number in range(2000):
        subject.transmit(number * MS, 0, [bytes(300)])
    subject.drain()
    receiver = subject.trace.column("receiver")
    share = np.bincount(receiver, subject.trace.column("outcome") == Outcome.delivered, 21)[1:] / 2000
    for place, distance_m in enumerate(east_m):
        mean_db = 20 - 47.86 - 20 * math.log10(distance_m)
        gamma = stats.gamma(1.5, scale=1 / 1.5) if distance_m <= 80 else stats.gamma(0.75, scale=1 / 0.75)
        least = 10 ** ((-82 - mean_db) / 10)
        expected = quad(
            lambda factor, g=gamma, db=mean_db: (
                g.pdf(factor) * nist_qpsk_half(factor * 10 ** ((db + 97) / 10), 2448)
            ),
            least,
            np.inf,
            limit=200,
        )[0]
        assert share[place] == pytest.approx(expected, abs=4.5 * math.sqrt(0.25 / 2000))


def test_without_a_medium_nobody_is_in_anybodys_way() -> None:
    subject = engine(line(0, 50, 100), path_loss={"kind": "free_space"})
    for node in range(3):
        subject.transmit(0, node, [bytes(300)])
    subject.drain()
    rows = subject.trace.to_table().to_pylist()
    assert {row["outcome"] for row in rows} == {"delivered"}
    assert "on_air_ns" not in rows[0]
    assert all(448_000 + 2 * MS <= row["arrival_ns"] <= 448_000 + 3 * MS for row in rows)


def test_the_peer_cap_and_the_loss_act_on_what_the_radio_leaves() -> None:
    subject = engine(line(0, 50, 100, 150), path_loss={"kind": "free_space"}, max_peers=2, loss=0.5)
    for number in range(200):
        subject.transmit(number * PERIOD_NS, 0, [bytes(100)])
        subject.transmit(number * PERIOD_NS, 3, [bytes(100)])
    subject.drain()
    counts = subject.counts
    # Of three neighbours each hears the nearest two: v0 and v3 do not hear each other, and one of them at either
    # of the two in the middle is the third.
    assert counts[Outcome.peer_cap] == 800
    assert counts[Outcome.faded] == 0
    assert 150 < counts[Outcome.lost] < 250


# The busy ratio and congestion control.


def test_the_busy_ratio_is_the_airtime_of_all_that_are_sensed() -> None:
    """v0 sends 448 µs ten times in each window; v1 senses it, v2 at 800 m does not; senders sense themselves."""
    subject = engine(line(0, 300, 800), path_loss={"kind": "log_distance"}, mac={})
    for number in range(50):
        subject.transmit(number * 10 * MS, 0, [bytes(300)])
    subject.advance(500 * MS)
    ratios = np.array(subject.busy_ratios(500 * MS))
    assert ratios.shape == (5, 3)
    assert ratios[:, :2] == pytest.approx(np.full((5, 2), 0.0448))
    assert ratios[:, 2] == pytest.approx(0)


def test_what_lasts_over_the_edge_of_a_window_counts_in_both() -> None:
    subject = engine(line(0, 300), path_loss={"kind": "log_distance"}, mac={}, latency_ms=1)
    subject.transmit(99_800_000, 0, [bytes(300)])
    subject.drain()
    on_air_ns = subject.trace.to_table()["on_air_ns"][0].as_py()
    first, second = (ratio[1] for ratio in subject.busy_ratios(200 * MS))
    assert first == pytest.approx((100 * MS - on_air_ns) / WINDOW_NS)
    assert first + second == pytest.approx(0.00448)


def windows(before_horizon: ReactiveControl | LimericControl, *ratios: float, first: int = 0) -> None:
    """Let a gate hear windows that are all equally busy throughout."""
    for number, ratio in enumerate(np.repeat(ratios, 10), start=10 * first):
        before_horizon.observe(number, np.full(len(before_horizon._meter), int(ratio * SLICE_NS)))


def pause_ms(before_horizon: ReactiveControl | LimericControl) -> int:
    """For how long the first sender must pause, if the channel stays as it is."""
    before_horizon.record_transmission(0, 0, 448_000)
    return next(ms for ms in range(2000) if before_horizon.next_poll_ns(0, ms * MS) == ms * MS)


def test_the_reactive_states_are_reached_one_after_the_other() -> None:
    before_horizon = ReactiveControl(EtsiReactive(kind="etsi"), BusyRatioMeter(1, 1))
    assert before_horizon.next_poll_ns(0, 0) == 0, "the first frame may go"
    pauses_ms = [pause_ms(before_horizon)]
    for first, ratio in enumerate((0.7,) * 6 + (0.45,) * 4 + (0.1,) * 4):
        windows(before_horizon, ratio, first=first)
        pauses_ms.append(pause_ms(before_horizon))
    states = [(50, 100, 200, 250, 1000).index(pause) for pause in pauses_ms]
    assert set(np.abs(np.diff(states))) == {0, 1}
    assert (states[0], states[6], states[10], states[14]) == (0, 4, 2, 0)


def test_who_is_held_back_asks_again_after_its_next_window() -> None:
    before_horizon = ReactiveControl(EtsiReactive(kind="etsi", pause_ms=(1000,) * 5), BusyRatioMeter(1, 1))
    before_horizon.record_transmission(0, 0, 448_000)
    asks_ns = [0]
    while (next_ns := before_horizon.next_poll_ns(0, asks_ns[-1])) > asks_ns[-1]:
        asks_ns.append(next_ns)
    assert asks_ns[-1] == 1000 * MS
    assert set(np.diff(asks_ns[1:-1])) == {WINDOW_NS}


def test_senders_measure_each_on_its_own_clock() -> None:
    ear = BusyRatioMeter(50, 3)
    asks_ns = [ear.next_poll_ns(node, 10**10, 0) for node in range(50)]
    assert len(set(asks_ns)) == 50
    assert asks_ns[:20] == [BusyRatioMeter(20, 3).next_poll_ns(node, 10**10, 0) for node in range(20)], (
        "whoever else there is"
    )
    # Slices that are busy or not, in turns of ten: who measures half in either sees half.
    ratios = []
    for number in range(40):
        over = ear.observe(number, np.full(50, SLICE_NS if number // 10 % 2 else 0))
        ratios.append((number, over, ear.busy_ratio.copy()))
    seen = np.concatenate([ratio[over] for number, over, ratio in ratios if number >= 9])
    assert set(np.round(seen, 3)) == {round(part / 10, 3) for part in range(11)}


def test_limeric_settles_where_its_equation_does() -> None:
    """K senders of airtime a: share* = β (target - K share) / α, as the busy ratio is the sum of all shares."""
    before_horizon = LimericControl(Limeric(kind="limeric"), BusyRatioMeter(1, 1))
    for first in range(6000):
        windows(before_horizon, min(100 * float(before_horizon.share[0]), 1.0), first=first)
    expected = 0.0012 * 0.68 / (0.016 + 0.0012 * 100)
    assert before_horizon.share[0] == pytest.approx(expected, rel=1e-4)


def test_limerics_pause_is_the_airtime_over_the_share_within_bounds() -> None:
    before_horizon = LimericControl(Limeric(kind="limeric"), BusyRatioMeter(1, 1))
    for share, expected_ms in ((0.03, 25), (0.00448, 100), (0.0001, 1000)):
        before_horizon.share[0] = share
        assert pause_ms(before_horizon) == expected_ms


def test_a_congested_channel_thins_out_what_is_sent() -> None:
    """Sixty vehicles, a frame of 1 000 bytes every 50 ms each: two thirds more than there is room for."""
    position_m = np.random.default_rng(3).uniform(0, 200, (60, 2))
    physical: dict[str, Any] = {
        "path_loss": {"kind": "log_distance"},
        "mac": {},
        "max_peers": 100,
        "queue_frames": 8,
    }

    def run(**congestion: Any) -> tuple[float, float, Engine]:
        subject = engine(position_m, **physical, **congestion)
        draws = np.random.default_rng(4)
        sends = sorted((int(t), n) for n in range(60) for t in draws.uniform(0, 3e9, 60))
        for time_ns, node in sends:
            subject.transmit(time_ns, node, [bytes(1000)])
        subject.drain()
        counts = subject.counts
        on_air = counts[Outcome.delivered] + counts[Outcome.collided]
        return counts[Outcome.delivered] / on_air, float(np.mean(subject.busy_ratios(3_000 * MS)[5:])), subject

    free, full, crowded = run()
    assert crowded.counts[Outcome.held_back] == 0
    assert full > 0.9
    for kind in ("etsi", "limeric"):
        share, load, subject = run(congestion={"kind": kind})
        assert share > free + 0.1
        assert load < full - 0.15
        assert subject.counts[Outcome.held_back] > 1000


def test_of_what_waits_the_newest_goes() -> None:
    subject = engine(
        line(0, 50),
        path_loss={"kind": "free_space"},
        mac={},
        congestion={"kind": "etsi", "pause_ms": [50, 50, 50, 50, 50], "waiting": 1},
    )
    for number in range(10):
        subject.transmit(number * 10 * MS, 0, [bytes(100)])
    subject.drain()
    rows = subject.trace.to_table().to_pylist()
    assert [row["seq"] for row in rows if row["outcome"] == "delivered"] == [0, 5, 9]
    assert {row["outcome"] for row in rows} == {"delivered", "held_back"}
    on_air_ms = [round(row["on_air_ns"] / MS) for row in rows if row["on_air_ns"] is not None]
    assert on_air_ms == [0, 50, 100]


# The scenario.


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("[radio.fading]", ["radio", "fading needs path_loss"]),
        ("[radio.shadowing]", ["radio", "shadowing needs path_loss"]),
        ("[radio.receiver]", ["radio", "receiver needs path_loss or mac"]),
        ("[radio.congestion]\nkind = 'etsi'", ["radio", "congestion needs mac"]),
        ("[radio.path_loss]", ["radio.path_loss: a kind is needed"]),
        ("[radio.path_loss]\nkind = 'cost231'", ["'cost231'", "dual_slope, free_space, log_distance, two_ray"]),
        ("[radio.path_loss]\nkind = 'free_space'\nexponent = 3", ["exponent: unknown key", "frequency_ghz"]),
        ("[radio.path_loss]\nkind = 'log_distance'\nexponent = 0", ["exponent = 0", "greater than 0"]),
        (
            "[radio]\nbitrate_mbps = 5.5\n[radio.mac]",
            ["radio", "bitrate_mbps = 5.5", "3, 4.5, 6, 9, 12, 18, 24, 27"],
        ),
        ("[radio]\nlinks = [[0]]\n[radio.path_loss]\nkind = 'free_space'", ["path_loss and links", "leave one"]),
        ("[radio.mac]\naccess_category = 'AC'", ["radio.mac.access_category = 'AC'", "'VO', 'VI', 'BE' or 'BK'"]),
        (
            "[radio.path_loss]\nkind = 'free_space'\n[radio.fading]\nm = [1.0]",
            ["radio.fading", "1 shapes m need 0 distances"],
        ),
        (
            "[radio.path_loss]\nkind = 'free_space'\n[radio.fading]\nm = [1, 2, 3]\nuntil_m = [9, 8]",
            ["radio.fading", "must grow"],
        ),
        ("[radio.mac]\n[radio.congestion]\nkind = 'etsi'\nbusy = [0.5]", ["5 pauses need 4 busy ratios"]),
    ],
)
def test_what_does_not_fit_together_is_one_line(tmp_path: Any, text: str, parts: list[str]) -> None:
    path = tmp_path / "s.toml"
    path.write_text(text)
    with pytest.raises(ScenarioError) as caught:
        load_scenario(path)
    message = str(caught.value)
    assert "\n" not in message
    assert all(part in message for part in parts), message


def test_a_physical_radio_survives_its_dump(tmp_path: Any) -> None:
    radio = {
        "path_loss": {"kind": "two_ray"},
        "shadowing": {"sigma_db": 2.5},
        "fading": {"m": [3, 2, 1], "until_m": [50, 150]},
        "receiver": {"min_rssi_dbm": -85},
        "mac": {"access_category": "VI"},
        "congestion": {"kind": "limeric", "target": 0.6},
    }
    scenario = Scenario.model_validate({"radio": radio})
    path = tmp_path / "s.toml"
    path.write_text(dump_scenario(scenario))
    assert load_scenario(path) == scenario
    assert "antenna_m = 1.5" in path.read_text(), "every default is spelled out"
    assert "path_loss" not in dump_scenario(Scenario()), "and what is left out stays so"
