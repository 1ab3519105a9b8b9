"""Baselines of cooperative positioning: what textbooks offer, to compare the cooperative program with.

Option `method`, all with one broadcast a period to the vehicles in range, and without any defence:

- `alone`: a vehicle filters its own fixes, and hears nobody.
- `diffusion`: the diffusion Kalman filter (Cattivelli and Sayed 2010): neighbours' increments are added, estimates
  are averaged, and covariances are not.
- `intersection`: covariance intersection with equal weights (Julier and Uhlmann 1997), increments added.
- `differential`: the correction that fits the present innovations of all heard best, each the distance of a fix
  from its lane; without a filter but for a mean over `smoothing_s`.
"""

from __future__ import annotations

import asyncio
import math
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta

from agents import options as parsing
from agents.cooperative.cmm.information import Five, Information, inverse
from agents.cooperative.cmm.map_matching import candidate_lanes
from agents.cooperative.cmm.own_vehicle import OwnConfig, own_vehicle
from agents.cooperative.cmm.rbpf import Observation, RbpfConfig
from agents.cooperative.estimator import usable
from vnet import Fix, Node
from vnet.errors import ProgramError
from vnet.roads.lanes import LaneMap
from vnet.types import Array
from vnet.units import NS_PER_S

DECLARES = "agents.cooperative.declared"
COMPUTING_SHARE = 0.8
"""Share of the period at which vehicles compute: all frames have come by then."""
REACH_M = 15.0
"""Distance (m) of a fix from its lane that is looked for before the common error is known: 5 σ of it."""
LEAST_INFORMATION = 1e-6
"""Information (1/m²) about the correction before anything is heard: a deviation of a kilometre."""

Positive = Annotated[float, Meta(gt=0)]


class Options(msgspec.Struct, frozen=True, kw_only=True):
    """Options of the baselines; lengths in metres, times in seconds."""

    method: Literal["alone", "diffusion", "intersection", "differential"] = "intersection"
    """The baseline."""
    particles: Annotated[int, Meta(ge=1, le=100_000)] = 1000
    """Number of hypotheses of the common error that a vehicle keeps."""
    common_sigma_m: Positive = 3.0
    """Standard deviation of the common error, as the vehicle assumes it."""
    common_tau_s: Positive = 600.0
    """Correlation time of the common error, as the vehicle assumes it."""
    smoothing_s: Positive = 1.0
    """Time over which `differential` averages."""


class BaselineFrame(msgspec.Struct, array_like=True):
    """One broadcast: what the sender knew before its fix, and what the fix says (matrix xx, xy, yy; vector)."""

    time_ns: int
    prior: Five
    increment: Five


def _information(five: Array) -> Information:
    a, b, d, x, y = five.tolist()
    return Information((a, b, d, x, y))


class Filtering:
    """The methods with a filter of the vehicle itself; `share` is what it broadcasts."""

    def __init__(self, options: Options, node: Node) -> None:
        self._method = options.method
        config = RbpfConfig(options.particles, options.common_sigma_m, options.common_tau_s)
        self._own = own_vehicle(OwnConfig(config), node.map, node.rng)
        self._last_ns: int | None = None

    def observe(self, fix: Fix) -> BaselineFrame:
        """Take the vehicle's own fix; returns the frame to broadcast."""
        last_ns = fix.time_ns if self._last_ns is None else self._last_ns
        observation = Observation(fix.position_m, fix.covariance_m2, fix.heading_rad) if usable(fix) else None
        increment = self._own.step((fix.time_ns - last_ns) / NS_PER_S, observation)
        self._last_ns = fix.time_ns
        return BaselineFrame(fix.time_ns, self._own.prior.numbers, increment.numbers)

    def combine(self, own: BaselineFrame, heard: list[BaselineFrame]) -> None:
        """Combine what others say of the same instant."""
        if not heard:
            return
        prior = np.array([own.prior, *(frame.prior for frame in heard)])
        increment = np.sum([own.increment, *(frame.increment for frame in heard)], axis=0)
        if self._method == "intersection":
            pooled = prior.mean(axis=0)
        else:
            means = [_information(each).moments()[0] for each in prior]
            certain = _information(prior[0]).matrix
            pooled = np.array(Information.from_arrays(certain, certain @ np.mean(means, axis=0)).numbers)
        self._own.absorb(_information(pooled + increment))

    def estimate(self, fix: Fix) -> tuple[Array, Array, Array, Array]:
        """Return the common error (2,), its covariance (2, 2), the position (2,) and its covariance (2, 2)."""
        common_m, covariance_m2 = self._own.belief
        position = self._own.position_m() or (fix.position_m - common_m, fix.covariance_m2 + covariance_m2)
        return common_m, covariance_m2, *position


class Differential:
    """Differential correction. Raises ProgramError on a map of roads, which has no lanes without end."""

    def __init__(self, options: Options, node: Node) -> None:
        if not isinstance(node.map, LaneMap):
            raise ProgramError('program.options.method = "differential": needs a network of straight lanes')
        self._lanes = node.map
        self._keep = math.exp(-node.period_ns / NS_PER_S / options.smoothing_s)
        self._sum = np.zeros(5)
        self._samples = 0.0
        self._common_m = np.zeros(2)
        self._covariance_m2 = options.common_sigma_m**2 * np.eye(2)

    def observe(self, fix: Fix) -> BaselineFrame:
        """Return the frame with the innovation: the distance of the fix from its lane, as information about c."""
        nothing = (0.0, 0.0, 0.0, 0.0, 0.0)
        if not usable(fix):
            return BaselineFrame(fix.time_ns, nothing, nothing)
        expected_m = fix.position_m - self._common_m
        lanes = candidate_lanes(self._lanes, expected_m, fix.heading_rad, REACH_M)
        if not len(lanes):
            return BaselineFrame(fix.time_ns, nothing, nothing)
        across_m = self._lanes.normal[lanes] @ expected_m - self._lanes.offset_m[lanes]
        lane = lanes[int(np.argmin(np.abs(across_m)))]
        normal = self._lanes.normal[lane]
        variance_m2 = float(normal @ fix.covariance_m2 @ normal) + (self._lanes.half_width_m / 2) ** 2
        innovation_m = float(normal @ fix.position_m - self._lanes.offset_m[lane])
        seen = Information.from_arrays(np.outer(normal, normal) / variance_m2, innovation_m * normal / variance_m2)
        return BaselineFrame(fix.time_ns, nothing, seen.numbers)

    def combine(self, own: BaselineFrame, heard: list[BaselineFrame]) -> None:
        """Average the innovations of all heard, and the vehicle's own, with those of the last moments."""
        innovations = np.sum([own.increment, *(frame.increment for frame in heard)], axis=0)
        self._sum = self._keep * self._sum + (1 - self._keep) * innovations
        self._samples = self._keep * self._samples + (1 - self._keep)
        mean = _information(self._sum / self._samples)
        matrix = mean.matrix + LEAST_INFORMATION * np.eye(2)
        self._covariance_m2 = inverse(matrix)
        self._common_m = self._covariance_m2 @ mean.vector

    def estimate(self, fix: Fix) -> tuple[Array, Array, Array, Array]:
        """Return the common error (2,), its covariance (2, 2), the position (2,) and its covariance (2, 2)."""
        position_m = fix.position_m - self._common_m
        return self._common_m, self._covariance_m2, position_m, fix.covariance_m2 + self._covariance_m2


async def main(node: Node) -> None:
    """Estimate until the run ends."""
    options = parsing.parse(node.options, Options)
    estimator = (Differential if options.method == "differential" else Filtering)(options, node)
    async for fix in node.gnss:
        own, heard, size = estimator.observe(fix), {}, 0
        if options.method != "alone":
            payload = msgspec.msgpack.encode(own)
            size = len(payload)
            await node.radio.broadcast(payload)
            await asyncio.sleep(max(0.0, COMPUTING_SHARE * node.period_ns - (node.now_ns - fix.time_ns)) / NS_PER_S)
            for packet in node.radio.drain():
                frame = _decoded(packet.payload)
                if frame is not None and frame.time_ns == fix.time_ns:
                    heard[packet.sender] = frame
        estimator.combine(own, [heard[sender] for sender in sorted(heard)])
        common_m, common_covariance_m2, position_m, covariance_m2 = estimator.estimate(fix)
        node.report(
            position_m,
            covariance_m2,
            common_error_m=common_m,
            common_error_covariance_m2=common_covariance_m2,
            heard=len(heard),
            bytes=size,
        )


def _decoded(payload: bytes) -> BaselineFrame | None:
    """Return the frame in some bytes, or None if they are none."""
    try:
        frame = msgspec.msgpack.decode(payload, type=BaselineFrame)
    except msgspec.DecodeError:
        return None
    return frame if np.isfinite([*frame.prior, *frame.increment]).all() else None
