"""The hosts of a run as the emulator sees them, in the place of a launcher of agents.

What is said to a host in one turn of the event loop goes as one bundle, so that in lockstep the grants of a barrier
are one message for each host. Only messages with the nonce of the process whose hello came first on a host's key
count.
"""

from __future__ import annotations

import asyncio
import signal
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from emulator.drivers.emulation import Emulation
from emulator.drivers.hosts import messages
from emulator.drivers.hosts.messages import Call, HostHello, HostWelcome
from emulator.drivers.hosts.retrieval import Retrieval
from emulator.drivers.launch import Exit
from emulator.drivers.live.supervisor import DEATH_GRACE_S, ChangeSignal
from emulator.drivers.processes import ProtocolError
from emulator.records.code_digest import entries_of, vnet_digest
from emulator.records.events import EventKind
from vnet.errors import VnetError, WireError, printable
from vnet.transport import keys, wire
from vnet.transport.access import Access

DETACH_PATIENCE_S = 1.0
"""Seconds that a process which was told to end has for it, before its host kills it."""
ANSWER_PATIENCE_S = 5.0
"""Seconds at the end of a run after which a host that has not answered is taken for cut off."""
HAND_IN_PATIENCE_S = 20.0
"""Seconds of silence at the end of a run, beyond what its processes have, that are granted to hosts that answer."""


@dataclass
class _Host:
    name: str
    processes: list[list[str]]
    retrieval: Retrieval
    nonce: bytes | None = None
    where: str = ""
    is_ready: bool = False
    is_gone: bool = False
    is_handing_in: bool = False
    has_handed_in: bool = False
    orders: list[Call] = field(default_factory=list)

    @property
    def nodes(self) -> list[str]:
        return [node for nodes in self.processes for node in nodes]


class Fleet:
    """See the module's text. What comes of agents is told: what it is, a name, and the item.

    `is_reconnecting` is true while the emulator itself is disconnected, and lost connections mean nothing.
    """

    def __init__(
        self,
        access: Access,
        emulation: Emulation,
        send: Callable[[str, bytes], None],
        tell: Callable[[str, str, Any], None],
        time_ns: Callable[[], int],
        is_reconnecting: Callable[[], bool],
        changes: ChangeSignal,
    ) -> None:
        self._access = access
        self._folder = emulation.folder
        self._scenario = scenario = emulation.scenario
        self._digest = vnet_digest()
        self._duration_ns = emulation.duration_ns
        self._send = send
        self._tell = tell
        self._time_ns = time_ns
        self._is_reconnecting = is_reconnecting
        self._changes = changes
        self._loop = asyncio.get_running_loop()
        self._hosts = {}
        for name in access.hosts:
            processes = access.processes_on(name)
            self._hosts[name] = _Host(
                name, processes, Retrieval(self._folder, processes, scenario.run.files_max_mb)
            )
        self._host_of = {node: host for host in self._hosts.values() for node in host.nodes}
        self._serials: dict[str, int] = {}
        self._last_serial = 0
        self._log_tails: dict[str, str] = {}
        self._has_work: dict[str, _Host] = {}
        self._failure: VnetError | None = None
        self._refused: Counter[str] = Counter()
        self.cpu_ns: Counter[str] = Counter()
        """CPU time of the agents' processes in ns, once it has been handed in."""

    # In the place of a launcher.

    @property
    def pids(self) -> dict[str, int]:
        """The processes that should be there; serial numbers stand for the ids of processes elsewhere."""
        return dict(self._serials)

    def is_prepared(self) -> bool:
        """Return whether agents can be started on all hosts. Raises VnetError if they never can."""
        if self._failure is not None:
            raise self._failure
        return all(host.is_ready for host in self._hosts.values())

    @property
    def missing(self) -> list[str]:
        """The hosts that are not ready yet, as messages name them."""
        return [f"host {host.name}" for host in self._hosts.values() if not host.is_ready]

    def start_agents(self, endpoint: str, access: Access, groups: Sequence[Sequence[str]], nice: int = 0) -> None:
        """Have the processes of these groups of nodes started where they belong."""
        starts: dict[str, list[str]] = {}
        for process_id in (nodes[0] for nodes in groups):
            self._last_serial += 1
            self._serials[process_id] = self._last_serial
            starts.setdefault(self._host_of[process_id].name, []).append(process_id)
        for name, process_ids in starts.items():
            if self._hosts[name].is_gone:
                self._loop.call_soon(self._lose, self._hosts[name], process_ids)
                continue
            serials = [self._serials[process_id] for process_id in process_ids]
            self._order(self._hosts[name], "start", process_ids, serials, nice)

    def signal(self, name: str, number: signal.Signals) -> None:
        """Send a signal to a process, if it is there."""
        if name in self._serials:
            self._order(self._host_of[name], "signal", name, int(number))

    def kill(self, name: str) -> None:
        """End a process at once; its end is not told."""
        if self._serials.pop(name, None) is not None:
            self._order(self._host_of[name], "kill", name)

    def detach(self, name: str) -> Callable[[float], None]:
        """Forget a process that has been told to go; its host kills it if it does not."""
        if self._serials.pop(name, None) is not None:
            self._order(self._host_of[name], "detach", name, DETACH_PATIENCE_S)
        return lambda patience_s: None

    def request_stack(self, name: str) -> None:
        """Have a process write its stacks to its log, and its host send the end of that."""
        self.signal(name, signal.SIGUSR1)

    def log_tail(self, name: str) -> str:
        """The last lines of a process's log, as far as they have come."""
        return self._log_tails.get(name, "")

    def takes_end(self, name: str, how: Exit) -> bool:
        """Agents on hosts are their hosts' children."""
        return False

    def look(self, time_ns: int) -> None:
        """Have CPU time and memory of the processes measured."""
        for host in self._hosts.values():
            self._order(host, "look", time_ns, self._scenario.run.memory_limit_mb)

    # To the hosts.

    def send(self, node: str, message: wire.EmulatorMessage) -> None:
        """Say something to a node."""
        host = self._host_of[node]
        if isinstance(message, wire.Await):
            self._order(host, "be_patient", message.within_s)
        self._order(host, "to_node", node, wire.encode(message), isinstance(message, wire.Grant))

    def send_content(self, unit: str, payload: bytes) -> None:
        """Put an encoded message on a unit's key of the backbone."""
        self._order(self._host_of[unit], "to_unit", unit, payload)

    def _order(self, host: _Host, *call: Any) -> None:
        if host.nonce is None or host.is_gone:
            return
        if not self._has_work:
            self._loop.call_soon(self.flush)
        host.orders.append(call)
        self._has_work[host.name] = host

    def flush(self) -> None:
        """Put the bundles of orders."""
        for host in self._has_work.values():
            assert host.nonce is not None
            orders, host.orders = host.orders, []
            self._send(host.name, messages.encode(messages.Calls(host.nonce, orders)))
        self._has_work = {}

    # From the hosts.

    def take(self, name: str, payload: bytes) -> None:
        """Take a message that came on the `tx` of a host."""
        host = self._hosts.get(name)
        try:
            if host is None:
                raise ProtocolError(f"{name[:64]!r} is not a host of this run")
            message = messages.decode_from_host(payload)
            if isinstance(message, HostHello):
                self._take_hello(host, message)
            elif message.nonce != host.nonce or host.is_gone:
                raise ProtocolError("a message without the nonce of its host")
            else:
                self._take_calls(host, message.calls)
        except (WireError, ProtocolError) as error:
            self._refuse(name, str(error))

    def _take_calls(self, host: _Host, calls: Sequence[Call]) -> None:
        for call in calls:
            try:
                self._take_call(host, call)
            except ProtocolError as error:
                self._refuse(host.name, str(error))

    def _refuse(self, name: str, reason: str) -> None:
        key = keys.host_tx(self._access.run, name)
        if key not in self._refused:
            self._folder.event(self._time_ns(), EventKind.refused, None, key=key, reason=reason)
        self._refused[key] += 1

    def _take_hello(self, host: _Host, hello: HostHello) -> None:
        if hello.host != host.name:
            raise ProtocolError(f"a hello of {hello.host[:64]!r}")
        if (reason := self._refusal(host, hello)) is not None:
            self._send(host.name, messages.encode(messages.HostRefusal(hello.nonce, reason)))
            self._refuse(host.name, reason)
            return
        host.nonce, host.where = hello.nonce, f"process {hello.pid} on {hello.machine}"
        if hello.failure is not None:
            self._failure = VnetError(f"host {host.name}: {hello.failure}")
        elif hello.ready:
            host.is_ready = True
        else:
            self._send(host.name, messages.encode(self._welcome(host, hello.nonce)))
        self._changes.set()

    def _welcome(self, host: _Host, nonce: bytes) -> HostWelcome:
        run = self._scenario.run
        return HostWelcome(
            nonce=nonce,
            processes=host.processes,
            start=run.start,
            modules=[entry.partition(":")[0] for entry in entries_of(self._scenario)],
            realtime=run.pacing == "realtime",
            orphan_timeout_s=run.orphan_timeout_s,
            duration_ns=self._duration_ns,
            files_max_mb=run.files_max_mb,
            units=[node for node in host.nodes if node in self._access.units],
        )

    def _refusal(self, host: _Host, hello: HostHello) -> str | None:
        """Return why a host is refused, or None."""
        if host.is_gone:
            return f"host {host.name} was here and has gone; the run goes on without it"
        if host.nonce not in (None, hello.nonce):
            return f"host {host.name} is already present ({host.where})"
        if hello.digest != self._digest:
            digests = f"{printable(hello.digest, 12)}, {self._digest[:12]}"
            return f"its vnet is not that of the emulator ({digests}): install the same"
        return None

    def _take_call(self, host: _Host, call: Call) -> None:
        match call:
            case ("message" | "backbone" | "token") as what, node, item:
                self._check_node(host, node)
                self._tell(what, node, item)
            case "ended", process_id, serial, status, log_tail, overdue_s:
                self._check_node(host, process_id)
                if self._serials.get(process_id) == serial:
                    del self._serials[process_id]
                    self._tell("ended", process_id, Exit(status, log_tail, overdue_s))
            case "log_tail", process_id, text:
                self._check_node(host, process_id)
                self._log_tails[process_id] = text
            case "part", kind, owner, path, data:
                host.retrieval.take(kind, owner, path, data)
                self._changes.set()
            case "left_out", kind, owner, count, which:
                host.retrieval.tell_left_out(self._time_ns(), kind, owner, count, which)
            case "figures", cpu_ns, memory:
                self._take_figures(host, cpu_ns, memory)
            case "memory", process_id, memory_mb:
                self._check_node(host, process_id)
                self._tell("memory", process_id, memory_mb)
            case ("handing_in",):
                host.is_handing_in = True
                self._changes.set()
            case ("handed_in",):
                host.has_handed_in = True
                self._changes.set()

    def _check_node(self, host: _Host, node: str) -> None:
        if self._host_of.get(node) is not host:
            raise ProtocolError(f"{node[:64]!r} is not on host {host.name}")

    def _take_figures(self, host: _Host, cpu_ns: Mapping[str, int], memory: Sequence[tuple[str, Any, Any]]) -> None:
        for process_id, figure in cpu_ns.items():
            self._check_node(host, process_id)
            self.cpu_ns[process_id] = figure
        for process_id, time_s, size_kb in memory:
            self._check_node(host, process_id)
            self._folder.event(
                self._time_ns(), EventKind.memory, process_id, time_s=list(time_s), private_kb=list(size_kb)
            )

    def take_token(self, name: str, alive: bool) -> None:
        """Take note that the connection of a host has appeared or is gone."""
        host = self._hosts.get(name)
        if host is None or alive or host.nonce is None or self._is_reconnecting() or host.has_handed_in:
            return
        self._loop.call_later(DEATH_GRACE_S, self._gone, host)

    def _gone(self, host: _Host) -> None:
        if host.is_gone or host.has_handed_in:
            return
        host.is_gone = True
        self._failure = VnetError(f"host {host.name} ({host.where}): its connection closed before the start")
        self._folder.event(self._time_ns(), EventKind.host_gone, None, host=host.name, where=host.where)
        self._lose(host, [nodes[0] for nodes in host.processes if nodes[0] in self._serials])

    def _lose(self, host: _Host, process_ids: Sequence[str]) -> None:
        """Tell that processes have ended with their host."""
        for process_id in process_ids:
            self._serials.pop(process_id, None)
        for node in host.nodes:
            self._tell("token", node, False)
        self._tell("lost", f"the connection of host {host.name} closed", process_ids)
        self._changes.set()

    # The end.

    async def hand_in(self, patience_s: float) -> None:
        """Have all agents ended after `patience_s`, and take what they leave.

        A host is not waited for any longer that does not answer for `ANSWER_PATIENCE_S`; nor is one that does, once
        there has been nothing from any host for `HAND_IN_PATIENCE_S`.
        """
        left = [host for host in self._hosts.values() if host.is_ready and not host.is_gone]
        for host in left:
            self._order(host, "hand_in", patience_s)
        silent_at = dict.fromkeys([host.name for host in left], time.monotonic() + ANSWER_PATIENCE_S)
        while left := [host for host in left if not (host.has_handed_in or host.is_gone)]:
            if not await self._changes.wait(max(silent_at[host.name] for host in left) - time.monotonic()):
                break
            at_least = time.monotonic() + patience_s + HAND_IN_PATIENCE_S
            silent_at |= {host.name: at_least for host in left if host.is_handing_in}
        for host in left:
            self._folder.event(self._time_ns(), EventKind.host_silent, None, host=host.name, where=host.where)
        for host in self._hosts.values():
            self._order(host, "leave")
        self.flush()
        for key, count in self._refused.items():
            self._folder.event(self._time_ns(), EventKind.refused_total, key=key, count=count)
