"""The connection of a host to the emulator's router, with the rights of the role *host*."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Sequence
from contextlib import ExitStack

import zenoh

from emulator.drivers.hosts.messages import HostHello, Item, News, encode
from vnet.transport import keys
from vnet.transport.credentials import Credentials
from vnet.transport.session import open_client

LEASE_MS = 3_600_000
"""Milliseconds. Silence of a host is judged by the emulator, which knows what it waits for."""


class Up:
    """The keys of a host. The callbacks run on Zenoh's threads."""

    def __init__(
        self,
        endpoint: str,
        run: str,
        host: str,
        credentials: Credentials | None,
        on_rx: Callable[[bytes], None],
        on_emulator: Callable[[bool], None],
        stack: ExitStack,
    ) -> None:
        """Connect until `stack` is closed. Raises TransportError."""
        self.nonce = secrets.token_bytes(16)
        session = stack.enter_context(open_client(endpoint, credentials, LEASE_MS))
        self._tx = stack.enter_context(
            session.declare_publisher(
                keys.host_tx(run, host), congestion_control=zenoh.CongestionControl.BLOCK, express=True
            )
        )
        rx = keys.host_rx(run, host)
        stack.enter_context(session.declare_subscriber(rx, lambda sample: on_rx(sample.payload.to_bytes())))
        stack.enter_context(session.liveliness().declare_token(keys.host_alive(run, host)))
        stack.enter_context(
            session.liveliness().declare_subscriber(
                keys.emulator_alive(run),
                lambda sample: on_emulator(sample.kind == zenoh.SampleKind.PUT),
                history=True,
            )
        )

    def say_hello(self, hello: HostHello) -> None:
        """Put a hello."""
        self._tx.put(encode(hello))

    def put(self, items: Sequence[Item]) -> None:
        """Put a bundle."""
        self._tx.put(encode(News(self.nonce, items)))
