"""Results of frames to single nodes and messages of the backbone, on their way to processes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from emulator.drivers.emulation import Emulation
from vnet.runtime.arrivals import NewsItem
from vnet.transport.wire import WireMessage, WireSendResult


class NewsFeed:
    """The results and messages that nodes of an emulation have yet to be granted."""

    def __init__(self, emulation: Emulation) -> None:
        self._engine, self._backbone, self._up = emulation.engine, emulation.backbone, emulation.up
        self._node_ids = list(emulation.world.node_ids)
        self._waiting: dict[str, list[NewsItem]] = {}

    def next_ns(self) -> int | None:
        """Return the time of the next result or message that has not been shown, or None."""
        times_ns = self._engine.next_result_ns(), self._backbone.next_ns()
        return min((time_ns for time_ns in times_ns if time_ns is not None), default=None)

    def show(self, time_ns: int) -> None:
        """Put what comes up to `time_ns` where its processes will find it."""
        for result in self._engine.take_results(time_ns):
            node = self._node_ids[result.sender]
            shown = WireSendResult(node, result.number, result.time_ns, result.delivered, result.attempts)
            self._waiting.setdefault(node, []).append(shown)
        for message in self._backbone.take(time_ns):
            if self._up[message.node]:
                self._waiting.setdefault(message.node, []).append(message)

    def repeat(self, news: Iterable[NewsItem]) -> None:
        """Put what a process has missed where it will find it again."""
        for item in news:
            self._waiting.setdefault(item.node, []).append(item)

    def firsts(self) -> Iterator[tuple[str, int]]:
        """Yield each node for which something has come, and the time in ns of the first."""
        for node, arrivals in self._waiting.items():
            yield node, min(arrival.time_ns for arrival in arrivals)

    def take(self, nodes: Iterable[str]) -> tuple[list[WireSendResult], list[WireMessage]]:
        """Remove and return the results and the messages of these nodes."""
        if not self._waiting:
            return [], []
        taken = [arrival for node in nodes for arrival in self._waiting.pop(node, ())]
        results = [arrival for arrival in taken if isinstance(arrival, WireSendResult)]
        return results, [arrival for arrival in taken if isinstance(arrival, WireMessage)]
