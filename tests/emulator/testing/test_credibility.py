"""The green runs that make a fix credible: the rule, and what campaigns say of an earlier one."""

import pytest

from emulator.testing.campaign import after_a_fix, compared_with_before, green_runs_needed


def rows(runs: int, failed: int, check: str = "own:safe") -> list[dict[str, object]]:
    return [{"checks": {check: "invalid" if number < failed else "valid"}} for number in range(runs)]


@pytest.mark.parametrize(("failed", "runs"), [(1, 1), (1, 200), (10, 200), (200, 200)])
def test_as_many_green_runs_pass_by_luck_once_in_twenty_at_the_lower_bound(failed: int, runs: int) -> None:
    needed = green_runs_needed(failed, runs)
    # The bound is the rate at which so many failures, or more, are seen with a probability of 0.05.
    low, high = 0.0, 1.0
    for _ in range(60):
        rate = (low + high) / 2
        low, high = (rate, high) if seen_at_least(failed, runs, rate) < 0.05 else (low, rate)
    assert (1 - rate) ** needed <= 0.05 < (1 - rate) ** (needed - 1)


def seen_at_least(failed: int, runs: int, rate: float) -> float:
    """Return the probability of at least so many failures, summed term by term."""
    term = (1 - rate) ** runs
    below = 0.0
    for count in range(failed):
        below += term
        term *= (runs - count) / (count + 1) * rate / (1 - rate)
    return 1 - below


def test_rarer_failures_need_more_green_runs() -> None:
    needed = [green_runs_needed(failed, 200) for failed in (1, 2, 10, 100, 200)]
    assert needed == sorted(needed, reverse=True) and len(set(needed)) == len(needed)


def test_a_campaign_that_fails_says_how_many_runs_are_needed() -> None:
    (line,) = after_a_fix(rows(200, 10))
    assert "own:safe failed in 10 of 200" in line and f" {green_runs_needed(10, 200)} runs" in line
    assert list(after_a_fix(rows(200, 0))) == []


def test_a_campaign_is_compared_with_the_one_before_the_fix() -> None:
    needed = green_runs_needed(10, 200)
    (too_few,) = compared_with_before(rows(200, 10), rows(needed - 1, 0))
    assert f"from {needed} runs on" in too_few
    (enough,) = compared_with_before(rows(200, 10), rows(needed, 0))
    assert "credible" in enough and "enough" in enough
    (failing,) = compared_with_before(rows(200, 10), rows(needed, 1))
    assert "credible" not in failing and f"in 1 of {needed} now" in failing
    assert list(compared_with_before(rows(200, 0), rows(10, 0))) == []
    (not_judged,) = compared_with_before(rows(200, 10), rows(needed, 0, "own:other"))
    assert "judged in no run now" in not_judged and "credible" not in not_judged
    (hung,) = compared_with_before(rows(200, 10, "hung"), rows(needed, 0))
    assert "enough" in hung, "a run that hangs comes to no check, and one that does not has no such check"


def test_only_runs_that_judge_a_check_say_anything_of_its_fix() -> None:
    unjudged: list[dict[str, object]] = [{"checks": {"own:safe": "unknown"}}, {"checks": {}}]
    needed = green_runs_needed(10, 20)
    (line,) = after_a_fix([*rows(20, 10), *unjudged * 90])
    assert "10 of 20 runs" in line and f" {needed} runs" in line
    (too_few,) = compared_with_before([*rows(20, 10), *unjudged], [*rows(needed - 1, 0), *unjudged * 90])
    assert f"none of {needed - 1} now" in too_few and f"from {needed} runs on" in too_few
    (none,) = compared_with_before(rows(20, 10), unjudged * 90)
    assert "judged in no run now" in none


def with_seeds(runs: list[dict[str, object]], first: int) -> list[dict[str, object]]:
    return [row | {"seed": first + number} for number, row in enumerate(runs)]


def test_the_same_runs_again_say_nothing_of_a_fix() -> None:
    needed = green_runs_needed(10, 200)
    before = with_seeds(rows(200, 10), 1)
    (same,) = compared_with_before(before, with_seeds(rows(200, 0), 1))
    assert "credible" not in same and "--seed" in same
    (some,) = compared_with_before(before, with_seeds(rows(200 + needed - 1, 0), 1))
    assert f"none of {needed - 1} " in some and f"from {needed} runs on" in some
    (enough,) = compared_with_before(before, with_seeds(rows(200 + needed, 0), 1))
    assert "enough" in enough
    (failing,) = compared_with_before(before, with_seeds(rows(200, 3), 1))
    assert "in 3 of 200 now" in failing


def test_a_fault_s_own_checks_count_together_and_a_foreign_row_counts_nothing() -> None:
    kills = dict.fromkeys(["effect:kill-0", "effect:kill-1"], "invalid")
    found: list[dict[str, object]] = [{"checks": kills}, {"checks": 3}, {}]
    (line,) = after_a_fix(found)
    assert "in 1 of 1 runs" in line
