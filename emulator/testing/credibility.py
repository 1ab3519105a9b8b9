"""The number of green runs after which a failure that was seen before may be believed fixed.

If a run fails with probability p, n runs pass by chance with (1 - p)^n. That is at most alpha from
n = ln(alpha) / ln(1 - p) on. The earlier campaign gives p by its lower confidence bound (Clopper and Pearson 1934,
one-sided): the rate itself would promise too much after few failures.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from emulator.records.verdicts import Verdict
from emulator.testing.matrix import column_of
from emulator.testing.trial import EMULATOR, HUNG

ALPHA = 0.05
"""Probability of error, both of the bound of the rate and of as many green runs by chance."""


def green_runs_needed(failed: int, runs: int, alpha: float = ALPHA) -> int:
    """Return how many runs in a row must pass, if `failed` (at least one) of so many have failed before."""
    from scipy.stats import beta  # takes longer to import than most of a campaign's other modules

    least_rate = float(beta.ppf(alpha, failed, runs - failed + 1))
    return math.ceil(math.log(alpha) / math.log1p(-least_rate))


def failures_by_check(results: Sequence[Mapping[str, Any]]) -> Counter[str]:
    """Count the runs of `campaign.json` in which each check failed."""
    counts: Counter[str] = Counter()
    for row in results:
        counts.update({column_of(name)[0] for name, verdict in _checks(row) if verdict == Verdict.INVALID})
    return counts


def _checks(row: Mapping[str, Any]) -> list[tuple[str, Any]]:
    checks = row.get("checks")
    return list(checks.items()) if isinstance(checks, dict) else []


def after_a_fix(results: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield a line for each check that failed: the runs that make its fix credible."""
    for check, failed in failures_by_check(results).most_common():
        needed = green_runs_needed(failed, len(results))
        yield (
            f"{check} failed in {failed} of {len(results)} runs: once it is fixed, {needed} runs without a failure "
            f"make that credible ({1 - ALPHA:.0%})"
        )


def compared_with_before(before: Sequence[Mapping[str, Any]], now: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield a line for each check that failed before: whether it is credibly fixed now."""
    failing = failures_by_check(now)
    judged = {HUNG, EMULATOR} | {column_of(name)[0] for row in now for name, _ in _checks(row)}
    for check, failed in failures_by_check(before).most_common():
        was = f"{check} failed in {failed} of {len(before)} runs before"
        if failing[check]:
            yield f"{was}, and in {failing[check]} of {len(now)} now"
            continue
        if check not in judged:
            yield f"{was}, and was judged in no run now"
            continue
        needed = green_runs_needed(failed, len(before))
        if len(now) >= needed:
            yield f"{was}, and in none of {len(now)} now: a fix is credible, for which {needed} runs are enough"
        else:
            yield f"{was}, and in none of {len(now)} now: a fix is credible from {needed} runs on ({1 - ALPHA:.0%})"
