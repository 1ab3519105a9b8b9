"""The pytest plugin: the fixture `vnet_emulation`, and coroutine tests that use it.

It is loaded into every pytest session of an environment in which vnet is installed, so it imports nothing heavy
before a test asks for the fixture. Coroutine tests that another plugin (pytest-asyncio, anyio) has taken stay its.
"""

from __future__ import annotations

import asyncio
import functools
import inspect
import itertools
import sys
from collections.abc import Callable, Coroutine, Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from emulator.testing.harness import RunHarness

FIXTURE = "vnet_emulation"
_runs: pytest.StashKey[list[RunHarness]] = pytest.StashKey()


def pytest_addoption(parser: pytest.Parser) -> None:
    """`--vnet-live`."""
    group = parser.getgroup("vnet")
    group.addoption(
        "--vnet-live",
        action="store_true",
        help=f"{FIXTURE} runs live, with real processes over Zenoh, where a test does not say otherwise",
    )


def pytest_unconfigure() -> None:
    """End the watch that the fixture has begun."""
    if death_watch := sys.modules.get("emulator.testing.death_watch"):
        death_watch.end()


@pytest.fixture
def vnet_emulation(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Callable[..., RunHarness]]:
    """Runs of a scenario, step by step: `async with vnet_emulation(SCENARIO, vehicles=6, …) as emu:`.

    SCENARIO is a file, a dict or a Scenario. Keywords change it: vehicles, program, options, seed, duration,
    settle, faults, or `**{"section.key": value}`. `live=True` runs real processes. See docs/testing.md.
    """
    from emulator.testing.death_watch import watch
    from emulator.testing.harness import RunHarness
    from emulator.testing.scenarios import make_scenario
    from vnet.runtime.outside_loop import refuse_success

    refuse_success()
    watch(request.config)
    runs: list[RunHarness] = []
    request.node.stash[_runs] = runs
    folders = [request.config.rootpath, request.path.parent]
    by_default = bool(request.config.getoption("--vnet-live"))

    def emulation(scenario: Any, *, live: bool | None = None, **changes: Any) -> RunHarness:
        folder = next(path for n in itertools.count(1) if not (path := tmp_path / f"vnet-{n}").exists())
        made = make_scenario(scenario, changes, folders)
        runs.append(RunHarness(made, folder, by_default if live is None else live))
        return runs[-1]

    yield emulation
    for run in runs:
        run.close()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_call(item: pytest.Item) -> None:
    """Let hypothesis call a coroutine test, one run of asyncio an example."""
    given = getattr(getattr(item, "obj", None), "hypothesis", None)
    if given is not None and inspect.iscoroutinefunction(given.inner_test) and _is_ours(item):
        given.inner_test = _synchronous(given.inner_test)


def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run a coroutine test that uses the fixture, and that nobody else has taken."""
    if not inspect.iscoroutinefunction(pyfuncitem.obj) or not _is_ours(pyfuncitem):
        return None
    arguments = {name: pyfuncitem.funcargs[name] for name in pyfuncitem._fixtureinfo.argnames}
    asyncio.run(pyfuncitem.obj(**arguments))
    return True


def _is_ours(item: pytest.Item) -> bool:
    taken = any(item.get_closest_marker(name) is not None for name in ("asyncio", "anyio", "trio"))
    return FIXTURE in getattr(item, "fixturenames", ()) and not taken


def _synchronous(test: Callable[..., Coroutine[Any, Any, None]]) -> Callable[..., None]:
    @functools.wraps(test)
    def run(*args: Any, **kwargs: Any) -> None:
        asyncio.run(test(*args, **kwargs))

    return run


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Add the folders of a failed test's runs to its report, and the command that reproduces the last one."""
    report = yield
    runs = item.stash.get(_runs, [])
    if report.failed and runs:
        from emulator.records.run_folder import is_run_folder

        begun = [run for run in runs if is_run_folder(run.folder)]
        lines = [f"files  {run.folder}" for run in begun[-3:]] + [f"again  {run.reproduce}" for run in begun[-1:]]
        report.sections.append(("vnet", "\n".join(lines)))
    return report
