"""The attachment of an agent process to Zenoh: its keys, its queue of messages, and how it joins and waits."""

from __future__ import annotations

import os
import queue
import secrets
import socket
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress

import zenoh
from msgspec.structs import replace

from vnet.errors import TransportError, WireError
from vnet.transport import keys, wire
from vnet.transport.backbone_keys import Contents, Sent, decode_arrived, encode, split_frames, split_yield
from vnet.transport.wire import MessageRef, WireMessage

HELLO_PERIOD_S = 0.5
TOLD_S = 5.0
"""Seconds for which an agent waits for the answer of the emulator to what it has left unhandled, at most."""

_WHERE = wire.encode(wire.StackRequest())


class RunOverError(Exception):
    """The emulator has said that the run is over."""


class Lost:
    """Stands in the message queue for: the emulator is gone."""


class Found:
    """Stands in the message queue for: the emulator is there (again)."""


class MessageCame:
    """Stands in the message queue for: a message of the backbone has come on a unit's own key."""


Item = tuple[bytes, int] | type[Lost] | type[Found] | type[MessageCame]
"""Entry of the queue that Zenoh's threads fill: a message with its arrival (monotonic ns), or a state."""


class Attachment:
    """The process's keys: it sends on the `tx` of its first node, and receives in one queue."""

    def __init__(self, session: zenoh.Session, run: str, nodes: Sequence[str], stack: ExitStack) -> None:
        self.nodes = list(nodes)
        self.nonce = secrets.token_bytes(16)
        self.inbox: queue.SimpleQueue[Item] = queue.SimpleQueue()
        self._set_aside: deque[Item] = deque()
        self.on_message: Callable[[bytes], None] = no_wake
        self.time_ns: Callable[[], int | None] = no_time
        self.orphan_timeout_s = 5.0
        self._patience_until = 0.0
        self._malformed = 0
        self._host = socket.gethostname()
        self._main_thread = threading.main_thread().ident
        self.units: UnitKeys | None = None
        self._publishers = {
            node: stack.enter_context(
                session.declare_publisher(
                    keys.node_tx(run, node), congestion_control=zenoh.CongestionControl.BLOCK, express=True
                )
            )
            for node in nodes
        }
        self._reports = {
            node: stack.enter_context(
                session.declare_publisher(
                    keys.node_report(run, node), congestion_control=zenoh.CongestionControl.DROP
                )
            )
            for node in nodes
        }
        for node in nodes:
            stack.enter_context(session.declare_subscriber(keys.node_rx(run, node), self._on_rx))
            stack.enter_context(session.liveliness().declare_token(keys.node_alive(run, node)))
        stack.enter_context(
            session.liveliness().declare_subscriber(keys.emulator_alive(run), self._on_emulator, history=True)
        )

    # Zenoh's thread: pass on and return.

    def _on_rx(self, sample: zenoh.Sample) -> None:
        payload = sample.payload.to_bytes()
        if payload == _WHERE:  # the program's thread may be stuck: this one answers
            self.say(wire.StackDump(self.nonce, self._stack(), self.time_ns()))
            return
        self.inbox.put((payload, time.monotonic_ns()))
        self.on_message(payload)

    def _on_emulator(self, sample: zenoh.Sample) -> None:
        self.inbox.put(Found if sample.kind == zenoh.SampleKind.PUT else Lost)
        self.on_message(b"")

    def open_units(self, session: zenoh.Session, run: str, units: Sequence[str], stack: ExitStack) -> None:
        """Open the keys of roadside units, whose messages come there: after their welcome, and before all else."""
        if units:
            self.units = UnitKeys(session, run, units, self._message_came, stack)

    def _message_came(self) -> None:
        self.inbox.put(MessageCame)
        self.on_message(b"")

    def _stack(self) -> str:
        frame = sys._current_frames().get(self._main_thread or 0)
        return "".join(traceback.format_stack(frame)[-12:]) if frame else ""

    # The program's thread.

    def say(self, message: wire.AgentMessage) -> None:
        """Put a message on the process's own `tx`, and before it the messages of units on theirs."""
        if self.units is not None:
            message = self.units.put(message)
        self._publishers[self.nodes[0]].put(wire.encode(message))

    def say_so_far(self, traffic: wire.Traffic | None) -> None:
        """Say what is unhandled before programs are ended, and wait until it has come: they may end the process."""
        if traffic is None:
            return
        self.say(wire.Final(self.nonce, traffic, provisional=True))
        deadline = time.monotonic() + TOLD_S
        with suppress(RunOverError, TransportError):
            while (wait_s := deadline - time.monotonic()) > 0:
                self._next(wait_s)

    def publish(self, traffic: wire.Traffic) -> None:
        """Put a copy of each report on its key, where somebody listens."""
        for report in traffic.reports:
            publisher = self._reports[report.node]
            if publisher.matching_status.matching:  # type: ignore[attr-defined]  # the stub says bool
                publisher.put(wire.encode(report))

    def say_hello(self, ready: bool = False, failure: str | None = None) -> None:
        """Say hello for each node on its own `tx`."""
        for node, publisher in self._publishers.items():
            hello = wire.Hello(
                node,
                self.nodes[0],
                self.nonce,
                os.getpid(),
                self._host,
                ready=ready,
                failure=failure,
                version=wire.VERSION,
                ahead=True,
            )
            publisher.put(wire.encode(hello))

    def join(self, timeout_s: float) -> list[wire.Welcome]:
        """Repeat hello until every node is welcome.

        Raises TransportError on refusal, after `timeout_s`, and if the emulator speaks another version.
        """
        welcomes: dict[str, wire.Welcome] = {}
        deadline = time.monotonic() + timeout_s
        while True:
            self.say_hello()
            next_hello = time.monotonic() + HELLO_PERIOD_S
            while (wait_s := next_hello - time.monotonic()) > 0:
                message = self._next(wait_s)
                if isinstance(message, wire.Welcome) and message.nonce == self.nonce:
                    if message.version != wire.VERSION:
                        raise TransportError(wire.other_version("emulator", message.version, "agent"))
                    welcomes[message.node] = message
                if len(welcomes) == len(self.nodes):
                    self.orphan_timeout_s = message.orphan_timeout_s  # type: ignore[union-attr]
                    return [welcomes[node] for node in self.nodes]
            if time.monotonic() > deadline:
                missing = ", ".join(node for node in self.nodes if node not in welcomes)
                raise TransportError(f"no welcome for {missing} within {timeout_s:g} s: is the emulator running?")

    def next_message(self) -> wire.EmulatorMessage:
        """The next message, waiting for as long as the emulator is there.

        Raises RunOverError at the end of the run, TransportError once the emulator has been gone for
        `orphan_timeout_s`.
        """
        message = None
        while message is None:
            message = self._next(None)
        if isinstance(message, wire.Grant) and message.messages and self.units is not None:
            return self._in_full(message, self.units)
        return message

    def _in_full(self, grant: wire.Grant, units: UnitKeys) -> wire.Grant:
        """Return a grant with the messages of units in the place of references, once all have come."""
        while units.missing(grant.messages):
            self._next(None)
        return replace(grant, messages=units.take(grant.messages)[0])

    def _next(self, timeout_s: float | None) -> wire.EmulatorMessage | None:
        try:
            item = self._set_aside.popleft() if self._set_aside else self.inbox.get(timeout=timeout_s)
        except queue.Empty:
            return None
        if item is Lost:
            self._wait_as_orphan()
            return None
        return self.decode(item)

    def decode(self, item: Item) -> wire.EmulatorMessage | None:
        """A queued item as a message for this process; raises RunOverError and TransportError when told to go."""
        if not isinstance(item, tuple):
            return None
        try:
            message = wire.decode_rx(item[0])
        except WireError as error:
            self._malformed += 1
            if self._malformed == 1:
                print(
                    f"vnet-agent: {self.nodes[0]}: a message of the emulator is dropped: {error}", file=sys.stderr
                )
            return None
        if isinstance(message, wire.Await):
            self._patience_until = time.monotonic() + message.within_s
            return None
        if isinstance(message, wire.End) and message.nonce in (None, self.nonce):
            if message.refused:
                raise TransportError(f"refused: {message.reason}")
            raise RunOverError(message.reason)
        return message

    def write_total(self) -> None:
        """Log how many messages were dropped because they did not decode, if any."""
        if self._malformed:
            print(f"vnet-agent: {self.nodes[0]}: malformed messages dropped: {self._malformed}", file=sys.stderr)

    @property
    def patience_s(self) -> float:
        """Seconds to wait for an emulator that is gone: longer if it has announced it."""
        return max(self.orphan_timeout_s, self._patience_until - time.monotonic())

    def _wait_as_orphan(self) -> None:
        """Wait until the emulator is back; its first messages may be faster than the news of it."""
        patience_s = self.patience_s
        deadline = time.monotonic() + patience_s
        while (wait_s := deadline - time.monotonic()) > 0:
            try:
                item = self.inbox.get(timeout=wait_s)
            except queue.Empty:
                break
            if item is Found:
                self.found()
                return
            if isinstance(item, tuple):
                self._set_aside.append(item)
        raise TransportError(self.orphaned(patience_s))

    def found(self) -> None:
        """The emulator is back: it has said nothing about when it goes the next time."""
        self._patience_until = 0.0

    def orphaned(self, patience_s: float) -> str:
        """The one line of an agent that has lost its emulator for so long."""
        return f"{self.nodes[0]}: the emulator has been gone for {patience_s:.3g} s; ending"


def no_time() -> int | None:
    """In real time, and before the first grant, there is no instant to tell of."""
    return None


def no_wake(payload: bytes) -> None:
    """In lockstep the program's thread waits on the queue itself."""


def write_line(node: str, line: str) -> None:
    """Write a line of a node's log to that of its process."""
    print(line, file=sys.stderr, flush=True)


class UnitKeys:
    """Keys of the roadside units of a process, for messages of the backbone.

    `on_arrived` is called on Zenoh's thread when a message has come.
    What has come is kept until a grant or a batch refers to it.
    """

    def __init__(
        self,
        session: zenoh.Session,
        run: str,
        units: Sequence[str],
        on_arrived: Callable[[], None],
        stack: ExitStack,
    ) -> None:
        self._on_arrived = on_arrived
        self._contents: Contents[WireMessage] = Contents()
        self._lock = threading.Lock()
        self._publishers = {
            unit: stack.enter_context(
                session.declare_publisher(
                    keys.backbone_tx(run, unit), congestion_control=zenoh.CongestionControl.BLOCK, express=True
                )
            )
            for unit in units
        }
        for unit in units:
            stack.enter_context(session.declare_subscriber(keys.backbone_rx(run, unit), self._take))

    def _take(self, sample: zenoh.Sample) -> None:
        try:
            arrived = decode_arrived(sample.payload.to_bytes())
        except WireError:  # whoever waits for it says so in the end
            return
        with self._lock:
            self._contents.add(arrived.message(keys.node_of(str(sample.key_expr))))
        self._on_arrived()

    def put(self, message: wire.AgentMessage) -> wire.AgentMessage:
        """Put the messages of units; return what their process says, with references in their place."""
        contents: list[tuple[str, Sent]] = []
        if isinstance(message, wire.Yield) and any(step.traffic.messages for step in message.steps):
            message, contents = split_yield(message)
        elif isinstance(message, wire.Frames) and message.traffic.messages:
            message, contents = split_frames(message)
        for unit, content in contents:
            self._publishers[unit].put(encode(content))
        return message

    def missing(self, refs: Sequence[MessageRef]) -> list[MessageRef]:
        """Return the references to messages that have not come yet."""
        with self._lock:
            return self._contents.missing(refs)

    def take(self, refs: Sequence[MessageRef]) -> tuple[list[WireMessage], list[MessageRef]]:
        """Remove and return the messages that have come of these, and the references to those that have not."""
        with self._lock:
            return self._contents.split(refs)
