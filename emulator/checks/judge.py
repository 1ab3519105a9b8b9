"""The verdict on a run, from its trace, states, metrics and events alone.

Each check is *valid*, *invalid* or *unknown*, with its figures and the offending rows. A check that the scenario
could not exercise (a cap that no neighbourhood exceeds) is not applicable and listed with its reason; one that
should have seen something and saw nothing is unknown. `emulator.checks.registry` is the table of all checks.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from emulator.checks.registry import CHECKS
from emulator.checks.replay import ONCE, check_replay
from emulator.radio.trace import sha256_of_table
from emulator.records.recorded_run import RecordedRun
from emulator.records.verdicts import CheckResult, Finding, Judgement, NotExercised, Verdict

__all__ = [
    "CheckResult",
    "Judgement",
    "NotExercised",
    "RecordedRun",
    "Verdict",
    "check_run",
    "judge",
]


def judge(recorded: RecordedRun) -> Judgement:
    """Judge a run by all checks."""
    findings: list[Finding] = [finding for check in CHECKS for finding in check.findings(recorded)]
    findings.append(ONCE)
    checks = [finding for finding in findings if isinstance(finding, CheckResult)]
    skipped = [finding for finding in findings if isinstance(finding, NotExercised)]
    return Judgement(_downgrade_if_overloaded(checks), skipped, sha256_of_table(recorded.trace))


def _downgrade_if_overloaded(checks: list[CheckResult]) -> list[CheckResult]:
    """Make invalid checks of timing unknown if the machine did not keep up."""
    of_machine = {check.name for check in CHECKS if check.of_machine}
    sensitive = {check.name for check in CHECKS if check.realtime_sensitive}
    if all(check.verdict is Verdict.VALID for check in checks if check.name in of_machine):
        return checks
    return [
        replace(check, verdict=Verdict.UNKNOWN, text=f"{check.text}; but the machine did not keep up")
        if check.name in sensitive and check.verdict is Verdict.INVALID
        else check
        for check in checks
    ]


def check_run(folder: Path) -> Judgement:
    """Judge a run from its folder. Raises VnetError if the folder is not a finished run's.

    A trace that is not the one whose hash the verdict holds makes the run invalid.
    """
    recorded = RecordedRun.open(folder)
    trace_sha256 = recorded.record.trace_sha256
    judgement = judge(recorded)
    judgement.put(check_replay(folder))
    if judgement.trace_sha256 != trace_sha256:
        text = f"the trace is not the one that verdict.json speaks of ({trace_sha256[:12]}…)"
        judgement.put(CheckResult("trace_sha256", Verdict.INVALID, text))
    return judgement
