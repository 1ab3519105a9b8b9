"""Hazard warnings, forwarded by contention or by flooding: docs/how-to/worked-example.md.

Vehicle number `source` sends a warning every `interval_s`. With `forwarding = "flooding"` each vehicle forwards a
warning at once when it receives it for the first time. With `"cbf"` (contention-based forwarding, in the manner of
ETSI EN 302 636-4-1) it first waits, for less time the further it is from the sender, and drops its copy if it
overhears another one meanwhile.
"""

from __future__ import annotations

import asyncio
from typing import Literal

import msgspec
import numpy as np

from vnet import Node, Packet
from vnet.types import Array

MIN_WAIT_MS = 1.0
"""TO_MIN of the standard: the wait of a receiver at the edge of the range."""
MAX_WAIT_MS = 100.0
"""TO_MAX of the standard: the wait of a receiver right beside the sender."""
PAYLOAD_BYTES = 300
"""Length of a frame: a warning with the headers of GeoNetworking and a signature."""
OFFSET_NS = 50_000_000
"""Time of the first warning: between two fixes, so that vehicles know where they are."""


class Options(msgspec.Struct, forbid_unknown_fields=True):
    """The program's options: `[program.options]`."""

    forwarding: Literal["cbf", "flooding"] = "cbf"
    source: int = 1
    """Number of the vehicle that warns: 1 is v01, or v001 in a network of a hundred."""
    interval_s: float = 1.0
    range_m: float = 1000.0
    """Distance from which a receiver waits `MIN_WAIT_MS`: DIST_MAX of the standard."""


class Hazard(msgspec.Struct, array_like=True, tag="hazard", forbid_unknown_fields=True):
    """Content of a frame: number and time of the warning, and the position in m of the sender of this frame."""

    number: int
    since_ns: int
    sender_m: tuple[float, float]
    padding: bytes = b""


def encode(warning: Hazard) -> bytes:
    """Return a warning as a payload of `PAYLOAD_BYTES`."""
    missing = PAYLOAD_BYTES - len(msgspec.msgpack.encode(warning)) - 1  # a longer padding has a length of two bytes
    return msgspec.msgpack.encode(msgspec.structs.replace(warning, padding=bytes(missing)))


def decode(payload: bytes) -> Hazard | None:
    """Return a payload as a warning; None for anything else that the radio may bring."""
    try:
        warning = msgspec.msgpack.decode(payload, type=Hazard)
    except msgspec.MsgspecError:
        return None
    return warning if np.isfinite(warning.sender_m).all() else None


def wait_s(distance_m: float, range_m: float) -> float:
    """Return the wait in s before forwarding, at a distance in m from the sender."""
    share = min(distance_m / range_m, 1.0)
    return (MAX_WAIT_MS + (MIN_WAIT_MS - MAX_WAIT_MS) * share) / 1e3


class Forwarder:
    """The warnings that one vehicle knows, waits to forward, and has forwarded."""

    def __init__(self, node: Node, options: Options) -> None:
        self._node = node
        self._options = options
        self._interval_ns = round(options.interval_s * 1e9)
        self._position_m: Array | None = None
        self._delay_ms: dict[int, float] = {}
        self._waiting: dict[int, asyncio.Task[None]] = {}
        self._sent = 0
        self._duplicates = 0

    async def warn(self) -> None:
        """Send a warning every `interval_s`; a source that has restarted goes on with the next one."""
        while True:
            number = self._due()
            await asyncio.sleep((OFFSET_NS + number * self._interval_ns - self._node.now_ns) / 1e9)
            self._delay_ms[number] = 0.0
            self._node.event("warned", number=number)
            await self._send(number, self._node.now_ns)

    async def listen(self) -> None:
        """Take in packets as they arrive, and forward what is new."""
        async with asyncio.TaskGroup() as tasks:
            async for packet in self._node.radio:
                warning = decode(packet.payload)
                if warning is None:
                    continue
                if warning.number in self._delay_ms:
                    self._duplicates += 1
                    if waiting := self._waiting.pop(warning.number, None):
                        waiting.cancel()
                    continue
                self._learn(warning, packet)
                self._waiting[warning.number] = tasks.create_task(self._forward(warning))

    async def follow(self) -> None:
        """Take in fixes, and report at each of them."""
        async for fix in self._node.gnss:
            self._position_m = fix.position_m
            values: dict[str, float] = {}
            if due := self._due():
                values["informed"] = len(self._delay_ms) / due
                values["frames"] = self._sent / due
                values["duplicates"] = self._duplicates / due
            if delays_ms := [delay_ms for delay_ms in self._delay_ms.values() if delay_ms]:
                values["delay_ms"] = float(np.mean(delays_ms))
            self._node.report(fix.position_m, fix.covariance_m2, **values)

    def _due(self) -> int:
        """Return how many warnings the source should have sent by now."""
        return (self._node.now_ns - OFFSET_NS) // self._interval_ns + 1

    def _learn(self, warning: Hazard, packet: Packet) -> None:
        delay_ms = (packet.received_ns - warning.since_ns) / 1e6
        self._delay_ms[warning.number] = delay_ms
        self._node.event("informed", number=warning.number, delay_ms=delay_ms)

    async def _forward(self, warning: Hazard) -> None:
        """Forward a warning, by contention after a wait in which another's copy cancels this task."""
        if self._options.forwarding == "cbf":
            distance_m = 0.0  # without a fix, the standard has a vehicle wait longest
            if self._position_m is not None:
                distance_m = float(np.linalg.norm(self._position_m - np.array(warning.sender_m)))
            await asyncio.sleep(wait_s(distance_m, self._options.range_m))
        self._waiting.pop(warning.number, None)
        await self._send(warning.number, warning.since_ns)

    async def _send(self, number: int, since_ns: int) -> None:
        east_m, north_m = (0.0, 0.0) if self._position_m is None else self._position_m.tolist()
        self._sent += 1
        await self._node.radio.broadcast(encode(Hazard(number, since_ns, (east_m, north_m))))


async def main(node: Node) -> None:
    """Warn if this is the source; forward the warnings of others; report at each fix."""
    options = msgspec.convert(node.options, Options)
    forwarder = Forwarder(node, options)
    async with asyncio.TaskGroup() as tasks:
        tasks.create_task(forwarder.follow())
        tasks.create_task(forwarder.listen())
        if node.id.lstrip("v0") == str(options.source):
            tasks.create_task(forwarder.warn())
