"""The bound that cooperation is held against: one filter that hears every fix directly (MODEL 5).

Run it where everybody hears everybody: all vehicles broadcast their fixes, and of those who hear each other the one
that has been there longest runs one particle filter over all of them and tells the others what it found, within the
same period. The next one filters beside it, and goes on when it leaves. Where `radio.links` keeps components apart,
each has a filter of its own, and the result is the limit of any cooperation.
"""

from __future__ import annotations

import asyncio
from typing import TypeVar

import msgspec
import numpy as np

from agents.cooperative.options import Options
from vnet import Fix, Node
from vnet.cmm.rbpf import Observation, Rbpf
from vnet.units import NS_PER_S

COMPUTING_SHARE, REPORTING_SHARE = 0.8, 0.95
"""Shares of the period: when the first vehicle filters and tells, and when all report."""
FILTERING = 2
"""So many filter, those who have been there longest: should the first one leave, the next one goes on."""


class Sighting(msgspec.Struct, array_like=True, tag=True):
    """A vehicle's own fix, and since when it has had any."""

    since_ns: int
    time_ns: int
    position_m: tuple[float, float]
    heading_rad: float | None


class Result(msgspec.Struct, array_like=True, tag=True):
    """What the filter says of the common error, its covariance, and where each vehicle is (in cm)."""

    time_ns: int
    common_error_m: tuple[float, float]
    covariance_m2: tuple[float, float, float, float]
    position_cm: dict[str, tuple[int, int]]


T = TypeVar("T", Sighting, Result)
_decoder = msgspec.msgpack.Decoder(Sighting | Result)


async def main(node: Node) -> None:
    """Send fixes, or filter everybody's; report what the filter says."""
    options = Options.parse(node.options)
    rbpf = Rbpf(options.filter_config(), node.map, node.rng)
    since_ns: int | None = None
    async for fix in node.gnss:
        if since_ns is None:
            since_ns, last_ns = fix.time_ns, fix.time_ns - node.period_ns
        own = Sighting(since_ns, fix.time_ns, (float(fix.position_m[0]), float(fix.position_m[1])), fix.heading_rad)
        await node.radio.broadcast(msgspec.msgpack.encode(own))
        await _sleep_until(node, fix.time_ns + round(COMPUTING_SHARE * node.period_ns))
        sightings = _read(node, Sighting, fix.time_ns)
        result = None
        before = sum((seen.since_ns, other) < (since_ns, node.id) for other, seen in sightings.items())
        if before < FILTERING:
            rbpf.step((fix.time_ns - last_ns) / NS_PER_S, _observations(node.id, fix, sightings))
            last_ns = fix.time_ns
            if options.separate_map_update:
                rbpf.update_from_map()
        if before == 0:
            result = _result(rbpf, fix.time_ns)
            await node.radio.broadcast(msgspec.msgpack.encode(result))
        await _sleep_until(node, fix.time_ns + round(REPORTING_SHARE * node.period_ns))
        told = _read(node, Result, fix.time_ns)
        result = result or next(iter(told.values()), None)
        if result is not None:
            _report(node, result)


async def _sleep_until(node: Node, time_ns: int) -> None:
    if time_ns > node.now_ns:
        await asyncio.sleep((time_ns - node.now_ns) / NS_PER_S)


def _read(node: Node, kind: type[T], time_ns: int) -> dict[str, T]:
    """What others said of this period, by sender."""
    found: dict[str, T] = {}
    for packet in node.radio.drain():
        try:
            message = _decoder.decode(packet.payload)
        except msgspec.DecodeError:
            continue
        if isinstance(message, kind) and message.time_ns == time_ns:
            found[packet.sender] = message
    return found


def _observations(node_id: str, fix: Fix, sightings: dict[str, Sighting]) -> dict[str, Observation]:
    observations = {
        other: Observation(np.array(seen.position_m), fix.covariance_m2, seen.heading_rad)
        for other, seen in sightings.items()
    }
    observations[node_id] = Observation(fix.position_m, fix.covariance_m2, fix.heading_rad)
    return observations


def _result(rbpf: Rbpf, time_ns: int) -> Result:
    x, y = rbpf.estimate_m.tolist()
    a, b, c, d = rbpf.estimate_covariance_m2.ravel().tolist()
    weight = rbpf.weight
    place = np.round(100 * (rbpf.tracks.mean[:, :2] @ weight)).astype(int).tolist()
    where = {vehicle: (p[0], p[1]) for vehicle, p in zip(rbpf.vehicles, place, strict=True)}
    return Result(time_ns, (x, y), (a, b, c, d), where)


def _report(node: Node, result: Result) -> None:
    place = result.position_cm.get(node.id)
    node.report(
        None if place is None else np.array(place) / 100,
        common_error_m=result.common_error_m,
        common_error_covariance_m2=result.covariance_m2,
        stacked_common_error_m=result.common_error_m,
        mean_m=result.common_error_m,
    )
