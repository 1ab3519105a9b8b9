"""Radio and backbone: what a vehicle program sends and receives, what its radio measures of it, and its mailboxes.

The backbone is the wired network among roadside units, as their programs see it. A mailbox holds what waits for a
program to read it: packets of its radio, messages of its backbone, fixes of its receiver.
"""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import Annotated, Any, Generic, NamedTuple, Protocol, TypeVar

from msgspec import Meta, Struct

from vnet.errors import PayloadTooLargeError, shown

T = TypeVar("T")

INBOX_LIMIT = 4096
"""Packets (or fixes) that are kept for a program that does not read them; beyond it the oldest are dropped."""


def number_or_nan(value: Any) -> float:
    """Return a number, numpy's included, as a float; NaN for what is none: texts, booleans, and beyond floats."""
    if isinstance(value, (str, bytes, bytearray, bool)):
        return math.nan
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return math.nan


def checked_payload(call: str, payload: bytes) -> bytes:
    """Return a payload of a `call` as bytes. Raise TypeError for what is not bytes."""
    try:
        return bytes(memoryview(payload))
    except TypeError:
        raise TypeError(
            f"{call}({shown(payload)}): bytes are expected, not {type(payload).__name__}; encode it first, "
            "as with msgpack.packb(…) or text.encode()"
        ) from None


class Waits:
    """The number of tasks that wait at some mailboxes; those of a process that was killed count on."""

    count = 0


class Mailbox(Generic[T]):
    """A bounded queue with one side for the transport (`deliver`) and one for the program.

    `waiting` tells the transport that a task of the program waits here: only then does an arrival wake the node;
    otherwise the program finds the item when it next runs. `refill` is called before the program reads, so that a
    transport may leave items in its own buffer until then (real time).
    `guard` is called before that, and raises where the program may not read. `waits` counts the tasks that wait
    here, with those at others, so that a transport of many mailboxes need not ask each.
    """

    def __init__(self) -> None:
        self.refill: Callable[[], None] = lambda: None
        self.guard: Callable[[], None] = lambda: None
        self.waits = Waits()
        self._items: deque[T] = deque(maxlen=INBOX_LIMIT)
        self._waiters: deque[asyncio.Future[None]] = deque()

    @property
    def awaited(self) -> bool:
        """True if a task may be waiting here; may be read from another thread."""
        return bool(self._waiters)

    @property
    def waiting(self) -> bool:
        """True if a task waits for the next item."""
        for waiter in self._waiters:  # noqa: SIM110 (`any` costs six times as much)
            if not waiter.done():
                return True
        return False

    def deliver(self, items: Sequence[T]) -> None:
        """Append items and wake the waiting tasks."""
        self._items.extend(items)
        for waiter in self._waiters:
            if not waiter.done():
                waiter.set_result(None)

    async def get(self) -> T:
        """Remove and return the oldest item; wait for one if there is none. Cancelling it loses no item."""
        self.guard()
        self.refill()
        while not self._items:
            waiter = asyncio.get_running_loop().create_future()
            self._waiters.append(waiter)
            self.waits.count += 1
            try:
                self.refill()  # again: an item that came before the waiter was visible woke no task
                await waiter
            finally:
                self._waiters.remove(waiter)
                self.waits.count -= 1
        return self._items.popleft()

    def drain(self) -> list[T]:
        """Remove and return all items, oldest first, without waiting."""
        self.guard()
        self.refill()
        items = list(self._items)
        self._items.clear()
        return items


class Packet(Struct, frozen=True, gc=False):  # made six times as fast as a dataclass; a run has millions
    """One received frame. Times are emulated nanoseconds from the start of the run.

    `rssi_dbm` is the received power, and `snr_db` its ratio to noise and interference, averaged over the payload;
    both are rounded to 0.01 dB. They are None where the scenario has no path loss.
    """

    sender: str
    sent_ns: int
    received_ns: int
    payload: bytes
    rssi_dbm: float | None = None
    snr_db: float | None = None

    def __hash__(self) -> int:  # that of msgspec, and of None before Python 3.12, differ from process to process
        return hash((self.sender, self.sent_ns, self.received_ns, self.payload))


class RadioAbilities(NamedTuple):
    """Limits of a choice for a frame: the largest power in dBm, or None, and the bit rates in Mbit/s.

    `acknowledges` says that there is a MAC that acknowledges frames to a single vehicle. `periods_ms` are the
    intervals with which the radio can reserve resources; none if it reserves nothing.
    """

    max_power_dbm: float | None = None
    rates_mbps: Sequence[float] = ()
    acknowledges: bool = False
    periods_ms: Sequence[float] = ()


class SentFrame(Struct, frozen=True, array_like=True):
    """One frame that `node` enqueues, with the scenario's power and bit rate where it has none of its own.

    It is a broadcast, or addressed `to` one node; then `number` counts such frames of the sender, and its result
    names it. `period_ms` is the interval in which the program will send, for a radio that reserves resources.
    """

    node: str
    payload: bytes
    power_dbm: float | None = None
    rate_mbps: float | None = None
    to: str | None = None
    number: Annotated[int, Meta(ge=0, le=2**62)] = 0
    period_ms: float | None = None


class SendResult(NamedTuple):
    """Result of `Radio.send`, as the sender knows it.

    `delivered` says that an acknowledgement came; without one the frame may have been received all the same.
    `attempts` is how often the frame was transmitted: 0 if it never left its sender.
    """

    delivered: bool
    attempts: int


class RadioTransport(Protocol):
    """Interface of a radio to the process that hosts its node."""

    def send_frame(self, frame: SentFrame) -> None:
        """Enqueue a frame at the emulated radio, at the present time."""
        ...

    def busy_ratio(self, node: str) -> float | None:
        """Return the channel busy ratio that `node` knows now; None if no medium is shared."""
        ...


MIN_POWER_DBM = -100.0
"""Least transmit power that a frame can have."""
NO_ABILITIES = RadioAbilities()
"""A radio with which nothing can be chosen."""


class Radio:
    """The vehicle's radio: sends broadcasts to all nodes in range or frames to one, and receives theirs.

    Attributes:
        max_payload: largest payload of a frame in bytes.
        max_power_dbm: largest transmit power in dBm, which is the default; None where the radio has no powers.
        rates_mbps: bit rates in Mbit/s that a frame may have; none where they cannot be chosen.
        acknowledges: whether frames to a single vehicle are acknowledged, as `send` needs it.
        periods_ms: intervals that a reservation of the radio may have; none where it reserves nothing.
    """

    def __init__(
        self, node_id: str, transport: RadioTransport, max_payload: int, abilities: RadioAbilities = NO_ABILITIES
    ) -> None:
        self.max_payload = max_payload
        self.max_power_dbm = abilities.max_power_dbm
        self.rates_mbps = tuple(abilities.rates_mbps)
        self.inbox: Mailbox[Packet] = Mailbox()
        self.acknowledges = abilities.acknowledges
        self.periods_ms = tuple(abilities.periods_ms)
        self._next_send = 0
        self._sends: dict[int, asyncio.Future[SendResult]] = {}
        self._unknown: set[int] = set()
        """Numbers of the frames whose results have not come, also if nobody waits for them."""
        self._node_id = node_id
        self._transport = transport

    async def broadcast(
        self,
        payload: bytes,
        *,
        power_dbm: float | None = None,
        rate_mbps: float | None = None,
        period_ms: float | None = None,
    ) -> None:
        """Send one frame to all nodes in range, with the scenario's power and bit rate or others.

        `power_dbm` is at most `max_power_dbm`, and `rate_mbps` one of `rates_mbps`. Less power reaches less far; a
        higher rate keeps the medium busy for a shorter time, but needs a better signal. `period_ms` is the interval
        in which such frames follow: a radio that reserves resources (`periods_ms`) learns it from the frames if it
        is not told, and others ignore it.

        Raise `PayloadTooLargeError` above `max_payload` bytes, TypeError for what is not bytes, and ValueError for
        a power, a rate or a period that the radio does not have.
        """
        power_dbm = self._checked_power("broadcast", power_dbm)
        rate_mbps = self._checked_rate("broadcast", rate_mbps)
        period_ms = self._checked_period("broadcast", period_ms)
        content = self._checked_payload("broadcast", payload)
        self._transport.send_frame(SentFrame(self._node_id, content, power_dbm, rate_mbps, period_ms=period_ms))

    async def send(
        self, to: str, payload: bytes, *, power_dbm: float | None = None, rate_mbps: float | None = None
    ) -> SendResult:
        """Send a frame to the vehicle `to` alone, and return whether it was acknowledged.

        The frame is transmitted again until an acknowledgement comes, up to 7 times in all. The result comes one
        `radio.latency_ms` after the sender's MAC knows it. Cancelling the call stops no transmission. The other
        arguments and exceptions are those of `broadcast`; raise ValueError also without `[radio.mac]` of 802.11p,
        and for a `to` that is no text, or the vehicle's own name. A name that no vehicle has is not acknowledged,
        with 0 attempts.
        """
        if not self.acknowledges:
            raise ValueError(
                f"send({shown(to)}, …): only with [radio.mac] of 802.11p a frame is acknowledged; use broadcast()"
            )
        is_text = isinstance(to, str) and to.encode(errors="ignore").decode() == to  # UTF-8: no lone surrogates
        if not is_text or to == self._node_id:
            raise ValueError(f"send({shown(to)}, …): the name of another vehicle is expected")
        content = self._checked_payload("send", payload)
        power_dbm, rate_mbps = self._checked_power("send", power_dbm), self._checked_rate("send", rate_mbps)
        number, self._next_send = self._next_send, self._next_send + 1
        result: asyncio.Future[SendResult] = asyncio.get_running_loop().create_future()
        self._sends[number] = result
        self._unknown.add(number)
        try:
            self._transport.send_frame(SentFrame(self._node_id, content, power_dbm, rate_mbps, to, number))
            return await result
        finally:
            self._sends.pop(number, None)

    @property
    def is_sending(self) -> bool:
        """True if the result of a `send` is still to come, also of one that has been cancelled."""
        return bool(self._unknown)

    def forget_results(self) -> None:
        """Expect no more results: the program is over, and nobody is told them."""
        self._unknown.clear()

    def settle(self, number: int, result: SendResult) -> None:
        """Give the call of `send` with this number its result, if it still waits for one."""
        self._unknown.discard(number)
        waiting = self._sends.get(number)
        if waiting is not None and not waiting.done():
            waiting.set_result(result)

    def _checked_payload(self, call: str, payload: bytes) -> bytes:
        """Return a payload as bytes. Raise TypeError for what is not bytes, and PayloadTooLargeError."""
        content = checked_payload(call, payload)
        if len(content) > self.max_payload:
            raise PayloadTooLargeError(len(content), self.max_payload)
        return content

    def _checked_power(self, call: str, power_dbm: float | None) -> float | None:
        """Return a power as a float. Raise ValueError for one that the radio does not have."""
        if power_dbm is None:
            return None
        if self.max_power_dbm is None:
            raise ValueError(
                f"{call}(power_dbm={shown(power_dbm)}): only with [radio.path_loss] a frame has a power"
            )
        number = number_or_nan(power_dbm)
        if not MIN_POWER_DBM <= number <= self.max_power_dbm:
            text = f"{MIN_POWER_DBM:g} to {self.max_power_dbm:g} dBm; radio.path_loss.tx_power_dbm is the largest"
            raise ValueError(f"{call}(power_dbm={shown(power_dbm)}): allowed are {text}")
        return number

    def _checked_rate(self, call: str, rate_mbps: float | None) -> float | None:
        """Return a bit rate as a float. Raise ValueError for one that the radio does not have."""
        if rate_mbps is None:
            return None
        if not self.rates_mbps:
            text = "only with 802.11p, and [radio.path_loss] or [radio.mac], a frame has a rate"
            raise ValueError(f"{call}(rate_mbps={shown(rate_mbps)}): {text}")
        number = number_or_nan(rate_mbps)
        if number not in self.rates_mbps:
            rates = ", ".join(f"{rate:g}" for rate in self.rates_mbps)
            raise ValueError(f"{call}(rate_mbps={shown(rate_mbps)}): 802.11p has {rates}")
        return number

    def _checked_period(self, call: str, period_ms: float | None) -> float | None:
        """Return a period as a float, None if the radio reserves nothing. Raise ValueError for one that is none."""
        if period_ms is None:
            return None
        number = number_or_nan(period_ms)
        if not self.periods_ms:
            if not 0 < number < math.inf:
                raise ValueError(f"{call}(period_ms={shown(period_ms)}): a number above 0 is needed")
            return None
        if number not in self.periods_ms:
            short = [f"{each:g}" for each in self.periods_ms if each < 100]
            text = ", ".join(short) if len(short) < 5 else f"{short[0]} to {short[-1]}"
            raise ValueError(f"{call}(period_ms={shown(period_ms)}): allowed are {text}, 100, 200, … 1000 ms")
        return number

    @property
    def busy_ratio(self) -> float | None:
        """Channel busy ratio: the share of 100 ms in which this vehicle's medium was busy (ETSI TS 102 687).

        The medium is busy while the vehicle transmits, or senses `radio.mac.carrier_sense_dbm` or more; of a
        sidelink it is the share of subchannels with `radio.mac.busy_dbm` or more. The 100 ms end at the last
        multiple of 10 ms that is at least `radio.latency_ms` past (of a sidelink, and `radio.mac.t1_slots`). In
        real time the value is as old as the emulator's last message. None where the scenario has no `[radio.mac]`.
        """
        self.inbox.refill()
        return self._transport.busy_ratio(self._node_id)

    def drain(self) -> list[Packet]:
        """Return all packets received since the last call, oldest first, without waiting."""
        return self.inbox.drain()

    async def receive(self) -> Packet:
        """Return the next packet; wait for one if there is none."""
        return await self.inbox.get()

    def __aiter__(self) -> Radio:
        return self

    async def __anext__(self) -> Packet:
        return await self.inbox.get()


class BackboneMessage(NamedTuple):
    """A message of another roadside unit. Times are emulated nanoseconds from the start of the run."""

    sender: str
    sent_ns: int
    received_ns: int
    payload: bytes


class UnitAbilities(NamedTuple):
    """Position of a roadside unit in m, names of the other units, and largest message in bytes."""

    position_m: tuple[float, float]
    peers: Sequence[str] = ()
    max_message_bytes: int = 0


class BackboneTransport(Protocol):
    """Interface of a backbone to the process that hosts its node."""

    def send_message(self, node: str, to: str | None, payload: bytes) -> None:
        """Enqueue a message of `node` to one unit, or to all others, at the present time."""
        ...


class Backbone:
    """The roadside unit's end of the backbone: sends to other units, and receives their messages.

    Attributes:
        peers: names of the other units.
        max_message: largest payload of a message in bytes.
    """

    def __init__(self, node_id: str, transport: BackboneTransport, peers: Sequence[str], max_message: int) -> None:
        self.peers = tuple(peers)
        self.max_message = max_message
        self.inbox: Mailbox[BackboneMessage] = Mailbox()
        self._node_id = node_id
        self._transport = transport

    async def send(self, to: str, payload: bytes) -> None:
        """Send a message to the unit `to`. Messages between two units arrive in the order in which they were sent.

        Raise `PayloadTooLargeError` above `max_message` bytes, TypeError for what is not bytes, and ValueError for
        a `to` that is none of the `peers`.
        """
        if to not in self.peers:
            allowed = f"one of {', '.join(self.peers)} is expected" if self.peers else "there is no other unit"
            raise ValueError(f"backbone.send({shown(to)}, …): {allowed}")
        self._transport.send_message(self._node_id, to, self._checked("send", payload))

    async def broadcast(self, payload: bytes) -> None:
        """Send a message to all other units. The exceptions are those of `send`."""
        self._transport.send_message(self._node_id, None, self._checked("broadcast", payload))

    def _checked(self, call: str, payload: bytes) -> bytes:
        content = checked_payload(f"backbone.{call}", payload)
        if len(content) > self.max_message:
            raise PayloadTooLargeError(len(content), self.max_message, "backbone.max_message_bytes")
        return content

    def drain(self) -> list[BackboneMessage]:
        """Return all messages received since the last call, oldest first, without waiting."""
        return self.inbox.drain()

    async def receive(self) -> BackboneMessage:
        """Return the next message; wait for one if there is none."""
        return await self.inbox.get()

    def __aiter__(self) -> Backbone:
        return self

    async def __anext__(self) -> BackboneMessage:
        return await self.inbox.get()
