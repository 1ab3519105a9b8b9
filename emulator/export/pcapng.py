"""Export of a run's frames as pcapng, as a capture on every vehicle's radio would have recorded them.

Each vehicle is an interface, with the frames that it sent (outbound, at the time they were enqueued or, with
`[radio.mac]`, went on air) and those delivered to it (inbound, at their arrival). A packet consists of radiotap, a
QoS data frame of 802.11 outside a BSS (as in 802.11p), LLC and SNAP with the ethertype 0x88B5 for local
experiments, and the payload; a CAM or DENM may have the headers and the ethertype that it has on air. With C-V2X
the header is Ethernet's in place of 802.11's. A frame to one vehicle asks for an acknowledgement, which is a packet
of its own; retries have the retry bit. Payloads that the run has not kept, or that a fault has altered, are
truncated (captured length < length); the digest is in the packet's comment. Frames without a node in range have no
rows in the trace and are missing. Times are nanoseconds from the start of the run.

Formats: draft-ietf-opsawg-pcapng; radiotap.org. Link type 127 is 802.11 with radiotap, 1 is Ethernet.

A program broadcasts a CAM or a DENM (release 1, in unaligned PER) as it is. On air such a message follows BTP-B
(EN 302 636-5-1) and GeoNetworking (EN 302 636-4-1 V1.4.1): a CAM as a single-hop broadcast, a DENM as a broadcast
into a circle around its event. What headers repeat of a message, such as its position, is read from its first bits.
Timestamps are milliseconds from the start of the run: a CAM has 16 bits of the time since 2004, too few for theirs.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import BinaryIO

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from emulator.radio.dot11p import SIFS_NS
from emulator.radio.unicast import BASIC_RATES_MBPS, ack_airtime_ns, ack_rate_mbps
from emulator.records.recorded_run import OpenedRun, RecordedRun
from emulator.records.tables import PAYLOADS
from vnet.errors import VnetError
from vnet.types import Array, IntArray

GEONETWORKING = 0x8947
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
_CAR, _ROADSIDE_UNIT, _MOST_TYPES = 5, 15, 31
"""Types of stations, and the greatest that an address can say."""


@dataclass(frozen=True)
class Station:
    """A sender as headers have it: position in 10⁻⁷ degrees, speed in cm/s, heading in 0.1 degrees from north.

    Attributes:
        kind: station type, as a CAM has it.
        is_accurate: whether the position is that of now.
    """

    latitude: int
    longitude: int
    speed: int = 0
    heading: int = 0
    kind: int = _CAR
    is_accurate: bool = True


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
        if read.latitude == _UNAVAILABLE[0] or read.longitude == _UNAVAILABLE[1]:
            last = self._last.get(sender, Station(0, 0))  # GeoNetworking has no value for it
            read = replace(read, latitude=last.latitude, longitude=last.longitude, is_accurate=False)
        if kind == CAM:
            self._last[sender] = read
        station = self._last.get(sender, read)
        source = _long_position(sender, time_ns, station)
        transport = struct.pack(">HH", _PORTS[kind], 0) + message
        if kind == CAM:
            header_type, extended = _SINGLE_HOP << 4, source + bytes(4)
        else:
            area = struct.pack(">iiHHHH", read.latitude, read.longitude, _RADIUS_M, 0, 0, 0)
            header_type, extended = _GEO_BROADCAST << 4, struct.pack(">HH", seq & 0xFFFF, 0) + source + area
        hops = _HOPS[kind]
        basic = struct.pack(">BBBB", 1 << 4 | _COMMON_HEADER, 0, _LIFETIME[kind], hops)
        flags = 0 if station.kind == _ROADSIDE_UNIT else _MOBILE
        common = struct.pack(
            ">BBBBHBB", _BTP_B << 4, header_type, _TRAFFIC_CLASS[kind], flags, len(transport), hops, 0
        )
        return basic + common + extended + transport


def station_of(message: bytes) -> Station | None:
    """Return what a CAM says of its station, or where the event of a DENM is; None if it is neither."""
    try:
        station = _read(message)
    except ValueError:  # it is cut short
        return None
    if station is None or abs(station.latitude) > _UNAVAILABLE[0] or abs(station.longitude) > _UNAVAILABLE[1]:
        return None
    return station


def _read(message: bytes) -> Station | None:
    if len(message) < 2 or message[0] not in _VERSIONS or message[1] not in _PORTS:
        return None
    bits = _Bits(message)
    if message[1] == CAM:
        bits.skip(_HEADER_BITS + 16 + 3 + 1)  # delta time; options
        kind = bits.take(8)
        latitude, longitude = _position(bits)
        bits.skip(36 + 24)  # confidence, altitude
        if bits.take(2):  # another container than a vehicle's
            return Station(latitude, longitude, kind=kind)
        bits.skip(7)
        heading = bits.take(12)
        bits.skip(7)
        speed = bits.take(14)
        return Station(latitude, longitude, 0 if speed == 16383 else speed, 0 if heading > 3600 else heading, kind)
    bits.skip(_HEADER_BITS + 3 + 1)
    has_termination = bits.take(1)
    bits.skip(4 + 32 + 16 + 42 + 42 + has_termination)  # options, action, times of detection and reference
    return Station(*_position(bits))


class _Bits:
    """Reader of unsigned numbers of a few bits each, as unaligned packed encoding rules have them."""

    def __init__(self, data: bytes) -> None:
        self._number, self._left = int.from_bytes(data, "big"), 8 * len(data)

    def take(self, count: int) -> int:
        """Return the next `count` bits. Raises ValueError if there are not so many."""
        self._left -= count
        return self._number >> self._left & (1 << count) - 1

    def skip(self, count: int) -> None:
        """Leave out the next `count` bits."""
        self._left -= count


def _position(bits: _Bits) -> tuple[int, int]:
    return bits.take(31) - 900_000_000, bits.take(32) - 1_800_000_000


def _long_position(sender: int, time_ns: int, station: Station) -> bytes:
    """Return a long position vector: address with the station type, time, place, speed and heading."""
    kind = station.kind if station.kind <= _MOST_TYPES else 0  # unknown
    address = struct.pack(">BB", kind << 2, 0) + _address(sender)
    milliseconds = time_ns // 1_000_000 % 2**32
    place = struct.pack(">Iii", milliseconds, station.latitude, station.longitude)
    accuracy = 0x8000 if station.is_accurate else 0
    return address + place + struct.pack(">HH", accuracy | min(station.speed, 0x3FFF), station.heading)


LINKTYPE_ETHERNET, LINKTYPE_RADIOTAP = 1, 127
"""Link types of the interfaces: of C-V2X, and of 802.11."""
ETHERTYPE = 0x88B5
"""Ethertype for local experiments."""
_SECTION, _INTERFACE, _PACKET = 0x0A0D0D0A, 1, 6
"""Types of blocks."""
_COMMENT, _NAME, _DESCRIPTION, _APPLICATION, _RESOLUTION, _FLAGS = 1, 2, 3, 4, 9, 2
"""Codes of options."""
_INBOUND, _OUTBOUND = 1, 2
"""Directions of packets."""
_CHANNEL_MHZ = 5900
"""Control channel of ITS-G5."""
_CHANNEL_FLAGS = 0x0040 | 0x0100 | 0x4000
"""OFDM, 5 GHz, half rate: 10 MHz wide."""
_MAX_RATE_MBPS = 127.5
"""Greatest rate in radiotap's field."""
_BROADCAST = b"\xff" * 6
"""Address of all stations, also used as BSSID outside a BSS."""
_QOS_DATA, _ACK, _RETRY = 0x0088, 0x00D4, 0x0800
"""Frame control of QoS data and of acknowledgements, and its retry bit."""
_NO_ACK = 0x0020
"""QoS control of frames that nobody acknowledges."""


@dataclass(frozen=True)
class _Packet:
    """A packet of the capture: interface (number of a vehicle), time, direction, and its row of the trace.

    If it `is_ack` it is the acknowledgement of the frame of that row.
    """

    interface: int
    time_ns: int
    direction: int
    row: int
    is_ack: bool


def write_pcapng(recorded: OpenedRun, file: BinaryIO, as_its: bool = False) -> int:
    """Write a run's frames; return the number of packets.

    With `as_its` payloads that are a CAM or a DENM have the headers of GeoNetworking and BTP. Raises VnetError if
    the run has kept no payloads.
    """
    if as_its:
        if not recorded.scenario.run.keep_payloads:
            raise VnetError(
                "--payloads its: the run has kept no payloads; run it with --set run.keep_payloads=true"
            )
        recorded.required(PAYLOADS)
    routers = Router() if as_its else None
    file.write(_block(_SECTION, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1) + _option(_APPLICATION, b"vnet")))
    headers, comments = _Headers(recorded), _Comments(recorded)
    for node in recorded.node_ids:
        described = _option(_NAME, node.encode()) + _option(_DESCRIPTION, f"vehicle {node}".encode())
        body = struct.pack("<HHI", headers.link_type, 0, 0) + described + _option(_RESOLUTION, b"\x09")
        file.write(_block(_INTERFACE, body))
    columns = [recorded.sender, recorded.seq, recorded.column("size_bytes")]
    count = 0
    for packet in _packets(recorded):
        count += 1
        if packet.is_ack:
            file.write(_packet_block(packet, headers.of_ack(packet.row), b"", 0, comments.of(packet)))
            continue
        sender, seq, size_bytes = (int(column[packet.row]) for column in columns)
        payload = None
        if (kept := recorded.payloads) is not None:
            payload = kept.of(recorded.node_ids[sender], seq, comments.digests(packet))
        ethertype, routed = ETHERTYPE, None
        if routers is not None and payload is not None:
            routed = routers.packet(sender, seq, int(recorded.sent_ns[packet.row]), payload)
        if routed is not None:
            ethertype, payload, size_bytes = GEONETWORKING, routed, len(routed)
        header = headers.of_frame(packet.row, ethertype)
        file.write(_packet_block(packet, header, payload or b"", size_bytes, comments.of(packet)))
    return count


def _packets(recorded: RecordedRun) -> Iterator[_Packet]:
    """Yield all packets in the order of their times."""
    # Of the receptions of a frame one that shows what was sent: the first that no fault has altered.
    rows = np.argsort(recorded.caused_by("corrupt", "custom"), kind="stable")
    sent = rows[np.unique(recorded.emission[rows], return_index=True)[1]]
    # A frame that a fault duplicates at a receiver was sent only once.
    sent = sent[~(recorded.caused_by("duplicate") & (recorded.copy > 0))[sent]]
    delivered = np.flatnonzero(recorded.outcome_is("delivered"))
    left_ns = recorded.sent_ns[sent]
    if recorded.scenario.radio.mac is not None and "on_air_ns" in recorded.trace.column_names:
        on_air_ns = recorded.column("on_air_ns")
        sent = sent[on_air_ns[sent] >= 0]  # others never left their sender
        left_ns = on_air_ns[sent]
    answered = np.flatnonzero(recorded.ack_on_air_ns >= 0)
    acked = answered[recorded.acked[answered]]
    acked_ns = recorded.ack_on_air_ns[acked] + _ack_airtimes_ns(recorded.bitrate_mbps[acked])
    parts = (
        (recorded.sender[sent], left_ns, _OUTBOUND, sent, False),
        (recorded.receiver[delivered], recorded.arrival_ns[delivered], _INBOUND, delivered, False),
        (recorded.receiver[answered], recorded.ack_on_air_ns[answered], _OUTBOUND, answered, True),
        (recorded.sender[acked], acked_ns, _INBOUND, acked, True),
    )
    filled = [[np.broadcast_to(column, len(part[0])) for column in part] for part in parts]
    columns = [np.concatenate(column) for column in zip(*filled, strict=True)]
    order = np.argsort(columns[1], kind="stable")
    for fields in zip(*(column[order].tolist() for column in columns), strict=True):
        yield _Packet(*fields)


def _ack_airtimes_ns(bitrate_mbps: Array) -> IntArray:
    """Return the airtimes (n,) of the acknowledgements of frames at these bit rates."""
    rates, index = np.unique(bitrate_mbps, return_inverse=True)
    return np.array([ack_airtime_ns(rate) for rate in rates.tolist()], np.int64)[index]


class _Comments:
    """The comments of packets: the frame, and the outcomes of its receptions."""

    def __init__(self, recorded: RecordedRun) -> None:
        self._recorded = recorded
        outcome = recorded.trace["outcome"].cast(pa.string())
        self._outcome = np.asarray(outcome.to_numpy(zero_copy_only=False), dtype=np.str_)
        self._cause = recorded.trace["cause"].cast(pa.string()).to_pylist()
        order = np.argsort(recorded.emission, kind="stable")
        self._order = order
        self._emission = recorded.emission[order]

    def of(self, packet: _Packet) -> str:
        """Return a packet's sender, frame number and digest and, if it is outbound, its outcomes."""
        recorded, row = self._recorded, packet.row
        copy = int(recorded.copy[row])
        name = recorded.node_ids[int(recorded.sender[row])]
        text = f"{name} frame {int(recorded.seq[row])}{f', copy {copy}' if copy else ''}"
        if packet.is_ack:
            return f"acknowledgement of {text}"
        attempt = int(recorded.attempt[row])
        text += f"; to {recorded.node_ids[int(recorded.receiver[row])]}, attempt {attempt}" if attempt else ""
        text += f"; payload {int(recorded.digest[row]):016x}"
        text += f"; {self._cause[row]}" if self._cause[row] else ""
        return text if packet.direction == _INBOUND else f"{text}; {self._outcomes(int(recorded.emission[row]))}"

    def digests(self, packet: _Packet) -> list[int]:
        """Return the digest of what a packet's receiver got or, if it is outbound, those of all receivers."""
        rows = (
            [packet.row] if packet.direction == _INBOUND else self._rows(int(self._recorded.emission[packet.row]))
        )
        digests: list[int] = self._recorded.digest[rows].tolist()
        return digests

    def _rows(self, emission: int) -> NDArray[np.intp]:
        first, end = np.searchsorted(self._emission, (emission, emission + 1))
        return self._order[first:end]

    def _outcomes(self, emission: int) -> str:
        outcomes, counts = np.unique(self._outcome[self._rows(emission)], return_counts=True)
        return ", ".join(f"{outcome} {count}" for outcome, count in zip(outcomes, counts.tolist(), strict=True))


def _radiotap(bitrate_mbps: float) -> bytes:
    """Return the radiotap header: flags, rate (if its field can hold it) and channel."""
    has_rate = 0.5 <= bitrate_mbps <= _MAX_RATE_MBPS
    present = 1 << 1 | has_rate << 2 | 1 << 3
    rate = struct.pack("<BB", 0, round(2 * bitrate_mbps)) if has_rate else struct.pack("<Bx", 0)
    fields = rate + struct.pack("<HH", _CHANNEL_MHZ, _CHANNEL_FLAGS)
    return struct.pack("<BxHI", 0, 8 + len(fields), present) + fields


class _Headers:
    """Headers of the packets of a run: radiotap and 802.11, or Ethernet on a sidelink."""

    def __init__(self, recorded: RecordedRun) -> None:
        self._recorded = recorded
        rates = np.unique(recorded.bitrate_mbps).tolist()
        self._radiotaps = {rate: _radiotap(rate) for rate in (*rates, *BASIC_RATES_MBPS)}
        self.link_type = LINKTYPE_RADIOTAP if recorded.scenario.radio.sidelink is None else LINKTYPE_ETHERNET

    def of_frame(self, row: int, ethertype: int) -> bytes:
        """Return the headers of the frame of a row: radiotap, QoS data outside a BSS, LLC, SNAP; or Ethernet."""
        recorded = self._recorded
        if self.link_type == LINKTYPE_ETHERNET:
            return _BROADCAST + _address(int(recorded.sender[row])) + struct.pack(">H", ethertype)
        rate, attempt = float(recorded.bitrate_mbps[row]), int(recorded.attempt[row])
        control, duration_us, receiver, qos = _QOS_DATA, 0, _BROADCAST, _NO_ACK
        if attempt:
            control |= _RETRY if attempt > 1 else 0
            duration_us = -(-(SIFS_NS + ack_airtime_ns(rate)) // 1000)
            receiver, qos = _address(int(recorded.receiver[row])), 0
        mac = struct.pack("<HH", control, duration_us) + receiver + _address(int(recorded.sender[row])) + _BROADCAST
        mac += struct.pack("<HH", (int(recorded.seq[row]) & 0xFFF) << 4, qos)
        return self._radiotaps[rate] + mac + b"\xaa\xaa\x03\x00\x00\x00" + struct.pack(">H", ethertype)

    def of_ack(self, row: int) -> bytes:
        """Return the acknowledgement of the frame of a row, with radiotap."""
        rate = ack_rate_mbps(float(self._recorded.bitrate_mbps[row]))
        return self._radiotaps[rate] + struct.pack("<HH", _ACK, 0) + _address(int(self._recorded.sender[row]))


def _address(number: int) -> bytes:
    """Return the address of a vehicle: locally administered."""
    return b"\x02\x00" + struct.pack(">I", number + 1)


def _packet_block(packet: _Packet, header: bytes, payload: bytes, size_bytes: int, comment: str) -> bytes:
    captured = header + payload
    high, low = divmod(packet.time_ns, 1 << 32)
    fixed = struct.pack("<IIIII", packet.interface, high, low, len(captured), len(header) + size_bytes)
    options = _option(_COMMENT, comment.encode()) + _option(_FLAGS, struct.pack("<I", packet.direction))
    return _block(_PACKET, fixed + _padded(captured) + options)


def _block(kind: int, body: bytes) -> bytes:
    """Return a block: its type, length, body, an option that ends the options, and the length again."""
    body += b"\0\0\0\0"
    length = struct.pack("<I", len(body) + 12)
    return struct.pack("<I", kind) + length + body + length


def _option(code: int, value: bytes) -> bytes:
    return struct.pack("<HH", code, len(value)) + _padded(value)


def _padded(data: bytes) -> bytes:
    return data + b"\0" * (-len(data) % 4)
