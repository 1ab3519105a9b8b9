"""Fixtures for tests of recordings."""

from collections.abc import Iterator

import pytest
import rerun as rr


@pytest.fixture(scope="module")
def strict() -> Iterator[None]:
    """Turn Rerun's warnings into errors."""
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)
