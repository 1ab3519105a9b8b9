"""Reading of untrusted files, endless devices included, with bounded memory."""

from __future__ import annotations

import os
import stat
from io import FileIO
from pathlib import Path

_CHUNK_BYTES = 65_536
"""Bytes that are read at once."""


def read_bounded(path: Path, largest_bytes: int) -> bytes:
    """Return the content of a file or pipe. Raise OSError, or ValueError if it is larger than `largest_bytes`."""
    with path.open("rb", buffering=0) as file:
        return _read(file, largest_bytes)


def read_regular(path: Path, largest_bytes: int) -> bytes:
    """Return the content of a regular file, as `read_bounded`; a pipe or a device raises ValueError."""
    with open_regular(path) as file:
        return _read(file, largest_bytes)


def open_regular(path: Path) -> FileIO:
    """Open a file for reading. Raise OSError, or ValueError unless it is a regular file: no pipe blocks."""
    file = FileIO(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC))
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise ValueError("not a regular file")
    return file


def _read(file: FileIO, largest_bytes: int) -> bytes:
    content = bytearray()
    while chunk := file.read(_CHUNK_BYTES):
        content += chunk
        if len(content) > largest_bytes:
            raise ValueError(f"larger than {largest_bytes} bytes")
    return bytes(content)
