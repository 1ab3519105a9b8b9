"""Queries of `import zenoh` on virtual time: on their way, and as a queryable has them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, field
from functools import partial
from typing import Any, Literal

import msgspec
import zenoh

from vnet.gateway.emulated.values import (
    DELETE,
    NO_ENCODING,
    NOTHING,
    PUT,
    Direct,
    EntityGlobalId,
    Reply,
    ReplyError,
    Sample,
    Shown,
    Sink,
    SourceInfo,
    bytes_or_none,
    check,
    encoding_of,
    key_of,
    zbytes_of,
)

ANY_KEY = "_anyke"
"""Parameter of queries to which replies with any key are accepted."""
ALL_REPLIES: dict[str, Any] = {"target": zenoh.QueryTarget.ALL, "consolidation": zenoh.ConsolidationMode.NONE}
"""Options of queries that all are asked, and of which each reply counts."""


@dataclass(eq=False)
class Entity:
    """An entity of a session, as the vehicle has it."""

    kind: Literal["subscriber", "queryable", "token", "watcher"]
    """A "watcher" is a subscriber of tokens."""
    session: Any
    id: EntityGlobalId
    key: zenoh.KeyExpr
    sink: Sink = field(default_factory=lambda: Direct(lambda item: None))
    origin: zenoh.Locality | None = None
    is_complete: bool = False
    told: set[str] = field(default_factory=set)
    """Keys of living tokens of which a subscriber of tokens has been told."""

    def arrive(self, item: Any) -> None:
        """Take an item that comes from outside of its session."""
        self.session.outlet.intake.take(self.sink, self.sink.push, item)

    def __post_init__(self) -> None:
        self.is_local = self.origin != zenoh.Locality.REMOTE
        self.is_remote = self.origin != zenoh.Locality.SESSION_LOCAL


@dataclass(eq=False)
class Asking:
    """A query on its way: who has been asked and has not concluded yet, and which replies are passed on."""

    selector: zenoh.Selector
    sink: Sink
    """Destination of replies, closed at the end."""
    _: KW_ONLY
    target: zenoh.QueryTarget | None = None
    consolidation: Any = None
    payload: Any = None
    encoding: Any = None
    attachment: Any = None
    source_info: SourceInfo | None = None
    congestion_control: zenoh.CongestionControl | None = None
    priority: zenoh.Priority | None = None
    express: bool | None = None

    def __post_init__(self) -> None:
        self.key, self.parameters = self.selector.key_expr, self.selector.parameters
        self.takes_any_key = ANY_KEY in self.parameters
        self.target = self.target or zenoh.QueryTarget.DEFAULT
        if self.payload is not None or self.encoding is not None:
            self.encoding = encoding_of(self.encoding)
        self.payload, self.attachment = bytes_or_none(self.payload), bytes_or_none(self.attachment)
        mode = getattr(self.consolidation, "mode", self.consolidation) or zenoh.ConsolidationMode.AUTO
        if mode == zenoh.ConsolidationMode.AUTO:
            ranged = "_time" in self.parameters
            mode = zenoh.ConsolidationMode.NONE if ranged else zenoh.ConsolidationMode.LATEST
        self._consolidates = mode != zenoh.ConsolidationMode.NONE
        self._holds_back = mode == zenoh.ConsolidationMode.LATEST
        self._replies: dict[str, Reply] = {}
        self._pending = 1
        self._timer: asyncio.TimerHandle | None = None
        self.is_over = False
        self.session: Any = None
        """The session that asks, None for another vehicle."""

    @property
    def qos(self) -> dict[str, Any]:
        """Quality of service of replies: the query's own."""
        return {
            "congestion_control": self.congestion_control or zenoh.CongestionControl.BLOCK,
            "priority": self.priority or zenoh.Priority.DATA,
            "express": bool(self.express),
        }

    def accepts(self, key: zenoh.KeyExpr) -> bool:
        """Return whether a reply may have this key."""
        return self.takes_any_key or self.key.intersects(key)

    def expire_after(self, seconds: float) -> None:
        """End it then if it goes on; who has been asked before concludes first at the same instant."""
        if not self.is_over:
            self._timer = asyncio.get_running_loop().call_later(seconds, self._expire)

    def begun(self) -> Asking:
        """Take note of one more that is asked."""
        self._pending += 1
        return self

    def put_to(self, entity: Entity) -> None:
        """Have a queryable take the query."""
        if entity.session.is_closed():
            self.done(entity.session)
            return
        query = Query(self, entity)
        if not self.is_over:
            (entity.sink.push if entity.session is self.session else entity.arrive)(query)

    def reply(self, reply: Reply, session: object | None = None) -> None:
        """Take a reply of a session, None for one that comes by radio: of others it has the query's priority."""
        sample = reply.result
        if isinstance(sample, Sample) and (session is None or session is not self.session):
            reply = Reply(msgspec.structs.replace(sample, **self.qos), reply.replier_id)
        self._arrive(self._take, reply, session)

    def _arrive(self, act: Callable[[Any], object], item: Any, session: Any) -> None:
        if self.session is None or session is self.session:
            act(item)
        else:
            self.session.outlet.intake.take(self.sink, act, item)

    def _take(self, reply: Reply) -> None:
        sample = reply.result
        if self.is_over:
            return
        if not isinstance(sample, Sample) or not self._consolidates:
            self.sink.push(reply)
            return
        key = str(sample.key_expr)
        before = self._replies.get(key)
        if before is None or _is_not_older(sample, before.result):
            self._replies[key] = reply
            if not self._holds_back:
                self.sink.push(reply)

    def done(self, session: object | None = None) -> None:
        """Take note that one of those asked has concluded: a session, None for other vehicles."""
        self._arrive(self._conclude, 1, session)

    def _conclude(self, number: int) -> None:
        self._pending -= number
        if self._pending == 0:
            self._end()

    def cancel(self) -> None:
        """End the query, with what it has held back lost."""
        self._replies.clear()
        self._end()

    def _end(self, error: Reply | None = None) -> None:
        if self.is_over:
            return
        self.is_over = True
        if self._timer is not None:
            self._timer.cancel()
        if error is not None:  # first, as from Zenoh's routers: only replies are held back
            self.sink.push(error)
        if self._holds_back:
            for reply in self._replies.values():
                self.sink.push(reply)
        self.sink.close()

    def _expire(self) -> None:
        self._end(Reply(ReplyError(zenoh.ZBytes("Timeout"), NO_ENCODING)))


def _is_not_older(sample: Sample, before: Sample | ReplyError) -> bool:
    """Return whether a reply takes the place of another of its key."""
    assert isinstance(before, Sample)
    if before.timestamp is None:
        return True
    return sample.timestamp is not None and sample.timestamp >= before.timestamp


class Query:
    """A query at a queryable; it is concluded once it is dropped, or discarded, or its session closed."""

    timestamp_stack = None

    def __init__(self, asking: Asking, entity: Entity) -> None:
        self._asking, self._entity, self._is_open = asking, entity, True
        self.selector, self.key_expr = zenoh.Selector(asking.key, str(asking.parameters)), asking.key
        self.parameters = zenoh.Parameters(str(asking.parameters))
        self.payload, self.encoding = asking.payload, asking.encoding
        self.attachment, self.source_info = asking.attachment, asking.source_info
        self._conclude = entity.session.until_end(partial(asking.done, entity.session))

    def __enter__(self) -> Query:
        return self

    def __exit__(self, *_args: object, **_kwargs: object) -> None:
        self.drop()

    def __del__(self) -> None:
        self.drop()

    def __str__(self) -> str:
        self.check_declared()
        return str(self._asking.selector)

    selector, key_expr, parameters, payload = Shown(), Shown(), Shown(), Shown()
    encoding, attachment, source_info = Shown(), Shown(), Shown()

    def check_declared(self) -> None:
        """Raise ZError if it has been concluded."""
        if not self._is_open:
            raise zenoh.ZError("Dropped query")

    def accepts_replies(self) -> zenoh.ReplyKeyExpr:
        """Return which keys replies may have."""
        self.check_declared()
        any_key = self._asking.takes_any_key
        return zenoh.ReplyKeyExpr.ANY if any_key else zenoh.ReplyKeyExpr.MATCHING_QUERY

    def reply(self, key_expr: Any, payload: Any, *, encoding: Any = None, **options: Any) -> None:
        """Reply with a sample. Raises ZError for a key that the query does not match."""
        self._reply(PUT, key_expr, zbytes_of(payload), encoding_of(encoding), **options)

    def reply_del(self, key_expr: Any, **options: Any) -> None:
        """Reply that a key is deleted. Raises ZError for a key that the query does not match."""
        self._reply(DELETE, key_expr, NOTHING, NO_ENCODING, **options)

    def reply_err(self, payload: Any, *, encoding: Any = None) -> None:
        """Reply with an error."""
        self._answer(ReplyError(zbytes_of(payload), encoding_of(encoding)))

    def reply_sample(self, sample: Sample) -> None:
        """Reply with a sample that has been published, as caches do, if the query matches its key."""
        if self._asking.accepts(sample.key_expr):
            self._answer(sample)

    def _reply(
        self,
        kind: zenoh.SampleKind,
        key: Any,
        payload: zenoh.ZBytes,
        encoding: zenoh.Encoding,
        *,
        congestion_control: object = None,  # as priority, the query's own
        priority: object = None,
        express: bool | None = None,
        attachment: Any = None,
        timestamp: zenoh.Timestamp | None = None,
    ) -> None:
        check({"congestion_control": congestion_control, "priority": priority, "express": express})
        check({"timestamp": timestamp})
        asking, key_expr = self._asking, key_of(key)
        if not asking.accepts(key_expr):
            raise zenoh.ZError(f"Attempted to reply on `{key_expr}`, which does not intersect query `{asking.key}`")
        options = {**asking.qos, "attachment": bytes_or_none(attachment), "timestamp": timestamp}
        if express is not None:
            options["express"] = express
        self._answer(Sample(key_expr, payload, kind, encoding, **options))

    def _answer(self, result: Sample | ReplyError) -> None:
        self.check_declared()
        if not self._entity.session.is_closed():
            self._asking.reply(Reply(result, self._entity.id), self._entity.session)

    def drop(self) -> None:
        """Conclude it: no more replies come from here."""
        if self._is_open:
            self._is_open = False
            self._conclude()
