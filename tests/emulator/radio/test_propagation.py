"""Path loss, shadowing and fading, against formulas of the literature."""

import math
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter

from emulator.radio.propagation import QUANTILES, MeanPower, Nakagami, ShadowField, loss_db
from emulator.radio.topology import distances_m
from emulator.scenario.program import RoadsideUnit
from emulator.scenario.radio import DualSlope, Fading, FreeSpace, LogDistance, PathLoss, Shadowing, TwoRay
from tests.support.radio import line

LIGHT_M_S = 299_792_458.0


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


@pytest.mark.slow
def test_shadowing_has_its_deviation(field: ShadowField) -> None:
    from scipy import stats  # slow to import

    position_m = np.random.default_rng(1).uniform(0, 20_000, (500, 2))
    loss = field.between(position_m, distances_m(position_m))[np.triu_indices(500, 1)]
    assert loss.mean() == pytest.approx(0, abs=0.1)
    assert loss.std() == pytest.approx(4.0, rel=0.03)
    assert abs(stats.kurtosis(loss)) < 0.2


@pytest.mark.slow
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


def test_shadowing_is_the_same_both_ways_and_independent_of_other_vehicles(field: ShadowField) -> None:
    position_m = np.random.default_rng(2).uniform(0, 2000, (40, 2))
    loss = field.between(position_m, distances_m(position_m))
    assert np.array_equal(loss, loss.T)
    some = position_m[[3, 30, 17]]
    assert field.between(some, distances_m(some)) == pytest.approx(loss[np.ix_([3, 30, 17], [3, 30, 17])])
    again = ShadowField(Shadowing(sigma_db=4.0), seed=7).between(some, distances_m(some))
    assert np.array_equal(again, field.between(some, distances_m(some)))
    assert not np.allclose(again, ShadowField(Shadowing(sigma_db=4.0), seed=8).between(some, distances_m(some)))


@pytest.mark.parametrize("distance_m", [0.1, 12.0])
def test_shadowing_of_neighbours_is_no_stronger_than_of_others(distance_m: float) -> None:
    """Both directions are the same wave if both ends are at one position, and nearly so close to each other."""
    ends, shadowing = line(0, distance_m), Shadowing(sigma_db=3.0, decorrelation_m=25.0)
    drawn = [ShadowField(shadowing, seed).between(ends, distances_m(ends))[0, 1] for seed in range(600)]
    assert np.std(drawn) == pytest.approx(3.0, rel=0.05)


# Fading.


@pytest.mark.slow
@pytest.mark.parametrize("m", [0.5, 0.75, 1.0, 1.5, 10.0])
def test_factors_are_gamma_distributed_with_mean_one(m: float) -> None:
    from scipy import stats  # slow to import

    nakagami = Nakagami(Fading(m=(m, 1.0), until_m=(1e6,)))
    shape = nakagami.shape(np.full(QUANTILES, 10.0))
    factors = nakagami.factor(shape, np.arange(QUANTILES))
    assert factors.mean() == pytest.approx(1, abs=1e-4)
    assert stats.kstest(factors, stats.gamma(m, scale=1 / m).cdf).statistic < 1e-4


@pytest.mark.slow
def test_each_stretch_has_its_shape() -> None:
    from scipy import stats  # slow to import

    nakagami = Nakagami(Fading(m=(1.5, 0.75), until_m=(80.0,)))
    middle = np.full(3, QUANTILES // 2)
    near, edge, far = nakagami.factor(nakagami.shape(np.array([5.0, 80.0, 80.1])), middle)
    assert near == edge == pytest.approx(stats.gamma(1.5, scale=1 / 1.5).ppf(0.5), rel=1e-4)
    assert far == pytest.approx(stats.gamma(0.75, scale=1 / 0.75).ppf(0.5), rel=1e-4)


POSITION_M = np.array([[0.0, 0.0], [80.0, 60.0], [-300.0, 0.0]])
MODELS = [
    {"kind": "free_space"},
    {"kind": "log_distance", "exponent": 2.7},
    {"kind": "dual_slope", "break_m": 50.0},
    {"kind": "two_ray"},
    {"kind": "winner_b1"},
]


def path_loss(section: dict[str, Any]) -> Any:
    return TypeAdapter(PathLoss).validate_python(section)


def powers_dbm(model: Any, *units: RoadsideUnit) -> Any:
    return MeanPower(model, None, 1, units).dbm(POSITION_M, distances_m(POSITION_M))


def unit(**keys: Any) -> RoadsideUnit:
    return RoadsideUnit(position_m=(0.0, 0.0), id="unit", **keys)


@pytest.mark.parametrize("section", MODELS)
def test_a_unit_as_high_and_strong_as_a_vehicle_is_one(section: dict[str, Any]) -> None:
    model = path_loss(section)
    assert np.array_equal(powers_dbm(model), powers_dbm(model, unit(height_m=1.5)))


@pytest.mark.parametrize("section", MODELS[:3])
def test_height_counts_by_the_slant_distance_and_power_where_it_is_sent(section: dict[str, Any]) -> None:
    model = path_loss(section)
    plain, power = powers_dbm(model), powers_dbm(model, unit(height_m=41.5, tx_power_dbm=33.0))
    assert np.array_equal(power[:2, :2], plain[:2, :2])
    slant_m = math.hypot(300.0, 40.0)
    received = 20.0 - loss_db(model, np.array([slant_m]))[0]
    assert power[0, 2] == pytest.approx(received, abs=1e-6)
    assert power[2, 0] == pytest.approx(received + 13.0, abs=1e-6)
    assert power[2, 2] == 33.0


def test_above_a_vehicle_a_mast_of_winner_b1_is_as_far_as_it_is_high() -> None:
    model = path_loss({"kind": "winner_b1"})
    above = loss_db(model, np.array([0.0, 30.0]), (np.array(1.5), np.array(41.5)))
    assert above == pytest.approx(loss_db(model, np.array([40.0, 50.0])))


def test_two_rays_meet_from_both_heights() -> None:
    """Far away the loss goes to 40 log10 d - 20 log10 (h h'): twice the height of one end, 6 dB."""
    model, far_m = path_loss({"kind": "two_ray", "permittivity": 1000.0}), np.array([30_000.0])
    low, high = (loss_db(model, far_m, (np.array(1.5), np.array(height))) for height in (3.0, 6.0))
    assert low[0] - high[0] == pytest.approx(20 * math.log10(2), abs=0.05)
    assert low[0] == pytest.approx(40 * math.log10(30_000.0) - 20 * math.log10(1.5 * 3.0), abs=0.1)
