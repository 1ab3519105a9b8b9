"""The world of a run: truth and GNSS fixes at every period, from the scenario's seed.

Every process is drawn from a stream of its own, keyed by (seed, what, vehicle), so that one more vehicle changes
nothing for the others. Vehicles stand on their lanes (MODEL 1: static networks); what moves is their lateral
offset, the error that all share, and the noise of each receiver.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from emulator.world.links import load_links
from emulator.world.networks import Network, generate_network, load_network
from vnet.errors import ScenarioError
from vnet.link.node import Fix
from vnet.roads.lanes import Array, LaneMap
from vnet.scenario import NS_PER_S, Gnss, Scenario


@dataclass(frozen=True)
class Instant:
    """The truth and the fixes at the start of one period.

    `position_m` (N, 2), `heading_rad` (N,), `common_error_m` (2,), `fix_m` (N, 2), `fix_heading_rad` (N,) with
    NaN where the fix has none.
    """

    period: int
    time_ns: int
    position_m: Array
    heading_rad: Array
    common_error_m: Array
    fix_m: Array
    fix_heading_rad: Array


class World:
    """All that is true during a run. `lane_map` is what vehicles may know; `lane_of` (N,) is their secret.

    `links` (N, N) is who (row) hears whom (column), or None where the radio's range decides. Raises ScenarioError
    if the scenario's links or exceptions do not fit the network.
    """

    def __init__(self, scenario: Scenario, network: Network) -> None:
        seed = scenario.run.seed
        count = len(network.node_ids)
        self.node_ids = network.node_ids
        self.links = load_links(scenario.radio, count)
        _check_exceptions(scenario, network)
        self.period_ns = scenario.period_ns
        self.periods = math.ceil(scenario.duration_ns / scenario.period_ns) + 1
        order = _stream(seed, "map order", 0).permutation(count)
        half_width_m = scenario.world.lateral.half_width_m
        self.lane_map = LaneMap(network.position_m[order], network.heading_rad[order], half_width_m)
        self.lane_of = np.argsort(order)
        self._network = network
        self._gnss = scenario.world.gnss
        self._lateral_m = self._draw_lateral(scenario, count)
        self._common_m = self._draw_common(scenario)
        self._noise_m, self._heading_noise = self._draw_noise(self._gnss, seed, count)
        self._normal = np.column_stack([np.sin(network.heading_rad), -np.cos(network.heading_rad)])

    def _draw_lateral(self, scenario: Scenario, count: int) -> Array:
        """(K, N): Ornstein-Uhlenbeck offsets from the lane's centre, reflected at the half-width."""
        lateral = scenario.world.lateral
        normal = np.column_stack(
            [_stream(scenario.run.seed, "lateral", i).standard_normal(self.periods) for i in range(count)]
        )
        keep = math.exp(-self.period_ns / NS_PER_S / lateral.tau_s)
        offset = np.empty_like(normal)
        offset[0] = _reflect(lateral.sigma_m * normal[0], lateral.half_width_m)
        for k in range(1, self.periods):
            step = keep * offset[k - 1] + lateral.sigma_m * math.sqrt(1 - keep**2) * normal[k]
            offset[k] = _reflect(step, lateral.half_width_m)
        return offset

    def _draw_common(self, scenario: Scenario) -> Array:
        """(K, 2): the common error, a Gauss-Markov process from its stationary distribution on."""
        common = scenario.world.common_error
        normal = _stream(scenario.run.seed, "common error", 0).standard_normal((self.periods, 2))
        keep = math.exp(-self.period_ns / NS_PER_S / common.tau_s)
        error = np.empty_like(normal)
        error[0] = common.sigma_m * normal[0]
        for k in range(1, self.periods):
            error[k] = keep * error[k - 1] + common.sigma_m * math.sqrt(1 - keep**2) * normal[k]
        return error

    def _draw_noise(self, gnss: Gnss, seed: int, count: int) -> tuple[Array, Array]:
        """(K, N, 2) position noise in metres and (K, N) heading noise in radians."""
        position = [_stream(seed, "gnss", i).standard_normal((self.periods, 2)) for i in range(count)]
        heading = [_stream(seed, "heading", i).standard_normal(self.periods) for i in range(count)]
        return gnss.sigma_m * np.stack(position, axis=1), gnss.heading_sigma_rad * np.stack(heading, axis=1)

    def at(self, period: int) -> Instant:
        """The truth at the start of `period`, 0 ≤ period < `periods`."""
        assert 0 <= period < self.periods, period
        heading = self._network.heading_rad
        position_m = self._network.position_m + self._lateral_m[period, :, None] * self._normal
        common_m = self._common_m[period]
        if self._gnss.heading:
            fix_heading = np.mod(heading + self._heading_noise[period], 2 * np.pi)
        else:
            fix_heading = np.full(len(heading), np.nan)
        return Instant(
            period,
            period * self.period_ns,
            position_m,
            heading,
            common_m,
            position_m + common_m + self._noise_m[period],
            fix_heading,
        )

    def fix(self, period: int, node: int) -> Fix:
        """What the receiver of vehicle number `node` says at the start of `period`."""
        lateral_m = self._lateral_m[period, node] * self._normal[node]
        true_m = self._network.position_m[node] + lateral_m
        fix_m = true_m + self._common_m[period] + self._noise_m[period, node]
        heading = None
        if self._gnss.heading:
            noisy = self._network.heading_rad[node] + self._heading_noise[period, node]
            heading = float(np.mod(noisy, 2 * np.pi))
        return Fix(period * self.period_ns, fix_m, np.eye(2) * self._gnss.sigma_m**2, heading)


def _check_exceptions(scenario: Scenario, network: Network) -> None:
    for exception in scenario.program.exceptions:
        for node in exception.nodes:
            if node not in network.node_ids:
                some = ", ".join(network.node_ids[:8]) + (", …" if len(network.node_ids) > 8 else "")
                raise ScenarioError(f"program.exceptions: {node!r} is no vehicle of the network; they are {some}")


def build_world(scenario: Scenario) -> World:
    """The world of a scenario. Raises ScenarioError if its network or its links cannot be used."""
    network = scenario.network
    if network.path is not None:
        return World(scenario, load_network(network.path))
    return World(scenario, generate_network(network.layout, network.vehicles, network.seed))


def components(position_m: Array, range_m: float, links: NDArray[np.bool_] | None = None) -> NDArray[np.intp]:
    """Which connected component each vehicle belongs to, as (N,) labels.

    Positions (N, 2) and the range are in metres. `links` (N, N), if given, says who hears whom in place of the
    range; a link of one direction connects as well (weakly).
    """
    offset = position_m[:, None] - position_m[None]
    linked = np.hypot(offset[..., 0], offset[..., 1]) <= range_m if links is None else links
    _, label = connected_components(linked, directed=False)
    return np.asarray(label, dtype=np.intp)


def _reflect(offset_m: Array, half_width_m: float) -> Array:
    """Fold offsets back into ±half_width, as between two mirrors."""
    folded = np.mod(offset_m + half_width_m, 4 * half_width_m)
    return np.asarray(np.where(folded > 2 * half_width_m, 4 * half_width_m - folded, folded) - half_width_m)


def _stream(seed: int, what: str, vehicle: int) -> np.random.Generator:
    """The random stream of one process of one vehicle."""
    key = int.from_bytes(hashlib.blake2b(what.encode(), digest_size=8).digest(), "little")
    return np.random.Generator(
        np.random.Philox(
            key=np.array([seed, key], dtype=np.uint64), counter=np.array([0, 0, vehicle, 0], dtype=np.uint64)
        )
    )
