"""Writing to the disk: files and folders that appear in one step, and logs of nodes up to a bound.

What appears in one step is written beside its place, and moved there when it is whole.
"""

from __future__ import annotations

import os
import shutil
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from vnet.errors import VnetError

LARGEST_LOG_BYTES = 10_000_000
"""Bytes that are kept of a node's log, so that a flood fills no disk."""
LONGEST_HELD = 10_000
"""Characters that are held back of a line that has no end."""


class DiskError(VnetError):
    """A refusal of the disk."""


@contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Raise DiskError, which names `path`, where the disk refuses something in the block."""
    try:
        yield
    except OSError as error:
        raise DiskError(f"{path}: cannot write: {error.strerror or error}") from None


@contextmanager
def room_held(folder: Path, size_bytes: int) -> Iterator[None]:
    """Hold room on the disk during the block: what is written later finds some behind files that fill the disk."""
    held = folder / ".room"
    try:
        with suppress(OSError):
            held.write_bytes(bytes(size_bytes))
        yield
    finally:
        with suppress(OSError):
            held.unlink(missing_ok=True)


def check_is_free(folder: Path, option: str = "") -> None:
    """Raise VnetError if a folder that is to be made exists and is not empty; `option` says who has named it."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise VnetError(f"{option}{folder}: exists and is not an empty folder")


@contextmanager
def atomically(path: Path) -> Iterator[Path]:
    """Yield a path beside `path` at which to write a file or a folder; move it to `path` at the end of the block.

    If the block raises, nothing is left, and what was at `path` stays as it was. A folder replaces an empty folder
    only. Raises VnetError where the disk refuses.
    """
    # Absolute, because pyarrow takes a relative path with a colon for the address of a remote file.
    part = path.absolute().with_name(f".{path.name}.{os.getpid()}.part")
    with disk_errors(path):
        try:
            yield part
            part.replace(path)
        finally:
            _remove(part)


def write_atomically(path: Path, content: bytes | str) -> None:
    """Write a whole file in one step; characters that are no text become `?`. Raises VnetError."""
    with atomically(path) as part:
        part.write_bytes(content.encode("utf-8", "replace") if isinstance(content, str) else content)


def _remove(path: Path) -> None:
    """Remove a file or a folder, if there is one."""
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def log_is_full() -> str:
    """Return the last line of a log that is full."""
    return f"(the log is full: further lines are left out after {LARGEST_LOG_BYTES:,} bytes)\n"


def cut_log(path: Path) -> None:
    """Cut a log that a process writes by itself, which must have it open for appending, if it is full."""
    with suppress(OSError):  # a full disk, or a log that is gone
        if path.stat().st_size <= LARGEST_LOG_BYTES:
            return
        with path.open("r+b") as file:
            file.seek(LARGEST_LOG_BYTES - 1)
            end = file.read(1)
            file.seek(LARGEST_LOG_BYTES)
            file.write(b"\n" * (end != b"\n") + log_is_full().encode())
            file.truncate()  # last: what the process writes meanwhile goes, too


class NodeLogs:
    """The logs of nodes in the folder `logs`. Raises VnetError where the disk refuses."""

    def __init__(self, logs: Path) -> None:
        self._logs = logs.absolute()
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
            text = log_is_full()
        with (
            disk_errors(self._logs),
            (self._logs / f"{node}.log").open("a", encoding="utf-8", errors="replace") as file,
        ):
            file.write(text)
