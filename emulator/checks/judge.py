"""The verdict on a run, from its trace, states, metrics and events alone.

Each check is *valid*, *invalid* or *unknown*, with its figures and the offending rows. A check that the scenario
could not exercise (a cap that no neighbourhood exceeds) is not applicable and listed with its reason; one that
should have seen something and saw nothing is unknown. `emulator.checks.registry` is the table of all checks.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from emulator.checks.folder import judge_folder
from emulator.checks.own import PREFIX, load_checks, own_findings, recorded_findings
from emulator.checks.registry import CHECKS, Subject
from emulator.checks.replay import ONCE, check_replay
from emulator.radio.trace import sha256_of_table
from emulator.records.recorded_run import OpenedRun, RecordedRun
from emulator.records.run import Run
from emulator.records.verdicts import CheckResult, Finding, Judgement, NotExercised, Verdict
from emulator.scenario.loading import with_modules

__all__ = [
    "CheckResult",
    "Judgement",
    "NotExercised",
    "RecordedRun",
    "Verdict",
    "check_run",
    "judge",
]


def judge(recorded: RecordedRun, own: Iterable[Finding] = ()) -> Judgement:
    """Judge a run by all checks; `own` are the findings of checks of the user's own."""
    findings: list[Finding] = [finding for check in CHECKS for finding in check.findings(recorded)]
    findings += [ONCE, *own]
    checks = [finding for finding in findings if isinstance(finding, CheckResult)]
    skipped = [finding for finding in findings if isinstance(finding, NotExercised)]
    return Judgement(_downgrade_if_overloaded(checks), skipped, sha256_of_table(recorded.trace))


def _downgrade_if_overloaded(checks: list[CheckResult]) -> list[CheckResult]:
    """Make invalid checks of timing unknown if the machine did not keep up."""
    of_machine = {check.name for check in CHECKS if check.subject is Subject.MACHINE}
    sensitive = {check.name for check in CHECKS if check.realtime_sensitive}
    if all(check.verdict is Verdict.VALID for check in checks if check.name in of_machine):
        return checks
    return [
        replace(check, verdict=Verdict.UNKNOWN, text=f"{check.text}; but the machine did not keep up")
        if (check.name in sensitive or check.name.startswith(PREFIX)) and check.verdict is Verdict.INVALID
        else check
        for check in checks
    ]


def check_run(folder: Path, own_checks: bool = False, checks: Sequence[str] = ()) -> Judgement:
    """Judge a run from its folder. Raises VnetError if the folder is not a finished run's.

    Checks of the user's own stand as the folder holds them; nothing that it names is imported. With `own_checks`
    those of its scenario are run again, and so are further `checks`. A trace that is not the one whose hash the
    verdict holds makes the run invalid.
    """
    recorded = RecordedRun.open(folder)
    trace_sha256 = recorded.record.trace_sha256
    judgement = judge(recorded, _own_findings(recorded, folder, own_checks, checks))
    judgement.put(check_replay(folder))
    if judgement.trace_sha256 != trace_sha256:
        text = f"the trace is not the one that verdict.json speaks of ({trace_sha256[:12]}…)"
        judgement.put(CheckResult("trace_sha256", Verdict.INVALID, text))
    judge_folder(recorded, judgement)
    return judgement


def _own_findings(recorded: OpenedRun, folder: Path, own_checks: bool, checks: Sequence[str]) -> list[Finding]:
    """Findings of checks of the user's own: as recorded, or of those that are run again."""
    program, found = recorded.scenario.program, {}
    exceptions = tuple(each.model_copy(update={"command": None}) for each in program.exceptions)
    program = program.model_copy(update={"command": None, "exceptions": exceptions})  # whose files may be gone
    if not own_checks:  # the folder has no say in where modules come from
        program = program.model_copy(update={"checks": (), "folders": ()})
        found = {finding.name: finding for finding in recorded_findings(recorded.record)}
    program = with_modules(program, None, checks)
    load_checks(program)
    return list(
        (found | {finding.name: finding for finding in own_findings(program, Run(recorded, folder))}).values()
    )
