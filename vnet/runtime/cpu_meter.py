"""CPU time and wake-ups of each node on a loop that hosts several: the answer to "whose program is slow?"."""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING

from vnet.runtime.ready_queue import node_of
from vnet.runtime.running_node import RunningNode

if TYPE_CHECKING:
    from vnet.node import Node


class CpuMeter:
    """CPU time that the callbacks of each node take, and the instants at which each is woken.

    `clock` gives the CPU time of the loop's thread in ns; what programs compute on other threads, as in executors,
    is not in it. A callback belongs to the node in whose context it runs; one of nobody's is not counted. The
    node whose callback runs is written down in `shown`.
    """

    def __init__(self, clock: Callable[[], int] = time.thread_time_ns, shown: RunningNode | None = None) -> None:
        self._clock = clock
        self._running: str | None = None
        self._since_ns = 0
        self._awake: set[str] = set()
        self._shown = shown or RunningNode()
        self.cpu_ns: Counter[str] = Counter()
        self.wake_ups: Counter[str] = Counter()

    def begin(self, handle: asyncio.Handle) -> None:
        """A callback begins, and the one before it is over."""
        now_ns = self._clock()
        self._charge(now_ns)
        node = node_of(handle)
        if node is not None:
            self._running, self._since_ns = node.id, now_ns
            self._awake.add(node.id)
            self._shown.show(node.id)

    def end(self) -> None:
        """The loop looks for callbacks: none is running."""
        if self._running is not None:
            self._charge(self._clock())
        self._shown.show("")

    def wait_for(self, node: Node | None) -> None:
        """The loop waits for a job of this node, on another thread."""
        self._shown.show("" if node is None else node.id)

    def end_instant(self) -> None:
        """Nothing is left to do at this instant: count a wake-up of each node that has run."""
        self.wake_ups.update(self._awake)
        self._awake.clear()

    def _charge(self, now_ns: int) -> None:
        if self._running is not None:
            self.cpu_ns[self._running] += now_ns - self._since_ns
            self._running = None
