"""Results of frames to single vehicles, on their way from the engine to the processes of their senders."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from emulator.radio.engine import Engine
from vnet.transport.send_results import WireSendResult


class ResultFeed:
    """The results that nodes have yet to be granted; `node_ids` are in the order of the engine."""

    def __init__(self, engine: Engine, node_ids: Iterable[str]) -> None:
        self._engine = engine
        self._node_ids = list(node_ids)
        self._waiting: dict[str, list[WireSendResult]] = {}

    def next_ns(self, otherwise_ns: int) -> int:
        """Return the time of the next result that has not been shown, or `otherwise_ns` if it is earlier."""
        result_ns = self._engine.next_result_ns()
        return otherwise_ns if result_ns is None else min(result_ns, otherwise_ns)

    def show(self, time_ns: int) -> None:
        """Put the results up to `time_ns` where their processes will find them."""
        for result in self._engine.take_results(time_ns):
            node = self._node_ids[result.sender]
            shown = WireSendResult(node, result.number, result.time_ns, result.delivered, result.attempts)
            self._waiting.setdefault(node, []).append(shown)

    def firsts(self) -> Iterator[tuple[str, int]]:
        """Yield each node that has results, and the time in ns of its first."""
        for node, results in self._waiting.items():
            yield node, results[0].time_ns

    def take(self, nodes: Iterable[str]) -> list[WireSendResult]:
        """Remove and return the results of these nodes."""
        if not self._waiting:
            return []
        return [result for node in nodes for result in self._waiting.pop(node, ())]
