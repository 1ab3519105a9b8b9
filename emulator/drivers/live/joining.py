"""The start of a live run: agents are started or awaited, and welcomed, until every node is ready."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence

from emulator.drivers.attachment import Attachment, LiveOptions
from emulator.drivers.emulation import Emulation
from emulator.drivers.join import Membership, split_into_processes
from emulator.drivers.launch import AgentProcesses, Launcher
from emulator.drivers.live.inbox import Refusals
from emulator.drivers.live.supervisor import Supervisor
from emulator.drivers.live.waiting import ChangeSignal
from emulator.viewer.sinks import Sinks
from vnet.counted import counted
from vnet.errors import ProgramError, TransportError, VnetError, first_names
from vnet.runtime.die_with_parent import STARTED_BY_VNET
from vnet.transport import wire
from vnet.transport.access import OBSERVER, host_user

RECORDER = "recorder"
RECORDER_POLL_S = 0.05
"""Seconds between two looks whether the recorder listens: nothing tells of it."""
LAUNCHER_POLL_S = 0.005
"""Seconds between two looks whether agents can be started."""
STARTED_AT_ONCE = 20
"""Processes that are started before messages are taken again."""


class Joining:
    """Welcomes nodes, before the start and when they return, and waits for all at the start."""

    def __init__(
        self,
        *,
        emulation: Emulation,
        members: Membership,
        supervisor: Supervisor,
        launcher: Launcher,
        agents: AgentProcesses,
        attachment: Attachment,
        options: LiveOptions,
        refusals: Refusals,
        changes: ChangeSignal,
    ) -> None:
        self._emulation = emulation
        self._members = members
        self._supervisor = supervisor
        self._launcher = launcher
        self._agents = agents
        self._attachment = attachment
        self._options = options
        self._refusals = refusals
        self._changes = changes
        self._failure: VnetError | None = None

    def take_hello(self, node: str, hello: wire.Hello) -> None:
        """Welcome a node, or tell it why it is refused."""
        refusal = None
        if hello.version != wire.VERSION:
            refusal = wire.other_version("agent", hello.version, "emulator")
        refusal = refusal or self._members.hello(node, hello)
        if refusal is not None:
            self._refusals.add(node, refusal)
            if self._attachment.knows(node):
                self._attachment.send(node, wire.End(hello.nonce, refusal, refused=True))
            return
        if hello.failure is not None:
            self._failure = ProgramError(f"{node}: {hello.failure}")
        elif not hello.ready:
            self._attachment.send(node, self._emulation.welcome(node, hello.nonce))
        self._changes.set()

    async def join(
        self, on_state: Callable[[str], None], on_missing: Callable[[Sequence[str]], None]
    ) -> list[list[str]]:
        """Start what is to be started and wait until every node is ready; returns the nodes of each process.

        Raises VnetError if a process ends or a program cannot be loaded, TransportError if nodes are missing in the
        end.
        """
        timeout_s = self._emulation.scenario.run.join_timeout_s
        deadline = time.monotonic() + timeout_s
        await self._start_processes(on_state, deadline)
        missing: list[str] = []
        while self._members.missing or not self._recorder_listens():
            if missing != self._members.missing:
                missing = self._members.missing
                on_missing(missing)
            if failure := self._failure or self._supervisor.failure:
                raise failure
            if time.monotonic() > deadline:
                raise TransportError(self._describe_missing(timeout_s))
            await self._changes.wait(RECORDER_POLL_S if self._options.record else deadline - time.monotonic())
        self._members.closed = True
        on_missing([])
        return self._members.processes()

    async def _start_processes(self, on_state: Callable[[str], None], deadline: float) -> None:
        node_ids = self._emulation.world.node_ids
        endpoint = self._attachment.endpoint
        groups = split_into_processes(node_ids, self._emulation.scenario.run.nodes_per_process)
        groups = [nodes for nodes in groups if nodes[0] not in self._members.later]
        if self._options.record is not None:
            self._start_recorder(endpoint, self._options.record.inside(self._emulation.folder.path))
        hosts = list(self._options.access.hosts)
        if hosts:
            self._start_hosts(endpoint)
            on_state(f"listening at {endpoint}; waiting for {counted(len(hosts), 'host')}: {first_names(hosts)}")
        if self._options.launch:
            await self._agents_prepared(deadline)
            where = f" on {counted(len(hosts), 'host')}" if hosts else ""
            on_state(f"listening at {endpoint}; starting {len(groups)} agent processes{where}")
            for first in range(0, len(groups), STARTED_AT_ONCE):
                self._supervisor.launch(groups[first : first + STARTED_AT_ONCE])
                await asyncio.sleep(0)  # those that have joined meanwhile are welcomed
        else:
            on_state(f"listening at {endpoint}; waiting for {len(node_ids) - len(self._members.later)} vehicles")

    async def _agents_prepared(self, deadline: float) -> None:
        """Wait until agents can be started. Raises VnetError if they cannot, TransportError after the deadline."""
        while not self._agents.is_prepared():
            if failure := self._supervisor.failure:
                raise failure
            if time.monotonic() > deadline:
                timeout_s = self._emulation.scenario.run.join_timeout_s
                raise TransportError(f"not ready within {timeout_s:g} s: {first_names(self._agents.missing)}")
            await asyncio.sleep(LAUNCHER_POLL_S)

    def _start_hosts(self, endpoint: str) -> None:
        """Start the hosts that are processes of this machine."""
        access = self._options.access
        for host in access.hosts if self._options.start_hosts else ():
            arguments = ["-P", "-m", "emulator.cli", "host", "--connect", endpoint, "--run", access.run]
            for folder in self._emulation.scenario.program.folders:
                arguments += ["--path", str(folder)]
            self._launcher.start(
                host_user(host), arguments, access.credentials(host_user(host)), {STARTED_BY_VNET: "1"}
            )

    def _start_recorder(self, endpoint: str, sinks: Sinks) -> None:
        arguments = ["-P", "-m", "emulator.cli", "record", "--connect", endpoint, "--run", self._options.access.run]
        arguments += ["--out", str(sinks.save), *sinks.arguments]
        credentials = self._options.access.credentials(OBSERVER)
        self._launcher.start(RECORDER, arguments, credentials, {}, own_session=True)

    def _recorder_listens(self) -> bool:
        return self._options.record is None or self._attachment.is_watched("period")

    def _describe_missing(self, timeout_s: float) -> str:
        missing = self._members.missing or ["the recorder"]
        total = len(self._emulation.world.node_ids)
        return f"{len(missing)} of {total} nodes have not joined within {timeout_s:g} s: {first_names(missing)}"
