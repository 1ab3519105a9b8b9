"""Keys of agents at the side of their router: the emulator's, or that of a host. The rights of agents are the same.

What comes is heard on Zenoh's threads: what it is, the id of a node (or the name of a host), and the item.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from contextlib import ExitStack
from typing import Any

import zenoh

from vnet.transport import keys

Hear = Callable[[str, str, Any], None]


class AgentKeys:
    """Keys of `nodes`, and those of the backbone of `units`, declared until `stack` is closed."""

    def __init__(
        self,
        session: zenoh.Session,
        run: str,
        nodes: Collection[str],
        units: Collection[str],
        drops: bool,
        hear: Hear,
        stack: ExitStack,
    ) -> None:
        # In lockstep one message is outstanding per agent, so BLOCK is safe; in real time one frozen agent must
        # not stall all others.
        control = zenoh.CongestionControl.DROP if drops else zenoh.CongestionControl.BLOCK

        def publisher(key: str) -> zenoh.Publisher:
            return stack.enter_context(session.declare_publisher(key, congestion_control=control, express=True))

        self._rx = {node: publisher(keys.node_rx(run, node)) for node in nodes}
        self._unit_rx = {unit: publisher(keys.backbone_rx(run, unit)) for unit in units}
        if units:  # before `tx` of nodes: who has been heard there can put a message here
            hear_payloads(session, keys.backbone_tx(run, "*"), "backbone", hear, stack)
        hear_payloads(session, keys.node_tx(run, "*"), "message", hear, stack)
        hear_tokens(session, keys.node_alive(run, "*"), "token", hear, stack)

    def put(self, node: str, payload: bytes) -> None:
        """Put an encoded message on the `rx` of a node; one for a node that is not here is dropped."""
        if node in self._rx:
            self._rx[node].put(payload)

    def put_unit(self, unit: str, payload: bytes) -> None:
        """Put an encoded message on a unit's key of the backbone; one for a unit that is not here is dropped."""
        if unit in self._unit_rx:
            self._unit_rx[unit].put(payload)


def hear_payloads(session: zenoh.Session, key: str, what: str, hear: Hear, stack: ExitStack) -> None:
    """Hear the payloads that are put on keys."""

    def take(sample: zenoh.Sample) -> None:
        hear(what, keys.node_of(str(sample.key_expr)), sample.payload.to_bytes())

    stack.enter_context(session.declare_subscriber(key, take))


def hear_tokens(session: zenoh.Session, key: str, what: str, hear: Hear, stack: ExitStack) -> None:
    """Hear whether tokens of liveliness are there, or are gone."""

    def take(sample: zenoh.Sample) -> None:
        hear(what, keys.node_of(str(sample.key_expr)), sample.kind == zenoh.SampleKind.PUT)

    stack.enter_context(session.liveliness().declare_subscriber(key, take, history=True))
