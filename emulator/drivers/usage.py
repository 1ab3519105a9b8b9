"""Memory and CPU time of the processes of a run, sampled for limits, costs, and the check that none grows."""

from __future__ import annotations

import math
import os
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from emulator.records.events import EventKind

if TYPE_CHECKING:
    from emulator.records.run_folder import RunFolder


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


SAMPLES = 20
"""Samples in a run, ten of them in its second half; a process that is started again begins a new series."""
LEAST_NS = 1_500_000_000
"""Least time between two samples, in emulated ns: that of a run of 30 s, the shortest that is judged."""
UNCHANGED_KB = 16
"""Change in KiB from which on private memory is read again: that takes 30 times as long."""
KB_PER_MB = 1e6 / 1024
"""KiB of a megabyte."""
_PAGE_KB = os.sysconf("SC_PAGE_SIZE") // 1024


def resident_kb(pid: int | str = "self") -> int | None:
    """Resident memory of a process, in KiB; None if it has just ended, or if this system has no /proc."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * _PAGE_KB
    except (OSError, IndexError, ValueError):
        return None


def private_kb(pid: int | str = "self") -> int | None:
    """Memory that a process shares with no other, in KiB; None if it has just ended, or the system does not say."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()[1:]
        sizes = {name: int(size.split()[0]) for name, size in (line.split(":") for line in lines)}
        return sizes["Private_Clean"] + sizes["Private_Dirty"]
    except (OSError, KeyError, IndexError, ValueError):
        return None


def _changes_kb(pid: int) -> tuple[int, int] | None:
    """Return a process's resident memory and the pages it has faulted in, in KiB; None where it has just ended.

    What a forked process writes to becomes its own by a fault, and was resident before.
    """
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return int(fields[21]) * _PAGE_KB, int(fields[7]) * _PAGE_KB
    except (OSError, IndexError, ValueError):
        return None


def first_over(limit_mb: float | None, pids: Mapping[str, int]) -> tuple[str, float] | None:
    """Return the first process (name to pid) that holds more private memory than the limit, and its megabytes."""
    if limit_mb is None:
        return None
    limit_kb = limit_mb * KB_PER_MB
    for name, pid in pids.items():
        if (resident_kb(pid) or 0) > limit_kb and (size_kb := private_kb(pid) or 0) > limit_kb:
            return name, math.ceil(size_kb / KB_PER_MB * 10) / 10  # rounded up: always more than the limit
    return None


class MemoryWatch:
    """Samples the private memory of processes; `write` puts it into the run's events."""

    def __init__(self, duration_ns: int) -> None:
        self._every_ns = max(LEAST_NS, duration_ns // SAMPLES)
        self._next_ns = 0
        self._series: dict[tuple[str, int], list[tuple[float, int]]] = {}
        self._changes_kb: dict[int, tuple[int, int]] = {}

    def look(self, time_ns: int, pids: Mapping[str, int]) -> None:
        """Take a sample of each process (name to pid), if it is time to."""
        if time_ns < self._next_ns:
            return
        self._next_ns = (time_ns // self._every_ns + 1) * self._every_ns
        for name, pid in pids.items():
            if (size_kb := self._private_kb(name, pid)) is not None:
                self._series.setdefault((name, pid), []).append((time_ns / 1e9, size_kb))

    def _private_kb(self, name: str, pid: int) -> int | None:
        """Return the private memory of a process; what was read before if nothing has changed since."""
        now_kb, before = _changes_kb(pid), self._series.get((name, pid))
        if now_kb is None:
            return None
        if before and math.dist(now_kb, self._changes_kb[pid]) < UNCHANGED_KB:
            return before[-1][1]
        self._changes_kb[pid] = now_kb
        return private_kb(pid)

    def series(self) -> Iterator[tuple[str, list[float], list[int]]]:
        """The samples of each process: its name, times in s and sizes in KiB."""
        for (name, _), samples in self._series.items():
            yield name, [time_s for time_s, _ in samples], [size_kb for _, size_kb in samples]

    def write(self, folder: RunFolder, time_ns: int) -> None:
        """One event `memory` a process: `time_s` and `private_kb` of its samples."""
        for name, time_s, sizes_kb in self.series():
            folder.event(time_ns, EventKind.memory, name, time_s=time_s, private_kb=sizes_kb)
