"""The result of a check: valid, invalid or unknown, in words, figures and offending rows."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

MOST_ROWS = 10
"""Offending rows that a failed check shows."""
NO_FAULTS = "the scenario has no faults"


class Verdict(StrEnum):
    """Verdict of a check, or of a run."""

    VALID = "valid"
    INVALID = "invalid"
    UNKNOWN = "unknown"

    @property
    def exit_status(self) -> int:
        """The exit status of a command that ends with this verdict."""
        return {Verdict.VALID: 0, Verdict.INVALID: 1, Verdict.UNKNOWN: 3}[self]


@dataclass(frozen=True)
class CheckResult:
    """One check's verdict, in words and figures. `figures["rows"]` of one that failed are its first offenders."""

    name: str
    verdict: Verdict
    text: str
    figures: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class NotExercised:
    """A check that this run could not exercise, and why."""

    name: str
    reason: str


Finding = CheckResult | NotExercised


@dataclass(frozen=True)
class Judgement:
    """All checks of a run and what they come to together: invalid wins over unknown, unknown over valid."""

    checks: list[CheckResult]
    not_exercised: list[NotExercised]
    trace_sha256: str

    @property
    def verdict(self) -> Verdict:
        """The verdict of the run."""
        verdicts = {check.verdict for check in self.checks}
        for verdict in (Verdict.INVALID, Verdict.UNKNOWN):
            if verdict in verdicts:
                return verdict
        return Verdict.VALID

    @property
    def not_applicable(self) -> dict[str, list[str]]:
        """Names of the checks that the run could not exercise, by reason."""
        names: dict[str, list[str]] = {}
        for left in self.not_exercised:
            names.setdefault(left.reason, []).append(left.name)
        return names

    @property
    def exit_status(self) -> int:
        """The exit status of a command that ends with this judgement."""
        return self.verdict.exit_status

    def put(self, finding: Finding) -> None:
        """Add a finding, in place of what was found under its name."""
        self.checks[:] = [check for check in self.checks if check.name != finding.name]
        self.not_exercised[:] = [left for left in self.not_exercised if left.name != finding.name]
        if isinstance(finding, CheckResult):
            self.checks.append(finding)
        else:
            self.not_exercised.append(finding)


def result(
    name: str, broken: int, text: str, broken_text: str, rows: list[dict[str, Any]] | None = None, **figures: Any
) -> CheckResult:
    """Invalid with its offending rows where anything is broken, else valid."""
    if not broken:
        return CheckResult(name, Verdict.VALID, text, figures)
    return CheckResult(name, Verdict.INVALID, broken_text, {**figures, "rows": (rows or [])[:MOST_ROWS]})


def unknown(name: str, text: str, **figures: Any) -> CheckResult:
    """A check that should have seen something, and did not."""
    return CheckResult(name, Verdict.UNKNOWN, text, figures)
