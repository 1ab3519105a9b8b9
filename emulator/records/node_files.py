"""`files/NODE/`: what vehicles have left on their disks, copied at the end of a run, bounded, and nothing else.

Disks are what programs made of them: links are not followed, only regular files are read, and names stay below the
folder of their vehicle.
"""

from __future__ import annotations

import os
import shutil
import stat
import threading
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from emulator.records.atomic import disk_errors
from emulator.records.run_folder import FILES, RunFolder
from vnet.units import BYTES_PER_MB

MOST_FILES = 1000
"""Files of a vehicle that are kept."""
DEEPEST = 16
"""Levels of folders of a vehicle that are kept."""
MOST_NAMED = 3
"""Names of files that were left out which are told; all are counted."""


@dataclass
class LeftOut:
    """Files and folders of a vehicle that were not kept: how many, and the first of them with the reason."""

    count: int = 0
    which: list[str] = field(default_factory=list)

    def add(self, name: str, reason: str) -> None:
        """Count one."""
        self.count += 1
        if self.count <= MOST_NAMED:
            self.which.append(f"{name[:100]}: {reason}".encode(errors="replace").decode())


def collect(folder: RunFolder, nodes: Iterable[str], most_mb: float) -> dict[str, LeftOut]:
    """Move the files of the disks to `files/` and remove the disks; return what was left out, by vehicle.

    Of each vehicle `most_mb` megabytes are kept.
    """
    left_out = {}
    for node in nodes:
        disk = folder.disks / node
        if disk.is_dir() and not disk.is_symlink():
            kept = _Collection(folder.path / FILES / node, round(most_mb * BYTES_PER_MB))
            kept.take(disk)
            if kept.left_out.count:
                left_out[node] = kept.left_out
    with suppress(RecursionError):  # folders a thousand deep
        shutil.rmtree(folder.disks, ignore_errors=True)
    return left_out


class _Collection:
    """Files of one vehicle on their way from its disk to `target`."""

    def __init__(self, target: Path, most_bytes: int) -> None:
        self.left_out = LeftOut()
        self._target = target
        self._bytes_left = most_bytes
        self._files_left = MOST_FILES

    def take(self, disk: Path) -> None:
        """Copy in the order of the names, folder by folder, what there is room for."""
        for name, depth, entry in self._entries(disk):
            if entry.is_symlink():
                self.left_out.add(name, "a link")
            elif entry.is_dir(follow_symlinks=False):
                if depth == DEEPEST:
                    self.left_out.add(name, f"more than {DEEPEST} folders deep")
            elif not entry.is_file(follow_symlinks=False):
                self.left_out.add(name, "no regular file")
            elif not self._files_left:
                self.left_out.add(name, f"more than {MOST_FILES} files")
            else:
                self._copy(name, Path(entry.path))

    def _entries(self, disk: Path) -> Iterator[tuple[str, int, os.DirEntry[str]]]:
        """Everything on a disk: its path there, the number of folders around it, and the entry."""
        folders = [("", 0, disk)]
        while folders:
            before, depth, folder = folders.pop()
            try:
                with os.scandir(folder) as found:
                    entries = sorted(found, key=lambda entry: entry.name)
            except OSError as error:
                self.left_out.add(before or ".", error.strerror or "cannot be read")
                continue
            for entry in entries:
                name = f"{before}{entry.name}"
                yield name, depth, entry
                if depth < DEEPEST and entry.is_dir(follow_symlinks=False):
                    folders.append((f"{name}/", depth + 1, Path(entry.path)))

    def _copy(self, name: str, source: Path) -> None:
        """Copy a file, as long as it is one and there is room."""
        try:
            number = os.open(source, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            self.left_out.add(name, error.strerror or "cannot be read")
            return
        with os.fdopen(number, "rb") as file:
            found = os.fstat(number)
            if not stat.S_ISREG(found.st_mode):
                self.left_out.add(name, "no regular file")
            elif found.st_size > self._bytes_left:
                self.left_out.add(name, f"{found.st_size:,} bytes, and there is room for {self._bytes_left:,}")
            else:
                target = self._target / name
                try:
                    target.parent.mkdir(parents=True, exist_ok=True)
                    with target.open("xb") as copy:
                        shutil.copyfileobj(file, copy)
                except OSError as error:  # a full disk: the run is kept all the same
                    target.unlink(missing_ok=True)
                    self.left_out.add(name, error.strerror or "cannot be written")
                    return
                self._bytes_left -= found.st_size
                self._files_left -= 1


LARGEST_LOG_BYTES = 10_000_000
"""Bytes that are kept of a node's log, so that a flood fills no disk."""

LONGEST_HELD = 10_000
"""Characters that are held back of a line that has no end."""


class NodeLogs:
    """The logs of nodes in the folder `logs`. Raises VnetError where the disk refuses."""

    def __init__(self, logs: Path) -> None:
        self._logs = logs
        self._bytes: Counter[str] = Counter()
        self._begun: dict[str, str] = {}
        self._lock = threading.RLock()  # threads of programs print

    def write(self, node: str, text: str) -> None:
        """Append a line, or say once that the log is full."""
        self.add(node, f"{text}\n")

    def add(self, node: str, text: str) -> None:
        """Append a text as it is; the beginning of a line is held back until there is more of it."""
        with self._lock:
            text = self._begun.pop(node, "") + text
            if len(text) < LONGEST_HELD:
                whole, newline, begun = text.rpartition("\n")
                text = whole + newline
                if begun:
                    self._begun[node] = begun
            if text:
                self._append(node, text)

    def end_lines(self) -> None:
        """Write what is held back."""
        for node in list(self._begun):
            self.add(node, "\n")

    def _append(self, node: str, text: str) -> None:
        before = self._bytes[node]
        self._bytes[node] += len(text.encode(errors="replace"))
        if before > LARGEST_LOG_BYTES:
            return
        if self._bytes[node] > LARGEST_LOG_BYTES:
            text = f"(the log is full: further lines are left out after {LARGEST_LOG_BYTES:,} bytes)\n"
        with (
            disk_errors(self._logs),
            (self._logs / f"{node}.log").open("a", encoding="utf-8", errors="replace") as file,
        ):
            file.write(text)
