"""Node: everything that a vehicle program sees of its vehicle and its network.

A program is `async def main(node: Node) -> None`. It has a radio, a GNSS receiver and a clock, and reports its
estimates. The source of the packets (lockstep or real time, one process or fifty) is hidden behind the
`NodeTransport`: the program is the same in all.
"""

from __future__ import annotations

import asyncio
import math
import sys
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Generic, Protocol, TypeVar

import numpy as np
from msgspec import Meta
from numpy.typing import ArrayLike

from vnet.errors import PayloadTooLargeError, shown
from vnet.roads.lanes import LaneMap
from vnet.roads.road_map import RoadMap
from vnet.types import Array

T = TypeVar("T")

LONGEST_TEXT = 64
"""Characters of a reported text: it names a state, and is no log."""
Value = bool | float | Annotated[str, Meta(max_length=LONGEST_TEXT)] | list[float]
"""A reported value besides the estimates."""

RESERVED_NAMES = frozenset(
    ["period", "time_ns", "node", "position_m", "heading_rad", "fix_m", "common_error_estimate_m", "values"]
)
"""Names that no reported value can have: columns that the emulator fills in every row of a run's states."""
COVARIANCE_TOLERANCE = 1e-6
"""Asymmetry and negative eigenvalues of a covariance, relative to its largest element, that rounding may cause."""
LARGEST_EXACT = 2**53
"""Integers below it are numbers of double precision."""
LEVELS = ("debug", "info", "warning", "error", "critical")
"""Levels of a line of a node's log."""
NoteDetail = bool | int | float | str
"""Value of a detail of an event."""
INBOX_LIMIT = 4096
"""Packets (or fixes) that are kept for a program that does not read them; beyond it the oldest are dropped."""


@dataclass(frozen=True, slots=True)
class Packet:
    """One received broadcast. Times are emulated nanoseconds from the start of the run."""

    sender: str
    sent_ns: int
    received_ns: int
    payload: bytes

    def __init__(self, sender: str, sent_ns: int, received_ns: int, payload: bytes) -> None:
        # A frozen dataclass sets its fields by name, which takes twice as long; a run has millions of packets.
        _set_sender(self, sender)
        _set_sent_ns(self, sent_ns)
        _set_received_ns(self, received_ns)
        _set_payload(self, payload)


_set_sender, _set_sent_ns, _set_received_ns, _set_payload = (
    Packet.__dict__[name].__set__ for name in ("sender", "sent_ns", "received_ns", "payload")
)


@dataclass(frozen=True, slots=True)
class Fix:
    """One GNSS fix: position (2,) in m east-north, covariance (2, 2) in m², heading in radians or None.

    The covariance is that of the receiver's own noise, without the common error of all receivers. A receiver has no
    heading where the scenario says so, for example while the vehicle stands.
    """

    time_ns: int
    position_m: Array
    covariance_m2: Array
    heading_rad: float | None


@dataclass(frozen=True, slots=True)
class Report:
    """A program's estimates at one time; see `Node.report`."""

    time_ns: int
    node: str
    estimate_m: tuple[float, float] | None
    covariance_m2: tuple[float, float, float, float] | None
    values: dict[str, Value] = field(default_factory=dict)


class NodeTransport(Protocol):
    """Interface of a node to the process that hosts it."""

    def now_ns(self, node: str) -> int:
        """Return the emulated time in nanoseconds by the clock of `node`."""
        ...

    def send_frame(self, node: str, payload: bytes) -> None:
        """Enqueue a frame at the emulated radio, at the present time."""
        ...

    def send_report(self, report: Report) -> None:
        """Send a report to the emulator's metrics."""
        ...

    def send_note(self, node: str, kind: str, level: str, text: str, details: dict[str, NoteDetail]) -> None:
        """Send a line of the log (kind "log"), or an event named `text` (kind "event")."""
        ...


class Mailbox(Generic[T]):
    """A bounded queue with one side for the transport (`deliver`) and one for the program.

    `waiting` tells the transport that a task of the program waits here: only then does an arrival wake the node;
    otherwise the program finds the item when it next runs. `refill` is called before the program reads, so that a
    transport may leave items in its own buffer until then (real time).
    """

    def __init__(self) -> None:
        self.refill: Callable[[], None] = lambda: None
        self._items: deque[T] = deque(maxlen=INBOX_LIMIT)
        self._waiters: deque[asyncio.Future[None]] = deque()

    @property
    def awaited(self) -> bool:
        """True if a task may be waiting here; may be read from another thread."""
        return bool(self._waiters)

    @property
    def waiting(self) -> bool:
        """True if a task waits for the next item."""
        return any(not waiter.done() for waiter in self._waiters)

    def deliver(self, items: Sequence[T]) -> None:
        """Append items and wake the waiting tasks."""
        self._items.extend(items)
        for waiter in self._waiters:
            if not waiter.done():
                waiter.set_result(None)

    async def get(self) -> T:
        """Remove and return the oldest item; wait for one if there is none. Cancelling it loses no item."""
        self.refill()
        while not self._items:
            waiter = asyncio.get_running_loop().create_future()
            self._waiters.append(waiter)
            try:
                self.refill()  # again: an item that came before the waiter was visible woke no task
                await waiter
            finally:
                self._waiters.remove(waiter)
        return self._items.popleft()

    def drain(self) -> list[T]:
        """Remove and return all items, oldest first, without waiting."""
        self.refill()
        items = list(self._items)
        self._items.clear()
        return items


class Radio:
    """The vehicle's radio: sends broadcasts to all nodes in range, and receives theirs.

    Attributes:
        max_payload: largest payload of a frame in bytes.
    """

    def __init__(self, node_id: str, transport: NodeTransport, max_payload: int) -> None:
        self.max_payload = max_payload
        self.inbox: Mailbox[Packet] = Mailbox()
        self._node_id = node_id
        self._transport = transport

    async def broadcast(self, payload: bytes) -> None:
        """Send one frame to all nodes in range.

        Raise `PayloadTooLargeError` above `max_payload` bytes, and TypeError for what is not bytes.
        """
        try:
            content = bytes(memoryview(payload))
        except TypeError:
            raise TypeError(
                f"broadcast({shown(payload)}): bytes are expected, not {type(payload).__name__}; encode it first, "
                "as with msgpack.packb(…) or text.encode()"
            ) from None
        if len(content) > self.max_payload:
            raise PayloadTooLargeError(len(content), self.max_payload)
        self._transport.send_frame(self._node_id, content)

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


class GnssReceiver:
    """The vehicle's GNSS receiver: `async for fix in node.gnss`."""

    def __init__(self) -> None:
        self.inbox: Mailbox[Fix] = Mailbox()

    def drain(self) -> list[Fix]:
        """Return all fixes since the last call, oldest first, without waiting."""
        return self.inbox.drain()

    async def receive(self) -> Fix:
        """Return the next fix; wait for one if there is none."""
        return await self.inbox.get()

    def __aiter__(self) -> GnssReceiver:
        return self

    async def __anext__(self) -> Fix:
        return await self.inbox.get()


class Node:
    """One vehicle as its program sees it.

    Attributes:
        id: the node's name.
        radio: the vehicle's radio.
        gnss: the vehicle's GNSS receiver.
        map: the lanes of the area; it does not say which lane the vehicle is on.
        rng: a generator with a seed of this node and incarnation, independent of the world's seed. It is the only
            source of randomness that is reproducible.
        options: the scenario's `[program.options]`.
        period_ns: time between two fixes in nanoseconds.
        incarnation: number of restarts of the program so far.
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
        disk: Callable[[], Path] | None = None,
    ) -> None:
        self._is_text: dict[str, bool] = {}  # by the name of each reported value
        self.id = node_id
        self.radio = Radio(node_id, transport, max_payload)
        self.gnss = GnssReceiver()
        self.map = lane_map
        self.rng = np.random.default_rng(seed)
        self.options = options
        self.period_ns = period_ns
        self.incarnation = incarnation
        self._transport = transport
        self._disk = disk

    @property
    def now_ns(self) -> int:
        """Emulated time in nanoseconds since the start of the run, by the vehicle's own clock."""
        return self._transport.now_ns(self.id)

    @property
    def folder(self) -> Path:
        """Folder of this vehicle's disk, on the machine of its process: empty at the start of the run.

        What was written there survives kills and restarts, as far as it has left the program's buffers: close or
        flush what must last. At the end of the run regular files are copied to `files/NODE/` in the run's folder,
        up to `run.files_max_mb`, if the emulator has started the process. The path differs from run to run: a
        program that sends it does not replay. Raise OSError where the disk refuses.
        """
        if self._disk is None:
            raise OSError(f"{self.id}: this node has no disk")
        return self._disk()

    def disconnect(self) -> None:
        """Disconnect the rest of the program from the world, after the vehicle's process has ended."""
        self._transport = self.radio._transport = _Disconnected(self.now_ns)

    def report(
        self,
        estimate_m: ArrayLike | None = None,
        covariance_m2: ArrayLike | None = None,
        **values: ArrayLike,
    ) -> None:
        """Report the present estimates: position (2,) in m, its covariance (2, 2) in m², and further values.

        Each further keyword is a number, a boolean, a text of at most 64 characters, or an array of numbers. All
        but arrays are figures of the run: a column of its states, a row of its summary, a curve. A name that ends
        in a unit is shown with it, as `delay_ms`. vnet's own metrics know `common_error_m` (2,),
        `common_error_covariance_m2` (2, 2), `mean_m` (2,) (of the consensus), `stacked_common_error_m` (2,) (after
        fusion) and `cloud_m` (n, 2); `heard` is the number of packets received since the last report, which is
        checked against the trace. A name is a Python identifier, with a dot and any text behind it if need be
        (`delay_ms.v03`, of which 32 have a column). Beside `common_error_m`, `weight.v03` is the weight that fusion
        gave v03. Raise ValueError for a wrong shape, for another kind of value, for a covariance that is
        none (not finite, not symmetric, or not positive semidefinite), for a name that is none or that vnet's
        own columns have, and for a text under a name that this node has reported numbers by, or the reverse.
        """
        estimate = None if estimate_m is None else _floats("estimate_m", estimate_m, 2)
        covariance = None if covariance_m2 is None else _covariance("covariance_m2", covariance_m2)
        named = {name: _value(name, value) for name, value in values.items()}
        for name, kept in named.items():
            self._check_kind(name, kept)
        self._transport.send_report(
            Report(
                time_ns=self.now_ns,
                node=self.id,
                estimate_m=None if estimate is None else (estimate[0], estimate[1]),
                covariance_m2=(
                    None if covariance is None else (covariance[0], covariance[1], covariance[2], covariance[3])
                ),
                values=named,
            )
        )

    def _check_kind(self, name: str, value: Value) -> None:
        """Raise ValueError for a name that no value can have, and for a text where numbers were, or the reverse."""
        is_text = isinstance(value, str)
        if name not in self._is_text:
            _check_name(name)
            self._is_text[name] = is_text
        elif self._is_text[name] != is_text:
            before, now = ("a text", "a number") if self._is_text[name] else ("a number", "a text")
            raise ValueError(
                f"report({name}={value!r}): {now}, but {self.id} has reported {before} by this name; use two names"
            )

    def log(self, text: str, level: str = "info") -> None:
        """Write a line to this vehicle's log, with the emulated time and a level.

        Levels are "debug", "info", "warning", "error" and "critical". The line stands in `logs/NODE.log` and in
        `events.jsonl` (event `log`). So does what the program gives to the standard `logging`, from the level of
        its loggers on ("warning" by default). Raise ValueError for another level.
        """
        if level not in LEVELS:
            raise ValueError(f"log(level={level!r}): allowed are {', '.join(LEVELS)}")
        self._transport.send_note(self.id, "log", level, str(text), {})

    def event(self, name: str, **details: NoteDetail) -> None:
        """Record that something happened, at the present time: event `event` of `events.jsonl`.

        `details` are numbers, booleans or texts. Raise ValueError for any other value, or an empty name.
        """
        if not isinstance(name, str) or not name:
            raise ValueError(f"event({name!r}): a name is expected")
        values = {key: _detail(key, value) for key, value in details.items()}
        self._transport.send_note(self.id, "event", "info", name, values)


class _Disconnected:
    """The transport of a node whose process has ended: it discards all frames and reports."""

    def __init__(self, now_ns: int) -> None:
        self._now_ns = now_ns

    def now_ns(self, node: str) -> int:
        return self._now_ns

    def send_frame(self, node: str, payload: bytes) -> None:
        pass

    def send_report(self, report: Report) -> None:
        pass

    def send_note(self, node: str, kind: str, level: str, text: str, details: dict[str, NoteDetail]) -> None:
        pass


def _detail(name: str, value: object) -> NoteDetail:
    """A detail of an event as plain Python; numbers of numpy are taken, and what is not finite becomes a text."""
    if isinstance(value, np.generic):
        value = value.item()
    if not isinstance(value, (bool, int, float, str)):
        raise ValueError(f"event({name}={value!r}): a number, a boolean or a text is expected")
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, int) and abs(value) >= 2**63:
        return str(value)
    return value


def _floats(name: str, value: ArrayLike, size: int | None = None) -> list[float]:
    try:
        flat: list[float] = np.asarray(value, dtype=float).ravel().tolist()
    except OverflowError:
        raise ValueError(
            f"report({name}={shown(value)}): a number within ±{sys.float_info.max:.2g} is expected"
        ) from None
    except (TypeError, ValueError):
        raise ValueError(f"report({name}={shown(value)}): numbers are expected") from None
    if size is not None and len(flat) != size:
        raise ValueError(f"report({name}=…): {len(flat)} numbers given, {size} expected")
    return flat


def _covariance(name: str, value: ArrayLike) -> list[float]:
    """Return a covariance matrix (2, 2) in row-major order; errors of rounding are allowed."""
    flat = _floats(name, value, 4)
    (a, b, c, d), margin = flat, COVARIANCE_TOLERANCE * max(map(abs, flat))
    if not all(map(math.isfinite, flat)):
        reason = "not finite"
    elif abs(b - c) > margin:
        reason = "not symmetric"
    elif min(a, d) < -margin or a * d - b * c < -margin * max(map(abs, flat)):
        reason = "not positive semidefinite"
    else:
        return flat
    raise ValueError(f"report({name}=[[{a:g}, {b:g}], [{c:g}, {d:g}]]): {reason}, so no covariance")


def _check_name(name: str) -> None:
    if name in RESERVED_NAMES:
        taken = ", ".join(sorted(RESERVED_NAMES))
        raise ValueError(f"report({name}=…): this name is taken by vnet; so are {taken}")
    if not name.partition(".")[0].isidentifier():
        allowed = "a Python identifier is expected, with a dot and any text behind it if need be"
        raise ValueError(f"report(**{{{name!r}: …}}): not a name of a value; {allowed}")


def _value(name: str, value: ArrayLike) -> Value:
    if name == "common_error_covariance_m2":
        return _covariance(name, value)
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, str):
        if len(value) > LONGEST_TEXT:
            raise ValueError(f"report({name}=…): text of {len(value)} characters, at most {LONGEST_TEXT} allowed")
        return str(value)
    if type(value) is float:
        return value
    if type(value) is int and abs(value) < LARGEST_EXACT:
        return float(value)
    flat = _floats(name, value)
    return flat[0] if np.ndim(value) == 0 else flat
