"""Sessions of `import zenoh` on virtual time, and what they declare."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import count
from typing import Any

import msgspec
import zenoh

from vnet.gateway.emulated.values import (
    EntityGlobalId,
    Hello,
    MatchingStatus,
    Outlet,
    Reply,
    ReplyError,
    Sample,
    SourceInfo,
    ZenohId,
    key_of,
    sink_of,
)
from vnet.gateway.emulated.vehicle import ANY_KEY, LOCAL, REMOTE, Asking, Entity, Vehicle, token_sample

QUERY_TIMEOUT_S = 10.0
"""Zenoh's own `queries_default_timeout`."""
_NO_ENCODING = zenoh.Encoding.ZENOH_BYTES
_NOTHING = zenoh.ZBytes(b"")
PUT, DELETE = zenoh.SampleKind.PUT, zenoh.SampleKind.DELETE


def _key(key: Any) -> zenoh.KeyExpr:
    return key if isinstance(key, zenoh.KeyExpr) else key_of(key)


def _bytes(content: Any) -> zenoh.ZBytes:
    return content if isinstance(content, zenoh.ZBytes) else zenoh.ZBytes(content)


def _bytes_or_none(content: Any) -> zenoh.ZBytes | None:
    return None if content is None else _bytes(content)


def _encoding(encoding: Any, default: zenoh.Encoding = _NO_ENCODING) -> zenoh.Encoding:
    if encoding is None:
        return default
    return encoding if isinstance(encoding, zenoh.Encoding) else zenoh.Encoding(encoding)


def _refuse_instrumentation(instrumentation: object) -> None:
    if instrumentation is not None:
        raise zenoh.ZError(
            "timestamp_instrumentation is not available on virtual time: Zenoh has no transport here"
        )


class Declared:
    """What a session has declared, until it is undeclared; a `with` block undeclares it."""

    _is_declared = True

    def __enter__(self) -> Any:
        return self

    def __exit__(self, *_args: object, **_kwargs: object) -> None:
        self.undeclare()

    def undeclare(self) -> None:
        """Undeclare it. Raises ZError if it has been."""
        if not self._is_declared:
            raise zenoh.ZError("Undeclared")
        self._is_declared = False
        self._end()

    def undeclare_if_declared(self) -> None:
        """Undeclare it unless it has been."""
        if self._is_declared:
            self.undeclare()

    def _end(self) -> None:
        """Do what undeclaring is."""


class Listening(Declared):
    """What a session has declared that takes items, with the end of the channel that the program reads."""

    _end_of: Callable[[], object] = staticmethod(lambda: None)
    _handler: Any = None
    _is_background = False

    def __class_getitem__(cls, item: object) -> type[Listening]:
        return cls

    @property
    def handler(self) -> Any:
        """The handler."""
        return self._handler

    def try_recv(self) -> Any:
        """Return the next item, None if there is none now."""
        return self._handler.try_recv()

    def recv(self) -> Any:
        """Return the next item; block until there is one."""
        return self._handler.recv()

    def __iter__(self) -> Any:
        return iter(self._handler)

    def _end(self) -> None:
        self._end_of()

    def __del__(self) -> None:
        if self._is_declared and not self._is_background:
            self._is_declared = False
            self._end_of()


class _Entity(Listening):
    """A subscriber or a queryable."""

    _kind = ""

    def __init__(
        self, session: Session, key: Any, handler: Any, origin: zenoh.Locality | None, complete: bool = False
    ) -> None:
        self._is_declared = False
        session.check_open()
        sink, self._handler, self._is_background = sink_of(handler, session.outlet)
        entity = Entity(
            session, _key(key), sink, origin != REMOTE, origin != LOCAL, complete, next(session.entity_numbers)
        )
        self._entity, self._is_declared = entity, True
        self._end_of = partial(session.vehicle.undeclare, self._kind, entity)
        session.declare(self._kind, entity)

    @property
    def id(self) -> EntityGlobalId:
        """The id of the entity."""
        return EntityGlobalId(self._entity.session.zid(), self._entity.eid)

    @property
    def key_expr(self) -> zenoh.KeyExpr:
        """The key expression."""
        return self._entity.key


class Subscriber(_Entity):
    """A subscriber."""

    _kind = "subscriber"


class Queryable(_Entity):
    """A queryable."""

    _kind = "queryable"


class Watcher(Subscriber):
    """A subscriber of tokens."""

    _kind = "watcher"

    def __init__(self, session: Session, key: Any, handler: Any, history: bool) -> None:
        super().__init__(session, key, handler, None)
        if history:
            session.vehicle.tell_present(self._entity)


class LivelinessToken(Declared):
    """A token."""

    def __init__(self, session: Session, key: Any) -> None:
        self._is_declared = False
        session.check_open()
        self._session = session
        self._entity = Entity(session, _key(key), eid=next(session.entity_numbers))
        self._is_declared = True
        session.declare("token", self._entity)

    def _end(self) -> None:
        self._session.vehicle.undeclare("token", self._entity)

    def __del__(self) -> None:
        if self._is_declared:
            self._is_declared = False
            self._end()


class Liveliness:
    """Tokens of a session, and of others."""

    def __init__(self, session: Session) -> None:
        self._session = session

    def declare_token(self, key_expr: Any) -> LivelinessToken:
        """Declare a token, which is there until it is undeclared or discarded."""
        return LivelinessToken(self._session, key_expr)

    def declare_subscriber(self, key_expr: Any, handler: Any = None, *, history: bool | None = None) -> Subscriber:
        """Declare a subscriber that is told of tokens, with `history` also of those that are there."""
        return Watcher(self._session, key_expr, handler, bool(history))

    def get(
        self,
        key_expr: Any,
        handler: Any = None,
        *,
        timeout: float | int | None = None,
        cancellation_token: CancellationToken | None = None,
    ) -> Any:
        """Get the tokens that are there: those of other vehicles as far as they have been heard."""
        self._session.check_open()
        sink, seen, _ = sink_of(handler, self._session.outlet)
        tokens = self._session.vehicle.tokens(_key(key_expr))
        if cancellation_token is None or not cancellation_token.is_cancelled:
            for token in tokens:
                sink.push(Reply(token_sample(token, alive=True)))
        sink.close()
        return seen


class CancellationToken:
    """A token that ends queries."""

    def __init__(self) -> None:
        self._is_cancelled = False
        self._askings: list[Asking] = []

    def cancel(self) -> None:
        """End the queries that have it, now and later."""
        self._is_cancelled = True
        for asking in self._askings:
            asking.cancel()
        self._askings.clear()

    @property
    def is_cancelled(self) -> bool:
        """Whether `cancel` was called."""
        return self._is_cancelled

    def add(self, asking: Asking) -> None:
        """Have it end a query."""
        self._askings.append(asking)
        if self._is_cancelled:
            self.cancel()


class Query:
    """A query at a queryable; it is concluded once it is dropped, or discarded."""

    def __init__(self, asking: Asking, entity: Entity) -> None:
        self._asking = asking
        self._entity = entity
        self._is_open = True

    def __enter__(self) -> Query:
        return self

    def __exit__(self, *_args: object, **_kwargs: object) -> None:
        self.drop()

    def __del__(self) -> None:
        self.drop()

    @property
    def selector(self) -> zenoh.Selector:
        """The selector."""
        return zenoh.Selector(self._asking.key, str(self._asking.parameters))

    @property
    def key_expr(self) -> zenoh.KeyExpr:
        """The key expression."""
        return self._asking.key

    @property
    def parameters(self) -> zenoh.Parameters:
        """The parameters."""
        return zenoh.Parameters(str(self._asking.parameters))

    @property
    def payload(self) -> zenoh.ZBytes | None:
        """The payload."""
        return self._asking.payload

    @property
    def encoding(self) -> zenoh.Encoding | None:
        """The encoding of the payload."""
        return self._asking.encoding

    @property
    def attachment(self) -> zenoh.ZBytes | None:
        """The attachment."""
        return self._asking.attachment

    @property
    def source_info(self) -> SourceInfo | None:
        """Who asks, if it says so."""
        return self._asking.source_info

    @property
    def timestamp_stack(self) -> None:
        """None: instrumentation of timestamps is refused."""
        return

    def accepts_replies(self) -> zenoh.ReplyKeyExpr:
        """Return which keys replies may have."""
        any_key = self._asking.takes_any_key
        return zenoh.ReplyKeyExpr.ANY if any_key else zenoh.ReplyKeyExpr.MATCHING_QUERY

    def reply(
        self,
        key_expr: Any,
        payload: Any,
        *,
        encoding: Any = None,
        congestion_control: Any = None,
        priority: Any = None,
        express: bool | None = None,
        attachment: Any = None,
        timestamp: zenoh.Timestamp | None = None,
    ) -> None:
        """Reply with a sample. Raises ZError for a key that the query does not match."""
        self._reply(PUT, key_expr, _bytes(payload), _encoding(encoding), express, attachment, timestamp)

    def reply_del(
        self,
        key_expr: Any,
        *,
        congestion_control: Any = None,
        priority: Any = None,
        express: bool | None = None,
        attachment: Any = None,
        timestamp: zenoh.Timestamp | None = None,
    ) -> None:
        """Reply that a key is deleted. Raises ZError for a key that the query does not match."""
        self._reply(DELETE, key_expr, _NOTHING, _NO_ENCODING, express, attachment, timestamp)

    def reply_err(self, payload: Any, *, encoding: Any = None) -> None:
        """Reply with an error."""
        self._check_open()
        self._asking.reply(Reply(ReplyError(_bytes(payload), _encoding(encoding)), self._replier()))

    def reply_sample(self, sample: Sample) -> None:
        """Reply with a sample that has been published, as caches do."""
        self._check_open()
        self._asking.reply(Reply(sample, self._replier()))

    def _reply(
        self, kind: Any, key: Any, payload: zenoh.ZBytes, encoding: Any, express: Any, attachment: Any, time: Any
    ) -> None:
        self._check_open()
        key_expr = _key(key)
        asking = self._asking
        if not asking.takes_any_key and not asking.key.intersects(key_expr):
            raise zenoh.ZError(
                f"Attempted to reply on `{key_expr}`, which does not intersect with query `{asking.key}`"
            )
        sample = Sample(
            key_expr,
            payload,
            kind,
            encoding,
            time,
            asking.congestion_control,
            asking.priority,
            asking.express if express is None else express,
            _bytes_or_none(attachment),
        )
        asking.reply(Reply(sample, self._replier()))

    def _replier(self) -> EntityGlobalId:
        return EntityGlobalId(self._entity.session.zid(), self._entity.eid)

    def _check_open(self) -> None:
        if not self._is_open:
            raise zenoh.ZError("the query has been dropped")

    def drop(self) -> None:
        """Conclude it: no more replies come from here."""
        if self._is_open:
            self._is_open = False
            self._asking.done()

    def __str__(self) -> str:
        return str(self.selector)


class MatchingListener(Listening):
    """A listener that is told whether there is anybody at the other end."""

    def __init__(self, owner: Publisher | Querier, handler: Any) -> None:
        session = owner._session
        sink, self._handler, self._is_background = sink_of(handler, session.outlet)
        self._owner, self._sink = owner, sink
        self._matching = False
        session.vehicle.on_matching.append(self._look)
        self._look()

    def _look(self) -> None:
        matching = self._owner.matching_status.matching
        if matching != self._matching:
            self._matching = matching
            self._sink.push(MatchingStatus(matching))

    def _end_of(self) -> None:
        self._owner._session.vehicle.on_matching.remove(self._look)
        self._sink.close()


class Publisher(Declared):
    """A publisher."""

    def __init__(self, session: Session, key: Any, options: dict[str, Any]) -> None:
        session.check_open()
        self._session = session
        self._key = _key(key)
        self._eid = next(session.entity_numbers)
        self._encoding = _encoding(options["encoding"])
        self._congestion_control = options["congestion_control"] or zenoh.CongestionControl.DEFAULT
        self._priority = options["priority"] or zenoh.Priority.DEFAULT
        self._express = bool(options["express"])
        self._reliability = options["reliability"] or zenoh.Reliability.RELIABLE
        self._destination = options["allowed_destination"]
        session.publishers.append(self)

    @property
    def id(self) -> EntityGlobalId:
        """The id of the publisher."""
        return EntityGlobalId(self._session.zid(), self._eid)

    @property
    def key_expr(self) -> zenoh.KeyExpr:
        """The key expression."""
        return self._key

    @property
    def encoding(self) -> zenoh.Encoding:
        """The encoding of samples that say none."""
        return self._encoding

    @property
    def congestion_control(self) -> zenoh.CongestionControl:
        """The congestion control of its samples."""
        return self._congestion_control

    @property
    def priority(self) -> zenoh.Priority:
        """The priority of its samples."""
        return self._priority

    @property
    def reliability(self) -> zenoh.Reliability:
        """The reliability that was asked for; the radio has its own."""
        return self._reliability

    @property
    def matching_status(self) -> MatchingStatus:
        """Whether anybody may take its samples."""
        return MatchingStatus(self._session.vehicle.matches_subscriber(self._key))

    def put(
        self,
        payload: Any,
        *,
        encoding: Any = None,
        attachment: Any = None,
        timestamp: zenoh.Timestamp | None = None,
        timestamp_instrumentation: object = None,
        source_info: SourceInfo | None = None,
    ) -> None:
        """Put a sample."""
        _refuse_instrumentation(timestamp_instrumentation)
        self._put(PUT, _bytes(payload), _encoding(encoding, self._encoding), attachment, timestamp, source_info)

    def delete(
        self,
        *,
        attachment: Any = None,
        timestamp: zenoh.Timestamp | None = None,
        timestamp_instrumentation: object = None,
        source_info: SourceInfo | None = None,
    ) -> None:
        """Delete the key."""
        _refuse_instrumentation(timestamp_instrumentation)
        self._put(DELETE, _NOTHING, _NO_ENCODING, attachment, timestamp, source_info)

    def _put(
        self, kind: Any, payload: zenoh.ZBytes, encoding: zenoh.Encoding, attachment: Any, time: Any, source: Any
    ) -> Sample:
        if not self._is_declared:
            raise zenoh.ZError("Undeclared Publisher")
        self._session.check_open()
        sample = Sample(
            self._key,
            payload,
            kind,
            encoding,
            time or self._session.stamp(),
            self._congestion_control,
            self._priority,
            self._express,
            _bytes_or_none(attachment),
            source,
        )
        self._session.send(sample, self._destination)
        return sample

    def declare_matching_listener(self, handler: Any = None) -> MatchingListener:
        """Declare a listener that is told whether anybody may take its samples."""
        return MatchingListener(self, handler)


class Querier(Declared):
    """A querier."""

    def __init__(self, session: Session, key: Any, options: dict[str, Any]) -> None:
        session.check_open()
        self._session = session
        self._key = _key(key)
        self._eid = next(session.entity_numbers)
        self._options = options

    @property
    def id(self) -> EntityGlobalId:
        """The id of the querier."""
        return EntityGlobalId(self._session.zid(), self._eid)

    @property
    def key_expr(self) -> zenoh.KeyExpr:
        """The key expression."""
        return self._key

    @property
    def accept_replies(self) -> zenoh.ReplyKeyExpr:
        """Which keys replies may have."""
        return self._options["accept_replies"] or zenoh.ReplyKeyExpr.DEFAULT

    @property
    def matching_status(self) -> MatchingStatus:
        """Whether anybody may answer."""
        complete = self._options["target"] == zenoh.QueryTarget.ALL_COMPLETE
        return MatchingStatus(self._session.vehicle.matches_queryable(self._key, complete))

    def get(
        self,
        handler: Any = None,
        *,
        parameters: Any = None,
        payload: Any = None,
        encoding: Any = None,
        attachment: Any = None,
        source_info: SourceInfo | None = None,
        cancellation_token: CancellationToken | None = None,
        timestamp_instrumentation: object = None,
    ) -> Any:
        """Ask for replies."""
        if not self._is_declared:
            raise zenoh.ZError("Undeclared Querier")
        selector = zenoh.Selector(self._key, parameters)
        return self._session.get(
            selector,
            handler,
            payload=payload,
            encoding=encoding,
            attachment=attachment,
            source_info=source_info,
            cancellation_token=cancellation_token,
            timestamp_instrumentation=timestamp_instrumentation,
            **self._options,
        )

    def declare_matching_listener(self, handler: Any = None) -> MatchingListener:
        """Declare a listener that is told whether anybody may answer."""
        return MatchingListener(self, handler)


class SessionInfo:
    """What a session knows of its surroundings: the router of its vehicle."""

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

    def transports(self) -> list[Any]:
        """Return none: a session of the emulator has no transport."""
        return []

    def links(self) -> list[Any]:
        """Return none, as `transports`."""
        return []

    def declare_transport_events_listener(self, handler: Any = None, *, history: bool | None = None) -> Any:
        """Refuse. Raises ZError."""
        raise zenoh.ZError("transport events are not available on virtual time: sessions have no transport")

    declare_link_events_listener = declare_transport_events_listener


class Session:
    """A session."""

    def __init__(self, vehicle: Vehicle, outlet: Outlet, config: zenoh.Config) -> None:
        self.vehicle = vehicle
        self.outlet = outlet
        self.entity_numbers = count(1)
        self.publishers: list[Publisher] = []
        self._zid = vehicle.new_zid()
        self._is_closed = False
        self._entities: list[tuple[str, Entity]] = []
        self._at_close: list[Callable[[], object]] = []
        self._stamps = stamps_own(config)
        vehicle.sessions.append(self)

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *_args: object, **_kwargs: object) -> None:
        self.close()

    @property
    def info(self) -> SessionInfo:
        """What the session knows of its surroundings."""
        return SessionInfo(self)

    @property
    def id(self) -> EntityGlobalId:
        """The session's id as that of an entity."""
        return EntityGlobalId(self._zid, 0)

    def zid(self) -> ZenohId:
        """Return the session's id."""
        return self._zid

    def close(self) -> None:
        """Undeclare all that the session has declared."""
        if self._is_closed:
            return
        for end in self._at_close:
            end()
        for kind, entity in self._entities:
            self.vehicle.undeclare(kind, entity)
        self._is_closed = True
        self.vehicle.sessions.remove(self)

    def is_closed(self) -> bool:
        """Return whether it has been closed."""
        return self._is_closed

    def check_open(self) -> None:
        """Raise ZError if it has been closed."""
        if self._is_closed:
            raise zenoh.ZError("session closed")

    def declare(self, kind: str, entity: Entity) -> None:
        """Declare an entity, until the session is closed."""
        self._entities.append((kind, entity))
        self.vehicle.declare(kind, entity)

    def at_close(self, end: Callable[[], object]) -> None:
        """Have `end` called when the session is closed."""
        self._at_close.append(end)

    def undeclare(self, obj: Any) -> None:
        """Undeclare a key expression, which is none the less valid."""

    def new_timestamp(self) -> zenoh.Timestamp:
        """Return the present time by the vehicle's clock."""
        return self.vehicle.new_timestamp(self._zid)

    def stamp(self) -> zenoh.Timestamp | None:
        """Return the timestamp of a sample that has none, if the session's configuration asks for one."""
        return self.new_timestamp() if self._stamps else None

    def declare_keyexpr(self, key_expr: Any) -> zenoh.KeyExpr:
        """Return the key expression."""
        return _key(key_expr)

    def send(self, sample: Sample, destination: zenoh.Locality | None) -> None:
        """Put a sample."""
        self.vehicle.put(self, sample, destination != REMOTE, destination != LOCAL)

    def put(
        self,
        key_expr: Any,
        payload: Any,
        *,
        encoding: Any = None,
        congestion_control: zenoh.CongestionControl | None = None,
        priority: zenoh.Priority | None = None,
        express: bool | None = None,
        attachment: Any = None,
        timestamp: zenoh.Timestamp | None = None,
        timestamp_instrumentation: object = None,
        allowed_destination: zenoh.Locality | None = None,
        source_info: SourceInfo | None = None,
    ) -> None:
        """Put a sample."""
        _refuse_instrumentation(timestamp_instrumentation)
        self.check_open()
        sample = Sample(
            _key(key_expr),
            _bytes(payload),
            PUT,
            _encoding(encoding),
            timestamp or self.stamp(),
            congestion_control or zenoh.CongestionControl.DEFAULT,
            priority or zenoh.Priority.DEFAULT,
            bool(express),
            _bytes_or_none(attachment),
            source_info,
        )
        self.send(sample, allowed_destination)

    def delete(
        self,
        key_expr: Any,
        *,
        congestion_control: zenoh.CongestionControl | None = None,
        priority: zenoh.Priority | None = None,
        express: bool | None = None,
        attachment: Any = None,
        timestamp: zenoh.Timestamp | None = None,
        timestamp_instrumentation: object = None,
        allowed_destination: zenoh.Locality | None = None,
        source_info: SourceInfo | None = None,
    ) -> None:
        """Delete a key."""
        _refuse_instrumentation(timestamp_instrumentation)
        self.check_open()
        sample = Sample(
            _key(key_expr),
            _NOTHING,
            DELETE,
            _NO_ENCODING,
            timestamp or self.stamp(),
            congestion_control or zenoh.CongestionControl.DEFAULT,
            priority or zenoh.Priority.DEFAULT,
            bool(express),
            _bytes_or_none(attachment),
            source_info,
        )
        self.send(sample, allowed_destination)

    def get(
        self,
        selector: Any,
        handler: Any = None,
        *,
        target: zenoh.QueryTarget | None = None,
        consolidation: Any = None,
        accept_replies: zenoh.ReplyKeyExpr | None = None,
        timeout: float | int | None = None,
        congestion_control: zenoh.CongestionControl | None = None,
        priority: zenoh.Priority | None = None,
        express: bool | None = None,
        payload: Any = None,
        encoding: Any = None,
        attachment: Any = None,
        timestamp_instrumentation: object = None,
        allowed_destination: zenoh.Locality | None = None,
        source_info: SourceInfo | None = None,
        cancellation_token: CancellationToken | None = None,
    ) -> Any:
        """Ask for replies."""
        _refuse_instrumentation(timestamp_instrumentation)
        self.check_open()
        sink, seen, _ = sink_of(handler, self.outlet)
        selector = zenoh.Selector(selector) if not isinstance(selector, zenoh.Selector) else selector
        if accept_replies == zenoh.ReplyKeyExpr.ANY and ANY_KEY not in selector.parameters:
            rest = str(selector.parameters)
            selector = zenoh.Selector(selector.key_expr, f"{rest};{ANY_KEY}" if rest else ANY_KEY)
        if isinstance(consolidation, zenoh.QueryConsolidation):
            consolidation = consolidation.mode
        asking = Asking(
            selector,
            sink.push,
            sink.close,
            target=target or zenoh.QueryTarget.DEFAULT,
            consolidation=consolidation or zenoh.ConsolidationMode.AUTO,
            payload=_bytes_or_none(payload),
            encoding=_encoding(encoding) if payload is not None or encoding is not None else None,
            attachment=_bytes_or_none(attachment),
            source_info=source_info,
            congestion_control=congestion_control or zenoh.CongestionControl.BLOCK,
            priority=priority or zenoh.Priority.DATA,
            express=bool(express),
        )
        asking.expire_after(QUERY_TIMEOUT_S if timeout is None else timeout)
        if cancellation_token is not None:
            cancellation_token.add(asking)
            if asking.is_over:
                return seen
        self.vehicle.ask(asking, self, allowed_destination != REMOTE, allowed_destination != LOCAL)
        return seen

    def declare_subscriber(
        self, key_expr: Any, handler: Any = None, *, allowed_origin: zenoh.Locality | None = None
    ) -> Subscriber:
        """Declare a subscriber."""
        return Subscriber(self, key_expr, handler, allowed_origin)

    def declare_queryable(
        self,
        key_expr: Any,
        handler: Any = None,
        *,
        complete: bool | None = None,
        allowed_origin: zenoh.Locality | None = None,
    ) -> Queryable:
        """Declare a queryable."""
        return Queryable(self, key_expr, handler, allowed_origin, bool(complete))

    def declare_publisher(
        self,
        key_expr: Any,
        *,
        encoding: Any = None,
        congestion_control: zenoh.CongestionControl | None = None,
        priority: zenoh.Priority | None = None,
        express: bool | None = None,
        reliability: zenoh.Reliability | None = None,
        allowed_destination: zenoh.Locality | None = None,
    ) -> Publisher:
        """Declare a publisher."""
        options = locals()
        return Publisher(self, key_expr, options)

    def declare_querier(
        self,
        key_expr: Any,
        *,
        target: zenoh.QueryTarget | None = None,
        consolidation: Any = None,
        accept_replies: zenoh.ReplyKeyExpr | None = None,
        timeout: float | int | None = None,
        congestion_control: zenoh.CongestionControl | None = None,
        priority: zenoh.Priority | None = None,
        express: bool | None = None,
        allowed_destination: zenoh.Locality | None = None,
    ) -> Querier:
        """Declare a querier."""
        options = {name: value for name, value in locals().items() if name not in ("self", "key_expr")}
        return Querier(self, key_expr, options)

    def liveliness(self) -> Liveliness:
        """Return what has tokens."""
        return Liveliness(self)


def stamps_own(config: zenoh.Config) -> bool:
    """Return whether a configuration has its session give timestamps."""
    enabled = msgspec.json.decode(config.get_json("timestamping/enabled"))
    mode = msgspec.json.decode(config.get_json("mode")) or "peer"
    return bool(enabled.get(mode) if isinstance(enabled, dict) else enabled)


class Scout(Listening):
    """Scouting, which finds the vehicle's router."""

    def __init__(self, vehicle: Vehicle, outlet: Outlet, handler: Any, what: Any) -> None:
        sink, self._handler, self._is_background = sink_of(handler, outlet)
        self._end_of = sink.close
        matcher = what if isinstance(what, zenoh.WhatAmIMatcher) else zenoh.WhatAmIMatcher(what or "router|peer")
        if matcher.matches(zenoh.WhatAmI.ROUTER):
            sink.push(Hello(zenoh.WhatAmI.ROUTER, vehicle.zid, []))

    def stop(self) -> None:
        """Stop scouting."""
        self.undeclare()
