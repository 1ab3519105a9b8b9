"""An intersection that a roadside unit grants to vehicles: docs/how-to/intersection.md.

The unit grants the crossing to vehicles of one road at a time. A grant ends when the unit has heard that the
vehicle is past, so no packet loss puts two roads onto the crossing. The unit also knows where it stands, and so
tells vehicles the error that its receiver has in common with theirs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import msgspec
import numpy as np

from vnet import Node

LINE_M = -12.0
"""Line before the crossing at which a vehicle without a grant waits: its own length, and room for noise."""
PAST_M = 10.0
"""From here on a vehicle is past the crossing."""
ASKS_M = 120.0
"""Distance to the line from which on a vehicle asks."""
VEHICLE_M = 5.0
"""Least distance between two positions of vehicles in a lane."""
CORRECTION_S = 2.0
"""Time over which the unit averages the noise of its receiver."""


class Request(msgspec.Struct, tag="request", frozen=True):
    """Request of a vehicle of road 0 or 1, `at_m` behind the crossing; far enough behind, word that it is past."""

    road: int
    at_m: float


class Grants(msgspec.Struct, tag="grants", frozen=True):
    """The vehicles that may cross, and the common error of all receivers in m, as far as the unit knows it."""

    vehicles: list[str]
    error_m: tuple[float, float]


MESSAGES = msgspec.msgpack.Decoder(Request | Grants)


@dataclass(frozen=True)
class Options:
    """Options of vehicles: whether they wait for a grant, and the drivers' model."""

    waits: bool = True
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


async def unit(node: Node) -> None:
    """Grant the crossing to one road at a time, and say ten times a second who has a grant."""
    assert node.surveyed_position_m is not None
    book, error_m = Book(float(node.options["patience_s"])), np.zeros(2)
    async for fix in node.gnss:
        keeps = math.exp(-node.period_ns / 1e9 / CORRECTION_S) if fix.time_ns else 0.0
        error_m = keeps * error_m + (1 - keeps) * (fix.position_m - node.surveyed_position_m)
        for packet in node.radio.drain():
            message = MESSAGES.decode(packet.payload)
            if isinstance(message, Request):
                book.note(packet.sender, message, fix.time_ns / 1e9)
        book.decide(fix.time_ns / 1e9)
        grants = Grants(sorted(book.granted), (float(error_m[0]), float(error_m[1])))
        await node.radio.broadcast(msgspec.msgpack.encode(grants))


async def main(node: Node) -> None:
    """Ask for the crossing, stop at the line without a grant, and tell the unit that the vehicle is past."""
    options = Options(**node.options)
    may_cross, is_over, at_m, error_m = not options.waits, False, -math.inf, np.zeros(2)
    async for fix in node.gnss:
        road = int(abs(math.sin(fix.heading_rad or 0.0)) > 0.5)  # 0 goes to the east, 1 to the north
        for packet in node.radio.drain():
            message = MESSAGES.decode(packet.payload)
            if isinstance(message, Grants):
                may_cross |= node.id in message.vehicles
                error_m = np.array(message.error_m)
                is_over |= at_m > PAST_M and node.id not in message.vehicles
        at_m, speed_m_s = float((fix.position_m - error_m)[road]), fix.speed_m_s or 0.0
        asked = wished(options, speed_m_s, fix.gap_m, fix.gap_rate_m_s or 0.0)
        if not may_cross and at_m < 0:
            asked = min(asked, wished(options, speed_m_s, LINE_M - at_m, -speed_m_s))
        node.drive(asked)
        if at_m > LINE_M - ASKS_M and not is_over:
            await node.radio.broadcast(msgspec.msgpack.encode(Request(road, at_m)))
