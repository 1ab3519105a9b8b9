"""The hears-all bound of cooperation: one filter that receives every fix directly (MODEL 5).

Run it where all vehicles hear each other: all broadcast their fixes, and the one that has been there longest runs
one particle filter over all of them and broadcasts the result, within the same period. The next one filters beside
it, and goes on when it leaves. If `radio.links` separates components, each has a filter of its own. No cooperation
of vehicles that hear only their neighbours can be expected to do better.
"""

from __future__ import annotations

import asyncio
from typing import TypeVar

import msgspec
import numpy as np

from agents.cooperative.cmm.rbpf import Observation, Rbpf
from agents.cooperative.options import Options
from vnet import Fix, Node
from vnet.units import NS_PER_S

DECLARES = "agents.cooperative.declared"
COMPUTING_SHARE = 0.8
"""Share of the period at which the filtering vehicles compute: all fixes have come by then."""
REPORTING_SHARE = 0.95
"""Share of the period at which all report: the result has come by then."""
FILTERING = 2
"""Number of vehicles that filter, those that have been there longest: if the first leaves, the next goes on."""


class OwnFix(msgspec.Struct, array_like=True, tag="Sighting"):
    """A vehicle's own fix, and the time of its first."""

    since_ns: int
    time_ns: int
    position_m: tuple[float, float]
    heading_rad: float | None


class Result(msgspec.Struct, array_like=True, tag=True):
    """The filter's estimate of the common error, its covariance, and the position of each vehicle in cm."""

    time_ns: int
    common_error_m: tuple[float, float]
    covariance_m2: tuple[float, float, float, float]
    position_cm: dict[str, tuple[int, int]]


T = TypeVar("T", OwnFix, Result)
_decoder = msgspec.msgpack.Decoder(OwnFix | Result)


async def main(node: Node) -> None:
    """Broadcast fixes, or filter those of all vehicles, until the run ends; report the filter's result."""
    options = Options.parse(node.options)
    rbpf = Rbpf(options.filter_config(), node.map, node.rng)
    since_ns: int | None = None
    async for fix in node.gnss:
        if since_ns is None:
            since_ns, last_ns = fix.time_ns, fix.time_ns - node.period_ns
        own = OwnFix(since_ns, fix.time_ns, (float(fix.position_m[0]), float(fix.position_m[1])), fix.heading_rad)
        await node.radio.broadcast(msgspec.msgpack.encode(own))
        await _sleep_until(node, fix.time_ns + round(COMPUTING_SHARE * node.period_ns))
        fixes = _read(node, OwnFix, fix.time_ns)
        result = None
        before = sum((seen.since_ns, other) < (since_ns, node.id) for other, seen in fixes.items())
        if before < FILTERING:
            rbpf.step((fix.time_ns - last_ns) / NS_PER_S, _observations(node.id, fix, fixes))
            last_ns = fix.time_ns
            if options.separate_map_update:
                rbpf.update_from_map()
        if before == 0:
            result = _result(rbpf, fix.time_ns)
            await node.radio.broadcast(msgspec.msgpack.encode(result))
        await _sleep_until(node, fix.time_ns + round(REPORTING_SHARE * node.period_ns))
        received = _read(node, Result, fix.time_ns)
        result = result or next(iter(received.values()), None)
        if result is not None:
            _report(node, result)


async def _sleep_until(node: Node, time_ns: int) -> None:
    if time_ns > node.now_ns:
        await asyncio.sleep((time_ns - node.now_ns) / NS_PER_S)


def _read(node: Node, kind: type[T], time_ns: int) -> dict[str, T]:
    """Return the messages of others about this period, by sender."""
    found: dict[str, T] = {}
    for packet in node.radio.drain():
        try:
            message = _decoder.decode(packet.payload)
        except msgspec.DecodeError:
            continue
        if isinstance(message, kind) and message.time_ns == time_ns:
            found[packet.sender] = message
    return found


def _observations(node_id: str, fix: Fix, fixes: dict[str, OwnFix]) -> dict[str, Observation]:
    observations = {
        other: Observation(np.array(seen.position_m), fix.covariance_m2, seen.heading_rad)
        for other, seen in fixes.items()
    }
    observations[node_id] = Observation(fix.position_m, fix.covariance_m2, fix.heading_rad)
    return observations


def _result(rbpf: Rbpf, time_ns: int) -> Result:
    x, y = rbpf.estimate_m.tolist()
    a, b, c, d = rbpf.estimate_covariance_m2.ravel().tolist()
    weight = rbpf.weight
    position_cm = np.round(100 * (rbpf.tracks.mean[:, :2] @ weight)).astype(int).tolist()
    by_vehicle = {vehicle: (p[0], p[1]) for vehicle, p in zip(rbpf.vehicles, position_cm, strict=True)}
    return Result(time_ns, (x, y), (a, b, c, d), by_vehicle)


def _report(node: Node, result: Result) -> None:
    position_cm = result.position_cm.get(node.id)
    node.report(
        None if position_cm is None else np.array(position_cm) / 100,
        common_error_m=result.common_error_m,
        common_error_covariance_m2=result.covariance_m2,
        stacked_common_error_m=result.common_error_m,
        mean_m=result.common_error_m,
    )
