"""The keys of the roadside units of an agent process, on which the messages of the backbone go out and come in."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack

import zenoh

from vnet.errors import WireError
from vnet.transport import keys, wire
from vnet.transport.backbone_keys import Contents, Sent, decode_arrived, encode, split_frames, split_yield
from vnet.transport.wire import MessageRef, WireMessage


class UnitKeys:
    """See the module's text. `on_arrived` is called on Zenoh's thread when a message has come.

    What has come is kept until a grant or a batch refers to it.
    """

    def __init__(
        self,
        session: zenoh.Session,
        run: str,
        units: Sequence[str],
        on_arrived: Callable[[], None],
        stack: ExitStack,
    ) -> None:
        self._on_arrived = on_arrived
        self._contents: Contents[WireMessage] = Contents()
        self._lock = threading.Lock()
        self._publishers = {
            unit: stack.enter_context(
                session.declare_publisher(
                    keys.backbone_tx(run, unit), congestion_control=zenoh.CongestionControl.BLOCK, express=True
                )
            )
            for unit in units
        }
        for unit in units:
            stack.enter_context(session.declare_subscriber(keys.backbone_rx(run, unit), self._take))

    def _take(self, sample: zenoh.Sample) -> None:
        try:
            arrived = decode_arrived(sample.payload.to_bytes())
        except WireError:  # whoever waits for it says so in the end
            return
        with self._lock:
            self._contents.add(arrived.message(keys.node_of(str(sample.key_expr))))
        self._on_arrived()

    def put(self, message: wire.AgentMessage) -> wire.AgentMessage:
        """Put the messages of units; return what their process says, with references in their place."""
        contents: list[tuple[str, Sent]] = []
        if isinstance(message, wire.Yield) and any(step.traffic.messages for step in message.steps):
            message, contents = split_yield(message)
        elif isinstance(message, wire.Frames) and message.traffic.messages:
            message, contents = split_frames(message)
        for unit, content in contents:
            self._publishers[unit].put(encode(content))
        return message

    def missing(self, refs: Sequence[MessageRef]) -> list[MessageRef]:
        """Return the references to messages that have not come yet."""
        with self._lock:
            return self._contents.missing(refs)

    def take(self, refs: Sequence[MessageRef]) -> tuple[list[WireMessage], list[MessageRef]]:
        """Remove and return the messages that have come of these, and the references to those that have not."""
        with self._lock:
            return self._contents.split(refs)
