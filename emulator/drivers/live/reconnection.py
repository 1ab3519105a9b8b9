"""Restarts of the emulator's connection, or of its separate router, in the middle of a live run."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence

from emulator.drivers.attachment import Attachment, LiveOptions
from emulator.drivers.emulation import Emulation
from emulator.drivers.join import Membership
from emulator.drivers.launch import Launcher
from emulator.drivers.live.inbox import Inbox
from emulator.drivers.live.supervisor import ProcessState, Supervisor
from emulator.drivers.live.waiting import Stalled
from emulator.drivers.router import ROUTER
from emulator.records.events import KINDS, EventKind
from emulator.scenario.faults import EmulatorRestart, Infrastructure
from vnet.transport import wire

AWAIT_WARNING_S = 0.2
"""Seconds between the announcement to the agents and the end of the connection."""
ANSWER_POLL_S = 0.1
"""Seconds between two requests to those who have not answered over the new connection."""


class Reconnection:
    """Takes the connection down and up again."""

    def __init__(
        self,
        *,
        emulation: Emulation,
        members: Membership,
        supervisor: Supervisor,
        launcher: Launcher,
        attachment: Attachment,
        options: LiveOptions,
        inbox: Inbox,
        time_ns: Callable[[], int],
    ) -> None:
        self._emulation = emulation
        self._members = members
        self._supervisor = supervisor
        self._launcher = launcher
        self._attachment = attachment
        self._options = options
        self._inbox = inbox
        self._time_ns = time_ns

    async def restart(self, fault: Infrastructure) -> None:
        """Announce the restart to the agents, restart, and wait until all have answered. Raises Stalled."""
        patience_s = fault.down_s + self._emulation.scenario.run.join_timeout_s
        for node in self._connected_nodes():
            self._attachment.send(node, wire.Await(patience_s))
        # In real time a paused process cannot answer: it has time until it goes on.
        answering = [ProcessState.RUNNING]
        if self._emulation.scenario.run.pacing == "lockstep":
            answering.append(ProcessState.PAUSED)
        process_ids = sorted({self._members.process_of(node) for node in self._connected_nodes()})
        process_ids = [process_id for process_id in process_ids if self._supervisor.state(process_id) in answering]
        await asyncio.sleep(AWAIT_WARNING_S)
        self._supervisor.reconnecting = True
        await self._restart(fault)
        await self._all_answer(process_ids, patience_s)
        self._supervisor.reconnecting = False
        self._emulation.folder.event(self._time_ns(), KINDS[f"{fault.kind}ed"], None, down_s=fault.down_s)

    def _connected_nodes(self) -> list[str]:
        """The nodes that are up and whose processes are there.

        The emulation may be ahead: a node that is up there again need not have been started yet.
        """
        gone = self._supervisor.processes_in(ProcessState.AWAY, ProcessState.RETURNING)
        up = [node for node in self._emulation.world.node_ids if self._emulation.up[node]]
        return [node for node in up if self._members.process_of(node) not in gone]

    async def _restart(self, fault: Infrastructure) -> None:
        if isinstance(fault, EmulatorRestart):
            await asyncio.to_thread(self._attachment.close)
            await asyncio.sleep(fault.down_s)
            await asyncio.to_thread(self._attachment.open)
        else:
            self._launcher.kill(ROUTER)
            await asyncio.sleep(fault.down_s)
            assert self._options.router is not None
            await asyncio.to_thread(self._options.router.start, self._launcher)

    async def _all_answer(self, process_ids: Sequence[str], patience_s: float) -> None:
        """Wait until each process has answered: only then do messages pass in both directions again."""
        self._inbox.stacks.clear()
        deadline = time.monotonic() + patience_s
        while silent := [id_ for id_ in process_ids if id_ not in self._inbox.stacks and not self._is_dead(id_)]:
            if time.monotonic() > deadline:
                error = f"has not found the emulator again within {patience_s:g} s"
                self._emulation.folder.event(self._time_ns(), EventKind.stalled, silent[0], error=error)
                raise Stalled
            for process_id in silent:
                self._attachment.send(process_id, wire.StackRequest())
            await asyncio.sleep(ANSWER_POLL_S)
        self._inbox.stacks.clear()

    def _is_dead(self, process_id: str) -> bool:
        return self._supervisor.state(process_id) is ProcessState.DEAD
