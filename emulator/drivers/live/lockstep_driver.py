"""The driver of a live run in lockstep: grants go out, and time goes on when every process has yielded."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable, Sequence

from emulator.drivers.live.driver import Driver, Parts
from emulator.drivers.live.waiting import Stalled
from emulator.drivers.lockstep import Lockstep
from vnet.transport import wire

STACKS_WAIT_S = 1.0
"""Seconds for which the stacks of processes that do not yield are awaited."""

HorizonCallback = Callable[[Lockstep], Awaitable[None]]
"""Sets the barrier's horizon: called before time 0, and whenever the run is held there."""


async def no_horizon(lockstep: Lockstep) -> None:
    """Leave the run without a horizon: nothing holds it."""


class LockstepDriver(Driver):
    """Gives the barrier's grants to the processes and takes their yields."""

    message_type = wire.Yield

    def __init__(
        self, parts: Parts, processes: Sequence[Sequence[str]], before_horizon: HorizonCallback = no_horizon
    ) -> None:
        super().__init__(parts, processes)
        self._lockstep = Lockstep(parts.emulation, processes)
        self._before_horizon = before_horizon

    @property
    def time_ns(self) -> int:
        """Emulated time: the instant of the last grants."""
        return self._lockstep.now_ns

    def take(self, process_id: str, message: wire.Yield) -> None:
        """Take a yield."""
        self._lockstep.receive(process_id, message)
        if not self._lockstep.owed:
            self._changes.set()

    async def run(self) -> None:
        """Grant and await yields, instant by instant."""
        lockstep = self._lockstep
        await self._before_horizon(lockstep)
        grants = lockstep.start()
        while grants:
            for actions in lockstep.take_actions():
                await self._apply_process_faults(actions)
            for process_id, grant in grants.items():
                self._send(process_id, grant)
            await self._all_yielded()
            grants = lockstep.step()
            while lockstep.held:
                await self._before_horizon(lockstep)
                grants = lockstep.step()
        for process_id, details in self._supervisor.take_deaths().items():
            lockstep.died(process_id, **details)

    async def finish(self, deadline_s: float) -> None:
        """Nothing is left: the last yields were taken before the end."""

    async def _all_yielded(self) -> None:
        timeout_s = self._emulation.scenario.run.stall_timeout_s
        owed = self._lockstep.owed
        while owed:
            for process_id, details in self._supervisor.take_deaths(owed.keys()).items():
                self._lockstep.died(process_id, **details)
            if owed and not await self._changes.wait(timeout_s):
                await self._stall(sorted(owed), timeout_s)

    async def _await_returned(self, process_ids: Sequence[str]) -> None:
        """Wait until processes that have been started are ready: they may be granted the instant that comes."""
        timeout_s = self._emulation.scenario.run.join_timeout_s
        deadline = time.monotonic() + timeout_s
        while late := self._supervisor.returning_nodes(process_ids):
            if not await self._changes.wait(deadline - time.monotonic()):
                error = f"has not come back within {timeout_s:g} s"
                self._emulation.folder.event(self.time_ns, "stalled", late[0], error=error)
                raise Stalled
        self._supervisor.take_returned()

    async def _stall(self, process_ids: Sequence[str], timeout_s: float) -> None:
        """Give up: ask the processes that do not yield for their stacks, and write them down."""
        parts = self._parts
        for process_id in process_ids:
            self._send(process_id, wire.StackRequest())
            parts.launcher.request_stack(process_id)
        await asyncio.sleep(STACKS_WAIT_S)
        for process_id in process_ids:
            self._emulation.folder.event(
                self.time_ns,
                "stalled",
                process_id,
                error=f"no yield within {timeout_s:g} s of wall clock; {parts.members.describe(process_id)}",
                where=parts.inbox.stacks.get(process_id) or parts.launcher.log_tail(process_id),
            )
        raise Stalled
