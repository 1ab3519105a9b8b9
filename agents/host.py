"""An agent process: it attaches its nodes to Zenoh and runs their program, in either pacing.

Its `Attachment` has the keys, the queue of messages, and how it joins and waits. Joining, losing the emulator and
ending are the same for both pacings; `_run_lockstep` and `_run_realtime` differ in who owns the clock.

Beyond its window a process does not know which packets have come. As long as no vehicle of it waits on the radio,
it need not: it goes on with its timers, and with the fixes of the next period if it has been given them, up to the
instant that its grant names (`RunAhead`). It asks as soon as a program looks for packets or tells anything:
whatever the program does next, the emulator stands at its instant, and knows what it did before.
"""

from __future__ import annotations

import asyncio
import gc
import os
import queue
import secrets
import socket
import sys
import threading
import traceback
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from itertools import chain
from time import monotonic, monotonic_ns  # by name: a program may put emulated time in their place
from typing import TYPE_CHECKING, NoReturn

import zenoh
from msgspec.structs import replace

from vnet.errors import ProgramError, TransportError, VirtualTimeError, VnetError, WireError
from vnet.node import Node
from vnet.runtime import interrupts
from vnet.runtime.arrivals import Mail
from vnet.runtime.host import Disks, Host
from vnet.runtime.outside_loop import collected_by_schedule, count_as_death, end_within
from vnet.runtime.programs import Programs, load_programs
from vnet.runtime.virtual_time import SkewedLoop, VirtualTimeLoop, end_fork
from vnet.transport import keys, wire
from vnet.transport.access import LEASE_MS
from vnet.transport.credentials import Credentials
from vnet.transport.scheduling import COMPUTING_SLICE_NS, PROMPT_SLICE_NS, never_preempt, set_time_slice
from vnet.transport.session import open_client
from vnet.transport.wire import (
    Contents,
    MessageRef,
    Sent,
    WireMessage,
    WireSendResult,
    decode_arrived,
    encode,
    split_frames,
    split_yield,
)

if TYPE_CHECKING:
    from vnet.runtime.debugger import NodeDebugger

HELLO_PERIOD_S = 0.5
TOLD_S = 5.0
"""Seconds for which an agent waits for the answer of the emulator to what it has left unhandled, at most."""

_WHERE = wire.encode(wire.StackRequest())

UNSEEN_NS = 1_000_000_000
"""Nanoseconds after which a message of the backbone that has not come is asked for again: each key has a thread of
Zenoh's, so it may come a little later than the batch that refers to it."""
MOST_KEPT = 10_000
"""Messages of a process that are kept in part, to be said again should they be lost."""


class RunOverError(Exception):
    """The emulator has said that the run is over, in lockstep also when (`time_ns`; None if it has not)."""

    def __init__(self, reason: str, time_ns: int | None) -> None:
        super().__init__(reason)
        self.time_ns = time_ns


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
        self.time_ns: Callable[[], int | None] = lambda: None  # in real time, and before the first grant
        self.hello_ns = 0
        """Instant (monotonic ns) of its last hello: at the latest then it was ready."""
        self.frames_seq: int | None = None
        """Real time: number of `Frames` that have been said."""
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
            self.say(wire.StackDump(self.nonce, self._stack(), self.time_ns(), self.frames_seq))
            return
        self.inbox.put((payload, monotonic_ns()))
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
        deadline = monotonic() + TOLD_S
        with suppress(RunOverError, TransportError):
            while (wait_s := deadline - monotonic()) > 0:
                self._next(wait_s)

    def publish(self, traffic: wire.Traffic) -> None:
        """Put a copy of each report on its key, where somebody listens."""
        for report in traffic.reports:
            publisher = self._reports[report.node]
            if publisher.matching_status.matching:  # type: ignore[attr-defined]  # the stub says bool
                publisher.put(wire.encode(report))

    def say_hello(self, ready: bool = False, failure: str | None = None) -> None:
        """Say hello for each node on its own `tx`."""
        self.hello_ns = monotonic_ns()
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
        deadline = monotonic() + timeout_s
        while True:
            self.say_hello()
            next_hello = monotonic() + HELLO_PERIOD_S
            while (wait_s := next_hello - monotonic()) > 0:
                message = self._next(wait_s)
                if isinstance(message, wire.Welcome) and message.nonce == self.nonce:
                    if message.version != wire.VERSION:
                        raise TransportError(wire.other_version("emulator", message.version, "agent"))
                    welcomes[message.node] = message
                if len(welcomes) == len(self.nodes):
                    self.orphan_timeout_s = message.orphan_timeout_s  # type: ignore[union-attr]
                    return [welcomes[node] for node in self.nodes]
            if monotonic() > deadline:
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
            self._patience_until = monotonic() + message.within_s
            return None
        if isinstance(message, wire.End) and message.nonce in (None, self.nonce):
            if message.refused:
                raise TransportError(f"refused: {message.reason}")
            raise RunOverError(message.reason, message.time_ns)
        return message

    def write_total(self) -> None:
        """Log how many messages were dropped because they did not decode, if any."""
        if self._malformed:
            print(f"vnet-agent: {self.nodes[0]}: malformed messages dropped: {self._malformed}", file=sys.stderr)

    @property
    def patience_s(self) -> float:
        """Seconds to wait for an emulator that is gone: longer if it has announced it."""
        return max(self.orphan_timeout_s, self._patience_until - monotonic())

    def _wait_as_orphan(self) -> None:
        """Wait until the emulator is back; its first messages may be faster than the news of it."""
        patience_s = self.patience_s
        deadline = monotonic() + patience_s
        while (wait_s := deadline - monotonic()) > 0:
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


def run_agent(
    endpoint: str,
    run: str,
    nodes: Sequence[str],
    credentials: Credentials | None,
    join_timeout_s: float,
    disks: Disks | None = None,
    debugger: NodeDebugger | None = None,
    connect_timeout_s: float | None = None,
) -> None:
    """Join `run` at `endpoint` as `nodes` and run their programs to the end of the run.

    `disks` has the folders of the nodes, by default temporary ones. `debugger` stops in a program, in lockstep.
    `connect_timeout_s` is how long to wait for a router, `join_timeout_s` for the emulator behind it.

    Raises TransportError (cannot join, refused, orphaned) and ProgramError (the program cannot be loaded).
    """
    with ExitStack() as stack:
        set_time_slice(PROMPT_SLICE_NS)  # Zenoh's threads keep it
        with interrupts.ended_by_system():  # Zenoh connects in code of its own, where no handler of Python's runs
            session = stack.enter_context(open_client(endpoint, credentials, LEASE_MS, connect_timeout_s))
        attachment = Attachment(session, run, nodes, stack)
        stack.callback(attachment.write_total)
        stack.callback(end_within)
        set_time_slice(COMPUTING_SLICE_NS)
        welcomes = attachment.join(join_timeout_s)
        count_as_death()
        try:
            programs = load_programs(welcomes)
        except ProgramError as error:
            attachment.say_hello(failure=str(error))
            raise
        gc.freeze()  # what is loaded stays: it need not be searched for garbage again and again
        attachment.open_units(session, run, [each.node for each in welcomes if each.unit is not None], stack)
        attachment.say_hello(ready=True)
        if welcomes[0].pacing == "lockstep":
            never_preempt()
            _run_lockstep(attachment, welcomes, programs, disks, debugger)
        else:
            _run_realtime(attachment, welcomes, programs, disks)


def _run_lockstep(
    attachment: Attachment,
    welcomes: Sequence[wire.Welcome],
    programs: Programs,
    disks: Disks | None,
    debugger: NodeDebugger | None,
) -> None:
    """Run the programs on a virtual-time loop until the emulator ends the run."""
    seq = 0

    def swap(next_timer_ns: int | None) -> int:
        message = host.make_yield(attachment.nonce, seq, next_timer_ns)
        attachment.say(message)
        for step in message.steps:
            attachment.publish(step.traffic)
        return next_grant()

    def next_grant() -> int:
        nonlocal seq
        message = attachment.next_message()
        while not isinstance(message, wire.Grant):
            message = attachment.next_message()
        seq = message.seq
        if message.clocks:
            host.apply_clock_error(message.clocks, loop)
        return ahead.open_window(message)

    loop = VirtualTimeLoop(lambda next_timer_ns: ahead.exchange(next_timer_ns), welcomes[0].spin_limit)
    host = Host(welcomes, lambda: loop.now_ns, lambda: ahead.tell(), write_line, disks, debugger)
    ahead = RunAhead(host, lambda: loop.now_ns, swap)
    loop.before_job = ahead.catch_up
    count_as_death(ahead.catch_up)
    attachment.time_ns = lambda: loop.now_ns
    asyncio.set_event_loop(loop)
    try:
        with collected_by_schedule():  # to the end, at which nothing is collected any more
            try:
                host.order_events(loop)
                loop.start_at(next_grant())
                host.start(loop, programs)
                host.run(loop)
            except RunOverError as over:
                ahead.close()
                attachment.say_so_far(host.unhandled_so_far())
                host.close(loop, over.time_ns)
                attachment.say(wire.Final(attachment.nonce, host.take_final()))
    finally:
        loop.close()
        host.discard_abandoned()


def _run_realtime(
    attachment: Attachment, welcomes: Sequence[wire.Welcome], programs: Programs, disks: Disks | None
) -> None:
    """Run the programs on an ordinary loop, on the wall clock."""
    with asyncio.Runner(loop_factory=_WallClockLoop) as runner:
        runner.run(_RealTimeAgent(attachment, welcomes, programs, disks).main())


class _WallClockLoop(SkewedLoop):
    """An ordinary loop that knows when the run began, so that clocks can go wrong."""

    origin_ns = 0

    def __init__(self) -> None:
        super().__init__()
        self._process = os.getpid()

    @property
    def now_ns(self) -> int:
        """Nanoseconds since the start of the run."""
        return max(monotonic_ns() - self.origin_ns, 0)

    def time(self) -> float:
        """As asyncio's, which asks in each round; not for what a program has forked, without Zenoh's threads."""
        if os.getpid() != self._process:
            end_fork()
        return super().time()


class _RealTimeAgent:
    """Real time: frames go out as they are sent, batches come in when they are due."""

    def __init__(
        self, attachment: Attachment, welcomes: Sequence[wire.Welcome], programs: Programs, disks: Disks | None
    ) -> None:
        self._attachment = attachment
        self._programs = programs
        self._boot_id = welcomes[0].boot_id
        self._origin_ns = monotonic_ns()
        self._host = Host(welcomes, self._now_ns, self._schedule_flush, write_line, disks)
        self._wake_pending = False
        self._flush_pending = False
        self._started = False
        self._receipts = wire.Receipts()
        self._sends: dict[tuple[str, int], int] = {}
        """Frames to single vehicles without a result, by node and number, and the `seq` with which they went."""
        self._said: dict[int, wire.Traffic] = {}
        """Notes, exceptions and ends of programs in the latest `Frames`, by their `seq`."""
        self._said_again: list[wire.Traffic] = []
        """That of `Frames` which have never come, for the next ones."""
        self._has_told_an_end = False
        self._unseen: dict[MessageRef, int] = {}
        """Messages of the backbone that have not come, and when (monotonic ns) a batch has referred to them."""
        self._orphan_timer: asyncio.TimerHandle | None = None

    def _now_ns(self) -> int:
        return max(monotonic_ns() - self._origin_ns, 0)

    async def main(self) -> None:
        """From the start of the run to its end."""
        loop = asyncio.get_running_loop()
        assert isinstance(loop, _WallClockLoop)
        self._loop = loop
        self._over: asyncio.Future[None] = self._loop.create_future()
        self._attachment.on_message = self._wake
        for node in self._host.nodes.values():
            node.radio.inbox.refill = node.gnss.inbox.refill = self._drain
            if node.backbone is not None:
                node.backbone.inbox.refill = self._drain
        self._wake(b"")
        acknowledging = self._loop.create_task(self._acknowledge())
        try:
            await self._over
        except RunOverError:
            self._attachment.say_so_far(self._host.unhandled_so_far())
            await self._host.cancel()
            self._flush(final=True)
        finally:
            acknowledging.cancel()
            self._attachment.on_message = no_wake

    def _wake(self, payload: bytes) -> None:
        # Zenoh's thread; one wake-up for however many messages come before it is answered. What nobody waits
        # for wakes nobody: the program finds it when it looks.
        if self._started and wire.is_batch(payload) and not self._awaits(wire.is_packets_only(payload)):
            return
        if not self._wake_pending:
            self._wake_pending = True
            self._loop.call_soon_threadsafe(self._drain)

    def _awaits(self, packets_only: bool) -> bool:
        if self._has_told_an_end and not packets_only:  # a batch may say that it is lost
            return True
        return any(
            node.radio.inbox.awaited
            or node.radio.is_sending
            or (node.gnss.inbox.awaited and not packets_only)
            or (node.backbone is not None and node.backbone.inbox.awaited)
            for node in self._host.nodes.values()
        )

    def _drain(self) -> None:
        self._wake_pending = False
        try:
            while True:
                item = self._attachment.inbox.get_nowait()
                if item is MessageCame:
                    self._deliver_messages()
                elif not isinstance(item, tuple):
                    self._emulator_present(item is Found)
                elif isinstance(message := self._attachment.decode(item), wire.Batch):
                    self._take(message, item[1])
        except queue.Empty:
            pass
        except (RunOverError, VnetError) as end:
            if not self._over.done():
                self._over.set_exception(end)

    def _emulator_present(self, present: bool) -> None:
        if self._orphan_timer is not None:
            self._orphan_timer.cancel()
            self._orphan_timer = None
            if present:
                self._attachment.found()
                self._schedule_flush()  # the emulator waits for a message of a process that was paused meanwhile
        if not present:
            patience_s = self._attachment.patience_s
            self._orphan_timer = self._loop.call_later(patience_s, self._orphaned, patience_s)

    def _orphaned(self, patience_s: float) -> None:
        if not self._over.done():
            self._over.set_exception(TransportError(self._attachment.orphaned(patience_s)))

    def _take(self, batch: wire.Batch, arrived_ns: int) -> None:
        if batch.origin_ns is not None and not self._started:
            head_start_ns = 0 if batch.start_ns else wire.HEAD_START_NS
            sent_ns = batch.origin_ns + batch.start_ns - head_start_ns
            # By a clock that is shared the batch was sent once this process was ready, and before it came.
            is_possible = self._attachment.hello_ns <= sent_ns <= arrived_ns
            is_shared = is_possible and self._boot_id != "" and self._boot_id == wire.boot_id()
            here_ns = batch.origin_ns if is_shared else batch.origin_ns + arrived_ns - sent_ns
            self._origin_ns = self._loop.origin_ns = here_ns
            self._started = True
            head_start_s = max(0.0, (self._origin_ns + batch.start_ns - monotonic_ns()) / 1e9)
            self._loop.call_later(head_start_s, self._host.start, self._loop, self._programs)
        now_ns = arrived_ns - self._origin_ns
        self._host.apply_clock_error(batch.clocks, self._loop)
        self._host.busy.add(batch.busy)
        self._receipts.take(batch, now_ns)
        self._host.mail.deliver(Mail.of(batch.packets, batch.fixes))
        self._take_results(batch)
        if batch.lost:
            lost = [seq for seq in self._said if any(first <= seq <= last for first, last in batch.lost)]
            self._said_again += map(self._said.pop, lost)
            self._schedule_flush()
        if batch.messages:
            self._unseen.update(dict.fromkeys(batch.messages, arrived_ns))
            self._deliver_messages()

    def _deliver_messages(self) -> None:
        """Deliver those messages of the backbone to which batches have referred and that have come."""
        if self._attachment.units is not None and self._unseen:
            arrived, missing = self._attachment.units.take(list(self._unseen))
            self._unseen = {ref: self._unseen[ref] for ref in missing}
            self._host.mail.deliver_news(arrived)

    def _take_results(self, batch: wire.Batch) -> None:
        """Deliver results of frames to single vehicles; those of frames that were lost on their way have failed."""
        lost = [
            WireSendResult(node, number, self._now_ns(), False, 0)
            for (node, number), seq in self._sends.items()
            if any(first <= seq <= last for first, last in batch.lost)
        ]
        for result in (results := [*batch.results, *lost]):
            self._sends.pop((result.node, result.number), None)
        self._host.mail.deliver_news(results)

    def _take_overdue(self) -> list[MessageRef]:
        """Return references to messages that have not come for `UNSEEN_NS`, and await them no longer."""
        self._deliver_messages()  # a program that has computed for long has looked at none
        now_ns = monotonic_ns()
        overdue = [ref for ref, since_ns in self._unseen.items() if now_ns - since_ns >= UNSEEN_NS]
        for ref in overdue:
            del self._unseen[ref]
        return overdue

    def _schedule_flush(self) -> None:
        if not self._flush_pending:
            self._flush_pending = True
            self._loop.call_soon(self._flush)

    def _flush(self, final: bool = False) -> None:
        self._flush_pending = False
        traffic, again, self._said_again = self._host.take_traffic(), self._said_again, []
        if final:  # no batch will say what a restart of the emulator has lost; who has ended twice has ended
            again += [wire.Traffic(endings=each.endings) for each in self._said.values()]
        for name in ("notes", "unhandled", "endings") if again else ():
            parts = [getattr(each, name) for each in (*again, traffic)]
            traffic = replace(traffic, **{name: list(chain.from_iterable(parts))})
        seq = self._receipts.seq
        if kept := wire.Traffic(notes=traffic.notes, unhandled=traffic.unhandled, endings=traffic.endings):
            self._said[seq], self._has_told_an_end = kept, self._has_told_an_end or bool(kept.endings)
            if len(self._said) > MOST_KEPT:
                del self._said[next(iter(self._said))]
        self._sends.update(((each.node, each.number), seq) for each in traffic.frames if each.to is not None)
        self._attachment.say(self._receipts.frames(self._attachment.nonce, traffic, final, self._take_overdue()))
        self._attachment.frames_seq = self._receipts.seq
        self._attachment.publish(traffic)

    async def _acknowledge(self) -> None:
        """A sign of life once a second, also from programs that never send."""
        while True:
            await asyncio.sleep(1.0)
            if self._started:
                self._drain()
                self._flush()


Swap = Callable[[int | None], int]
"""Yield with the next timer (ns), await the next grant, give it to `RunAhead.open_window`, and return its time."""


class RunAhead:
    """Passes a host through its windows and the quiet instants behind them. `clock` is the loop's own, in ns.

    It is made in the thread of the loop. The loop calls `catch_up` before each job, the host `tell`.
    """

    def __init__(self, host: Host, clock: Callable[[], int], swap: Swap) -> None:
        self._host = host
        self._clock = clock
        self._swap = swap
        self._end_ns = 0
        self._quiet_ns = 0
        self._fixes: Sequence[wire.WireFix] = ()
        self._fixes_ns: int | None = None
        self._failure: BaseException | None = None
        self._thread = os.getpid(), threading.get_ident()
        self._is_exchanging = False
        self._is_over = False
        for node in host.nodes.values():
            node.radio.inbox.refill = partial(self._look, node.radio.inbox.refill)

    def open_window(self, grant: wire.Grant) -> int:
        """Take a grant; returns its first instant, with everything delivered that is due at it."""
        if self._fixes_ns is not None and self._fixes_ns <= grant.time_ns:
            grant = replace(grant, fixes=[*self._take_fixes(), *grant.fixes])
        self._end_ns, self._quiet_ns = grant.end_ns, grant.quiet_ns
        if grant.next_fixes_ns is not None:
            self._fixes_ns, self._fixes = grant.next_fixes_ns, grant.next_fixes
        return self._host.open_window(grant)

    def exchange(self, next_timer_ns: int | None) -> int:
        """End an instant at which nothing is left to do; returns the next, for which it may ask the emulator."""
        self._is_exchanging = True
        try:
            if self._failure is not None:
                self._give_up(self._failure)
            return self._pass_on(next_timer_ns)
        finally:
            self._is_exchanging = False

    def _pass_on(self, next_timer_ns: int | None) -> int:
        now_ns = self._clock()
        if now_ns >= self._end_ns and (self._host.must_ask or not self._may_pass(self._wake_ns(next_timer_ns))):
            self._reach(now_ns)  # the last of quiet instants, too: a program that is ended finds what came by then
        next_ns = self._host.next_instant(next_timer_ns)
        if next_ns is not None:
            return next_ns
        wake_ns = self._wake_ns(next_timer_ns)
        if wake_ns is None or not self._may_pass(wake_ns):
            return self._swap(wake_ns)
        if self._fixes_ns is not None and self._fixes_ns <= wake_ns:
            self._host.mail.deliver(Mail.of((), self._take_fixes()), wake_ns)
        return wake_ns

    def _look(self, refill: Callable[[], None]) -> None:
        """Let a program look for packets, as of this instant."""
        self.catch_up()
        refill()

    def tell(self) -> None:
        """Have this instant granted if it is quiet, and what is told at it cannot be told in advance."""
        if self._host.must_ask:
            self.catch_up()

    def catch_up(self) -> None:
        """Have this instant granted if it is quiet: a program looks for packets, begins a job, or ends.

        Other threads, and processes that a program has forked, cannot ask. What ends the run here must not pass
        through the program: it leaves the loop when the instant is over.
        """
        if self._clock() < self._end_ns or self._is_exchanging or self._is_over or self._failure is not None:
            return
        if (os.getpid(), threading.get_ident()) != self._thread:
            return
        self._is_exchanging = True
        try:
            self._reach(self._clock())
        except BaseException as failure:
            self._failure = failure
        finally:
            self._is_exchanging = False

    def close(self) -> None:
        """Let programs that are ended look for packets, and tell what they will, without asking."""
        self._is_over = True

    def _may_pass(self, wake_ns: int | None) -> bool:
        """Return whether the process may go on to `wake_ns`, beyond the window, by itself."""
        if wake_ns is None or wake_ns >= self._quiet_ns:
            return False
        return not any(map(_listens, self._host.nodes.values()))

    def _wake_ns(self, next_timer_ns: int | None) -> int | None:
        """Return the earliest of the next timer and, if a vehicle waits for one, the fixes that are here."""
        fixes_ns = self._fixes_ns
        if fixes_ns is None or (next_timer_ns is not None and next_timer_ns <= fixes_ns):
            return next_timer_ns
        awaits_fix = any(node.gnss.inbox.waiting for node in self._host.nodes.values())
        return fixes_ns if awaits_fix else next_timer_ns

    def _take_fixes(self) -> Sequence[wire.WireFix]:
        fixes, self._fixes, self._fixes_ns = self._fixes, (), None
        return fixes

    def _reach(self, time_ns: int) -> None:
        """Have this quiet instant granted."""
        granted_ns = self._swap(time_ns)
        if granted_ns != time_ns:
            raise VirtualTimeError(f"granted {granted_ns} ns to a process that has come to {time_ns} ns")

    def _give_up(self, failure: BaseException) -> NoReturn:
        """Leave the loop; what was done at an instant that was never granted is dropped."""
        self._host.take_traffic()
        self._failure = None
        raise failure


def _listens(node: Node) -> bool:
    """Return whether something that comes for a node makes an instant: for a roadside unit every message does."""
    return node.radio.inbox.waiting or node.radio.is_sending or node.backbone is not None
