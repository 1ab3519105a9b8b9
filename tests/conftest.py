"""Fixtures for tests of all packages."""

import gc
import signal
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import Phase, settings

from vnet.runtime.environment import use_same_arithmetic

use_same_arithmetic()  # as in the commands, whose results some tests compare with those of this process

# The same examples in each run, so that it fails for what was changed, and however slow the machine.
# Others: --hypothesis-profile=default.
settings.register_profile("same", derandomize=True, deadline=None)
settings.load_profile("same")
# For mutants: the first example that fails is enough, and looking for a smaller one takes minutes.
settings.register_profile("first", settings.get_profile("same"), phases=[Phase.explicit, Phase.generate])


def pytest_collection_finish() -> None:
    """Keep garbage collection from looking through all tests and modules again at the end of each simulation."""
    gc.collect()
    gc.freeze()


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
