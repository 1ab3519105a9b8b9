"""The emulator's attachment to Zenoh: its session, its keys, and the nodes that are connected.

All of it can be closed and opened again in the middle of a run (the fault `emulator_restart`): the state of a run
is kept elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import zenoh

from emulator.drivers.agent_keys import AgentKeys, Hear, hear_payloads, hear_tokens
from emulator.drivers.router import SeparateRouter
from emulator.viewer.sinks import Sinks
from vnet.errors import TransportError
from vnet.runtime.debug_target import DebugTarget
from vnet.transport import keys, wire
from vnet.transport.access import EMULATOR, LEASE_MS, Access
from vnet.transport.session import open_client, open_router, router_endpoint


@dataclass(frozen=True)
class LiveOptions:
    """Options of a live run's attachment.

    `listen` (embedded router), or `connect` (client of one that is there), or `router` (one started with the run).
    `launch` starts the agents, which are on hosts if `access` names some; `start_hosts` starts those here as well.
    `record` is where a recorder process writes its recording (a file in the run's folder, unless its path is
    absolute), or None. `debug` has a debugger stop in a program. `agent` are the words of the command that an agent
    is, with `{endpoint}`, `{run}`, `{node}` and `{credentials}`; without any, agents are those of vnet.
    """

    access: Access
    listen: str = "tcp/127.0.0.1:0"
    connect: str | None = None
    launch: bool = True
    record: Sinks | None = None
    router: SeparateRouter | None = None
    start_hosts: bool = False
    debug: DebugTarget | None = None
    agent: Sequence[str] = ()


class Attachment:
    """The emulator's end of the wire. What comes is heard on Zenoh's threads: what it is, a name, and the item."""

    def __init__(
        self,
        options: LiveOptions,
        node_ids: tuple[str, ...],
        drops: bool,
        hear: Hear,
        has_agents: bool = True,
    ) -> None:
        self._has_agents = has_agents
        self._connect = options.connect if options.router is None else options.router.endpoint
        self.endpoint = self._connect or options.listen
        self._options = options
        self._run = options.access.run
        self._node_ids = node_ids
        self._drops = drops
        self._hear = hear
        self._stack = ExitStack()
        self._host_rx: dict[str, zenoh.Publisher] = {}
        self._observers: dict[str, zenoh.Publisher] = {}

    def open(self, again: bool = False) -> None:
        """Listen or connect, and declare what is said and heard. Raises TransportError.

        At a router of others no other emulator may have this run, unless this one opens `again`.
        """
        stack, options = self._stack, self._options
        if self._connect is None:
            session = stack.enter_context(open_router(self.endpoint, options.access, not self._drops))
            self.endpoint = router_endpoint(session)
        else:
            login = options.access.credentials(EMULATOR)
            session = stack.enter_context(open_client(self._connect, login, LEASE_MS))
            alive = keys.emulator_alive(self._run)
            if not again and any(reply.ok for reply in session.liveliness().get(alive)):
                raise TransportError(f"{self._connect}: run {self._run} has an emulator there already")
        run, hosts = self._run, options.access.hosts
        control = zenoh.CongestionControl
        full = control.DROP if self._drops else control.BLOCK  # one host that is cut off must not stall the others
        self._host_rx = {
            host: stack.enter_context(
                session.declare_publisher(keys.host_rx(run, host), congestion_control=full, express=True)
            )
            for host in hosts
        }
        if hosts:  # one that cannot be reached is closed after a while
            hear_payloads(session, keys.host_tx(run, "*"), "host_message", self._hear, stack)
            hear_tokens(session, keys.host_alive(run, "*"), "host_token", self._hear, stack)
        self._observers = {
            stream: stack.enter_context(
                session.declare_publisher(
                    keys.observe(self._run, stream), congestion_control=zenoh.CongestionControl.DROP
                )
            )
            for stream in ("scene", "period", "end")
        }
        nodes, units = (self._node_ids, options.access.units)
        if hosts or not self._has_agents:  # the keys of those on hosts are their hosts' own
            nodes, units = (), ()
        self._agents = AgentKeys(session, run, nodes, units, self._drops, self._hear, stack)
        stack.enter_context(session.declare_queryable(keys.control(run, "*"), self._take_query))
        stack.enter_context(session.liveliness().declare_token(keys.emulator_alive(run)))

    def close(self) -> None:
        """Close everything."""
        self._stack.close()

    def _take_query(self, query: zenoh.Query) -> None:
        self._hear("query", keys.verb_of(str(query.key_expr)), query)

    def knows(self, node: str) -> bool:
        """Return whether there is a key for this node."""
        return node in self._node_ids

    def send(self, node: str, message: wire.EmulatorMessage) -> None:
        """Say something to a node."""
        self._agents.put(node, wire.encode(message))

    def send_content(self, unit: str, payload: bytes) -> None:
        """Put an encoded message on a unit's key of the backbone."""
        self._agents.put_unit(unit, payload)

    def send_host(self, host: str, payload: bytes) -> None:
        """Put an encoded message on the `rx` of a host."""
        self._host_rx[host].put(payload)

    def is_watched(self, stream: str) -> bool:
        """Return whether somebody observes this stream."""
        return bool(self._observers[stream].matching_status.matching)  # type: ignore[attr-defined]

    def publish(self, stream: str, message: dict[str, Any]) -> None:
        """Publish a message to observers."""
        self._observers[stream].put(wire.encode_observation(message))
