"""Orders that fail are shrunk to their fewest deviations; a campaign keeps the least case as a test."""

import io
import json
from collections.abc import Sequence
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from emulator.records.tape import tape_lines
from emulator.testing.campaign import FAILURE_PAGE, PARTING_FILE, TEST_FILE, run_campaign
from emulator.testing.campaign_plan import Plan
from emulator.testing.scenarios import make_scenario
from emulator.testing.trial import fewest, order_text, shrink_run
from tests.emulator.testing.test_campaign import planted, said_by_pytest
from vnet.transport.wire import Deviation

pytestmark = pytest.mark.slow

pytest_plugins = "pytester"


@given(st.sets(st.integers(0, 199), min_size=1, max_size=4))
def test_what_fails_together_is_left(needed: set[int]) -> None:
    def fails(items: Sequence[int]) -> bool:
        return needed <= set(items)

    least, tried = fewest(range(200), fails, most=1000)
    assert set(least) == needed and len(least) == len(needed)
    assert tried < 300


@pytest.mark.parametrize("most", [0, 1, 2, 5])
def test_a_campaign_shrinks_with_no_more_runs_than_it_is_allowed(tmp_path: Path, most: int) -> None:
    scenario = planted("tells_before_it_measures", 2, duration_s=1.0, settle_s=0.0, order="shuffle")
    plan = Plan.of(scenario, "none", 1, 1, shrink_steps=most, jobs=1)
    assert run_campaign(plan, tmp_path / "campaign", Console(file=io.StringIO())) == 1
    (row,) = json.loads((tmp_path / "campaign" / "campaign.json").read_text())["results"]
    assert row["failed"] and row["steps"] <= most


def test_no_more_is_tried_than_is_allowed() -> None:
    tried: list[int] = []

    def fails(items: Sequence[int]) -> bool:
        tried.append(len(items))
        return False

    _, steps = fewest(range(1000), fails, most=7)
    assert len(tried) == steps == 7


def test_vehicles_that_no_fault_needs_are_left_out() -> None:
    kill = {"kind": "kill", "at_s": 0.5, "duration_s": 1.0, "nodes": ["v02"]}
    scenario = make_scenario("beacon", {"vehicles": 8, "duration": 4, "settle": 1, "faults": [kill]})
    least, steps = shrink_run(scenario, lambda smaller: smaller.network.vehicles >= 3, most=20)
    assert least.network.vehicles == 4 and steps > 2


def test_an_order_is_a_phrase() -> None:
    (line,) = tape_lines([Deviation("v03", 0, 4_200_000_000, 0, "timer of tell", "fix")])
    assert order_text([line]) == "FIFO, except v03: timer of tell before fix, at 4.2 s"
    assert order_text([line] * 7).endswith("; and 2 more")


def test_a_campaign_of_orders_keeps_the_least_case_as_a_test_that_fails(
    tmp_path: Path, pytester: pytest.Pytester
) -> None:
    """One deviation of hundreds is left; FIFO does not fail; the test that was written fails, and says why."""
    scenario = planted("tells_before_it_measures", 3, settle_s=0.0, order="shuffle")
    folder = tmp_path / "campaign"
    said = io.StringIO()
    status = run_campaign(Plan.of(scenario, "none", 2, 1), folder, Console(file=said, width=200))
    assert status == 1
    rows = json.loads((folder / "campaign.json").read_text())["results"]
    failed = [row for row in rows if "order" in row]
    assert failed and all(
        row["order"].startswith("FIFO, except ") and row["order"].count("timer of tell") == 1 for row in failed
    )
    page = (folder / "campaign.html").read_text()
    assert "The order of events: FIFO, except" in page
    parts = "parts from the same run in FIFO order at "
    assert f"\n001 {parts}" in said.getvalue() and page.count(f"This run {parts}") == len(failed)
    assert (folder / "failures" / "001" / PARTING_FILE).read_text().startswith(parts)
    failure = (folder / "failures" / "001" / FAILURE_PAGE).read_text()
    assert f"This run {parts}" in failure and 'id="timeline-data"' in failure and "crashed: " in failure
    assert page.count('<a href="failures/001/failure.html">') == 1
    assert [row["parting"]["differences"][0]["first"] for row in failed] == ["decision"] * len(failed)
    test = folder / "failures" / "001" / TEST_FILE.format("001")
    assert "agents_alive" in said_by_pytest(test, pytester)
