"""Export of a run's frames as pcapng, as a capture on every vehicle's radio would have recorded them.

Each vehicle is an interface, with the frames that it sent (outbound, at the time they were enqueued or, with
`[radio.mac]`, went on air) and those delivered to it (inbound, at their arrival). A packet consists of radiotap, a
QoS data frame of 802.11 outside a BSS (as in 802.11p), LLC and SNAP with the ethertype 0x88B5 for local
experiments, and the payload; a CAM or DENM may have the headers and the ethertype that it has on air. Payloads that
the run has not kept, or that a fault has altered, are truncated (captured length < length); the digest is in the
packet's comment. Frames without a node in range have no rows in the trace and are missing. Times are nanoseconds
from the start of the run.

Formats: draft-ietf-opsawg-pcapng; radiotap.org. Link type 127 is 802.11 with radiotap.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from emulator.export import geonetworking
from emulator.export.geonetworking import Router
from emulator.records.recorded_run import OpenedRun, RecordedRun
from vnet.errors import VnetError

LINKTYPE_RADIOTAP = 127
"""Link type of the interfaces: 802.11 with radiotap."""
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


@dataclass(frozen=True)
class _Packet:
    """A packet of the capture: interface (number of a vehicle), time, direction, and its row of the trace."""

    interface: int
    time_ns: int
    direction: int
    row: int


def write_pcapng(recorded: OpenedRun, file: BinaryIO, as_its: bool = False) -> int:
    """Write a run's frames; return the number of packets.

    With `as_its` payloads that are a CAM or a DENM have the headers of GeoNetworking and BTP. Raises VnetError if
    the run has kept no payloads.
    """
    if as_its and recorded.payloads is None:
        raise VnetError("--payloads its: the run has kept no payloads; run it with --set run.keep_payloads=true")
    routers = Router() if as_its else None
    file.write(_block(_SECTION, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1) + _option(_APPLICATION, b"vnet")))
    for node in recorded.node_ids:
        described = _option(_NAME, node.encode()) + _option(_DESCRIPTION, f"vehicle {node}".encode())
        body = struct.pack("<HHI", LINKTYPE_RADIOTAP, 0, 0) + described + _option(_RESOLUTION, b"\x09")
        file.write(_block(_INTERFACE, body))
    radiotaps = {rate: _radiotap(rate) for rate in np.unique(recorded.bitrate_mbps).tolist()}
    comments = _Comments(recorded)
    columns = [recorded.sender, recorded.seq, recorded.column("size_bytes")]
    count = 0
    for packet in _packets(recorded):
        sender, seq, size_bytes = (int(column[packet.row]) for column in columns)
        kept = recorded.payloads
        payload = None
        if kept is not None:
            payload = kept.of(recorded.node_ids[sender], seq, comments.digests(packet))
        ethertype, routed = ETHERTYPE, None
        if routers is not None and payload is not None:
            routed = routers.packet(sender, seq, int(recorded.sent_ns[packet.row]), payload)
        if routed is not None:
            ethertype, payload, size_bytes = geonetworking.ETHERTYPE, routed, len(routed)
        header = radiotaps[float(recorded.bitrate_mbps[packet.row])] + _frame_header(sender, seq, ethertype)
        file.write(_packet_block(packet, header, payload or b"", size_bytes, comments.of(packet)))
        count += 1
    return count


def _packets(recorded: RecordedRun) -> Iterator[_Packet]:
    """Yield all packets in the order of their times."""
    sent = np.unique(recorded.emission, return_index=True)[1]
    # A frame that a fault duplicates at a receiver was sent only once.
    sent = sent[~(recorded.caused_by("duplicate") & (recorded.copy > 0))[sent]]
    delivered = np.flatnonzero(recorded.outcome_is("delivered"))
    row = np.concatenate([sent, delivered])
    interface = np.concatenate([recorded.sender[sent], recorded.receiver[delivered]])
    left_ns = recorded.sent_ns[sent] if recorded.scenario.radio.mac is None else _on_air_ns(recorded, sent)
    time_ns = np.concatenate([left_ns, recorded.arrival_ns[delivered]])
    direction = np.repeat([_OUTBOUND, _INBOUND], [len(sent), len(delivered)])
    order = np.argsort(time_ns, kind="stable")
    columns = (column[order].tolist() for column in (interface, time_ns, direction, row))
    for fields in zip(*columns, strict=True):
        yield _Packet(*fields)


def _on_air_ns(recorded: RecordedRun, rows: NDArray[np.intp]) -> NDArray[np.int64]:
    """Return the times (n,) at which frames went on air; for those that never did, the times they were enqueued."""
    on_air_ns = recorded.column("on_air_ns")[rows]
    return np.where(on_air_ns < 0, recorded.sent_ns[rows], on_air_ns)


class _Comments:
    """The comments of packets: the frame, and the outcomes of its receptions."""

    def __init__(self, recorded: RecordedRun) -> None:
        self._recorded = recorded
        self._outcome = _decoded(recorded.trace["outcome"])
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


def _decoded(column: pa.ChunkedArray) -> NDArray[np.str_]:
    return np.asarray(column.cast(pa.string()).to_numpy(zero_copy_only=False), dtype=np.str_)


def _radiotap(bitrate_mbps: float) -> bytes:
    """Return the radiotap header: flags, rate (if its field can hold it) and channel."""
    has_rate = 0.5 <= bitrate_mbps <= _MAX_RATE_MBPS
    present = 1 << 1 | has_rate << 2 | 1 << 3
    rate = struct.pack("<BB", 0, round(2 * bitrate_mbps)) if has_rate else struct.pack("<Bx", 0)
    fields = rate + struct.pack("<HH", _CHANNEL_MHZ, _CHANNEL_FLAGS)
    return struct.pack("<BxHI", 0, 8 + len(fields), present) + fields


def _frame_header(sender: int, seq: int, ethertype: int) -> bytes:
    """Return a QoS data header from `sender` to all stations, outside a BSS, without acknowledgement; LLC, SNAP."""
    address = b"\x02\x00" + struct.pack(">I", sender + 1)  # locally administered
    control = struct.pack("<HH", 0x0088, 0)
    mac = control + _BROADCAST + address + _BROADCAST + struct.pack("<HH", (seq & 0xFFF) << 4, 0x0020)
    return mac + b"\xaa\xaa\x03\x00\x00\x00" + struct.pack(">H", ethertype)


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
