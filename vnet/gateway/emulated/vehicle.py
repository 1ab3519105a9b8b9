"""A vehicle whose programs `import zenoh`: what their sessions say to each other, and what crosses the radio.

It stands where a router stands in the world: sessions of one vehicle talk to each other past the radio, and what
matches the keys of the radio is sent by it, too, in the frames of `vnet/gateway/frames.py`.
"""

from __future__ import annotations

import asyncio
from collections import defaultdict
from collections.abc import Callable, Coroutine, Sequence
from contextlib import suppress
from functools import lru_cache, partial
from itertools import count
from math import inf
from typing import Any

import msgspec
import zenoh

from vnet.errors import VnetError, shown
from vnet.gateway.emulated.modules import EPOCH_NS
from vnet.gateway.emulated.queries import ALL_REPLIES, Asking, Entity
from vnet.gateway.emulated.values import (
    NO_ENCODING,
    PUT,
    Direct,
    DueCallbacks,
    EntityGlobalId,
    Reply,
    Sample,
    ZenohId,
    key_of,
    result_of,
    sample_of,
    timestamp_at,
    token_sample,
    unix_ns_of,
)
from vnet.gateway.frames import (
    CrossingQuery,
    CrossingReply,
    CrossingSample,
    CrossingTokens,
    Fragments,
    Message,
    TooLargeError,
    crossing_reply,
    crossing_sample,
)
from vnet.gateway.keys import FIX_KEY, REPORT_KEY
from vnet.gateway.radio_side import RadioSide
from vnet.gateway.ros2 import MOST_KEYS, TOKENS, Ros2
from vnet.node import Node
from vnet.radio import Packet
from vnet.runtime.own_asyncio import Task
from vnet.runtime.virtual_time import VirtualTimeLoop
from vnet.units import NS_PER_S

MOST_AHEAD_NS = NS_PER_S // 2
"""Time ahead of its clock up to which Zenoh believes a timestamp (`delta` of uhlc, its hybrid logical clock)."""


class Vehicle(RadioSide[Asking]):
    """The sessions of one vehicle, and its radio."""

    def __init__(
        self, node: Node, keys: Sequence[str] | None, query_s: float, liveliness_s: float, ros2: Ros2 | None = None
    ) -> None:
        super().__init__(node.id, node.incarnation, keys, query_s, liveliness_s, ros2)
        self.node = node
        self.zid = ZenohId.of(node.id, node.incarnation, "router")
        self._liveliness_s = liveliness_s
        self._loop = asyncio.get_running_loop()
        most, warn = node.options.get("queue_frames", inf), partial(node.log, level="warning")
        self._fragments = Fragments(node.radio.max_payload, node.incarnation, most, warn)
        self.due = DueCallbacks()
        self._entities: defaultdict[str, list[Entity]] = defaultdict(list)
        """Declarations of its sessions by kind."""
        self._has_tokens = asyncio.Event()
        self._more_tokens: bool | None = None
        """True if more tokens have changed since those of this instant were sent; None if none were."""
        self._subscribers_of = lru_cache(MOST_KEYS)(self._find_subscribers)
        self._session_numbers = count(1)
        self._stamped_ns = 0
        self._is_verbatim_told = False
        self._hears, self._locates = asyncio.Event(), asyncio.Event()
        self.on_matching: list[Callable[[], None]] = []
        """Called when subscribers or queryables come or go."""

    def _crosses(self, key: str) -> bool:
        crosses = super()._crosses(key)
        # Zenoh's own keys are no user's, nor are tokens of ROS 2, which cross as their topics do.
        if not crosses and not self._is_verbatim_told and not key.startswith(("@/", f"{TOKENS}/")):
            unmarked = f"/{key}".replace("/@", "/_")[1:]
            if unmarked != key and super()._crosses(unmarked):
                self._is_verbatim_told = True
                reason = "wildcards of radio.keys stand for no part that begins with @, which must be named"
                self.node.log(f"{shown(key)} stays in the vehicle: {reason}", "warning")
        return crosses

    def new_zid(self) -> ZenohId:
        """Return the id of a further session."""
        return ZenohId.of(self.node.id, self.node.incarnation, next(self._session_numbers))

    @property
    def _true_ns(self) -> int:
        """Emulated time, whatever a fault makes of the vehicle's clock."""
        assert isinstance(self._loop, VirtualTimeLoop)
        return self._loop.now_ns

    def new_timestamp(self, zid: ZenohId) -> zenoh.Timestamp:
        """Return the present time by the vehicle's clock; later than all made or heard, as Zenoh promises."""
        self._stamped_ns = max(EPOCH_NS + self.node.now_ns, self._stamped_ns + 1)
        return timestamp_at(self._stamped_ns, zid)

    def stamped(self, sample: Sample, zid: ZenohId) -> Sample:
        """Return a sample with a time: a new one if it has none or one too far ahead; later ones follow it."""
        stamp = sample.timestamp
        if stamp is not None and (stamp_ns := unix_ns_of(stamp)) <= EPOCH_NS + self.node.now_ns + MOST_AHEAD_NS:
            self._stamped_ns = max(self._stamped_ns, stamp_ns)
            return sample
        return msgspec.structs.replace(sample, timestamp=self.new_timestamp(zid))

    # Entities come and go.

    def declare(self, entity: Entity) -> None:
        """Add an entity."""
        if entity.kind != "token":
            self._listen()  # first: tokens that were heard before are not told as new
        self._entities[entity.kind].append(entity)
        if entity.kind == "token":
            self._token_changed(entity.key, alive=True)
            return
        fix_keys = [FIX_KEY] if self._ros2 is None else [FIX_KEY, self._ros2.fix_key]
        if entity.kind == "subscriber" and any(map(entity.key.intersects, fix_keys)):
            self._locates.set()
        self._changed(entity.kind)

    def undeclare(self, entity: Entity) -> None:
        """Remove an entity; it takes nothing more."""
        entities = self._entities[entity.kind]
        entities.remove(entity)
        entity.sink.close()
        self._changed(entity.kind)
        if entity.kind == "token" and not any(str(each.key) == str(entity.key) for each in entities):
            self._token_changed(entity.key, alive=False)

    def _changed(self, kind: str) -> None:
        if kind in ("subscriber", "queryable"):
            self._subscribers_of.cache_clear()
            for tell in list(self.on_matching):
                tell()

    def matches_subscriber(self, session: object, key: zenoh.KeyExpr) -> bool:
        """Return whether anybody may take what is put there: over the radio nobody knows."""
        there = self._subscribers_of(str(key))
        return self.crosses(str(key)) or any(each.session is session or each.is_remote for each in there)

    def matches_queryable(self, session: object, key: zenoh.KeyExpr, complete: bool) -> bool:
        """Return whether anybody may answer a query there, as a session of Zenoh 1.10 says of its queriers.

        A queryable of another session counts if it answers all keys; one of its own may answer some of them.
        """
        if self._is_asked_by_radio(key, complete):
            return True
        return any(
            each.key.includes(key) if complete or each.session is not session else each.key.intersects(key)
            for each in self._entities["queryable"]
            if (each.is_complete or not complete) and (each.session is session or each.is_remote)
        )

    # Samples.

    def _find_subscribers(self, key: str) -> list[Entity]:
        expression = key_of(key)
        return [each for each in self._entities["subscriber"] if each.key.intersects(expression)]

    def put(self, session: object, sample: Sample, to_own: bool, to_others: bool) -> None:
        """Take a sample of a session to its own subscribers, and to all others here and over the radio."""
        key = str(sample.key_expr)
        matching = self._subscribers_of(key)
        if to_others:
            stamped = sample
            if sample.timestamp is not None or sample.kind == PUT:  # as routers do
                stamped = self.stamped(sample, self.zid)
            if self.crosses(key):
                # Also a delete: by the radio Zenoh's routers would give it a later one, of the receiver's.
                self._send(crossing_sample(stamped, stamped.timestamp or self.new_timestamp(self.zid)))
            elif key == REPORT_KEY:
                self._report(sample)
            others = [each for each in matching if each.session is not session and each.is_remote]
            if others:
                self._loop.call_soon(self._deliver, others, stamped)
        if to_own:
            for entity in matching:
                if entity.session is session and entity.is_local:
                    entity.sink.push(sample)

    def _deliver(self, entities: list[Entity], sample: Sample) -> None:
        for entity in entities:
            entity.arrive(sample)

    def _report(self, sample: Sample) -> None:
        try:
            values = msgspec.msgpack.decode(sample.payload.to_bytes(), type=dict[str, Any])
            self.node.report(**values)
        except (msgspec.MsgspecError, TypeError, ValueError, VnetError) as error:
            self.node.log(f"a report is refused: {error}", "error")

    # Queries.

    def ask(self, asking: Asking, session: object | None, timeout_s: float, to_own: bool, to_others: bool) -> None:
        """Ask the queryables of a session, those of others, and other vehicles; None asks for another vehicle."""
        asking.session = session
        intersecting = [each for each in self._entities["queryable"] if each.key.intersects(asking.key)]
        all_complete = asking.target == zenoh.QueryTarget.ALL_COMPLETE
        if to_others:
            others = [each for each in intersecting if each.session is not session and each.is_remote]
            complete = [each for each in others if each.is_complete and each.key.includes(asking.key)]
            crosses = session is not None and self._is_asked_by_radio(asking.key, all_complete)
            if all_complete:
                others = complete
            elif complete and asking.target == zenoh.QueryTarget.BEST_MATCHING:
                # Zenoh asks of others the nearest alone; and the router's own, as a gateway has for the radio.
                nearest = complete[0].session
                others = [each for each in others if each.session is nearest]
            if crosses:
                self._ask_by_radio(asking)
            for entity in others:
                self._loop.call_soon(asking.begun().put_to, entity)
        if to_own:
            for entity in intersecting:
                if entity.session is session and entity.is_local and (entity.is_complete or not all_complete):
                    asking.begun().put_to(entity)
        asking.done(session)  # of the asking itself
        asking.expire_after(timeout_s)

    def _is_asked_by_radio(self, key: zenoh.KeyExpr, all_complete: bool) -> bool:
        """Return whether queries there cross. Clients of ROS 2's services ask none but complete queryables."""
        return self.crosses(str(key)) and (not all_complete or self._ros2 is not None)

    def _ask_by_radio(self, asking: Asking) -> None:
        self._listen()
        self._send(self.keep(asking.begun()))

    def _conclude(self, query: Asking) -> None:
        query.done()

    def _answer(self, asker: str, query: CrossingQuery) -> None:
        """Ask the sessions of this vehicle on behalf of another, and send their replies by radio."""

        def reply(reply: Reply) -> None:
            if self.crosses_in(reply):
                self._send(crossing_reply(asker, query, reply))

        asking = Asking(
            zenoh.Selector(query.selector),
            Direct(reply),
            **ALL_REPLIES,
            payload=query.payload,
            encoding=query.encoding,
            attachment=query.attachment,
        )
        self.ask(asking, None, self._query_s, to_own=False, to_others=True)

    # Tokens.

    def tokens(self, key: zenoh.KeyExpr) -> list[zenoh.KeyExpr]:
        """Return the keys of tokens that are there, each once: this vehicle's first."""
        self._listen()
        keys = dict.fromkeys(str(each.key) for each in self._entities["token"]) | self.heard_tokens
        return [key_of(each) for each in keys if key_of(each).intersects(key)]

    def tell_present(self, watcher: Entity) -> None:
        """Tell a new subscriber of tokens which are there."""
        for token in self.tokens(watcher.key):
            watcher.told.add(str(token))
            watcher.arrive(token_sample(token, alive=True))

    def _token_changed(self, key: zenoh.KeyExpr, alive: bool) -> None:
        if self.crosses(str(key)):
            if self._more_tokens is None:
                self._more_tokens = False
                self._send_tokens()
                self._loop.call_soon(self._end_instant)
            else:
                self._more_tokens = True
            self._has_tokens.set()
        self._tell_watchers(key, alive)

    def _send_more_tokens(self) -> None:
        """Send the tokens if more than one has changed at this instant: a message each would have all of them."""
        if self._more_tokens:
            self._more_tokens = False
            self._send_tokens()

    def _end_instant(self) -> None:
        self._send_more_tokens()
        self._more_tokens = None

    def _tell_watchers(self, key: zenoh.KeyExpr, alive: bool) -> None:
        text = str(key)
        if not alive and text in map(str, self.tokens(key)):
            return  # another of its name is there
        watchers = [watcher for watcher in self._entities["watcher"] if watcher.key.intersects(key)]
        # A session that has told one of its subscribers tells none that the token is new.
        knowing = {watcher.session for watcher in watchers if text in watcher.told}
        for watcher in watchers:
            if watcher.session not in knowing if alive else not watcher.session.is_closed():
                (watcher.told.add if alive else watcher.told.discard)(text)
                watcher.arrive(token_sample(key, alive))

    async def tell_tokens(self) -> None:
        """Tell the tokens again while there are any, and forget those of vehicles that are not heard."""
        while True:
            await self._has_tokens.wait()
            await asyncio.sleep(self._liveliness_s)
            self.forget_tokens(self._true_ns)
            if any(self.crosses(str(each.key)) for each in self._entities["token"]):
                self._send_tokens()
            elif not self.heard_tokens:
                self._has_tokens.clear()

    def _send_tokens(self) -> None:
        keys = {str(each.key) for each in self._entities["token"]}
        self._send(CrossingTokens(tuple(sorted(key for key in keys if self.crosses(key)))))

    def hear_tokens(self, sender: str, tokens: CrossingTokens, time_ns: int, number: int = 0) -> None:
        """Take word of another vehicle's tokens, and forget them in time."""
        super().hear_tokens(sender, tokens, time_ns, number)
        self._has_tokens.set()

    def _show_token(self, key: str, is_there: bool) -> None:
        self._tell_watchers(key_of(key), is_there)

    # The radio.

    def _send(self, message: Message) -> None:
        if not isinstance(message, CrossingTokens):
            self._send_more_tokens()  # in their order
        try:
            payloads = self._fragments.of(message)
        except TooLargeError as error:
            self.node.log(str(error), "error")
            return
        radio = self.node.radio
        for payload in payloads:
            if isinstance(message, CrossingReply) and radio.acknowledges and message.to != self.node.id:
                Task(radio.send(message.to, payload), loop=self._loop)
            else:
                with suppress(StopIteration):
                    radio.broadcast(payload).send(None)  # which never waits

    def _listen(self) -> None:
        """Have the radio's packets wake this vehicle from now on; of those before, tokens alone find somebody."""
        if not self._hears.is_set():
            self._hears.set()
            for packet in self.node.radio.drain():
                self._take(packet)

    def tasks(self) -> list[Coroutine[Any, Any, None]]:
        """Return what is to run beside the programs."""
        return [self.receive(), self.tell_fixes(), self.tell_tokens()]

    async def receive(self) -> None:
        """Take what the radio delivers to the sessions, from the first entity on that could take it."""
        await self._hears.wait()
        radio = self.node.radio
        while True:
            first, self.due.is_held = await radio.receive(), True
            for packet in (first, *radio.drain()):
                self._take(packet)
            self.due.is_held = False
            self.due.run()

    def _take(self, packet: Packet) -> None:
        try:
            self.hear(packet.sender, packet.payload, self._true_ns)
        except ValueError as error:  # bytes that a fault has changed
            self.node.log(f"a frame of {packet.sender} is no sample: {error}", "debug")

    def _show(self, sample: CrossingSample) -> None:
        shown = self.stamped(sample_of(sample), self.zid)
        for entity in self._subscribers_of(sample.key):
            if entity.is_remote:
                entity.arrive(shown)

    def _reply(self, query: Asking, answer: CrossingReply) -> None:
        query.reply(Reply(result_of(answer), EntityGlobalId(self.zid, 0)))  # as a gateway, which passes it on

    async def tell_fixes(self) -> None:
        """Put each fix at the sessions, from the first subscriber on that takes them."""
        await self._locates.wait()
        for fix in self.node.gnss.drain():
            if fix.time_ns == self._true_ns:  # the first fix is that of the instant at which programs begin
                self.show_fix(fix)
        async for fix in self.node.gnss:
            self.show_fix(fix)

    async def tell_clock(self, clock_hz: float) -> None:
        """Tell the sessions emulated time, as ROS 2 does."""
        while True:
            self.show_clock(self.node.now_ns)
            await asyncio.sleep(1 / clock_hz)

    def _publish(self, key: str, payload: bytes, attachment: bytes | None = None) -> None:
        sample = Sample(
            key_of(key),
            zenoh.ZBytes(payload),
            PUT,
            NO_ENCODING,
            self.new_timestamp(self.zid),
            attachment=None if attachment is None else zenoh.ZBytes(attachment),
        )
        self._deliver([each for each in self._subscribers_of(key) if each.is_remote], sample)
