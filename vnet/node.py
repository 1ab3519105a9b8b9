"""Node: all that a vehicle program sees of its vehicle and its network.

A program is `async def main(node: Node) -> None`. It hears the radio, its own GNSS receiver and its clock,
and reports what it believes. Where the packets come from (lockstep, real time, one process or fifty) is the
business of the `NodeTransport` behind it; the program cannot tell.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from vnet.errors import PayloadTooLargeError
from vnet.roads.lanes import LaneMap
from vnet.roads.road_map import RoadMap
from vnet.types import Array

T = TypeVar("T")

INBOX_LIMIT = 4096
"""Packets (or fixes) that a node keeps for a program that does not read them; the oldest go first."""


@dataclass(frozen=True, slots=True)
class Packet:
    """One received broadcast. Times are emulated nanoseconds from the start of the run."""

    sender: str
    sent_ns: int
    received_ns: int
    payload: bytes


@dataclass(frozen=True, slots=True)
class Fix:
    """One GNSS fix: position (2,) in m east-north, covariance (2, 2) in m², heading in radians or None.

    The covariance is that of the receiver's own noise; the error common to the area is not in it.
    """

    time_ns: int
    position_m: Array
    covariance_m2: Array
    heading_rad: float | None


@dataclass(frozen=True, slots=True)
class Report:
    """What a program believes at one instant; see `Node.report`."""

    time_ns: int
    node: str
    estimate_m: tuple[float, float] | None
    covariance_m2: tuple[float, float, float, float] | None
    values: dict[str, float | list[float]] = field(default_factory=dict)


class NodeTransport(Protocol):
    """What a node needs of the process that hosts it."""

    def now_ns(self, node: str) -> int:
        """Emulated time in nanoseconds, by the clock of `node`."""
        ...

    def send_frame(self, node: str, payload: bytes) -> None:
        """Hand a frame to the emulated radio at this instant."""
        ...

    def send_report(self, report: Report) -> None:
        """Hand a report to the emulator's metrics."""
        ...


class Mailbox(Generic[T]):
    """A bounded queue with one side for the link (`deliver`) and one for the program.

    `waiting` tells the link whether a task of the program is waiting here: only then is a node woken by
    what arrives; otherwise it finds it at its next wake-up. `refill` is called before the program looks, so that
    a link may leave what nobody waits for where it is (real time).
    """

    def __init__(self) -> None:
        self.refill: Callable[[], None] = lambda: None
        self._items: deque[T] = deque(maxlen=INBOX_LIMIT)
        self._waiters: deque[asyncio.Future[None]] = deque()

    @property
    def awaited(self) -> bool:
        """Whether a task may be waiting here; safe to ask from another thread."""
        return bool(self._waiters)

    @property
    def waiting(self) -> bool:
        """Whether a task waits for the next item."""
        return any(not waiter.done() for waiter in self._waiters)

    def deliver(self, items: Sequence[T]) -> None:
        """Append items and wake those who wait."""
        self._items.extend(items)
        for waiter in self._waiters:
            if not waiter.done():
                waiter.set_result(None)

    async def get(self) -> T:
        """The oldest item; waits for one if there is none. Safe to cancel: nothing is lost."""
        self.refill()
        while not self._items:
            waiter = asyncio.get_running_loop().create_future()
            self._waiters.append(waiter)
            try:
                self.refill()  # once more: what came before the waiter could be seen has woken nobody
                await waiter
            finally:
                self._waiters.remove(waiter)
        return self._items.popleft()

    def drain(self) -> list[T]:
        """All items, oldest first, without waiting."""
        self.refill()
        items = list(self._items)
        self._items.clear()
        return items


class Radio:
    """The vehicle's radio: broadcast to whoever is in range, hear whoever was.

    Attributes:
        max_payload: the most bytes of a frame.
    """

    def __init__(self, node_id: str, transport: NodeTransport, max_payload: int) -> None:
        self.max_payload = max_payload
        self.inbox: Mailbox[Packet] = Mailbox()
        self._node_id = node_id
        self._transport = transport

    async def broadcast(self, payload: bytes) -> None:
        """Send one frame to all in range. Raises `PayloadTooLargeError` above `max_payload` bytes."""
        if len(payload) > self.max_payload:
            raise PayloadTooLargeError(len(payload), self.max_payload)
        self._transport.send_frame(self._node_id, bytes(payload))

    def drain(self) -> list[Packet]:
        """All packets heard since the last look, oldest first, without waiting."""
        return self.inbox.drain()

    async def receive(self) -> Packet:
        """The next packet; waits for one if there is none."""
        return await self.inbox.get()

    def __aiter__(self) -> Radio:
        return self

    async def __anext__(self) -> Packet:
        return await self.inbox.get()


class GnssReceiver:
    """The vehicle's GNSS receiver: `async for fix in node.gnss`."""

    def __init__(self) -> None:
        self.inbox: Mailbox[Fix] = Mailbox()

    def drain(self) -> list[Fix]:
        """All fixes since the last look, oldest first, without waiting."""
        return self.inbox.drain()

    async def receive(self) -> Fix:
        """The next fix; waits for one if there is none."""
        return await self.inbox.get()

    def __aiter__(self) -> GnssReceiver:
        return self

    async def __anext__(self) -> Fix:
        return await self.inbox.get()


class Node:
    """One vehicle as its program sees it.

    Attributes:
        id: the node's name.
        radio: broadcast, receive, drain.
        gnss: the fixes of the vehicle's own receiver.
        map: the lanes of the area, unlabelled.
        rng: a generator from a seed of this node's own (and of this incarnation), which says nothing about
            the world's; the only source of randomness that replays.
        options: the scenario's `[program.options]`.
        period_ns: time between two fixes.
        incarnation: 0, and one more after each restart.
    """

    def __init__(
        self,
        node_id: str,
        transport: NodeTransport,
        *,
        lane_map: LaneMap | RoadMap,
        seed: int,
        options: Mapping[str, Any],
        period_ns: int,
        max_payload: int,
        incarnation: int = 0,
    ) -> None:
        self.id = node_id
        self.radio = Radio(node_id, transport, max_payload)
        self.gnss = GnssReceiver()
        self.map = lane_map
        self.rng = np.random.default_rng(seed)
        self.options = options
        self.period_ns = period_ns
        self.incarnation = incarnation
        self._transport = transport

    @property
    def now_ns(self) -> int:
        """Emulated nanoseconds since the start of the run, by the vehicle's own clock."""
        return self._transport.now_ns(self.id)

    def disconnect(self) -> None:
        """Cut what is left of the program off from the world: the vehicle's process is gone."""
        self._transport = self.radio._transport = _Disconnected(self.now_ns)

    def report(
        self,
        estimate_m: ArrayLike | None = None,
        covariance_m2: ArrayLike | None = None,
        **values: ArrayLike,
    ) -> None:
        """Say what the program believes now: its position (2,) in m, covariance (2, 2) in m², and more.

        Any further keyword is a number or an array of numbers; the emulator's metrics know
        `common_error_m` (2,), `common_error_covariance_m2` (2, 2), `mean_m` (2,) (the consensus),
        `stacked_common_error_m` (2,) and `cloud_m` (n, 2); `heard` is how many packets came since the last report,
        which is held against the trace. Raises ValueError on a wrong shape or on something
        that is not a number.
        """
        estimate = None if estimate_m is None else _floats("estimate_m", estimate_m, 2)
        covariance = None if covariance_m2 is None else _floats("covariance_m2", covariance_m2, 4)
        named = {name: _value(name, value) for name, value in values.items()}
        self._transport.send_report(
            Report(
                self.now_ns,
                self.id,
                None if estimate is None else (estimate[0], estimate[1]),
                None if covariance is None else (covariance[0], covariance[1], covariance[2], covariance[3]),
                named,
            )
        )


class _Disconnected:
    """The link of a node whose process is gone: nothing that it still does reaches anybody."""

    def __init__(self, now_ns: int) -> None:
        self._now_ns = now_ns

    def now_ns(self, node: str) -> int:
        return self._now_ns

    def send_frame(self, node: str, payload: bytes) -> None:
        pass

    def send_report(self, report: Report) -> None:
        pass


def _floats(name: str, value: ArrayLike, size: int | None = None) -> list[float]:
    try:
        flat: list[float] = np.asarray(value, dtype=float).ravel().tolist()
    except (TypeError, ValueError):
        raise ValueError(f"report({name}={value!r}): numbers are expected") from None
    if size is not None and len(flat) != size:
        raise ValueError(f"report({name}=…): {len(flat)} numbers given, {size} expected")
    return flat


def _value(name: str, value: ArrayLike) -> float | list[float]:
    flat = _floats(name, value)
    return flat[0] if np.ndim(value) == 0 else flat
