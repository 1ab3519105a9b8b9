"""Results of `Radio.send` that the nodes of one process have been granted, each for its instant."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

from vnet.node import Node
from vnet.transport.send_results import WireSendResult


class SendResults:
    """Results whose instants have not come yet, in the order of time; `node_of` gives a node by its name."""

    def __init__(self, node_of: Callable[[str], Node]) -> None:
        self._node_of = node_of
        self._waiting: list[WireSendResult] = []

    def add(self, results: Sequence[WireSendResult]) -> None:
        """Add results."""
        if results:
            self._waiting = sorted([*self._waiting, *results], key=lambda result: result.time_ns)

    def drop(self, node: str) -> None:
        """Drop the results of a node whose process is gone."""
        self._waiting = [result for result in self._waiting if result.node != node]

    def first_ns(self, paused: Collection[str], otherwise_ns: int) -> int:
        """Return the instant of the first result of a node that is not paused, or `otherwise_ns` if earlier."""
        times_ns = (result.time_ns for result in self._waiting if result.node not in paused)
        return min(next(times_ns, otherwise_ns), otherwise_ns)

    def settle(self, time_ns: int, paused: Collection[str] = ()) -> None:
        """Give programs the results of all instants up to `time_ns`; those of paused nodes wait."""
        if not self._waiting:
            return
        waiting = []
        for result in self._waiting:
            if result.time_ns <= time_ns and result.node not in paused:
                self._node_of(result.node).radio.settle(result.number, result.result())
            else:
                waiting.append(result)
        self._waiting = waiting
