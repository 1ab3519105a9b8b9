"""Fixtures for tests of all packages."""

import functools
import gc
import os
import re
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer.main
from hypothesis import Phase, settings

from tests.support import forked_commands

# The same examples in each run, so that it fails for what was changed, and however slow the machine.
# Others: --hypothesis-profile=others. Where time matters less, twice as many.
settings.register_profile("same", derandomize=True, deadline=None, max_examples=100 if os.environ.get("CI") else 50)
settings.register_profile("others", deadline=None)
settings.load_profile("same")
# For mutants: the first example that fails is enough, and looking for a smaller one takes minutes.
settings.register_profile("first", settings.get_profile("same"), phases=[Phase.explicit, Phase.generate])

# A thirtieth of a second for each command line, of an application that is always the same.
vars(typer.main)["get_command"] = functools.cache(typer.main.get_command)


gc.disable()  # while tests are collected: nothing of what is imported is garbage
SLOW_FILE = re.compile(r"^pytestmark = \[?\s*pytest\.mark\.slow\b", re.MULTILINE)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out files whose tests are all slow where slow tests are not run: importing them takes half a minute."""
    if config.option.markexpr != "not slow" or not collection_path.match("test_*.py"):
        return None
    return True if SLOW_FILE.search(collection_path.read_text(encoding="utf-8")) else None


MOSTLY_WAIT = ("test_zenoh.py", "test_access.py", "test_ros2.py", "test_ends_of_agents.py", "test_hosts.py")
"""Files of tests/system whose tests take four times as long as they compute, or more."""


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with what waits for processes, so that other workers compute meanwhile; end with files of quick tests.

    The first worker takes the first of the tests, and those that are done take the last of others. So pages, which
    compute, come after whole runs: otherwise all workers wait at the end.
    """
    slow = {item.path for item in items if item.get_closest_marker("slow")}

    def place(item: pytest.Item) -> tuple[bool, ...]:
        path = item.path
        is_run, is_page = path.parent.name == "system", path in slow and path.parent.name == "docs"
        return not (is_run and path.name in MOSTLY_WAIT), not is_run, not is_page, path not in slow

    items.sort(key=place)


def pytest_collection_finish() -> None:
    """Keep garbage collection from looking through all tests and modules again at the end of each simulation."""
    gc.enable()
    gc.collect()
    gc.freeze()


STARTS = {"subprocess.Popen", "os.exec", "os.fork", "os.forkpty", "os.posix_spawn"}
_started: list[str] = []
sys.addaudithook(lambda event, arguments: _started.append(f"{event} {arguments[:2]}") if event in STARTS else None)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    """Forget the processes of the test before."""
    _started.clear()


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item: pytest.Item) -> None:
    """Keep `make quick` quick on every machine: a process costs what a hundred other tests do."""
    assert item.get_closest_marker("slow") or not _started, f"bears no @pytest.mark.slow, and starts {_started}"


MOST_LEFT_OPEN = 100
"""Descriptors that a file of tests may leave open: Zenoh and Rerun keep some until they are needed again."""


def _open_descriptors() -> int:
    return sum(1 for _ in Path("/proc/self/fd").iterdir())


@pytest.fixture(scope="module", autouse=True)
def _descriptors_are_closed() -> Iterator[None]:
    """Name the file of tests that leaves many descriptors open, of which a later one would have too many."""
    most = _open_descriptors() + MOST_LEFT_OPEN
    yield
    if _open_descriptors() > most:
        gc.collect()
        assert _open_descriptors() <= most, f"more than {MOST_LEFT_OPEN} descriptors are left open"


@pytest.fixture(scope="session", autouse=True)
def _processes_are_forked() -> None:
    """Save each worker of cells, and each repetition of a run, the second that it takes to import vnet."""
    forked_commands.fork_processes()


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
