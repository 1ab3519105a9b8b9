"""Checks of estimates: divergent vehicles, means that are none, agreement that does not return."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from emulator.checks.judge import CheckResult, NotExercised, RecordedRun, Verdict, judge
from emulator.checks.own import own_findings
from emulator.records.events import Event
from emulator.records.run import Run
from tests.emulator.checks.test_faults import simulated
from vnet.node import Node

pytestmark = pytest.mark.slow

DECLARES = "agents.cooperative.declared"

BLOCK = {"kind": "block", "at_s": 2.0, "duration_s": 1.0}
COOPERATION = ("consensus_mean", "convergence", "bounded_error")


async def believes(node: Node) -> None:
    """Report beliefs that agree, but for the `wrong`: {node, what, from_s, to_s, by_m}.

    With `lag_s` all beliefs move by 1.5 m a second, back and forth, and means follow after that time.
    """
    wrong: Mapping[str, Any] = node.options
    number = int(node.id[1:])
    async for fix in node.gnss:
        await node.radio.broadcast(b"hello")
        values: dict[str, Any] = {"common_error_m": [0.02 * number, 0.0], "mean_m": [0.05, 0.0]}
        if wrong and node.id == wrong["node"] and wrong["from_s"] <= fix.time_ns / 1e9 < wrong["to_s"]:
            values[wrong["what"]][1] += wrong["by_m"]
        if "lag_s" in wrong:
            values["common_error_m"][0] += away_m(fix.time_ns / 1e9)
            values["mean_m"][0] += away_m(fix.time_ns / 1e9 - wrong["lag_s"])
        if "stated_m2" in wrong:
            values["common_error_covariance_m2"] = [[wrong["stated_m2"], 0.0], [0.0, wrong["stated_m2"]]]
        node.report(fix.position_m, fix.covariance_m2, **values)


def away_m(time_s: float) -> float:
    return 1.5 * abs(time_s % 12 - 6)


async def silent(node: Node) -> None:
    """Report only the fix."""
    async for fix in node.gnss:
        await node.radio.broadcast(b"hello")
        node.report(fix.position_m, fix.covariance_m2)


def run(
    *faults: dict[str, Any],
    duration_s: float = 16.0,
    what: str = "",
    from_s: float = 0,
    to_s: float = 0,
    by_m: float = 0,
    rate_hz: float = 5,
    **more: float,
) -> RecordedRun:
    """Four vehicles in a world without a common error, one of which errs for a time."""
    wrong = {"node": "v03", "what": what, "from_s": from_s, "to_s": to_s, "by_m": by_m, **more} if what else {}
    return simulated(
        *faults,
        run={"duration_s": duration_s, "settle_s": 2.0},
        network={"vehicles": 4, "layout": "dense"},
        world={"common_error": {"sigma_m": 0.0}, "gnss": {"rate_hz": rate_hz}},
        program=f"{__name__}:believes",
        options=wrong,
    )


def findings(recorded: RecordedRun) -> dict[str, CheckResult | NotExercised]:
    """All findings of a run, those of the declared checks without their prefix."""
    judgement = judge(recorded, own_findings(recorded.scenario.program, Run(recorded, Path())))
    found: list[CheckResult | NotExercised] = [*judgement.checks, *judgement.not_exercised]
    return {each.name.removeprefix("own:"): each for each in found}


def not_valid(recorded: RecordedRun) -> dict[str, Verdict]:
    checks = [each for each in findings(recorded).values() if isinstance(each, CheckResult)]
    return {each.name.removeprefix("own:"): each.verdict for each in checks if each.verdict is not Verdict.VALID}


def result(recorded: RecordedRun, name: str) -> CheckResult | NotExercised:
    return findings(recorded)[name]


def checked(recorded: RecordedRun, name: str) -> CheckResult:
    found = result(recorded, name)
    assert isinstance(found, CheckResult)
    return found


def verdict(recorded: RecordedRun, name: str) -> Verdict:
    return checked(recorded, name).verdict


def test_vehicles_that_agree_and_recover_are_valid() -> None:
    recorded = run(BLOCK)
    assert not_valid(recorded) == {}
    assert all(isinstance(result(recorded, name), CheckResult) for name in COOPERATION)


def test_programs_without_beliefs_leave_nothing_to_judge() -> None:
    recorded = simulated(BLOCK, program=f"{__name__}:silent")
    assert all(isinstance(result(recorded, name), NotExercised) for name in COOPERATION)


@pytest.mark.parametrize(
    ("to_s", "stated_m2", "found"),
    [(6.5, 0.1, {"bounded_error": Verdict.INVALID}), (5.7, 0.1, {}), (6.5, 9.0, {})],
)
def test_a_vehicle_that_is_lost_for_five_seconds_is_found_unless_it_says_so(
    to_s: float, stated_m2: float, found: dict[str, Verdict]
) -> None:
    recorded = run(duration_s=9.0, what="common_error_m", from_s=1.0, to_s=to_s, by_m=12.0, stated_m2=stated_m2)
    assert not_valid(recorded) == found


def test_a_vehicle_whose_receiver_is_bent_may_be_lost() -> None:
    jump = {"kind": "gnss_jump", "at_s": 1.0, "duration_s": 2.0, "offset_m": [50.0, 0.0], "nodes": {"ids": ["v03"]}}
    recorded = run(jump, duration_s=9.0, what="common_error_m", from_s=1.0, to_s=8.0, by_m=12.0)
    assert verdict(recorded, "bounded_error") is Verdict.VALID


def test_a_mean_that_is_none_is_found() -> None:
    recorded = run(duration_s=11.0, what="mean_m", from_s=3.0, to_s=11.0, by_m=2.0)
    assert not_valid(recorded) == {"consensus_mean": Verdict.INVALID}
    rows = checked(recorded, "consensus_mean").figures["rows"]
    assert [row["node"] for row in rows] == ["v03"]
    assert rows[0]["off_m"] == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize(("stated_m2", "found"), [(0.4, {"consensus_mean": Verdict.INVALID}), (4.0, {})])
def test_a_mean_may_be_as_far_off_as_the_vehicle_states(stated_m2: float, found: dict[str, Verdict]) -> None:
    recorded = run(duration_s=12.0, what="mean_m", from_s=3.0, to_s=12.0, by_m=2.0, stated_m2=stated_m2)
    assert not_valid(recorded) == found


@pytest.mark.parametrize(("lag_s", "found"), [(1.0, {}), (5.0, {"consensus_mean": Verdict.INVALID})])
def test_a_mean_follows_a_few_periods_later(lag_s: float, found: dict[str, Verdict]) -> None:
    recorded = run(duration_s=60.0, what="mean_m", lag_s=lag_s, rate_hz=1)
    assert not_valid(recorded) == found


def test_a_mean_has_some_seconds_to_settle() -> None:
    recorded = run(duration_s=4.0, what="mean_m", from_s=1.0, to_s=6.0, by_m=2.0)
    assert isinstance(result(recorded, "consensus_mean"), NotExercised)


def test_who_is_down_has_no_mean_and_is_no_part_of_it() -> None:
    recorded = run(duration_s=8.0, what="mean_m", from_s=3.0, to_s=9.0, by_m=2.0)
    dead = replace(recorded, events=[*recorded.events, Event(3_000_000_000, "finished", "v03", {})])
    assert verdict(dead, "consensus_mean") is Verdict.VALID


@pytest.mark.parametrize(("to_s", "found"), [(12.5, {}), (14.0, {"convergence": Verdict.INVALID})])
def test_agreement_must_come_back_within_ten_seconds(to_s: float, found: dict[str, Verdict]) -> None:
    recorded = run(BLOCK, what="common_error_m", from_s=2.5, to_s=to_s, by_m=4.0)
    assert not_valid(recorded) == found


def test_agreement_that_had_no_ten_seconds_to_come_back_is_unknown() -> None:
    recorded = run(BLOCK, duration_s=8.0, what="common_error_m", from_s=2.5, to_s=8.0, by_m=4.0)
    assert not_valid(recorded) == {"convergence": Verdict.UNKNOWN}


@pytest.mark.parametrize(("rate_hz", "duration_s"), [(5, 6.0), (1, 40.0)])
def test_a_mean_that_has_not_settled_yet_is_unknown(rate_hz: float, duration_s: float) -> None:
    """It has ten seconds, or fifty rounds, for that."""
    recorded = run(duration_s=duration_s, what="mean_m", from_s=3.0, to_s=duration_s, by_m=2.0, rate_hz=rate_hz)
    assert not_valid(recorded) == {"consensus_mean": Verdict.UNKNOWN}


def test_a_heal_that_the_next_fault_cuts_short_is_not_judged() -> None:
    second = {**BLOCK, "at_s": 4.0}
    recorded = run(BLOCK, second, what="common_error_m", from_s=2.5, to_s=6.0, by_m=4.0)
    found = result(recorded, "convergence")
    assert isinstance(found, CheckResult)
    assert found.figures["recovered_s"] == [pytest.approx(1.0)]
