"""Reading of untrusted files, endless devices included, with bounded memory."""

from __future__ import annotations

from pathlib import Path

_CHUNK_BYTES = 65_536
"""Bytes that are read at once."""


def read_bounded(path: Path, largest_bytes: int) -> bytes:
    """Return the content of a file or pipe. Raise OSError, or ValueError if it is larger than `largest_bytes`."""
    content = bytearray()
    with path.open("rb", buffering=0) as file:
        while chunk := file.read(_CHUNK_BYTES):
            content += chunk
            if len(content) > largest_bytes:
                raise ValueError(f"larger than {largest_bytes} bytes")
    return bytes(content)
