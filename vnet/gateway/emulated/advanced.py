"""`zenoh.ext` on virtual time: publishers with a cache and heartbeats, subscribers that detect and recover misses.

Keys, parameters and rules are those of zenoh-ext 1.10 (advanced_publisher.rs, advanced_cache.rs,
advanced_subscriber.rs), so that what crosses the radio is what crosses it by a gateway.
"""

from __future__ import annotations

import asyncio
import re
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

import msgspec
import zenoh
from zenoh.ext import UInt32, z_deserialize, z_serialize

from vnet.gateway.emulated.modules import EPOCH_NS
from vnet.gateway.emulated.queries import ALL_REPLIES, ANY_KEY, Asking, Entity, Query
from vnet.gateway.emulated.sessions import Listening, LivelinessToken, Publisher, Session, Watcher
from vnet.gateway.emulated.values import Direct, EntityGlobalId, Reply, Sample, SourceInfo, ZenohId, key_of
from vnet.runtime.own_asyncio import Task
from vnet.units import NS_PER_S

RECOVERY_TIMEOUT_S = 10.0
"""Seconds for which replies to queries of caches are awaited."""
_WITHOUT_ID = "uhlc"
"""Part of a publisher's key where its samples have timestamps and no numbers."""


@dataclass(frozen=True)
class RepliesConfig:
    """Quality of service of a cache's replies."""

    congestion_control: zenoh.CongestionControl | None = field(default=None, kw_only=True)
    priority: zenoh.Priority | None = field(default=None, kw_only=True)
    express: bool | None = field(default=None, kw_only=True)


@dataclass(frozen=True)
class CacheConfig:
    """A publisher's cache."""

    max_samples: int | None = None
    replies_config: RepliesConfig | None = field(default=None, kw_only=True)


@dataclass(frozen=True)
class HistoryConfig:
    """History for which a subscriber asks caches at its beginning."""

    detect_late_publishers: bool | None = field(default=None, kw_only=True)
    max_samples: int | None = field(default=None, kw_only=True)
    max_age: float | None = field(default=None, kw_only=True)

    def parameters(self) -> str:
        """Return the parameters of a query for it."""
        most = [] if self.max_samples is None else [f"_max={self.max_samples}"]
        return ";".join(most + ([] if self.max_age is None else [f"_time=[now(-{self.max_age:g}s)..]"]))


@dataclass(frozen=True)
class MissDetectionConfig:
    """Seconds between the heartbeats by which the last misses are detected; sporadic ones follow samples alone."""

    heartbeat: float | None = field(default=None, kw_only=True)
    sporadic_heartbeat: float | None = field(default=None, kw_only=True)


@dataclass(frozen=True)
class RecoveryConfig:
    """Ways to find that a subscriber's last sample was not the publisher's."""

    periodic_queries: Any = field(default=None, kw_only=True)
    heartbeat: Literal[True] | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        if (self.periodic_queries is None) == (not self.heartbeat):
            raise ValueError("invalid parameters")


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


class AdvancedPublisher(Publisher):
    """A publisher whose samples can be asked for later."""

    def __init__(
        self,
        session: Session,
        key: Any,
        *,
        cache: CacheConfig | None = None,
        sample_miss_detection: MissDetectionConfig | None = None,
        publisher_detection: bool | None = None,
        **options: Any,
    ) -> None:
        super().__init__(session, key, **options)
        misses = sample_miss_detection
        if misses is None and cache is not None and not session.stamps:
            self._is_declared = False
            raise zenoh.ZError(
                f"Cannot create AdvancedPublisher {self.key_expr} with Sequencing::Timestamp: the 'timestamping' "
                "setting must be enabled in the Zenoh configuration."
            )
        self._number: int | None = None if misses is None else 0
        eid = self.id.eid if misses is not None else _WITHOUT_ID
        own_key = key_of(f"{self.key_expr}/@adv/pub/{session.zid()}/{eid}/_")
        self._cache = None if cache is None else _Cache(session, own_key, cache)
        self._token = LivelinessToken(session, own_key) if publisher_detection else None
        self._heart: asyncio.Task[None] | None = None
        self._told = 0
        if misses is not None and (period_s := misses.heartbeat or misses.sporadic_heartbeat) is not None:
            self._heart = _every(period_s, partial(self._beat, own_key, misses.heartbeat is None))
            session.at_close(self._heart.cancel)
        self._end = self._end_all

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

    def _end_all(self) -> None:
        if self._heart is not None:
            self._heart.cancel()
        if self._token is not None:
            self._token.undeclare_if_declared()
        if self._cache is not None:
            self._cache.end()


class _Cache:
    """The last samples of a publisher, and a queryable that has them."""

    def __init__(self, session: Session, key: zenoh.KeyExpr, config: CacheConfig) -> None:
        self.samples: deque[Sample] = deque(maxlen=config.max_samples or 1)
        self._replies = config.replies_config or RepliesConfig()
        entity = Entity(session, key, Direct(self._answer))
        session.declare("queryable", entity)
        self._node = session.vehicle.node
        self.end = partial(session.end, entity)

    def _answer(self, query: Query) -> None:
        first, last = _range_of(query.parameters.get("_sn"))
        since_ns = _start_of(query.parameters.get("_time"), EPOCH_NS + self._node.now_ns)
        found = [each for each in self.samples if _is_in(each, first, last) and _is_since(each, since_ns)]
        most = query.parameters.get("_max")
        if most is not None and most.isdigit():
            found = found[max(len(found) - int(most), 0) :]
        for sample in found:
            query.reply_sample(
                msgspec.structs.replace(
                    sample,
                    congestion_control=self._replies.congestion_control or zenoh.CongestionControl.BLOCK,
                    priority=self._replies.priority or zenoh.Priority.DATA,
                    express=bool(self._replies.express),
                )
            )
        query.drop()


def _range_of(text: str | None) -> tuple[int | None, int | None]:
    """Return the first and the last number of `_sn`; None is no bound."""
    first, dots, last = (text or "..").partition("..")
    least = int(first) if first.isdigit() else None
    return least, (int(last) if last.isdigit() else None) if dots else least


def _is_in(sample: Sample, first: int | None, last: int | None) -> bool:
    if first is None and last is None:
        return True
    number = None if sample.source_info is None else sample.source_info.source_sn
    return number is not None and (first or 0) <= number and (last is None or number <= last)


def _start_of(text: str | None, unix_ns: int) -> int | None:
    """Return the beginning of a `_time` that ends now, as histories have it."""
    found = re.fullmatch(r"\[now\(-([\d.]+)s\)\.\.\]", text or "")
    return None if found is None else unix_ns - round(float(found[1]) * NS_PER_S)


def _is_since(sample: Sample, since_ns: int | None) -> bool:
    if since_ns is None or sample.timestamp is None:
        return True
    time = sample.timestamp.get_time_as_ntp64()
    return time.as_secs() * NS_PER_S + time.subsec_nanos() >= since_ns


class _Source:
    """State of one publisher at a subscriber: samples by number, or by timestamp."""

    def __init__(self) -> None:
        self.last: Any = None
        """Number or timestamp of the last sample that was passed on."""
        self.waiting: dict[Any, Sample] = {}
        self.queries = 0
        self.timer: asyncio.Task[None] | None = None


class AdvancedSubscriber(Listening):
    """A subscriber that asks caches for what it has missed."""

    def __init__(
        self,
        session: Session,
        key: Any,
        handler: Any,
        *,
        allowed_origin: zenoh.Locality | None = None,
        history: HistoryConfig | None = None,
        recovery: RecoveryConfig | None = None,
        subscriber_detection: bool | None = None,
    ) -> None:
        session.check_open()
        self._history, self._recovery, self.session = history, recovery, session
        for name, value in (("max_samples", self._most), ("max_age", history and history.max_age)):
            if value == 0:
                raise zenoh.ZError(f"{name} must not be zero")
        super().__init__(handler, session.outlet)
        self._sources: dict[EntityGlobalId, _Source] = {}
        self._stamped: dict[bytes, _Source] = {}
        self._queries = 0 if history is None else 1
        self._misses: list[SampleMissListener] = []
        self._ends: list[Callable[[], object]] = [self._stop_timers]
        self._end = self._end_all
        sink = Direct(self._take, self._sink.close)
        self._main = Entity(session, key_of(key), sink, allowed_origin, eid=next(session.entity_numbers))
        self.id, self.key_expr = self._main.id, self._main.key
        self._declare("subscriber", self._main)
        publishers = key_of(f"{self.key_expr}/@adv/pub/**")
        if history is not None:
            self._ask(f"{self.key_expr}/@adv/**", history.parameters(), self._initial_done)
            if history.detect_late_publishers:
                watcher = Entity(session, publishers, Direct(self._publisher_changed))
                self._declare("watcher", watcher)
                session.vehicle.tell_present(watcher)
        if recovery is not None and recovery.heartbeat:
            self._declare("subscriber", Entity(session, publishers, Direct(self._hear_heartbeat), allowed_origin))
        if subscriber_detection:
            token = LivelinessToken(session, f"{self.key_expr}/@adv/sub/{session.zid()}/{self.id.eid}/_")
            self._ends.append(token.undeclare_if_declared)
        session.at_close(self._stop_timers)

    id: EntityGlobalId
    key_expr: zenoh.KeyExpr

    def _declare(self, kind: str, entity: Entity) -> None:
        self.session.declare(kind, entity)
        self._ends.append(partial(self.session.end, entity))

    def _end_all(self) -> None:
        for end in self._ends:
            end()

    @property
    def _most(self) -> int | None:
        return None if self._history is None else self._history.max_samples

    def sample_miss_listener(self, handler: Any = None) -> SampleMissListener:
        """Declare a listener that is told of samples that are missed for good."""
        return SampleMissListener(self, handler)

    def detect_publishers(self, handler: Any = None, *, history: bool | None = None) -> Watcher:
        """Declare a subscriber of the tokens of advanced publishers."""
        return Watcher(self.session, f"{self.key_expr}/@adv/pub/**", handler, history)

    def _stop_timers(self) -> None:
        for source in self._sources.values():
            if source.timer is not None:
                source.timer.cancel()
        for listener in self._misses:
            listener._sink.close()

    # Samples.

    def _take(self, sample: Sample) -> None:
        """Take a sample that was published just now, and ask for what lies before it."""
        is_new = self._handle(sample)
        if sample.source_info is None:
            return
        source_id = sample.source_info.source_id
        source = self._sources[source_id]
        if is_new:
            self._query_periodically(source_id, source)
        if self._recovery is not None and source.queries == 0 and source.waiting:
            self._recover(source_id, source)

    def _handle(self, sample: Sample) -> bool:
        """Pass a sample on, or have it wait for those before it; return whether its publisher is a new one."""
        if sample.source_info is not None:
            is_new = sample.source_info.source_id not in self._sources
            source = self._sources.setdefault(sample.source_info.source_id, _Source())
            self._handle_numbered(sample, sample.source_info, source)
            return is_new
        if sample.timestamp is None:
            self._sink.push(sample)
            return False
        source = self._stamped.setdefault(bytes(sample.timestamp.get_id()), _Source())
        if source.last is None or not source.last >= sample.timestamp:
            if (self._queries == 0 and source.queries == 0) or self._most == 1:
                source.last = sample.timestamp
                self._sink.push(sample)
            else:
                source.waiting.setdefault(sample.timestamp, sample)
                if self._most is not None and len(source.waiting) >= self._most:
                    self._flush_stamped(source)
        return False

    def _handle_numbered(self, sample: Sample, info: SourceInfo, source: _Source) -> None:
        number = info.source_sn
        if source.last is None and self._queries:
            if self._most == 1:
                source.last = number
                self._sink.push(sample)
                return
            source.waiting[number] = sample
            if self._most is not None and len(source.waiting) >= self._most:
                first = min(source.waiting)
                self._pass_on(source, first, source.waiting.pop(first))
        elif source.last is None or number == source.last + 1:
            self._pass_on(source, number, sample)
        elif number > source.last:
            if self._recovery is not None:
                source.waiting[number] = sample
            else:
                self._miss(info.source_id, number - source.last - 1)
                source.last = number
                self._sink.push(sample)

    def _pass_on(self, source: _Source, number: int, sample: Sample) -> None:
        """Pass a sample on, and those that wait for it."""
        self._sink.push(sample)
        while (following := source.waiting.pop(number + 1, None)) is not None:
            self._sink.push(following)
            number += 1
        source.last = number

    def _miss(self, source_id: EntityGlobalId, count: int) -> None:
        for listener in self._misses:
            listener.push(Miss(source_id, count))

    def _flush(self, source_id: EntityGlobalId, source: _Source) -> None:
        """Pass on what waits: what is not there by now is missed."""
        if source.queries == 0:
            for number in sorted(source.waiting):
                sample = source.waiting.pop(number)
                if source.last is not None and number <= source.last:
                    continue
                if source.last is not None and number > source.last + 1:
                    self._miss(source_id, number - source.last - 1)
                source.last = number
                self._sink.push(sample)

    def _flush_stamped(self, source: _Source) -> None:
        if source.queries == 0:
            for stamp in sorted(source.waiting, key=lambda stamp: stamp.get_time_as_ntp64().as_nanos()):
                source.last = stamp
                self._sink.push(source.waiting.pop(stamp))

    # Queries of caches.

    def _ask(self, key: str, parameters: str, on_end: Callable[[], object]) -> None:
        parameters = f"{parameters};{ANY_KEY}" if parameters else ANY_KEY
        asking = Asking(zenoh.Selector(key, parameters), self._replied, on_end, **ALL_REPLIES)
        asking.expire_after(RECOVERY_TIMEOUT_S)
        self.session.vehicle.ask(asking, self.session, to_own=True, to_others=True)

    def _replied(self, reply: Reply) -> None:
        if reply.ok is not None and self.key_expr.intersects(reply.ok.key_expr):
            self._handle(reply.ok)

    def _initial_done(self) -> None:
        self._queries = max(self._queries - 1, 0)
        if self._queries == 0:
            for source_id, source in self._sources.items():
                self._flush(source_id, source)
                self._query_periodically(source_id, source)
            for source in self._stamped.values():
                self._flush_stamped(source)

    def _recover(self, source_id: EntityGlobalId, source: _Source, last: int | None = None, key: str = "") -> None:
        source.queries += 1
        first = "" if source.last is None else source.last + 1
        self._ask(
            key or f"{self.key_expr}/@adv/*/{source_id.zid}/{source_id.eid}/**",
            f"_sn={first}..{'' if last is None else last}",
            partial(self._source_done, source_id, source),
        )

    def _source_done(self, source_id: EntityGlobalId, source: _Source) -> None:
        source.queries -= 1
        if self._queries == 0:
            self._flush(source_id, source)

    def _query_periodically(self, source_id: EntityGlobalId, source: _Source) -> None:
        if self._recovery is not None and self._recovery.periodic_queries is not None:
            if source.timer is not None:
                source.timer.cancel()
            period = self._recovery.periodic_queries
            period_s = period.total_seconds() if hasattr(period, "total_seconds") else period
            source.timer = _every(period_s, partial(self._recover, source_id, source))

    def _hear_heartbeat(self, sample: Sample) -> None:
        source_id = _source_of(sample.key_expr)
        if sample.kind != zenoh.SampleKind.PUT or not isinstance(source_id, EntityGlobalId):
            return
        try:
            number = int(z_deserialize(UInt32, sample.payload))
        except zenoh.ext.ZDeserializeError:
            return
        is_new = source_id not in self._sources
        source = self._sources.setdefault(source_id, _Source())
        if is_new and self._queries:
            return
        if (source.last is None or number > source.last) and source.queries == 0:
            self._recover(source_id, source, number, str(sample.key_expr))

    # Publishers that come later.

    def _publisher_changed(self, token: Sample) -> None:
        assert self._history is not None
        source_id = _source_of(token.key_expr)
        if token.kind != zenoh.SampleKind.PUT or source_id is None:
            return
        if isinstance(source_id, EntityGlobalId):
            is_new = source_id not in self._sources
            source = self._sources.setdefault(source_id, _Source())
            if is_new:
                self._query_periodically(source_id, source)
            done: Callable[[], object] = partial(self._source_done, source_id, source)
        else:
            source = self._stamped.setdefault(bytes(source_id), _Source())
            done = partial(self._stamped_done, source)
        source.queries += 1
        self._ask(str(token.key_expr), self._history.parameters(), done)

    def _stamped_done(self, source: _Source) -> None:
        source.queries -= 1
        if self._queries == 0:
            self._flush_stamped(source)


def _source_of(key: zenoh.KeyExpr) -> EntityGlobalId | ZenohId | None:
    """Return the publisher that a key `…/@adv/pub/ZID/EID/_` names; its session alone if it has no number."""
    found = re.search(r"(?:^|/)@adv/pub/([0-9a-f]+)/(\w+)(?:/|$)", str(key))
    if found is None or not (found[2] == _WITHOUT_ID or found[2].isdigit()):
        return None
    zid = ZenohId(int(found[1], 16))
    return zid if found[2] == _WITHOUT_ID else EntityGlobalId(zid, int(found[2]))


class SampleMissListener(Listening):
    """A listener that is told of samples that are missed for good."""

    def __init__(self, subscriber: AdvancedSubscriber, handler: Any) -> None:
        self._listeners = subscriber._misses
        super().__init__(handler, subscriber.session.outlet)
        self._listeners.append(self)
        self._end = self._stop

    def push(self, miss: Miss) -> None:
        """Tell of a miss."""
        self._sink.push(miss)

    def _stop(self) -> None:
        self._listeners.remove(self)
        self._sink.close()


def declare_advanced_publisher(session: Session, key_expr: Any, **options: Any) -> AdvancedPublisher:
    """Declare an advanced publisher."""
    return AdvancedPublisher(session, key_expr, **options)


def declare_advanced_subscriber(
    session: Session, key_expr: Any, handler: Any = None, **options: Any
) -> AdvancedSubscriber:
    """Declare an advanced subscriber."""
    return AdvancedSubscriber(session, key_expr, handler, **options)
