"""The frames of a run as pcapng: what a capture on every vehicle's radio would have seen.

Each vehicle is an interface, with the frames that it sent (outbound, when it handed them over or, where senders
share a medium, when they went on air) and those that reached it (inbound, when they arrived). A packet is radiotap,
a QoS data frame of 802.11 outside every BSS (as 802.11p sends), LLC and SNAP with the ethertype for local
experiments 0x88B5, and then the payload, which a run does not keep: it is cut off (captured length < length), and
its digest is in the packet's comment. Frames that had nobody in range have no trace and are not in it. Times count
from the start of the run, in nanoseconds.

The format: draft-ietf-opsawg-pcapng. Radiotap: radiotap.org. Interface type 127 is 802.11 with radiotap.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from emulator.records.recorded_run import RecordedRun

LINKTYPE_RADIOTAP = 127
ETHERTYPE = 0x88B5
_SECTION, _INTERFACE, _PACKET = 0x0A0D0D0A, 1, 6
_COMMENT, _NAME, _DESCRIPTION, _APPLICATION, _RESOLUTION, _FLAGS = 1, 2, 3, 4, 9, 2
_INBOUND, _OUTBOUND = 1, 2
_CHANNEL_MHZ = 5900
"""Control channel of ITS-G5."""
_CHANNEL_FLAGS = 0x0040 | 0x0100 | 0x4000
"""OFDM, 5 GHz, half rate: 10 MHz wide."""
_FASTEST_MBPS = 127.5
"""What radiotap's field of the rate can say."""
_BROADCAST = b"\xff" * 6


@dataclass(frozen=True)
class _Packet:
    """One packet of the capture: on whose interface, when, which way, and which row of the trace tells of it."""

    interface: int
    time_ns: int
    direction: int
    row: int


def write_pcapng(recorded: RecordedRun, file: BinaryIO) -> int:
    """Write a run's frames; returns how many packets these are."""
    file.write(_block(_SECTION, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1) + _option(_APPLICATION, b"vnet")))
    for node in recorded.node_ids:
        described = _option(_NAME, node.encode()) + _option(_DESCRIPTION, f"vehicle {node}".encode())
        body = struct.pack("<HHI", LINKTYPE_RADIOTAP, 0, 0) + described + _option(_RESOLUTION, b"\x09")
        file.write(_block(_INTERFACE, body))
    radiotap = _radiotap(recorded.scenario.radio.bitrate_mbps)
    fates = _Fates(recorded)
    columns = [recorded.sender, recorded.seq, recorded.column("size_bytes")]
    count = 0
    for packet in _packets(recorded):
        sender, seq, size_bytes = (int(column[packet.row]) for column in columns)
        header = radiotap + _frame_header(sender, seq)
        file.write(_packet_block(packet, header, size_bytes, fates.comment(packet)))
        count += 1
    return count


def _packets(recorded: RecordedRun) -> Iterator[_Packet]:
    """All packets in the order of their times."""
    sent = np.unique(recorded.emission, return_index=True)[1]
    # What arrives once more on its way to one receiver was sent once.
    sent = sent[~(recorded.caused_by("duplicate") & (recorded.copy > 0))[sent]]
    heard = np.flatnonzero(recorded.outcome_is("delivered"))
    row = np.concatenate([sent, heard])
    interface = np.concatenate([recorded.sender[sent], recorded.receiver[heard]])
    left_ns = recorded.sent_ns[sent] if recorded.scenario.radio.mac is None else _on_air_ns(recorded, sent)
    time_ns = np.concatenate([left_ns, recorded.arrival_ns[heard]])
    direction = np.repeat([_OUTBOUND, _INBOUND], [len(sent), len(heard)])
    order = np.argsort(time_ns, kind="stable")
    columns = (column[order].tolist() for column in (interface, time_ns, direction, row))
    for fields in zip(*columns, strict=True):
        yield _Packet(*fields)


def _on_air_ns(recorded: RecordedRun, rows: NDArray[np.intp]) -> NDArray[np.int64]:
    """When these frames went on the air that all share; those that never did, when they were handed over."""
    on_air_ns = recorded.column("on_air_ns")[rows]
    return np.where(on_air_ns < 0, recorded.sent_ns[rows], on_air_ns)


class _Fates:
    """What is said of packets in their comments."""

    def __init__(self, recorded: RecordedRun) -> None:
        self._evidence = recorded
        self._outcome = _decoded(recorded.trace["outcome"])
        self._cause = recorded.trace["cause"].cast(pa.string()).to_pylist()
        order = np.argsort(recorded.emission, kind="stable")
        self._order = order
        self._emission = recorded.emission[order]

    def comment(self, packet: _Packet) -> str:
        """Whose frame it is and, for one that is sent, what became of it."""
        recorded, row = self._evidence, packet.row
        copy = int(recorded.copy[row])
        name = recorded.node_ids[int(recorded.sender[row])]
        text = f"{name} frame {int(recorded.seq[row])}{f', copy {copy}' if copy else ''}"
        text += f"; payload {int(recorded.digest[row]):016x}"
        text += f"; {self._cause[row]}" if self._cause[row] else ""
        return text if packet.direction == _INBOUND else f"{text}; {self._became(int(recorded.emission[row]))}"

    def _became(self, emission: int) -> str:
        first, end = np.searchsorted(self._emission, (emission, emission + 1))
        outcomes, counts = np.unique(self._outcome[self._order[first:end]], return_counts=True)
        return ", ".join(f"{outcome} {count}" for outcome, count in zip(outcomes, counts.tolist(), strict=True))


def _decoded(column: pa.ChunkedArray) -> NDArray[np.str_]:
    return np.asarray(column.cast(pa.string()).to_numpy(zero_copy_only=False), dtype=np.str_)


def _radiotap(bitrate_mbps: float) -> bytes:
    """The header that says how the frame was sent: flags, rate if it can be said, channel."""
    has_rate = 0.5 <= bitrate_mbps <= _FASTEST_MBPS
    present = 1 << 1 | has_rate << 2 | 1 << 3
    rate = struct.pack("<BB", 0, round(2 * bitrate_mbps)) if has_rate else struct.pack("<Bx", 0)
    fields = rate + struct.pack("<HH", _CHANNEL_MHZ, _CHANNEL_FLAGS)
    return struct.pack("<BxHI", 0, 8 + len(fields), present) + fields


def _frame_header(sender: int, seq: int) -> bytes:
    """QoS data from `sender` to all, outside every BSS, without acknowledgement; LLC and SNAP."""
    address = b"\x02\x00" + struct.pack(">I", sender + 1)  # locally administered
    control = struct.pack("<HH", 0x0088, 0)
    mac = control + _BROADCAST + address + _BROADCAST + struct.pack("<HH", (seq & 0xFFF) << 4, 0x0020)
    return mac + b"\xaa\xaa\x03\x00\x00\x00" + struct.pack(">H", ETHERTYPE)


def _packet_block(packet: _Packet, header: bytes, size_bytes: int, comment: str) -> bytes:
    high, low = divmod(packet.time_ns, 1 << 32)
    fixed = struct.pack("<IIIII", packet.interface, high, low, len(header), len(header) + size_bytes)
    options = _option(_COMMENT, comment.encode()) + _option(_FLAGS, struct.pack("<I", packet.direction))
    return _block(_PACKET, fixed + _padded(header) + options)


def _block(kind: int, body: bytes) -> bytes:
    """A block: its kind, its length, what is in it and its length again. Options end with an empty one."""
    body += b"\0\0\0\0"
    length = struct.pack("<I", len(body) + 12)
    return struct.pack("<I", kind) + length + body + length


def _option(code: int, value: bytes) -> bytes:
    return struct.pack("<HH", code, len(value)) + _padded(value)


def _padded(data: bytes) -> bytes:
    return data + b"\0" * (-len(data) % 4)
