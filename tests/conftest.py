"""Fixtures for tests of all packages."""

import signal
from collections.abc import Iterator
from typing import Any

import pytest


@pytest.fixture
def default_signals() -> Iterator[None]:
    """Let Ctrl-C and SIGTERM do what they do by default, in this process and in those that the test starts.

    A shell that runs the tests in the background has them ignore Ctrl-C, and so would all that they start.
    """
    defaults: dict[int, Any] = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
    before = {number: signal.signal(number, handler) for number, handler in defaults.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)
