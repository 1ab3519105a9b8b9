"""A vehicle whose programs `import zenoh`: what their sessions say to each other, and what crosses the radio.

It stands where a router stands in the world: sessions of one vehicle talk to each other past the radio, and what
matches the keys of the radio is sent by it, too, in the frames of `vnet/gateway/frames.py`.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine, Sequence
from contextlib import suppress
from functools import lru_cache
from itertools import count
from typing import Any

import msgspec
import zenoh

from vnet.errors import VnetError
from vnet.gateway.emulated.modules import EPOCH_NS
from vnet.gateway.emulated.queries import ALL_REPLIES, Asking, Entity, Owner
from vnet.gateway.emulated.values import (
    NO_ENCODING,
    PUT,
    DueCallbacks,
    Reply,
    Sample,
    ZenohId,
    crossing_of,
    key_of,
    result_of,
    sample_of,
    timestamp_at,
    token_sample,
)
from vnet.gateway.frames import (
    CrossingQuery,
    CrossingReply,
    CrossingSample,
    CrossingTokens,
    Fragments,
    Message,
    Reassembly,
    TooLargeError,
    whole_message,
)
from vnet.gateway.keys import FIX_KEY, OWN_KEYS, REPORT_KEY, fix_content
from vnet.gateway.ros2 import Ros2
from vnet.gateway.tokens import TOKEN_PERIODS, HeardTokens
from vnet.node import Node
from vnet.radio import Packet
from vnet.runtime.own_asyncio import Task
from vnet.units import NS_PER_S

MOST_KEYS = 4096
"""Keys of samples for which it is remembered where they go."""


class Vehicle:
    """The sessions of one vehicle, and its radio."""

    def __init__(
        self, node: Node, keys: Sequence[str], query_s: float, liveliness_s: float, ros2: Ros2 | None = None
    ) -> None:
        self.node, self._ros2 = node, ros2
        self.zid = ZenohId.of(node.id, node.incarnation, "router")
        self._keys = [zenoh.KeyExpr(key) for key in keys]
        self._query_s, self._liveliness_s = query_s, liveliness_s
        self._loop = asyncio.get_running_loop()
        self._fragments = Fragments(node.radio.max_payload, node.incarnation)
        self._reassembly = Reassembly()
        self.due = DueCallbacks()
        self._subscribers: list[Entity] = []
        self._queryables: list[Entity] = []
        self._tokens: list[Entity] = []
        self._watchers: list[Entity] = []
        """Subscribers of tokens."""
        self._entities = {
            "subscriber": self._subscribers,
            "queryable": self._queryables,
            "token": self._tokens,
            "watcher": self._watchers,
        }
        self._heard_tokens = HeardTokens(round(TOKEN_PERIODS * liveliness_s * NS_PER_S))
        self._has_tokens = asyncio.Event()
        self._matching: dict[str, list[Entity]] = {}
        self._crossing: dict[str, bool] = {}
        self._queries: dict[int, Asking] = {}
        self._query_numbers = count()
        self._session_numbers = count(1)
        self._hears, self._locates = asyncio.Event(), asyncio.Event()
        self.on_matching: list[Callable[[], None]] = []
        """Called when subscribers or queryables come or go."""

    def new_zid(self) -> ZenohId:
        """Return the id of a further session."""
        return ZenohId.of(self.node.id, self.node.incarnation, next(self._session_numbers))

    def new_timestamp(self, zid: ZenohId) -> zenoh.Timestamp:
        """Return the present time by the vehicle's clock."""
        return timestamp_at(EPOCH_NS + self.node.now_ns, zid)

    # Entities come and go.

    def declare(self, kind: str, entity: Entity) -> None:
        """Add a subscriber, a queryable, a token or a subscriber of tokens ("watcher")."""
        self._entities[kind].append(entity)
        if kind != "token":
            self._listen()
        fix_keys = [FIX_KEY] if self._ros2 is None else [FIX_KEY, self._ros2.fix_key]
        if kind == "subscriber" and any(map(entity.key.intersects, fix_keys)):
            self._locates.set()
        self._changed(kind)
        if kind == "token":
            self._token_changed(entity.key, alive=True)

    def undeclare(self, kind: str, entity: Entity) -> None:
        """Remove one; it takes nothing more."""
        entities = self._entities[kind]
        entities.remove(entity)
        entity.sink.close()
        self._changed(kind)
        if kind == "token" and not any(str(each.key) == str(entity.key) for each in entities):
            self._token_changed(entity.key, alive=False)

    def _changed(self, kind: str) -> None:
        if kind in ("subscriber", "queryable"):
            self._matching.clear()
            for tell in list(self.on_matching):
                tell()

    def matches_subscriber(self, key: zenoh.KeyExpr) -> bool:
        """Return whether anybody may take what is put there: over the radio nobody knows."""
        return self.crosses(str(key)) or any(each.key.intersects(key) for each in self._subscribers)

    def matches_queryable(self, key: zenoh.KeyExpr, complete: bool) -> bool:
        """Return whether anybody may answer a query there."""
        if self._is_asked_by_radio(key, complete):
            return True
        if complete:
            return any(each.is_complete and each.key.includes(key) for each in self._queryables)
        return any(each.key.intersects(key) for each in self._queryables)

    # Samples.

    def crosses(self, key: str) -> bool:
        """Return whether what has this key is sent by the radio."""
        crosses = self._crossing.get(key)
        if crosses is None:
            expression = key_of(key)
            crosses = not key.startswith(OWN_KEYS) and any(each.intersects(expression) for each in self._keys)
            crosses = crosses and (self._ros2 is None or self._ros2.crosses(key))
            if len(self._crossing) < MOST_KEYS:
                self._crossing[key] = crosses
        return crosses

    def _subscribers_of(self, key: str) -> list[Entity]:
        matching = self._matching.get(key)
        if matching is None:
            expression = key_of(key)
            matching = [each for each in self._subscribers if each.key.intersects(expression)]
            if len(self._matching) < MOST_KEYS:
                self._matching[key] = matching
        return matching

    def put(self, session: Owner, sample: Sample, to_own: bool, to_others: bool) -> None:
        """Take a sample of a session to its own subscribers, and to all others here and over the radio."""
        key = str(sample.key_expr)
        matching = self._subscribers_of(key)
        if to_others:
            stamped = sample
            if sample.timestamp is None and sample.kind == PUT:  # as routers do
                stamped = msgspec.structs.replace(sample, timestamp=self.new_timestamp(self.zid))
            if self.crosses(key):
                self._send(crossing_of(stamped))
            elif key == REPORT_KEY:
                self._report(sample)
            others = [each for each in matching if each.session is not session and each.is_remote]
            if others:
                self._loop.call_soon(self._deliver, others, stamped)
        if to_own:
            self._deliver([each for each in matching if each.session is session and each.is_local], sample)

    def _deliver(self, entities: list[Entity], sample: Sample) -> None:
        for entity in entities:
            entity.sink.push(sample)

    def _report(self, sample: Sample) -> None:
        try:
            values = msgspec.msgpack.decode(sample.payload.to_bytes(), type=dict[str, Any])
            self.node.report(**values)
        except (msgspec.MsgspecError, TypeError, ValueError, VnetError) as error:
            self.node.log(f"a report is refused: {error}", "error")

    # Queries.

    def ask(self, asking: Asking, session: Owner | None, to_own: bool, to_others: bool) -> None:
        """Ask the queryables of a session, those of others, and other vehicles; None asks for another vehicle."""
        intersecting = [each for each in self._queryables if each.key.intersects(asking.key)]
        all_complete = asking.target == zenoh.QueryTarget.ALL_COMPLETE
        if to_others:
            others = [each for each in intersecting if each.session is not session and each.is_remote]
            complete = [each for each in others if each.is_complete and each.key.includes(asking.key)]
            crosses = session is not None and self._is_asked_by_radio(asking.key, all_complete)
            if all_complete:
                others = complete
            elif complete and asking.target == zenoh.QueryTarget.BEST_MATCHING:
                nearest = complete[0].session
                others, crosses = [each for each in others if each.session is nearest], False
            if crosses:
                self._ask_by_radio(asking)
            for entity in others:
                self._loop.call_soon(asking.begun().put_to, entity)
        if to_own:
            for entity in intersecting:
                if entity.session is session and entity.is_local and (entity.is_complete or not all_complete):
                    asking.begun().put_to(entity)
        asking.done()  # of the asking itself

    def _is_asked_by_radio(self, key: zenoh.KeyExpr, all_complete: bool) -> bool:
        """Return whether queries there cross. Clients of ROS 2's services ask none but complete queryables."""
        return self.crosses(str(key)) and (not all_complete or self._ros2 is not None)

    def _ask_by_radio(self, asking: Asking) -> None:
        number = next(self._query_numbers)
        self._queries[number] = asking
        asking.begun()
        self._listen()
        payload, encoding, attachment = asking.payload, asking.encoding, asking.attachment
        self._send(
            CrossingQuery(
                number,
                str(asking.selector),
                None if payload is None else payload.to_bytes(),
                None if encoding is None else str(encoding),
                None if attachment is None else attachment.to_bytes(),
            )
        )
        self._loop.call_later(self._query_s, self._conclude, number)

    def _conclude(self, number: int) -> None:
        self._queries.pop(number).done()

    def _answer(self, asker: str, query: CrossingQuery) -> None:
        """Ask the sessions of this vehicle on behalf of another, and send their replies by radio."""

        def reply(reply: Reply) -> None:
            result = reply.result
            if isinstance(result, Sample):
                self._send(CrossingReply(asker, query.number, crossing_of(result)))
            else:
                error = result.payload.to_bytes(), str(result.encoding)
                self._send(CrossingReply(asker, query.number, None, error))

        asking = Asking(
            zenoh.Selector(query.selector),
            reply,
            lambda: None,
            **ALL_REPLIES,
            payload=query.payload,
            encoding=query.encoding,
            attachment=query.attachment,
        )
        asking.expire_after(self._query_s)
        self.ask(asking, None, to_own=False, to_others=True)

    # Tokens.

    def tokens(self, key: zenoh.KeyExpr) -> list[zenoh.KeyExpr]:
        """Return the keys of tokens that are there, each once: this vehicle's first."""
        self._listen()
        keys = dict.fromkeys(str(each.key) for each in self._tokens) | self._heard_tokens.keys
        return [key_of(each) for each in keys if key_of(each).intersects(key)]

    def tell_present(self, watcher: Entity) -> None:
        """Tell a new subscriber of tokens which are there."""
        for token in self.tokens(watcher.key):
            watcher.told.add(str(token))
            watcher.sink.push(token_sample(token, alive=True))

    def _token_changed(self, key: zenoh.KeyExpr, alive: bool) -> None:
        if self.crosses(str(key)):
            self._send_tokens()
            self._has_tokens.set()
        self._tell_watchers(key, alive)

    def _tell_watchers(self, key: zenoh.KeyExpr, alive: bool) -> None:
        text = str(key)
        if not alive and text in map(str, self.tokens(key)):
            return  # another of its name is there
        for watcher in self._watchers:
            if watcher.key.intersects(key) and not (alive and text in watcher.told):
                (watcher.told.add if alive else watcher.told.discard)(text)
                watcher.sink.push(token_sample(key, alive))

    async def tell_tokens(self) -> None:
        """Tell the tokens again while there are any, and forget those of vehicles that are not heard."""
        while True:
            await self._has_tokens.wait()
            await asyncio.sleep(self._liveliness_s)
            for key, _ in self._heard_tokens.expire(self.node.now_ns):
                self._tell_watchers(key_of(key), alive=False)
            if any(self.crosses(str(each.key)) for each in self._tokens):
                self._send_tokens()
            elif not self._heard_tokens.keys:
                self._has_tokens.clear()

    def _send_tokens(self) -> None:
        keys = {str(each.key) for each in self._tokens}
        self._send(CrossingTokens(tuple(sorted(key for key in keys if self.crosses(key)))))

    def _hear_tokens(self, sender: str, tokens: CrossingTokens, heard_ns: int) -> None:
        for text in tokens.keys:
            key_of(text)  # which raises for what is no key
        for text, alive in self._heard_tokens.hear(sender, tokens.keys, heard_ns):
            self._tell_watchers(key_of(text), alive)
        self._has_tokens.set()

    # The radio.

    def _send(self, message: Message) -> None:
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
        """Have the radio's packets wake this vehicle from now on; of what it has heard before tokens count."""
        if not self._hears.is_set():
            self._hears.set()
            for packet in self.node.radio.drain():
                self._hear(packet, only_tokens=True)

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
                self._hear(packet)
            self.due.is_held = False
            self.due.run()

    def _hear(self, packet: Packet, only_tokens: bool = False) -> None:
        sender = packet.sender
        try:
            heard = _whole(packet.payload)
            if heard is None:
                message = self._reassembly.take(sender, packet.payload)
                sample = sample_of(message) if isinstance(message, CrossingSample) else None
            else:
                message, sample = heard
            if sample is not None and not only_tokens:
                assert isinstance(message, CrossingSample)
                for entity in self._subscribers_of(message.key):
                    if entity.is_remote:
                        entity.sink.push(sample)
            elif isinstance(message, CrossingTokens):
                self._hear_tokens(sender, message, packet.received_ns)
            elif isinstance(message, CrossingQuery) and not only_tokens:
                self._answer(sender, message)
            elif isinstance(message, CrossingReply):
                asking = self._queries.get(message.number) if message.to == self.node.id else None
                if asking is not None:
                    asking.reply(Reply(result_of(message)))
        except (msgspec.MsgspecError, zenoh.ZError, LookupError, ValueError, OverflowError) as error:
            # bytes that a fault has changed
            self.node.log(f"a frame of {sender} is no sample: {error}", "debug")

    async def tell_fixes(self) -> None:
        """Put each fix at the sessions, from the first subscriber on that takes them."""
        await self._locates.wait()
        self.node.gnss.drain()
        async for fix in self.node.gnss:
            self._publish(FIX_KEY, fix_content(fix))
            if self._ros2 is not None:
                self._publish(*self._ros2.fix(fix))

    async def tell_clock(self, ros2: Ros2, clock_hz: float) -> None:
        """Tell the sessions emulated time, as ROS 2 does."""
        while True:
            self._publish(*ros2.clock(self.node.now_ns))
            await asyncio.sleep(1 / clock_hz)

    def _publish(self, key: str, payload: bytes, attachment: bytes | None = None) -> None:
        """Take a sample of vnet's own to the sessions."""
        sample = Sample(
            key_of(key),
            zenoh.ZBytes(payload),
            PUT,
            NO_ENCODING,
            self.new_timestamp(self.zid),
            attachment=None if attachment is None else zenoh.ZBytes(attachment),
        )
        self._deliver([each for each in self._subscribers_of(key) if each.is_remote], sample)


@lru_cache(maxsize=1024)
def _whole(payload: bytes) -> tuple[Message, Sample | None] | None:
    """Return the message of a frame that has all of it, and its sample if it is one: the same at all receivers."""
    if (message := whole_message(payload)) is None:
        return None
    return message, sample_of(message) if isinstance(message, CrossingSample) else None
