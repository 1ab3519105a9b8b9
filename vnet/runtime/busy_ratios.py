"""Channel busy ratios that the radios of one process have measured."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence

from vnet.transport.wire import BusyRatios


class MeasuredBusyRatios:
    """Busy ratios of `nodes` over the latest time, each from its instant on; `clock` gives emulated nanoseconds."""

    def __init__(self, nodes: Sequence[str], clock: Callable[[], int]) -> None:
        self._index = {node: index for index, node in enumerate(nodes)}
        self._clock = clock
        self._measured: deque[BusyRatios] = deque()

    def add(self, measured: Sequence[BusyRatios]) -> None:
        """Add measurements, which replace those that begin at the same instant or later."""
        while self._measured and measured and self._measured[-1].from_ns >= measured[0].from_ns:
            self._measured.pop()
        self._measured.extend(measured)
        self._drop_past()

    def _drop_past(self) -> None:
        while len(self._measured) > 1 and self._measured[1].from_ns <= self._clock():
            self._measured.popleft()

    def of(self, node: str) -> float | None:
        """Return the busy ratio that a node knows now; None if no medium is shared."""
        self._drop_past()
        return self._measured[0].ratios[self._index[node]] if self._measured else None
