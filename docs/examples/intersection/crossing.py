"""An intersection that a unit beside the road grants to vehicles: docs/how-to/intersection.md.

The first vehicle stands at the crossing and is the unit. It grants the crossing to vehicles of one road at a time.
A grant ends when the unit has heard that the vehicle is past, so no packet loss puts two roads onto the crossing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import msgspec

from vnet import Node

CROSSING_M = 1500.0
"""Position of the crossing along either road."""
LINE_M = 1488.0
"""Line at which a vehicle without a grant waits: its own length before the crossing, and room for noise."""
PAST_M = 1510.0
"""From here on a vehicle is past the crossing."""
ASKS_M = 120.0
"""Distance to the line from which on a vehicle asks."""
VEHICLE_M = 5.0
"""Least distance between two positions of vehicles in a lane."""
TELLS_M = 100.0
"""Distance behind the crossing up to which a vehicle says that it is past."""


class Request(msgspec.Struct, tag="request", frozen=True):
    """Request of a vehicle of road 0 or 1 for the crossing, and where it is; behind it, word that it is past."""

    road: int
    at_m: float


class Grants(msgspec.Struct, tag="grants", frozen=True):
    """The vehicles that may cross."""

    vehicles: list[str]


MESSAGES = msgspec.msgpack.Decoder(Request | Grants)


@dataclass(frozen=True)
class Options:
    """Options of the program: whether vehicles wait for a grant, the unit's patience, and the drivers' model."""

    waits: bool = True
    patience_s: float = 8.0
    cruise_m_s: float = 14.0
    headway_s: float = 1.2
    standstill_m: float = 2.0
    acceleration_m_s2: float = 2.0
    comfortable_m_s2: float = 2.0


def wished(options: Options, speed_m_s: float, gap_m: float | None, rate_m_s: float) -> float:
    """Return the acceleration of the intelligent driver model in m/s² behind something `gap_m` ahead, if any."""
    free = 1 - (speed_m_s / options.cruise_m_s) ** 4
    if gap_m is None:
        return options.acceleration_m_s2 * free
    scale = 2 * math.sqrt(options.acceleration_m_s2 * options.comfortable_m_s2)
    wish_m = options.standstill_m + max(0.0, options.headway_s * speed_m_s - speed_m_s * rate_m_s / scale)
    return max(-8.0, options.acceleration_m_s2 * (free - (wish_m / max(gap_m, 0.1)) ** 2))


class Book:
    """Requests and grants as the unit knows them. One road has grants at a time."""

    def __init__(self, patience_s: float) -> None:
        self.patience_s = patience_s
        self.granted: dict[str, Request] = {}
        self.past: set[str] = set()
        self._waiting: dict[str, tuple[float, Request]] = {}

    def note(self, vehicle: str, request: Request, now_s: float) -> None:
        """Take note of a request: of one for the crossing, or of a vehicle that is past."""
        if request.at_m > PAST_M:
            self.past.add(vehicle)
            self.granted.pop(vehicle, None)
            self._waiting.pop(vehicle, None)
        elif vehicle in self.granted:
            self.granted[vehicle] = request
        elif vehicle not in self.past:
            since_s, _ = self._waiting.get(vehicle, (now_s, request))
            self._waiting[vehicle] = since_s, request

    def decide(self, now_s: float) -> None:
        """Grant in the order of requests, unless the other road has grants or a request that is out of patience.

        A vehicle ahead of one with a grant gets one in any case: it is in the way.
        """
        for vehicle, (since_s, request) in list(self._waiting.items()):
            if any(other.road != request.road for other in self.granted.values()):
                continue
            others_s = [s for s, other in self._waiting.values() if other.road != request.road]
            is_turn = min(others_s, default=now_s) >= min(since_s, now_s - self.patience_s)
            is_ahead = any(other.at_m + VEHICLE_M < request.at_m for other in self.granted.values())
            if is_turn or is_ahead:
                self.granted[vehicle] = request
                del self._waiting[vehicle]


async def unit(node: Node, options: Options) -> None:
    """Grant the crossing to one road at a time, and say ten times a second who has a grant."""
    book = Book(options.patience_s)
    async for fix in node.gnss:
        for packet in node.radio.drain():
            message = MESSAGES.decode(packet.payload)
            if isinstance(message, Request):
                book.note(packet.sender, message, fix.time_ns / 1e9)
        book.decide(fix.time_ns / 1e9)
        await node.radio.broadcast(msgspec.msgpack.encode(Grants(sorted(book.granted))))


async def vehicle(node: Node, options: Options) -> None:
    """Ask for the crossing, stop at the line without a grant, and say so when past."""
    road = int(node.id[1:]) % 2
    may_cross = not options.waits
    async for fix in node.gnss:
        for packet in node.radio.drain():
            message = MESSAGES.decode(packet.payload)
            may_cross |= isinstance(message, Grants) and node.id in message.vehicles
        at_m, speed_m_s = float(fix.position_m[0]), fix.speed_m_s or 0.0
        asked = wished(options, speed_m_s, fix.gap_m, fix.gap_rate_m_s or 0.0)
        if not may_cross and at_m < CROSSING_M:
            asked = min(asked, wished(options, speed_m_s, LINE_M - at_m, -speed_m_s))
        node.drive(asked)
        if LINE_M - ASKS_M < at_m < CROSSING_M + TELLS_M:
            await node.radio.broadcast(msgspec.msgpack.encode(Request(road, at_m)))


async def main(node: Node) -> None:
    """Be the unit at the crossing, or a vehicle."""
    options = Options(**node.options)
    await (unit if int(node.id[1:]) == 1 else vehicle)(node, options)
