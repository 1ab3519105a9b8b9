"""Tests that take long and depend on some files alone: skipped while these are as they were when they passed."""

import contextlib
import hashlib
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest


def key_of(files: Iterable[Path]) -> str:
    """Return a digest of files, and of their names."""
    found = hashlib.sha256()
    for file in sorted(file for file in files if file.is_file() and file.suffix != ".pyc"):
        found.update(f"{file} {hashlib.sha256(file.read_bytes()).hexdigest()}\n".encode())
    return found.hexdigest()


@contextlib.contextmanager
def unless_passed(config: pytest.Config, name: str, files: Iterable[Path]) -> Iterator[None]:
    """Skip the test `name` if it has passed with the same files, but in CI (if the environment has `CI`) never."""
    cache, place = getattr(config, "cache", None), f"vnet/passed/{name.replace('/', '-')}"
    key = key_of(files)
    if cache and cache.get(place, None) == key and not os.environ.get("CI"):
        pytest.skip("has passed, and what it depends on has not changed since; CI=1 runs it again")
    yield
    if cache:
        cache.set(place, key)
