"""`zenoh.ext` on virtual time: publishers with a cache and heartbeats, subscribers that detect and recover misses.

Keys, parameters and rules are those of zenoh-ext 1.10 (advanced_publisher.rs, advanced_cache.rs,
advanced_subscriber.rs), so that what crosses the radio is what crosses it by a gateway.
"""

from __future__ import annotations

import asyncio
import re
import sys
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import timedelta
from functools import partial, partialmethod
from typing import Any, Literal, NoReturn
from weakref import proxy

import msgspec
import zenoh
from zenoh.ext import UInt32, z_deserialize, z_serialize

from vnet.gateway.emulated.modules import EPOCH_NS
from vnet.gateway.emulated.queries import ALL_REPLIES, ANY_KEY, Asking, Entity, Query
from vnet.gateway.emulated.sessions import Listening, LivelinessToken, Publisher, Session, Subscriber, Watcher
from vnet.gateway.emulated.values import (
    BOOL,
    PUT,
    Direct,
    EntityGlobalId,
    Reply,
    Sample,
    Sink,
    SourceInfo,
    ZenohId,
    check,
    key_of,
    unix_ns_of,
)
from vnet.runtime.own_asyncio import Task
from vnet.units import NS_PER_S

RECOVERY_TIMEOUT_S = 10.0
"""Seconds for which replies to queries of caches are awaited."""
_WITHOUT_ID = "uhlc"
"""Part of a publisher's key where its samples have timestamps and no numbers."""


@dataclass(frozen=True)
class _Config:
    def __post_init__(self) -> None:
        check(vars(self), **_KINDS)


@dataclass(frozen=True)
class RepliesConfig(_Config):
    """Quality of service of a cache's replies."""

    congestion_control: zenoh.CongestionControl | None = field(default=None, kw_only=True)
    priority: zenoh.Priority | None = field(default=None, kw_only=True)
    express: bool | None = field(default=None, kw_only=True)


@dataclass(frozen=True)
class CacheConfig(_Config):
    """A publisher's cache."""

    max_samples: int | None = None
    replies_config: RepliesConfig | None = field(default=None, kw_only=True)


@dataclass(frozen=True)
class HistoryConfig(_Config):
    """History for which a subscriber asks caches at its beginning."""

    detect_late_publishers: bool | None = field(default=None, kw_only=True)
    max_samples: int | None = field(default=None, kw_only=True)
    max_age: float | None = field(default=None, kw_only=True)

    def parameters(self) -> str:
        """Return the parameters of a query for it."""
        most = [] if self.max_samples is None else [f"_max={self.max_samples}"]
        return ";".join(most + ([] if self.max_age is None else [f"_time=[now(-{self.max_age:g}s)..]"]))


@dataclass(frozen=True)
class MissDetectionConfig(_Config):
    """Seconds between the heartbeats by which the last misses are detected; sporadic ones follow samples alone."""

    heartbeat: float | None = field(default=None, kw_only=True)
    sporadic_heartbeat: float | None = field(default=None, kw_only=True)


@dataclass(frozen=True)
class RecoveryConfig(_Config):
    """Ways to find that a subscriber's last sample was not the publisher's."""

    periodic_queries: timedelta | None = field(default=None, kw_only=True)
    heartbeat: Literal[True] | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        check(vars(self), heartbeat=BOOL)
        if (self.periodic_queries is None) == (not self.heartbeat):
            raise ValueError("invalid parameters")


_KINDS = {
    "cache": CacheConfig,
    "history": HistoryConfig,
    "recovery": RecoveryConfig,
    "replies_config": RepliesConfig,
    "sample_miss_detection": MissDetectionConfig,
    "session": Session,
}
"""Types of options that are of this module."""


class Miss(msgspec.Struct, frozen=True):
    """Samples that a subscriber has missed."""

    source: EntityGlobalId
    nb: int


def _every(seconds: float, act: Callable[[], object]) -> asyncio.Task[None]:
    async def repeat() -> None:
        while True:
            await asyncio.sleep(seconds)
            act()

    loop = asyncio.get_running_loop()
    return Task(repeat(), loop=loop)


def _absent(publisher: AdvancedPublisher) -> NoReturn:
    raise AttributeError("'AdvancedPublisher' object has no such attribute in Zenoh")


class AdvancedPublisher(Publisher):
    """A publisher whose samples can be asked for later."""

    matching_status = declare_matching_listener = property(_absent)

    def __init__(
        self,
        session: Session,
        key_expr: Any,
        *,
        cache: CacheConfig | None = None,
        sample_miss_detection: MissDetectionConfig | None = None,
        publisher_detection: bool | None = None,
        **options: Any,
    ) -> None:
        given = {"cache": cache, "sample_miss_detection": sample_miss_detection, "session": session}
        check({**given, "publisher_detection": publisher_detection}, **_KINDS)
        session = session.inner
        super().__init__(session, key_expr, **options)
        misses = sample_miss_detection
        if misses is None and cache is not None and not session.stamps:
            raise zenoh.ZError(
                f"Cannot create AdvancedPublisher {self.key_expr} with Sequencing::Timestamp: the 'timestamping' "
                "setting must be enabled in the Zenoh configuration."
            )
        self._number: int | None = None if misses is None else 0
        self._told = 0
        eid = self.id.eid if misses is not None else _WITHOUT_ID
        own_key = key_of(f"{self.key_expr}/@adv/pub/{session.zid()}/{eid}/_")
        self._cache = None if cache is None else _Cache(session, cache)
        if self._cache is not None:
            queryable = Entity("queryable", session, session.id, own_key, Direct(self._cache.answer))
            self.until_end(session.declare(queryable))
        if publisher_detection:
            self.until_end(LivelinessToken(session, own_key).end)
        if misses is not None and (period_s := misses.heartbeat or misses.sporadic_heartbeat) is not None:
            beat = partial(AdvancedPublisher._beat, proxy(self), own_key, misses.heartbeat is None)
            heart = _every(period_s, beat)
            self.until_end(session.until_end(heart.cancel))

    def _beat(self, key: zenoh.KeyExpr, sporadic: bool) -> None:
        number = self._number or 0
        if number > (self._told if sporadic else 0):
            self._told = number
            self.session.put(key, z_serialize(UInt32(number - 1)))

    def _publish(self, kind: zenoh.SampleKind, payload: Any, **options: Any) -> Sample:
        if self._number is not None:
            options["source_info"] = SourceInfo(self.id, self._number)
            self._number += 1
        sample = super()._publish(kind, payload, **options)
        if self._cache is not None:
            self._cache.samples.append(sample)
        return sample


class _Cache:
    """The last samples of a publisher."""

    def __init__(self, session: Session, config: CacheConfig) -> None:
        self.samples: deque[Sample] = deque(maxlen=config.max_samples or 1)
        self._replies = config.replies_config or RepliesConfig()
        self._node = session.vehicle.node

    def answer(self, query: Query) -> None:
        """Reply with the samples that a query asks for."""
        numbers = _numbers_of(query.parameters.get("_sn"))
        since_ns = _start_of(query.parameters.get("_time"), EPOCH_NS + self._node.now_ns)
        found = [each for each in self.samples if _is_in(each, numbers) and _is_since(each, since_ns)]
        most = query.parameters.get("_max")
        if most is not None and most.isdigit():
            found = found[max(len(found) - int(most), 0) :]
        for sample in found:
            query.reply_sample(
                msgspec.structs.replace(
                    sample,
                    kind=PUT,  # also of a delete, as Zenoh 1.10 does
                    congestion_control=self._replies.congestion_control or zenoh.CongestionControl.BLOCK,
                    priority=self._replies.priority or zenoh.Priority.DATA,
                    express=bool(self._replies.express),
                )
            )
        query.drop()


def _numbers_of(text: str | None) -> range | None:
    """Return the numbers of samples for which `_sn` asks; None is all samples, also those without a number."""
    first, dots, last = (text or "").partition("..")
    if not (first.isdigit() or last.isdigit()):
        return None
    start = int(first) if first.isdigit() else 0
    if not dots:
        return range(start, start + 1)
    return range(start, int(last) + 1 if last.isdigit() else sys.maxsize)


def _is_in(sample: Sample, numbers: range | None) -> bool:
    return numbers is None or (sample.source_info is not None and sample.source_info.source_sn in numbers)


def _start_of(text: str | None, unix_ns: int) -> int | None:
    """Return the beginning of a `_time` that ends now, as histories have it."""
    found = re.fullmatch(r"\[now\(-([\d.]+)s\)\.\.\]", text or "")
    return None if found is None else unix_ns - round(float(found[1]) * NS_PER_S)


def _is_since(sample: Sample, since_ns: int | None) -> bool:
    return since_ns is None or sample.timestamp is None or unix_ns_of(sample.timestamp) >= since_ns


class _Source:
    """A publisher at a subscriber. Its samples have places: their numbers, or without numbers their timestamps."""

    def __init__(self, source_id: EntityGlobalId | bytes) -> None:
        self.id = source_id
        """Id of the publisher, or of the timestamps of its samples."""
        self.last: int | None = None
        """Place of the last sample that was passed on."""
        self.waiting: dict[int, Sample] = {}
        self.queries = 0
        self.timer: asyncio.Task[None] | None = None

    @property
    def has_numbers(self) -> bool:
        """True if a sample that is missed leaves a gap between places."""
        return isinstance(self.id, EntityGlobalId)


class SampleMissListener(Listening):
    """A listener that is told of samples that are missed for good."""

    def __init__(self, subscriber: AdvancedSubscriber, handler: Any = None) -> None:
        super().__init__(handler, subscriber.session.outlet)
        subscriber.miss_sinks.append(self._sink)
        self._ends = dict.fromkeys([partial(subscriber.miss_sinks.remove, self._sink), self._sink.close])


class AdvancedSubscriber(Subscriber):
    """A subscriber that asks caches for what it has missed."""

    def __init__(
        self,
        session: Session,
        key_expr: Any,
        handler: Any = None,
        *,
        allowed_origin: zenoh.Locality | None = None,
        history: HistoryConfig | None = None,
        recovery: RecoveryConfig | None = None,
        subscriber_detection: bool | None = None,
    ) -> None:
        given = {"history": history, "recovery": recovery, "session": session}
        check({**given, "subscriber_detection": subscriber_detection}, **_KINDS)
        session, self._history, self._recovery = session.inner, history or HistoryConfig(), recovery
        for name in ("max_samples", "max_age"):
            if getattr(self._history, name) == 0:
                raise zenoh.ZError(f"{name} must not be zero")
        self._sources: dict[EntityGlobalId | bytes, _Source] = {}
        self._begins = history is not None
        """True until the replies to its query for history are there."""
        self.miss_sinks: list[Sink] = []
        """Destinations of what is missed for good."""
        super().__init__(session, key_expr, handler, allowed_origin=allowed_origin)
        self.until_end(session.until_end(self._stop))
        publishers = key_of(f"{self.key_expr}/@adv/pub/**")

        def declare(kind: Literal["subscriber", "watcher"], take: Callable[[Sample], None]) -> Entity:
            sink = Direct(take, has_room=self._sink.has_room)
            entity = Entity(kind, session, self.id, publishers, sink, allowed_origin)
            self.until_end(session.declare(entity))
            return entity

        if history is not None:
            self._ask(f"{self.key_expr}/@adv/**", history.parameters(), self._begun)
            if history.detect_late_publishers:
                session.vehicle.tell_present(declare("watcher", self._publisher_changed))
        if recovery is not None and recovery.heartbeat:
            declare("subscriber", self._hear_heartbeat)
        if subscriber_detection:
            token = LivelinessToken(session, f"{self.key_expr}/@adv/sub/{session.zid()}/{self.id.eid}/_")
            self.until_end(token.end)

    def _intake(self) -> Sink:
        return Direct(self._take, self._sink.close, self._sink.has_room)

    sample_miss_listener = partialmethod(SampleMissListener)

    def detect_publishers(self, handler: Any = None, *, history: bool | None = None) -> Watcher:
        """Declare a subscriber of the tokens of advanced publishers."""
        return Watcher(self.session, f"{self.key_expr}/@adv/pub/**", handler, history)

    def _stop(self) -> None:
        for source in self._sources.values():
            if source.timer is not None:
                source.timer.cancel()
        for sink in self.miss_sinks:
            sink.close()

    # Samples.

    def _take(self, sample: Sample) -> None:
        """Take a sample that was published just now, and ask for what lies before it."""
        info = sample.source_info
        is_new = info is not None and info.source_id not in self._sources
        self._handle(sample)
        if info is None:
            return
        source = self._sources[info.source_id]
        if is_new:
            self._query_periodically(source)
        if self._recovery is not None and source.queries == 0 and source.waiting:
            self._recover(source)

    def _handle(self, sample: Sample) -> None:
        """Pass a sample on, or have it wait for those before it, unless it has gone by."""
        if sample.source_info is not None:
            source, place = self._source(sample.source_info.source_id), sample.source_info.source_sn
        elif sample.timestamp is not None:
            source, place = self._source(bytes(sample.timestamp.get_id())), unix_ns_of(sample.timestamp)
        else:
            self._sink.push(sample)
            return
        if source.last is not None and place <= source.last:
            return
        if self._waits(source, place):
            source.waiting[place] = sample
            self._pass_surplus(source)
        else:
            self._pass_on(source, place, sample)

    def _source(self, source_id: EntityGlobalId | bytes) -> _Source:
        return self._sources.setdefault(source_id, _Source(source_id))

    def _waits(self, source: _Source, place: int) -> bool:
        """Return whether a sample is to wait: for those in a gap before it, or for the history."""
        if source.has_numbers and source.last is not None:
            return self._recovery is not None and place > source.last + 1
        is_asked = self._begins or (not source.has_numbers and source.queries > 0)
        return is_asked and self._history.max_samples != 1

    def _pass_on(self, source: _Source, place: int, sample: Sample) -> None:
        """Pass a sample on, and those that follow it at once; those between it and the last one are missed."""
        if isinstance(source.id, EntityGlobalId) and source.last is not None and place > source.last + 1:
            for sink in self.miss_sinks:
                sink.push(Miss(source.id, place - source.last - 1))
        self._sink.push(sample)
        while source.has_numbers and (following := source.waiting.pop(place + 1, None)) is not None:
            place += 1
            self._sink.push(following)
        source.last = place

    def _pass_surplus(self, source: _Source) -> None:
        """Pass on what waits beyond the number of samples that a history may have."""
        most = self._history.max_samples
        if most is None or len(source.waiting) < most:
            return
        if not source.has_numbers:
            self._flush(source)
        elif source.last is None:
            first = min(source.waiting)
            self._pass_on(source, first, source.waiting.pop(first))

    def _flush(self, source: _Source) -> None:
        """Pass on what waits, if no more replies are awaited."""
        if source.queries == 0:
            waiting, source.waiting = source.waiting, {}
            for place in sorted(waiting):
                if source.last is None or place > source.last:
                    self._pass_on(source, place, waiting[place])

    # Queries of caches.

    def _ask(self, key: str, parameters: str, on_end: Callable[[], object]) -> None:
        parameters = f"{parameters};{ANY_KEY}" if parameters else ANY_KEY
        sink = Direct(self._replied, on_end, self._sink.has_room)
        asking = Asking(zenoh.Selector(key, parameters), sink, **ALL_REPLIES)
        self.session.vehicle.ask(asking, self.session, RECOVERY_TIMEOUT_S, to_own=True, to_others=True)

    def _ask_about(self, source: _Source, key: str, parameters: str) -> None:
        source.queries += 1
        self._ask(key, parameters, partial(self._told_about, source))

    def _replied(self, reply: Reply) -> None:
        if reply.ok is not None and self._entity.key.intersects(reply.ok.key_expr):
            self._handle(reply.ok)

    def _begun(self) -> None:
        self._begins = False
        for source in self._sources.values():
            self._flush(source)
            self._query_periodically(source)

    def _told_about(self, source: _Source) -> None:
        source.queries -= 1
        if not self._begins:
            self._flush(source)

    def _recover(self, source: _Source, last: int | None = None, key: str = "") -> None:
        """Ask for what follows the last sample of a publisher with numbers."""
        assert isinstance(source.id, EntityGlobalId)
        first = "" if source.last is None else source.last + 1
        key = key or f"{self._entity.key}/@adv/*/{source.id.zid}/{source.id.eid}/**"
        self._ask_about(source, key, f"_sn={first}..{'' if last is None else last}")

    def _query_periodically(self, source: _Source) -> None:
        period = None if self._recovery is None else self._recovery.periodic_queries
        if period is not None and source.has_numbers:
            if source.timer is not None:
                source.timer.cancel()
            source.timer = _every(period.total_seconds(), partial(self._recover, source))

    def _hear_heartbeat(self, sample: Sample) -> None:
        source_id = _publisher_of(sample.key_expr)
        if sample.kind != zenoh.SampleKind.PUT or not isinstance(source_id, EntityGlobalId):
            return
        try:
            number = int(z_deserialize(UInt32, sample.payload))
        except zenoh.ext.ZDeserializeError:
            return
        is_new = source_id not in self._sources
        source = self._source(source_id)
        if is_new and self._begins:
            return
        if (source.last is None or number > source.last) and source.queries == 0:
            self._recover(source, number, str(sample.key_expr))

    # Publishers that come later.

    def _publisher_changed(self, token: Sample) -> None:
        source_id = _publisher_of(token.key_expr)
        if token.kind != zenoh.SampleKind.PUT or source_id is None:
            return
        is_new = source_id not in self._sources
        source = self._source(source_id)
        if is_new:
            self._query_periodically(source)
        self._ask_about(source, str(token.key_expr), self._history.parameters())


def _publisher_of(key: zenoh.KeyExpr) -> EntityGlobalId | bytes | None:
    """Return the publisher that a key `…/@adv/pub/ZID/EID/_` names; without numbers the id of its timestamps."""
    found = re.search(r"(?:^|/)@adv/pub/([0-9a-f]+)/(\w+)(?:/|$)", str(key))
    if found is None or not (found[2] == _WITHOUT_ID or found[2].isdigit()):
        return None
    zid = ZenohId(int(found[1], 16))
    return bytes(zid) if found[2] == _WITHOUT_ID else EntityGlobalId(zid, int(found[2]))


declare_advanced_publisher, declare_advanced_subscriber = AdvancedPublisher, AdvancedSubscriber
