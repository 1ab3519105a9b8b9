"""Decomposition of the error of c above its bound: oracles give back, one at a time, what the exchange loses.

The vehicles of a network are Gaussian filters with the rules of `information_estimator`, without defence and
particles, all seeds at once as arrays. The fixes are those of the emulator's world. An oracle changes one rule:
no frame is lost, increments are passed on further, none is cut, and so on. Frames may then have any size.

Arrays have axes (S seeds, N vehicles, …). Information about c is (…, 5): the matrix (xx, xy, yy) and the vector.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from agents.cooperative.cmm.kalman_bound import KalmanBound, LaneModel, lane_axes
from agents.cooperative.cmm.own_vehicle import INCREMENT_SHARE
from agents.cooperative.cmm.plausibility import INCREMENT_FACTOR, PRIOR_FACTOR, SELF_SHARE
from agents.cooperative.hears_all import lane_model
from agents.cooperative.information_estimator import LEARNED_S
from emulator.scenario.scenario import Scenario
from emulator.world.world import build_world
from studies.paper import PAPER_RANGE_M, counted_from
from studies.reports import (
    Result,
    in_seeds,
    markdown_table,
    mean_and_error,
    paired_ratio,
    select,
    unique,
    with_error,
)
from vnet.types import Array, Mask

LOSS = 0.1
FLOODED = 99
"""Number of hops that no network has."""


@dataclass(frozen=True)
class Rules:
    """Rules of an exchange; the defaults are those of the cooperative program.

    loss: share of the frames that is lost. hops: hops that an increment goes, each takes a period; `FLOODED` for
    all, and then no priors are pooled: each increment counts once, wherever it is heard. hears_all: a vehicle hears
    all others of its component. increment_share: share of what a fix says that is told. learned_s: time in which c
    moves by the error that increments have in common. self_share: weight that a vehicle keeps for its own prior.
    is_cut: increments and priors are cut at some times the own.
    """

    loss: float = LOSS
    hops: int = 2
    hears_all: bool = False
    increment_share: float = INCREMENT_SHARE
    learned_s: float = LEARNED_S
    self_share: float = SELF_SHARE
    is_cut: bool = True


ORACLES: Mapping[str, Rules] = {
    "the program's rules": Rules(),
    "no frame lost": Rules(loss=0.0),
    "no share, no cut": Rules(increment_share=1.0, learned_s=0.0, self_share=0.0, is_cut=False),
    "a third hop": Rules(hops=3),
    "all hops, each increment once": Rules(hops=FLOODED),
    "all hops, once, no frame lost": Rules(hops=FLOODED, loss=0.0),
    "all hear all": Rules(hears_all=True),
    "all hear all, no frame lost": Rules(hears_all=True, loss=0.0),
    "nothing passed on": Rules(hops=1),
}
"""The rules of the program, and each oracle; the last takes something away."""


@dataclass(frozen=True)
class Worlds:
    """The same network with several seeds.

    fix_m: (K, S, N, 2). common_m: (K, S, 2). point_m: (N, 2) and heading_rad: (N,) of the lanes. hears: (N, N), who
    is in range of whom, and alike: (N, N), who is in one component.
    """

    model: LaneModel
    dt_s: float
    noise_m2: float
    fix_m: Array
    common_m: Array
    point_m: Array
    heading_rad: Array
    hears: Mask
    alike: Mask


def worlds(network: Mapping[str, Any], seeds: Sequence[int], duration_s: float) -> Worlds:
    """Return the worlds of a network; `network` is the section of a scenario."""
    found = [build_world(_scenario(network, seed, duration_s)) for seed in seeds]
    first, scenario = found[0], _scenario(network, seeds[0], duration_s)
    instants = [[world.at(period) for world in found] for period in range(first.periods - 1)]
    lane = first.lane_of
    apart_m = first.at(0).position_m[:, None] - first.at(0).position_m
    hears = np.hypot(apart_m[..., 0], apart_m[..., 1]) <= PAPER_RANGE_M
    alike = hears
    while not np.array_equal(alike, further := alike @ alike):
        alike = further
    return Worlds(
        model=lane_model(scenario),
        dt_s=first.period_ns / 1e9,
        noise_m2=scenario.world.gnss.sigma_m**2,
        fix_m=np.array([[each.fix_m for each in row] for row in instants]),
        common_m=np.array([[each.common_error_m for each in row] for row in instants]),
        point_m=first.lane_map.point_m[lane],
        heading_rad=first.lane_map.heading_rad[lane],
        hears=hears & ~np.eye(len(hears), dtype=bool),
        alike=alike,
    )


def _scenario(network: Mapping[str, Any], seed: int, duration_s: float) -> Scenario:
    return Scenario.model_validate(
        {"run": {"name": "cell", "seed": seed, "duration_s": duration_s}, "network": dict(network)}
    )


class Filters:
    """The Kalman filters of all vehicles: moments (S, N, 5) and (S, N, 5, 5) of c, offset, place and speed."""

    def __init__(self, world: Worlds) -> None:
        self._world = world
        seeds, count = world.fix_m.shape[1:3]
        axes, model = lane_axes(world.heading_rad), world.model
        self._measured = np.concatenate([axes, np.tile(np.eye(2, 3), (count, 1, 1))], axis=2)
        self._axes = axes
        covariance = np.zeros((5, 5))
        covariance[:2, :2] = model.common_sigma_m**2 * np.eye(2)
        covariance[2:, 2:] = model.own_covariance()
        self.mean, self.covariance = np.zeros((seeds, count, 5)), np.tile(covariance, (seeds, count, 1, 1))
        keep, variance_m2 = model.common_step(world.dt_s)
        self._moves, self._noise = np.zeros((5, 5)), np.zeros((5, 5))
        self._moves[:2, :2], self._moves[2:, 2:] = keep * np.eye(2), model.transition(world.dt_s)
        self._noise[:2, :2], self._noise[2:, 2:] = variance_m2 * np.eye(2), model.process_noise(world.dt_s)

    @property
    def belief(self) -> Array:
        """The belief about c (S, N, 5)."""
        return _information(self.mean[..., :2], self.covariance[..., :2, :2])

    def predict(self) -> None:
        """Advance by a period."""
        self.mean = self.mean @ self._moves.T
        self.covariance = self._moves @ self.covariance @ self._moves.T + self._noise

    def take(self, fix_m: Array) -> Array:
        """Take the fixes (S, N, 2); return the increments (S, N, 5)."""
        before = self.belief
        seen = np.einsum("nij,snj->sni", self._axes, fix_m - self._world.point_m)
        cross = self.covariance @ self._measured.transpose(0, 2, 1)
        total = self._measured @ cross + self._world.noise_m2 * np.eye(2)
        gain = cross @ np.linalg.inv(total)
        off = seen[..., None] - self._measured @ self.mean[..., None]
        self.mean = self.mean + (gain @ off)[..., 0]
        self.covariance = self.covariance - gain @ cross.swapaxes(-1, -2)
        return self.belief - before

    def absorb(self, pooled: Array) -> None:
        """Replace what is known of c by `pooled` (S, N, 5)."""
        mean, covariance = _moments(pooled)
        here = self.covariance[..., :2, :2]
        slope = self.covariance[..., :2] @ np.linalg.inv(here)
        self.mean = self.mean + (slope @ (mean - self.mean[..., :2])[..., None])[..., 0]
        self.covariance = self.covariance + slope @ (covariance - here) @ slope.swapaxes(-1, -2)


def _information(mean: Array, covariance: Array) -> Array:
    matrix = np.linalg.inv(covariance)
    vector = (matrix @ mean[..., None])[..., 0]
    return np.stack(
        [matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 1], vector[..., 0], vector[..., 1]], axis=-1
    )


def _moments(information: Array) -> tuple[Array, Array]:
    a, b, d = information[..., 0], information[..., 1], information[..., 2]
    matrix = np.stack([np.stack([a, b], axis=-1), np.stack([b, d], axis=-1)], axis=-2)
    covariance = np.asarray(np.linalg.inv(matrix), dtype=np.float64)
    return (covariance @ information[..., 3:, None])[..., 0], covariance


def _trace(information: Array) -> Array:
    return np.asarray(information[..., 0] + information[..., 2])


class Exchange:
    """The exchange of all vehicles by some rules: what is known of c after each period."""

    def __init__(self, world: Worlds, rules: Rules, seed: int = 1) -> None:
        self.filters = Filters(world)
        self._world, self._rules = world, rules
        self._hears = world.alike & ~np.eye(len(world.alike), dtype=bool) if rules.hears_all else world.hears
        self._rng = np.random.default_rng(seed)
        shape = (world.fix_m.shape[1], *self._hears.shape)
        self._own = np.eye(len(self._hears))
        # Increments of the periods before, the latest first, and which of them each vehicle's belief holds.
        self._increments: list[Array] = []
        self._used: list[Array] = []
        # Flooded: sums of all increments by period, and the number of an origin's that each vehicle has.
        self._sums: list[Array] = [np.zeros((*shape[:2], 5))]
        self._known, self._period = np.zeros(shape, dtype=int), 0

    def step(self, fix_m: Array) -> None:
        """Take the fixes (S, N, 2) of a period, and exchange what they say."""
        self.filters.predict()
        priors = self.filters.belief
        increments = self._rules.increment_share * self.filters.take(fix_m)
        heard = self._hears & (self._rng.random(self._known.shape) >= self._rules.loss)
        if self._rules.hops == FLOODED:
            self.filters.absorb(priors + self._flooded(increments, heard))
        else:
            self.filters.absorb(self._pooled(priors, increments, heard.astype(float)))

    def _flooded(self, increments: Array, heard: Mask) -> Array:
        """Return the sum (S, N, 5) of all increments that are new to each vehicle."""
        self._period += 1
        self._sums.append(self._sums[-1] + increments)
        period, vehicles, before = self._period, np.arange(heard.shape[1]), self._known
        told = before.copy()
        told[:, vehicles, vehicles] = period
        now = told.copy()
        for other in vehicles:
            np.maximum(now, np.where(heard[:, :, other, None], told[:, other, None, :], 0), out=now)
        self._sums = self._sums[-FLOODED:]  # nobody is heard of later than that
        sums, base = np.array(self._sums), period + 1 - len(self._sums)
        rows = np.arange(len(heard))[:, None, None]
        now_row, before_row = np.maximum(now - base, 0), np.maximum(before - base, 0)
        added = sums[now_row, rows, vehicles] - sums[before_row, rows, vehicles]
        self._known = now
        return np.asarray(added.sum(axis=2))

    def _pooled(self, priors: Array, increments: Array, heard: Array) -> Array:
        rules = self._rules
        weights = (1 - rules.self_share) * heard / (1 + heard.sum(axis=2, keepdims=True))
        own_weight = 1 - weights.sum(axis=2, keepdims=True)
        shares = heard
        limit = np.full(heard.shape[:2], np.inf)
        if rules.is_cut:
            traces = _trace(increments)
            present = np.where((heard + self._own) > 0, traces[:, None], np.nan)
            limit = INCREMENT_FACTOR * np.maximum(traces, np.nanmedian(present, axis=2))
            shares = heard * np.minimum(1.0, limit[:, :, None] / traces[:, None])
            of_priors = _trace(priors)
            weights = weights * np.minimum(1.0, PRIOR_FACTOR * of_priors[:, :, None] / of_priors[:, None])
        added = increments + shares @ increments + self._passed_on(heard, weights, limit)
        left = 1 / (1 + self._world.model.common_step(rules.learned_s)[1] * _trace(added) / 2)
        pooled = own_weight * priors + weights @ priors + left[..., None] * added
        self._used.insert(0, np.maximum(heard, self._own))
        self._increments.insert(0, increments)
        del self._used[rules.hops :], self._increments[rules.hops :]
        return np.asarray(pooled)

    def _passed_on(self, heard: Array, weights: Array, limit: Array) -> Array:
        """Return the sum (S, N, 5) of what is added of earlier increments, of which priors hold a part."""
        total = np.zeros(1)
        for age, (increments, used) in enumerate(zip(self._increments, self._used, strict=True), 1):
            if age >= self._rules.hops:
                break
            new = ((heard @ used) > 0) & (used == 0)
            shares = np.where(new, 1 - weights @ used, 0.0)
            if self._rules.is_cut:
                traces = _trace(increments)[:, None]
                shares = shares * np.minimum(1.0, limit[:, :, None] / np.maximum(shares * traces, 1e-12))
            total = total + shares @ increments
            self._used[age - 1] = np.maximum(used, new)
        return total


def decompose(network: Mapping[str, Any], seeds: Sequence[int], duration_s: float) -> Iterator[Result]:
    """Yield the figures of each oracle and seed on a network: error and ANEES of c, beside those of the bound."""
    world = worlds(network, seeds, duration_s)
    first = round(counted_from(duration_s) / world.dt_s)
    bounds = [_figures(world, *_bound(world, row), slice(row, row + 1), first)[0] for row in range(len(seeds))]
    for name, rules in ORACLES.items():
        exchange = Exchange(world, rules)
        means, covariances = [], []
        for fix_m in world.fix_m:
            exchange.step(fix_m)
            means.append(exchange.filters.mean[..., :2])
            covariances.append(exchange.filters.covariance[..., :2, :2])
        figures = _figures(world, np.array(means), np.array(covariances), slice(None), first)
        for seed, own, bound in zip(seeds, figures, bounds, strict=True):
            yield {"rules": name, "seed": seed, **own, "bound_m": bound["rmse_m"], "bound_anees": bound["anees"]}


def _bound(world: Worlds, row: int) -> tuple[Array, Array]:
    """Return what the filters that hear all know of c: (K, 1, N, 2) and (K, 1, N, 2, 2)."""
    count = len(world.alike)
    labels = world.alike.argmax(axis=1)
    mean, covariance = np.empty((len(world.fix_m), 1, count, 2)), np.empty((len(world.fix_m), 1, count, 2, 2))
    for label in np.unique(labels):
        some = labels == label
        bound = KalmanBound(world.point_m[some], world.heading_rad[some], world.model)
        for period, fix_m in enumerate(world.fix_m[:, row]):
            bound.step(world.dt_s if period else 0.0, fix_m[some], world.noise_m2 * np.eye(2))
            mean[period, 0, some] = bound.common_m
            covariance[period, 0, some] = bound.common_covariance_m2
    return mean, covariance


def _figures(world: Worlds, mean: Array, covariance: Array, rows: slice, first: int) -> list[dict[str, float]]:
    """Return root of the mean square error of c and ANEES of each seed, from period `first` on."""
    off = (mean - world.common_m[:, rows, None])[first:]
    squares = (off * np.linalg.solve(covariance[first:], off[..., None])[..., 0]).sum(axis=-1) / 2
    rmse_m = np.sqrt((off**2).sum(axis=-1).mean(axis=(0, 2)))
    return [
        {"rmse_m": float(error), "anees": float(anees)}
        for error, anees in zip(rmse_m, squares.mean(axis=(0, 2)), strict=True)
    ]


def report(results: Sequence[Result], duration_s: float) -> str:
    """Return the ratio to the bound and the ANEES of each oracle on each network, in Markdown."""
    networks = unique(results, "network")
    header = ["rules"]
    for network in networks:
        header += [f"{network.upper()}: c : bound", "ANEES of c"]
    rows = []
    for name in unique(results, "rules"):
        row = [name]
        for network in networks:
            found = select(results, network=network, rules=name)
            ratio, error = paired_ratio([each["rmse_m"] for each in found], [each["bound_m"] for each in found])
            row += [with_error(ratio, error, ".2f"), mean_and_error([each["anees"] for each in found], 2)]
        rows.append(row)
    one = [select(results, network=network, rules=next(iter(ORACLES))) for network in networks]
    anees = [mean_and_error([each["bound_anees"] for each in found], 2) for found in one]
    rows.append(["the bound", *[cell for each in anees for cell in ("1", each)]])
    return (
        "# Decomposition: what each oracle gives back\n\n"
        f"{markdown_table(header, rows)}\n\n"
        f"RMSE of c relative to its bound, of {duration_s:g} s from {counted_from(duration_s):.3g} s on; "
        f"{in_seeds(len(unique(results, 'seed')))}; {100 * LOSS:g} % loss. Gaussian filters with the "
        "rules of the cooperative program, without defence and particles; oracles may send any number of bytes.\n"
    )
