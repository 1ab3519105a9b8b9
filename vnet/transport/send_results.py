"""Results of frames to single nodes, in their form on the wire."""

from __future__ import annotations

import msgspec

from vnet.radio import SendResult
from vnet.transport.orders import Count, TimeNs


class WireSendResult(msgspec.Struct, frozen=True, array_like=True):
    """The result of frame `number` that `node` has sent to another one, which it learns at `time_ns`."""

    node: str
    number: Count
    time_ns: TimeNs
    delivered: bool
    attempts: Count

    def result(self) -> SendResult:
        """Return the result as the program sees it."""
        return SendResult(self.delivered, self.attempts)
