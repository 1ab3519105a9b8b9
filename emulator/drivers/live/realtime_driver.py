"""The driver of a live run in real time: what is due goes out in batches, by the monotonic clock."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence

from msgspec.structs import replace

from emulator.drivers.live.driver import Driver, Parts
from emulator.drivers.live.supervisor import ProcessState
from emulator.drivers.realtime import RealTime
from vnet.transport import wire
from vnet.transport.wire import MessageRef, SentMessage

LATE_WAIT_S = 1.0
"""Seconds for which messages of the backbone are awaited at the end: they and frames come by keys of their own."""


class RealTimeDriver(Driver):
    """Sends batches when they are due and takes frames when they come."""

    message_type = wire.Frames

    def __init__(self, parts: Parts, processes: Sequence[Sequence[str]]) -> None:
        super().__init__(parts, processes)
        self._realtime = RealTime(parts.emulation, processes)
        self._origin_ns = time.monotonic_ns()
        self._late: set[MessageRef] = set()
        """Messages of the backbone to which frames have referred and that have not come."""
        parts.supervisor.on_death = self._take_deaths

    @property
    def time_ns(self) -> int:
        """Emulated time: the time since the start, or 0 before it."""
        return max(self._now_ns(), 0)

    def _now_ns(self) -> int:
        return time.monotonic_ns() - self._origin_ns

    def take(self, process_id: str, message: wire.Frames) -> None:
        """Take frames and acknowledgements."""
        if refs := message.traffic.messages:
            self._check_refs(process_id, refs)
            here, missing = self._sent.split(refs)
            if self.time_ns < self._emulation.duration_ns:  # later ones are sent to nobody
                self._late.update(missing)
            message = replace(message, traffic=replace(message.traffic, messages=here))
        self._realtime.receive(self.time_ns, process_id, message)
        if message.final:
            self._so_far.pop(process_id, None)
        self._changes.set()

    def take_sent(self, message: SentMessage) -> None:
        """Take what a unit has put on the backbone; it is sent when frames refer to it, or now if they have."""
        self._sent.add(message)
        ref = MessageRef(message.node, message.number)
        if ref in self._late:
            self._late.discard(ref)
            self._realtime.take_messages(self.time_ns, self._sent.split([ref])[0])
            self._changes.set()

    def _forget_sent(self, process_ids: Sequence[str]) -> None:
        super()._forget_sent(process_ids)
        process_of = self._parts.members.process_of
        self._late = {ref for ref in self._late if process_of(ref.node) not in process_ids}

    def _take_deaths(self) -> None:
        for process_id, details in self._supervisor.take_deaths().items():
            self._realtime.died(self._now_ns(), process_id, **details)

    async def run(self) -> None:
        """Start all processes at one instant and send what is due until the end."""
        self._origin_ns = time.monotonic_ns() + wire.HEAD_START_NS
        duration_ns = self._emulation.duration_ns
        for process_id, batch in self._realtime.start(self._origin_ns).items():
            self._send(process_id, batch)
        await asyncio.sleep(wire.HEAD_START_NS / 1e9)
        while (now_ns := self._now_ns()) < duration_ns:
            batches = self._realtime.due(now_ns)
            for actions in self._realtime.take_actions():
                await self._apply_process_faults(actions)
            for process_id, batch in batches.items():
                self._send(process_id, batch)
            for process_id in self._supervisor.take_returned():
                self._send(process_id, self._realtime.returned(self._now_ns(), process_id))
            next_ns = min(self._realtime.next_time_ns() or duration_ns, duration_ns)
            await self._changes.wait((next_ns - self._now_ns()) / 1e9)

    async def _await_returned(self, process_ids: Sequence[str]) -> None:
        """Wait for nobody: `run` sees which processes have returned."""

    async def _await_final(self, process_id: str, time_ns: int) -> None:
        """Wait for nobody: time goes on."""

    async def finish(self, deadline_s: float) -> None:
        """Wait for the last acknowledgements and late messages, and decide what nobody has acknowledged."""
        while self._is_final_missing() and await self._changes.wait(deadline_s - time.monotonic()):
            pass
        deadline_s = min(deadline_s, time.monotonic() + LATE_WAIT_S)
        while self._late and await self._changes.wait(deadline_s - time.monotonic()):
            pass
        self._realtime.gaps += len(self._late)
        self._tell_so_far(self._emulation.duration_ns)
        self._realtime.finish()
        await self._supervisor.all_ended()

    def _is_final_missing(self) -> bool:
        return not self._realtime.awaited <= set(self._supervisor.processes_in(ProcessState.AWAY))
