"""The exchange of Gaussian filters as arrays: what it equals, and what its oracles give back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from agents.cooperative.cmm.kalman_bound import KalmanBound, LaneModel
from studies import decomposition
from studies.decomposition import FLOODED, Exchange, Rules, Worlds
from studies.reports import mean_and_error
from vnet.types import Mask

PERIODS, SEEDS = 30, 2


def world(hears: Mask) -> Worlds:
    """Return vehicles that stand at the origin, on lanes in all directions."""
    rng, count = np.random.default_rng(1), len(hears)
    return Worlds(
        model=LaneModel(),
        dt_s=0.1,
        noise_m2=1.0,
        fix_m=rng.normal(0, 1, (PERIODS, SEEDS, count, 2)),
        common_m=np.zeros((PERIODS, SEEDS, 2)),
        point_m=np.zeros((count, 2)),
        heading_rad=np.arange(count) * np.pi / count,
        hears=hears & ~np.eye(count, dtype=bool),
        alike=np.ones((count, count), dtype=bool),
    )


def line(count: int) -> Mask:
    """Return who hears whom if each hears the next and the one before."""
    return np.abs(np.subtract.outer(np.arange(count), np.arange(count))) <= 1


def run(found: Worlds, rules: Rules) -> Exchange:
    exchange = Exchange(found, rules)
    for fix_m in found.fix_m:
        exchange.step(fix_m)
    return exchange


def test_alone_a_vehicle_is_the_bound() -> None:
    found = world(np.ones((1, 1), dtype=bool))
    exchange, bound = run(found, Rules(increment_share=1.0)), KalmanBound(np.zeros((1, 2)), np.zeros(1))
    for period, fix_m in enumerate(found.fix_m[:, 1]):
        bound.step(0.1 if period else 0.0, fix_m, np.eye(2))
    np.testing.assert_allclose(exchange.filters.mean[1, 0, :2], bound.common_m, atol=0.05)
    np.testing.assert_allclose(exchange.filters.covariance[1, 0, :2, :2], bound.common_covariance_m2, rtol=0.02)


def test_where_all_hear_all_nothing_is_counted_twice_and_nothing_is_missing() -> None:
    found = world(np.ones((4, 4), dtype=bool))
    pooled, flooded = (
        run(found, Rules(loss=0.0, learned_s=0.0, hops=hops, is_cut=False)).filters for hops in (2, FLOODED)
    )
    np.testing.assert_allclose(pooled.mean, flooded.mean, atol=1e-6)
    np.testing.assert_allclose(pooled.covariance, flooded.covariance, rtol=1e-6, atol=1e-9)


@pytest.mark.slow
def test_each_hop_tells_more() -> None:
    found = world(line(6))
    claimed = [
        float(np.trace(run(found, Rules(loss=0.0, hops=hops)).filters.covariance[0, 0, :2, :2]))
        for hops in (1, 2, 3, FLOODED)
    ]
    assert claimed == sorted(claimed, reverse=True)
    lossy = run(found, Rules(hops=FLOODED, loss=0.3)).filters.covariance[0, 0, :2, :2]
    assert claimed[-1] <= float(np.trace(lossy)) < 2 * claimed[-1], "flooded increments are late, not lost"


def test_a_seed_has_the_same_figures_beside_others() -> None:
    found = world(line(4))
    alone = replace(found, fix_m=found.fix_m[:, :1], common_m=found.common_m[:, :1])
    both, one = (run(each, Rules(loss=0.0)).filters.mean[0] for each in (found, alone))
    np.testing.assert_allclose(both, one)


@pytest.mark.slow
def test_a_network_is_decomposed_and_shown() -> None:
    network = {"kind": "generated", "vehicles": 6}
    rows = [{"network": "n3", **row} for row in decomposition.decompose(network, [1, 2], 4.0)]
    assert {row["rules"] for row in rows} == set(decomposition.ORACLES)
    text = decomposition.report(rows, 4.0)
    assert all(name in text for name in (*decomposition.ORACLES, "the bound", "2 seeds"))
    anees = [row["bound_anees"] for row in rows if row["rules"] == "no frame lost"]
    assert f"| {mean_and_error(anees, 2)} |" in text, "the bound of a seed counts once, not for each of the rules"
    assert "nan" not in decomposition.report([row for row in rows if row["seed"] == 1], 4.0)
