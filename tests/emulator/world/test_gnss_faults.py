"""Effects of faults on fixes, as functions of the plan and the time."""

from typing import Any

import numpy as np
import pytest

from emulator.fault_plan import FaultPlan, Nodes
from emulator.scenario.scenario import Scenario
from emulator.world.truth import FaultyGnss
from emulator.world.world import World, build_world

VEHICLES = 4
RATE_HZ = 10


def receivers(*faults: dict[str, Any], seed: int = 1) -> tuple[FaultyGnss, World, FaultPlan]:
    """The receivers of four vehicles under faults, and what they would be without."""
    run = {"duration_s": 20.0, "seed": seed}
    scenario = Scenario.model_validate({"run": run, "network": {"vehicles": VEHICLES}, "fault": list(faults)})
    world = build_world(scenario)
    start_m = world.at(0).position_m
    plan = FaultPlan(scenario, Nodes(world.node_ids, start_m, np.zeros(VEHICLES, int)))
    return FaultyGnss(world, plan.faults, seed), world, plan


def fault(kind: str, at_s: float = 2.0, duration_s: float = 3.0, **more: Any) -> dict[str, Any]:
    return {"kind": kind, "at_s": at_s, "duration_s": duration_s, "nodes": {"ids": ["v01"]}, **more}


def strayed(gnss: FaultyGnss, world: World, number: int = 0, periods: int = 100) -> np.ndarray:
    """(periods, 2): how far the fixes are from those of a sound receiver; NaN where there is none."""
    found = [gnss.fix(period, number) for period in range(periods)]
    nothing = np.full(2, np.nan)
    sound = [world.fix(period, number) for period in range(periods)]
    for one, other in zip(found, sound, strict=True):
        if one is not None:
            assert one.time_ns == other.time_ns, "times go on"
            assert np.array_equal(one.covariance_m2, other.covariance_m2)
            assert one.heading_rad == other.heading_rad
    return np.array(
        [nothing if f is None else f.position_m - s.position_m for f, s in zip(found, sound, strict=True)]
    )


def steps(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split values into those during the fault, from 2 to 5 s, and the others."""
    return values[20:50], np.concatenate([values[:20], values[50:]])


@pytest.mark.parametrize("kind", ["gnss_jump", "ConstPosOffset"])
def test_a_jump_is_constant_while_it_lasts_and_for_its_vehicle_only(kind: str) -> None:
    gnss, world, _ = receivers(fault(kind, offset_m=(3.0, -4.0)))
    inside, outside = steps(strayed(gnss, world))
    assert np.allclose(inside, (3.0, -4.0))
    assert np.array_equal(outside, np.zeros_like(outside))
    assert not strayed(gnss, world, number=1).any()


def test_a_ramp_starts_at_nothing_and_goes_back_to_nothing() -> None:
    gnss, world, _ = receivers(fault("gnss_ramp", rate_m_s=(0.5, -1.0)))
    inside, outside = steps(strayed(gnss, world))
    assert np.allclose(inside, np.outer(np.arange(30) / RATE_HZ, (0.5, -1.0)))
    assert not outside.any()


def test_an_outage_gives_no_fix_and_observers_see_none() -> None:
    gnss, world, _ = receivers(fault("gnss_outage"))
    inside, outside = steps(strayed(gnss, world))
    assert np.isnan(inside).all()
    assert not outside.any()
    seen = np.array([gnss.at(period).fix_m for period in range(100)])
    assert np.isnan(seen[20:50, 0]).all()
    assert not np.isnan(np.delete(seen, 0, axis=1)).any()
    assert not np.isnan(np.delete(seen, slice(20, 50), axis=0)).any()


def test_a_frozen_receiver_repeats_the_last_position_before_with_new_times() -> None:
    gnss, world, _ = receivers(fault("gnss_freeze", at_s=2.05))
    for period in range(21, 51):
        fix = gnss.fix(period, 0)
        assert fix is not None
        assert np.array_equal(fix.position_m, world.fix(20, 0).position_m)
        assert fix.time_ns == period * world.period_ns
    inside, outside = np.arange(21, 51), strayed(gnss, world)
    assert not np.delete(outside, inside, axis=0).any()


def test_a_freeze_at_the_instant_of_a_fix_repeats_the_one_before_and_at_the_start_the_first() -> None:
    for at_s, last in ((2.0, 19), (0.0, 0)):
        gnss, world, _ = receivers(fault("gnss_freeze", at_s=at_s))
        fix = gnss.fix(round(at_s * RATE_HZ) + 5, 0)
        assert fix is not None
        assert np.array_equal(fix.position_m, world.fix(last, 0).position_m)


@pytest.mark.slow
def test_random_positions_are_new_each_time_within_their_radius_and_fill_the_disc() -> None:
    gnss, world, _ = receivers(fault("RandomPos", at_s=0.0, duration_s=14.9, radius_m=50.0, nodes={}))
    away = np.concatenate([strayed(gnss, world, number, 149) for number in range(VEHICLES)])
    distance = np.hypot(*away.T)
    assert distance.max() <= 50
    assert len(np.unique(away, axis=0)) == len(away)
    assert abs(np.mean(distance <= 25) - 0.25) < 0.08, "uniform over the area"
    assert np.all(np.abs(away.mean(axis=0)) < 6)
    again, _, _ = receivers(fault("RandomPos", at_s=0.0, duration_s=14.9, radius_m=50.0, nodes={}))
    assert np.array_equal(away, np.concatenate([strayed(again, world, n, 149) for n in range(VEHICLES)]))


def test_faults_of_a_receiver_add_up_and_an_outage_beats_them_all() -> None:
    gnss, world, _ = receivers(
        fault("gnss_jump", at_s=1.0, duration_s=6.0, offset_m=(1.0, 0.0)),
        fault("gnss_freeze", at_s=2.0, duration_s=3.0),
        fault("gnss_ramp", at_s=3.0, duration_s=1.0, rate_m_s=(0.0, 2.0)),
        fault("gnss_jump", at_s=3.0, duration_s=3.0, offset_m=(10.0, 0.0)),
        fault("gnss_outage", at_s=4.5, duration_s=0.2),
    )

    def position(period: int) -> Any:
        fix = gnss.fix(period, 0)
        return None if fix is None else fix.position_m

    frozen = world.fix(19, 0).position_m
    assert np.allclose(position(15), world.fix(15, 0).position_m + np.array([1, 0]))
    assert np.allclose(position(25), frozen + np.array([1, 0])), "frozen, and off"
    assert np.allclose(position(35), frozen + np.array([11, 1.0]))
    assert np.allclose(position(44), frozen + np.array([11, 0]))
    assert position(45) is position(46) is None
    assert np.allclose(position(47), frozen + np.array([11, 0]))
    assert np.allclose(position(55), world.fix(55, 0).position_m + np.array([11, 0]))
    assert np.allclose(position(65), world.fix(65, 0).position_m + np.array([1, 0]))
    assert np.allclose(position(75), world.fix(75, 0).position_m)


def test_a_healed_receiver_is_right_from_then_on_and_the_past_stays() -> None:
    gnss, world, plan = receivers(fault("gnss_jump", offset_m=(1.0, 0.0)))
    for _ in range(2):
        plan.heal("gnss_jump-0", 3_050_000_000)
        offset = strayed(gnss, world)[:, 0]
        assert np.allclose(offset, [1.0 if 20 <= period <= 30 else 0.0 for period in range(100)])


def test_the_truth_and_the_instant_that_observers_see_agree_with_the_fixes() -> None:
    gnss, world, _ = receivers(fault("gnss_jump", offset_m=(3, 4)), fault("gnss_freeze", nodes={"ids": ["v02"]}))
    for period in (10, 30):
        seen, truth = gnss.at(period), world.at(period)
        assert np.array_equal(seen.position_m, truth.position_m)
        for number in range(VEHICLES):
            fix = gnss.fix(period, number)
            assert fix is not None
            assert np.array_equal(seen.fix_m[number], fix.position_m)
