"""The base of the drivers of both pacings: faults are applied to processes in one order."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from emulator.drivers.attachment import Attachment
from emulator.drivers.emulation import Emulation, ProcessActions
from emulator.drivers.join import Membership
from emulator.drivers.launch import AgentProcesses
from emulator.drivers.live.inbox import Inbox
from emulator.drivers.live.reconnection import Reconnection
from emulator.drivers.live.supervisor import Supervisor
from emulator.drivers.live.waiting import ChangeSignal
from emulator.drivers.processes import check_ownership
from vnet.transport import wire
from vnet.transport.backbone_keys import Contents
from vnet.transport.wire import MessageRef, SentMessage


@dataclass(frozen=True)
class Parts:
    """The parts of a live run that its driver uses."""

    emulation: Emulation
    members: Membership
    supervisor: Supervisor
    agents: AgentProcesses
    attachment: Attachment
    inbox: Inbox
    reconnection: Reconnection
    changes: ChangeSignal
    debugged: str | None = None
    """The node whose program may wait for its user in a debugger."""


class Driver(ABC):
    """Moves the messages of one pacing between the emulation and the processes, from time 0 to the end."""

    message_type: ClassVar[type]
    """The messages of agents that `take` takes while the pacing is on."""

    def __init__(self, parts: Parts, processes: Sequence[Sequence[str]]) -> None:
        self._parts = parts
        self._emulation = parts.emulation
        self._supervisor = parts.supervisor
        self._changes = parts.changes
        self._send = parts.attachment.send
        parts.supervisor.begin(processes)
        parts.inbox.handlers[self.message_type] = self.take
        parts.inbox.handlers[wire.Final] = self.take_final
        self._so_far: dict[str, wire.Traffic] = {}
        """Exceptions left unhandled so far in processes that are to end, until their last message comes."""
        self._sent: Contents[SentMessage] = Contents()
        """Messages that units have put on the backbone, and to which nothing has referred yet."""
        parts.inbox.on_sent = self.take_sent

    @property
    @abstractmethod
    def time_ns(self) -> int:
        """Emulated time, for events."""

    @property
    def decided_ns(self) -> int:
        """Emulated time up to which nothing can be changed any more: new faults act after it."""
        return self.time_ns

    @abstractmethod
    def take(self, process_id: str, message: Any) -> None:
        """Take a message of a process. Raises ProtocolError to refuse it."""

    def take_final(self, process_id: str, message: wire.Final) -> None:
        """Take what is unhandled in a process before its programs are ended. Raises ProtocolError to refuse it."""
        check_ownership(self._parts.members.nodes_with(process_id), message.traffic)
        if message.provisional:
            self._so_far[process_id] = message.traffic
            self._send(process_id, wire.End(message.nonce, "taken"))

    def _tell_so_far(self, time_ns: int) -> None:
        """Tell what is unhandled in processes that have gone without their last message."""
        self._emulation.take_final(time_ns, self._so_far.values())

    @abstractmethod
    def take_sent(self, message: SentMessage) -> None:
        """Take what a unit has put on its key of the backbone; its process's messages say when it was sent."""

    def _check_refs(self, process_id: str, refs: Sequence[MessageRef]) -> None:
        """Raise ProtocolError if a process refers to what others have sent."""
        if refs:
            check_ownership(self._parts.members.nodes_with(process_id), wire.Traffic(messages=refs))

    def _forget_sent(self, process_ids: Sequence[str]) -> None:
        """Forget what earlier processes of these names have put on the backbone."""
        for process_id in process_ids:
            self._sent.drop(self._parts.members.nodes_with(process_id))

    @abstractmethod
    async def run(self) -> None:
        """Run from time 0 to the end. Raises Stalled if a process does not answer."""

    @abstractmethod
    async def finish(self, deadline_s: float) -> None:
        """Wait for the last messages of the processes, at most until `deadline_s` on the monotonic clock."""

    async def _apply_process_faults(self, actions: ProcessActions) -> None:
        """Do to the processes what the faults and the trips of an instant do."""
        process_of = self._parts.members.process_of
        for process_id, killed in {process_of(node): killed for node, killed in actions.stop.items()}.items():
            await self._supervisor.end(process_id, killed, self._reason(process_id, killed))
            if not killed:
                await self._await_final(process_id, actions.time_ns)
        begun = list(dict.fromkeys(map(process_of, actions.start)))
        self._forget_sent(begun)
        self._supervisor.begin_again(begun)
        await self._await_returned(begun)
        self._supervisor.pause({process_of(node) for node in actions.paused})
        for fault in actions.restarts:
            await self._parts.reconnection.restart(fault)

    def _reason(self, process_id: str, killed: bool) -> str:
        if killed:
            return "killed by a fault"
        return "it has left" if self._emulation.presence.is_outside(process_id) else "restarted by a fault"

    @abstractmethod
    async def _await_final(self, process_id: str, time_ns: int) -> None:
        """Wait for the last message of a process that a fault ended at `time_ns`, if time can wait."""

    @abstractmethod
    async def _await_returned(self, process_ids: Sequence[str]) -> None:
        """Wait for processes that have been started, where the pacing cannot go on without them."""
