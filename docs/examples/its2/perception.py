"""Vehicles that tell each other by CPM what their sensors see, and fuse it: docs/how-to/standard-messages.md.

Options: `shares`, whether they send; `asn1`, ETSI's own schema in place of that of the example.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from docs.examples.its2.standard_messages import (
    PROFILE,
    Message,
    Seen,
    Xy,
    decode_cpm,
    encode_cpm,
    schema,
    station_of,
)
from vnet import Fix, Node
from vnet.types import Array

DECLARES = "docs.examples.its2.perception"
FIGURES = "docs.examples.its2.perception:Figures"

EVERY = 2
"""Fixes from one CPM to the next: 0.2 s, within the 0.1 to 1 s of TS 103 324."""
APART_S = 0.09
"""Time over which CPMs of one period are spread."""
HOLDS_S = 0.5
"""Age at which an object that nobody tells of any more is forgotten."""
SAME_M = 4.0
"""Distance within which two objects are one: less than a vehicle's length."""
AREA_M, RIGHT_M = 100.0, 3.0
"""Distance from the crossing within which vehicles count, and from the truth within which one is seen."""
PLACES, NOWHERE_M = 24, 1e6
"""Places of a report, those next to the crossing, and what stands for those that are fewer."""


@dataclass(frozen=True)
class Figures:
    """Share of the crossing that is seen, and what is seen that is not there."""

    COLUMNS: ClassVar = {
        "seen_m": ("seen_m", 2 * PLACES, "places of the vehicles that it knows of, one after the other")
    }
    CHARTS: ClassVar = (
        {
            "id": "seen",
            "title": "Crossing",
            "axis": "share of the vehicles that is known",
            "lines": {"mean": "seen_share"},
            "text": "Share of the vehicles near the crossing that those there know of.",
        },
    )

    seen_share: float | None
    """Mean share, over vehicles near the crossing, of the others there that they know of within `RIGHT_M`."""
    ghosts: float | None
    """Mean number, over these vehicles, of places there where they know of a vehicle and none is."""

    @staticmethod
    def compute(periods: Any) -> dict[str, list[float | None]]:
        """Return the figures of each of K periods."""
        both = [seen_of(*each) for each in zip(periods["position_m"], periods["seen_m"], strict=True)]
        return {"seen_share": [share for share, _ in both], "ghosts": [ghosts for _, ghosts in both]}


def seen_of(position_m: Array, seen_m: Array) -> tuple[float | None, float | None]:
    """Return both figures of one period: true positions (N, 2), and what each vehicle knows, (N, size)."""
    near = np.flatnonzero(np.hypot(*position_m.T) <= AREA_M)
    if len(near) < 2:
        return None, None
    shares, ghosts = [], []
    for number in near:
        known_m = seen_m[number].reshape(-1, 2)
        known_m = known_m[np.hypot(*known_m.T) <= AREA_M]
        others_m = position_m[near[near != number]]
        all_m = np.delete(position_m, number, axis=0)
        shares.append(float((_distances(others_m, known_m) <= RIGHT_M).mean()))
        ghosts.append(int((_distances(known_m, all_m) > RIGHT_M).sum()))
    return float(np.mean(shares)), float(np.mean(ghosts))


def _distances(from_m: Array, to_m: Array) -> Array:
    """Return the distance of each of (n, 2) to the nearest of (m, 2)."""
    if not len(to_m):
        return np.full(len(from_m), np.inf)
    return np.asarray(np.hypot(*np.moveaxis(from_m[:, None] - to_m, 2, 0)).min(axis=1))


def fused(now_ns: int, own_m: Xy, seen: Iterable[Seen], heard: Iterable[tuple[Message, Xy]]) -> list[Xy]:
    """Return the places now of all others: what is seen now, and what messages say, moved on; each vehicle once.

    `heard` are the latest message of each sender and that sender's velocity.
    """
    told: list[tuple[float, Seen]] = []
    for message, velocity_m_s in heard:
        age_s = (now_ns - message.time_ns) / 1e9
        if age_s <= HOLDS_S:
            told.append((age_s, Seen(message.position_m, velocity_m_s)))
            told += [(age_s + each.age_s, each) for each in message.objects]
    places: list[Xy] = [own_m]
    for age_s, each in [*((0.0, each) for each in seen), *sorted(told, key=lambda one: one[0])]:
        x_m, y_m = (at + age_s * speed for at, speed in zip(each.position_m, each.velocity_m_s, strict=True))
        if all(math.hypot(x_m - other[0], y_m - other[1]) > SAME_M for other in places):
            places.append((x_m, y_m))
    return places[1:]


def sensed(fix: Fix) -> tuple[Seen, ...]:
    """Return what a vehicle's sensor sees, at places east and north of the origin."""
    numbers = fix.sensors.get("sight", ())
    assert isinstance(numbers, tuple)
    east_m, north_m = fix.position_m.tolist()
    rows = zip(*(iter(numbers),) * 4, strict=True)
    return tuple(Seen((east_m + x, north_m + y), (x_m_s, y_m_s)) for x, y, x_m_s, y_m_s in rows)


async def main(node: Node) -> None:
    """Send a CPM at every other fix, and report where others are."""
    types = schema(node.options.get("asn1", PROFILE), "CollectivePerceptionMessage")
    station, apart_s = station_of(node.id), float(node.rng.uniform(0.0, APART_S))
    heard: dict[int, tuple[Message, Xy]] = {}
    async for fix in node.gnss:
        for packet in node.radio.drain():
            message = decode_cpm(packet.payload, types)
            if message is not None:
                heard[message.station] = message, _velocity(message, heard.get(message.station))
        seen, here = sensed(fix), (float(fix.position_m[0]), float(fix.position_m[1]))
        places = fused(fix.time_ns, here, seen, heard.values())
        node.report(fix.position_m, fix.covariance_m2, seen_m=_row(places))
        if node.options.get("shares", True) and (fix.time_ns // node.period_ns + station) % EVERY == 0:
            await asyncio.sleep(apart_s)
            told = Message(station, fix.time_ns, here, fix.heading_rad, objects=seen)
            await node.radio.broadcast(encode_cpm(told, types), period_ms=EVERY * node.period_ns / 1e6)


def _row(places: list[Xy]) -> list[float]:
    nearest = sorted(places, key=lambda place: math.hypot(*place))[:PLACES]
    return [at for place in nearest for at in place] + [NOWHERE_M] * 2 * (PLACES - len(nearest))


def _velocity(message: Message, before: tuple[Message, Xy] | None) -> Xy:
    """Return a sender's velocity from its last two CPMs, which do not tell it."""
    if before is None or message.time_ns <= before[0].time_ns:
        return 0.0, 0.0
    passed_s = (message.time_ns - before[0].time_ns) / 1e9
    x_m_s, y_m_s = (
        (now - then) / passed_s for now, then in zip(message.position_m, before[0].position_m, strict=True)
    )
    return x_m_s, y_m_s
