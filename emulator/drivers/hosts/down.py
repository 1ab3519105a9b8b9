"""The router of a host's agents: what they say comes out here, and what the emulator says to them goes in.

Agents have the rights that they would have at the emulator's router: a user for each process, with its own keys.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack

import zenoh

from vnet.transport import keys
from vnet.transport.access import Access
from vnet.transport.session import open_router, router_endpoint

LISTEN = "tcp/127.0.0.1:0"
"""Agents are on the same host."""
LEASE_MS = 3_600_000
"""Milliseconds. A paused or starved agent must not look like a dead one; a closed connection is seen at once."""


class Down:
    """The connection of a host to its agents. The callbacks run on Zenoh's threads, with a node's id."""

    def __init__(
        self,
        access: Access,
        realtime: bool,
        on_tx: Callable[[str, bytes], None],
        on_alive: Callable[[str, bool], None],
        on_backbone: Callable[[str, bytes], None],
    ) -> None:
        self.access = access
        self._on_tx = on_tx
        self._on_alive = on_alive
        self._on_backbone = on_backbone
        # As at the emulator's router: in real time one frozen agent must not stall all others.
        self._control = zenoh.CongestionControl.DROP if realtime else zenoh.CongestionControl.BLOCK
        self._rx: dict[str, zenoh.Publisher] = {}
        self._unit_rx: dict[str, zenoh.Publisher] = {}
        self._emulator_token: zenoh.LivelinessToken | None = None

    def open(self, stack: ExitStack) -> None:
        """Listen until `stack` is closed. Raises TransportError."""
        session = self._session = stack.enter_context(open_router(LISTEN, self.access, LEASE_MS))
        self.endpoint = router_endpoint(session)
        run = self.access.run
        for node in (node for nodes in self.access.processes for node in nodes):
            self._rx[node] = stack.enter_context(
                session.declare_publisher(keys.node_rx(run, node), congestion_control=self._control, express=True)
            )
        for unit in self.access.units:
            rx = keys.backbone_rx(run, unit)
            self._unit_rx[unit] = stack.enter_context(
                session.declare_publisher(rx, congestion_control=self._control, express=True)
            )
        if self.access.units:  # before `tx` of nodes, as at the emulator's router
            stack.enter_context(session.declare_subscriber(keys.backbone_tx(run, "*"), self._take_backbone))
        stack.enter_context(session.declare_subscriber(keys.node_tx(run, "*"), self._take_tx))
        alive = keys.node_alive(run, "*")
        stack.enter_context(session.liveliness().declare_subscriber(alive, self._take_alive, history=True))
        self.show_emulator(True)
        stack.callback(self.show_emulator, False)

    def show_emulator(self, there: bool) -> None:
        """Let agents see that the emulator is there, or that it is gone."""
        if there and self._emulator_token is None:
            token_key = keys.emulator_alive(self.access.run)
            self._emulator_token = self._session.liveliness().declare_token(token_key)
        elif not there and self._emulator_token is not None:
            self._emulator_token.undeclare()  # type: ignore[no-untyped-call]
            self._emulator_token = None

    def put(self, node: str, payload: bytes) -> None:
        """Pass a message on to a node; one for a node that is not on this host is dropped."""
        if node in self._rx:
            self._rx[node].put(payload)

    def put_unit(self, unit: str, payload: bytes) -> None:
        """Pass a message of the backbone on to a unit; one for a unit that is not on this host is dropped."""
        if unit in self._unit_rx:
            self._unit_rx[unit].put(payload)

    def _take_backbone(self, sample: zenoh.Sample) -> None:
        self._on_backbone(keys.node_of(str(sample.key_expr)), sample.payload.to_bytes())

    def _take_tx(self, sample: zenoh.Sample) -> None:
        self._on_tx(keys.node_of(str(sample.key_expr)), sample.payload.to_bytes())

    def _take_alive(self, sample: zenoh.Sample) -> None:
        self._on_alive(keys.node_of(str(sample.key_expr)), sample.kind == zenoh.SampleKind.PUT)
