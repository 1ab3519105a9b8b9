"""The verdict on a run, from its trace, states, metrics and events alone.

Each check is *valid*, *invalid* or *unknown*, with its figures and the offending rows. A check that the scenario
could not exercise (a cap that no neighbourhood exceeds) is not applicable and listed with its reason; one that
should have seen something and saw nothing is unknown. `emulator.checks.registry` is the table of all checks.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from emulator.checks.registry import CHECKS
from emulator.checks.replay import ONCE, check_replay
from emulator.radio.trace import read_trace, sha256_of_table
from emulator.records.busy import read_busy
from emulator.records.recorded_run import RecordedRun
from emulator.records.run_folder import read_events
from emulator.records.verdicts import CheckResult, Finding, Judgement, NotExercised, Verdict
from emulator.scenario.scenario import load_scenario
from vnet.errors import VnetError

__all__ = [
    "CheckResult",
    "Judgement",
    "NotExercised",
    "RecordedRun",
    "Verdict",
    "check_run",
    "judge",
    "read_recorded_run",
    "recorded_verdict",
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


def recorded_verdict(folder: Path) -> dict[str, Any]:
    """What verdict.json says. Raises VnetError if it cannot be read."""
    try:
        verdict: dict[str, Any] = json.loads((folder / "verdict.json").read_text())
        verdict["trace_sha256"], verdict["reproduce"]
    except (OSError, ValueError, KeyError) as error:
        raise VnetError(f"{folder}: not the folder of a finished run: {error}") from None
    return verdict


def check_run(folder: Path) -> Judgement:
    """Judge a run from its folder. Raises VnetError if the folder is not a finished run's.

    A trace that is not the one whose hash the verdict holds makes the run invalid.
    """
    recorded = read_recorded_run(folder)
    trace_sha256 = recorded_verdict(folder)["trace_sha256"]
    judgement = judge(recorded)
    judgement.put(check_replay(folder))
    if judgement.trace_sha256 != trace_sha256:
        text = f"the trace is not the one that verdict.json speaks of ({trace_sha256[:12]}…)"
        judgement.put(CheckResult("trace_sha256", Verdict.INVALID, text))
    return judgement


def read_recorded_run(folder: Path) -> RecordedRun:
    """What a run has left in its folder. Raises VnetError if the folder is not a finished run's."""
    events = read_events(folder)
    try:
        trace = read_trace(folder / "trace.parquet")
        states = pq.read_table(folder / "states.parquet")
        metrics = pq.read_table(folder / "metrics.parquet")
    except (OSError, pa.ArrowInvalid, ValueError) as error:
        raise VnetError(f"{folder}: not the folder of a finished run: {error}") from None
    scenario = load_scenario(folder / "scenario.toml")
    busy = None if scenario.radio.mac is None else read_busy(folder)
    return RecordedRun(scenario, trace, states, metrics, events, busy=busy)
