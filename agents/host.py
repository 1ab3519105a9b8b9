"""An agent process: it attaches its nodes to Zenoh and runs their program, in either pacing.

Joining, losing the emulator and ending are the same for both; `_run_lockstep` and `_run_realtime` differ in
who owns the clock.
"""

from __future__ import annotations

import asyncio
import gc
import queue
import time
from collections.abc import Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING

from agents.attachment import Attachment, Found, MessageCame, RunOverError, no_wake, write_line
from vnet.errors import ProgramError, TransportError, VnetError
from vnet.runtime import interrupts
from vnet.runtime.ahead import RunAhead
from vnet.runtime.arrivals import Mail
from vnet.runtime.host import Disks, Host
from vnet.runtime.process_end import count_as_death, end_within
from vnet.runtime.programs import Programs, load_programs
from vnet.runtime.virtual_time import SkewedLoop, VirtualTimeLoop
from vnet.transport import wire
from vnet.transport.credentials import Credentials
from vnet.transport.scheduling import COMPUTING_SLICE_NS, PROMPT_SLICE_NS, never_preempt, set_time_slice
from vnet.transport.session import open_client
from vnet.transport.wire import MessageRef, WireSendResult

if TYPE_CHECKING:
    from vnet.runtime.debugger import NodeDebugger

LEASE_MS = 60_000
"""Long, because a starved machine must not look like a dead one; a closed connection is seen at once."""

UNSEEN_NS = 1_000_000_000
"""Nanoseconds after which a message of the backbone that has not come is asked for again: each key has a thread of
Zenoh's, so it may come a little later than the batch that refers to it."""


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
    host = Host(welcomes, lambda: loop.now_ns, lambda: ahead.catch_up(), write_line, disks, debugger)
    ahead = RunAhead(host, lambda: loop.now_ns, swap)
    loop.before_job = ahead.catch_up
    attachment.time_ns = lambda: loop.now_ns
    asyncio.set_event_loop(loop)
    try:
        host.order_events(loop)
        loop.start_at(next_grant())
        host.start(loop, programs)
        host.run(loop)
    except RunOverError:
        ahead.close()
        attachment.say_so_far(host.unhandled_so_far())
        host.close(loop)
        attachment.say(wire.Final(attachment.nonce, host.take_final()))
    finally:
        loop.close()


def _run_realtime(
    attachment: Attachment, welcomes: Sequence[wire.Welcome], programs: Programs, disks: Disks | None
) -> None:
    """Run the programs on an ordinary loop, on the wall clock."""
    with asyncio.Runner(loop_factory=_WallClockLoop) as runner:
        runner.run(_RealTimeAgent(attachment, welcomes, programs, disks).main())


class _WallClockLoop(SkewedLoop):
    """An ordinary loop that knows when the run began, so that clocks can go wrong."""

    origin_ns = 0

    @property
    def now_ns(self) -> int:
        """Nanoseconds since the start of the run."""
        return max(time.monotonic_ns() - self.origin_ns, 0)


class _RealTimeAgent:
    """Real time: frames go out as they are sent, batches come in when they are due."""

    def __init__(
        self, attachment: Attachment, welcomes: Sequence[wire.Welcome], programs: Programs, disks: Disks | None
    ) -> None:
        self._attachment = attachment
        self._programs = programs
        self._boot_id = welcomes[0].boot_id
        self._origin_ns = time.monotonic_ns()
        self._host = Host(welcomes, self._now_ns, self._schedule_flush, write_line, disks)
        self._wake_pending = False
        self._flush_pending = False
        self._started = False
        self._receipts = wire.Receipts()
        self._sends: dict[tuple[str, int], int] = {}
        """Frames to single vehicles without a result, by node and number, and the `seq` with which they went."""
        self._unseen: dict[MessageRef, int] = {}
        """Messages of the backbone that have not come, and when (monotonic ns) a batch has referred to them."""
        self._orphan_timer: asyncio.TimerHandle | None = None

    def _now_ns(self) -> int:
        return max(time.monotonic_ns() - self._origin_ns, 0)

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
        if not present:
            patience_s = self._attachment.patience_s
            self._orphan_timer = self._loop.call_later(patience_s, self._orphaned, patience_s)

    def _orphaned(self, patience_s: float) -> None:
        if not self._over.done():
            self._over.set_exception(TransportError(self._attachment.orphaned(patience_s)))

    def _take(self, batch: wire.Batch, arrived_ns: int) -> None:
        if batch.origin_ns is not None and not self._started:
            same_machine = self._boot_id != "" and self._boot_id == wire.boot_id()
            head_start_ns = 0 if batch.start_ns else wire.HEAD_START_NS
            here_ns = time.monotonic_ns() + head_start_ns - batch.start_ns
            self._origin_ns = self._loop.origin_ns = batch.origin_ns if same_machine else here_ns
            self._started = True
            head_start_s = max(0.0, (self._origin_ns + batch.start_ns - time.monotonic_ns()) / 1e9)
            self._loop.call_later(head_start_s, self._host.start, self._loop, self._programs)
        now_ns = arrived_ns - self._origin_ns
        self._host.apply_clock_error(batch.clocks, self._loop)
        self._host.busy.add(batch.busy)
        self._receipts.take(batch, now_ns)
        self._host.mail.deliver(Mail.of(batch.packets, batch.fixes))
        self._take_results(batch)
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
        now_ns = time.monotonic_ns()
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
        traffic = self._host.take_traffic()
        seq = self._receipts.seq
        self._sends.update(((each.node, each.number), seq) for each in traffic.frames if each.to is not None)
        self._attachment.say(self._receipts.frames(self._attachment.nonce, traffic, final, self._take_overdue()))
        self._attachment.publish(traffic)

    async def _acknowledge(self) -> None:
        """A sign of life once a second, also from programs that never send."""
        while True:
            await asyncio.sleep(1.0)
            if self._started:
                self._drain()
                self._flush()
