"""News: results of `Radio.send` and messages of the backbone that a process has been granted, each for its instant.

They make an instant, whoever waits for them.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

from vnet.transport.backbone import WireMessage
from vnet.transport.send_results import WireSendResult

NewsItem = WireSendResult | WireMessage


class News:
    """News whose instants have not come yet, in the order of time."""

    def __init__(self) -> None:
        self._waiting: list[NewsItem] = []

    def add(self, *some_news: Sequence[NewsItem]) -> None:
        """Add news."""
        if any(some_news):
            new = [item for some in some_news for item in some]
            self._waiting = sorted([*self._waiting, *new], key=lambda item: item.time_ns)

    def drop(self, node: str) -> None:
        """Drop what comes for a node whose process is gone."""
        self._waiting = [item for item in self._waiting if item.node != node]

    def first_ns(self, paused: Collection[str], otherwise_ns: int) -> int:
        """Return the instant of the first item for a node that is not paused, or `otherwise_ns` if earlier."""
        if not self._waiting:
            return otherwise_ns
        times_ns = (item.time_ns for item in self._waiting if item.node not in paused)
        return min(next(times_ns, otherwise_ns), otherwise_ns)

    def take(self, time_ns: int, paused: Collection[str] = ()) -> list[NewsItem]:
        """Remove and return the news of all instants up to `time_ns`; those of paused nodes wait."""
        if not self._waiting:
            return []
        due: list[NewsItem] = []
        waiting: list[NewsItem] = []
        for item in self._waiting:
            is_due = item.time_ns <= time_ns and item.node not in paused
            (due if is_due else waiting).append(item)
        self._waiting = waiting
        return due
