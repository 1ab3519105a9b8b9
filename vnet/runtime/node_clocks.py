"""The clocks of the nodes of one process, some of which are wrong (the faults `skew` and `drift`)."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from vnet.runtime.current_node import present_node
from vnet.runtime.virtual_time import SkewedLoop
from vnet.transport.wire import ClockError


class NodeClocks:
    """The clocks of the nodes of a process; `now_ns` gives the emulated time in nanoseconds."""

    def __init__(self, now_ns: Callable[[], int]) -> None:
        self._now_ns = now_ns
        self._errors: dict[str, ClockError] = {}
        self._past: dict[str, list[ClockError]] = {}

    def apply(self, errors: Iterable[ClockError], loop: SkewedLoop) -> None:
        """Take new errors of clocks, which the timers of tasks on `loop` follow from now on."""
        for error in errors:
            self._past.setdefault(error.node, []).append(error)
            self._errors.pop(error.node, None)
            if error.is_wrong:
                self._errors[error.node] = error
        loop.clock_error_of = self._error_of_task if self._errors else lambda: None

    def _error_of_task(self) -> ClockError | None:
        node = present_node()
        return None if node is None else self._errors.get(node.id)

    def now_of(self, node: str) -> int:
        """Return what the clock of `node` shows now, in nanoseconds."""
        error = self._errors.get(node)
        return self._now_ns() if error is None else max(error.shown_ns(self._now_ns()), 0)

    def has_been_wrong(self, node: str) -> bool:
        """Return whether the clock of `node` has ever been given an error."""
        return node in self._past

    def shown_ns(self, node: str, time_ns: int) -> int:
        """Return what the clock of `node` showed at `time_ns`, as it went then."""
        for error in reversed(self._past.get(node, ())):
            if error.since_ns <= time_ns:
                return max(error.shown_ns(time_ns), 0)
        return time_ns
