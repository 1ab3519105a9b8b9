"""Files and folders that appear in one step: written beside their place, and moved there when they are whole."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from vnet.errors import VnetError


@contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Raise VnetError, which names `path`, where the disk refuses something in the block."""
    try:
        yield
    except OSError as error:
        raise VnetError(f"{path}: cannot write: {error.strerror or error}") from None


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
