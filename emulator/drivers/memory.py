"""Memory of the processes of a live run, sampled for the check that none of them grows."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # slow to import, and hosts write no events
    from emulator.records.run_folder import RunFolder

SAMPLES = 40
"""A run, so many times; a process that is started again begins a new series."""
_PAGE_KB = os.sysconf("SC_PAGE_SIZE") // 1024


def resident_kb(pid: int | str = "self") -> int | None:
    """Resident memory of a process, in KiB; None if it has just ended, or if this system has no /proc."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * _PAGE_KB
    except (OSError, IndexError, ValueError):
        return None


class MemoryWatch:
    """Samples the resident memory of processes; `write` puts it into the run's events."""

    def __init__(self, duration_ns: int) -> None:
        self._every_ns = max(1, duration_ns // SAMPLES)
        self._next_ns = 0
        self._series: dict[tuple[str, int], list[tuple[float, int]]] = {}

    def look(self, time_ns: int, pids: Mapping[str, int]) -> None:
        """Take a sample of each process (name to pid), if it is time to."""
        if time_ns < self._next_ns:
            return
        self._next_ns = time_ns + self._every_ns
        for name, pid in pids.items():
            if (size_kb := resident_kb(pid)) is not None:
                self._series.setdefault((name, pid), []).append((time_ns / 1e9, size_kb))

    def series(self) -> Iterator[tuple[str, list[float], list[int]]]:
        """The samples of each process: its name, times in s and sizes in KiB."""
        for (name, _), samples in self._series.items():
            yield name, [time_s for time_s, _ in samples], [size_kb for _, size_kb in samples]

    def write(self, folder: RunFolder, time_ns: int) -> None:
        """One event `memory` a process: `time_s` and `rss_kb` of its samples."""
        for name, time_s, rss_kb in self.series():
            folder.event(time_ns, "memory", name, time_s=time_s, rss_kb=rss_kb)
