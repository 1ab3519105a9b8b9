"""The checks: a run judged from its trace, states, metrics and events alone.

Each check is *valid*, *invalid* or *unknown* with its figures, and the rows that offend. A check that this
scenario could not exercise (a cap that nobody's neighbourhood exceeds) is left out and listed with its reason; one
that should have seen something and saw nothing is unknown. docs/checks.md says what each of them claims.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

from emulator.checks.channel import (
    check_conservation,
    check_isolation,
    check_loss_rate,
    check_peer_cap,
    check_range,
)
from emulator.checks.cooperation import check_bounded_error, check_consensus_mean, check_convergence
from emulator.checks.fault_effects import check_bits
from emulator.checks.faults import (
    check_causes,
    check_down_respected,
    check_fault_loss,
    check_outage_respected,
    check_partition_respected,
    check_pause_respected,
)
from emulator.checks.latency import check_latency
from emulator.checks.radio import check_fading, check_medium
from emulator.checks.replay import ONCE, check_replay
from emulator.checks.run import (
    check_agents_alive,
    check_finite,
    check_kept_up,
    check_liveness,
    check_memory,
    check_presence,
    check_progress,
    check_transport,
)
from emulator.checks.senders import check_copies, check_gnss
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

Check = Callable[[RecordedRun], Finding]
Checks = Callable[[RecordedRun], Iterable[Finding]]

RADIO_CHECKS: tuple[Check, ...] = (check_conservation, check_range, check_peer_cap, check_loss_rate)
"""These need to know where the vehicles are; so do those of the other tuples but the last."""
OF_FRAMES: tuple[Check, ...] = (
    check_fading,
    check_medium,
    check_latency,
    check_isolation,
    check_causes,
    check_partition_respected,
    check_down_respected,
    check_pause_respected,
    check_outage_respected,
    check_copies,
    check_gnss,
)
OF_BELIEFS: tuple[Check, ...] = (
    check_presence,
    check_liveness,
    check_consensus_mean,
    check_convergence,
    check_bounded_error,
)
OF_EACH_FAULT: tuple[Checks, ...] = (check_fault_loss, check_bits)
OF_THE_RUN: tuple[Check, ...] = (
    check_transport,
    check_agents_alive,
    check_progress,
    check_finite,
    check_memory,
    check_kept_up,
)
OF_THE_MACHINE = ("transport", "kept_up")
REALTIME_SENSITIVE = (
    "pause_respected",
    "liveness",
    "consensus_mean",
    "convergence",
    "bounded_error",
)
"""What these see as broken may be the doing of a machine that did not keep up."""


def judge(recorded: RecordedRun) -> Judgement:
    """Run all checks."""
    findings = [*_placed(recorded), *(check(recorded) for check in OF_THE_RUN), ONCE]
    checks = [finding for finding in findings if isinstance(finding, CheckResult)]
    skipped = [finding for finding in findings if isinstance(finding, NotExercised)]
    return Judgement(_downgrade_if_overloaded(checks), skipped, sha256_of_table(recorded.trace))


def _placed(recorded: RecordedRun) -> Iterator[Finding]:
    """The checks that need to know who was where. A run that ended within its first period does not know."""
    reason = "no period was completed, so nobody's position is known"
    if len(recorded.states):
        for check in (*RADIO_CHECKS, *OF_FRAMES, *OF_BELIEFS):
            yield check(recorded)
        for checks in OF_EACH_FAULT:
            yield from checks(recorded)
        return
    for check in RADIO_CHECKS:
        yield CheckResult(_name(check), Verdict.UNKNOWN, reason)
    for check in (*OF_FRAMES, *OF_BELIEFS):
        yield NotExercised(_name(check), reason)


def _name(check: Check) -> str:
    return check.__name__.removeprefix("check_")


def _downgrade_if_overloaded(checks: list[CheckResult]) -> list[CheckResult]:
    """Turn what is to happen in time from invalid to unknown where the machine did not keep up."""
    if all(check.verdict is Verdict.VALID for check in checks if check.name in OF_THE_MACHINE):
        return checks
    return [
        replace(check, verdict=Verdict.UNKNOWN, text=f"{check.text}; but the machine did not keep up")
        if check.name in REALTIME_SENSITIVE and check.verdict is Verdict.INVALID
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
