"""The planted bugs: FIFO hides those that need another order, and the repaired programs keep what they promise."""

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from emulator.records.run_folder import RunFolder
from emulator.records.verdicts import Verdict
from emulator.scenario.scenario import Scenario
from emulator.testing.campaign_plan import Plan
from emulator.testing.scenarios import make_scenario
from emulator.testing.trial import run_trial
from tests.hunt.bugs import BUGS, FAULTS, Bug
from tests.hunt.programs import crossing_permits

pytestmark = pytest.mark.slow

CAMPAIGN_SEED = 3
PAUSE = {"kind": "pause", "nodes": {"ids": ["v02"]}, "at_s": 0.35, "duration_s": 0.6}
DELAY = {"kind": "delay", "at_s": 0.1, "duration_s": 0.5, "delay_ms": 10.0}
SHOWN_IN_FIFO: dict[str, list[dict[str, Any]]] = {
    "lost_item": [],
    "swallowed_cancellation": [PAUSE],
    "changed_table": [PAUSE],
    "second_session": [DELAY],
}
"""Faults with which a bug shows in FIFO all the same, in the run with the campaign's seed."""

each_bug = pytest.mark.parametrize("bug", BUGS, ids=[bug.name for bug in BUGS])


def failed(scenario: Scenario, folder: Path) -> list[str]:
    """Simulate and judge; returns the checks that are invalid."""
    return run_trial(scenario, RunFolder.create(folder, scenario)).failed


@each_bug
def test_a_repaired_program_passes_and_is_judged(bug: Bug, tmp_path: Path) -> None:
    scenario = bug.scenario(repaired=True)
    trial = run_trial(scenario, RunFolder.create(tmp_path / "run", scenario))
    assert not trial.failed
    assert trial.verdicts[bug.judged_by] is Verdict.VALID


@each_bug
def test_a_repaired_program_withstands_faults(bug: Bug, tmp_path: Path) -> None:
    scenario = Plan.of(bug.scenario(repaired=True), FAULTS, 1, CAMPAIGN_SEED).draw(0)
    assert scenario.fault
    assert not failed(scenario, tmp_path / "run")


@pytest.mark.parametrize("bug", [bug for bug in BUGS if bug.needs_order], ids=lambda bug: bug.name)
def test_fifo_hides_a_bug_that_needs_another_order(bug: Bug, tmp_path: Path) -> None:
    assert not failed(bug.scenario(), tmp_path / "run")


@pytest.mark.parametrize("bug", [bug for bug in BUGS if bug.name in SHOWN_IN_FIFO], ids=lambda bug: bug.name)
def test_its_check_finds_a_bug_that_fifo_shows(bug: Bug, tmp_path: Path) -> None:
    changes = {"seed": CAMPAIGN_SEED, "faults": SHOWN_IN_FIFO[bug.name]}
    assert failed(make_scenario(bug.scenario(), changes), tmp_path / "bug") == [bug.judged_by]
    assert not failed(make_scenario(bug.scenario(repaired=True), changes), tmp_path / "repaired")


# The order that a bug needs, without a run.


async def cancel_when_ready(task: "asyncio.Task[object]", make_ready: Callable[[], object]) -> None:
    """Cancel a waiting task in the same round of callbacks in which it has become ready."""
    await asyncio.sleep(0)
    make_ready()
    task.cancel()
    await asyncio.wait({task})


@pytest.mark.parametrize(
    ("permits", "free"), [(crossing_permits.Permits, 0), (crossing_permits.RepairedPermits, 1)]
)
def test_a_permit_given_to_a_cancelled_task(permits: type[crossing_permits.Permits], free: int) -> None:
    async def main() -> int:
        pool = permits(1)
        await pool.acquire()
        waiting: asyncio.Task[object] = asyncio.ensure_future(pool.acquire())
        await cancel_when_ready(waiting, pool.release)
        return pool.free

    assert asyncio.run(main()) == free
