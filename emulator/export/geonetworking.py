"""GeoNetworking and BTP headers for messages of ITS stations, so that other programs dissect them.

A program broadcasts a CAM or a DENM (release 1, in unaligned PER) as it is. On air such a message follows BTP-B
(EN 302 636-5-1) and GeoNetworking (EN 302 636-4-1 V1.4.1): a CAM as a single-hop broadcast, a DENM as a broadcast
into a circle around its event. What headers repeat of a message, such as its position, is read from its first bits.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

ETHERTYPE = 0x8947
"""Ethertype of GeoNetworking."""
DENM, CAM = 1, 2
"""Numbers of messages, the second byte of each."""
_VERSIONS = (1, 2)
_PORTS = {CAM: 2001, DENM: 2002}
_BTP_B, _COMMON_HEADER = 2, 1
_GEO_BROADCAST, _SINGLE_HOP = 4, 5
_TRAFFIC_CLASS = {CAM: 2, DENM: 1}
_LIFETIME = {CAM: 1 << 2 | 1, DENM: 60 << 2 | 1}
"""Multiples of a second."""
_MOBILE, _HOPS, _RADIUS_M = 0x80, {CAM: 1, DENM: 10}, 1000
_HEADER_BITS = 48
_UNAVAILABLE = 900_000_001, 1_800_000_001
"""Latitude and longitude that are not available; larger ones are none."""
_LEAST_BITS = {CAM: 256, DENM: 250}
"""Bits of messages that have all that is read here."""


@dataclass(frozen=True)
class Station:
    """A sender as headers have it: position in 10⁻⁷ degrees, speed in cm/s, heading in 0.1 degrees from north."""

    latitude: int
    longitude: int
    speed: int = 0
    heading: int = 0


class Router:
    """The GeoNetworking routers of all stations of a run: what they have said last stands in their headers."""

    def __init__(self) -> None:
        self._last: dict[int, Station] = {}

    def packet(self, sender: int, seq: int, time_ns: int, message: bytes) -> bytes | None:
        """Return a message of the station number `sender` with its headers; None if it is no CAM or DENM."""
        read = station_of(message)
        if read is None:
            return None
        kind = message[1]
        if kind == CAM:
            self._last[sender] = read
        source = _long_position(sender, time_ns, self._last.get(sender, read))
        transport = struct.pack(">HH", _PORTS[kind], 0) + message
        if kind == CAM:
            header_type, extended = _SINGLE_HOP << 4, source + bytes(4)
        else:
            area = struct.pack(">iiHHHH", read.latitude, read.longitude, _RADIUS_M, 0, 0, 0)
            header_type, extended = _GEO_BROADCAST << 4, struct.pack(">HH", seq & 0xFFFF, 0) + source + area
        hops = _HOPS[kind]
        basic = struct.pack(">BBBB", 1 << 4 | _COMMON_HEADER, 0, _LIFETIME[kind], hops)
        common = struct.pack(
            ">BBBBHBB", _BTP_B << 4, header_type, _TRAFFIC_CLASS[kind], _MOBILE, len(transport), hops, 0
        )
        return basic + common + extended + transport


def station_of(message: bytes) -> Station | None:
    """Return what a CAM says of its station, or where the event of a DENM is; None if it is neither."""
    station = _read(message)
    if station is None or abs(station.latitude) > _UNAVAILABLE[0] or abs(station.longitude) > _UNAVAILABLE[1]:
        return None
    return station


def _read(message: bytes) -> Station | None:
    if len(message) < 2 or message[0] not in _VERSIONS or message[1] not in _PORTS:
        return None
    kind = message[1]
    if 8 * len(message) < _LEAST_BITS[kind]:
        return None
    bits = _Bits(message)
    if kind == CAM:
        bits.skip(_HEADER_BITS + 16 + 3 + 1 + 8)  # delta time; options; station type
        latitude, longitude = _position(bits)
        bits.skip(36 + 24)  # confidence, altitude
        if bits.take(2):  # another container than a vehicle's
            return Station(latitude, longitude)
        bits.skip(7)
        heading = bits.take(12)
        bits.skip(7)
        speed = bits.take(14)
        return Station(latitude, longitude, 0 if speed == 16383 else speed, 0 if heading > 3600 else heading)
    bits.skip(_HEADER_BITS + 3 + 1)
    has_termination = bits.take(1)
    bits.skip(4 + 32 + 16 + 42 + 42 + has_termination)  # options, action, times of detection and reference
    return Station(*_position(bits))


class _Bits:
    """Reader of unsigned numbers of a few bits each, as unaligned packed encoding rules have them."""

    def __init__(self, data: bytes) -> None:
        self._number, self._left = int.from_bytes(data, "big"), 8 * len(data)

    def take(self, count: int) -> int:
        """Return the next `count` bits."""
        self._left -= count
        return self._number >> self._left & (1 << count) - 1

    def skip(self, count: int) -> None:
        """Leave out the next `count` bits."""
        self._left -= count


def _position(bits: _Bits) -> tuple[int, int]:
    return bits.take(31) - 900_000_000, bits.take(32) - 1_800_000_000


def _long_position(sender: int, time_ns: int, station: Station) -> bytes:
    """Return a long position vector: address (a car's), time, place, speed and heading."""
    address = struct.pack(">BB", 5 << 2, 0) + b"\x02\x00" + struct.pack(">I", sender + 1)
    milliseconds = time_ns // 1_000_000 % 2**32
    place = struct.pack(">Iii", milliseconds, station.latitude, station.longitude)
    return address + place + struct.pack(">HH", 0x8000 | min(station.speed, 0x3FFF), station.heading)
