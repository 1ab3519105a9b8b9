"""CPU time of the processes of a live run."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Mapping

_WHOLE_PROCESS = 2
"""Kind of a clock in Linux's clock ids of processes: CPU time of all its threads."""


def cpu_time_ns(pid: int) -> int | None:
    """CPU time of a process and all its threads; None if it has ended, or this system does not say."""
    if sys.platform != "linux":
        return None
    try:
        return time.clock_gettime_ns((~pid << 3) | _WHOLE_PROCESS)  # the id that clock_getcpuclockid(3) returns
    except OSError:
        return None


class CpuWatch:
    """CPU time of processes between the first and the last look at each; `cpu_ns` is the sum by name.

    A process that is started again under its name adds to it.
    """

    def __init__(self) -> None:
        self._first_ns: dict[tuple[str, int], int] = {}
        self._last_ns: dict[tuple[str, int], int] = {}

    def look(self, pids: Mapping[str, int]) -> None:
        """Read the clock of each process (name to pid)."""
        for name, pid in pids.items():
            if (now_ns := cpu_time_ns(pid)) is not None:
                self._first_ns.setdefault((name, pid), now_ns)
                self._last_ns[name, pid] = now_ns

    @property
    def cpu_ns(self) -> Counter[str]:
        """CPU time in ns by name."""
        total: Counter[str] = Counter()
        for process, last_ns in self._last_ns.items():
            total[process[0]] += last_ns - self._first_ns[process]
        return total
