"""The inbox of a live run: everything that Zenoh's threads bring, handled in order on the run's event loop.

Messages of agents are dispatched by their type, in one table; a message that is not understood, or that comes from
the wrong sender, is refused.
"""

from __future__ import annotations

import asyncio
from collections import Counter, deque
from collections.abc import Callable
from typing import Any

import zenoh

from emulator.drivers.join import Membership
from emulator.drivers.live.waiting import ChangeSignal
from emulator.drivers.processes import ProtocolError
from emulator.records.events import EventKind
from emulator.records.run_folder import RunFolder
from vnet.errors import WireError
from vnet.transport import keys, wire
from vnet.transport.backbone_keys import decode_sent
from vnet.transport.wire import SentMessage

Handler = Callable[[str, Any], None]
"""Takes a message of one type from a node. Raises ProtocolError to refuse it."""


class Refusals:
    """Counts the messages that are refused, by key, and logs the first of each key."""

    def __init__(self, run: str, folder: RunFolder, time_ns: Callable[[], int]) -> None:
        self._run = run
        self._folder = folder
        self._time_ns = time_ns
        self._counts: Counter[str] = Counter()

    def add(self, node: str, reason: str, on_backbone: bool = False) -> None:
        """Count a refused message of `node`, on its `tx` or that of its backbone."""
        key = keys.backbone_tx(self._run, node) if on_backbone else keys.node_tx(self._run, node)
        if key not in self._counts:
            self._folder.event(self._time_ns(), EventKind.refused, node, key=key, reason=reason)
        self._counts[key] += 1

    def write_totals(self) -> None:
        """Log how many messages were refused, by key."""
        for key, count in self._counts.items():
            self._folder.event(self._time_ns(), EventKind.refused_total, key=key, count=count)


class Inbox:
    """Hands what Zenoh's threads `put_…` to its handlers, on the loop on which it was made.

    `handlers` is the table of message types: a part of the run adds the type that it takes. `on_sent` takes what
    units put on the keys of the backbone. What hosts say goes to `on_host_…`, which unbundles it and calls
    `take_message`, `take_backbone` and `take_token`. Of `connected` are the nodes that hold a connection; `stacks`
    are the answers to stack requests, by process.
    """

    def __init__(
        self,
        members: Membership,
        refusals: Refusals,
        changes: ChangeSignal,
        on_disconnected: Callable[[str], None],
        on_query: Callable[[str, zenoh.Query], None],
    ) -> None:
        self._members = members
        self._refusals = refusals
        self._changes = changes
        self._on_disconnected = on_disconnected
        self._on_query = on_query
        self._loop = asyncio.get_running_loop()
        self._incoming: deque[tuple[Callable[[str, Any], None], str, Any]] = deque()
        self._wake_pending = False
        self._closed = False
        self.on_host_message: Callable[[str, bytes], None] = lambda host, payload: None
        self.on_host_token: Callable[[str, bool], None] = lambda host, alive: None
        self.handlers: dict[type, Handler] = {wire.StackDump: self._take_stack, wire.Final: _ignore}
        self.on_sent: Callable[[SentMessage], None] = lambda message: None
        self.connected: set[str] = set()
        self.stacks: dict[str, wire.StackDump] = {}
        self.refused: dict[str, str] = {}
        """Reasons of the last refused messages, of nodes whose next yield has not come."""

    # On Zenoh's threads: append, and wake the loop once.

    def put_message(self, node: str, payload: bytes) -> None:
        """Enqueue an encoded message of a node."""
        self._put(self.take_message, node, payload)

    def put_backbone(self, unit: str, payload: bytes) -> None:
        """Enqueue what a unit has put on its key of the backbone."""
        self._put(self.take_backbone, unit, payload)

    def put_token(self, node: str, alive: bool) -> None:
        """Enqueue that the connection of a node has appeared or is gone."""
        self._put(self.take_token, node, alive)

    def put_host_message(self, host: str, payload: bytes) -> None:
        """Enqueue an encoded message of a host."""
        self._put(self._take_host_message, host, payload)

    def put_host_token(self, host: str, alive: bool) -> None:
        """Enqueue that the connection of a host has appeared or is gone."""
        self._put(self._take_host_token, host, alive)

    def put_query(self, verb: str, query: zenoh.Query) -> None:
        """Enqueue an operator's query."""
        self._put(self._take_query, verb, query)

    def _put(self, take: Callable[[str, Any], None], name: str, item: Any) -> None:
        self._incoming.append((take, name, item))
        if not self._wake_pending and not self._closed:
            self._wake_pending = True
            self._loop.call_soon_threadsafe(self._drain)

    # On the loop.

    def close(self) -> None:
        """Handle nothing any more."""
        self._closed = True

    def _drain(self) -> None:
        self._wake_pending = False
        while self._incoming and not self._closed:
            take, name, item = self._incoming.popleft()
            take(name, item)

    def _take_host_message(self, host: str, payload: bytes) -> None:
        self.on_host_message(host, payload)

    def _take_host_token(self, host: str, alive: bool) -> None:
        self.on_host_token(host, alive)

    def take_message(self, node: str, payload: bytes) -> None:
        """Take an encoded message of a node."""
        try:
            message = wire.decode_tx(payload)
            # A hello introduces its nonce; Membership judges it.
            if type(message) is not wire.Hello and not self._members.speaks_for(node, message.nonce):
                raise ProtocolError("a message without the nonce of its process")
            handler = self.handlers.get(type(message))
            if handler is None:
                raise ProtocolError(f"an unexpected {type(message).__name__}")
            handler(node, message)
            if type(message) is wire.Yield:
                self.refused.pop(node, None)
        except (WireError, ProtocolError) as error:
            self._refusals.add(node, str(error))
            self.refused[node] = str(error)

    def take_backbone(self, unit: str, payload: bytes) -> None:
        """Take what a unit has put on its key of the backbone."""
        try:
            sent = decode_sent(payload)
            if not self._members.is_of(unit, sent.nonce):
                raise ProtocolError("a message without the nonce of its process")
            self.on_sent(sent.message(unit))
        except (WireError, ProtocolError) as error:
            self._refusals.add(unit, str(error), on_backbone=True)

    def take_token(self, node: str, alive: bool) -> None:
        """Take note that the connection of a node has appeared or is gone."""
        if alive:
            self.connected.add(node)
            return
        self.connected.discard(node)
        self._on_disconnected(node)
        self._changes.set()

    def _take_query(self, verb: str, query: zenoh.Query) -> None:
        self._on_query(verb, query)
        self._changes.set()

    def _take_stack(self, node: str, message: wire.StackDump) -> None:
        self.stacks[node] = message


def _ignore(node: str, message: Any) -> None:
    """Take a message that means nothing before the run."""
