"""Reading files that may be anything, endless devices included, without taking more memory than they need."""

from __future__ import annotations

from pathlib import Path

_CHUNK_BYTES = 65_536


def read_bounded(path: Path, largest_bytes: int) -> bytes:
    """The content of a file (or pipe). Raises OSError, and ValueError where it is larger than `largest_bytes`."""
    content = bytearray()
    with path.open("rb", buffering=0) as file:
        while chunk := file.read(_CHUNK_BYTES):
            content += chunk
            if len(content) > largest_bytes:
                raise ValueError(f"larger than {largest_bytes} bytes")
    return bytes(content)
