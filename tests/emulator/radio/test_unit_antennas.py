"""Antennas of roadside units: heights and powers in the mean received power."""

import math
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter

from emulator.radio.propagation import MeanPower, loss_db
from emulator.radio.topology import distances_m
from emulator.scenario.program import RoadsideUnit
from emulator.scenario.radio import PathLoss

POSITION_M = np.array([[0.0, 0.0], [80.0, 60.0], [-300.0, 0.0]])
MODELS = [
    {"kind": "free_space"},
    {"kind": "log_distance", "exponent": 2.7},
    {"kind": "dual_slope", "break_m": 50.0},
    {"kind": "two_ray"},
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


def test_two_rays_meet_from_both_heights() -> None:
    """Far away the loss goes to 40 log10 d - 20 log10 (h h'): twice the height of one end, 6 dB."""
    model, far_m = path_loss({"kind": "two_ray", "permittivity": 1000.0}), np.array([30_000.0])
    low, high = (loss_db(model, far_m, (np.array(1.5), np.array(height))) for height in (3.0, 6.0))
    assert low[0] - high[0] == pytest.approx(20 * math.log10(2), abs=0.05)
    assert low[0] == pytest.approx(40 * math.log10(30_000.0) - 20 * math.log10(1.5 * 3.0), abs=0.1)
