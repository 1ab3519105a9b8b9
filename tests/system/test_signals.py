"""A live run in the caller's own process leaves the caller's signal handlers as they were, however it ends.

tests/emulator/drivers/test_signals.py has callers that ignore signals or leave them to the system.
"""

import asyncio
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from emulator.drivers.attachment import LiveOptions
from emulator.drivers.emulation import Emulation
from emulator.drivers.live import run_live
from emulator.scenario.loading import load_scenario
from tests.support.paths import ROOT
from tests.support.recorded import prepared
from vnet.errors import VnetError
from vnet.transport.access import Access

HANDLED = (signal.SIGINT, signal.SIGTERM, signal.SIGCHLD)


def own(number: int, frame: object) -> None:
    """A handler of the caller's."""


@pytest.fixture(autouse=True)
def handlers() -> Iterator[list[object]]:
    """Signal handlers of the caller."""
    earlier = {number: signal.signal(number, own) for number in HANDLED}
    yield [own] * len(HANDLED)
    for number, handler in earlier.items():
        signal.signal(number, handler)


def emulation_of(folder: Path, *overrides: str) -> Emulation:
    scenario = load_scenario(ROOT / "scenarios/beacon.toml", ["network.vehicles=2", "run.duration_s=1", *overrides])
    return prepared(scenario, folder)


def live(emulation: Emulation, **options: Any) -> bool:
    """Run; returns whether the run was interrupted."""
    access = Access.create(emulation.scenario.run.name, [["v01"], ["v02"]])
    return asyncio.run(run_live(emulation, LiveOptions(access, **options)))[1]


def now() -> list[object]:
    return [signal.getsignal(number) for number in HANDLED]


def test_after_a_run_that_came_to_its_end(tmp_path: Path, handlers: list[object]) -> None:
    assert not live(emulation_of(tmp_path / "run"))
    assert now() == handlers


@pytest.mark.parametrize("number", HANDLED[:2])
def test_after_an_interrupted_run(number: signal.Signals, tmp_path: Path, handlers: list[object]) -> None:
    emulation = emulation_of(tmp_path / "run")
    emulation.watch(lambda view: os.kill(os.getpid(), number))  # and again at the end of each period left
    assert live(emulation)
    assert [event.kind for event in emulation.folder.events].count("interrupted") == 1
    assert now() == handlers


@pytest.mark.parametrize(
    ("overrides", "options"),
    [(["program.entry='no.such:program'"], {}), ([], {"listen": "carrier-pigeon/127.0.0.1:0"})],
    ids=["no program", "no endpoint"],
)
def test_after_a_run_that_could_not_start(
    overrides: list[str], options: dict[str, str], tmp_path: Path, handlers: list[object]
) -> None:
    emulation = emulation_of(tmp_path / "run", *overrides)
    with pytest.raises(VnetError):
        live(emulation, **options)
    assert now() == handlers
