"""Sessions of `import zenoh` on virtual time, and what they declare."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextvars import Context, copy_context
from functools import partial, partialmethod
from itertools import count
from typing import Any, Literal

import msgspec
import zenoh

from vnet.gateway.emulated.queries import ANY_KEY, Asking, Entity
from vnet.gateway.emulated.strands import give_way, go_no_further_if_ended, look
from vnet.gateway.emulated.values import (
    DELETE,
    NO_ENCODING,
    NOTHING,
    PUT,
    CallbackSink,
    Direct,
    EntityGlobalId,
    Hello,
    MatchingStatus,
    Outlet,
    Reply,
    Sample,
    Shown,
    Sink,
    ZenohId,
    bytes_or_none,
    check,
    check_taken,
    encoding_of,
    key_of,
    ordered,
    sink_of,
    token_sample,
    zbytes_of,
)
from vnet.gateway.emulated.vehicle import Vehicle
from vnet.runtime.outside_loop import collector
from vnet.runtime.own_asyncio import Numbered, present_node
from vnet.runtime.virtual_time import VirtualTimeLoop

QUERY_TIMEOUT_S = 10.0
"""Zenoh's own `queries_default_timeout`."""
_REFUSED_SETTINGS = (
    "namespace",
    "access_control/enabled",
    "downsampling",
    "low_pass_filter",
    "qos/network",
    "qos/publication",
)
"""Parts of a configuration that change what a session sends, and which virtual time does not have."""
LOCAL, REMOTE = zenoh.Locality.SESSION_LOCAL, zenoh.Locality.REMOTE


class Ending(Numbered):
    """A session, or an entity that it has declared; a `with` block ends it."""

    _ends: dict[Callable[[], object], None] | None = None
    """Called at its end, in this order; None unless it is open or declared."""
    _context: Context
    """That of the program, in which it ends if the garbage collector finds it."""

    def __new__(cls, *args: Any, **options: Any) -> Any:
        """Return one that has noted whose it is."""
        made = super().__new__(cls)
        made._context = copy_context()
        return made

    def __enter__(self) -> Any:
        return self

    def __exit__(self, *_args: object, **_kwargs: object) -> None:
        self.end()

    def until_end(self, end: Callable[[], object]) -> Callable[[], None]:
        """Have `end` called at its end; return what calls it before."""
        assert self._ends is not None
        self._ends[end] = None
        return partial(self._end_before, end)

    def _end_before(self, end: Callable[[], object]) -> None:
        if self._ends and end in self._ends:
            del self._ends[end]
            end()

    def end(self) -> None:
        """End it unless it has ended."""
        ends, self._ends = self._ends, None
        for end in list(ends or ()):
            end()

    def discard(self) -> None:
        """End it as the program discards it; what a kill or the end of the run leaves ends without a word."""
        loop = asyncio._get_running_loop()
        if isinstance(loop, VirtualTimeLoop) and not loop.is_ending:
            if collector.runs:  # on nobody's behalf
                self._context.run(self._let_go)
            else:
                self._let_go()

    def _let_go(self) -> None:
        self.end()


class Declared(Ending):
    """An entity that a session has declared."""

    _noun = "LivelinessToken"
    """Word of Zenoh's messages for it."""

    def check_declared(self) -> None:
        """Raise ZError if it has been undeclared."""
        if self._ends is None:
            raise zenoh.ZError(f"Undeclared {self._noun}")

    def undeclare(self) -> None:
        """Undeclare it. Raises ZError if it has been."""
        self.check_declared()
        self.end()


class Listening(Declared):
    """An entity that takes items, with the end of the channel that the program reads."""

    _noun = "listener"

    def __init__(self, handler: Any, outlet: Outlet) -> None:
        self._sink, self._handler = sink_of(handler, outlet)
        self._is_background = callable(handler)
        self._ends = {self._sink.close: None}

    _is_background = True
    """True if it goes on when the program discards it, as a callback does."""
    _readers = 0
    """Threads that are in `recv`."""

    def __class_getitem__(cls, item: object) -> type[Listening]:
        return cls

    @property
    def handler(self) -> Any:
        """The handler that the program reads."""
        self.check_declared()
        return self._handler

    def try_recv(self) -> Any:
        """Return the next item, None if there is none now."""
        return self.handler.try_recv()

    def recv(self) -> Any:
        """Return the next item; block until there is one."""
        handler = self.handler
        self._readers += 1
        try:
            return handler.recv()
        finally:
            self._readers -= 1

    def end(self) -> None:
        """Undeclare it unless it has been. Raises RuntimeError while a thread is in `recv`, as Zenoh's Python."""
        if self._readers:
            if (node := present_node()) is not None:
                node.log("undeclare() while a thread is in recv() raises RuntimeError, as at Zenoh", "warning")
            raise RuntimeError("Already borrowed")
        super().end()

    def __iter__(self) -> Any:
        return iter(self.handler)

    def __del__(self) -> None:
        if not self._is_background:
            self.discard()


class Subscriber(Listening):
    """A subscriber."""

    kind: Literal["subscriber", "queryable", "watcher"] = "subscriber"
    _noun = "subscriber"

    def __init__(
        self,
        session: Session,
        key_expr: Any,
        handler: Any = None,
        *,
        allowed_origin: zenoh.Locality | None = None,
        complete: bool | None = None,
    ) -> None:
        check({"allowed_origin": allowed_origin, "complete": complete})
        session, own_id, key = session.inner, session.new_id(), key_of(key_expr)
        super().__init__(handler, session.outlet)
        self.session, self.id, self.key_expr = session, own_id, key
        self._entity = Entity(self.kind, session, own_id, key, self._intake(), allowed_origin, bool(complete))
        self._ends = {session.declare(self._entity): None}

    id, key_expr = Shown(), Shown()

    def _intake(self) -> Sink:
        """Return where the vehicle puts its items."""
        return self._sink


class Queryable(Subscriber):
    """A queryable."""

    kind = _noun = "queryable"

    def end(self) -> None:
        """Undeclare it unless it has been, and let go of queries that lie unread, which concludes them."""
        is_declared = self._ends is not None
        super().end()
        if is_declared:
            del self._handler, self._sink, self._entity


class Watcher(Subscriber):
    """A subscriber of tokens."""

    kind = "watcher"

    def __init__(self, session: Session, key: Any, handler: Any, history: bool | None) -> None:
        check({"history": history})
        super().__init__(session, key, handler)
        if history:
            session.vehicle.tell_present(self._entity)


class LivelinessToken(Declared):
    """A token."""

    def __init__(self, session: Session, key: Any) -> None:
        self._ends = {session.declare(Entity("token", session, session.new_id(), key_of(key))): None}

    def __del__(self) -> None:
        self.discard()


class CancellationToken:
    """A token that ends queries."""

    def __init__(self) -> None:
        self._is_cancelled = False
        self._queries: list[tuple[Asking | None, Sink]] = []

    def cancel(self) -> None:
        """End the queries that have it, and block until their callbacks have ended."""
        self._is_cancelled = True
        queries, self._queries = self._queries, []
        for asking, _ in queries:
            if asking is not None:
                asking.cancel()
        for _, sink in queries:
            if isinstance(sink, CallbackSink):
                sink.wait()

    is_cancelled = property(lambda self: self._is_cancelled)

    def add(self, sink: Sink, asking: Asking | None = None) -> None:
        """Have it end a query. Raises ZError if it is cancelled."""
        if self._is_cancelled:
            raise zenoh.ZError("Query was cancelled")
        self._queries.append((asking, sink))


class Liveliness:
    """Tokens of a session, and of others."""

    def __init__(self, session: Session) -> None:
        self._session = session

    def declare_token(self, key_expr: Any) -> LivelinessToken:
        """Declare a token, which is there until it is undeclared or discarded."""
        return LivelinessToken(self._session, key_expr)

    def declare_subscriber(self, key_expr: Any, handler: Any = None, *, history: bool | None = None) -> Watcher:
        """Declare a subscriber that is told of tokens, with `history` also of those that are there."""
        return Watcher(self._session, key_expr, handler, history)

    def get(
        self,
        key_expr: Any,
        handler: Any = None,
        *,
        timeout: float | int | None = None,
        cancellation_token: CancellationToken | None = None,
    ) -> Any:
        """Get the tokens that are there: those of other vehicles as far as they have been heard."""
        check({"timeout": timeout, "cancellation_token": cancellation_token}, cancellation_token=CancellationToken)
        self._session.check_open()
        sink, seen = sink_of(handler, self._session.outlet)
        if cancellation_token is not None:
            cancellation_token.add(sink)
        for token in self._session.vehicle.tokens(key_of(key_expr)):
            sink.push(Reply(token_sample(token, alive=True)))
        asyncio.get_running_loop().call_soon(sink.close)  # once it can be read: a ring is lost with its end
        return seen


class MatchingListener(Listening):
    """A listener that is told whether there may be anybody at the other end."""

    _noun = "matching listener"

    def __init__(self, owner: Sending, handler: Any = None) -> None:
        super().__init__(handler, owner.session.outlet)
        # Not the owner, which is undeclared as the program discards it.
        self._on_matching, self._matches, self._matching = owner.session.vehicle.on_matching, owner.matches, False
        self._ends = {owner.until_undeclared(self._stop): None}
        self._on_matching.append(self._look)
        self._look()

    def _stop(self) -> None:
        self._on_matching.remove(self._look)
        self._sink.close()

    def _look(self) -> None:
        if (matching := self._matches()) != self._matching:
            self._matching = matching
            self._sink.push(MatchingStatus(matching))


class Sending(Declared):
    """A publisher or a querier."""

    key_expr, id = Shown(), Shown()
    matches: Callable[[], bool]
    """Returns whether anybody may take its samples, or may answer."""

    def __init__(self, session: Session, key: Any) -> None:
        self.session, self.id, self.key_expr = session.inner, session.new_id(), key_of(key)
        self._ends = {}

    def until_undeclared(self, end: Callable[[], object]) -> Callable[[], None]:
        """Have `end` called when it is undeclared, or its session closed; return what calls it before.

        That does not hold this object, which is undeclared as the program discards it.
        """
        self.check_declared()
        ends, end_before = self._ends, self.session.until_end(end)
        assert ends is not None
        ends[end_before] = None

        def forget() -> None:
            ends.pop(end_before, None)
            end_before()

        return forget

    def __del__(self) -> None:
        self.discard()

    @property
    def matching_status(self) -> MatchingStatus:
        """True for `matching` if there may be anybody at the other end."""
        self.check_declared()
        return MatchingStatus(self.matches())

    declare_matching_listener = partialmethod(MatchingListener)


class Publisher(Sending):
    """A publisher."""

    _noun = "publisher"

    def __init__(
        self,
        session: Session,
        key_expr: Any,
        *,
        encoding: Any = None,
        congestion_control: zenoh.CongestionControl | None = None,
        priority: zenoh.Priority | None = None,
        express: bool | None = None,
        reliability: zenoh.Reliability | None = None,
        allowed_destination: zenoh.Locality | None = None,
    ) -> None:
        self._qos: dict[str, Any] = {
            "congestion_control": congestion_control,
            "priority": priority,
            "express": express,
            "allowed_destination": allowed_destination,
        }
        check({**self._qos, "reliability": reliability})
        super().__init__(session, key_expr)
        self.matches = partial(session.vehicle.matches_subscriber, self.session, self.key_expr)
        self.encoding = encoding_of(encoding)
        self.congestion_control = congestion_control or zenoh.CongestionControl.DEFAULT
        self.priority = priority or zenoh.Priority.DEFAULT
        self.reliability = reliability or zenoh.Reliability.RELIABLE

    encoding, congestion_control, priority, reliability = Shown(), Shown(), Shown(), Shown()

    def put(self, payload: Any, *, encoding: Any = None, **options: Any) -> None:
        """Put a sample."""
        self._publish(PUT, payload, encoding=encoding_of(encoding, self.encoding), **options)

    def delete(self, **options: Any) -> None:
        """Delete the key."""
        self._publish(DELETE, NOTHING, **options)

    def _publish(self, kind: zenoh.SampleKind, payload: Any, **options: Any) -> Sample:
        check(options)
        self.check_declared()
        return self.session.publish(kind, self.key_expr, payload, **self._qos, **options)


class Querier(Sending):
    """A querier."""

    _noun = "querier"

    def __init__(
        self,
        session: Session,
        key_expr: Any,
        *,
        target: zenoh.QueryTarget | None = None,
        accept_replies: zenoh.ReplyKeyExpr | None = None,
        **options: Any,
    ) -> None:
        check_taken(zenoh.Session.declare_querier, options)
        super().__init__(session, key_expr)
        all_complete = target == zenoh.QueryTarget.ALL_COMPLETE
        self.matches = partial(session.vehicle.matches_queryable, self.session, self.key_expr, all_complete)
        self.accept_replies = accept_replies or zenoh.ReplyKeyExpr.DEFAULT
        self._options = {**options, "target": target, "accept_replies": accept_replies}
        check(self._options)

    accept_replies = Shown()

    def get(self, handler: Any = None, *, parameters: Any = None, **options: Any) -> Any:
        """Ask for replies."""
        check_taken(zenoh.Querier.get, options)
        self.check_declared()
        selector = zenoh.Selector(self.key_expr, ordered(parameters))
        return self.session.query(self.until_undeclared, selector, handler, **self._options, **options)


class SessionInfo:
    """Surroundings of a session: the router of its vehicle."""

    def __init__(self, session: Session) -> None:
        self._session = session

    def zid(self) -> ZenohId:
        """Return the session's id."""
        return self._session.zid()

    def routers_zid(self) -> list[ZenohId]:
        """Return the id of the vehicle's router."""
        return [self._session.vehicle.zid]

    def peers_zid(self) -> list[ZenohId]:
        """Return none: a vehicle has no peers."""
        return []

    transports = links = peers_zid

    def declare_transport_events_listener(self, handler: Any = None, *, history: bool | None = None) -> Any:
        """Refuse. Raises ZError."""
        raise zenoh.ZError("events of transports are not available on virtual time: sessions have no transport")

    declare_link_events_listener = declare_transport_events_listener


class Session(Ending):
    """A session."""

    def __init__(self, vehicle: Vehicle, outlet: Outlet, config: zenoh.Config) -> None:
        check({"config": config})
        self.inner = self
        """The session itself, which what it has declared holds; the program has `of_program`."""
        self.vehicle, self.outlet = vehicle, outlet
        self._entity_numbers = count(1)
        self._ends = {}
        self._declared_keys: set[str] = set()

        def setting(name: str) -> Any:
            return msgspec.json.decode(config.get_json(name))

        for name in filter(setting, _REFUSED_SETTINGS):
            raise zenoh.ZError(f"{name} of a configuration is not available on virtual time")
        given = setting("id")
        self._zid = vehicle.new_zid() if given is None else ZenohId(int(given, 16))
        timeout_ms = setting("queries_default_timeout")
        self._timeout_s = QUERY_TIMEOUT_S if timeout_ms is None else timeout_ms / 1000
        enabled, mode = setting("timestamping/enabled"), setting("mode") or "peer"
        self.stamps = bool(enabled.get(mode) if isinstance(enabled, dict) else enabled)
        """True if its samples have timestamps of its own."""

    info = property(lambda self: SessionInfo(self.inner))
    id = property(lambda self: EntityGlobalId(self._zid, 0))

    def of_program(self) -> Session:
        """Return the session as its program has it: closed once the program lets go of it, as at Zenoh."""
        held: Session = Session.__new__(Session)
        held.__dict__ = self.__dict__
        return held

    def __del__(self) -> None:
        if vars(self).get("inner") is not self:
            self.discard()

    def __repr__(self) -> str:
        return f"Session(Session {{ id: {self._zid} }})"

    def zid(self) -> ZenohId:
        """Return the session's id."""
        return self._zid

    def end(self) -> None:
        """Undeclare all that the session has declared."""
        if not self.is_closed():
            super().end()
            give_way()  # to what is called in answer

    def _let_go(self) -> None:
        super().end()  # a finalizer cannot give way

    close = end

    def is_closed(self) -> bool:
        """Return whether it has been closed."""
        return self._ends is None

    def check_open(self) -> None:
        """Raise ZError if it has been closed."""
        go_no_further_if_ended()
        if self.is_closed():
            raise zenoh.ZError("session closed")

    def new_id(self) -> EntityGlobalId:
        """Return the id of a further entity. Raises ZError if the session has been closed."""
        self.check_open()
        return EntityGlobalId(self._zid, next(self._entity_numbers))

    def declare(self, entity: Entity) -> Callable[[], None]:
        """Declare an entity until the session is closed; return what undeclares it before."""
        self.vehicle.declare(entity)
        return self.until_end(partial(self.vehicle.undeclare, entity))

    def undeclare(self, obj: Any) -> None:
        """Undeclare what a session has declared; a key expression is none the less valid.

        Raises ZError if it has been undeclared, or if this session has not declared the key expression.
        """
        if not isinstance(obj, (str, zenoh.KeyExpr)):
            obj.undeclare()
            return
        if isinstance(obj, str) or str(obj) not in self._declared_keys:
            raise zenoh.ZError(f"Failed to undeclare {obj}: this session has not declared it")

    def new_timestamp(self) -> zenoh.Timestamp:
        """Return the present time by the vehicle's clock."""
        return self.vehicle.new_timestamp(self._zid)

    def declare_keyexpr(self, key_expr: Any) -> zenoh.KeyExpr:
        """Return the key expression. Raises ZError if the session has been closed."""
        self.check_open()
        self._declared_keys.add(str(key := key_of(key_expr)))
        return key

    def put(self, key_expr: Any, payload: Any, **options: Any) -> None:
        """Put a sample."""
        check(options)
        self.publish(PUT, key_expr, payload, **options)

    def delete(self, key_expr: Any, **options: Any) -> None:
        """Delete a key."""
        check_taken(zenoh.Session.delete, options)
        check(options)
        self.publish(DELETE, key_expr, NOTHING, **options)

    def publish(
        self,
        kind: zenoh.SampleKind,
        key: Any,
        payload: Any,
        *,
        encoding: Any = None,
        attachment: Any = None,
        timestamp: zenoh.Timestamp | None = None,
        timestamp_instrumentation: object = None,
        allowed_destination: zenoh.Locality | None = None,
        **options: Any,
    ) -> Sample:
        """Put or delete a sample, and return it."""
        self.check_open()
        look()  # a loop of puts that waits for nothing comes to the end of the run
        sample = Sample(
            key_of(key),
            zbytes_of(payload),
            kind,
            encoding_of(encoding) if kind == PUT else NO_ENCODING,
            self.new_timestamp() if timestamp is None and self.stamps else timestamp,
            attachment=bytes_or_none(attachment),
            **{name: value for name, value in options.items() if value is not None},
        )
        told = self.vehicle.stamped(sample, self._zid) if self.stamps else sample
        self.vehicle.put(self.inner, told, allowed_destination != REMOTE, allowed_destination != LOCAL)
        return sample

    def get(self, selector: Any, handler: Any = None, **options: Any) -> Any:
        """Ask for replies."""
        return self.query(self.inner.until_end, selector, handler, **options)

    def query(
        self,
        until: Callable[[Callable[[], object]], Callable[[], None]],
        selector: Any,
        handler: Any = None,
        *,
        accept_replies: zenoh.ReplyKeyExpr | None = None,
        timeout: float | int | None = None,
        timestamp_instrumentation: object = None,
        allowed_destination: zenoh.Locality | None = None,
        cancellation_token: CancellationToken | None = None,
        **options: Any,
    ) -> Any:
        """Ask for replies, until they are there or what `until` is given is called."""
        check({**options, "timeout": timeout, "timestamp_instrumentation": timestamp_instrumentation})
        check({"accept_replies": accept_replies, "allowed_destination": allowed_destination})
        check({"cancellation_token": cancellation_token}, cancellation_token=CancellationToken)
        self.check_open()
        look()
        sink, seen = sink_of(handler, self.outlet)
        selector = selector if isinstance(selector, zenoh.Selector) else zenoh.Selector(selector)
        if accept_replies == zenoh.ReplyKeyExpr.ANY and ANY_KEY not in selector.parameters:
            rest = str(selector.parameters)
            selector = zenoh.Selector(selector.key_expr, f"{rest};{ANY_KEY}" if rest else ANY_KEY)

        def ended() -> None:
            forget()
            sink.close()

        asking = Asking(selector, Direct(sink.push, ended, sink.has_room), **options)
        forget = until(asking.cancel)
        if cancellation_token is not None:
            cancellation_token.add(sink, asking)
        timeout_s = self._timeout_s if timeout is None else timeout
        self.vehicle.ask(asking, self.inner, timeout_s, allowed_destination != REMOTE, allowed_destination != LOCAL)
        return seen

    declare_subscriber = partialmethod(Subscriber)
    declare_queryable = partialmethod(Queryable)
    declare_publisher = partialmethod(Publisher)
    declare_querier = partialmethod(Querier)

    def liveliness(self) -> Liveliness:
        """Return what has tokens."""
        return Liveliness(self.inner)


class Scout(Listening):
    """Scouting, which finds the vehicle's router."""

    def __init__(self, vehicle: Vehicle, outlet: Outlet, handler: Any, what: Any) -> None:
        super().__init__(handler, outlet)
        matcher = what if isinstance(what, zenoh.WhatAmIMatcher) else zenoh.WhatAmIMatcher(what or "router|peer")
        if matcher.matches(zenoh.WhatAmI.ROUTER):
            self._sink.push(Hello(zenoh.WhatAmI.ROUTER, vehicle.zid, []))

    stop = Listening.end
