"""GNSS time by a vehicle's own clock, which may be wrong."""

from __future__ import annotations

import asyncio
from collections import deque

from vnet import Fix, Node
from vnet.units import NS_PER_S

CLOCK_FIXES = 10
"""Number of fixes by which the clock is judged: after it has jumped ahead it is wrong for so long."""


class GnssClock:
    """GNSS time of a node.

    A fix is received at its time or later: the least that the clock was ahead of the last fixes is its error.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._ahead_ns: deque[int] = deque(maxlen=CLOCK_FIXES)

    def set_by(self, fix: Fix) -> None:
        """Take note of a fix that has just come."""
        self._ahead_ns.append(self._node.now_ns - fix.time_ns)

    @property
    def now_ns(self) -> int:
        """GNSS time in nanoseconds."""
        return self._node.now_ns - min(self._ahead_ns)

    async def sleep_until(self, time_ns: int) -> None:
        """Sleep until this GNSS time."""
        if time_ns > self.now_ns:
            await asyncio.sleep((time_ns - self.now_ns) / NS_PER_S)
