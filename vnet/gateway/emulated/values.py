"""Values and channels of `import zenoh` on virtual time, beside those of Zenoh's own that Python can construct."""

from __future__ import annotations

import asyncio
import hashlib
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Set
from dataclasses import dataclass
from datetime import timedelta
from functools import cache, lru_cache
from inspect import signature
from math import inf, isfinite
from operator import index
from pathlib import Path
from types import UnionType
from typing import Any, ClassVar, NamedTuple, NoReturn

import msgspec
import numpy as np
import zenoh
from greenlet import GreenletExit
from zenoh.handlers import Callback

from vnet.gateway.emulated.strands import (
    IDLE,
    Strand,
    Threads,
    Waiting,
    context_of_thread,
    current_strand,
    fail,
    go_on,
    idle,
    look,
)
from vnet.gateway.frames import MOST_WHOLE, ZID_BYTES, CrossingReply, CrossingSample, sample_options
from vnet.runtime.own_asyncio import Task
from vnet.units import NS_PER_S

MOST_COUNT = 2**64
"""Bound of counts, and of seconds."""


class Shown:
    """An attribute that an entity shows until it is undeclared, or a query until it is concluded, as at Zenoh."""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = f"_{name}"

    def __set__(self, entity: Any, value: object) -> None:
        vars(entity)[self._name] = value

    def __get__(self, entity: Any, owner: type | None = None) -> Any:
        if entity is None:
            return self
        entity.check_declared()
        return vars(entity)[self._name]


class _Value(msgspec.Struct, frozen=True, eq=False, gc=False):
    """A value that vehicles share."""


class _Id(msgspec.Struct, frozen=True, gc=False):
    """A value with equals. The hash that msgspec gives has the address of the class, which differs by process."""

    def __hash__(self) -> int:
        return hash(msgspec.structs.astuple(self))


class ZenohId(_Id, frozen=True, gc=False):
    """The id of a session."""

    number: int

    def __str__(self) -> str:
        return f"{self.number:x}"

    __repr__ = __str__

    def __bytes__(self) -> bytes:
        return self.number.to_bytes(-(-self.number.bit_length() // 8), "little")

    @classmethod
    def of(cls, *parts: object) -> ZenohId:
        """Return the id that these parts give."""
        digest = hashlib.sha256("/".join(map(str, parts)).encode()).digest()
        return cls(int.from_bytes(digest[:ZID_BYTES]) | 1 << 8 * ZID_BYTES - 1)


class EntityGlobalId(_Id, frozen=True, gc=False):
    """The id of an entity: that of its session, and its number there."""

    zid: ZenohId
    eid: int

    def __repr__(self) -> str:
        return f"EntityGlobalId {{ zid: {self.zid}, eid: {self.eid} }}"


class SourceInfo(_Id, frozen=True, gc=False):
    """The entity that has published a sample, and the sample's number there."""

    source_id: EntityGlobalId
    source_sn: int


class Sample(_Value, frozen=True, eq=False, gc=False):
    """A sample."""

    key_expr: zenoh.KeyExpr
    payload: zenoh.ZBytes
    kind: zenoh.SampleKind
    encoding: zenoh.Encoding
    timestamp: zenoh.Timestamp | None = None
    congestion_control: zenoh.CongestionControl = zenoh.CongestionControl.DROP
    priority: zenoh.Priority = zenoh.Priority.DATA
    express: bool = False
    attachment: zenoh.ZBytes | None = None
    source_info: SourceInfo | None = None

    timestamp_stack: ClassVar[None] = None


class ReplyError(_Value, frozen=True, eq=False, gc=False):
    """An error in reply to a query."""

    payload: zenoh.ZBytes
    encoding: zenoh.Encoding

    timestamp_stack: ClassVar[None] = None


class Reply(_Value, frozen=True, eq=False, gc=False):
    """A reply to a query."""

    result: Sample | ReplyError
    replier_id: EntityGlobalId | None = None

    @property
    def ok(self) -> Sample | None:
        """The sample, None of an error."""
        return self.result if isinstance(self.result, Sample) else None

    @property
    def err(self) -> ReplyError | None:
        """The error, None of a sample."""
        return self.result if isinstance(self.result, ReplyError) else None


class Hello(_Value, frozen=True, eq=False, gc=False):
    """A router that scouting finds."""

    whatami: zenoh.WhatAmI
    zid: ZenohId
    locators: list[str]


class MatchingStatus(_Value, frozen=True, eq=False, gc=False):
    """True for `matching` if there is anybody at the other end."""

    matching: bool

    def __repr__(self) -> str:
        return f"MatchingStatus {{ matching: {str(self.matching).lower()} }}"


class _StandIn(type):
    """A class that stands for one of Zenoh's, and makes values of that."""

    real: type[Any]

    def __call__(cls, *args: Any, **options: Any) -> Any:
        return cls.real(*map(ordered, args), **{name: ordered(each) for name, each in options.items()})

    def __instancecheck__(cls, instance: object) -> bool:
        return isinstance(instance, cls.real)

    def __getattr__(cls, name: str) -> Any:
        return getattr(cls.real, name)


def ordered(parameters: Any) -> Any:
    """Return parameters in the order of their dict: Zenoh takes them from one in another order each time."""
    if not isinstance(parameters, dict):
        return parameters
    if not all(isinstance(word, str) for item in parameters.items() for word in item):
        return parameters
    return ";".join(f"{key}={value}" if value else key for key, value in parameters.items() if key)


class Parameters(metaclass=_StandIn):
    """Zenoh's own parameters of a query."""

    real = zenoh.Parameters


class Selector(metaclass=_StandIn):
    """Zenoh's own selector."""

    real = zenoh.Selector


class Config(metaclass=_StandIn):
    """Zenoh's own configuration; that of the environment is found by the variables of the program."""

    real = zenoh.Config
    environ: ClassVar[Mapping[str, str]] = {}
    DEFAULT_CONFIG_PATH_ENV = "ZENOH_CONFIG"

    @classmethod
    def from_env(cls) -> zenoh.Config:
        """Return the configuration in the file that the program's environment names. Raises ZError."""
        path = cls.environ.get(cls.DEFAULT_CONFIG_PATH_ENV)
        if path is None:
            raise zenoh.ZError("environment variable not found")
        return zenoh.Config.from_file(path)


NO_STACK = "a frame of the radio carries no stack of timestamps"


def refused(name: str, reason: str) -> type:
    """Return what stands for a name that virtual time does not have."""

    def refuse(cls: type, *args: object, **options: object) -> NoReturn:
        raise zenoh.ZError(f"zenoh.{name} is not available on virtual time: {reason}")

    return type(name, (), {"__new__": refuse, "__doc__": f"Refused: {reason}."})


# Arguments.


def _seconds(value: float) -> None:
    if not 0 <= value < MOST_COUNT:
        raise ValueError("negative timeout, or one that is too long")


def _count(value: int) -> None:
    if not 0 <= index(value) < MOST_COUNT:
        raise OverflowError("can't convert int to unsigned")


def _no_instrumentation(value: object) -> NoReturn:
    raise zenoh.ZError(f"timestamp_instrumentation is not available on virtual time: {NO_STACK}")


BOOL = bool | np.bool_
KINDS: dict[str, type | UnionType | Callable[[Any], object]] = {
    **dict.fromkeys(["allowed_origin", "allowed_destination"], zenoh.Locality),
    **dict.fromkeys(["complete", "detect_late_publishers", "express", "history"], BOOL),
    **dict.fromkeys(["publisher_detection", "subscriber_detection"], BOOL),
    **dict.fromkeys(["encoding", "attachment", "payload"], object),  # which Zenoh's own types check
    **dict.fromkeys(["heartbeat", "sporadic_heartbeat", "timeout"], _seconds),
    **dict.fromkeys(["capacity", "max_samples"], _count),
    "accept_replies": zenoh.ReplyKeyExpr,
    "config": zenoh.Config,
    "congestion_control": zenoh.CongestionControl,
    "consolidation": zenoh.QueryConsolidation | zenoh.ConsolidationMode,
    "max_age": isfinite,  # of any sign
    "periodic_queries": timedelta,
    "priority": zenoh.Priority,
    "reliability": zenoh.Reliability,
    "source_info": SourceInfo,
    "target": zenoh.QueryTarget,
    "timestamp": zenoh.Timestamp,
    "timestamp_instrumentation": _no_instrumentation,
}
"""Type of each option, or check of one that is a number."""


@cache
def _parameters(function: Callable[..., Any]) -> Set[str]:
    return signature(function).parameters.keys()


def check_taken(function: Callable[..., Any], options: Mapping[str, Any]) -> None:
    """Raise TypeError for an option that a function of Zenoh does not take."""
    for name in options:
        if name not in _parameters(function):
            raise TypeError(f"{function.__qualname__}() got an unexpected keyword argument '{name}'")


def check(options: Mapping[str, Any], **kinds: Any) -> None:
    """Raise as Zenoh for an option that there is not, or of another type or sign; `kinds` go before `KINDS`."""
    for name, value in options.items():
        kind = kinds.get(name) or KINDS.get(name)
        if kind is None:
            raise TypeError(f"got an unexpected keyword argument '{name}'")
        if value is None and name not in ("capacity", "config", "session"):
            continue
        if not isinstance(kind, type | UnionType):
            kind(value)
        elif not isinstance(value, kind):
            given = type(value).__name__
            wanted = kind.__name__ if isinstance(kind, type) else kind.__args__[0].__name__
            raise TypeError(f"argument '{name}': '{given}' object cannot be converted to '{wanted}'")


# Between samples and what crosses the radio.


def timestamp_at(unix_ns: int, zid: ZenohId) -> zenoh.Timestamp:
    """Return the timestamp of an instant."""
    return zenoh.Timestamp(zenoh.NTP64(*divmod(unix_ns, NS_PER_S)), bytes(zid))


def unix_ns_of(stamp: zenoh.Timestamp) -> int:
    """Return the instant of a timestamp."""
    return stamp.get_time_as_ntp64().as_nanos()


PUT, DELETE = zenoh.SampleKind.PUT, zenoh.SampleKind.DELETE
NOTHING = zenoh.ZBytes(b"")
NO_ENCODING = zenoh.Encoding.ZENOH_BYTES
_key = lru_cache(maxsize=1024)(zenoh.KeyExpr)
_encoding = lru_cache(maxsize=256)(zenoh.Encoding)


def key_of(key: Any) -> zenoh.KeyExpr:
    """Return what a program has given as a key expression as one. Raises ZError."""
    return key if isinstance(key, zenoh.KeyExpr) else _key(key)


def encoding_of(encoding: Any, default: zenoh.Encoding = NO_ENCODING) -> zenoh.Encoding:
    """Return what a program has given as an encoding as one."""
    if encoding is None:
        return default
    return encoding if isinstance(encoding, zenoh.Encoding) else _encoding(encoding)


def zbytes_of(content: Any) -> zenoh.ZBytes:
    """Return what a program has given as a payload as one. Raises TypeError, for None too."""
    if content is None:
        raise TypeError("argument 'payload': expected bytes/str type, found 'NoneType'")
    return content if isinstance(content, zenoh.ZBytes) else zenoh.ZBytes(content)


def bytes_or_none(content: Any) -> zenoh.ZBytes | None:
    """Return the same, None for None."""
    return None if content is None else zbytes_of(content)


def token_sample(key: zenoh.KeyExpr, alive: bool) -> Sample:
    """Return the sample that says that a token has come or gone."""
    return Sample(key, NOTHING, PUT if alive else DELETE, NO_ENCODING)


@lru_cache(maxsize=MOST_WHOLE)
def sample_of(crossing: CrossingSample) -> Sample:
    """Return the sample that has crossed the radio. Raises ZError, ValueError or OverflowError for none."""
    source = None
    if crossing.source is not None:
        entity, number = crossing.source
        zid, eid = (int.from_bytes(part, "little") for part in (entity[:ZID_BYTES], entity[ZID_BYTES:]))
        source = SourceInfo(EntityGlobalId(ZenohId(zid), eid), number)
    return Sample(
        key_of(crossing.key),
        zenoh.ZBytes(crossing.payload),
        DELETE if crossing.is_delete else PUT,
        encoding_of(crossing.encoding),
        source_info=source,
        **sample_options(crossing),
    )


def result_of(reply: CrossingReply) -> Sample | ReplyError:
    """Return sample or error of a reply that has crossed the radio. Raises as `sample_of`."""
    if reply.sample is not None:
        return sample_of(reply.sample)
    content, encoding = reply.error or (b"", "")
    return ReplyError(zenoh.ZBytes(content), zenoh.Encoding(encoding))


# Channels.


class DefaultHandler:
    """The default channel."""

    capacity = 256


class FifoChannel(DefaultHandler):
    """A channel whose writers wait while it is full."""

    def __init__(self, capacity: int) -> None:
        check({"capacity": capacity})
        self.capacity = capacity


class RingChannel(FifoChannel):
    """A channel that keeps the newest items."""


class Intake:
    """Items that wait for room at a session, in order; one stops all that follow, as it stops Zenoh's thread."""

    def __init__(self) -> None:
        self._held: deque[tuple[Sink, Callable[[Any], object], Any]] = deque()
        self._called: CallbackSink | None = None
        """The latest callback that is called in Zenoh's own thread."""
        self.is_giving = False

    def take(self, sink: Sink, act: Callable[[Any], object], item: Any) -> None:
        """Have `act` give an item to `sink` once that has room, and all before it has been given."""
        self._held.append((sink, act, item))
        if not self.is_giving:
            self._go_on()

    def go_on_soon(self) -> None:
        """Go on, as there is room, once the present code has blocked or returned."""
        if self._held:
            asyncio.get_running_loop().call_soon(self._go_on)

    def _go_on(self) -> None:
        self.is_giving = True
        try:
            while self._held and self._held[0][0].has_room() and not (self._called and self._called.is_running):
                sink, act, item = self._held.popleft()
                self._called = sink if isinstance(sink, CallbackSink) and sink.is_direct else None
                act(item)
        finally:
            self.is_giving = False


class _Queue:
    """Items on their way to a program, as many as its capacity; a thread that adds more waits."""

    def __init__(self, capacity: float, intake: Intake) -> None:
        self._items: deque[Any] = deque()
        self._capacity, self._intake = capacity, intake
        self._room = Waiting()
        self._closed = False

    def has_room(self) -> bool:
        """Return whether an item stops nobody."""
        return len(self._items) < self._capacity or self._closed

    def _is_given_by_program(self) -> bool:
        return current_strand() is not None and not self._intake.is_giving

    def _takes(self) -> bool:
        """Return whether it is open; a thread of the program waits for room before."""
        while not self.has_room() and self._is_given_by_program():
            self._room.wait()
        return not self._closed

    def _next(self) -> Any:
        item = self._items.popleft()
        self._freed()
        return item

    def _freed(self) -> None:
        (self._room.wake_all if self._closed else self._room.wake)()
        self._intake.go_on_soon()


class Handler(_Queue):
    """A channel, with the reading end that a program sees."""

    def __init__(self, channel: DefaultHandler, intake: Intake) -> None:
        self._is_ring = isinstance(channel, RingChannel)
        super().__init__(inf if self._is_ring else max(channel.capacity, 1), intake)
        self._items = deque(maxlen=channel.capacity if self._is_ring else None)
        self._waiting = Waiting()
        self._readers = 0

    def __class_getitem__(cls, item: object) -> type[Handler]:
        return cls

    def try_recv(self) -> Any:
        """Return the next item, None if there is none now. Raises ZError if there will be none."""
        if self._items:
            return self._next()
        self._check_open()
        look()
        return None

    def recv(self) -> Any:
        """Return the next item; block until there is one. Raises ZError if there will be none."""
        while not self._items:
            self._check_open()
            self._readers += 1
            try:
                self._waiting.wait()
            finally:
                self._readers -= 1
        return self._next()

    def _check_open(self) -> None:
        if self._closed:
            why = "The ringbuffer has been deleted" if self._is_ring else "channel is empty and closed"
            raise zenoh.ZError(why)

    def __iter__(self) -> Iterator[Any]:
        return self

    def __next__(self) -> Any:
        try:
            return self.recv()
        except zenoh.ZError:
            raise StopIteration from None

    # The other end.

    def push(self, item: Any) -> None:
        """Add an item, and wake who waits longest."""
        if self._takes():
            self._items.append(item)
            self._waiting.wake()

    def close(self) -> None:
        """Add no more; what a ring has is lost with its writer, as at Zenoh, but for readers that wait for it."""
        self._closed = True
        self._waiting.wake_all()
        self._freed()
        if self._is_ring and self._readers and (loop := asyncio._get_running_loop()) is not None:
            loop.call_soon(self._items.clear)  # they have been woken before
        elif self._is_ring:
            self._items.clear()


class CallbackSink(_Queue):
    """A callback in a thread of its own, as Zenoh's Python runs it, or without a queue in the thread that calls."""

    def __init__(self, callback: Callback[Any], outlet: Outlet) -> None:
        super().__init__(DefaultHandler.capacity, outlet.intake)
        self._callback, self._drop, self.is_direct = callback.callback, callback.drop, not callback.indirect
        self._outlet = outlet
        self._number = outlet.threads.new_number()
        self._context = context_of_thread()
        self._strand: Strand | None = None
        self.is_running = False
        self._waiting = Waiting()
        if not self.is_direct:
            outlet.threads.callbacks.add(self)

    def has_room(self) -> bool:
        """Return whether an item stops nobody."""
        return not self.is_running if self.is_direct else super().has_room()

    def wait(self) -> None:
        """Block until the callback has had all, unless it is the callback itself that asks."""
        if self.is_running and current_strand() is not self._strand:
            self._waiting.wait()

    def push(self, item: Any) -> None:
        """Have the callback called with an item."""
        if self.is_direct and self._is_given_by_program():
            self._call(self._callback, item)
            return
        if not self._takes():
            return
        self._items.append(item)
        if not self.is_running:
            self.is_running = True
            self._outlet.due.soon(self)

    def close(self) -> None:
        """Call the callback no more, once it has had all."""
        if not self._closed:
            self._closed = True
            self._freed()
            if self._drop is not None and not self.is_running:
                self.is_running = True
                self._outlet.due.soon(self)
            elif not self.is_running:
                self._end()

    def _end(self) -> None:
        threads = self._outlet.threads
        threads.callbacks.discard(self)
        threads.callbacks_end.wake_all()

    def run(self) -> None:
        """Call the callback until it blocks; then a task goes on with it."""
        if self._outlet.threads.have_stopped:
            return
        strand = self._strand
        if strand is None:
            strand = self._strand = Strand(
                self._work, self._number, self._outlet.threads.folder, context=self._context
            )
        item = strand.begin()
        if item is not IDLE:
            Task(go_on(strand, item), loop=asyncio.get_running_loop(), name=f"thread {self._number}")

    def _work(self) -> None:
        while True:  # a strand costs ten times what a switch does
            while self._items:
                self._call(self._callback, self._next())
            if self._closed and self._drop is not None:
                drop, self._drop = self._drop, None
                self._call(drop)
            self.is_running = False
            self._freed()
            self._waiting.wake_all()
            if self._closed:
                self._end()
            idle()

    def _call(self, function: Callable[..., Any], *args: Any) -> None:
        try:
            function(*args)
        except SystemExit as leave:  # which ends a callback at most
            error = RuntimeError(f"SystemExit({leave.code!r}) in a callback ends nothing")
            fail(error.with_traceback(leave.__traceback__), "in a callback of Zenoh")
        except (GreenletExit, KeyboardInterrupt):  # the program is ended
            raise
        except BaseException as error:
            is_called = error.__traceback__ is not None and error.__traceback__.tb_next is not None
            code = None if is_called else getattr(function, "__code__", None)
            of = "" if code is None else f" defined at {Path(code.co_filename).name}:{code.co_firstlineno}"
            fail(error, f"in a callback of Zenoh{of}")


@dataclass(eq=False)
class Direct:
    """A sink that calls a function at once."""

    push: Callable[[Any], object]
    close: Callable[[], object] = lambda: None
    has_room: Callable[[], bool] = lambda: True


Sink = Handler | CallbackSink | Direct
"""A receiver of samples, queries or replies."""


class DueCallbacks:
    """Callbacks of a vehicle that are due, which run in the order in which they became so."""

    def __init__(self) -> None:
        self._due: list[CallbackSink] = []
        self.is_held = False
        """True while `run` will be called, as what is due comes by the radio."""

    def soon(self, sink: CallbackSink) -> None:
        """Have a callback run once the present code has blocked or returned."""
        if not self._due and not self.is_held:
            asyncio.get_running_loop().call_soon(self.run)
        self._due.append(sink)

    def run(self) -> None:
        """Run what is due."""
        due, self._due = self._due, []
        for sink in due:
            sink.run()


class Outlet(NamedTuple):
    """Destination of items for a program."""

    due: DueCallbacks
    threads: Threads
    intake: Intake


def sink_of(handler: Any, outlet: Outlet) -> tuple[Handler | CallbackSink, Any]:
    """Return where items go, and the handler that the program sees. Raises ValueError for what is no handler."""
    if handler is None or isinstance(handler, DefaultHandler):
        channel = Handler(handler or DefaultHandler(), outlet.intake)
        return channel, channel
    seen = None
    if isinstance(handler, tuple) and len(handler) == 2:
        handler, seen = handler
    if not callable(handler):
        raise ValueError(f"Invalid handler type {type(handler).__name__}")
    return CallbackSink(handler if isinstance(handler, Callback) else Callback(handler), outlet), seen
