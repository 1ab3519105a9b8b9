"""The driver of a live run in lockstep: grants go out, and time goes on when every process has yielded.

A run stalls if no process makes progress: none yields, and none that is asked has come to a later instant.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Collection, Sequence

from emulator.drivers.live.driver import Driver, Parts
from emulator.drivers.live.supervisor import DEATH_GRACE_S, ProcessState
from emulator.drivers.live.waiting import Stalled
from emulator.drivers.lockstep import HorizonCallback, Lockstep, no_horizon
from emulator.records.events import EventKind
from vnet.counted import counted
from vnet.transport import wire
from vnet.transport.backbone_keys import join_yield, refs_of
from vnet.transport.wire import SentMessage

FINAL_WAIT_S = 1.0
"""Seconds for which the last message of a process that a fault ends is awaited."""
STACKS_WAIT_S = 1.0
"""Seconds after which the emulator looks whether processes that do not yield have sent their stacks."""
STACKS_LOOKS = 5
"""Number of looks after which it does without what is missing."""


class LockstepDriver(Driver):
    """Gives the barrier's grants to the processes and takes their yields."""

    message_type = wire.Yield

    def __init__(
        self, parts: Parts, processes: Sequence[Sequence[str]], before_horizon: HorizonCallback = no_horizon
    ) -> None:
        super().__init__(parts, processes)
        self._lockstep = Lockstep(parts.emulation, processes)
        if not parts.emulation.orders.explores:  # where an order is tried, no instant is quiet
            self._lockstep.ahead = parts.members.ahead
        self._before_horizon = before_horizon
        self._finals: dict[str, wire.Traffic] = {}
        self._reached_ns: dict[str, int] = {}
        self._completed = False
        self._incomplete: dict[str, wire.Yield] = {}
        """Yields that refer to messages of the backbone that have not come."""

    @property
    def time_ns(self) -> int:
        """Emulated time: the beginning of the window that was granted."""
        return self._lockstep.now_ns

    @property
    def decided_ns(self) -> int:
        """Emulated time up to which processes may have come: new faults act after it."""
        return self._lockstep.decided_ns

    def take(self, process_id: str, message: wire.Yield) -> None:
        """Take a yield, once the messages of the backbone have come to which it refers."""
        self._incomplete.pop(process_id, None)
        if refs := refs_of(message):
            self._check_refs(process_id, refs)
            if self._sent.missing(refs):
                self._incomplete[process_id] = message
                return
            message = join_yield(message, self._sent)
        self._lockstep.receive(process_id, message)
        if not self._lockstep.owed:
            self._changes.set()

    def take_sent(self, message: SentMessage) -> None:
        """Take what a unit has put on the backbone, and the yield that has waited for it."""
        self._sent.add(message)
        process_id = self._parts.members.process_of(message.node)
        if process_id in self._incomplete and process_id in self._lockstep.owed:
            self.take(process_id, self._incomplete[process_id])

    async def run(self) -> None:
        """Grant and await yields, window by window."""
        try:
            await self._run()
        finally:
            self._lockstep.tell_deaths()

    async def _run(self) -> None:
        lockstep = self._lockstep
        await self._before_horizon(lockstep)
        grants = lockstep.start()
        while grants:
            for actions in lockstep.take_actions():
                await self._apply_process_faults(actions)
            self._reached_ns = {process_id: grant.time_ns for process_id, grant in grants.items()}
            for process_id, grant in grants.items():
                self._send(process_id, lockstep.take_mail(process_id).within(grant))
            await self._all_yielded()
            grants = lockstep.step()
            while lockstep.held:
                await self._before_horizon(lockstep)
                grants = lockstep.step()
        for process_id, details in self._supervisor.take_deaths().items():
            lockstep.died(process_id, **details)
        self._completed = True

    def take_final(self, process_id: str, message: wire.Final) -> None:
        """Take the last message of a process, or what it may leave unhandled."""
        super().take_final(process_id, message)
        if not message.provisional:
            self._so_far.pop(process_id, None)
            self._finals[process_id] = message.traffic
            self._changes.set()

    async def finish(self, deadline_s: float) -> None:
        """Take what programs told as they were ended."""
        there = self._supervisor.processes_in(ProcessState.RUNNING, ProcessState.PAUSED)
        await self._all_final(there, deadline_s)
        time_ns = self._emulation.duration_ns if self._completed else self.time_ns
        self._emulation.take_final(time_ns, self._finals.values())
        self._tell_so_far(time_ns)

    async def _await_final(self, process_id: str, time_ns: int) -> None:
        await self._all_final([process_id], time.monotonic() + FINAL_WAIT_S)
        so_far = self._so_far.pop(process_id, None)
        if (traffic := self._finals.pop(process_id, so_far)) is not None:
            self._emulation.take_final(time_ns, [traffic])

    async def _all_final(self, process_ids: Collection[str], deadline_s: float) -> None:
        """Wait until these processes have sent their last message, or have gone without: it is optional."""
        while missing := [process_id for process_id in process_ids if process_id not in self._finals]:
            if self._parts.inbox.connected.isdisjoint(missing):
                deadline_s = min(deadline_s, time.monotonic() + DEATH_GRACE_S)
            if not await self._changes.wait(deadline_s - time.monotonic()):
                return

    async def _all_yielded(self) -> None:
        timeout_s = self._emulation.scenario.run.stall_timeout_s
        owed = self._lockstep.owed
        while owed:
            for process_id, details in self._supervisor.take_deaths(owed.keys()).items():
                self._lockstep.died(process_id, **details)
            patience_s = math.inf if self._waits_for_user(owed) else timeout_s
            if not owed or await self._changes.wait(patience_s) or await self._has_progressed():
                continue
            if owed:  # yields that their host kept for the sake of another process have come since
                self._stall(sorted(owed), timeout_s)

    def _waits_for_user(self, process_ids: Collection[str]) -> bool:
        """Return whether one of these processes may be in a debugger: its user takes what time it takes."""
        debugged = self._parts.debugged
        return debugged is not None and self._parts.members.process_of(debugged) in process_ids

    async def _await_returned(self, process_ids: Sequence[str]) -> None:
        """Wait until processes that have been started are ready: they may be granted the instant that comes."""
        timeout_s = self._emulation.scenario.run.join_timeout_s
        deadline = time.monotonic() + timeout_s
        while late := self._supervisor.returning_nodes(process_ids):
            if not await self._changes.wait(deadline - time.monotonic()):
                error = f"has not come back within {timeout_s:g} s"
                self._emulation.folder.event(self.time_ns, EventKind.stalled, late[0], error=error)
                raise Stalled
        self._supervisor.take_returned()

    async def _has_progressed(self) -> bool:
        """Ask the processes that do not yield for their stacks; returns whether one is at a later instant."""
        parts = self._parts
        asked = sorted(self._lockstep.owed)
        parts.inbox.stacks.clear()
        for process_id in asked:
            self._send(process_id, wire.StackRequest())
            parts.agents.request_stack(process_id)
        for _ in range(STACKS_LOOKS):  # on a busy machine an answer takes its time
            await asyncio.sleep(STACKS_WAIT_S)
            if all(process_id in parts.inbox.stacks for process_id in asked):
                break
        before_ns = dict(self._reached_ns)
        for process_id, dump in parts.inbox.stacks.items():
            if dump.time_ns is not None and process_id in before_ns:
                self._reached_ns[process_id] = max(dump.time_ns, before_ns[process_id])
        return self._reached_ns != before_ns

    def _stall(self, process_ids: Sequence[str], timeout_s: float) -> None:
        """Give up, and write down where the processes are that do not yield."""
        parts = self._parts
        for process_id in process_ids:
            dump = parts.inbox.stacks.get(process_id)
            refused = parts.inbox.refused.get(process_id)
            self._emulation.folder.event(
                self.time_ns,
                EventKind.stalled,
                process_id,
                error=f"{self._lacking(process_id)} within {timeout_s:g} s of wall clock; "
                f"{parts.members.describe(process_id)}",
                where=(dump.text if dump else "") or parts.agents.log_tail(process_id),
                **({} if refused is None else {"refused": refused}),
            )
        raise Stalled

    def _lacking(self, process_id: str) -> str:
        """Return what has not come of a process."""
        if process_id not in self._incomplete:
            return "no yield"
        missing = self._sent.missing(refs_of(self._incomplete[process_id]))
        messages = f"{counted(len(missing), 'message')} of {missing[0].node} on the backbone"
        return f"yield {self._incomplete[process_id].seq} without {messages}, to which it refers,"
